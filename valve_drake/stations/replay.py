"""The recorded station: the contract's ports, fed by a log instead of a machine. No physics, no rendering.

It shows every reader what that reader was shown when the log was written, to the bit. The recorder publishes at every
tick and sees what was there before the tick's updates; a stage reads in the slot that it runs in (ports.py). Hence

| what                 | is recorded at                                   | and is shown again               |
|----------------------|--------------------------------------------------|----------------------------------|
| all vectors          | every tick, which is when robot_state reads them | from that tick on                |
| health               | the tick after it appeared                       | from right after the tick before |
| images               | the tick after a stage has looked at one         | from right after the tick before |
| own command, packets | the tick after it was given                      | from right after the tick before |

An image is the recorded JPEG, decoded as the live camera does, with the capture time and the sequence that its consumer
passed on. A log holds only the images that a stage looked at: a stage that looks at another time gets the last of them.
"""

import bisect
import collections
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, Diagram

from valve_drake.checks import ConfigError
from valve_drake.messages import CAMERAS, SIDES, CameraFrame, Health, Message, OperatorCommand, OperatorPackets
from valve_drake.ports import TICK, PythonSystem
from valve_drake.recording.foxglove import NANO, nanoseconds
from valve_drake.recording.reader import LogReader, Record
from valve_drake.recording.schemas import Wrench, proto_class
from valve_drake.recording.signals import FRAMES, JOINED, measured, topic_of
from valve_drake.robot.groups import Groups
from valve_drake.stations.camera_rig import decode_image
from valve_drake.stations.contract import CONTRACT, PortSpec, station_of, vectors

JOINTS, HEALTH, OPERATOR, PACKETS = "/joint_states", "/health", "/operator/command", "/operator/packets"
CONSUMERS = {topic_of(port) for port, _, _ in FRAMES.values()}
_JOINT = "joints."
_WRENCH = [f"{part}.{k}" for part in ("torque", "force") for k in range(3)]
WRENCHES = {f"/{side}_wrist/wrench": {f"{side}_wrist.wrench": _WRENCH} for side in SIDES}
IMAGES = {f"/{camera}/image": camera for camera in CAMERAS}


def _vectors(groups: Groups) -> dict[str, dict[str, list[str]]]:
    """Topic -> port -> where its values are in the topic's messages."""
    ports = measured(groups)
    joined = {**ports, "measured": itertools.chain.from_iterable(ports.values())}
    return {JOINTS: {port: [_JOINT + name for name in names] for port, names in joined.items()}, **WRENCHES}


def schemas_of(vectors: Iterable[str]) -> dict[str, str]:
    """Topics that are read -> the schema of their messages. vectors: topics of vectors."""
    kinds: dict[str, type[Message]] = {HEALTH: Health, OPERATOR: OperatorCommand, PACKETS: OperatorPackets}
    kinds |= {topic_of(port): kind for port, kind, _ in FRAMES.values()}
    kinds |= {topic: Wrench for topic in vectors if topic != JOINTS}
    out = {topic: proto_class(kind).DESCRIPTOR.full_name for topic, kind in kinds.items()}
    return (
        out | {JOINTS: JointStates.DESCRIPTOR.full_name} | dict.fromkeys(IMAGES, CompressedImage.DESCRIPTOR.full_name)
    )


class History:
    """What one port showed: values by the time of the tick that recorded them."""

    def __init__(self, times: Iterable[float] = (), values: Iterable[Any] = ()) -> None:
        self.times = list(times)  # [s]
        self.values = list(values)

    def add(self, time: float, value: Any) -> None:
        """The value from `time` on, which is not before the last one's [s]."""
        self.times.append(time)
        self.values.append(value)

    def at(self, time: float) -> Any:
        """The last value recorded up to `time`; the first one before that."""
        return self.values[max(bisect.bisect_right(self.times, time) - 1, 0)]


class Recording:
    """All that a log holds of the machine that it was recorded from.

    end: the last tick up to which everything is there [s]; a damaged log is replayed up to its damage.
    histories: History by port of the contract: arrays, Health, or (time, CameraFrame without its image).
    joined: the same of the ports of the recorder that join several (signals.JOINED).
    requests: the program's own commands. packets: what operators have sent.
    groups: the joints of the robot that was recorded.
    Raises ConfigError if the log lacks something that the stages read, or holds it in another schema.
    """

    def __init__(self, log: LogReader, groups: Groups):
        self._log, self.groups = log, groups
        self.histories: dict[str, History] = collections.defaultdict(History)
        self.joined: dict[str, History] = {}
        self.requests, self.packets = History(), History()
        topics = _vectors(groups)
        needed = {HEALTH, OPERATOR, *topics, *CONSUMERS}
        if missing := sorted(needed - {name for name, topic in log.topics.items() if topic.count > 0}):
            raise ConfigError(f"{log.path} cannot be replayed: it has no messages of {', '.join(missing)}")
        for topic, schema in schemas_of(topics).items():
            if topic in log.topics and log.topics[topic].schema != schema:
                raise ConfigError(
                    f"{log.path}: {topic} holds {log.topics[topic].schema or 'no messages'}, not {schema}"
                )
        images = set()  # topic, time
        vectors: dict[str, list[Record]] = {topic: [] for topic in topics}
        for record in log.records(needed | ({PACKETS, *IMAGES} & log.topics.keys())):
            topic, time = record.topic, record.time
            if topic in IMAGES:
                images.add((topic, time))
            elif topic in vectors:
                vectors[topic].append(record)
            elif topic in CONSUMERS:
                self._add_frames(topic, time, log.decode(record))
            else:
                history = {OPERATOR: self.requests, PACKETS: self.packets, HEALTH: self.histories["health"]}[topic]
                history.add(time, log.decode(record))
        for topic, ports in topics.items():
            self._add_vectors(vectors[topic], ports)
        self.end = self._sound_end()
        for camera in CAMERAS:
            history = self.histories[f"{camera}.image"]
            for time, frame in history.values:
                if frame.sequence >= 0 and time <= self.end and (f"/{camera}/image", time) not in images:
                    raise ConfigError(f"{log.path} lacks the image {frame.sequence} of {camera} at t = {time:.3f} s")

    def sent(self, topics: Iterable[str]) -> Iterator[Record]:
        """The messages of those of the topics that the log has; `decode` reads one."""
        return self._log.records(self._log.topics.keys() & topics)

    def decode(self, record: Record) -> Any:
        """The message of a record. Raises ConfigError if this version of the program cannot hold it."""
        return self._log.decode(record)

    def frame(self, time: float, header: CameraFrame) -> CameraFrame:
        """The frame with its image, as recorded at `time`. Raises ConfigError if the log does not hold it."""
        if header.sequence < 0:
            return header
        for _, _, recorded in self._log.messages([f"/{header.camera}/image"], time, time):
            message: Any = recorded
            stamp = message.timestamp
            if stamp.seconds * NANO + stamp.nanos == nanoseconds(header.time):
                try:
                    image = decode_image(message.data)
                except ValueError as error:
                    words = f"{error}: of {header.camera} at t = {time:.3f} s"
                    raise ConfigError(f"{self._log.path} holds {words}") from error
                return CameraFrame(header.camera, header.time, header.sequence, image, message.data)
        raise ConfigError(f"{self._log.path} holds another image of {header.camera} at t = {time:.3f} s")

    def _add_vectors(self, records: list[Record], ports: Mapping[str, Sequence[str]]) -> None:
        """The ports of one topic; `ports`: of each the paths of its values."""
        topic, table = records[0].topic, self._log.table(records)
        times = [record.time for record in records]
        for port, paths in ports.items():
            for path in paths:
                if path not in table.columns or path in table.gaps:
                    raise ConfigError(f"{self._log.path}: {topic} has no {path.removeprefix(_JOINT)}")
            values = table.values[:, [table.columns[path] for path in paths]]
            (self.joined if port in JOINED else self.histories)[port] = History(times, values)

    def _add_frames(self, topic: str, time: float, message: Any) -> None:
        for camera, (port, _, frame) in FRAMES.items():
            if topic_of(port) != topic:
                continue
            header, history = frame(message), self.histories[f"{camera}.image"]
            if not history.values:
                history.add(0.0, (0.0, CameraFrame(camera=camera)))  # before the first capture
            if header.sequence != history.values[-1][1].sequence:
                history.add(time, (time, header))

    def _sound_end(self) -> float:
        """Every tick is in JOINTS: the first one that is missing tells where something was lost."""
        times = self.histories["base.odometry"].times
        count = next((k for k, time in enumerate(times) if time != k * TICK), len(times))
        damaged = self._log.damage or self._log.past_damage
        last = count - 1 - bool(damaged or count < len(times))  # of the last tick before a loss some may be missing
        if last < 0:
            raise ConfigError(f"{self._log.path} has no tick that is whole")
        return last * TICK


class RecordedStation(PythonSystem):
    """A Recording on the contract's ports. Its outputs are functions of time; its inputs are not read."""

    def __init__(self, recording: Recording):
        super().__init__()
        self.set_name("recorded_station")
        ports, sizes = shown(recording), vectors(recording.groups)
        for spec in CONTRACT:
            if spec.direction == "in":
                self.DeclareVectorInputPort(spec.name, sizes[spec.name])
                continue
            read, when = ports[spec.name], {self.time_ticket()}
            if not isinstance(spec.kind, type):
                self.DeclareVectorOutputPort(spec.name, sizes[spec.name], _vector(read), when)
            else:
                self.DeclareAbstractOutputPort(spec.name, functools.partial(Value, spec.kind()), _message(read), when)


def _vector(read: Callable[[float], Any]) -> Callable[[Context, BasicVector], None]:
    return lambda context, output: output.SetFromVector(read(context.get_time()))


def _message(read: Callable[[float], Any]) -> Callable[[Context, Value], None]:
    return lambda context, output: output.set_value(read(context.get_time()))


def shown(recording: Recording) -> dict[str, Callable[[float], Any]]:
    """What each output port of the contract shows at a time [s] (see the top of this file)."""
    frame = functools.lru_cache(maxsize=len(CAMERAS))(recording.frame)

    def reader(spec: PortSpec) -> Callable[[float], Any]:
        at = recording.histories[spec.name].at
        if not isinstance(spec.kind, type):
            return at
        if spec.kind is CameraFrame:
            return lambda time: frame(*at(_next_tick(time)))
        return lambda time: at(_next_tick(time))

    return {spec.name: reader(spec) for spec in CONTRACT if spec.direction == "out"}


def _next_tick(time: float) -> float:
    """The tick at or after `time`: the one that recorded what could be read then."""
    return math.ceil(time / TICK) * TICK


def make_replay_station(recording: Recording) -> Diagram:
    """The station as a Diagram named `replay`."""
    station = RecordedStation(recording)
    return station_of("replay", inputs=station, outputs=station, groups=recording.groups)
