"""System `plant` of the simulated station: robot, valve and room as a MultibodyPlant, with the joints' servos.

The MultibodyPlant, its SceneGraph and all that works at each of its steps form a Diagram of their own, in C++.
`PlantSystem` takes that diagram through one control tick at a time, so that no other system is woken at a plant's
step. Whatever the plant keeps from one tick to the next is state of the PlantSystem; the Context of the inner diagram
is scratch paper, written from that state before every step. A Context of the station can therefore be cloned, saved,
restored and advanced again to the same bits.
"""

import contextlib
import itertools
import math
import threading
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    FixedInputPortValue,
    State,
)
from pydrake.systems.primitives import ConstantVectorSource

from valve_drake import profiling
from valve_drake.beside import Beside
from valve_drake.frames import inverse
from valve_drake.messages import SIDES
from valve_drake.ports import SLOT, TICK, PythonSystem
from valve_drake.robot.drive import whole
from valve_drake.robot.groups import GROUPS
from valve_drake.robot.robot import Robot
from valve_drake.stations import contacts
from valve_drake.stations.contract import CONTRACT, vectors
from valve_drake.stations.rails import rails
from valve_drake.stations.scene import add_scene
from valve_drake.stations.servos import add_servos, ignore_touching
from valve_drake.stations.simulation_config import ValveConfig
from valve_drake.valve.valve import Valve

STEPS = 2  # of the plant in a tick; twice as many leave forces and angles as they are and double the work
COMMANDS = tuple(spec.name for spec in CONTRACT if spec.direction == "in")
STEM = "stem"  # the valve's joint, and the output port of its load


_Pose = tuple[float, float, float]  # x, y, heading [m, rad]
_Twist = tuple[float, float, float]  # forward, sideways, yaw rate [m/s, rad/s]


class PlantSystem(PythonSystem):
    """Advances the plant once a tick, in slot 2, by the commands of the tick before.

    port                             dir  type       notes
    -------------------------------  ---  ---------  ---------------------------------------------------------------
    (the station's inputs)           in   vector     as in stations/contract.py
    now                              out  vector     all of the state, in parts: `parts` has the slice of each
      of it: state                        vector     positions and velocities of `plant`
      base                                vector(3)  the base's set point x, y, heading, or where it is bolted [m, rad]
      actuation                           vector     of the robot's actuators in the last step, by index [N m, N]
      left, right, stem                   vector(6)  [torque; force] of the joint on its child in the last step, in
                                                     the child's frame: the wrist sensors, of hands that have one,
                                                     and the valve's stem
      left_opening, right_opening         vector(1)  between the pads [m]
      left_grip, right_grip               vector(1)  force of the finger actuator that closes, in the last step [N]
    contacts                         out  Contacts   what touched what in the last step, a look every 1/16 s

    Slot 2 of tick k finds the commands of tick k - 1 at its ports, since command_selector replaces them at the same
    instant, and makes the state of t_(k+1) from that of t_k. So a command of tick k moves the joints from t_(k+1) on,
    and the ports show the state of t_(k+1) from slot 2 of tick k to slot 2 of tick k + 1. That is the present state
    for whoever reads in slot 0 or 1 (cameras, truth, robot_state); wrist sensors and odometry read it in slot 3 for
    robot_state to find at t_(k+1).

    What a tick does to the plant depends on its state and those commands alone, which are known when slot 2 of the tick
    before is over. While `beside` is open, slot 3 hands both to a copy of the process, and slot 2 of the next tick
    fetches the same bits that it would compute: robot_state, the behaviours and the recorder work meanwhile.

    Servos: joints are implicit PD servos with effort limits. Arms and torso are sent positions, with v_d = 0. The
    base's set point is the integral of its twist. A finger's is clipped about its position at each step, so that the
    servo's stiffness times the difference never exceeds the gripper's force limit. Gravity is fed forward, once a tick.

    plant, scene_graph, robot, valve: the MultibodyPlant, its geometry, its model instances; `plant_context` makes a
    Context for them. They belong to `diagram`, which nobody else advances. actuated: the robot's joints with an
    actuator, in the order of `actuation`.
    """

    def __init__(
        self,
        valve: ValveConfig,
        shape: Valve,
        start: Mapping[str, float],
        offsets: Mapping[str, np.ndarray],
        robot: Robot,
        place: Sequence[float] = (0.0, 0.0, 0.0),
    ):
        """start: joint of the robot -> where it is at first [m, rad]; offsets: side -> what the arm's encoders read at
        the joints' true zero (n,) [rad]: an arm goes to where its encoders read the command. place: of a fixed base,
        x, y, heading."""
        super().__init__()
        self.set_name("plant")
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=TICK / STEPS,
            discrete_contact_approximation="lagged",
            contact_model="point",
            stiction_tolerance=1e-4,
            use_sampled_output_ports=False,  # `_advance` reads its outputs at the last step itself
        )
        self.plant, self.scene_graph = AddMultibodyPlant(config, builder)
        self.plant.set_name("plant")
        self.scene_graph.set_name("scene_graph")
        scene = add_scene(self.plant, valve, shape, robot.description, place)
        self.robot, self.valve = scene.robot, scene.valve
        add_servos(self.plant, self.robot, robot)
        self.plant.Finalize()
        ignore_touching(self.plant, self.scene_graph, self.robot, robot)
        _leave_out_looks(self.plant, self.scene_graph)
        for name, value in start.items():
            self.plant.GetJointByName(name, self.robot).set_default_positions([value])
        stem = self.plant.GetJointByName("stem", self.valve)
        self._valve = valve
        self._friction = self.plant.GetJointActuatorByName(STEM, self.valve)
        stem.set_default_positions([valve.bar_angle + shape.sense * max(valve.position, 0.0)])
        still = builder.AddNamedSystem("valve_at_rest", ConstantVectorSource(np.zeros(2)))
        builder.Connect(still.get_output_port(), self.plant.get_desired_state_input_port(self.valve))
        builder.ExportInput(self.plant.get_desired_state_input_port(self.robot), "desired")
        self.rails = rails(self.plant, valve, shape)
        for rail in self.rails:
            builder.ExportInput(self.plant.get_desired_state_input_port(rail.model), rail.joint)
        builder.ExportInput(self.plant.get_actuation_input_port(self.robot), "feed_forward")
        self.diagram: Diagram = builder.Build()
        self.diagram.set_name("plant_with_servos")

        self._stem = stem.position_start()
        joints = [self.plant.get_joint_actuator(i).joint() for i in self.plant.GetJointActuatorIndices(self.robot)]
        self.actuated = order = [joint.name() for joint in joints]
        fingers = [robot.grippers[side].joint for side in SIDES]
        self._sent = [order.index(j) for names in map(robot.groups.names, GROUPS) for j in names]
        self._zeros = np.concatenate([np.zeros(len(robot.torso)), *(offsets[side] for side in SIDES)])
        self.base, self.place = robot.base.names, tuple(place)
        self._base_at = [order.index(name) for name in self.base]
        self._fingers = [(order.index(name), joints[order.index(name)].position_start()) for name in fingers]
        self._actuated_at = [joint.velocity_start() for joint in joints]
        self._grippers = [robot.grippers[side] for side in SIDES]
        gains = [self.plant.GetJointActuatorByName(name, self.robot).get_controller_gains() for name in fingers]
        self._stiffness = [gain.p for gain in gains]

        sizes = vectors(robot.groups, "in")
        self._inputs = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
        self._reads = [port.Eval for port in self._inputs.values()]
        self._scratch = self.diagram.CreateDefaultContext()
        self._lock = threading.Lock()  # of the scratch: two threads may advance two Contexts
        self._inner = self.plant.GetMyMutableContextFromRoot(self._scratch)
        self._after = self.plant.AllocateDiscreteVariables()
        desired = np.zeros(2 * len(joints))  # [q_d; v_d] of the robot's actuators
        self._fixed_desired, self._desired = self._fix("desired", desired)
        self._fixed_feed_forward, self._feed_forward = self._fix("feed_forward", np.zeros(len(joints)))
        self._driven_rails = [(rail, *self._fix(rail.joint, np.zeros(2))) for rail in self.rails]
        self._rails_at = [self.plant.GetJointByName(rail.joint).position_start() for rail in self.rails]
        self._axis = (self.plant.GetFrameByName("valve_axis", self.valve), inverse(shape.X_AP())[:, 3])
        self._hands = [self.plant.GetFrameByName(f"{side}_grip", self.robot) for side in SIDES]
        self._net_actuation = self.plant.get_net_actuation_output_port(self.robot)
        self._reaction_forces = self.plant.get_reaction_forces_output_port()
        self._contact_results = self.plant.get_contact_results_output_port()
        self._reader = contacts.ContactReader(self.plant, self.robot, self.valve, robot)
        sensed = {side: robot.description.arm(side).sensor for side in SIDES if not robot.feels_by_torque(side)}
        loaded = sensed | {STEM: STEM}  # output port -> joint
        present = list(self.plant.GetJointIndices())  # a welded joint has left its index unused
        self._loads = [present.index(self.plant.GetJointByName(name).index()) for name in loaded.values()]
        x = self.plant.GetPositionsAndVelocities(self._inner)
        base = [start[name] for name in self.base] or list(place)
        grips = [f"{side}_{what}" for side in SIDES for what in ("opening", "grip")]
        counts = {"state": len(x), "base": len(base), "actuation": len(joints)}
        counts |= {**dict.fromkeys(loaded, 6), **dict.fromkeys(grips, 1)}
        ends = list(itertools.accumulate(counts.values()))
        self.parts = {name: slice(end - counts[name], end) for name, end in zip(counts, ends)}  # of port `now`
        self.size = ends[-1]  # of it
        still = [np.zeros(ends[-1] - ends[1] - len(grips)), self._measured_grips(x, np.zeros(len(joints)))]
        self._now = self.DeclareDiscreteState(np.concatenate([x, base, *still]))
        self.DeclareStateOutputPort("now", self._now)
        self._contacts = self.DeclareAbstractState(Value(contacts.NONE))
        self.DeclareStateOutputPort("contacts", self._contacts)
        self._kept = ends[1]  # how much of it the next tick depends on
        self._ends = list(itertools.accumulate([self._kept, 1, *sizes.values()]))  # of the parts of a question
        self._beside: Beside | None = None
        self.DeclarePeriodicUnrestrictedUpdateEvent(TICK, 2 * SLOT, self._update)
        self.DeclarePeriodicPublishEvent(TICK, 3 * SLOT, self._begin)

    def plant_context(self, root: Context) -> Context:
        """A new Context of `plant` with the positions, velocities and commands that `root` holds, for any question to
        the plant or the geometry in it; changing it changes nothing else. root: of the station, or of a diagram that
        it is in. Outputs that depend on forces are those of the step to come.
        """
        context = self.GetMyContextFromRoot(root)
        now = context.get_discrete_state(self._now).value()
        x, base = now[self.parts["state"]], now[self.parts["base"]]
        inner = self.diagram.CreateDefaultContext()
        inner.SetTime(context.get_time())
        plant_context = self.plant.GetMyMutableContextFromRoot(inner)
        self.plant.SetPositionsAndVelocities(plant_context, x)
        commands, desired = self._commands(context), np.zeros(len(self._desired))
        self._set_joints(desired, commands)
        self._set_base(desired, tuple(base.tolist()), whole(commands["base.twist_command"]), 0.0)
        self._set_fingers(desired, x, self._grips(x, commands))
        self.diagram.GetInputPort("desired").FixValue(inner, desired)
        self.diagram.GetInputPort("feed_forward").FixValue(inner, self._gravity(plant_context))
        for rail, goal in zip(self.rails, self._rail_goals(plant_context, x)):
            self.diagram.GetInputPort(rail.joint).FixValue(inner, goal)
        return plant_context

    def _fix(self, name: str, value: np.ndarray) -> tuple[FixedInputPortValue, np.ndarray]:
        """Fixes an input of the scratch -> what tells the Context of a change, the memory to write it into."""
        fixed = self.diagram.GetInputPort(name).FixValue(self._scratch, value)
        return fixed, fixed.GetMutableData().get_mutable_value().get_mutable_value()

    def _gravity(self, plant_context: Context) -> np.ndarray:
        """What the robot's actuators do to bear its weight (n,) [N m, N]."""
        return -self.plant.CalcGravityGeneralizedForces(plant_context)[self._actuated_at]

    def _grips(self, x: np.ndarray, commands: dict[str, np.ndarray]) -> list[tuple[float, float]]:
        """Of each hand: where its finger is sent, how far from where it is the servo may pull it [rad or m].

        x: of the plant, now. A force limit is that of the finger actuator; the joint's effort follows by the lever.
        """
        out = []
        for side, gripper, (_, at), stiffness in zip(SIDES, self._grippers, self._fingers, self._stiffness):
            opening = float(commands[f"{side}_gripper.position_command"][0])
            effort = float(commands[f"{side}_gripper.force_limit"][0]) * abs(gripper.lever(float(x[at])))
            out.append((gripper.position(opening), effort / stiffness))
        return out

    def _measured_grips(self, x: np.ndarray, actuation: np.ndarray) -> np.ndarray:
        """Of each hand: opening [m], force of the finger actuator that closes [N] -> (4,)."""
        out: list[float] = []
        for gripper, (actuated, at) in zip(self._grippers, self._fingers):
            q = float(x[at])
            out += [gripper.opening(q), -float(actuation[actuated]) / gripper.lever(q)]
        return np.array(out)

    def _commands(self, context: Context) -> dict[str, np.ndarray]:
        return {name: port.Eval(context) for name, port in self._inputs.items()}

    def _set_joints(self, desired: np.ndarray, commands: dict[str, np.ndarray]) -> None:
        """Arms and torso in [q_d; v_d] of the robot's actuators: the same throughout a tick."""
        sent = [commands["torso.position_command"], *(commands[f"{side}_arm.position_command"] for side in SIDES)]
        desired[self._sent] = np.concatenate(sent) - self._zeros

    def _set_base(self, desired: np.ndarray, base: _Pose, twist: _Twist, time: float) -> None:
        """The base in `desired`, `time` after the tick's begin; base: its set point then."""
        forward, sideways, yaw_rate = twist
        pose = _driven(base, twist, time)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        speed = (forward * c - sideways * s, forward * s + sideways * c, yaw_rate)
        n = len(self.actuated)
        for at, q, v in zip(self._base_at, pose, speed):
            desired[at], desired[n + at] = q, v

    def _rail_goals(self, plant_context: Context, x: np.ndarray) -> list[tuple[float, float]]:
        """Where each rail is sent in the next step, and how fast; x: of the plant, now."""
        if not self.rails:
            return []
        frame, p_axis = self._axis
        places = [self.plant.CalcPointsPositions(plant_context, hand, np.zeros(3), frame) for hand in self._hands]
        distance = min(float(np.linalg.norm(place.ravel() - p_axis)) for place in places)
        return [r.desired(float(x[at]), distance, TICK / STEPS) for r, at in zip(self.rails, self._rails_at)]

    def _set_friction(self, x: np.ndarray) -> None:
        """Of a valve that stiffens while it opens."""
        valve = self._valve
        if valve.friction_open >= 0 and not valve.seized:
            way = min(abs(float(x[self._stem]) - valve.bar_angle) / valve.travel, 1.0)
            friction = valve.friction + way * (valve.friction_open - valve.friction)
            self._friction.set_effort_limit(max(friction, 1e-6))

    def _set_fingers(self, desired: np.ndarray, x: np.ndarray, grips: list[tuple[float, float]]) -> None:
        """The fingers in `desired`; x: now; grips: of each hand where its finger is sent and how far from where it is
        the servo may pull it [m]."""
        for (at, position), (goal, reach) in zip(self._fingers, grips):
            q = float(x[position])
            desired[at] = q + min(max(goal - q, -reach), reach)

    @contextlib.contextmanager
    def beside(self) -> Iterator[Beside]:
        """While open, the plant is advanced beside the blocks, in a copy of this process where one can be made."""
        with Beside(self._advance, self._ends[-1], self.size + contacts.SIZE) as self._beside:
            try:
                yield self._beside
            finally:
                self._beside = None

    def _question(self, context: Context) -> np.ndarray:
        """All that the next tick depends on: x, the base's set point, whether contacts are looked at, the commands."""
        now = context.get_discrete_state(self._now).value()[: self._kept]
        return np.concatenate([now, [float(self._looks(context))], *[read(context) for read in self._reads]])

    @staticmethod
    def _looks(context: Context) -> bool:
        """Whether the recorder wants the contacts of the state to come; asked in slot 2, or in slot 3 before."""
        return _made(context) % contacts.EVERY == 0

    def _begin(self, context: Context) -> None:
        if self._beside is not None:
            with profiling.work(profiling.PLANT):
                self._beside.begin(self._question(context))

    def _update(self, context: Context, state: State) -> None:
        with profiling.work(profiling.PLANT):
            question = self._question(context)
            answer = self._advance(question) if self._beside is None else self._beside.answer(question)
        state.get_mutable_discrete_state().set_value(self._now, answer[: self.size])
        if self._looks(context):
            kept = state.get_mutable_abstract_state().get_mutable_value(self._contacts)
            kept.set_value(self._reader.message(answer[self.size :], _made(context) * TICK, kept.get_value()))

    def _advance(self, question: np.ndarray) -> np.ndarray:
        """One tick -> all of the state after it, and contacts. It depends on the question alone."""
        kept, look, *commands = (question[a:b] for a, b in itertools.pairwise((0, *self._ends)))
        x, base = kept[self.parts["state"]], kept[self.parts["base"]]
        with self._lock:
            return np.concatenate(self._step(x, base, bool(look[0]), dict(zip(self._inputs, commands))))

    def _step(
        self, x: np.ndarray, base: np.ndarray, look: bool, commands: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        scratch, desired = self._scratch, self._desired
        start: _Pose = tuple(base.tolist())
        twist = whole(commands["base.twist_command"])
        grips = self._grips(x, commands)
        scratch.SetDiscreteState(x)
        self._set_friction(x)
        self._fixed_feed_forward.GetMutableData()  # tells the Context that the memory of `_feed_forward` changes
        self._feed_forward[:] = self._gravity(self._inner)
        for k in range(STEPS):
            self._fixed_desired.GetMutableData()  # as that of `_desired` does
            if k == 0:
                self._set_joints(desired, commands)
            self._set_base(desired, start, twist, k * TICK / STEPS)
            self._set_fingers(desired, x, grips)
            for (_, fixed, kept), goal in zip(self._driven_rails, self._rail_goals(self._inner, x)):
                fixed.GetMutableData()
                kept[:] = goal
            self.plant.CalcForcedDiscreteVariableUpdate(self._inner, self._after)
            x = self._after.value(0)
            if k < STEPS - 1:
                scratch.SetDiscreteState(x)
        # The last step is not taken in the scratch, so what the outputs need of it is in the cache.
        actuation = self._net_actuation.Eval(self._inner)
        forces = self._reaction_forces.Eval(self._inner)
        loads = [forces[k].get_coeffs() for k in self._loads]
        touching = contacts.NOTHING
        if look:
            touching = self._reader.look(self._contact_results.Eval(self._inner), self._inner)
        held = self._measured_grips(x, actuation)
        return x, np.array(_driven(start, twist, TICK)), actuation, *loads, held, touching


def _made(context: Context) -> int:
    """Which tick's state the update of slot 2 makes; asked then, or in slot 3 before."""
    return (round(context.get_time() / SLOT) + 1) // round(TICK / SLOT) + 1


def _driven(base: _Pose, twist: _Twist, time: float) -> _Pose:
    """Where x, y, heading are after driving straight on or on an arc."""
    x, y, heading = base
    forward, sideways, yaw_rate = twist
    middle = heading + yaw_rate * time / 2
    c, s, way, aside = math.cos(middle), math.sin(middle), forward * time, sideways * time
    return x + (way * c - aside * s), y + (way * s + aside * c), heading + yaw_rate * time


def _leave_out_looks(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Removes the visual geometry: it would cost time at every step, and cameras and views have scenes of their own."""
    inspector = scene_graph.model_inspector()
    source = plant.get_source_id()
    assert source is not None
    for id in inspector.GetAllGeometryIds():
        if inspector.GetProximityProperties(id) is None and inspector.BelongsToSource(id, source):
            scene_graph.RemoveGeometry(source, id)
