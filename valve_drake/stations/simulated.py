"""The simulated station: contact physics, joint servos, sensors and cameras behind the contract's ports.

Nothing is welded or moved by hand: the fingers hold the handles by friction and the valve turns by the hands' forces.
Joints are implicit PD servos with effort limits that get positions at 1/128 s, and gravity is fed forward from a model
of the robot alone. `truth.*` ports exist here only; the recorder alone reads them.
"""

import dataclasses as dc
import math
from typing import Annotated, Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, SceneGraph
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.controllers import InverseDynamics
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, DiscreteValues, LeafSystem
from pydrake.systems.primitives import AffineSystem, ConstantVectorSource, MatrixGain, Multiplexer

from valve_drake.camera.lens import Lens, StereoHead
from valve_drake.frames import compose, make, rotation
from valve_drake.messages import DEVICES, SIDES, Health
from valve_drake.ports import SLOT, TICK, Block, Inputs, Outputs
from valve_drake.stations.camera_rig import CameraRig, CameraSystem, Mount
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.contract import CAMERAS, CONTRACT, TRUTH, check_contract
from valve_drake.stations.scene import Scene, add_scene, panel_pose, parse, start_pose
from valve_drake.stations.simulation_config import ErrorConfig, SimulationConfig, ValveConfig

TORSO = ("waist", "neck_pitch", "neck_yaw")
BASE = ("base_x", "base_y", "base_yaw")
STEP = 2 * SLOT  # of the plant [s]; halving it leaves forces and angles as they are and doubles the work
FINGER_STIFFNESS = 2e4  # of the finger servo, as in the model file [N/m]


def arm_joints(side: str) -> list[str]:
    return [f"{side}_arm_{k}" for k in range(1, 7)]


class ServoDriver(LeafSystem):
    """Computes the set points of the base and of the fingers, which change at every step of the plant.

    The base's is the integral of its twist. A finger's is clipped about the measured position, so that the servo's
    stiffness times the difference never exceeds the gripper's force limit.
    Output (10,): q_d of base x, y, heading, left and right finger, then their v_d.
    """

    def __init__(self, fingers: list[int], states: int, start: np.ndarray):
        super().__init__()
        self.set_name("servo_driver")
        self._fingers = fingers
        self._twist = self.DeclareVectorInputPort("base.twist_command", 2)
        self._opening = [self.DeclareVectorInputPort(f"{side}_gripper.position_command", 1) for side in SIDES]
        self._limit = [self.DeclareVectorInputPort(f"{side}_gripper.force_limit", 1) for side in SIDES]
        self._state = self.DeclareVectorInputPort("plant_state", states)
        self._pose = self.DeclareDiscreteState(6)  # base set point x, y, heading; its time; forward, yaw rate
        self._start = start
        self.DeclareInitializationDiscreteUpdateEvent(self._begin)
        self.DeclarePeriodicDiscreteUpdateEvent(TICK, 3 * SLOT, self._integrate)
        self.DeclareVectorOutputPort("desired", 10, self._calc)

    def _begin(self, context: Context, state: DiscreteValues) -> None:
        state.set_value(int(self._pose), np.concatenate([self._start, np.zeros(3)]))

    def _now(self, context: Context) -> tuple[float, float, float, float, float]:
        """Base set point x, y, heading, and the twist that moves it."""
        x, y, h, t0, v, w = context.get_discrete_state(int(self._pose)).value()
        dt = context.get_time() - t0
        middle = h + w * dt / 2
        return x + v * dt * math.cos(middle), y + v * dt * math.sin(middle), h + w * dt, v, w

    def _integrate(self, context: Context, state: DiscreteValues) -> None:
        pose = self._now(context)[:3]
        state.set_value(int(self._pose), [*pose, context.get_time(), *self._twist.Eval(context)])

    def _calc(self, context: Context, output: BasicVector) -> None:
        x, y, h, v, w = self._now(context)
        state = self._state.Eval(context)
        fingers = []
        for k, slot in enumerate(self._fingers):
            q = state[slot]
            reach = self._limit[k].Eval(context)[0] / FINGER_STIFFNESS
            fingers.append(q + min(max(self._opening[k].Eval(context)[0] / 2 - q, -reach), reach))
        output.SetFromVector([x, y, h, *fingers, v * math.cos(h), v * math.sin(h), w, 0.0, 0.0])


def _affine(gain: np.ndarray, offset: np.ndarray) -> AffineSystem:
    """y = gain u + offset, in C++."""
    none, (n, m) = np.zeros((0, 0)), gain.shape
    return AffineSystem(none, np.zeros((0, m)), np.zeros(0), np.zeros((n, 0)), gain, offset)


def arm_offsets(error: ErrorConfig, seed: int) -> dict[str, np.ndarray]:
    """What each arm's encoders read at the joints' true zero: side -> (6,) [rad]."""
    draw = _rng(seed, 5).standard_normal((2, 6))
    return {side: error.arm_offset * draw[k] for k, side in enumerate(SIDES)}


def _add_servos(
    builder: DiagramBuilder, plant: MultibodyPlant, scene: Scene, start: np.ndarray, offsets: dict[str, np.ndarray]
) -> ServoDriver:
    """From the contract's commands to [q_d; v_d] of all actuators. Arms and torso get v_d = 0: they are sent positions.

    offsets: of `arm_offsets`; an arm goes to where its encoders read the command. All but the base and the fingers is
    C++, as it runs at every step of the plant.
    """
    actuated = [plant.get_joint_actuator(i).joint().name() for i in plant.GetJointActuatorIndices(scene.robot)]
    n = len(actuated)
    fingers = [f"{side}_finger_1" for side in SIDES]
    driver = builder.AddSystem(
        ServoDriver(
            [plant.GetJointByName(f, scene.robot).position_start() for f in fingers],
            plant.num_multibody_states(),
            start,
        )
    )
    arms = {f"{side}_arm.position_command": arm_joints(side) for side in SIDES}
    parts = {"torso.position_command": list(TORSO), **arms}
    joints = [joint for names in parts.values() for joint in names]
    every = Multiplexer([*(len(names) for names in parts.values()), 10])
    every.set_name("servo_targets")
    builder.AddSystem(every)
    order = np.zeros((2 * n, every.get_output_port().size()))
    for k, joint in enumerate(joints):
        order[actuated.index(joint), k] = 1
    for k, joint in enumerate([*BASE, *fingers]):
        order[actuated.index(joint), len(joints) + k] = 1
        order[n + actuated.index(joint), len(joints) + 5 + k] = 1
    zeros = np.zeros(order.shape[1])
    zeros[: len(joints)] = np.concatenate([np.zeros(len(TORSO)), *(offsets[side] for side in SIDES)])
    sort = builder.AddSystem(_affine(order, -order @ zeros))
    sort.set_name("servo_order")
    for k, port in enumerate(parts):
        builder.ExportInput(every.get_input_port(k), port)
    builder.Connect(driver.get_output_port(), every.get_input_port(len(parts)))
    builder.Connect(every.get_output_port(), sort.get_input_port())
    for spec in CONTRACT:
        if spec.direction == "in" and spec.name not in parts:
            builder.ExportInput(driver.GetInputPort(spec.name), spec.name)
    builder.Connect(plant.get_state_output_port(), driver.GetInputPort("plant_state"))
    builder.Connect(sort.get_output_port(), plant.get_desired_state_input_port(scene.robot))
    return driver


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
    odometry  out  vector(5)  m, rad, m/s, rad/s  x, y, heading, forward, yaw rate
    """

    OUTPUTS = {"odometry": 5}

    def __init__(self, error: ErrorConfig, seed: int):
        self._error = error
        self._noise = _Noise(seed, 1, 2)
        self._scale = 1 + error.odometry_scale * _rng(seed, 0).standard_normal(2)
        super().__init__("odometry", slot=3)

    def initial(self) -> tuple[np.ndarray, int]:
        return np.zeros(5), 0

    def step(
        self, time: float, inputs: OdometryInputs, memory: tuple[np.ndarray, int]
    ) -> tuple[tuple[np.ndarray, int], Outputs]:
        (x, y, h, _, _), count = memory
        _, _, heading, vx, vy, w = inputs.base
        forward = vx * np.cos(heading) + vy * np.sin(heading)
        noise = 1 + self._error.odometry_noise * self._noise(count)
        forward, w = np.array([forward, w]) * self._scale * noise
        middle = h + w * TICK / 2
        new = np.array(
            [x + forward * TICK * np.cos(middle), y + forward * TICK * np.sin(middle), h + w * TICK, forward, w]
        )
        return (new, count + 1), {"odometry": new}


class WrenchSensorInputs(Inputs):
    reaction_forces: Annotated[list[SpatialForce], Value[list[SpatialForce]]()]


class WrenchSensorSystem(Block[WrenchSensorInputs, int]):
    """Both wrist force-torque sensors: load felt by the sensor, in its frame, with bias and noise.

    port             dir  type                notes
    ---------------  ---  ------------------  -------------------------------------
    reaction_forces  in   list[SpatialForce]  of the plant, by joint
    left, right      out  vector(6)           [torque; force] [N m, N]
    """

    OUTPUTS = {side: 6 for side in SIDES}

    def __init__(self, joints: dict[str, int], error: ErrorConfig, seed: int):
        self._joints = joints
        self._noise = _Noise(seed, 3, 12)
        torque, force = np.ones(3), np.ones(3)
        self._scatter = np.concatenate([error.wrench_noise_torque * torque, error.wrench_noise_force * force])
        bias = np.concatenate([error.wrench_bias_torque * torque, error.wrench_bias_force * force])
        draw = _rng(seed, 2).standard_normal((2, 6))
        self._bias = {side: bias * draw[k] for k, side in enumerate(SIDES)}
        super().__init__("wrench_sensor", slot=3)

    def initial(self) -> int:
        return 0

    def step(self, time: float, inputs: WrenchSensorInputs, memory: int) -> tuple[int, Outputs]:
        forces = inputs.reaction_forces
        draw = self._noise(memory).reshape(2, 6)
        out = {}
        for k, side in enumerate(SIDES):
            F = forces[self._joints[side]]  # on the hand, from the arm; the sensor feels the opposite
            felt = -np.concatenate([F.rotational(), F.translational()])
            out[side] = felt + self._bias[side] + self._scatter * draw[k]
        return memory + 1, out


class HealthSystem(Block[Inputs, None]):
    """Reports that all devices work and were heard just now: the simulated machine has no faults of its own."""

    OUTPUTS = {"health": Health}
    DEVICES = tuple(device for device in DEVICES if device != "robot")

    def __init__(self) -> None:
        super().__init__("health", period=1 / 32, slot=0)

    def step(self, time: float, inputs: Inputs, memory: None) -> tuple[None, Outputs]:
        return None, {"health": Health(time=time, devices=self.DEVICES, ages=np.zeros(len(self.DEVICES)))}


class TruthSystem(LeafSystem):
    """What only a simulation knows, for the recorder and the metrics; the state is that of the instant it is read.

    port             dir  type                notes
    ---------------  ---  ------------------  ------------------------------------------------------
    state            in   vector              of the whole plant
    reaction_forces  in   list[SpatialForce]  of the plant's last step
    valve_angle      out  vector(2)           opened since closed [rad], and its rate [rad/s]
    base_pose        out  vector(3)           x, y, heading in W
    marker_pose      out  vector(12)          X_WV, rows of (3, 4)
    stem_wrench      out  vector(6)           on the valve from its bearing, in the stem's frame
    """

    OUTPUTS = {"valve_angle": 2, "base_pose": 3, "marker_pose": 12, "stem_wrench": 6}

    def __init__(self, plant: MultibodyPlant, scene: Scene, valve: ValveConfig):
        super().__init__()
        self.set_name("truth")
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._forces = self.DeclareAbstractInputPort("reaction_forces", Value[list[SpatialForce]]())
        stem = plant.GetJointByName("stem", scene.valve)
        self._stem = int(stem.index())
        self._q, self._v = stem.position_start(), plant.num_positions() + stem.velocity_start()
        self._base = [plant.GetJointByName(j, scene.robot).position_start() for j in BASE]
        self._bar_angle = valve.bar_angle
        self._X_WP = panel_pose(valve)
        X = plant.GetFrameByName("marker", scene.valve).GetFixedPoseInBodyFrame()
        self._X_LinkMarker = make(X.rotation().matrix(), X.translation())
        for name, size in self.OUTPUTS.items():
            source = self._forces if name == "stem_wrench" else self._state
            calc = getattr(self, f"_calc_{name}")
            self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc={source.ticket()})

    def _calc_valve_angle(self, context: Context, output: BasicVector) -> None:
        state = self._state.Eval(context)
        output.SetFromVector([state[self._q] - self._bar_angle, state[self._v]])

    def _calc_base_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._state.Eval(context)[self._base])

    def _calc_marker_pose(self, context: Context, output: BasicVector) -> None:
        turn = make(rotation(np.array([0, 0, -self._state.Eval(context)[self._q]])), np.zeros(3))
        output.SetFromVector(compose(self._X_WP, turn, self._X_LinkMarker).ravel())

    def _calc_stem_wrench(self, context: Context, output: BasicVector) -> None:
        forces = self._forces.Eval(context)
        if len(forces) > self._stem:  # none before the first step
            F = forces[self._stem]
            output.SetFromVector(np.concatenate([F.rotational(), F.translational()]))


def true_head(head: StereoHead, error: ErrorConfig, seed: int) -> dict[str, Mount]:
    """The head cameras as they really are: the calibration plus the errors drawn from the seed."""
    rng = _rng(seed, 4)
    mount = make(rotation(error.head_mount * rng.standard_normal(3)), np.zeros(3))
    wobble = error.head_rotation * rng.standard_normal(3)
    wobble[1] = error.head_yaw * rng.standard_normal()  # about y of the camera: relative yaw
    # Both cameras are mounted on the left camera's frame: the right one at X_LR of the calibration, with errors.
    right = compose(mount, head.X_LR, make(rotation(wobble), np.zeros(3)))
    return {
        "head_left": Mount(head.left, "head_left_camera", mount),
        "head_right": Mount(head.right, "head_left_camera", right),
    }


def wrist_lens(focal: float) -> Lens:
    """The wrist cameras' wide lens. No controller reads it: to them the wrist cameras are not calibrated."""
    return Lens(k_u=6e-7, k_v=6e-7, k_x=focal, k_y=focal, u_0=316.0, v_0=243.0)


def make_mounts(head: StereoHead, simulation: SimulationConfig, seed: int) -> dict[str, Mount]:
    """All four cameras of the simulated robot."""
    wrist = wrist_lens(simulation.camera.wrist_focal)
    return {
        **true_head(head, simulation.error, seed),
        **{f"{side}_wrist": Mount(wrist, f"{side}_wrist_camera", np.eye(3, 4)) for side in SIDES},
    }


def rig_arguments(
    simulation: SimulationConfig, marker_size: tuple[float, float], head: StereoHead, seed: int
) -> tuple[Any, ...]:
    """The arguments of CameraRig, or of CameraWorkers, for the station's cameras."""
    mounts = make_mounts(head, simulation, seed)
    return mounts, simulation.valve, marker_size, simulation.light, simulation.camera, seed


@dc.dataclass(frozen=True)
class Joints:
    """Indices of joints in the plant's state and actuation."""

    plant: MultibodyPlant
    scene: Scene

    def select(self, names: list[str], what: str) -> np.ndarray:
        """0/1 matrix that picks these joints out of state ("position", "velocity") or net actuation ("torque")."""
        if what == "torque":
            order = [
                self.plant.get_joint_actuator(i).joint().name()
                for i in self.plant.GetJointActuatorIndices(self.scene.robot)
            ]
            columns, width = [order.index(n) for n in names], len(order)
        else:
            joints = [self.plant.GetJointByName(n, self.scene.robot) for n in names]
            width = self.plant.num_multibody_states()
            if what == "position":
                columns = [j.position_start() for j in joints]
            else:
                columns = [self.plant.num_positions() + j.velocity_start() for j in joints]
        D = np.zeros((len(names), width))
        D[range(len(names)), columns] = 1
        return D


def make_simulated_station(
    simulation: SimulationConfig,
    marker_size: tuple[float, float],
    head: StereoHead,
    home: np.ndarray,
    opening: float,
    seed: int,
    meshcat: Meshcat | None = None,
    workers: CameraWorkers | None = None,
) -> Diagram:
    """The station as a Diagram. simulation: resolved (no distributions left); home: both arms (12,) [rad].

    workers: of `rig_arguments`, make the images; else they are made when they are read.
    """
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=STEP, discrete_contact_approximation="lagged", contact_model="point", stiction_tolerance=1e-4
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    plant.set_name("plant")
    scene_graph.set_name("scene_graph")
    valve = simulation.valve
    scene = add_scene(plant, valve, marker_size)
    plant.Finalize()
    if meshcat is None:
        _leave_out_looks(plant, scene_graph)
    start = start_pose(simulation.start, valve)
    offsets = arm_offsets(simulation.error, seed)
    arms = home - np.concatenate([offsets[side] for side in SIDES])  # home is what the encoders read
    _set_start(plant, scene, simulation, start, arms, opening)
    joints = Joints(plant, scene)

    driver = _add_servos(builder, plant, scene, start, offsets)
    still = builder.AddSystem(ConstantVectorSource(np.zeros(2)))
    still.set_name("valve_at_rest")
    builder.Connect(still.get_output_port(), plant.get_desired_state_input_port(scene.valve))

    model = MultibodyPlant(STEP)
    parse(model, "robot")
    model.Finalize()
    gravity = builder.AddSystem(InverseDynamics(model, InverseDynamics.InverseDynamicsMode.kGravityCompensation))
    gravity.set_name("gravity_compensation")
    driver.keep_alive = model  # InverseDynamics refers to it; a Python block lives as long as the diagram
    builder.Connect(plant.get_state_output_port(scene.robot), gravity.get_input_port_estimated_state())
    actuation = builder.AddSystem(MatrixGain(model.MakeActuationMatrix().T))
    actuation.set_name("gravity_torques")
    builder.Connect(gravity.get_output_port_generalized_force(), actuation.get_input_port())
    builder.Connect(actuation.get_output_port(), plant.get_actuation_input_port(scene.robot))

    def measure(port: str, names: list[str], what: str, factor: float = 1.0, offset: np.ndarray | None = None) -> None:
        matrix = factor * joints.select(names, what)
        gain = builder.AddSystem(MatrixGain(matrix) if offset is None else _affine(matrix, offset))
        gain.set_name(port)
        torque = what == "torque"
        source = plant.get_net_actuation_output_port(scene.robot) if torque else plant.get_state_output_port()
        builder.Connect(source, gain.get_input_port())
        builder.ExportOutput(gain.get_output_port(), port)

    measure("torso.position_measured", list(TORSO), "position")
    for side in SIDES:
        measure(f"{side}_arm.position_measured", arm_joints(side), "position", offset=offsets[side])
        measure(f"{side}_arm.velocity_measured", arm_joints(side), "velocity")
        measure(f"{side}_arm.torque_measured", arm_joints(side), "torque")
        measure(f"{side}_gripper.position_measured", [f"{side}_finger_1"], "position", 2.0)
        measure(f"{side}_gripper.force_measured", [f"{side}_finger_1"], "torque", -1.0)

    base = builder.AddSystem(
        MatrixGain(np.vstack([joints.select(list(BASE), "position"), joints.select(list(BASE), "velocity")]))
    )
    base.set_name("base_state")
    builder.Connect(plant.get_state_output_port(), base.get_input_port())
    odometry = builder.AddSystem(OdometrySystem(simulation.error, seed))
    builder.Connect(base.get_output_port(), odometry.GetInputPort("base"))
    builder.ExportOutput(odometry.GetOutputPort("odometry"), "base.odometry")

    sensors = {side: int(plant.GetJointByName(f"{side}_wrist_sensor", scene.robot).index()) for side in SIDES}
    wrench = builder.AddSystem(WrenchSensorSystem(sensors, simulation.error, seed))
    builder.Connect(plant.get_reaction_forces_output_port(), wrench.GetInputPort("reaction_forces"))
    for side in SIDES:
        builder.ExportOutput(wrench.GetOutputPort(side), f"{side}_wrist.wrench")

    camera = simulation.camera
    images = CameraRig(*rig_arguments(simulation, marker_size, head, seed)) if workers is None else workers
    positions = builder.AddSystem(MatrixGain(np.eye(plant.num_positions(), plant.num_multibody_states())))
    positions.set_name("positions")
    builder.Connect(plant.get_state_output_port(), positions.get_input_port())
    for name in CAMERAS:
        period = camera.head_period if name.startswith("head") else camera.wrist_period
        system = builder.AddSystem(CameraSystem(name, plant.num_positions(), period, camera.latency, images))
        builder.Connect(positions.get_output_port(), system.GetInputPort("positions"))
        builder.ExportOutput(system.GetOutputPort("image"), f"{name}.image")

    health = builder.AddSystem(HealthSystem())
    builder.ExportOutput(health.GetOutputPort("health"), "health")

    truth = builder.AddSystem(TruthSystem(plant, scene, valve))
    builder.Connect(plant.get_state_output_port(), truth.GetInputPort("state"))
    builder.Connect(plant.get_reaction_forces_output_port(), truth.GetInputPort("reaction_forces"))
    for name in TruthSystem.OUTPUTS:
        builder.ExportOutput(truth.GetOutputPort(name), TRUTH + name)

    if meshcat is not None:
        params = MeshcatVisualizerParams(publish_period=1 / 16)
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, params).set_name("meshcat")
    station = builder.Build()
    station.set_name("simulated")
    check_contract(station)
    return station


def _leave_out_looks(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Removes the visual geometry: it would cost time at every step, and the cameras render a scene of their own."""
    inspector = scene_graph.model_inspector()
    source = plant.get_source_id()
    assert source is not None
    for id in inspector.GetAllGeometryIds():
        if inspector.GetProximityProperties(id) is None and inspector.BelongsToSource(id, source):
            scene_graph.RemoveGeometry(source, id)


def _set_start(
    plant: MultibodyPlant,
    scene: Scene,
    simulation: SimulationConfig,
    start: np.ndarray,
    arms: np.ndarray,
    opening: float,
) -> None:
    """Default positions of all joints: where the run begins. arms: true angles of both (12,) [rad]."""
    values = dict(zip(BASE, start))
    for k, side in enumerate(SIDES):
        values |= dict(zip(arm_joints(side), arms[6 * k : 6 * k + 6]))
        values |= {f"{side}_finger_{finger}": opening / 2 for finger in (1, 2)}
    for name, value in values.items():
        plant.GetJointByName(name, scene.robot).set_default_positions([value])
    valve = simulation.valve
    plant.GetJointByName("stem", scene.valve).set_default_positions([valve.bar_angle + max(valve.position, 0.0)])
