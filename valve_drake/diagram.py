"""The wiring: every block of the system and every arrow between them.

`WIRES` is the list of arrows; `make_diagram` adds the blocks and connects them. The reviewed list and drawing of each
scenario are in diagrams/ (made by `valve-drake draw`; a test keeps them current).
"""

import dataclasses as dc
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, InputPort, LeafSystem
from pydrake.systems.primitives import Multiplexer

from valve_drake import named_files
from valve_drake.behaviors.base_approach_system import BaseApproachSystem
from valve_drake.behaviors.blind_servo import STRAIGHT, BlindServo
from valve_drake.behaviors.grasp_geometry import Turn
from valve_drake.behaviors.handle_check import check_handles
from valve_drake.behaviors.hybrid_rotation import HybridRotation
from valve_drake.behaviors.hybrid_rotation_system import HybridRotationSystem
from valve_drake.behaviors.image_servo import ImageServo
from valve_drake.behaviors.image_servo_system import ImageServoSystem
from valve_drake.behaviors.kinematic_approach import KinematicApproach
from valve_drake.behaviors.kinematic_approach_system import KinematicApproachSystem
from valve_drake.behaviors.stance_planner import StancePlanner
from valve_drake.behaviors.stance_planner_system import StancePlannerSystem
from valve_drake.behaviors.stance_search import Stances
from valve_drake.behaviors.taught import load_taught
from valve_drake.behaviors.valve_search import GazeLimits, Sight, ValveSearchConfig, reachable
from valve_drake.behaviors.valve_search_system import ValveSearchSystem
from valve_drake.camera.lens import StereoHead, load_head
from valve_drake.checks import ConfigError, require
from valve_drake.collision import CollisionModel
from valve_drake.config import Uniform
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.messages import SIDES, OperatorCommand, OperatorPackets
from valve_drake.operator.operator_channel_system import OperatorChannelSystem
from valve_drake.perception.color_segmentation_system import ColorSegmentationSystem
from valve_drake.perception.handle_marker_system import HandleMarkerSystem
from valve_drake.perception.line_fitting_system import LineFittingSystem
from valve_drake.perception.rectangle_estimator_system import RectangleEstimatorSystem
from valve_drake.perception.stereo_positioning_system import StereoPositioningSystem
from valve_drake.ports import Block
from valve_drake.recording.recorder_system import RecorderSystem
from valve_drake.recording.signals import JOINED
from valve_drake.robot.groups import Groups
from valve_drake.robot.robot import Robot
from valve_drake.robot_state_system import RobotStateSystem
from valve_drake.scenario import Scenario
from valve_drake.stations.bus import Bus
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.contract import CONTRACT, vectors
from valve_drake.stations.hardware import RobotLink, make_hardware_station
from valve_drake.stations.plant_system import PlantSystem
from valve_drake.stations.replay import Recording, make_replay_station
from valve_drake.stations.scene import panel_pose, start_pose
from valve_drake.stations.simulated import RobotStart, make_plant, make_simulated_station, rig_arguments
from valve_drake.stations.simulation_config import StartConfig
from valve_drake.supervisor.command_selector_system import CommandSelectorSystem
from valve_drake.supervisor.supervisor_system import SupervisorSystem
from valve_drake.task.modes import BEHAVIORS
from valve_drake.valve.valve import turned

# A robot that drives begins no nearer to the valve, nor than it has room to turn: base and arms are clear of the panel.
DRIVING_START = 0.9  # [m]

MEASURED = tuple(spec.name for spec in CONTRACT if spec.direction == "out" and not isinstance(spec.kind, type))

WIRES: tuple[tuple[str, str], ...] = (
    # head cameras: stages 1 and 2
    ("station.head_left.image", "color_segmentation.head_left_image"),
    ("station.head_right.image", "color_segmentation.head_right_image"),
    ("color_segmentation.segmentation", "line_fitting.segmentation"),
    ("color_segmentation.segmentation", "stereo_positioning.segmentation"),
    ("line_fitting.edges", "rectangle_estimator.edges"),
    # wrist cameras
    ("station.left_wrist.image", "handle_marker.left_wrist_image"),
    ("station.right_wrist.image", "handle_marker.right_wrist_image"),
    # joints and forces
    *((f"station.{name}", f"robot_state.{name}") for name in MEASURED),
    *(
        ("robot_state.robot_state", f"{block}.robot_state")
        for block in ("stereo_positioning", "rectangle_estimator", *BEHAVIORS, "command_selector")
    ),
    # from perception to the behaviours
    ("stereo_positioning.position", "valve_search.position"),
    ("stereo_positioning.position", "base_approach.position"),
    ("rectangle_estimator.estimate", "valve_search.estimate"),
    ("rectangle_estimator.estimate", "base_approach.estimate"),
    ("rectangle_estimator.estimate", "kinematic_approach.estimate"),
    ("handle_marker.marks", "kinematic_approach.marks"),
    ("handle_marker.marks", "image_servo.marks"),
    # between behaviours: where to stand, what to grasp, how far it was turned
    ("rectangle_estimator.estimate", "stance_planner.estimate"),
    ("stance_planner.stance", "base_approach.stance"),
    ("stance_planner.stance", "valve_search.stance"),
    ("kinematic_approach.request", "stance_planner.request"),
    ("stance_planner.grasps", "kinematic_approach.grasps"),
    ("stance_planner.path", "kinematic_approach.path"),
    ("kinematic_approach.plan", "hybrid_rotation.plan"),
    ("kinematic_approach.plan", "image_servo.plan"),
    ("hybrid_rotation.turn", "kinematic_approach.turn"),
    # all commands reach the robot through command_selector
    *((f"{block}.command", f"command_selector.{block}") for block in BEHAVIORS),
    ("station.health", "command_selector.health"),
    *((f"command_selector.{spec.name}", f"station.{spec.name}") for spec in CONTRACT if spec.direction == "in"),
    # supervision
    *((f"{block}.status", f"supervisor.{block}") for block in BEHAVIORS),
    ("station.health", "supervisor.health"),
    ("command_selector.report", "supervisor.selector"),
    *(
        ("supervisor.mode", f"{block}.mode")
        for block in (
            "color_segmentation",
            "rectangle_estimator",
            "handle_marker",
            "stance_planner",
            *BEHAVIORS,
            "command_selector",
        )
    ),
)

OPERATOR = "operator"  # the diagram's input port: the program's own command
PACKETS = "packets"  # another one, where operators are listened to: what they have sent

# Where operators are listened to, they stand before the port OPERATOR.
COMMANDED = ((f"{OPERATOR}", "supervisor.operator"),)
LISTENING: tuple[tuple[str, str], ...] = (
    (OPERATOR, "operator_channel.local"),
    (PACKETS, "operator_channel.packets"),
    ("supervisor.mode", "operator_channel.mode"),
    ("hybrid_rotation.status", "operator_channel.turning"),
    ("rectangle_estimator.estimate", "operator_channel.estimate"),
    ("handle_marker.marks", "operator_channel.marks"),
    ("operator_channel.command", "supervisor.operator"),
)


def listens(scenario: Scenario) -> bool:
    """Whether operators are listened to."""
    return scenario.operator_channel.wire != "none"


def wires_of(scenario: Scenario) -> tuple[tuple[str, str], ...]:
    """Every arrow between blocks, and from the diagram's input ports (names without a dot)."""
    return WIRES + (LISTENING if listens(scenario) else COMMANDED)


@dc.dataclass(frozen=True)
class System:
    """The whole system, and the parts of it that a runner uses."""

    diagram: Diagram
    station: Diagram
    supervisor: SupervisorSystem
    operator_channel: OperatorChannelSystem | None  # where operators are listened to


def robot_of(scenario: Scenario) -> Robot:
    """The robot of a scenario. Raises ConfigError if there is none, or the program cannot use it."""
    robot = Robot.load(named_files.find(scenario, "robot"), scenario.valve)
    d = robot.description
    try:
        over_wire = scenario.station == "hardware"  # its channels are those of four cameras
        words = "given for station hardware" if over_wire else "given, or servo: none"
        for side in SIDES if over_wire or d.servo == "camera" else ():
            require(bool(d.cameras[f"{side}_wrist"]), f"cameras.{side}_wrist", words, d.cameras[f"{side}_wrist"])
        _gaze(scenario.valve_search, robot)
        high, width = scenario.command_selector.gripper_high, max(h.width for h in scenario.valve.handles)
        require(d.opening <= high, "opening", f"at most command_selector.gripper_high, {high:g}", d.opening)
        # Open fingers keep clear of the handle as of all else, and an open hand must not look like one that holds.
        room = max(scenario.hybrid_rotation.grip_margin, d.collision.padding)
        least = width + 2 * room
        words = f"at least {least:g}: valve.handles.width and {room:g} to either side (collision.padding)"
        if d.opening > 2 * room:
            words += f", or the handles at most {d.opening - 2 * room:.4g} wide"
        require(d.opening >= least - 1e-9, "opening", words, d.opening)
    except ConfigError as error:
        raise ConfigError(f"{scenario.robot}: {error}") from error
    distance = scenario.simulation.start.distance
    nearest = distance.min if isinstance(distance, Uniform) else distance
    least = max(DRIVING_START, math.ceil(1e3 * robot.turning_room) / 1e3)
    words = f"at least {least:g} for a base that drives"
    require(robot.drive.fixed or nearest >= least, "simulation.start.distance", words, nearest)
    return robot


def gaze_of(scenario: Scenario, robot: Robot | None = None) -> tuple[ValveSearchConfig, list[str]]:
    """The search as the robot's joints can do it, and a line for each default that they cannot.

    robot: that of the scenario, where it is known, usable or not. Raises ConfigError: a value that was chosen is beyond
    the joints.
    """
    return _gaze(scenario.valve_search, robot_of(scenario) if robot is None else robot)


def _gaze(search: ValveSearchConfig, robot: Robot) -> tuple[ValveSearchConfig, list[str]]:
    limits = list(zip(robot.torso.low.tolist(), robot.torso.high.tolist()))
    waist, tilt, pan = (None if joint is None else limits[joint] for joint in robot.gaze.joints)

    def both(limit: tuple[float, float]) -> float:
        return max(min(-limit[0], limit[1]), 0.0)

    pitch = tilt if tilt is None or robot.gaze.signs[1] > 0 else (-tilt[1], -tilt[0])
    return reachable(search, GazeLimits(pitch, pan and both(pan), waist and both(waist)))


def start_of(scenario: Scenario) -> RobotStart | None:
    """How the simulated robot of a resolved scenario begins; None: at home. Raises ConfigError if it cannot."""
    simulation, valve, robot = scenario.simulation, scenario.valve, robot_of(scenario)
    start: StartConfig = simulation.start
    if not start.at_valve:
        return None
    opened = simulation.valve.bar_angle + valve.sense * max(simulation.valve.position, 0.0)
    X_WA = turned(compose(panel_pose(simulation.valve), inverse(valve.X_AP())), opened)
    along = dict.fromkeys(SIDES, np.array([0.0, 0.0, 1.0]))  # how the wrist cameras look is not known without a lesson
    stances = Stances(robot, valve, scenario.stance, along, CollisionModel(robot).is_free)
    place, margin = stances.find(X_WA, scenario.angle)
    arc = stances.best_arc(Turn(compose(inverse(planar(*place.base)), X_WA), scenario.angle, place.posture))
    if margin < 0 or not arc.q:
        raise ConfigError(f"the hands do not reach the handles of a valve at {simulation.valve.height:g} m")
    torso = robot.torso.home.copy()
    if place.posture is not None:
        torso[: len(place.posture)] = place.posture
    return RobotStart(place.base, torso, arc.q)


def initial_commands(scenario: Scenario) -> dict[str, np.ndarray]:
    """The values of the station's inputs before the first command, by port."""
    robot, start = robot_of(scenario), start_of(scenario)
    arms = robot.split(robot.home) if start is None else start.arms
    out = {name: np.zeros(size) for name, size in vectors(robot.groups, "in").items()}
    out["torso.position_command"] = robot.torso.home if start is None else start.torso
    for side in SIDES:
        out[f"{side}_arm.position_command"] = arms[side]
        out[f"{side}_gripper.position_command"] = np.array([robot.opening])
        out[f"{side}_gripper.force_limit"] = np.array([scenario.kinematic_approach.gripper_force])
    return out


def make_station(
    scenario: Scenario,
    meshcat: Meshcat | None = None,
    recording: Recording | None = None,
    workers: CameraWorkers | None = None,
    link: RobotLink | None = None,
    physics: PlantSystem | None = None,
) -> Diagram:
    """The station of a resolved scenario. recording: for station `replay`; link: for station `hardware`; workers and
    physics: of `rig_of` and `plant_of`, for station `simulated`."""
    if scenario.station == "hardware":
        robot = robot_of(scenario)
        return make_hardware_station(RobotLink(Bus(scenario.hardware), robot.groups) if link is None else link, robot)
    if scenario.station == "replay":
        if recording is None:
            raise ConfigError("station replay needs a log: valve-drake replay LOG")
        return make_replay_station(recording)
    robot = robot_of(scenario)
    return make_simulated_station(
        scenario.simulation,
        scenario.valve,
        _head(scenario),
        robot,
        scenario.seed,
        meshcat,
        workers,
        physics or plant_of(scenario),
    )


def plant_of(scenario: Scenario) -> PlantSystem:
    """The plant of a resolved scenario of station `simulated`."""
    return make_plant(scenario.simulation, scenario.valve, robot_of(scenario), scenario.seed, start_of(scenario))


def rig_of(scenario: Scenario) -> tuple[Any, ...]:
    """The simulated cameras of a resolved scenario, as the arguments of CameraRig or CameraWorkers."""
    robot, simulation = robot_of(scenario), scenario.simulation
    place: Sequence[float] = (0.0, 0.0, 0.0)
    if robot.drive.fixed:
        start = start_of(scenario)
        place = (start_pose(simulation.start, simulation.valve) if start is None else start.base).tolist()
    return rig_arguments(simulation, scenario.valve, _head(scenario), scenario.seed, robot.description, place)


def _head(scenario: Scenario) -> StereoHead:
    return load_head(named_files.find(scenario, "head_calibration"))


def _check_seen(scenario: Scenario, head: StereoHead, robot: Robot) -> None:
    """Raises ConfigError for a marker that is too small to be seen from anywhere that a search may look from.

    Whether one is seen from where a run starts, that run tells: the place is drawn.
    """
    size, nearest = scenario.valve.marker.size, robot.stand[0] if robot.drive.fixed else DRIVING_START
    least = scenario.color_segmentation.min_area
    area = size[0] * size[1] * (head.left.focal() / nearest) ** 2
    grow = math.sqrt(least / area)
    enough = ", ".join(f"{math.ceil(1e3 * grow * side) / 1e3:g}" for side in size)
    words = (
        f"at least [{enough}]: {nearest:.3g} m away, the nearest place of a search, it has {area:.1f} px^2, and "
        f"color_segmentation.min_area is {least:g}"
    )
    require(grow <= 1.0, "valve.marker.size", words, size)


def _sight(head: StereoHead) -> Sight:
    """What both eyes see at once."""
    halves = [
        (math.atan2(lens.width / 2, fx), math.atan2(lens.height / 2, fy))
        for lens in head.lenses()
        for fx, fy in (lens.magnification(),)
    ]
    return Sight.of(*map(min, zip(*halves)))


def make_blocks(scenario: Scenario) -> list[Block[Any, Any]]:
    """All blocks between the station's outputs and its inputs: the same objects for every station."""
    head = _head(scenario)
    valve, marker = scenario.valve, scenario.valve.target()
    X_LEyes = make(np.eye(3), head.X_LR[:, 3] / 2)  # between both head cameras: a near marker stays in both images
    robot = robot_of(scenario)
    _check_seen(scenario, head, robot)
    servo: ImageServo | BlindServo
    if robot.description.servo == "camera":
        taught = load_taught(named_files.find(scenario, "taught"))
        view = {side: taught[side].view for side in SIDES}
        area = {side: taught[side].area for side in SIDES}
        servo = ImageServo(scenario.image_servo, robot, taught)
    else:  # marks are never large enough: the hands reach the stand-off
        view, area = dict.fromkeys(SIDES, STRAIGHT), dict.fromkeys(SIDES, math.inf)
        servo = BlindServo(scenario.image_servo, robot)
    collision = CollisionModel(robot)
    if touching := collision.touching(None, robot.home):
        raise ConfigError(f"{scenario.robot}: arms.left.home and arms.right.home must be free of all: {touching[0]}")
    check_handles(collision, valve, robot.opening)
    stances = Stances(robot, valve, scenario.stance, view, collision.is_free, collision.pairs, robot.drive.fixed)
    return [
        RobotStateSystem(robot.groups),
        ColorSegmentationSystem(scenario.color_segmentation, reach=1.3 * marker.reach()),
        LineFittingSystem(scenario.line_fitting, head, marker, scenario.stereo_positioning),
        StereoPositioningSystem(scenario.stereo_positioning, head, robot.head_pose, marker),
        RectangleEstimatorSystem(scenario.rectangle_estimator, head, robot.head_pose, marker),
        HandleMarkerSystem(scenario.handle_marker),
        ValveSearchSystem(
            _gaze(scenario.valve_search, robot)[0],
            lambda base, torso: compose(robot.head_pose(base, torso), X_LEyes),
            robot.gaze,
            look=valve.look(),
            drive=robot.drive,
            sight=_sight(head),
        ),
        BaseApproachSystem(scenario.base_approach, valve, robot.drive, robot.turning_room),
        StancePlannerSystem(StancePlanner(scenario.stance_planner, stances)),
        KinematicApproachSystem(KinematicApproach(scenario.kinematic_approach, robot, valve, area)),
        ImageServoSystem(servo),
        HybridRotationSystem(HybridRotation(scenario.hybrid_rotation, valve, robot, view)),
        CommandSelectorSystem(
            scenario.command_selector, initial_commands(scenario), robot.torso, robot.arms, robot.drive
        ),
        SupervisorSystem(scenario.supervisor, opening=valve.sense),
        *(
            [OperatorChannelSystem(scenario.operator_channel, scenario.angle, scenario.supervisor.angle_limit)]
            if listens(scenario)
            else []
        ),
    ]


def make_diagram(
    scenario: Scenario,
    recorder: RecorderSystem | None = None,
    *,
    meshcat: Meshcat | None = None,
    recording: Recording | None = None,
    workers: CameraWorkers | None = None,
    link: RobotLink | None = None,
    physics: PlantSystem | None = None,
    truth: bool = True,
    added: Mapping[LeafSystem, Mapping[str, str]] | None = None,
) -> System:
    """The whole system for a resolved scenario; `recording` is what station `replay` shows, `link` leads to a robot.

    workers: of `rig_of`, render the simulated cameras' images in other processes. physics: of `plant_of`, else it is
    made. truth=False: the recorder gets no `truth.*` ports. added: systems of one's own, and for each of their input
    ports "<block>.<port>" that it reads.
    """
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(scenario, meshcat, recording, workers, link, physics))
    station.set_name("station")  # whichever it is: the wiring is the same
    blocks = {block.get_name(): block for block in make_blocks(scenario)}
    for block in blocks.values():
        builder.AddSystem(block)
    systems: dict[str, Any] = blocks | {"station": station}
    for source, target in wires_of(scenario):
        b, port = target.split(".", 1)
        if "." not in source:
            builder.ExportInput(systems[b].GetInputPort(port), source)
            continue
        a, output = source.split(".", 1)
        builder.Connect(systems[a].GetOutputPort(output), systems[b].GetInputPort(port))
    for own, inputs in (added or {}).items():
        builder.AddSystem(own)
        for port, source in inputs.items():
            a, output = source.split(".", 1)
            builder.Connect(systems[a].GetOutputPort(output), own.GetInputPort(port))
    if recorder is not None:
        builder.AddSystem(recorder)
        _connect_recorder(builder, recorder, systems, robot_of(scenario).groups, truth)
    diagram = builder.Build()
    diagram.set_name("valve_drake")
    return System(diagram, station, systems["supervisor"], systems.get("operator_channel"))


def recorded_from(name: str) -> str:
    """The output port that a port of the recorder shows, as "<block>.<port>", OPERATOR or PACKETS; not for JOINED."""
    if name in _EXPORTED:
        return _EXPORTED[name]
    if name.startswith("truth."):
        return f"station.{name}"
    return {spec.name: _OWNER[spec.direction] + name for spec in CONTRACT}.get(name, name)


_EXPORTED = {"operator.command": OPERATOR, "operator.packets": PACKETS}
_OWNER = {"out": "station.", "in": "command_selector."}  # of the contract's ports


def _connect_recorder(
    builder: DiagramBuilder, recorder: RecorderSystem, systems: dict[str, Any], groups: Groups, truth: bool
) -> None:
    """Every port of the recorder is named after what it records: a station's port, a command, block.port, or JOINED."""
    station = systems["station"]
    exported = {station.get_output_port(k).get_name() for k in range(station.num_output_ports())}

    def connect(name: str, port: InputPort) -> None:
        if name in JOINED:
            parts = JOINED[name](groups)
            join = builder.AddNamedSystem(name, Multiplexer([len(values) for values in parts.values()]))
            for k, part in enumerate(parts):
                connect(part, join.get_input_port(k))
            builder.Connect(join.get_output_port(), port)
            return
        source = recorded_from(name)
        if "." not in source:
            if source == OPERATOR or "operator_channel" in systems:
                builder.ConnectInput(source, port)
            return
        block, output = source.split(".", 1)
        if block not in systems:  # not of this scenario
            return
        if not output.startswith("truth.") or (truth and output in exported):
            builder.Connect(systems[block].GetOutputPort(output), port)
        if isinstance(systems[block], Block) and port.get_system() is recorder:
            recorder.follow(port.get_name(), systems[block])

    for k in range(recorder.num_input_ports()):
        port = recorder.get_input_port(k)
        connect(port.get_name(), port)


def command(system: System, context: Context, request: OperatorCommand) -> None:
    """Gives the system an operator's request, from now on."""
    system.diagram.GetInputPort(OPERATOR).FixValue(context, Value(request))


def deliver(system: System, context: Context, packets: OperatorPackets) -> None:
    """Gives the system what operators have sent, from now on."""
    system.diagram.GetInputPort(PACKETS).FixValue(context, Value(packets))


def wiring(diagram: Diagram) -> list[str]:
    """Every connection of a diagram as "block.port -> block.port", sorted."""
    lines = [
        f"{a.get_name()}.{a.get_output_port(i).get_name()} -> {b.get_name()}.{b.get_input_port(j).get_name()}"
        for (b, j), (a, i) in diagram.connection_map().items()
    ]
    return sorted(lines)
