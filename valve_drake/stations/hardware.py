"""The hardware station: the contract's ports, made of LCM messages from and to a robot (lcm_channels.py has the table).

`RobotLink` keeps what the robot reported last, as a socket does, outside the Context; two blocks stand between it and
the ports. `lcm_receiver` reads it in slot 3, just before the next tick; `lcm_sender` publishes the commands of a tick
at its end. A station is alive when it is initialised: it waits there for every device's first report.

A report counts as news only if its stamp is later than that of the last one, and, for what is never quite still (wrist
sensors, cameras) or says that it moves (base, arms), only if it says something else. So a duplicate, a message
overtaken on the way, and a frozen sensor are all silence, and silence is what `health` tells: ages by the receiver's
clock. A report that is not finite is no news either, and a fault. A wrist sensor that is broken or has fallen silent
reads NaN: its last word is not the present force.

Time: images are stamped by the robot's clock, and are placed on this side's by the least delay that the joints' reports
had of late.
"""

import collections
import dataclasses as dc
import functools
import math
import time as wall
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, Diagram, LeafSystem, State

from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.messages import SIDES, CameraFrame, Health
from valve_drake.ports import SLOT, TICK, profile
from valve_drake.stations.camera_rig import decode_image
from valve_drake.stations.contract import CAMERAS, CONTRACT, station_of
from valve_drake.stations.lcm_channels import (
    CHANNELS,
    COMMANDS,
    CONTROLLER,
    DEVICES,
    IMAGES,
    JOINTS,
    LOCKSTEP_TIME,
    MODE,
    PROTOCOL,
    REPORTS,
    REQUEST,
    ROBOT,
    STATE,
    SYNC,
    Bus,
    Values,
    WrongMessage,
    from_utime,
    read_image,
    to_utime,
)

NEVER_STILL = tuple(row.key for row in REPORTS if row.device.endswith("wrist_sensor"))
SPEEDS = ("base.odometry", *(f"{side}_arm.velocity_measured" for side in SIDES))  # ports that tell of motion
MOVING = 0.005  # [rad/s, m/s]
HEAD = ("head_left", "head_right")
LOOKED_AT = 0.75  # after the last look at a camera it is requested for this long: a search looks twice a second [s]
DELAYS = 2.0  # the least delay is taken over this long [s]
RESTART = 0.5  # a stamp that goes back by more is a driver begun anew; it is reported for as long [s]
DECODING = 5e-3  # that an image takes, with room [s]
AHEAD = SLOT / 2  # the station is read this long before a tick, when the last one's slot 3 is done [s of the diagram]
HEALTH_TICKS = 4  # health is reported every 1/32 s


@dc.dataclass
class _Report:
    """The last news of one device."""

    stamp: int  # [us] of the robot's clock
    arrival: float  # [s] of the receiver's clock
    values: Any


@dc.dataclass
class _Image:
    utime: int
    sequence: int
    data: bytes
    time: float  # of capture, on this side's clock [s]
    frame: CameraFrame | None = None  # once somebody has looked

    def decoded(self, camera: str) -> CameraFrame:
        if self.frame is None:
            with profile("images"):
                self.frame = CameraFrame(camera, self.time, self.sequence, decode_image(self.data), self.data)
        return self.frame


@dc.dataclass(frozen=True)
class Snapshot:
    """What the ports show during one tick."""

    values: Values
    images: dict[str, _Image | None]
    health: Health

    def __deepcopy__(self, memo: dict) -> "Snapshot":
        return self


BEFORE = Snapshot(  # the station was initialised
    {s.name: np.full(s.kind, np.nan) for s in CONTRACT if s.direction == "out" and isinstance(s.kind, int)},
    dict.fromkeys(CAMERAS),
    Health(),
)


class RobotLink:
    """The program's end of the wire.

    idle: called while this side waits for the robot with nothing to do; a robot in the same process steps there.
    """

    def __init__(self, bus: Bus, idle: Callable[[], None] | None = None):
        self.bus = bus
        self._config = bus.config
        self._idle = idle or (lambda: wall.sleep(2e-4))
        self._reports: dict[str, _Report] = {}
        self._films = {camera: collections.deque(maxlen=4) for camera in CAMERAS}
        self._placed: dict[int, float] = {}  # utime of a capture -> time on this side
        self._looked: dict[str, float] = {}  # camera -> when it was looked at last [s of the diagram]
        self._wanted: dict[str, float] = {}  # requested cameras -> since when, receiver's clock
        self._complaints: dict[str, tuple[str, float]] = {}  # device -> what was wrong, and when
        self._delays: collections.deque = collections.deque()  # (time, least delay of a tick)
        self._delay = math.inf  # the least one of this tick's reports
        self._time = 0.0  # of the tick that looks at what arrives now [s of the diagram]
        self._heard = 0  # messages since the start of lock-step
        self._sync = (-2, 0)  # tick, messages
        self._sent_before = 0
        self._answered = -1  # the last tick whose commands were sent
        self._synced = False  # the robot keeps lock-step
        self._health = Health()
        self._told: tuple[str, int] | None = None  # mode and activation
        self._doing: tuple[str, int] | None = None  # the same, not yet sent
        bus.listen(ROBOT, self._hear)

    # ------------------------------------------------------------ the wire
    def clock(self) -> float:
        """The receiver's clock [s]: the wall's, but in lock-step the diagram's."""
        return self._time if self._config.lockstep else wall.monotonic()

    def _hear(self, key: str, message: Any) -> None:
        row = CHANNELS[key]
        if key == SYNC[ROBOT]:
            self._hear_sync(message)
            return
        self._heard += 1
        if message is None:
            self._complain(row.device, f"{self.bus.name(key)} does not carry {row.kind.__name__}")
            return
        try:
            if row.read is not None:
                self._take(key, getattr(message, row.stamp), row.read(message))
            elif key == STATE:
                self._take(key, message.timestamp, dict(zip(message.coord, message.val)))
            else:
                self._take_image(row.device, key, read_image(message))
        except WrongMessage as error:
            self._complain(row.device, f"{row.device}: {error}")

    def _hear_sync(self, message: Any) -> None:
        if message is None or message.dim != 2:
            return
        self._synced = True
        self._sync = (int(message.val[0]), int(message.val[1]))
        if self._sync[0] < 0:  # all before the start does not count
            self._heard = 0

    def _take(self, key: str, stamp: int, values: Any) -> bool:
        """Keeps a report if it is news."""
        last = self._reports.get(key)
        if last is not None and stamp <= last.stamp:
            if last.stamp - stamp < 1e6 * RESTART:
                return False  # a duplicate, or overtaken
            self._complain(CHANNELS[key].device, f"{CHANNELS[key].device} restarted")
            self._delays.clear()
        arrival = self.clock()
        if not _finite(values):
            self._complain(CHANNELS[key].device, f"{CHANNELS[key].device}: not finite")
            if last is None or key not in NEVER_STILL:
                return False
            arrival = last.arrival  # shown all the same: what is not known must not look known
        elif last is not None and _frozen(key, values, last.values):
            arrival = last.arrival
        self._reports[key] = _Report(stamp, arrival, values)
        if CHANNELS[key].read is not None:
            self._delay = min(self._delay, self._time - from_utime(stamp))
        return True

    def _take_image(self, camera: str, key: str, image: Any) -> None:
        film, data, last = self._films[camera], bytes(image.data), self._reports.get(key)
        if not self._take(key, image.header.utime, None):
            return
        if film and film[-1].data == data:  # a frozen camera has nothing to say
            self._reports[key].arrival = last.arrival
            return
        utime = image.header.utime
        if utime not in self._placed:
            self._placed[utime] = from_utime(utime) + min((d for _, d in self._delays), default=0.0)
        film.append(_Image(utime, image.header.seq, data, self._placed[utime]))
        while len(self._placed) > 64:
            self._placed.pop(next(iter(self._placed)))

    def _complain(self, device: str, words: str) -> None:
        self._complaints[device] = (words, self.clock())

    def _wait(self) -> None:
        if not self.bus.pump():
            self._idle()

    # ------------------------------------------------------------ the start
    def start(self) -> Snapshot:
        """Waits for the first report of every device.

        Raises OperationFailed if the robot does not answer, ConfigError if it is not the robot of this program.
        """
        needed = [row.key for row in REPORTS] + [STATE]
        self._until(
            lambda: all(key in self._reports for key in needed) or self._complaints,
            self._config.answer_time,
            lambda: (
                "the robot does not answer: nothing on "
                + ", ".join(self.bus.name(key) for key in needed if key not in self._reports)
                + f" within {self._config.answer_time:g} s"
            ),
        )
        for words, _ in self._complaints.values():
            raise ConfigError(f"not the robot of this program: {words}")
        state = self._reports[STATE].values
        if state.get("protocol") != PROTOCOL:
            spoken = state.get("protocol", math.nan)
            raise ConfigError(f"the robot speaks version {spoken:g} of the protocol, this program {PROTOCOL}")
        for device, count in JOINTS.items():
            if state.get(device) != count:
                raise ConfigError(f"the robot's {device} has {state.get(device, math.nan):g} joints, want {count}")
        if self._config.lockstep:
            self._start_lockstep()
        elif self._synced:
            raise ConfigError("the robot runs in lock-step, this program does not: hardware.lockstep")
        return self._look()

    def _until(self, done: Callable[[], Any], seconds: float, failure: Callable[[], str]) -> None:
        end = wall.monotonic() + seconds
        while not done():
            if wall.monotonic() > end:
                raise OperationFailed(failure())
            self._wait()

    def _start_lockstep(self) -> None:
        self._until(
            lambda: self._synced,
            self._config.answer_time,
            lambda: "the robot does not run in lock-step, this program does",
        )
        self._sent_before = self.bus.sent
        self._send_sync(-1)
        self._await_tick(0)

    def _await_tick(self, tick: int) -> None:
        """Lock-step: until all that the robot sent for this tick is here."""
        self._until(
            lambda: self._sync == (tick, self._heard),
            LOCKSTEP_TIME,
            lambda: (
                f"lock-step: the robot's tick {tick} did not arrive within {LOCKSTEP_TIME:g} s; "
                f"at tick {self._sync[0]} with {self._heard} of {self._sync[1]} messages"
            ),
        )

    def _send_sync(self, tick: int) -> None:
        self.bus.say(SYNC[CONTROLLER], 0, {"tick": tick, "messages": self.bus.sent - self._sent_before})

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
        if math.isfinite(self._delay):
            self._delays.append((time, self._delay))
        while self._delays and time - self._delays[0][0] > DELAYS:
            self._delays.popleft()
        values: Values = {}
        for row in REPORTS:
            report = self._reports[row.key]
            silent = row.key in NEVER_STILL and not now - report.arrival <= self._config.report_age
            values |= {port: np.full_like(v, np.nan) for port, v in report.values.items()} if silent else report.values
        if round(time / TICK) % HEALTH_TICKS == 0:
            self._health = self._diagnose(now, time)
        self._time, self._delay = self._time + TICK, math.inf
        return Snapshot(values, self._shown(time), self._health)

    def _diagnose(self, now: float, time: float) -> Health:
        ages = [now - self._reports[row.key].arrival for row in REPORTS]
        for camera, row in IMAGES.items():
            since = self._wanted.get(camera)
            last = self._reports[row.key].arrival if row.key in self._reports else -math.inf
            ages.append(0.0 if since is None else now - max(since, last))
        ages.append(now - self._reports[STATE].arrival)
        state = self._reports[STATE].values
        faults = [name for name, value in state.items() if name not in ("protocol", "estop", *JOINTS) and value]
        faults += [words for words, when in self._complaints.values() if now - when <= RESTART]
        return Health(
            time=time, devices=DEVICES, ages=np.array(ages), faults=tuple(faults), estop=bool(state.get("estop", 1))
        )

    def _shown(self, time: float) -> dict[str, _Image | None]:
        """The newest image of each camera; of the head's eyes the newest that both have."""
        shown = {camera: film[-1] if film else None for camera, film in self._films.items()}
        both = {i.utime for i in self._films[HEAD[0]]} & {i.utime for i in self._films[HEAD[1]]}
        if both:
            newest = max(both)
            shown |= {eye: next(i for i in self._films[eye] if i.utime == newest) for eye in HEAD}
        elif all(shown[eye] for eye in HEAD):
            shown |= dict.fromkeys(HEAD)
        return {c: i if i is not None and time - i.time <= self._config.image_age else None for c, i in shown.items()}

    def look(self, camera: str, image: _Image | None, time: float) -> CameraFrame:
        """What a reader of the camera's port gets; the camera is requested from then on."""
        self._looked[camera] = time
        return CameraFrame(camera=camera) if image is None else image.decoded(camera)

    def send(self, time: float, commands: Values) -> None:
        """Publishes the commands of the tick that began at `time`."""
        stamp = to_utime(time)
        for row in COMMANDS:
            self.bus.send(row.key, row.encode(stamp, commands))
        wanted = {camera for camera, looked in self._looked.items() if time - looked <= LOOKED_AT}
        if wanted != set(self._wanted) or round(time / TICK) % round(self._config.request_period / TICK) == 0:
            self._wanted = {camera: self._wanted.get(camera, self.clock()) for camera in wanted}
            self.bus.say(REQUEST, stamp, {camera: camera in wanted for camera in CAMERAS})
        if self._doing is not None:
            self.bus.say(MODE, stamp, dict([self._doing]))
            self._doing = None
        if self._config.lockstep:
            self._answered = round(time / TICK)
            self._send_sync(self._answered)

    def pass_time(self, seconds: float) -> None:
        """Listens while there is nothing else to do, since a channel has room for one message; decodes images ahead."""
        wall.sleep(min(seconds, 2e-3))
        self.bus.pump()
        fresh = (c for c in self._wanted if self._films[c] and self._films[c][-1].frame is None)
        if seconds > DECODING and (camera := next(fresh, None)):
            self._films[camera][-1].decoded(camera)

    def tell(self, mode: str, activation: int) -> None:
        """Tells the robot's side what the program is doing, with the next commands."""
        if (mode, activation) != self._told:
            self._told = self._doing = (mode, activation)

    def leave(self) -> None:
        """Lock-step: the robot need not wait any longer. It is told when it has answered the last tick: a channel has
        room for one message."""
        if self._config.lockstep:
            if self._sync[0] == self._answered:
                self._await_tick(self._answered + 1)
            self._send_sync(-2)


def _finite(values: Values | None) -> bool:
    return values is None or all(np.isfinite(value).all() for value in values.values())


def _frozen(key: str, values: Values | None, last: Values | None) -> bool:
    """Says what it said last, though it is never still or says that it moves."""
    row = CHANNELS[key]
    if values is None or row.read is None or any(not np.array_equal(values[port], last[port]) for port in values):
        return False
    speeds = [v[3:] if port == "base.odometry" else v for port, v in values.items() if port in SPEEDS]
    return key in NEVER_STILL or any(np.max(np.abs(speed)) > MOVING for speed in speeds)


class LcmReceiver(LeafSystem):
    """All output ports of the contract, from a RobotLink."""

    def __init__(self, link: RobotLink):
        super().__init__()
        self.set_name("lcm_receiver")
        self._link = link
        self._snapshot = self.DeclareAbstractState(Value(BEFORE))
        self.DeclareInitializationUnrestrictedUpdateEvent(lambda context, state: self._keep(state, link.start()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            TICK, TICK - AHEAD, lambda context, state: self._keep(state, link.update(context.get_time() + AHEAD))
        )
        when = {self.abstract_state_ticket(self._snapshot)}
        for spec in CONTRACT:
            if spec.direction == "in":
                continue
            if isinstance(spec.kind, int):
                calc = functools.partial(self._calc_vector, spec.name)
                self.DeclareVectorOutputPort(spec.name, spec.kind, calc, when)
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


class LcmSender(LeafSystem):
    """All input ports of the contract, to a RobotLink at the end of every tick's work."""

    def __init__(self, link: RobotLink):
        super().__init__()
        self.set_name("lcm_sender")
        self._link = link
        self._commands = {s.name: self.DeclareVectorInputPort(s.name, s.kind) for s in CONTRACT if s.direction == "in"}
        self.DeclarePeriodicPublishEvent(TICK, 3 * SLOT, self._publish)

    def _publish(self, context: Context) -> None:
        values = {name: port.Eval(context) for name, port in self._commands.items()}
        self._link.send(context.get_time() - 3 * SLOT, values)


def make_hardware_station(link: RobotLink) -> Diagram:
    """The station as a Diagram named `hardware`."""
    return station_of("hardware", inputs=LcmSender(link), outputs=LcmReceiver(link))
