"""The log's channels served live to Foxglove over its WebSocket: a sink for the recorder, beside the log's writer.

Only topics with a subscriber are sent. A new subscriber gets the topic's last message at once, because the scene and
the calibrations are sent rarely. The server never blocks the control loop: a client that is too slow loses messages.
"""

from types import TracebackType
from typing import Any, Self

from google.protobuf.message import Message as Proto

from valve_drake.checks import ConfigError
from valve_drake.recording import schemas
from valve_drake.recording.foxglove import NANO, nanoseconds

HOST, PORT = "127.0.0.1", 8765
CLOCK_PERIOD = NANO // 32  # the time is sent to the clients this often [ns]


class LiveView:
    """A sink of the recorder (recorder_system.Sink). Use it as a context manager: leaving it ends the server.

    port 0: any free one; `port` says which. Raises ConfigError if the `live` extra is missing or the port is taken.
    """

    def __init__(self, port: int = PORT, host: str = HOST):
        try:
            import foxglove
            from foxglove.websocket import ServerListener
        except ImportError:
            raise ConfigError("--live needs the foxglove-sdk package: pip install 'valve-drake[live]'") from None

        class Listener(ServerListener):
            def on_subscribe(_, client: Any, channel: Any) -> None:
                self._repeat(channel.topic)

        self._foxglove = foxglove
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._last: dict[str, tuple[bytes, int]] = {}  # topic -> message, when [ns]
        self._clock = -CLOCK_PERIOD
        try:
            self._server = foxglove.start_server(
                name="valve-drake",
                host=host,
                port=port,
                capabilities=[foxglove.Capability.Time],
                server_listener=Listener(),
                context=self._context,
            )
        except (RuntimeError, OSError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ConfigError(f"--live cannot serve on {host}:{port}: {reason}") from None

    @property
    def port(self) -> int:
        """Where the server listens."""
        return self._server.port

    def write(self, topic: str, message: schemas.Loggable, time: float) -> None:
        """Sends a message of `topic` at `time` [s] to those who have subscribed to it."""
        when = nanoseconds(time)
        if when - self._clock >= CLOCK_PERIOD:
            self._clock = when
            self._server.broadcast_time(when)
        kind, data = schemas.serialized(message)
        channel = self._channels.get(topic) or self._define(topic, kind)
        self._last[topic] = data, when
        if channel.has_sinks():
            channel.log(data, log_time=when)

    def flush(self) -> None:
        """Does nothing: no message is buffered."""

    def close(self) -> None:
        """Ends the server."""
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _define(self, topic: str, kind: type[Proto]) -> Any:
        schema = self._foxglove.Schema(
            name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=schemas.schema_data(kind)
        )
        channel = self._foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
        self._channels[topic] = channel
        return channel

    def _repeat(self, topic: str) -> None:
        """Called by the server's thread."""
        if topic in self._last and topic in self._channels:
            data, when = self._last[topic]
            self._channels[topic].log(data, log_time=when)
