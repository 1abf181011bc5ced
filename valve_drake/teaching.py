"""Teaching the hands: the reference image of each at its handle, and the image Jacobian by small moves there.

The lesson stands over the station contract: it reads images and joints and commands joints, of a simulated robot or of
one behind the LCM channels. It begins with both hands on their handles, grippers open; a simulated robot is put there
(`simulation.start.at_valve`), a real one by its operator. Then both hands go 15 mm to each side along each of their
axes, and the Jacobian is fitted to what the images and the joints' sensors showed.

References are good for one robot, marker and opening: their file says which (`made_for`). `prepared` looks, before a
run.
"""

import contextlib
import dataclasses as dc
import functools
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from valve_drake import named_files, outputs
from valve_drake.behaviors.taught import MadeFor, TaughtReference, load_made_for, load_taught, save_taught
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.diagram import initial_commands, make_station, robot_of
from valve_drake.frames import make
from valve_drake.messages import SIDES, CameraFrame, HandleMark, Health
from valve_drake.pace import Pacer
from valve_drake.perception.handle_marker import HandleMarkerConfig, find_mark
from valve_drake.ports import SLOT, TICK
from valve_drake.robot.robot import Robot
from valve_drake.scenario import Scenario, resolve
from valve_drake.stations.bus import Bus
from valve_drake.stations.contract import vectors
from valve_drake.stations.hardware import AHEAD, RobotLink
from valve_drake.stations.simulation_config import ErrorConfig, SimulationConfig
from valve_drake.valve.model import MARK
from valve_drake.valve.valve import Valve

PROBE = 0.015  # of the hand to both sides along each of its axes, at most [m]
ROOM = 0.6  # share of the room between handle and pads that it takes; raise it for hands that hardly open
SPEED = 0.04  # of a hand [m/s]
SETTLE = 0.2  # until a hand stands still [s]; twice at every place
TRACKED = 0.05  # a joint's error that is made up for, at most [rad]
TOUCH = 25.0  # a force that has changed by more comes of a contact; raise it for heavy hands without balance [N]
IMAGES = 8  # that show the mark, averaged at every place
PATIENCE = 10.0  # for them [s]
HEIGHTS = (1.0, 0.9, 1.1, 0.8, 1.2)  # of the simulated valve, the first that is reached [m]
REFERENCES, PICTURES = "hands.yaml", {side: f"{side}.png" for side in SIDES}
FILES = (REFERENCES, *PICTURES.values())
HEADING = "Made by `valve-drake teach`."
CACHE = "valve_drake"  # below XDG_CACHE_HOME
PLACES = np.vstack([np.zeros(3), *(sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))])  # (7, 3), in probes

Stop = Callable[[], bool]
Taught = dict[str, TaughtReference]
Pictures = dict[str, np.ndarray]  # of each hand at its handle (H, W, 3)


# ---------------------------------------------------------------- what references are good for


def made_for(robot: Robot, valve: Valve) -> MadeFor:
    """What the images at the handles depend on: the wrist cameras in their hands, the green marks, the opening."""
    cameras = [np.round(robot.X_GC(side), 6) + 0.0 for side in SIDES]
    return MadeFor(
        _hash(repr([X.tolist() for X in cameras])), _hash(repr((valve.marker.mark_height, MARK))), robot.opening
    )


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def prepared(scenario: Scenario, say: Callable[[str], None] = lambda line: None) -> Scenario:
    """The resolved scenario of a run, with references for its robot, marker and opening as `taught`.

    Where there are none, or they are of others: a simulated robot is taught now, once, into the user's cache; `say` is
    told. Raises ConfigError for a real robot, since its hands have to be put on the handles, and for a file that is
    named and not there.
    """
    robot = robot_of(scenario)
    if robot.description.servo != "camera":
        return scenario
    wanted, why = made_for(robot, scenario.valve), ""
    if scenario.taught or robot.description.taught:
        path = named_files.find(scenario, "taught")
        why = wanted.unlike(load_made_for(path))
        if not why:
            return scenario
        why = f"{path} is of {why}"
    else:
        why = f"{scenario.robot} names no taught references"
    if scenario.station != "simulated":
        raise ConfigError(f"{why}: put the hands on the handles and run `valve-drake teach SCENARIO`")
    path = _cached(wanted)
    if not _serve(path, wanted):
        outputs.make_folder(path.parent)  # before the work: a cache that cannot be written keeps nothing
        say(f"{why}: the hands are taught, once")
        write(dc.replace(scenario, seed=0), path.parent)
    say(f"{why}: {path} stands in")
    return dc.replace(scenario, taught=str(path))


def _serve(path: Path, wanted: MadeFor) -> bool:
    """Whether references of the cache are good; damaged ones are made anew."""
    try:
        return bool(load_taught(path)) and not wanted.unlike(load_made_for(path))
    except ConfigError:
        return False


def _cached(wanted: MadeFor) -> Path:
    """Where the references of such a robot are kept. Raises ConfigError: the user has no folder for a cache."""
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # neither HOME nor an entry in the list of users
        raise ConfigError(
            "HOME or XDG_CACHE_HOME must be given: the hands are taught, and their references kept"
        ) from None
    return home / CACHE / "taught" / _hash(repr(wanted)) / REFERENCES


# ---------------------------------------------------------------- the lesson


class _Ports:
    """A station on its own: its ports by name, moved on by whole ticks.

    pacer: holds it to the wall's clock. stop: True ends the lesson.
    """

    def __init__(self, station: Diagram, commands: Mapping[str, np.ndarray], pacer: Pacer | None, stop: Stop):
        self._station, self._pacer, self._stop = station, pacer, stop
        self._simulator = Simulator(station)
        self._context = self._simulator.get_mutable_context()
        for name, value in commands.items():
            self.write(name, value)
        self._simulator.Initialize()

    @property
    def time(self) -> float:
        time: float = self._context.get_time()
        return time

    def read(self, name: str) -> np.ndarray:
        value: np.ndarray = np.array(self._station.GetOutputPort(name).Eval(self._context))
        return value

    def image(self, camera: str) -> CameraFrame:
        frame: CameraFrame = self._station.GetOutputPort(f"{camera}.image").Eval(self._context)
        return frame

    def write(self, name: str, value: np.ndarray) -> None:
        self._station.GetInputPort(name).FixValue(self._context, value)

    def tick(self) -> None:
        """Raises OperationFailed if the robot reports a fault, or somebody stops it."""
        if self._stop():
            raise OperationFailed("stopped by the operator")
        health: Health = self._station.GetOutputPort("health").Eval(self._context)
        if health.estop or health.faults:
            raise OperationFailed(f"the robot reports {', '.join(health.faults) or 'its emergency stop'}")
        tick = round(self.time / TICK - 1 / 4) * TICK
        if self._pacer is None:
            self._simulator.AdvanceTo(tick + TICK)
            return
        advance = self._simulator.AdvanceTo
        # As in a run: the first part ends when the commands are sent; what follows delays none.
        self._pacer.tick(functools.partial(advance, tick + 3 * SLOT), functools.partial(advance, tick + TICK - AHEAD))


def teach(scenario: Scenario, stop: Stop = lambda: False, link: RobotLink | None = None) -> tuple[Taught, Pictures]:
    """References and pictures of both hands. Station `simulated`: with its valve straight before the robot.

    stop: True ends the lesson. link: to the robot of station `hardware`, else made of the scenario.
    Raises ConfigError or OperationFailed, one line: a mark is not seen, a hand does not reach or touches something, the
    robot does not answer.
    """
    scenario = resolve(scenario)
    robot = robot_of(scenario)
    with _station(scenario, robot, stop, link) as ports:
        return _lesson(ports, robot, scenario)


@contextlib.contextmanager
def _station(scenario: Scenario, robot: Robot, stop: Stop, link: RobotLink | None) -> Iterator[_Ports]:
    if scenario.station == "hardware":
        link = link or RobotLink(Bus(scenario.hardware), robot.groups, stop=stop)
        station = make_station(scenario, link=link)
        start = {name: np.zeros(size) for name, size in vectors(robot.groups, "in").items()}
        ports = _Ports(station, start, None if scenario.hardware.lockstep else Pacer(idle=link.pass_time), stop)
        try:
            yield ports
        finally:
            link.leave()
        return
    last: ConfigError | None = None
    for height in HEIGHTS:
        simulation = SimulationConfig(camera=scenario.simulation.camera, error=ErrorConfig(arm_offset=0.0))
        simulation.valve.height, simulation.start.at_valve = height, True
        there = resolve(dc.replace(scenario, simulation=simulation, command="open"))
        try:
            commands = initial_commands(there)
        except ConfigError as error:
            last = error
            continue
        yield _Ports(make_station(there), commands, None, stop)
        return
    raise ConfigError(f"teach: {last}")


def _lesson(ports: _Ports, robot: Robot, scenario: Scenario) -> tuple[Taught, Pictures]:
    torso = ports.read("torso.position_measured")
    posture = torso[: len(robot.posture)]
    ports.write("torso.position_command", torso)
    ports.write("base.twist_command", np.zeros(len(robot.drive.names)))
    goals = {side: ports.read(f"{side}_arm.position_measured") for side in SIDES}
    commands = dict(goals)
    _command(ports, commands)
    for side in SIDES:
        ports.write(f"{side}_gripper.position_command", np.array([robot.opening]))
        ports.write(f"{side}_gripper.force_limit", np.array([scenario.image_servo.gripper_force]))
    start = {side: robot.forward(side, goals[side], posture) for side in SIDES}
    at = {side: np.zeros_like(PLACES) for side in SIDES}  # where a hand was, in its own frame at the start [m]
    seen: dict[str, list[HandleMark]] = {side: [] for side in SIDES}
    pictures: Pictures = {}
    _wait(ports, {})
    load = {side: ports.read(f"{side}_wrist.wrench")[3:] for side in SIDES}
    probe = min(PROBE, ROOM * (robot.opening - max(handle.width for handle in scenario.valve.handles)) / 2)
    last = np.zeros(3)
    for k, place in enumerate(probe * PLACES):
        before = dict(commands)
        for side in SIDES:
            X = make(start[side][:, :3], start[side][:, 3] + start[side][:, :3] @ place)
            q = robot.inverse(side, X, goals[side], posture)
            if q is None:
                raise ConfigError(f"teach: the {side} hand does not reach a place {1e3 * place} mm off its handle")
            commands[side] = before[side] + q - goals[side]
            goals[side] = q
        steps = max(1, round(float(np.linalg.norm(place - last)) / SPEED / TICK))
        for step in range(1, steps + 1):
            _command(ports, {s: before[s] + (commands[s] - before[s]) * step / steps for s in SIDES})
            _tick(ports, load)
        last = place
        for _ in range(2):  # what the servos leave is made up for
            _wait(ports, load)
            for side in SIDES:
                left = goals[side] - ports.read(f"{side}_arm.position_measured")
                commands[side] = commands[side] + np.clip(left, -TRACKED, TRACKED)
            _command(ports, commands)
        _wait(ports, load)
        marks, last_images = _look(ports, load, scenario.handle_marker)
        for side in SIDES:
            p = robot.forward(side, ports.read(f"{side}_arm.position_measured"), posture)[:, 3]
            at[side][k] = start[side][:, :3].T @ (p - start[side][:, 3])
            seen[side].append(marks[side])
        if k == 0:
            pictures = last_images
    return {side: _reference(at[side], seen[side]) for side in SIDES}, pictures


def _reference(at: np.ndarray, seen: list[HandleMark]) -> TaughtReference:
    """Of one hand: places (K, 3) and the marks seen from there, the first at the handle."""
    features = np.array([mark.feature for mark in seen])
    # The places lie evenly about the handle, so what is of second order falls out.
    jacobian = np.linalg.lstsq(at - at.mean(axis=0), features - features.mean(axis=0), rcond=None)[0].T
    return TaughtReference(features[0] - jacobian @ at[0], jacobian, float(seen[0].area), seen[0].corners)


def _command(ports: _Ports, arms: Mapping[str, np.ndarray]) -> None:
    for side, q in arms.items():
        ports.write(f"{side}_arm.position_command", q)


def _tick(ports: _Ports, load: Mapping[str, np.ndarray]) -> None:
    """load: of each hand at the start (3,) [N]; none: contacts are not looked for."""
    ports.tick()
    for side, before in load.items():
        force = float(np.linalg.norm(ports.read(f"{side}_wrist.wrench")[3:] - before))
        if force > TOUCH:
            raise OperationFailed(f"teach: the {side} hand touches something: {force:.0f} N more than at the start")


def _wait(ports: _Ports, load: Mapping[str, np.ndarray]) -> None:
    for _ in range(round(SETTLE / TICK)):
        _tick(ports, load)


def _look(
    ports: _Ports, load: Mapping[str, np.ndarray], spec: HandleMarkerConfig
) -> tuple[dict[str, HandleMark], Pictures]:
    """The mean of IMAGES marks of each hand, in images taken from now on, and an image of each."""
    since = ports.time
    last = dict.fromkeys(SIDES, -1)  # image
    found: dict[str, list[HandleMark]] = {side: [] for side in SIDES}
    missed = dict.fromkeys(SIDES, 0)
    pictures: Pictures = {}
    while min(len(marks) for marks in found.values()) < IMAGES:
        _tick(ports, load)
        for side in SIDES:
            frame = ports.image(f"{side}_wrist")
            news = frame.sequence > last[side] and frame.image.size > 0 and frame.time >= since
            if not news or len(found[side]) == IMAGES:
                continue
            last[side] = frame.sequence
            mark = find_mark(frame.image, spec)
            if mark.found:
                found[side].append(mark)
                pictures.setdefault(side, frame.image)
                continue
            missed[side] += 1
            if missed[side] == IMAGES:  # noise hides a mark now and then
                looked = IMAGES + len(found[side])
                raise ConfigError(f"teach: no mark in {IMAGES} of {looked} {side} wrist images: {mark.reason}")
        if ports.time - since > PATIENCE:
            few = min(SIDES, key=lambda side: last[side])
            raise OperationFailed(f"teach: the {few} wrist camera sends too few images in {PATIENCE:g} s")
    names = ("feature", "area", "corners")
    means = {
        side: {name: np.mean([getattr(mark, name) for mark in marks], axis=0) for name in names}
        for side, marks in found.items()
    }
    return {side: dc.replace(found[side][0], **means[side]) for side in SIDES}, pictures


# ---------------------------------------------------------------- files


def place_of(scenario: Scenario) -> tuple[Path, str]:
    """The folder that the references of a scenario's robot belong in, and the value that robot.yaml's `taught` should
    have; "" if it leads there already."""
    name = robot_of(scenario).description.taught
    if Path(name).name == REFERENCES:
        try:
            return named_files.find(dc.replace(scenario, taught=""), "taught").parent, ""
        except ConfigError:  # it is not there yet
            if not name.startswith("package://"):
                return Path(name).parent, ""
    return named_files.find(scenario, "robot").parent / "taught", f"taught/{REFERENCES}"


def made_before(path: Path) -> bool:
    """Whether `write` has filled the folder of this file: its references say so."""
    try:
        with open(path.with_name(REFERENCES), "rb") as file:
            return file.read(100).startswith(f"# {HEADING}".encode())
    except OSError:
        return False


def write(scenario: Scenario, folder: Path, stop: Stop = lambda: False) -> None:
    """Teaches and writes FILES into a folder. Raises ConfigError as `teach` does, OperationFailed."""
    taught, pictures = teach(scenario, stop)
    outputs.make_folder(folder)
    save_taught(
        taught,
        folder / REFERENCES,
        f"{HEADING} For each hand at its handle, gripper open: feature (u, v, 1)/sqrt(area),\n"
        "image Jacobian d feature / d hand translation [1/m] in its frame, the mark's area [px^2] and corners [px].\n"
        "made_for: what of the robot, marker and opening [m] they are good for.",
        made_for(robot_of(scenario), scenario.valve),
    )
    for side, picture in pictures.items():
        _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        outputs.write(folder / PICTURES[side], data.tobytes())
