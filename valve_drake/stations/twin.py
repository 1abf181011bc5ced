"""The twin: a station, simulated, as the robot at the other end of the wire, with a robot's own guard and its faults.

What a robot's own side does, whatever the program asks:

- commands older than `hardware.command_age`: the base stops, joints hold where they were measured, fingers stay; with
  new commands the joints go to them slowly;
- a command that is not finite or absurd, or whose stamp is not later than the last one's, counts as none;
- no joint is faster than the robot's own limit, however far ahead its command is;
- the commands of two programs at once count as none;
- the emergency stop stops base and joints and leaves the fingers to their commands, so that a hand can be opened.

All but the stop are reported as faults, the stop as such. The twin's time is its own: paced by the wall's clock, or in
lock-step with the program.
"""

import bisect
import contextlib
import dataclasses as dc
import math
import os
import time as wall
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from valve_drake.messages import CAMERAS, CameraFrame
from valve_drake.motion import slew
from valve_drake.ports import SLOT, TICK
from valve_drake.processor import YIELDING, hurries
from valve_drake.robot.drive import whole
from valve_drake.robot.groups import GROUPS
from valve_drake.stations.bus import BadMessage, Bus
from valve_drake.stations.camera_rate import SECOND, CameraRate
from valve_drake.stations.camera_rig import Capture
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.contract import CONTRACT, MATE
from valve_drake.stations.faults import Faults, Wire
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
    HardwareConfig,
    Values,
    WrongMessage,
    check_sizes,
    image_message,
    read_mode,
    read_request,
    signal,
    to_utime,
)
from valve_drake.stations.reports import BadMessages, Lockstep, Stamps
from valve_drake.stations.simulation_config import CameraConfig

VECTORS = tuple(spec.name for spec in CONTRACT if spec.direction == "out" and not isinstance(spec.kind, type))
FAULT_TIME = 0.5  # a refused command is reported as a fault for this long [s]
REQUEST_AGE = 0.5  # cameras stop when the last request for them is older [s]
FAR = 0.5  # a joint command farther from the measured position is refused [rad]
FAST = (2.0, 2.0, 3.0)  # a base twist (forward, sideways, yaw rate) that is faster is refused [m/s, rad/s]
GRIP = (0.2, 200.0)  # a larger opening or force is refused [m, N]
FASTER = 1.25  # the robot's own limit on its joints' speed, as a multiple of what its description grants the program
BEHIND = 0.1  # a joint whose limited motion is farther behind its command is reported [rad]
BACK = 0.3  # speed of a joint that was stopped, back to its commands [rad/s]
GONE = 3.0  # paced: a program that was silent for this long counts as gone; raise it for a slow one [s]
IDLE = 0.05  # lock-step: time between two reports before the start [s, wall clock]
PATIENCE = {"cameras": 0.1, "controller": math.inf}  # of what does not come every tick (reports.py) [s]
NAMED = 0.8  # a camera without images is named at this share of the age at which the program would call it dead
OVERDUE = 0.2  # an image that is under way for longer needs help [s, wall]
STARTING = 3.0  # the user is told if the first images take longer than this [s, wall clock]


class LiveImages(CameraWorkers):
    """Images made when they are captured, if somebody wants them, and fetched when they are ready; nobody waits."""

    def __init__(self, *rig: Any) -> None:
        super().__init__(*rig)
        self.wanted: frozenset[str] = frozenset()
        self._shown_at: dict[str, float] = {}  # last image, or since when it is wanted [s, wall]
        self.period: Callable[[str], float] = lambda camera: 0.0  # between two images [s]; less: as the camera captures
        self._unmade = set(CAMERAS)  # cameras whose first image, which is made unasked, is not there yet
        self._begun = dict.fromkeys(CAMERAS, -math.inf)  # when the last image was captured [s, wall]
        self._took: dict[str, list[float]] = {camera: [] for camera in CAMERAS}
        self._loops_first = False
        self._hurried: set[int] = set()  # processes

    def settle(self, stop: Callable[[], bool], notice: Callable[[str], None]) -> None:
        """Waits for the first images, which take a renderer seconds, or until `stop`. notice: tells the user."""
        begin, told = wall.monotonic(), False
        while self._unmade and not stop():
            self.ready()
            wall.sleep(0.01)
            if not told and wall.monotonic() - begin > STARTING:
                told = True
                missing = ", ".join(camera for camera in CAMERAS if camera in self._unmade)
                notice(f"the twin waits for its renderers: no image yet of {missing}")

    def want(self, cameras: Collection[str]) -> None:
        """What is asked for from now on."""
        self._shown_at |= dict.fromkeys(set(cameras) - self.wanted, wall.monotonic())
        self.wanted = frozenset(cameras)

    def captured(self, name: str, capture: Capture) -> None:
        # A camera that cannot keep up drops images; the two of a pair drop the same ones.
        mate = MATE[name]
        free = not self._asked[name] | self._asked[mate]
        now = wall.monotonic()
        due = now - max(self._begun[name], self._begun[mate]) > self.period(name) - 2 * TICK
        if capture.sequence == 0 or (name in self.wanted and (capture.sequence in self._asked[mate] or (free and due))):
            self._begun[name] = now
            self._ask(name, capture)

    def ready(self) -> list[CameraFrame]:
        """Those that came since the last call."""
        self._receive_all()
        frames = list(self._made.values())
        now = wall.monotonic()
        for frame in frames:
            del self._asked[frame.camera][frame.sequence]
            self._took[frame.camera].append(now - self._begun[frame.camera])
            self._shown_at[frame.camera] = now
            if frame.sequence == 0:
                self._unmade.discard(frame.camera)
        self._made.clear()
        if self._loops_first:
            self._hurry(now)
        return [frame for frame in frames if frame.sequence > 0]

    def yield_to(self, loops_first: bool) -> None:
        """Gives the renderers their share of the processor: a late image is better than a late tick of either side.

        loops_first: both sides' loops go before all others anyway; then the renderers are as good as other programs,
        and one that does not get its share for OVERDUE goes before those.
        """
        self._loops_first = loops_first
        for worker in self._workers:
            with contextlib.suppress(PermissionError):  # to be no longer as nice as it was
                os.setpriority(os.PRIO_PROCESS, worker.pid, 0 if loops_first else YIELDING)

    def _hurry(self, now: float) -> None:
        late = {camera for camera in CAMERAS if self._asked[camera] and now - self._begun[camera] > OVERDUE}
        hurried = {self._worker(camera).pid for camera in late}
        for process in hurried ^ self._hurried:
            hurries(process, process in hurried)
        self._hurried = hurried

    def took(self) -> dict[str, float]:
        """By camera, the mean time that an image took since the last call, or so far if none came [s, wall]."""
        now, took = wall.monotonic(), {}
        for camera, times in self._took.items():
            if times:
                took[camera] = sum(times) / len(times)
            elif self._asked[camera]:
                took[camera] = now - self._begun[camera]
            times.clear()
        return took

    def longest_silence(self) -> tuple[float, str]:
        """For how long a camera that is wanted has shown nothing [s, wall], and which."""
        since, camera = min(((self._shown_at[camera], camera) for camera in self.wanted), default=(math.inf, ""))
        return wall.monotonic() - since, camera


class Guard:
    """The robot's own check of commands; it decides what the joints are sent."""

    def __init__(self, start: Mapping[str, np.ndarray], age: float, speed: Mapping[str, np.ndarray]):
        """start: port -> vector: what holds until the first command. age: of commands [s]. speed: of a group's joints,
        at most [1/s]."""
        self._speed = speed
        self._rows = [row for row in COMMANDS if row.device != "base" or len(start["base.twist_command"])]
        self._commanded = dict(start)
        self._targets = dict(start)  # what the joints were told last
        self._behind: set[str] = set()  # channels whose command is farther ahead than the joints' speed allows
        self._arrived: dict[str, float] = {}
        self._stopped: set[str] = set()  # channels whose joints hold, or are on their way back to their commands
        self._refused: dict[str, tuple[str, float]] = {}
        self._age = age

    def take(self, key: str, values: Values, measured: Values, time: float) -> None:
        """A command that has arrived."""
        if problem := _problem(CHANNELS[key].device, values, measured):
            self.refuse(key, problem, time)
            return
        self._commanded |= values
        self._arrived[key] = time

    def refuse(self, key: str, problem: str, time: float) -> None:
        """Reports a command that is ignored."""
        self._refused[key] = (problem, time)

    def _late(self, key: str, time: float) -> bool:
        return time - self._arrived.get(key, time) > self._age

    def targets(self, measured: Values, estop: bool, time: float) -> Values:
        """What the joints are told now: contract's input ports -> vectors. To be called once a tick.

        A joint that was stopped goes slowly to where it is commanded afterwards, however far that is by then.
        """
        targets = dict(self._commanded)
        for row in self._rows:
            if row.device.endswith("gripper"):
                continue
            stop = estop or self._late(row.key, time)
            if row.device == "base":
                twist = self._commanded["base.twist_command"]
                targets["base.twist_command"] = np.zeros_like(twist) if stop else twist
                continue
            port = f"{row.device}.position_"
            goal, stopped = self._commanded[port + "command"], row.key in self._stopped
            if stop:
                target = self._targets[port + "command"] if stopped else measured[port + "measured"]
                self._stopped.add(row.key)
            else:
                target = _bounded(self._targets[port + "command"], goal, BACK if stopped else self._speed[row.device])
                if stopped and np.array_equal(target, goal):
                    self._stopped.discard(row.key)
                behind = not stopped and bool(np.any(np.abs(goal - target) > BEHIND))
                (self._behind.add if behind else self._behind.discard)(row.key)
            targets[port + "command"] = target
        self._targets = targets
        return targets

    def faults(self, time: float) -> list[str]:
        """Faults of the commands, one line each."""
        words = [f"{row.key} late" for row in self._rows if self._late(row.key, time)]
        words += [f"{row.key} faster than the joints may move" for row in self._rows if row.key in self._behind]
        return words + [f"{key} refused: {p}" for key, (p, when) in self._refused.items() if time - when <= FAULT_TIME]


def _bounded(value: np.ndarray, goal: np.ndarray, speed: float | np.ndarray) -> np.ndarray:
    """One tick from `value` towards `goal`; a goal within reach is met to the bit."""
    step = np.asarray(speed) * TICK
    return np.where(np.abs(goal - value) <= step, goal, slew(value, goal, step))


def _problem(device: str, values: Values, measured: Values) -> str:
    """Why a command is refused, or ""."""
    if not all(np.isfinite(value).all() for value in values.values()):
        return "not finite"
    if device == "base":
        return "" if np.all(np.abs(whole(values["base.twist_command"])) <= FAST) else "too fast"
    if device in GROUPS:
        off = values[f"{device}.position_command"] - measured[f"{device}.position_measured"]
        far = np.max(np.abs(off), initial=0.0)
        return "" if far <= FAR else f"{far:.2f} rad off the measured position"
    opening, force = (float(value[0]) for value in values.values())
    return "" if -1e-3 <= opening <= GRIP[0] and 0 <= force <= GRIP[1] else "out of range"


class RobotClock:
    """The clock of the twin's stamps: simulated time, and what that has fallen behind the wall's.

    A robot's clock does not stand still while its simulation waits for a processor, and the program places images by
    it: with stamps of simulated time, those of a twin that runs 5 % slow would be a tenth of a second off.
    """

    def __init__(self) -> None:
        self._since, self._behind = [-math.inf], [0.0]  # simulated time, and how far behind from then on [s]

    def fell_behind(self, time: float, total: float) -> None:
        """At `time` it is `total` behind."""
        if total > self._behind[-1]:
            self._since.append(time)
            self._behind.append(total)

    def at(self, time: float) -> float:
        """What the clock showed at a simulated time [s]."""
        return time + self._behind[bisect.bisect_right(self._since, time) - 1]


class Twin:
    """A simulated station behind LCM.

    station: its inputs are the robot's joints, its outputs its sensors. start: what its inputs hold at first.
    speed: of each group's joints, as the program may ask for [1/s]. absent: devices that the robot lacks. images,
    rate: who makes the images of a paced twin, and how many.
    """

    def __init__(
        self,
        station: Diagram,
        start: Mapping[str, np.ndarray],
        speed: Mapping[str, np.ndarray],
        hardware: HardwareConfig,
        camera: CameraConfig,
        faults: Faults,
        *,
        absent: Collection[str] = (),
        images: LiveImages | None = None,
        rate: CameraRate | None = None,
        lcm: DrakeLcm | None = None,
    ):
        self._reports = [row for row in REPORTS if row.device not in absent]
        self.station = station
        self.simulator = Simulator(station)
        self.context = self.simulator.get_mutable_context()
        self.tick = 0
        self.gone = False  # the program has left
        self.faults = faults
        self._hardware = hardware
        self._camera = camera
        self._images = images
        self._rate = rate
        if images is not None and rate is not None:
            images.period = rate.period
        self._clock = RobotClock()
        self._judged: tuple[float, float] | None = None  # when the cameras' rate was, and how far behind it was then
        self._bus = Bus(hardware, lcm)
        newest = hardware.lockstep and not self._bus.lcm.get_lcm_url().startswith("memq")
        self._out = Wire(faults, self._bus.send, newest)
        self._in = Wire(faults, self._obey, newest)
        self._guard = Guard(start, hardware.command_age, {group: FASTER * speed[group] for group in GROUPS})
        self._sizes = {port: len(value) for port, value in start.items()}
        self._stamps = Stamps(quiet=hardware.command_age)
        self._bad = BadMessages(PATIENCE)
        self._requested: tuple[float, set[str]] = (-math.inf, set())
        self._shown = dict.fromkeys(CAMERAS, -1)  # sequence sent last
        self._lockstep = Lockstep()
        self._heard_at = math.inf  # wall time of the last message
        self._started = not hardware.lockstep
        self._idle_at = -math.inf
        self._bus.listen(CONTROLLER, self._hear)
        self._set(start)
        self.simulator.Initialize()
        if images is not None:
            self.simulator.AdvanceTo(SLOT / 2)  # the first captures

    @property
    def time(self) -> float:
        """Of the present tick [s]."""
        return self.tick * TICK

    @property
    def dropped(self) -> Mapping[str, int]:
        """How many bad messages were dropped so far, by what they were for."""
        return self._bad.counts

    def read(self, port: str) -> np.ndarray:
        """What an output port of the station shows now; a CameraFrame of a camera's."""
        return self.station.GetOutputPort(port).Eval(self.context)

    def _set(self, values: Mapping[str, np.ndarray]) -> None:
        for port, value in values.items():
            self.station.GetInputPort(port).FixValue(self.context, value)

    # ------------------------------------------------------------ what it hears
    def _hear(self, key: str, message: Any) -> None:
        device = CHANNELS[key].device
        if isinstance(message, BadMessage):
            self._bad.bad(device, message.words, self.time)
            return
        self._heard_at = wall.monotonic()
        if key != SYNC[CONTROLLER]:
            self._lockstep.count()
            self._in.put(key, message, self.time)
        elif not self._lockstep.hear(message):
            self._bad.bad(device, f"{self._bus.name(key)}: other numbers than tick and messages", self.time)

    def _obey(self, key: str, message: Any) -> None:
        """A message that has come through the wire."""
        row = CHANNELS[key]
        if self.faults.silent(row.device, self.time):
            return
        try:
            if key == REQUEST:
                self._requested = (self.time, read_request(message))
            elif key == MODE:
                self.faults.enter(read_mode(message), self.time)
            elif row.read is not None:
                self._command(key, check_sizes(row.read(message), self._sizes), getattr(message, row.stamp))
            self._bad.good(row.device, self.time)
        except WrongMessage as error:
            self._bad.bad(row.device, f"{self._bus.name(key)}: {error}", self.time)

    def _command(self, key: str, values: Values, stamp: int) -> None:
        if self._bus.others(CONTROLLER) > 1:
            self._guard.refuse(key, "two programs", self.time)
            return
        verdict = self._stamps.judge(key, stamp, self.time)
        if verdict == Stamps.STRANGE:
            self._guard.refuse(key, "a stamp of another clock", self.time)
        elif verdict != Stamps.OLD:
            self._guard.take(key, values, self._measured, self.time)

    # ------------------------------------------------------------ one tick
    def report(self) -> None:
        """Publishes what the sensors show now."""
        time, values = self.time, self._sense()
        for row in self._reports:
            if self.faults.silent(row.device, time):
                continue
            said = self.faults.frozen(row.key, time, values)
            if self.faults.acts("nan", row.device, time):
                said = {port: np.full_like(value, np.nan) for port, value in said.items()}
            self._say(row.key, row.encode(self._stamp(row.device, time), said))
        for frame in self._frames(time):
            self._put_image(frame, time)
        if self.tick % round(self._hardware.robot_period / TICK) == 0 and not self.faults.silent("robot", time):
            state: dict[str, float] = {
                "protocol": PROTOCOL,
                **{group: float(len(self._measured[f"{group}.position_measured"])) for group in GROUPS},
                "estop": self.faults.acts("estop", "robot", time),
            }
            words = [*self._guard.faults(time), *self._bad.faults(time), *self._too_slow()]
            state |= dict.fromkeys(words, 1.0)
            if self._bus.others(ROBOT):
                state["two robots on the bus"] = 1.0
            message = signal(state)
            message.timestamp = self._stamp("robot", time)
            self._say(STATE, message)
        self._out.pass_on(time)
        self._bus.announce(ROBOT)
        if self._started:
            self.simulator.AdvanceTo(time + 3 * SLOT)  # what does not depend on the answer

    def _stamp(self, device: str, time: float) -> int:
        """Of what a device reports now."""
        return to_utime(self.faults.clock(device, self._clock.at(time)))

    def _too_slow(self) -> list[str]:
        """What the program should not have to guess from silence."""
        if self._images is None or self._rate is None:
            return []
        words = [self._rate.trouble] if self._rate.trouble else []
        silence, camera = self._images.longest_silence()
        limit = NAMED * self._rate.limits.age
        return words + ([f"the twin has not made an image of {camera} for {limit:g} s"] if silence > limit else [])

    def fell_behind(self, total: float) -> None:
        """Paced: by how much simulated time is behind the wall's clock since the start [s], before every tick."""
        self._clock.fell_behind(self.time, total)
        if self._rate is None or self._images is None:
            return
        now = wall.monotonic()
        begun, before = self._judged or (now, total)
        if self._judged is None or now - begun >= SECOND:
            took = self._images.took()
            if self._judged is not None:
                self._rate.judge((total - before) / (now - begun), took)
            self._judged = (now, total)

    def _say(self, key: str, message: Any) -> None:
        if self._started:
            self._out.put(key, message, self.time)
        else:  # before the start time stands still: no latency, and no random fault yet
            self._bus.send(key, message)

    def _sense(self) -> Values:
        self._measured = {name: self.read(name) for name in VECTORS}
        return self._measured

    def _frames(self, time: float) -> list[CameraFrame]:
        """Images that are there and were asked for."""
        asked, wanted = self._requested
        if time - asked > REQUEST_AGE:
            wanted = set()
        if self._images is not None:
            self._images.want(wanted)
            return self._images.ready()
        frames = []
        for camera in sorted(wanted):
            # Delivered before this tick.
            there = math.floor((time - TICK - self._camera.latency) / self._camera.period(camera))
            if there > self._shown[camera]:
                frame: Any = self.read(f"{camera}.image")
                self._shown[camera] = frame.sequence
                frames.append(frame)
        return frames

    def _put_image(self, frame: CameraFrame, time: float) -> None:
        key = IMAGES[frame.camera].key
        if not self.faults.silent(frame.camera, time):
            shown = self.faults.frozen(key, time, frame)
            if shown is not frame:
                shown = CameraFrame(frame.camera, frame.time, frame.sequence, shown.image, shown.data)
            self._say(key, image_message(dc.replace(shown, time=self._clock.at(shown.time))))

    def move(self) -> None:
        """Takes the commands that have arrived, which reach the joints in slot 3, and moves on to the next tick."""
        time = self.time
        self._in.pass_on(time)
        targets = self._guard.targets(self._measured, self.faults.acts("estop", "robot", time), time)
        for device in GROUPS:
            port = f"{device}.position_command"
            measured = self._measured[f"{device}.position_measured"]
            targets[port] = self.faults.stuck(device, time, targets[port], measured)
        self._set(targets)
        self.simulator.AdvanceTo(time + TICK)
        self.tick += 1

    # ------------------------------------------------------------ the start
    def claim(self, stop: Callable[[], bool]) -> None:
        """Makes sure that this is the only robot on the bus. Raises OperationFailed if it is not."""
        alone = self._bus.claim(ROBOT)
        while not (alone() or stop()):
            self.pass_time(2e-3)

    # ------------------------------------------------------------ lock-step
    def poll(self) -> None:
        """Lock-step: does what can be done now, without waiting for the program."""
        self._bus.pump()
        if not self._started:
            if self._lockstep.tick == -1:
                self._started = True
                self._lockstep.begin(self._bus.sent)
                self._report_tick()
            elif wall.monotonic() - self._idle_at > IDLE:
                self._idle_at = wall.monotonic()
                self.report()
                self._bus.say(SYNC[ROBOT], 0, {"tick": -1, "messages": 0})
        elif self._lockstep.tick == -2 or wall.monotonic() - self._heard_at > LOCKSTEP_TIME:
            self.gone = True
        elif self._lockstep.complete(self.tick):
            self.move()
            self._report_tick()

    def wait(self) -> None:
        """Lock-step: as `poll`, leaving the processor to others while the program thinks."""
        before = self.tick
        self.poll()
        if self.tick == before:
            wall.sleep(2e-4)

    def _report_tick(self) -> None:
        self.report()
        self._bus.say(SYNC[ROBOT], to_utime(self.time), self._lockstep.announcement(self.tick, self._bus.sent))

    # ------------------------------------------------------------ paced
    def pass_time(self, seconds: float) -> None:
        """Listens while there is nothing else to do: a channel has room for one message."""
        wall.sleep(min(seconds, 2e-3))
        self._bus.pump()

    def hear(self) -> None:
        """Paced: takes in what has arrived."""
        while self._bus.pump():
            pass
        self.gone = wall.monotonic() - self._heard_at > GONE
