"""The simulated station: contact physics, joint servos, sensors and cameras behind the contract's ports.

Nothing is welded or moved by hand: the fingers hold the handles by friction and the valve turns by the hands' forces
(plant_system.py). `truth.*` ports exist here only; the recorder alone reads them.
"""

import dataclasses as dc
import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import (
    AffineSystem,
    ConstantValueSource,
    ConstantVectorSource,
    Demultiplexer,
    MatrixGain,
)
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from valve_drake.camera.lens import Lens, StereoHead
from valve_drake.frames import compose, make, rotation
from valve_drake.messages import CAMERAS, DEVICES, LEFT, SIDES, WRISTS, CameraFrame, Health
from valve_drake.ports import TICK, Block, Inputs, Outputs, PythonSystem
from valve_drake.robot.description import ArmDescription, RobotDescription
from valve_drake.robot.drive import DIFFERENTIAL, Drive, whole
from valve_drake.robot.groups import POSE
from valve_drake.robot.robot import Robot
from valve_drake.stations.camera_rig import CameraSystem, Images, Mount, RigWhenRead
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.contract import TRUTH, check_contract
from valve_drake.stations.mishaps import LostGripSystem, WheelSlipSystem, slips
from valve_drake.stations.plant_system import COMMANDS, STEM, PlantSystem
from valve_drake.stations.rails import STAND
from valve_drake.stations.scene import add_scene, panel_pose, start_pose
from valve_drake.stations.simulation_config import ErrorConfig, MishapConfig, SimulationConfig, ValveConfig
from valve_drake.stations.torque_wrench import add_torque_wrenches
from valve_drake.valve.model import marker_frame
from valve_drake.valve.valve import Valve


def arm_offsets(error: ErrorConfig, seed: int, robot: Robot) -> dict[str, np.ndarray]:
    """What each arm's encoders read at the joints' true zero: side -> (n,) [rad]."""
    sizes = {side: len(arm) for side, arm in robot.arms.items()}
    draws = np.split(_rng(seed, 5).standard_normal(sum(sizes.values())), [sizes[LEFT]])
    return {side: error.arm_offset * draw for side, draw in zip(SIDES, draws)}


def _rng(seed: int, stream: int) -> np.random.Generator:
    """The random generator of one source of errors: it depends on the seed and the source's number alone."""
    return np.random.Generator(np.random.SFC64([seed, 1000 + stream]))


class _Noise:
    """A table of white noise: row `count` depends on the seed and `count` alone, so that no generator state is kept."""

    def __init__(self, seed: int, stream: int, width: int):
        self._rows = _rng(seed, stream).standard_normal((1 << 16, width))

    def __call__(self, count: int) -> np.ndarray:
        return self._rows[count % len(self._rows)]


class OdometryInputs(Inputs):
    base: Annotated[np.ndarray, 6]


class OdometrySystem(Block[OdometryInputs, tuple[np.ndarray, int]]):
    """Wheel odometry: starts at zero, integrates measured wheel speeds, drifts.

    port      dir  type       unit                notes
    --------  ---  ---------  ------------------  ------------------------------------
    base      in   vector(6)  m, rad, m/s, rad/s  x, y, heading and their rates, true
    odometry  out  vector     m, rad, m/s, rad/s  x, y, heading, and the speeds that the base has
    """

    def __init__(self, error: ErrorConfig, seed: int, mishap: MishapConfig | None = None, drive: Drive = DIFFERENTIAL):
        self._error, self._mishap, self._drive = error, mishap or MishapConfig(), drive
        count = len(drive.names)
        self._noise = _Noise(seed, 1, count)
        self._scale = (1 + error.odometry_scale * _rng(seed, 0).standard_normal(count)).tolist()
        self.OUTPUTS = {"odometry": len(POSE) + count}
        super().__init__("odometry", slot=3)

    def initial(self) -> tuple[np.ndarray, int]:
        return np.zeros(len(POSE) + len(self._drive.names)), 0

    def step(
        self, time: float, inputs: OdometryInputs, memory: tuple[np.ndarray, int]
    ) -> tuple[tuple[np.ndarray, int], Outputs]:
        last, count = memory
        x, y, h = last.tolist()[: len(POSE)]
        _, _, heading, vx, vy, w = inputs.base.tolist()
        c, s = math.cos(heading), math.sin(heading)
        turning = 1.0 - slips(self._mishap, time)  # of the wheels' way, what the base has made
        made = (vx * c + vy * s, vy * c - vx * s, w)
        true = self._drive.part(np.array([speed / turning if turning > 0 else 0.0 for speed in made])).tolist()
        draw, noise = self._noise(count).tolist(), self._error.odometry_noise
        twist = [speed * scale * (1 + noise * off) for speed, scale, off in zip(true, self._scale, draw)]
        forward, sideways, w = whole(np.array(twist))
        middle, way, aside = h + w * TICK / 2, forward * TICK, sideways * TICK
        c, s = math.cos(middle), math.sin(middle)
        new = np.array([x + (way * c - aside * s), y + (way * s + aside * c), h + w * TICK, *twist])
        return (new, count + 1), {"odometry": new}


class WrenchSensorSystem(Block[Inputs, int]):
    """Both wrist force-torque sensors: load felt by the sensor, in its frame, with bias and noise.

    port                    dir  type       notes
    ----------------------  ---  ---------  --------------------------------------------------------
    left_load, right_load   in   vector(6)  on the hand, from the arm, [torque; force] [N m, N]
    left, right             out  vector(6)  what the sensor feels, the opposite [torque; force] [N m, N]

    sides: of the hands that have one.
    """

    def __init__(self, error: ErrorConfig, seed: int, sides: Sequence[str] = SIDES):
        self.INPUTS = {f"{side}_load": 6 for side in sides}
        self.OUTPUTS = {side: 6 for side in sides}
        self._noise = _Noise(seed, 3, 12)
        torque, force = np.ones(3), np.ones(3)
        self._scatter = np.concatenate([error.wrench_noise_torque * torque, error.wrench_noise_force * force])
        bias = np.concatenate([error.wrench_bias_torque * torque, error.wrench_bias_force * force])
        draw = _rng(seed, 2).standard_normal((2, 6))
        self._bias = {side: bias * draw[k] for k, side in enumerate(SIDES)}
        super().__init__("wrench_sensor", slot=3)

    def initial(self) -> int:
        return 0

    def step(self, time: float, inputs: Inputs, memory: int) -> tuple[int, Outputs]:
        draw = self._noise(memory).reshape(2, 6)
        out = {}
        for k, side in enumerate(SIDES):
            if side not in self.OUTPUTS:
                continue
            out[side] = -inputs[f"{side}_load"] + self._bias[side] + self._scatter * draw[k]
        return memory + 1, out


class TorqueSensorSystem(Block[Inputs, int]):
    """The torque readings of an arm that has no force sensor, with the bias and noise that robot.yaml states.

    port    dir  type    notes
    ------  ---  ------  ---------------------------------------
    true    in   vector  of the joints' actuators [N m]
    torque  out  vector  what they read [N m]
    """

    def __init__(self, side: str, arm: ArmDescription, seed: int):
        count, stream = len(arm.joints), 6 + 2 * SIDES.index(side)
        self.INPUTS, self.OUTPUTS = {"true": count}, {"torque": count}
        self._scatter, self._noise = np.array(arm.torque_noise), _Noise(seed, stream, count)
        self._bias = np.array(arm.torque_bias or [0.0] * count) * _rng(seed, stream + 1).standard_normal(count)
        super().__init__(f"{side}_torque_sensor", slot=3)

    def initial(self) -> int:
        return 0

    def step(self, time: float, inputs: Inputs, memory: int) -> tuple[int, Outputs]:
        return memory + 1, {"torque": inputs["true"] + self._bias + self._scatter * self._noise(memory)}


class HealthSystem(Block[Inputs, None]):
    """Reports that all devices work and were heard just now: the simulated machine has no faults of its own."""

    OUTPUTS = {"health": Health}

    def __init__(self, missing: Sequence[str] = ()) -> None:
        """missing: devices that this robot does not have."""
        self.DEVICES = tuple(device for device in DEVICES if device not in ("robot", *missing))
        super().__init__("health", period=1 / 32, slot=0)

    def step(self, time: float, inputs: Inputs, memory: None) -> tuple[None, Outputs]:
        return None, {"health": Health(time=time, devices=self.DEVICES, ages=np.zeros(len(self.DEVICES)))}


class TruthSystem(PythonSystem):
    """What only a simulation knows, for the recorder and the metrics; the state is that of the instant it is read.

    port         dir  type        notes
    -----------  ---  ----------  ---------------------------------------------------------------------
    state        in   vector      of the whole plant
    stem_load    in   vector(6)   of the plant
    valve_angle  out  vector(2)   turned since closed, counter-clockwise [rad], and its rate [rad/s]
    base_pose    out  vector(3)   x, y, heading in W
    marker_pose  out  vector(12)  X_WV, rows of (3, 4)
    stem_wrench  out  vector(6)   on the valve from its bearing, in the stem's frame, in the last step
    """

    OUTPUTS = {"valve_angle": 2, "base_pose": 3, "marker_pose": 12, "stem_wrench": 6}

    def __init__(self, physics: PlantSystem, valve: ValveConfig):
        super().__init__()
        self.set_name("truth")
        plant = physics.plant
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._load = self.DeclareVectorInputPort("stem_load", 6)
        stem = plant.GetJointByName("stem", physics.valve)
        self._stand = [plant.GetJointByName(r.joint).position_start() for r in physics.rails if r.joint == STAND]
        self._q, self._v = stem.position_start(), plant.num_positions() + stem.velocity_start()
        self._base = [plant.GetJointByName(j, physics.robot).position_start() for j in physics.base]
        self._place = physics.place
        self._bar_angle = valve.bar_angle
        self._X_WP = panel_pose(valve)
        marker = marker_frame(plant, physics.valve)
        self._turns = marker.body().name() == "wheel"
        X = marker.GetFixedPoseInBodyFrame()
        self._X_LinkMarker = make(X.rotation().matrix(), X.translation())
        for name, size in self.OUTPUTS.items():
            source = self._load if name == "stem_wrench" else self._state
            calc = getattr(self, f"_calc_{name}")
            self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc={source.ticket()})

    def _calc_valve_angle(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        output.SetFromVector([state[self._q] - self._bar_angle, state[self._v]])

    def _calc_base_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._state.Eval(context)[self._base] if self._base else self._place)

    def _calc_marker_pose(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        aside = np.array([state[self._stand].sum(), 0.0, 0.0])  # by which the stand was pushed
        turn = make(rotation(np.array([0, 0, -state[self._q] if self._turns else 0.0])), aside)
        output.SetFromVector(compose(self._X_WP, turn, self._X_LinkMarker).ravel())

    def _calc_stem_wrench(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._load.Eval(context))


def true_head(head: StereoHead, error: ErrorConfig, seed: int, frame: str) -> dict[str, Mount]:
    """The head cameras as they really are: the calibration plus the errors drawn from the seed.

    frame: of the robot's model, where the left one is mounted.
    """
    rng = _rng(seed, 4)
    mount = make(rotation(error.head_mount * rng.standard_normal(3)), np.zeros(3))
    wobble = error.head_rotation * rng.standard_normal(3)
    wobble[1] = error.head_yaw * rng.standard_normal()  # about y of the camera: relative yaw
    # Both cameras are mounted on the left camera's frame: the right one at X_LR of the calibration, with errors.
    right = compose(mount, head.X_LR, make(rotation(wobble), np.zeros(3)))
    return {
        "head_left": Mount(head.left, frame, mount),
        "head_right": Mount(head.right, frame, right),
    }


def wrist_lens(focal: float) -> Lens:
    """The wrist cameras' wide lens. No controller reads it: to them the wrist cameras are not calibrated."""
    return Lens(k_u=6e-7, k_v=6e-7, k_x=focal, k_y=focal, u_0=316.0, v_0=243.0)


def make_mounts(
    head: StereoHead, simulation: SimulationConfig, seed: int, frames: Mapping[str, str]
) -> dict[str, Mount]:
    """The cameras of the simulated robot, two or four. frames: of its model, as robot.yaml's `cameras` names them."""
    wrist = wrist_lens(simulation.camera.wrist_focal)
    return {
        **true_head(head, simulation.error, seed, frames["head_left"]),
        **{name: Mount(wrist, frames[name], np.eye(3, 4)) for side in SIDES if frames[name := f"{side}_wrist"]},
    }


def rig_arguments(
    simulation: SimulationConfig,
    shape: Valve,
    head: StereoHead,
    seed: int,
    robot: RobotDescription,
    place: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[Any, ...]:
    """The arguments of CameraRig, or of CameraWorkers, for the station's cameras. place: of a fixed base."""
    mounts = make_mounts(head, simulation, seed, robot.cameras)
    return mounts, simulation.valve, shape, simulation.light, simulation.camera, seed, robot, place


POSITIONS, BASE = "positions", "base"  # of the plant; of the base, with their rates: what the station measures inside


def _select(physics: PlantSystem, joints: Sequence[str], what: str) -> np.ndarray:
    """0/1 matrix that picks a "position", "velocity" or "torque" of each of these joints out of the plant's `now`."""
    plant, parts = physics.plant, physics.parts
    found = [plant.GetJointByName(name, physics.robot) for name in joints]
    if what == "position":
        columns = [parts["state"].start + joint.position_start() for joint in found]
    elif what == "velocity":
        columns = [parts["state"].start + plant.num_positions() + joint.velocity_start() for joint in found]
    else:
        columns = [parts["actuation"].start + physics.actuated.index(name) for name in joints]
    picked = np.zeros((len(joints), physics.size))
    picked[range(len(joints)), columns] = 1
    return picked


def _measured(
    builder: DiagramBuilder, now: OutputPort, rows: Mapping[str, tuple[np.ndarray, np.ndarray | float]]
) -> dict[str, OutputPort]:
    """A port for each of the rows: matrix @ `now` + offset. One system in C++ makes all: each costs at every event."""
    matrix = np.vstack([gain for gain, _ in rows.values()])
    offset = np.concatenate([np.broadcast_to(zero, len(gain)) for gain, zero in rows.values()])
    none, (n, m) = np.zeros((0, 0)), matrix.shape
    sensors = AffineSystem(none, np.zeros((0, m)), np.zeros(0), np.zeros((n, 0)), matrix, offset)
    builder.AddNamedSystem("sensors", sensors)
    builder.Connect(now, sensors.get_input_port())
    ends = dict(zip(rows, np.cumsum([len(gain) for gain, _ in rows.values()]).tolist()))
    parts = {name: slice(end - len(rows[name][0]), end) for name, end in ends.items()}
    return _demultiplexed(builder, "sensor_ports", sensors.get_output_port(), parts)


def _demultiplexed(
    builder: DiagramBuilder, name: str, port: OutputPort, parts: Mapping[str, slice]
) -> dict[str, OutputPort]:
    """A port for each part of a vector; the parts follow each other and are all of it."""
    split = builder.AddNamedSystem(name, Demultiplexer([part.stop - part.start for part in parts.values()]))
    builder.Connect(port, split.get_input_port(0))
    return {part: split.get_output_port(k) for k, part in enumerate(parts)}


@dc.dataclass(frozen=True, eq=False)
class RobotStart:
    """How a simulated robot begins: base (x, y, heading) in W, torso, and each arm as its encoders read it."""

    base: np.ndarray
    torso: np.ndarray
    arms: Mapping[str, np.ndarray]


def make_plant(
    simulation: SimulationConfig,
    shape: Valve,
    robot: Robot,
    seed: int,
    start: RobotStart | None = None,
) -> PlantSystem:
    """The station's plant. simulation: resolved (no distributions left). start: None: at home, where the simulation's
    `start` says."""
    valve = simulation.valve
    offsets = arm_offsets(simulation.error, seed, robot)
    if start is None:
        home = {side: arm.home for side, arm in robot.arms.items()}
        start = RobotStart(start_pose(simulation.start, valve), robot.torso.home, home)
    arms = {side: q - offsets[side] for side, q in start.arms.items()}  # the start is what the encoders read
    at_start = robot.named(base=start.base, torso=start.torso, arms=arms, opening=robot.opening)
    return PlantSystem(valve, shape, at_start, offsets, robot, start.base.tolist())


def _mishaps(
    builder: DiagramBuilder, simulation: SimulationConfig, physics: PlantSystem, now: OutputPort, robot: Robot
) -> dict[str, InputPort]:
    """Puts the mishaps before the plant -> the inputs that commands go to instead of the plant's, by name."""
    mishap, out = simulation.mishap, {}
    if mishap.grip_lost_at >= 0:
        lost = builder.AddSystem(LostGripSystem(mishap, simulation.valve.bar_angle, robot))
        stem = np.zeros((1, physics.size))
        stem[0, physics.plant.GetJointByName("stem", physics.valve).position_start()] = 1.0
        angle = builder.AddNamedSystem("stem_angle", MatrixGain(stem))
        builder.Connect(now, angle.get_input_port())
        builder.Connect(angle.get_output_port(), lost.GetInputPort("angle"))
        for port, command in (("position", "position_command"), ("force", "force_limit")):
            name = f"{mishap.grip_lost_hand}_gripper.{command}"
            builder.Connect(lost.GetOutputPort(command), physics.GetInputPort(name))
            out[name] = lost.GetInputPort(port)
    if mishap.wheel_slip_at >= 0 and not robot.drive.fixed:
        slip = builder.AddSystem(WheelSlipSystem(mishap, len(robot.drive.names)))
        builder.Connect(slip.GetOutputPort("twist_command"), physics.GetInputPort("base.twist_command"))
        out["base.twist_command"] = slip.GetInputPort("twist")
    return out


def make_simulated_station(
    simulation: SimulationConfig,
    shape: Valve,
    head: StereoHead,
    robot: Robot,
    seed: int,
    meshcat: Meshcat | None = None,
    workers: CameraWorkers | None = None,
    physics: PlantSystem | None = None,
) -> Diagram:
    """The station as a Diagram. simulation: resolved (no distributions left).

    workers: of `rig_arguments`, make the images; else they are made when they are read. physics: of `make_plant`, else
    it is made, the robot at home.
    """
    builder = DiagramBuilder()
    valve = simulation.valve
    offsets = arm_offsets(simulation.error, seed, robot)
    physics = builder.AddSystem(make_plant(simulation, shape, robot, seed) if physics is None else physics)
    plant, now = physics.plant, physics.GetOutputPort("now")
    part = _demultiplexed(builder, "plant_parts", now, physics.parts)
    done = _mishaps(builder, simulation, physics, now, robot)
    for name in COMMANDS:
        builder.ExportInput(done.get(name, physics.GetInputPort(name)), name)
    measured: dict[str, tuple[np.ndarray, np.ndarray | float]] = {
        POSITIONS: (np.eye(plant.num_positions(), physics.size), 0.0),
    }
    if len(robot.torso):
        measured["torso.position_measured"] = _select(physics, robot.torso.names, "position"), 0.0
    else:
        nothing = builder.AddNamedSystem("torso", ConstantVectorSource(np.zeros(0)))
        builder.ExportOutput(nothing.get_output_port(), "torso.position_measured")
    if not robot.drive.fixed:
        rows = [_select(physics, robot.base.names, what) for what in ("position", "velocity")]
        measured[BASE] = np.vstack(rows), 0.0
    for side in SIDES:
        joints = robot.arms[side].names
        measured[f"{side}_arm.position_measured"] = _select(physics, joints, "position"), offsets[side]
        measured[f"{side}_arm.velocity_measured"] = _select(physics, joints, "velocity"), 0.0
        measured[f"{side}_arm.torque_measured"] = _select(physics, joints, "torque"), 0.0
        builder.ExportOutput(part[f"{side}_opening"], f"{side}_gripper.position_measured")
        builder.ExportOutput(part[f"{side}_grip"], f"{side}_gripper.force_measured")
    ports = _measured(builder, now, measured)
    without = [side for side in SIDES if robot.feels_by_torque(side)]
    for side in without:
        name = f"{side}_arm.torque_measured"
        sensors = builder.AddSystem(TorqueSensorSystem(side, robot.description.arm(side), seed))
        builder.Connect(ports[name], sensors.GetInputPort("true"))
        ports[name] = sensors.GetOutputPort("torque")
    for name in measured.keys() - {POSITIONS, BASE}:
        builder.ExportOutput(ports[name], name)

    if robot.drive.fixed:
        still = builder.AddNamedSystem("odometry", ConstantVectorSource(np.zeros(len(POSE))))
        builder.ExportOutput(still.get_output_port(), "base.odometry")
    else:
        odometry = builder.AddSystem(OdometrySystem(simulation.error, seed, simulation.mishap, robot.drive))
        builder.Connect(ports[BASE], odometry.GetInputPort("base"))
        builder.ExportOutput(odometry.GetOutputPort("odometry"), "base.odometry")

    if with_sensor := [side for side in SIDES if side not in without]:
        wrench = builder.AddSystem(WrenchSensorSystem(simulation.error, seed, with_sensor))
        for side in with_sensor:
            builder.Connect(part[side], wrench.GetInputPort(f"{side}_load"))
            builder.ExportOutput(wrench.GetOutputPort(side), f"{side}_wrist.wrench")
    for name, port in add_torque_wrenches(robot, builder, ports).items():
        builder.ExportOutput(port, name)

    camera = simulation.camera
    place = physics.place
    images: Images = workers or RigWhenRead(*rig_arguments(simulation, shape, head, seed, robot.description, place))
    missing = [name for name in WRISTS if not robot.description.cameras[name]]
    for name in missing:  # its port never shows an image
        nothing = builder.AddNamedSystem(name, ConstantValueSource(Value(CameraFrame(camera=name))))
        builder.ExportOutput(nothing.get_output_port(), f"{name}.image")
    for name in [name for name in CAMERAS if name not in missing]:
        made = CameraSystem(name, plant.num_positions(), camera.period(name), camera.latency, images)
        system = builder.AddSystem(made)
        builder.Connect(ports[POSITIONS], system.GetInputPort("positions"))
        builder.ExportOutput(system.GetOutputPort("image"), f"{name}.image")

    health = builder.AddSystem(HealthSystem([*missing, *robot.groups.absent]))
    builder.ExportOutput(health.GetOutputPort("health"), "health")

    truth = builder.AddSystem(TruthSystem(physics, valve))
    builder.Connect(part["state"], truth.GetInputPort("state"))
    builder.Connect(part[STEM], truth.GetInputPort("stem_load"))
    for name in TruthSystem.OUTPUTS:
        builder.ExportOutput(truth.GetOutputPort(name), TRUTH + name)
    builder.ExportOutput(physics.GetOutputPort("contacts"), TRUTH + "contacts")

    if meshcat is not None:
        view = _add_view(builder, ports[POSITIONS], valve, shape, meshcat, robot.description, place)
        physics.view = view  # lives as long
    station = builder.Build()
    station.set_name("simulated")
    check_contract(station, robot.groups)
    return station


def _add_view(
    builder: DiagramBuilder,
    positions: OutputPort,
    valve: ValveConfig,
    shape: Valve,
    meshcat: Meshcat,
    robot: RobotDescription | None,
    place: Sequence[float],
) -> MultibodyPlant:
    """Shows the positions in a scene of its own, with all looks -> its plant, which must outlive the diagram."""
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant = MultibodyPlant(0.0)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_scene(plant, valve, shape, robot, place)
    plant.Finalize()
    poses = builder.AddNamedSystem("poses", MultibodyPositionToGeometryPose(plant))
    builder.Connect(positions, poses.get_input_port())
    builder.Connect(poses.get_output_port(), scene_graph.get_source_pose_port(plant.get_source_id()))
    params = MeshcatVisualizerParams(publish_period=1 / 16)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params).set_name("meshcat")
    return plant
