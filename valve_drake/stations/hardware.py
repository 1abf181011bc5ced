"""The hardware station: the contract's ports, made of LCM messages from and to a robot (lcm_channels.py has the table).

`RobotLink` keeps what the robot reported last, as a socket does, outside the Context; two blocks stand between it and
the ports. `lcm_receiver` reads it in slot 3, just before the next tick; `lcm_sender` publishes the commands of a tick
at its end. When the station is initialised, it waits for every device's first report.

A report is news only if its stamp is later than that of the last one. Sensors with noise (wrists, cameras), and any
device that reports a speed, must also report other values than last time. Duplicates, overtaken messages and frozen
sensors are therefore silence, which `health` reports as age by the receiver's clock. A message that cannot be read,
an image that cannot be decoded and a report that is not finite are dropped and counted; the first two are a fault if
they go on, the last one at once. A wrist sensor that is broken or silent reads NaN, since its last report is not the
present force.

Drake's own LCM subscribers are not used: their Python binding keeps one message a channel until it is asked for, and
they do not judge stamps.

Time: images are stamped by the robot's clock, and are placed on this side's by the least delay that the joints'
reports had of late.
"""

import collections
import dataclasses as dc
import functools
import math
import time as wall
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, Diagram, State

from valve_drake import profiling
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.console import complain
from valve_drake.messages import CAMERAS, HEAD, SIDES, CameraFrame, Health
from valve_drake.ports import SLOT, TICK, PythonSystem
from valve_drake.robot.groups import GROUPS, Groups
from valve_drake.robot.robot import Robot
from valve_drake.stations.bus import BadMessage, Bus
from valve_drake.stations.camera_rig import decode_image
from valve_drake.stations.contract import CONTRACT, SAID_BY, station_of, vectors
from valve_drake.stations.lcm_channels import (
    CHANNELS,
    COMMANDS,
    CONTROLLER,
    IMAGES,
    LOCKSTEP_TIME,
    MODE,
    PROTOCOL,
    REPORTS,
    REQUEST,
    ROBOT,
    STATE,
    SYNC,
    Values,
    WrongMessage,
    check_sizes,
    from_utime,
    present,
    read_image,
    read_named,
    to_utime,
)
from valve_drake.stations.reports import BadMessages, LeastDelay, Lockstep, Stamps, listed
from valve_drake.stations.torque_wrench import add_torque_wrenches

NEVER_STILL = tuple(row.key for row in REPORTS if row.device.endswith("wrist_sensor"))
SPEEDS = ("base.odometry", *(f"{side}_arm.velocity_measured" for side in SIDES))  # ports that tell of motion
MOVING = 0.005  # [rad/s, m/s]
ABSURD = 1e6  # a larger number in a report is no measurement, in any unit of the table
LOOKED_AT = 0.75  # a camera is requested for this long after it was last read; the search reads it every 0.5 s [s]
EARLY = 0.1  # an image may be stamped this far ahead of the robot's other reports [s]
DECODING = 3e-3  # time to allow for decoding an image, twice what it takes; raise it for larger images [s]
AHEAD = SLOT / 2  # the station is read this long before a tick, after slot 3 of the tick before [s of the diagram]
HEALTH_TICKS = 4  # health is reported every 1/32 s
PATIENCE = {"robot": 0.1}  # of devices that do not report every tick (reports.py) [s]
PATIENCE |= dict.fromkeys(CAMERAS, 0.5) | {f"{camera} late": 0.9 for camera in CAMERAS}
NOTICE = 2.0  # the user is told of a wait for the robot that takes longer [s]


@dc.dataclass
class _Report:
    """The last report of one device that was news."""

    arrival: float  # [s] of the receiver's clock
    values: Any


@dc.dataclass(eq=False)
class _Image:
    utime: int
    sequence: int
    data: bytes
    time: float  # of capture, on this side's clock [s]
    before: float  # when the camera's last image before this one had arrived [s, receiver's clock]
    frame: CameraFrame | None = None  # once it was decoded; without pixels if it cannot be


@dc.dataclass(frozen=True)
class Snapshot:
    """What the ports show during one tick."""

    values: Values
    images: dict[str, _Image | None]
    health: Health

    def __deepcopy__(self, memo: dict[int, Any]) -> "Snapshot":
        return self


def _before(groups: Groups) -> Snapshot:
    """What the ports show until the station is initialised."""
    values = {name: np.full(size, np.nan) for name, size in vectors(groups, "out").items()}
    return Snapshot(values, dict.fromkeys(CAMERAS), Health())


class CameraRequests:
    """Which cameras the robot is asked for: those that a block looked at of late."""

    def __init__(self) -> None:
        self._looked: dict[str, float] = {}  # camera -> last look [s of the diagram]
        self.since: dict[str, float] = {}  # requested cameras -> since when [s, receiver's clock]

    def look(self, camera: str, time: float) -> None:
        """A block reads the camera's port."""
        self._looked[camera] = time

    def update(self, time: float, clock: float) -> bool:
        """At the end of a tick -> whether the request has changed."""
        wanted = [camera for camera, looked in self._looked.items() if time - looked <= LOOKED_AT]
        changed = set(wanted) != set(self.since)
        self.since = {camera: self.since.get(camera, clock) for camera in wanted}
        return changed

    def message(self) -> dict[str, float]:
        """Of every camera whether it is requested, 1 or 0."""
        return {camera: float(camera in self.since) for camera in CAMERAS}


class RobotLink:
    """The program's end of the wire.

    groups: the joints of the robot at the other end. idle: called while this side waits for the robot with nothing to
    do; a robot in the same process steps there.
    notice: tells the user, one line, what is waited for. stop: True ends the wait for a robot.
    """

    def __init__(
        self,
        bus: Bus,
        groups: Groups,
        idle: Callable[[], None] | None = None,
        *,
        notice: Callable[[str], None] = complain,
        stop: Callable[[], bool] = lambda: False,
    ):
        self.bus = bus
        self.groups = groups
        self._sizes = vectors(groups)
        self._silent = [SAID_BY[device] for device in groups.absent]
        self._report_rows, self._command_rows = present(REPORTS, groups), present(COMMANDS, groups)
        # Reports of what is never still for noise, and the port that tells of a force: unknown when they stay away.
        self._forces = {f"{side}_wrist_sensor.status": f"{side}_wrist.wrench" for side in SIDES}
        for side in SIDES:
            if f"{side}_wrist_sensor" in groups.absent:
                self._forces[f"{side}_arm.status"] = f"{side}_arm.torque_measured"
        self._devices = (*(row.device for row in self._report_rows), *IMAGES, "robot")  # in the order of `_diagnose`
        self.stop = stop
        self._config = bus.config
        self._idle = idle or (lambda: wall.sleep(2e-4))
        self._notice = notice
        self._stamps = Stamps()
        self._bad = BadMessages(PATIENCE)
        self._reports: dict[str, _Report] = {}
        self._delay = LeastDelay()
        self._lockstep = Lockstep()
        self._requests = CameraRequests()
        self._images: dict[str, collections.deque[_Image]] = {c: collections.deque(maxlen=4) for c in CAMERAS}
        self._capture_time: dict[int, float] = {}  # utime of a capture -> time on this side
        self._time = 0.0  # of the tick that looks at what arrives now [s of the diagram]
        self._answered = -1  # the last tick whose commands were sent
        self._health = Health()
        self._sent_mode: tuple[str, int] | None = None  # mode and activation
        self._new_mode: tuple[str, int] | None = None  # the same, to be sent with the next commands
        bus.listen(ROBOT, self._hear)

    # ------------------------------------------------------------ the wire
    def clock(self) -> float:
        """The receiver's clock [s]: the wall's, but in lock-step the diagram's."""
        return self._time if self._config.lockstep else wall.monotonic()

    def _hear(self, key: str, message: Any) -> None:
        device = CHANNELS[key].device
        if isinstance(message, BadMessage):
            self._bad.bad(device, message.words, self.clock())
            return
        try:
            if key == SYNC[ROBOT]:
                if not self._lockstep.hear(message):
                    raise WrongMessage("sync of other numbers than tick and messages")
                return
            self._lockstep.count()
            self._read(key, message)
        except WrongMessage as error:
            self._bad.bad(device, f"{device}: {error}", self.clock())

    def _read(self, key: str, message: Any) -> None:
        row = CHANNELS[key]
        if row.read is not None:
            self._take(key, getattr(message, row.stamp), check_sizes(row.read(message), self._sizes))
        elif key == STATE:
            self._take(key, message.timestamp, read_named(message))
        elif row.device in IMAGES:
            self._take_image(row.device, key, read_image(message, self._config.image_size))

    def _is_news(self, key: str, stamp: int) -> bool:
        device, now = CHANNELS[key].device, self.clock()
        verdict = self._stamps.judge(key, stamp, now)
        if verdict == Stamps.RESTARTED:
            self._delay.forget()
        if verdict in (Stamps.STRANGE, Stamps.RESTARTED):
            self._bad.bad(device, f"{device} restarted", now, at_once=verdict == Stamps.RESTARTED)
        return verdict in (Stamps.NEWS, Stamps.RESTARTED)

    def _take(self, key: str, stamp: int, values: Any) -> None:
        """Keeps a report if it is news."""
        if not self._is_news(key, stamp):
            return
        row, last, arrival = CHANNELS[key], self._reports.get(key), self.clock()
        if not _sound(values):
            self._bad.bad(row.device, f"{row.device}: not finite", arrival, at_once=True)
            if last is None or key not in NEVER_STILL:
                return
            arrival = last.arrival  # the port shows NaN nevertheless: an unknown force must not look known
        else:
            self._bad.good(row.device, arrival)
            if last is not None and _frozen(key, values, last.values, key in self._forces):
                arrival = last.arrival
        self._reports[key] = _Report(arrival, values)
        if row.read is not None:
            self._delay.add(self._time - from_utime(stamp))

    def _take_image(self, camera: str, key: str, image: Any) -> None:
        utime, data, now = image.header.utime, bytes(image.data), self.clock()
        if not self._is_news(key, utime):
            return
        kept, last = self._images[camera], self._reports.get(key)
        if kept and kept[-1].data == data:  # the camera is frozen
            return
        least = self._delay.least()
        if least is None:  # the robot's clock is not known
            return
        time = self._capture_time.setdefault(utime, from_utime(utime) + least)
        while len(self._capture_time) > 64:
            self._capture_time.pop(next(iter(self._capture_time)))
        late = self._time - time
        if late > self._config.image_age:  # too old to be shown to any block
            words = f"{camera}: images come {late:.1f} s after they were taken, want {self._config.image_age:g} s"
            self._bad.bad(f"{camera} late", words, now)
            return
        self._bad.good(f"{camera} late", now)
        if time > self._time + EARLY:
            raise WrongMessage(f"an image stamped {time - self._time:.1f} s ahead of the robot's other reports")
        before = -math.inf if last is None else last.arrival
        self._reports[key] = _Report(now, None)
        kept.append(_Image(utime, image.header.seq, data, time, before))

    def _wait(self) -> None:
        if not self.bus.pump():
            self._idle()

    # ------------------------------------------------------------ the start
    def start(self) -> Snapshot:
        """Waits for the first report of every device.

        Raises OperationFailed if the robot does not answer or another program is there, ConfigError if it is not the
        robot of this program.
        """
        needed = [row.key for row in self._report_rows] + [STATE]
        alone = self.bus.claim(CONTROLLER)

        def ready() -> bool:
            if self.bus.others(ROBOT) > 1:
                raise OperationFailed(f"{self.bus.others(ROBOT)} robots are on {self._config.lcm_url}: want one")
            return alone() and (all(key in self._reports for key in needed) or bool(self._bad.words))

        def missing() -> str:
            return ", ".join(self.bus.name(key) for key in needed if key not in self._reports)

        self._until(
            ready,
            self._config.answer_time,
            lambda: (
                f"the robot does not answer: nothing on {missing()} within {self._config.answer_time:g} s"
                + self.bus.excuse()
            ),
            lambda: f"waiting up to {self._config.answer_time:g} s for the robot: nothing yet on {missing()}",
        )
        for words in self._bad.words.values():
            raise ConfigError(f"not the robot of this program: {words}")
        state = self._reports[STATE].values
        if state.get("protocol") != PROTOCOL:
            spoken = state.get("protocol", math.nan)
            raise ConfigError(f"the robot speaks version {spoken:g} of the protocol, this program {PROTOCOL}")
        for device in GROUPS:
            count = self.groups.size(device)
            if state.get(device) != count:
                raise ConfigError(f"the robot's {device} has {state.get(device, math.nan):g} joints, want {count}")
        if self._config.lockstep:
            self._start_lockstep()
        elif self._lockstep.tick is not None:
            raise ConfigError("the robot runs in lock-step, this program does not: hardware.lockstep")
        return self._look()

    def _until(
        self,
        done: Callable[[], Any],
        seconds: float,
        failure: Callable[[], str],
        waiting: Callable[[], str] | None = None,
    ) -> None:
        """Raises OperationFailed with `failure` after some seconds. waiting: tells the user, and may be stopped."""
        begin, told = wall.monotonic(), False
        while not done():
            passed = wall.monotonic() - begin
            if passed > seconds:
                raise OperationFailed(failure())
            if waiting is not None and self.stop():
                raise OperationFailed("stopped by the operator before the robot had answered")
            if waiting is not None and not told and passed > NOTICE:
                told = True
                self._notice(waiting())
            self._wait()

    def _start_lockstep(self) -> None:
        self._until(
            lambda: self._lockstep.tick is not None,
            self._config.answer_time,
            lambda: "the robot does not run in lock-step, this program does",
            lambda: f"waiting for lock-step: nothing yet on {self.bus.name(SYNC[ROBOT])}",
        )
        self._lockstep.begin(self.bus.sent)
        self._send_sync(-1)
        self._await_tick(0)

    def _await_tick(self, tick: int) -> None:
        """Lock-step: until all that the robot sent for this tick is here."""
        self._until(
            lambda: self._lockstep.complete(tick),
            LOCKSTEP_TIME,
            lambda: (
                f"lock-step: the robot's tick {tick} did not arrive within {LOCKSTEP_TIME:g} s; "
                + self._lockstep.progress()
            ),
        )

    def _send_sync(self, tick: int) -> None:
        self.bus.say(SYNC[CONTROLLER], 0, self._lockstep.announcement(tick, self.bus.sent))

    # ------------------------------------------------------------ every tick
    def update(self, time: float) -> Snapshot:
        """What is known to the tick that begins at `time`."""
        self._time = time
        if self._config.lockstep:
            self._await_tick(round(time / TICK))
        while self.bus.pump():
            pass
        return self._look()

    def _look(self) -> Snapshot:
        now, time = self.clock(), self._time
        self._delay.close(time)
        values: Values = {name: np.zeros(self._sizes[name]) for name in self._silent}
        for row in self._report_rows:
            report = self._reports[row.key]
            values |= report.values
            if row.key in self._forces and not now - report.arrival <= self._config.report_age:
                port = self._forces[row.key]
                values[port] = np.full_like(report.values[port], np.nan)
        if round(time / TICK) % HEALTH_TICKS == 0:
            self._health = self._diagnose(now, time)
        self._time = time + TICK
        return Snapshot(values, self._shown(time), self._health)

    def _diagnose(self, now: float, time: float) -> Health:
        ages = [now - self._reports[row.key].arrival for row in self._report_rows]
        for camera, row in IMAGES.items():
            since = self._requests.since.get(camera)
            last = self._reports[row.key].arrival if row.key in self._reports else -math.inf
            ages.append(0.0 if since is None else now - max(since, last))
        ages.append(now - self._reports[STATE].arrival)
        state = self._reports[STATE].values
        faults = [name for name, value in state.items() if name not in ("protocol", "estop", *GROUPS) and value]
        faults += self._bad.faults(now)
        faults += ["another program commands this robot"] if self.bus.others(CONTROLLER) else []
        faults += ["two robots on the bus"] if self.bus.others(ROBOT) > 1 else []
        return Health(
            time=time,
            devices=self._devices,
            ages=np.array(ages),
            faults=tuple(faults),
            estop=bool(state.get("estop", 1)),
        )

    def _shown(self, time: float) -> dict[str, _Image | None]:
        """The newest image of each camera; of the head's eyes the newest that both have."""
        shown = {camera: kept[-1] if kept else None for camera, kept in self._images.items()}
        both = {i.utime for i in self._images[HEAD[0]]} & {i.utime for i in self._images[HEAD[1]]}
        if both:
            newest = max(both)
            shown |= {eye: next(i for i in self._images[eye] if i.utime == newest) for eye in HEAD}
        elif all(shown[eye] for eye in HEAD):
            shown |= dict.fromkeys(HEAD)
        return {c: i if i is not None and time - i.time <= self._config.image_age else None for c, i in shown.items()}

    def look(self, camera: str, image: _Image | None, time: float) -> CameraFrame:
        """What a reader of the camera's port gets; the camera is requested from then on."""
        self._requests.look(camera, time)
        return CameraFrame(camera=camera) if image is None else self._decoded(camera, image)

    def _decoded(self, camera: str, image: _Image) -> CameraFrame:
        """The image, or one without pixels if it cannot be decoded: then it was no news."""
        if image.frame is None:
            with profiling.work(profiling.IMAGES):
                image.frame = self._decode(camera, image)
        return image.frame

    def _decode(self, camera: str, image: _Image) -> CameraFrame:
        try:
            pixels = decode_image(image.data)
            if pixels.shape[1::-1] != tuple(self._config.image_size):
                raise ValueError("an image of another size than its header says")
        except ValueError as error:
            self._bad.bad(camera, f"{camera}: {error}", self.clock())
            kept, report = self._images[camera], self._reports[IMAGES[camera].key]
            if kept and kept[-1].utime == image.utime:
                report.arrival = image.before
            for later in kept:
                later.before = image.before if later.utime > image.utime else later.before
            sound = [other for other in kept if other.utime != image.utime]
            kept.clear()
            kept.extend(sound)
            return CameraFrame(camera=camera)
        self._bad.good(camera, self.clock())
        return CameraFrame(camera, image.time, image.sequence, pixels, image.data)

    def send(self, time: float, commands: Values) -> None:
        """Publishes the commands of the tick that began at `time`."""
        stamp = to_utime(time)
        for row in self._command_rows:
            self.bus.send(row.key, row.encode(stamp, commands))
        changed = self._requests.update(time, self.clock())
        if changed or round(time / TICK) % round(self._config.request_period / TICK) == 0:
            self.bus.say(REQUEST, stamp, self._requests.message())
        if self._new_mode is not None:
            self.bus.say(MODE, stamp, dict([self._new_mode]))
            self._new_mode = None
        self.bus.announce(CONTROLLER)
        if self._config.lockstep:
            self._answered = round(time / TICK)
            self._send_sync(self._answered)

    def pass_time(self, seconds: float) -> None:
        """Listens while there is nothing else to do, since a channel has room for one message; decodes images ahead."""
        wall.sleep(min(seconds, 2e-3))
        self.bus.pump()
        fresh = (c for c in self._requests.since if self._images[c] and self._images[c][-1].frame is None)
        if seconds > DECODING and (camera := next(fresh, None)):
            self._decoded(camera, self._images[camera][-1])

    def tell(self, mode: str, activation: int) -> None:
        """Tells the robot's side what the program is doing, with the next commands."""
        if (mode, activation) != self._sent_mode:
            self._sent_mode = self._new_mode = (mode, activation)

    def leave(self) -> None:
        """The end of a run: says what was dropped. In lock-step the robot need not wait any longer; it is told when
        it has answered the last tick, since a channel has room for one message."""
        if self.dropped:
            self._notice(f"bad messages of the robot were dropped: {listed(self.dropped)}")
        if self._config.lockstep:
            if self._lockstep.tick == self._answered:
                self._await_tick(self._answered + 1)
            self._send_sync(-2)

    @property
    def dropped(self) -> Mapping[str, int]:
        """How many messages of each device were dropped so far."""
        return self._bad.counts


def _sound(values: Values | Mapping[str, float] | None) -> bool:
    """All numbers are finite, and such as something measured can be."""
    return values is None or all(bool(np.all(np.abs(value) <= ABSURD)) for value in values.values())


def _frozen(key: str, values: Values | None, last: Values | None, noisy: bool) -> bool:
    """The same values again, from a sensor with noise or a device that reports a speed."""
    row = CHANNELS[key]
    if (
        values is None
        or last is None
        or row.read is None
        or any(not np.array_equal(values[port], last[port]) for port in values)
    ):
        return False
    speeds = [v[3:] if port == "base.odometry" else v for port, v in values.items() if port in SPEEDS]
    return noisy or any(np.max(np.abs(speed)) > MOVING for speed in speeds)


class LcmReceiver(PythonSystem):
    """All output ports of the contract, from a RobotLink."""

    def __init__(self, link: RobotLink):
        super().__init__()
        self.set_name("lcm_receiver")
        self._link = link
        self._snapshot = self.DeclareAbstractState(Value(_before(link.groups)))
        self.DeclareInitializationUnrestrictedUpdateEvent(lambda context, state: self._keep(state, link.start()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            TICK, TICK - AHEAD, lambda context, state: self._keep(state, link.update(context.get_time() + AHEAD))
        )
        when = {self.abstract_state_ticket(self._snapshot)}
        sizes = vectors(link.groups)
        for spec in CONTRACT:
            if spec.direction == "in":
                continue
            if not isinstance(spec.kind, type):
                calc: Callable[..., None] = functools.partial(self._calc_vector, spec.name)
                self.DeclareVectorOutputPort(spec.name, sizes[spec.name], calc, when)
            else:
                calc = self._calc_health if spec.kind is Health else self._calc_image(spec.name.partition(".")[0])
                self.DeclareAbstractOutputPort(spec.name, functools.partial(Value, spec.kind()), calc, when)

    def _keep(self, state: State, snapshot: Snapshot) -> None:
        state.get_mutable_abstract_state().get_mutable_value(int(self._snapshot)).set_value(snapshot)

    def _shown(self, context: Context) -> Snapshot:
        return context.get_abstract_state(int(self._snapshot)).get_value()

    def _calc_vector(self, name: str, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._shown(context).values[name])

    def _calc_health(self, context: Context, output: Value) -> None:
        output.set_value(self._shown(context).health)

    def _calc_image(self, camera: str) -> Callable[[Context, Value], None]:
        def calc(context: Context, output: Value) -> None:
            output.set_value(self._link.look(camera, self._shown(context).images[camera], context.get_time()))

        return calc


class LcmSender(PythonSystem):
    """All input ports of the contract, to a RobotLink at the end of every tick's work."""

    def __init__(self, link: RobotLink):
        super().__init__()
        self.set_name("lcm_sender")
        self._link = link
        sizes = vectors(link.groups, "in")
        self._commands = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
        self.DeclarePeriodicPublishEvent(TICK, 3 * SLOT, self._publish)

    def _publish(self, context: Context) -> None:
        values = {name: port.Eval(context) for name, port in self._commands.items()}
        self._link.send(context.get_time() - 3 * SLOT, values)


def make_hardware_station(link: RobotLink, robot: Robot | None = None) -> Diagram:
    """The station as a Diagram named `hardware`. robot: at the other end; needed for one without force sensors."""
    computed = functools.partial(add_torque_wrenches, robot)
    return station_of("hardware", LcmSender(link), LcmReceiver(link), link.groups, computed)
