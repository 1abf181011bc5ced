"""What a robot can do of the work, before its first run: `valve-drake check-robot`.

Read off its model and robot.yaml alone: names and limits, whether home is free, what the folded arms hide from the
eyes, from where its hands turn a valve at which height and with what effort, how far its grippers open, how its
simulated servos swing, and what is missing for each stage. The reach is asked of the same search that a run uses.
"""

import contextlib
import dataclasses as dc
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.sensors import CameraInfo

from valve_drake import named_files
from valve_drake.behaviors.grasp_geometry import Turn
from valve_drake.behaviors.handle_check import check_handles
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.behaviors.stance_search import Place, Stances
from valve_drake.behaviors.taught import load_made_for, load_taught
from valve_drake.camera.lens import StereoHead, load_head
from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.config import Uniform
from valve_drake.diagram import gaze_of, robot_of
from valve_drake.frames import apply, compose, inverse, planar
from valve_drake.messages import SIDES
from valve_drake.robot import description as descriptions
from valve_drake.robot.kinematics import Joints
from valve_drake.robot.model import add_robot, parent_joint
from valve_drake.robot.portrait import Studio, png
from valve_drake.robot.robot import Robot, carriers
from valve_drake.robot_postures import Postures, find_home, find_work
from valve_drake.robot_sight import seen_from
from valve_drake.scenario import Scenario
from valve_drake.stations.scene import add_scene, panel_pose
from valve_drake.stations.servos import add_servos
from valve_drake.stations.simulation_config import ValveConfig
from valve_drake.teaching import made_for
from valve_drake.valve.valve import Valve, turned

HEIGHTS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3)  # of the valve's axis [m]
TILTS = (-0.3, 0.0, 0.3)  # of the panel; positive leans away at its top [rad]
WORKED = (0.9, 1.1, 1.3)  # of those that a working posture is looked for at [m]
TURN = math.pi / 2  # [rad]
STEP, LIFT_STEP = 0.07, 0.15  # between two that are tried, and between two heights of a lift [m]
ARC_STEP = 0.4  # of the turn [rad]
ENOUGH = 0.6  # margin at which the search ends
ROW = 6.0  # of processor time for one row of the table [s]
BUDGET = 40.0  # of processor time for the table; what is left of it then is not searched [s]
DEAR = 1.0  # share of an effort limit that must not be passed
HIDDEN, BLIND = 0.02, 0.25  # share of the middle of an eye's image that folded arms may hide: doubtful, useless
ASIDE = 0.6  # of the pans that the eyes are tried at, to both sides [rad]
NARROW = 0.015  # room on each side of the handle below which a hand must be led that well [m]
SLACK = 0.01  # by which the fingers' shapes may be nearer to each other than the pads' surfaces [m]
SWINGS = 0.3  # damping ratio of a servo below which it swings
DROOPS = 0.02  # of a joint below its command, by the arm's weight [rad]
DEEP = 0.005  # overlap of two links that is no matter of their hulls' roughness [m]
OUTER = 3  # arm joints from the shoulder on whose links may touch the trunk at home
FIELD = 1.0  # upright, of an eye whose lens is not known [rad]
EYE = 320, 240  # of an eye's picture [px]
BEHIND = np.array([-0.75, 0.65, 0.35]), np.array([-0.45, -0.75, 0.6])  # views of a robot at the valve
SAMPLES = 7  # of the turn at which efforts are looked at
NIGHT = (1.0, 0.0, 1.0)  # a sky in a colour that no robot has

Best: TypeAlias = tuple[ValveConfig, Place]  # the valve that is turned best, and from where
MISSING, DOUBTFUL, NOTE = "missing", "doubtful", "note"


@dc.dataclass(frozen=True)
class Finding:
    """level: MISSING (the work cannot be done), DOUBTFUL or NOTE. stage: of the work; key: of robot.yaml."""

    level: str
    stage: str
    key: str
    text: str

    def line(self) -> str:
        return f"{self.level}: {self.stage}: {self.key + ': ' if self.key else ''}{self.text}"


@dc.dataclass(frozen=True)
class Reach:
    """The best place to turn one valve from."""

    height: float  # [m]
    tilt: float  # [rad]
    margin: float  # of the arms over the turn; negative: out of reach
    distance: float = math.nan  # base to panel [m]
    posture: tuple[float, ...] = ()  # lift and waist
    effort: float = math.nan  # largest share of a joint's limit
    joint: str = ""  # whose that is
    seen_to: float | None = None  # the head sees the valve from there to so far back [m]; 0: not; None: no calibration

    def serves(self, least: float) -> bool:
        return self.margin >= least and not self.effort > DEAR


@dc.dataclass(frozen=True)
class Servo:
    """A joint's servo in simulation, at home."""

    joint: str
    stiffness: float  # [N m/rad or N/m]
    effort: float  # limit [N m or N]
    ratio: float  # of damping
    droop: float  # by the weight of what it carries [rad or m]


@dc.dataclass
class Report:
    """All that was found. pictures: PNG by title."""

    source: str
    name: str
    findings: list[Finding] = dc.field(default_factory=list)
    groups: dict[str, list[dict[str, Any]]] = dc.field(default_factory=dict)
    grippers: dict[str, dict[str, float]] = dc.field(default_factory=dict)
    servos: list[Servo] = dc.field(default_factory=list)
    reach: list[Reach] = dc.field(default_factory=list)
    least_margin: float = 0.0
    friction: float = 0.0  # of the valve for which efforts are given [N m]
    hidden: dict[str, float] = dc.field(default_factory=dict)  # by eye, share of its image's middle
    pictures: dict[str, bytes] = dc.field(default_factory=dict)
    seconds: float = 0.0  # of processor time

    @property
    def usable(self) -> bool:
        return not any(finding.level == MISSING for finding in self.findings)

    def add(self, level: str, stage: str, key: str, text: str) -> None:
        self.findings.append(Finding(level, stage, key, text))

    def sorted(self) -> list[Finding]:
        """What is missing first, then in the order of the work."""
        order = {level: k for k, level in enumerate((MISSING, DOUBTFUL, NOTE))}
        return sorted(self.findings, key=lambda finding: order[finding.level])

    def as_json(self) -> dict[str, Any]:
        """The object of `check-robot --json`."""
        return {
            "robot": self.source,
            "name": self.name,
            "usable": self.usable,
            "findings": [dc.asdict(finding) for finding in self.sorted()],
            "groups": self.groups,
            "grippers": self.grippers,
            "servos": [_plain(servo) for servo in self.servos],
            "friction_Nm": self.friction,
            "least_margin": self.least_margin,
            "reach": [_plain(row) | {"serves": row.serves(self.least_margin)} for row in self.reach],
            "hidden_share": self.hidden,
            "processor_s": round(self.seconds, 2),
        }


def _plain(row: Reach | Servo) -> dict[str, Any]:
    """JSON has no numbers that are none."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in dc.asdict(row).items()}


def check(scenario: Scenario, source: str, *, pictures: bool = False) -> Report:
    """The robot of a scenario, `source` is its robot.yaml's name. Raises ConfigError if that cannot be read."""
    start = time.process_time()
    report = Report(source, Path(source).name, least_margin=scenario.stance.margin_min)
    file = named_files.find(scenario, "robot")
    report.name = Path(descriptions.load(file).model).stem
    try:
        robot = Robot.load(file, scenario.valve)
    except ConfigError as error:
        report.add(MISSING, "load", "", str(error).removeprefix(f"{file}: "))
        report.seconds = time.process_time() - start
        return report
    _groups(report, robot)
    _head(report, robot, scenario)
    _base(report, robot)
    head, collision = _head_of(scenario), CollisionModel(robot)
    _home(report, robot, collision)
    refused = ""
    try:
        check_handles(collision, scenario.valve, robot.opening)
    except ConfigError as error:
        refused = str(error)
        report.add(MISSING, "grasp", "", refused)
    _servoing(report, robot, scenario)
    _grippers(report, robot, scenario)
    _servos(report, robot)
    report.friction = _most(scenario.simulation.valve.friction)
    best = (
        None if refused else _reach(report, robot, scenario, collision, head)
    )  # no hand holds it: nothing to reach for
    _eyes(report, robot, scenario, best, head, pictures)
    if not refused:
        _postures(report, robot, scenario, collision, head)
    _rest(report, scenario)
    report.seconds = time.process_time() - start
    return report


def _most(value: Any) -> float:
    return float(value.max if isinstance(value, Uniform) else value)


def _least(value: Any) -> float:
    return float(value.min if isinstance(value, Uniform) else value)


# ---------------------------------------------------------------- names, limits, home


def _groups(report: Report, robot: Robot) -> None:
    groups: dict[str, Joints] = {"base": robot.base, "torso": robot.torso}
    groups |= {f"{side}_arm": robot.arms[side] for side in SIDES}
    for group, joints in groups.items():
        rows = zip(joints.names, joints.low.tolist(), joints.high.tolist(), joints.speed.tolist(), joints.home.tolist())
        report.groups[group] = [
            {
                "joint": name,
                "low": low if math.isfinite(low) else None,
                "high": high if math.isfinite(high) else None,
                "speed": speed,
                "home": home,
            }
            for name, low, high, speed, home in rows
        ]
    for side in SIDES:
        arm = robot.arms[side]
        if not np.any(arm.home):
            report.add(DOUBTFUL, "reach", f"arms.{side}.home", "all zero: fold the arm where it is out of the way")
        if not robot.description.arm(side).work:
            text = "not given: a redundant arm is drawn to home, and the search begins there"
            report.add(NOTE, "reach", f"arms.{side}.work", text)


def _home(report: Report, robot: Robot, collision: CollisionModel) -> None:
    for pair in collision.touching(None, robot.home)[:4]:
        report.add(MISSING, "reach", "arms.*.home", f"touches or is nearer than collision.padding: {pair}")
    outer = {link: k for side in SIDES for link, k in _links(robot, side).items()}
    for a, b, depth in _overlaps(robot):
        if _apart(outer.get(a, 0), outer.get(b, 0)):
            text = f"{a} is {1e3 * depth:.0f} mm inside {b} there, and `collision` has it that they may touch"
            report.add(DOUBTFUL, "reach", "arms.*.home", text)


def _overlaps(robot: Robot) -> list[tuple[str, str, float]]:
    """The links that overlap by more than DEEP at home, whatever `collision` permits, and how far [m]."""
    model = robot.model
    root = model.diagram.CreateDefaultContext()
    model.plant.SetPositions(model.plant.GetMyMutableContextFromRoot(root), robot.rest(robot.opening))
    query = model.scene_graph.get_query_output_port().Eval(model.scene_graph.GetMyContextFromRoot(root))
    inspector = model.scene_graph.model_inspector()
    out: dict[tuple[str, str], float] = {}
    for pair in query.ComputeSignedDistancePairwiseClosestPoints(0.0):
        if pair.distance > -DEEP:
            continue
        bodies = [model.plant.GetBodyFromFrameId(inspector.GetFrameId(shape)) for shape in (pair.id_A, pair.id_B)]
        if all(body.model_instance() == model.robot for body in bodies):
            key = min(b.name() for b in bodies), max(b.name() for b in bodies)
            out[key] = max(out.get(key, 0.0), -pair.distance)
    return [(a, b, depth) for (a, b), depth in sorted(out.items())]


def _apart(a: int, b: int) -> bool:
    """Two links, by _links, that do not belong in each other: of both arms, or far along one and at its beginning."""
    return a * b < 0 or abs(abs(a) - abs(b)) > OUTER


def _links(robot: Robot, side: str) -> dict[str, int]:
    """The links that an arm carries -> how many of its joints do; negative for the right arm."""
    plant, index = robot.model.plant, robot.model.robot
    names, sign = robot.arms[side].names, 1 if side == SIDES[0] else -1
    out = {}
    for k in plant.GetBodyIndices(index):
        body, count = plant.get_body(k), 0
        inner = body
        while (joint := parent_joint(plant, index, inner)) is not None:
            count += joint.name() in names
            inner = joint.parent_body()
        if count:
            out[body.name()] = sign * count
    return out


# ---------------------------------------------------------------- what each stage needs


def _head(report: Report, robot: Robot, scenario: Scenario) -> None:
    d = robot.description
    for name in _unnamed(robot):
        text = f"{name} moves the eyes and is not named: give it as waist, pan or tilt, or hold it fast (weld)"
        report.add(DOUBTFUL, "search", "gaze", text)
    with contextlib.suppress(ConfigError):  # what a run refuses comes last
        for line in gaze_of(scenario, robot)[1]:
            key, _, text = line.partition(": ")
            report.add(NOTE, "search", key, text)
    if not (scenario.head_calibration or d.head_calibration):
        text = "none: there is no second eye without it, and the valve's place is measured with two (calibrate stereo)"
        report.add(MISSING, "search", "head_calibration", text)
        return
    try:
        _calibration(scenario)
    except ConfigError as error:
        report.add(MISSING, "search", "head_calibration", str(error))


def _unnamed(robot: Robot) -> list[str]:
    """Joints that carry the left eye and move, and that robot.yaml does not name."""
    plant, index = robot.model.plant, robot.model.robot
    named = {*robot.base.names, *robot.torso.names, *(mimic.joint for mimic in robot.model.mimics)}
    carry = carriers(plant, index, plant.GetFrameByName(robot.description.cameras["head_left"], index))
    return [joint.name() for joint in carry if joint.num_velocities() and joint.name() not in named]


def _calibration(scenario: Scenario) -> StereoHead:
    return load_head(named_files.find(scenario, "head_calibration"))


def _base(report: Report, robot: Robot) -> None:
    if robot.drive.fixed:
        report.add(NOTE, "approach", "base.drive", "fixed: the valve has to be within reach; the table says from where")


def _servoing(report: Report, robot: Robot, scenario: Scenario) -> None:
    d = robot.description
    if d.servo == "none":
        report.add(NOTE, "servo", "servo", "none: the last decimeter is by the head's estimate and touch")
        return
    plant, index = robot.model.plant, robot.model.robot
    mounted = True
    for side in SIDES:
        key = f"cameras.{side}_wrist"
        if not d.cameras[f"{side}_wrist"]:
            report.add(MISSING, "servo", key, "no camera: mount one beyond the arm's last joint, or `servo: none`")
            mounted = False
            continue
        body = plant.GetFrameByName(d.cameras[f"{side}_wrist"], index).body()
        carried = _links(robot, side).get(body.name(), 0)
        if abs(carried) < len(robot.arms[side]):
            text = f"{body.name()} does not move with the hand: its joints beyond would turn the image"
            report.add(MISSING, "servo", key, text)
            mounted = False
    if not mounted:
        return
    if not (scenario.taught or d.taught):
        text = "none yet: a simulated run teaches the hands itself, a real robot needs `valve-drake teach`"
        report.add(NOTE, "servo", "taught", text)
        return
    try:
        path = named_files.find(scenario, "taught")
        load_taught(path)
        if unlike := made_for(robot, scenario.valve).unlike(load_made_for(path)):
            report.add(DOUBTFUL, "servo", "taught", f"of {unlike}: `valve-drake teach` makes them anew")
    except ConfigError as error:
        report.add(MISSING, "servo", "taught", str(error))


def _grippers(report: Report, robot: Robot, scenario: Scenario) -> None:
    width, margin = max(h.width for h in scenario.valve.handles), scenario.hybrid_rotation.grip_margin
    room = (robot.opening - width) / 2
    for side in SIDES:
        gripper = robot.grippers[side]
        shut, most = float(gripper.openings.min()), float(gripper.openings.max())
        force = _grip(robot, side, width)
        row = {"shuts_m": shut, "opens_m": most, "used_m": robot.opening, "room_m": room, "force_N": force}
        report.grippers[side] = row
        if shut > width - 0.002:
            text = f"shuts to {1e3 * shut:.0f} mm, the handle has {1e3 * width:g} mm"
            report.add(MISSING, "grasp", f"grippers.{side}", text)
        gap = _gap(robot, side)
        if gap < robot.opening - SLACK:
            text = f"open, the fingers' shapes are {1e3 * gap:.0f} mm apart, its surfaces {1e3 * robot.opening:.0f} mm"
            report.add(DOUBTFUL, "grasp", "pad.at", text)
        wanted = scenario.hybrid_rotation.grip_force
        if force < wanted:
            text = f"its motor closes with {force:.0f} N, hybrid_rotation.grip_force asks for {wanted:g} N"
            report.add(DOUBTFUL, "grasp", f"grippers.{side}", text)
    first = report.grippers[SIDES[0]]
    way = f"{1e3 * first['shuts_m']:.0f} to {1e3 * first['opens_m']:.0f} mm"
    told = (
        f"the fingers open by {1e3 * (first['opens_m'] - first['shuts_m']):.0f} mm, from {way}, of which "
        f"{1e3 * robot.opening:.0f} mm are used; the handle has {1e3 * width:.0f} mm"
    )
    if room < margin:
        report.add(MISSING, "grasp", "opening", f"{told}: {1e3 * margin:g} mm of room on each side are needed")
    elif room < NARROW:
        report.add(DOUBTFUL, "grasp", "opening", f"{told}: the hand must come within {1e3 * room:.0f} mm of its middle")
    else:
        report.add(NOTE, "grasp", "opening", f"{told}: {1e3 * room:.0f} mm of room on each side")


def _gap(robot: Robot, side: str) -> float:
    """The least distance between the shapes of the two pads' links, the gripper open [m]; infinite without shapes."""
    model = robot.model
    root = model.diagram.CreateDefaultContext()
    model.plant.SetPositions(model.plant.GetMyMutableContextFromRoot(root), robot.rest(robot.opening))
    query = model.scene_graph.get_query_output_port().Eval(model.scene_graph.GetMyContextFromRoot(root))
    bodies = [model.plant.GetFrameByName(pad, model.robot).body() for pad in robot.description.gripper(side).pads]
    first, second = (model.plant.GetCollisionGeometriesForBody(body) for body in bodies)
    gaps = [query.ComputeSignedDistancePairClosestPoints(a, b).distance for a in first for b in second]
    return float(min(gaps, default=math.inf))


def _grip(robot: Robot, side: str, width: float) -> float:
    """What the motor closes with on a handle, as the contract counts it: of both fingers together [N]."""
    gripper = robot.grippers[side]
    effort = _limits(robot.model.plant)[gripper.joint]
    step = 1e-3
    lever = abs(gripper.position(width + step) - gripper.position(width - step)) / (2 * step)  # [rad/m or 1]
    return float(effort * lever * 2)


def _servos(report: Report, robot: Robot) -> None:
    """Stiffness, damping and droop of the torso's and the arms' servos in simulation, at home."""
    plant = MultibodyPlant(1 / 512)
    index = add_robot(plant, robot.description)
    add_servos(plant, index, robot)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    arms = {side: arm.home for side, arm in robot.arms.items()}
    q = np.array(plant.GetPositions(context))
    for name, value in robot.named(torso=robot.torso.home, arms=arms, opening=robot.opening).items():
        q[plant.GetJointByName(name, index).position_start()] = value
    plant.SetPositions(context, q)
    M, weight = plant.CalcMassMatrix(context), plant.CalcGravityGeneralizedForces(context)
    asked: dict[str, tuple[float, float]] = {}  # by joint, what weight asks and what it has
    wanted = {*robot.torso.names, *(name for arm in robot.arms.values() for name in arm.names)}
    for k in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(k)
        name, v = actuator.joint().name(), actuator.joint().velocity_start()
        if name not in wanted or not actuator.has_controller():
            continue
        gains, inertia = actuator.get_controller_gains(), float(M[v, v])
        ratio = gains.d / (2 * math.sqrt(gains.p * inertia))
        droop = abs(float(weight[v])) / gains.p
        report.servos.append(Servo(name, gains.p, actuator.effort_limit(), ratio, droop))
        asked[name] = abs(float(weight[v])), actuator.effort_limit()
    if heavy := {name: load / limit for name, (load, limit) in asked.items() if load > limit}:
        name = max(heavy, key=lambda name: heavy[name])
        load, limit = asked[name]
        text = f"false, but the weight asks {load:.0f} of {name}, whose limit is {limit:.0f}: do springs carry it?"
        report.add(MISSING, "reach", "counterbalanced", text)
    arm_names = {name for arm in robot.arms.values() for name in arm.names}
    if swings := [s for s in report.servos if s.ratio < SWINGS]:
        worst = min(swings, key=lambda s: s.ratio)
        text = f"{len(swings)} servos swing, {worst.joint} most: its damping ratio is {worst.ratio:.2f}"
        report.add(DOUBTFUL, "reach", "arms.*.stiffness", text)
    if droops := [s for s in report.servos if s.droop > DROOPS and s.joint in arm_names]:
        worst = max(droops, key=lambda s: s.droop)
        text = f"{len(droops)} joints hang below their commands, {worst.joint} by {1e3 * worst.droop:.0f} mrad"
        report.add(DOUBTFUL, "reach", "arms.*.stiffness", text)


# ---------------------------------------------------------------- reach


def _reach(
    report: Report, robot: Robot, scenario: Scenario, collision: CollisionModel, head: StereoHead | None
) -> Best | None:
    """Fills the table."""
    spec, stances = scenario.stance, _stances(robot, scenario, collision)
    fixed = scenario.simulation.valve
    own = {round(value(fixed.height), 3) for value in (_least, _most)}
    rows = [(height, 0.0) for height in sorted({*HEIGHTS, *own})]
    rows += [(height, tilt) for height in HEIGHTS[1::2] for tilt in TILTS if tilt]
    best: tuple[float, ValveConfig, Place] | None = None
    try:
        search = gaze_of(scenario, robot)[0]
    except ConfigError:  # what a run refuses comes last
        search = scenario.valve_search
    start = time.process_time()
    for k, (height, tilt) in enumerate(rows):
        if time.process_time() - start > BUDGET:
            text = f"the last {len(rows) - k} rows of the table are not searched: they would take over {BUDGET:g} s"
            report.add(NOTE, "reach", "", text)
            break
        valve = ValveConfig(height=height, tilt=tilt)
        X_WA = compose(panel_pose(valve), inverse(scenario.valve.X_AP()))
        place, margin = _find(stances, X_WA)
        if margin < 0:
            report.reach.append(Reach(height, tilt, -1.0))
            continue
        X_BA = compose(inverse(planar(*place.base)), X_WA)
        effort, joint = _effort(report, robot, stances, X_BA, place)
        distance = float(np.linalg.norm(place.base[:2]))
        posture = () if place.posture is None else tuple(round(float(q), 4) for q in place.posture)
        seen_to = None if head is None else seen_from(robot, head, search, place, _marker(scenario.valve, X_WA))
        report.reach.append(Reach(height, tilt, margin, distance, posture, effort, joint, seen_to))
        if tilt == 0 and (best is None or margin > best[0]):
            best = margin, valve, place
    _judge_reach(report, spec, own)
    if head is not None:
        _judge_sight(report, scenario, own, not robot.drive.fixed)
    if best is None or best[0] < spec.margin_min:
        _in_the_way(report, stances, collision)
    return None if best is None else best[1:]


def _marker(valve: Valve, X_WA: np.ndarray) -> np.ndarray:
    """The marker's corners before the turn and after it, in W (n, 3)."""
    ends = [X_WA] if valve.fixed else [X_WA, turned(X_WA, TURN)]
    return np.concatenate([apply(compose(X, valve.X_AV()), valve.target().corners()) for X in ends])


def _in_the_way(report: Report, stances: Stances, collision: CollisionModel) -> None:
    """Where no valve is turned: which of the robot's own links keep the arms from it, if that is what does."""
    found: dict[str, int] = {}

    def look(X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> bool:
        for pair in collision.touching(X_BA, q, posture):
            links = " - ".join(shape.partition("::")[0] for shape in pair.split(" - "))
            found[links] = found.get(links, 0) + 1
        return True

    upright = {row.height for row in report.reach if row.tilt == 0}
    for height in sorted(upright, key=lambda h: abs(h - 1.1))[:3]:
        found.clear()
        X_WA = compose(panel_pose(ValveConfig(height=height)), inverse(stances.valve.X_AP()))
        _, margin = _find(dc.replace(stances, is_free=look), X_WA)
        if margin >= stances.config.margin_min and found:
            pair = max(found, key=lambda links: found[links])
            text = f"links in the way are all that keeps it from {height:g} m, mostly {pair}"
            by_valve = set(pair.split(" - ")) & {"wheel", "panel"}
            way = "smaller shapes of that link in the model" if by_valve else "if they are neighbours, collision.srdf"
            report.add(MISSING, "reach", "collision", f"{text}: {way}")
            return


def _stances(robot: Robot, scenario: Scenario, collision: CollisionModel) -> Stances:
    """The search of a run, with fewer places and angles."""
    spec = scenario.stance
    step, lift, arc = max(STEP, spec.distance_step), max(LIFT_STEP, spec.lift_step), max(ARC_STEP, spec.arc_step)
    tried = dc.replace(spec, distance_step=step, lift_step=lift, arc_step=arc, aside=0.0, margin_enough=ENOUGH)
    return Stances(robot, scenario.valve, tried, _views(scenario), collision.is_free)


def _find(stances: Stances, X_WA: np.ndarray) -> tuple[Place, float]:
    """As Stances.find, for ROW seconds of processor time at the most."""
    search, end = stances.begin(X_WA, TURN, np.array([-2.0, 0.0])), time.process_time() + ROW
    while not search.done and time.process_time() < end:
        search = stances.advance(search)
    return search.best or Place(np.zeros(3)), search.margin


def _views(scenario: Scenario) -> Mapping[str, np.ndarray]:
    try:
        taught = load_taught(named_files.find(scenario, "taught"))
        return {side: taught[side].view for side in SIDES}
    except ConfigError:
        return dict.fromkeys(SIDES, np.array([0.0, 0.0, 1.0]))


def _judge_reach(report: Report, spec: StanceConfig, own: set[float]) -> None:
    upright = [row for row in report.reach if row.tilt == 0]
    good = [row for row in upright if row.serves(spec.margin_min)]
    weak = [row for row in upright if row.margin >= spec.margin_min and row.effort > DEAR]
    for row in weak[:1]:
        text = f"{report.friction:g} N m at {row.height:g} m ask {row.effort:.2f} times the limit of {row.joint}"
        report.add(DOUBTFUL if good else MISSING, "turn", "", text)
    if not good:
        most = max(upright, key=lambda row: row.margin)
        said = f"the best margin is {most.margin:.2f} at {most.height:g} m" if most.margin >= 0 else "none is in reach"
        text = f"no valve is turned by a quarter: {said}; {spec.margin_min:g} is needed (stance.margin_min)"
        report.add(MISSING, "reach", "arms.*.work", text)
        return
    served = {round(row.height, 3) for row in good}
    out = [row.height for row in upright if round(row.height, 3) not in served]
    if lost := sorted(own - served):
        # One height: that is the valve of this scenario. Several: it is drawn, and most may be in reach.
        text = f"the scenario's valve at {', '.join(f'{h:g}' for h in lost)} m is out of reach"
        report.add(MISSING if len(lost) == len(own) else DOUBTFUL, "reach", "", text)
    elif out:
        report.add(NOTE, "reach", "", f"valves at {', '.join(f'{h:g}' for h in out)} m are out of reach")


def _judge_sight(report: Report, scenario: Scenario, own: set[float], drives: bool) -> None:
    """Whether the head sees the valves that the hands reach: from the stance, and on the way there."""
    good = [row for row in report.reach if row.tilt == 0 and row.serves(scenario.stance.margin_min)]
    comes = scenario.base_approach.rough_distance
    blind = [row for row in good if row.seen_to == 0]
    late = [row for row in good if drives and row.seen_to and row.seen_to < comes]
    for rows, where in (blind, "from where its hands reach it"), (late, f"from there back to {comes:g} m"):
        if not rows:
            continue
        heights = sorted({row.height for row in rows})
        text = f"the eyes do not see the whole marker of a valve at {', '.join(f'{h:g}' for h in heights)} m {where}"
        mine = own & {round(height, 3) for height in heights}
        report.add(MISSING if mine == own else DOUBTFUL if mine else NOTE, "search", "gaze.tilt", text)


def _effort(report: Report, robot: Robot, stances: Stances, X_BA: np.ndarray, place: Place) -> tuple[float, str]:
    """The largest share of an effort limit along the turn, by weight and the hands' push, and whose it is."""
    arc = stances.best_arc(Turn(X_BA, TURN, place.posture))
    if not arc.q:
        return math.nan, ""
    plant, index, limits = robot.model.plant, robot.model.robot, _limits(robot.model.plant)
    context = plant.CreateDefaultContext()
    worst, joint, now = 0.0, "", dict(arc.q)
    for angle in np.linspace(0.0, TURN, SAMPLES):
        X_BAk = turned(X_BA, float(angle))
        positions = robot.rest(robot.opening)
        if place.posture is not None and len(place.posture):
            positions[robot.slots(robot.posture.names)] = place.posture
        for side in SIDES:
            X_BG = compose(X_BAk, stances.valve.grasp(arc.grasps[side].handle, arc.grasps[side].sign))
            q = robot.inverse(side, X_BG, now[side], place.posture)
            now[side] = now[side] if q is None else q
            positions[robot.slots(robot.arms[side].names)] = now[side]
        plant.SetPositions(context, positions)
        weight = plant.CalcGravityGeneralizedForces(context)
        for side in SIDES:
            radius = robot.forward(side, now[side], place.posture)[:, 3] - X_BAk[:, 3]
            across = np.cross(-X_BAk[:, 2], radius)
            push = report.friction / 2 / float(np.linalg.norm(across))  # half the couple each [N]
            torque = robot.jacobian(side, now[side], place.posture)[3:].T @ (push * across / np.linalg.norm(across))
            for k, name in enumerate(robot.arms[side].names):
                v = plant.GetJointByName(name, index).velocity_start()
                share = abs(float(torque[k] - weight[v])) / limits[name]
                if share > worst:
                    worst, joint = share, name
    return worst, joint


def _limits(plant: MultibodyPlant) -> dict[str, float]:
    """Effort limits by joint [N m or N]."""
    found = (plant.get_joint_actuator(k) for k in plant.GetJointActuatorIndices())
    return {actuator.joint().name(): actuator.effort_limit() for actuator in found}


# ---------------------------------------------------------------- eyes and pictures


def _eyes(
    report: Report, robot: Robot, scenario: Scenario, best: Best | None, head: StereoHead | None, pictures: bool
) -> None:
    """What of the robot itself its eyes see, arms folded; and pictures of it."""
    report.hidden = _hidden(robot, scenario, head)
    worst = max(report.hidden.values())
    if worst > HIDDEN:
        text = f"folded, the robot hides {100 * worst:.0f} % of the middle of an eye's image"
        report.add(MISSING if worst > BLIND else DOUBTFUL, "search", "arms.*.home", text)
    if pictures:
        _pictures(report, robot, scenario, best, head, _eyes_of(head))


def _head_of(scenario: Scenario) -> StereoHead | None:
    try:
        return _calibration(scenario)
    except ConfigError:
        return None


def _eyes_of(head: StereoHead | None) -> dict[str, np.ndarray]:
    """The poses of the eyes in the left one."""
    return {"left": np.eye(3, 4)} | ({} if head is None else {"right": head.X_LR})


def _hidden(robot: Robot, scenario: Scenario, head: StereoHead | None) -> dict[str, float]:
    """By eye, how much of the middle of its image the robot hides with its arms at home, at the most."""
    d, out = robot.description, {}
    arms = {side: arm.home for side, arm in robot.arms.items()}
    night = Studio(lambda plant: _alone(plant, robot), floor=False, sky=NIGHT)
    search = scenario.valve_search
    pitches = sorted({min(search.pitches), max(search.pitches)}) if d.gaze.tilt else [0.0]
    pans = (-ASIDE, 0.0, ASIDE) if d.gaze.pan else (0.0,)
    for eye, X_LC in _eyes_of(head).items():
        info = _info(head, eye)
        shares = []
        for pitch in pitches:
            for pan in pans:
                night.pose(robot.named(torso=_gaze(robot, pitch, pan), arms=arms, opening=robot.opening))
                image = night.view(compose(night.frame(d.cameras["head_left"]), X_LC), info)
                shares.append(_share(image))
        out[eye] = round(max(shares), 4)
    return out


def _postures(
    report: Report, robot: Robot, scenario: Scenario, collision: CollisionModel, head: StereoHead | None
) -> None:
    """Others to copy, where those of robot.yaml do not serve: work for a poor reach, home where it is in the way."""
    spec = scenario.stance
    work: Postures = {side: arm.work.tolist() for side, arm in robot.arms.items()}
    most = max((row.margin for row in report.reach), default=1.0)
    if most < spec.margin_good:
        stances = _stances(robot, scenario, collision)
        fixed = scenario.simulation.valve.height
        heights = sorted({round((_least(fixed) + _most(fixed)) / 2, 2), *WORKED})
        valves = {h: compose(panel_pose(ValveConfig(height=h)), inverse(scenario.valve.X_AP())) for h in heights}

        def margin(other: Robot, X_BA: np.ndarray) -> float:
            asked = dc.replace(stances, robot=other, is_free=CollisionModel(other).is_free)
            return asked.best_arc(Turn(X_BA, TURN)).margin

        if found := find_work(stances, valves, TURN, max(most, spec.margin_min), margin):
            work = found.postures
            text = f"with these, a valve at {found.height:g} m is turned with a margin of {found.margin:.2f}"
            _tell(report, "work", work, text)
    zero = not all(np.any(arm.home) for arm in robot.arms.values())
    if not zero and max(report.hidden.values()) <= HIDDEN and not collision.touching(None, robot.home):
        return

    def serves(other: Robot) -> bool:
        outer = {link: k for side in SIDES for link, k in _links(other, side).items()}
        inside = any(_apart(outer.get(a, 0), outer.get(b, 0)) for a, b, _ in _overlaps(other))
        free = not inside and not CollisionModel(other).touching(None, other.home)
        return free and max(_hidden(other, scenario, head).values()) <= HIDDEN

    if home := find_home(robot, collision, work, serves):
        _tell(report, "home", home, "with these, the arms are free of all and out of the eyes' sight")


def _tell(report: Report, key: str, postures: Postures, text: str) -> None:
    for side in SIDES:
        report.add(NOTE, "reach", f"arms.{side}.{key}", f"try {postures[side]}: {text}")


def _share(image: np.ndarray) -> float:
    """Of the middle of an image (half as wide, half as high), how much is not the sky."""
    h, w = image.shape[:2]
    middle = image[h // 4 : -(h // 4), w // 4 : -(w // 4)].astype(int)
    return float(np.mean(np.abs(middle - [255, 0, 255]).max(axis=-1) > 8))


def _gaze(robot: Robot, pitch: float, pan: float) -> np.ndarray:
    """The torso's joints for a look down and to the left, within their limits."""
    within: np.ndarray = np.clip(robot.gaze.torso(np.array([0.0, pitch, pan])), robot.torso.low, robot.torso.high)
    return within


def _info(head: StereoHead | None, eye: str) -> CameraInfo:
    width, height = EYE
    if head is None:
        return CameraInfo(width, height, FIELD)
    lens = head.left if eye == "left" else head.right
    (fx, fy), scale = lens.magnification(), width / lens.width
    return CameraInfo(width, round(lens.height * scale), fx * scale, fy * scale, width / 2, lens.height * scale / 2)


def _alone(plant: MultibodyPlant, robot: Robot) -> ModelInstanceIndex:
    return add_robot(plant, robot.description)


def _pictures(
    report: Report,
    robot: Robot,
    scenario: Scenario,
    best: Best | None,
    head: StereoHead | None,
    eyes: Mapping[str, np.ndarray],
) -> None:
    d = robot.description
    valve, place = best if best is not None else (ValveConfig(), Place(np.array([-1.0, 0, 0])))

    def pose(base: np.ndarray, torso: np.ndarray, arms: Mapping[str, np.ndarray]) -> Studio:
        """A fixed base is bolted down there, another is put there by its joints."""
        studio = Studio(lambda plant: add_scene(plant, valve, scenario.valve, d, base.tolist(), laboratory=False).robot)
        moved = {"base": base} if len(robot.base) else {}
        studio.pose(robot.named(torso=torso, arms=arms, opening=robot.opening, **moved))
        return studio

    arms = {side: arm.home for side, arm in robot.arms.items()}
    away = np.array([-2.0, 0.0, 0.0])
    studio = pose(away, robot.torso.home, arms)
    box = np.array([[-0.5, -0.6, 0.0], [0.6, 0.6, 1.6]]) + away
    report.pictures["at home"] = png(studio.around(box))
    looks = _gaze(robot, scenario.valve_search.pitches[0], 0.0)
    studio = pose(away, looks, arms)
    for eye, X_LC in eyes.items():
        X = compose(studio.frame(d.cameras["head_left"]), X_LC)
        report.pictures[f"{eye} eye, arms folded, a valve 2 m away"] = png(studio.view(X, _info(head, eye)))
    if best is None:
        return
    X_WA = compose(panel_pose(valve), inverse(scenario.valve.X_AP()))
    stances = _stances(robot, scenario, CollisionModel(robot))
    arc = stances.best_arc(Turn(compose(inverse(planar(*place.base)), X_WA), TURN, place.posture))
    torso = robot.torso.home.copy()
    if place.posture is not None:
        torso[: len(place.posture)] = place.posture
    studio = pose(place.base, torso, arc.q)
    box = np.array([[place.base[0] - 0.4, -0.6, 0.0], [0.1, 0.6, 1.6]])
    report.pictures[f"at a valve {valve.height:g} m high"] = png(studio.around(box, BEHIND))


def _rest(report: Report, scenario: Scenario) -> None:
    """What else a run with this scenario refuses."""
    try:
        robot_of(scenario)
    except ConfigError as error:
        text = str(error).removeprefix(f"{scenario.robot}: ")
        if not any(
            finding.level == MISSING and finding.key and text.startswith(finding.key) for finding in report.findings
        ):
            report.add(MISSING, "run", "", text)
