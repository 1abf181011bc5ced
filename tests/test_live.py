"""The live view: a real client on loopback subscribes and gets the recorder's messages, as their schema says."""

import base64
import json
import os
import socket
import struct
import sys
import time

import numpy as np
import pytest

from valve_drake import cli
from valve_drake.checks import ConfigError
from valve_drake.messages import ModeState, RobotState
from valve_drake.recording import foxglove as schemas_foxglove
from valve_drake.recording import schemas
from valve_drake.recording.live import LiveView
from valve_drake.recording.recorder_system import Tee

PROTOCOL = "foxglove.sdk.v1"
TEXT, BINARY = 1, 2


class Client:
    """The parts of RFC 6455 (WebSocket) and of Foxglove's protocol that a subscriber needs."""

    def __init__(self, port):
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=5)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n".encode()
        )
        self._buffer = b""
        while b"\r\n\r\n" not in self._buffer:
            self._buffer += self._socket.recv(65536)
        head, self._buffer = self._buffer.split(b"\r\n\r\n", 1)
        assert b" 101 " in head.split(b"\r\n")[0]
        self.channels = {}

    def _take(self, count):
        while len(self._buffer) < count:
            more = self._socket.recv(65536)
            if not more:
                raise EOFError
            self._buffer += more
        out, self._buffer = self._buffer[:count], self._buffer[count:]
        return out

    def frame(self):
        first, second = self._take(2)
        size = second & 0x7F
        if size == 126:
            (size,) = struct.unpack(">H", self._take(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self._take(8))
        return first & 0x0F, self._take(size)

    def send(self, message):
        data = json.dumps(message).encode()
        head = struct.pack(">BBH", 0x80 | TEXT, 0x80 | 126, len(data))
        self._socket.sendall(head + b"\0\0\0\0" + data)  # a mask of zeros changes nothing

    def subscribe(self, *topics):
        """Waits until all of them are announced, then subscribes: the subscription's number is the channel's."""
        while not set(topics) <= {c["topic"] for c in self.channels.values()}:
            kind, data = self.frame()
            message = json.loads(data) if kind == TEXT else {}
            if message.get("op") == "advertise":
                self.channels |= {c["id"]: c for c in message["channels"]}
        wanted = [c["id"] for c in self.channels.values() if c["topic"] in topics]
        self.send({"op": "subscribe", "subscriptions": [{"id": n, "channelId": n} for n in wanted]})

    def message(self):
        """The next message: topic, time [ns], content."""
        while True:
            kind, data = self.frame()
            if kind == BINARY and data[0] == 1:
                number, when = struct.unpack("<IQ", data[1:13])
                return self.channels[number]["topic"], when, data[13:]

    def close(self):
        self._socket.close()


@pytest.fixture
def live():
    pytest.importorskip("foxglove", reason="the live extra is not installed")
    with LiveView(port=0) as view:
        yield view


def test_a_client_gets_what_the_recorder_writes_with_its_time_and_schema(live):
    state = RobotState(time=0.5, odometry=np.arange(5.0))
    live.write("/robot_state/robot_state", state, 0.5)
    client = Client(live.port)
    client.subscribe("/robot_state/robot_state")
    topic, when, data = client.message()  # the last message comes at once
    assert (topic, when) == ("/robot_state/robot_state", 500_000_000)
    assert schemas.decode(RobotState, data).odometry.tolist() == state.odometry.tolist()
    later = RobotState(time=0.75, odometry=np.ones(5))
    live.write("/robot_state/robot_state", later, 0.75)
    topic, when, data = client.message()
    assert when == 750_000_000 and data == schemas.encode(later)
    channel = next(iter(client.channels.values()))
    assert channel["schemaName"] == "valve_drake.RobotState" and channel["encoding"] == "protobuf"
    client.close()


def test_foxglove_messages_are_kept_as_they_were_when_written(live):
    message = schemas_foxglove.log(1.0, "supervisor", "first")
    live.write("/log", message, 1.0)
    message.message = "changed by its maker"
    client = Client(live.port)
    client.subscribe("/log")
    _, _, data = client.message()
    assert type(message).FromString(data).message == "first"
    client.close()


def test_topics_that_begin_later_are_announced_to_those_who_are_connected(live):
    client = Client(live.port)
    live.write("/supervisor/mode", ModeState(mode="search"), 0.0)
    client.subscribe("/supervisor/mode")
    assert schemas.decode(ModeState, client.message()[2]).mode == "search"
    client.close()


def test_without_a_client_or_with_one_that_left_writing_goes_on(live):
    client = Client(live.port)
    client.close()
    for k in range(50):
        live.write("/supervisor/mode", ModeState(time=k / 32), k / 32)


def test_it_listens_on_loopback_only(live):
    with open("/proc/net/tcp", encoding="ascii") as table:
        listening = [row.split()[1] for row in list(table)[1:] if row.split()[3] == "0A"]
    mine = [address for address in listening if int(address.split(":")[1], 16) == live.port]
    assert [address.split(":")[0] for address in mine] == ["0100007F"]


def test_a_taken_port_is_one_line(live):
    with pytest.raises(ConfigError, match=f"127.0.0.1:{live.port}"):
        LiveView(port=live.port)


def test_a_slow_client_does_not_hold_up_the_loop(live):
    live.write("/robot_state/robot_state", RobotState(), 0.0)
    client = Client(live.port)
    client.subscribe("/robot_state/robot_state")
    client.message()
    begin = time.perf_counter()
    for k in range(1, 3000):  # nobody reads them
        live.write("/robot_state/robot_state", RobotState(history=np.zeros((100, 7))), k / 128)
    assert time.perf_counter() - begin < 5.0
    client.close()


def test_without_the_extra_run_live_says_in_one_line_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    assert cli.main(["run", "--live", "--duration", "0.1", "--log", str(tmp_path / "a.mcap")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "valve-drake[live]" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.system
def test_a_run_is_served_while_it_goes_on_and_its_log_is_the_same_to_the_byte(tmp_path):
    pytest.importorskip("foxglove", reason="the live extra is not installed")
    from valve_drake import runner
    from valve_drake import scenario as scenarios

    seen = []
    with LiveView(port=0) as view:
        client = Client(view.port)

        def watch(progress):
            if progress.sim_time == 0.0625:
                client.subscribe("/supervisor/mode", "/scene")
            elif progress.sim_time > 0.25 and not seen:
                seen.extend(client.message() for _ in range(4))

        runner.run(scenarios.load(None, ["seed=4"]), tmp_path / "live.mcap", duration=0.5, show=watch, live=view)
        client.close()
    assert {topic for topic, _, _ in seen} == {"/supervisor/mode", "/scene"}
    runner.run(scenarios.load(None, ["seed=4"]), tmp_path / "still.mcap", duration=0.5)
    assert (tmp_path / "live.mcap").read_bytes() == (tmp_path / "still.mcap").read_bytes()


def test_a_tee_writes_to_all_its_sinks_in_order():
    got = []

    class Sink:
        def __init__(self, name):
            self.name = name

        def write(self, topic, message, time):
            got.append((self.name, topic, time))

        def flush(self):
            got.append((self.name, "flush", None))

    tee = Tee(Sink("a"), Sink("b"))
    tee.write("/x", ModeState(), 1.0)
    tee.flush()
    assert got == [("a", "/x", 1.0), ("b", "/x", 1.0), ("a", "flush", None), ("b", "flush", None)]
