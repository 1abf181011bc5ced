"""The robot as one frozen value: joint groups, limits, frames, kinematics and loads, of its model and robot.yaml.

    robot = Robot.load("models/robot/robot.yaml")
    q = robot.inverse("left", X_BG, near=q)

All questions are answered from the model's own numbers. A Context of Drake is held for scratch: every question sets all
that its answer depends on, so the same question gives the same bits, and copies share the value.
"""

import bisect
import dataclasses as dc
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    JacobianWrtVariable,
    Joint,
    ModelInstanceIndex,
    MultibodyForces,
    PrismaticJoint,
)

from valve_drake.checks import ConfigError, require, shown
from valve_drake.frames import compose, inverse, planar
from valve_drake.messages import LEFT, RIGHT, SIDES
from valve_drake.robot import description as descriptions
from valve_drake.robot import kinematics
from valve_drake.robot.description import FAR, TORQUE, RobotDescription
from valve_drake.robot.drive import Drive, drive
from valve_drake.robot.gaze import Gaze
from valve_drake.robot.groups import Groups
from valve_drake.robot.kinematics import Arm, HandLoad, Joints
from valve_drake.robot.model import (
    base_chain,
    follower,
    frame_named,
    joint_named,
    named_joints,
    parent_joint,
)
from valve_drake.robot.world import Model, make_model
from valve_drake.valve.valve import Valve

_ORIGIN = np.zeros(3)
_OPENINGS = 65  # positions of a gripper's joint at which its opening is read
ROOM = 0.2  # between a base that turns and a panel [m]
_ON_WAY = 1e-4  # by which a base's frame may be off the way of its joints [m, rad]
_AHEAD = 0.1  # by which a head without a pan may look aside [rad]: as near do the images of a sweep join
_TOUCH = 1e-4  # an opening may lack so much of what is asked for [m]


@dc.dataclass(frozen=True, eq=False)
class Gripper:
    """A gripper: its joint's positions and the openings between its pads there.

    Forces are those of an actuator that moves one pad along the other's line, and the other pad by a gear: on each pad
    is half of it. Its travel is half the opening, so the joint's effort is force times `lever`.
    """

    joint: str
    positions: np.ndarray  # (K,) rising [rad or m]
    openings: np.ndarray  # (K,) rising or falling [m]
    levers: np.ndarray  # (K,) half the opening's change over the joint's, positive or negative [m/rad or 1]

    def opening(self, position: float) -> float:
        """Between the pads; beyond the joint's ends it goes on as there [m]."""
        positions, openings, _ = self._table
        within = _between(position, positions, openings)
        beyond = position - min(max(position, positions[0]), positions[-1])
        return within + 2 * self.lever(position) * beyond if beyond else within

    def position(self, opening: float) -> float:
        """Of the joint; beyond the ends of the opening it goes on as there: a shut gripper presses [rad or m]."""
        openings, positions = self._by_opening
        within = _between(opening, openings, positions)
        beyond = opening - min(max(opening, openings[0]), openings[-1])
        return within + beyond / (2 * self.lever(within)) if beyond else within

    def lever(self, position: float) -> float:
        """The joint's effort for a force that opens [m or 1]."""
        positions, _, levers = self._table
        return _between(position, positions, levers)

    @functools.cached_property
    def _table(self) -> tuple[list[float], list[float], list[float]]:
        return self.positions.tolist(), self.openings.tolist(), self.levers.tolist()

    @functools.cached_property
    def _by_opening(self) -> tuple[list[float], list[float]]:
        """Openings, rising, and the positions of the joint."""
        positions, openings, _ = self._table
        return (openings, positions) if openings[0] < openings[-1] else (openings[::-1], positions[::-1])


def _between(x: float, at: list[float], values: list[float]) -> float:
    """The bits of np.interp, which takes eight times as long for a single number."""
    if not at[0] <= x < at[-1]:
        return values[0] if x < at[0] else values[-1] if x >= at[-1] else x  # not a number
    k = bisect.bisect_right(at, x) - 1
    return (values[k + 1] - values[k]) / (at[k + 1] - at[k]) * (x - at[k]) + values[k]


@dc.dataclass(frozen=True, eq=False)
class _Chain:
    """Where an arm's numbers stand in the plant's vectors."""

    q: np.ndarray  # (n,)
    v: np.ndarray
    followers: tuple[
        tuple[int, int, float], ...
    ]  # on the way to the hand: whom one follows (0 .. n-1), its v, how fast
    grip: Frame
    shoulder: Frame  # that the first joint turns in
    reach: float  # of the grip point from there, at most [m]


class Robot:
    """See the module. Immutable; `robot.yaml` is `description`, the model `model`."""

    description: RobotDescription
    model: Model
    base: Joints  # x, y, yaw; none if it is fixed
    drive: Drive  # its speeds
    posture: Joints  # lift and waist: what holds still while the hands work
    torso: Joints  # posture, tilt, pan, as far as there are
    arms: Mapping[str, Arm]
    hands: Mapping[str, HandLoad]
    grippers: Mapping[str, Gripper]
    gaze: Gaze
    opening: float  # of an open gripper [m]
    home: np.ndarray  # both arms, left first (n + m,)
    couples: bool  # joints that follow others carry hands or eyes, as the second stage of a lift does

    def __init__(self, description: RobotDescription, model: Model):
        """Raises ConfigError in one line that names the key: what the model lacks or contradicts."""
        d, plant, index = description, model.plant, model.robot
        joint = {key: joint_named(plant, index, name, key) for key, name in named_joints(d)}
        _check_room(joint)
        self.description, self.model = d, model
        self.opening = d.opening
        frame = frame_named(plant, index, d.base.frame, "base.frame")
        self.base = _base(plant, index, d, frame)
        self.drive = drive(d.base.drive, d.base.speed, d.base.acceleration)
        lift = [joint[f"lift.joints[{k}]"] for k in range(len(d.lift.joints))]
        gaze = {key: joint[f"gaze.{key}"] for key in ("waist", "tilt", "pan") if f"gaze.{key}" in joint}
        held = [*lift, *(gaze[key] for key in ("waist",) if key in gaze)]
        rest = [*d.lift.home, *(_nearest_zero(gaze[key]) for key in ("waist",) if key in gaze)]
        speed = [*d.lift.speed, *(d.gaze.waist_speed for key in ("waist",) if key in gaze)]
        head = [gaze[key] for key in ("tilt", "pan") if key in gaze]
        self.posture = _joints(held, speed, rest)
        self.torso = _joints(
            [*held, *head], [*speed, *(d.gaze.speed for _ in head)], [*rest, *map(_nearest_zero, head)]
        )
        _check_within(self.posture, "lift.home")
        _check_speeds("lift.speed", lift, d.lift.speed)
        for name, turning in gaze.items():
            field = "waist_speed" if name == "waist" else "speed"
            _check_speeds(f"gaze.{field}", [turning], [getattr(d.gaze, field)])
        self.arms = MappingProxyType({side: _arm(d, side, joint) for side in SIDES})
        self.home = _locked(np.concatenate([self.arms[side].home for side in SIDES]))

        self._plant, self._base_frame = plant, frame
        self._check_base()
        self._follow = follower(plant, index, model.mimics)
        self._context = plant.CreateDefaultContext()
        self._eye = frame_named(plant, index, d.cameras["head_left"], "cameras.head_left")
        for name, camera in d.cameras.items():
            if camera:
                frame_named(plant, index, camera, f"cameras.{name}")
        self._torso_q = _positions([*held, *head])
        self._posture_q = self._torso_q[: len(held)]
        q = np.array(plant.GetPositions(self._context))
        q[self._torso_q] = self.torso.home
        for side in SIDES:
            q[_positions([joint[f"arms.{side}.joints[{k}]"] for k in range(len(self.arms[side]))])] = self.arms[
                side
            ].home
        self.follow(q)
        self._home_q = q
        ways = [self._eye, *(frame_named(plant, index, f"{side}_grip", f"frames.{side}_grip") for side in SIDES)]
        carrying = {inner.name() for way in ways for inner in carriers(plant, index, way)}
        self.couples = any(mimic.joint in carrying for mimic in model.mimics)
        self._chains = {side: self._chain(side, joint) for side in SIDES}
        self._plant.SetPositions(self._context, self._home_q)
        self._ends = [float(self._pose(chain.shoulder)[0, 3]) + chain.reach for chain in self._chains.values()]
        self._check_sides()
        self._check_posture()
        self._check_ahead()
        self.gaze = self._gaze()
        self.grippers = MappingProxyType({side: self._gripper(side, joint[f"grippers.{side}.joint"]) for side in SIDES})
        for side in SIDES:
            q[joint[f"grippers.{side}.joint"].position_start()] = self.grippers[side].position(d.opening)
        self.follow(q)
        self.hands = MappingProxyType({side: self._hand(side) for side in SIDES})
        self._scratch = q.copy()
        for name in ("_home_q", "_torso_q", "_posture_q"):
            _locked(getattr(self, name))
        self._frozen = True

    def __setattr__(self, name: str, value: Any) -> None:
        if getattr(self, "_frozen", False):
            raise AttributeError(f"a robot does not change: {name}")
        super().__setattr__(name, value)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Robot":
        return self

    def held(self, torso: np.ndarray) -> np.ndarray:
        """See RobotKinematics."""
        return torso[..., : len(self.posture)]

    @property
    def lift(self) -> int:
        """How many of the posture's joints are the lift; they come first."""
        return len(self.description.lift.joints)

    @property
    def stand(self) -> tuple[float, float]:
        """The nearest and the farthest place before a panel that are worth a try, base to panel along the floor [m]."""
        base = self.description.base
        if base.stand:
            return base.stand[0], base.stand[1]
        return self.turning_room, max(self.turning_room, *self._ends)

    @property
    def turning_room(self) -> float:
        """The base's frame to a panel, along the floor, where it can turn before it [m]."""
        return math.hypot(*self.description.base.footprint) + ROOM

    @property
    def groups(self) -> Groups:
        """The joints that are commanded by position, the base's speeds, and the devices that there are none of."""
        absent = [name for name, there in (("base", self.base), ("torso", self.torso)) if not len(there)]
        absent += [f"{side}_wrist_sensor" for side in SIDES if self.feels_by_torque(side)]
        return Groups(
            self.torso.names,
            self.arms[LEFT].names,
            self.arms[RIGHT].names,
            self.drive.names,
            tuple(absent),
        )

    def feels_by_torque(self, side: str) -> bool:
        """Whether an arm has no force sensor: its wrench is that of its joints' torques (`torque_wrench`)."""
        return self.description.arm(side).sensor == TORQUE

    @staticmethod
    def load(path: str | Path, valve: Valve | None = None) -> "Robot":
        """The robot of a robot.yaml; made once for equal files. Raises ConfigError in one line.

        valve: in its model of the world; None: ours.
        """
        return Robot.of(descriptions.load(path), str(path), valve)

    @staticmethod
    def of(description: RobotDescription, source: str, valve: Valve | None = None) -> "Robot":
        """The robot of a loaded description; made once for equal ones. Raises ConfigError in one line.

        source: named in errors. valve: in its model of the world; None: ours.
        """
        shape = Valve() if valve is None else valve
        file = descriptions.model_file(description)
        state = file.stat()
        key = (repr(description), str(file), state.st_mtime_ns, state.st_size, repr(shape))
        if key not in _loaded:
            try:
                _loaded[key] = Robot(description, make_model(description, shape))
            except ConfigError as error:
                if str(error).startswith("valve."):
                    raise
                raise ConfigError(f"{source}: {error}") from error
            while len(_loaded) > _KEPT:
                _loaded.pop(next(iter(_loaded)))
        return _loaded[key]

    # ------------------------------------------------------------ head
    def X_BL(self, torso: np.ndarray) -> np.ndarray:
        """The left eye in the base for the torso's joints -> (3, 4)."""
        q = self._home_q.copy()
        q[self._torso_q] = torso
        self._put(q)
        return self._pose(self._eye)

    def X_GC(self, side: str) -> np.ndarray:
        """The wrist camera in its hand, the arm at home -> (3, 4)."""
        name = self.description.cameras[f"{side}_wrist"]
        camera = frame_named(self._plant, self.model.robot, name, f"cameras.{side}_wrist")
        self._plant.SetPositions(self._context, self._home_q)
        return compose(inverse(self._pose(self._chains[side].grip)), self._pose(camera))

    def head_pose(self, base: np.ndarray, torso: np.ndarray) -> np.ndarray:
        """X_OL for base = (x, y, heading) in O -> (3, 4)."""
        return compose(planar(*base.tolist()), self.X_BL(torso))

    # ------------------------------------------------------------ arms
    def split(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Both arms' joints (n + m,), left first -> by side."""
        n = len(self.arms[LEFT])
        return {LEFT: q[:n], RIGHT: q[n:]}

    def shoulder(self, side: str) -> np.ndarray:
        """Where an arm's first joint is, in the base, all at home -> (3,) [m]."""
        self._plant.SetPositions(self._context, self._home_q)
        return self._pose(self._chains[side].shoulder)[:, 3]

    def forward(self, side: str, q: np.ndarray, posture: np.ndarray | None = None) -> np.ndarray:
        """X_BG of a hand for its arm's joints (n,) -> (3, 4). posture: lift and waist; None or empty: at home."""
        chain = self._chains[side]
        self._set(chain, q, posture)
        return self._pose(chain.grip)

    def jacobian(self, side: str, q: np.ndarray, posture: np.ndarray | None = None) -> np.ndarray:
        """J with V_BG = J q' ([w; v] of the grip point, in B) -> (6, n)."""
        chain = self._chains[side]
        self._set(chain, q, posture)
        return self._jacobian(chain)

    def inverse(
        self, side: str, X_BG: np.ndarray, near: np.ndarray | None = None, posture: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Joints (n,) within their limits that bring the hand to X_BG within 1e-6 rad and m; None if out of reach.

        near: the solution that continues this pose; None: any, with a good margin where there is one.
        """
        chain, arm = self._chains[side], self.arms[side]
        if not np.isfinite(X_BG).all() or (near is not None and not np.isfinite(near).all()):
            return None
        self._set(chain, arm.home, posture)
        if near is None:
            far = X_BG[:, 3] - self._pose(chain.shoulder)[:, 3]
            if math.sqrt(far @ far) > chain.reach:
                return None
        put, scratch, slots = self._put, self._scratch, chain.q

        def evaluate(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            scratch[slots] = q
            put(scratch)
            return self._pose(chain.grip), self._jacobian(chain)

        if near is not None:
            return kinematics.solve(evaluate, X_BG, near, arm)

        def margin(q: np.ndarray) -> float:
            return kinematics.margin(q, evaluate(q)[1], arm)

        return kinematics.search(evaluate, X_BG, arm, kinematics.seeds(arm), margin)

    def margin(self, side: str, q: np.ndarray) -> float:
        """Of an arm from its limits and singularities: 1 is comfortable, 0 at a limit, negative beyond."""
        return kinematics.margin(q, self.jacobian(side, q), self.arms[side])

    # ------------------------------------------------------------ forces without a sensor
    def torque_wrench(
        self, side: str, q: np.ndarray, velocity: np.ndarray, torque: np.ndarray, posture: np.ndarray | None = None
    ) -> np.ndarray:
        """What a hand feels, of its arm's joints (n,), their rates and the torques of their actuators.

        -> [torque; force] of the world on the hand, at and in G (6,), no weight in it. The arm's own acceleration
        counts as a force. Joints that tell nothing of a direction, near a singularity, leave it near zero.
        """
        chain, d = self._chains[side], self.description.arm(side)
        self._set(chain, q, posture)
        plant, context = self._plant, self._context
        v = np.zeros(plant.num_velocities())
        v[chain.v] = velocity
        plant.SetVelocities(context, v)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)  # gravity, the joints' damping
        free = plant.CalcInverseDynamics(context, np.zeros_like(v), forces)[chain.v]
        R_BG = self._pose(chain.grip)[:, :3]
        F_B = kinematics.wrench(self._jacobian(chain), free - torque, np.array(d.torque_noise))
        plant.SetVelocities(context, np.zeros_like(v))
        return np.concatenate([F_B[:3] @ R_BG, F_B[3:] @ R_BG])

    # ------------------------------------------------------------ for who has a plant or a Context of his own
    def named(
        self,
        *,
        base: Iterable[float] = (),
        torso: Iterable[float] = (),
        arms: Mapping[str, np.ndarray] = MappingProxyType({}),
        opening: float | None = None,
    ) -> dict[str, float]:
        """Joint of the model -> position, of the groups that are given; opening: of both grippers [m].

        base: x, y, heading; none of them for a base that has no joints.
        """
        out = dict(zip(self.base.names, base)) | dict(zip(self.torso.names, torso))
        for side, q in arms.items():
            out |= dict(zip(self.arms[side].names, q))
        if opening is not None:
            out |= {gripper.joint: gripper.position(opening) for gripper in self.grippers.values()}
        for mimic in self.model.mimics:  # a leader comes before its followers, which may lead others
            if mimic.follows in out:
                out[mimic.joint] = mimic.multiplier * out[mimic.follows] + mimic.offset
        return {name: float(value) for name, value in out.items()}

    def slots(self, joints: Sequence[str]) -> np.ndarray:
        """Where these joints' positions stand in the positions of the model's plant."""
        return _positions([joint_named(self._plant, self.model.robot, name, "joint") for name in joints])

    def rest(self, opening: float) -> np.ndarray:
        """The positions of the model's plant with all joints at home and both grippers so far open [m]."""
        q = self._home_q.copy()
        for gripper in self.grippers.values():
            q[self.slots([gripper.joint])] = gripper.position(opening)
        self.follow(q)
        return q

    # ------------------------------------------------------------ scratch
    def _set(self, chain: _Chain, q: np.ndarray, posture: np.ndarray | None) -> None:
        scratch = self._scratch
        scratch[:] = self._home_q
        scratch[chain.q] = q
        if posture is not None and len(posture):
            scratch[self._posture_q] = posture
        self._put(scratch)

    def _put(self, q: np.ndarray) -> None:
        """Sets the context to q, in which joints that follow others may stand anywhere."""
        if self.couples:
            self._follow(q)
        self._plant.SetPositions(self._context, q)

    def _pose(self, frame: Frame) -> np.ndarray:
        """X_BF as the context stands -> (3, 4)."""
        X: np.ndarray = self._plant.CalcRelativeTransform(self._context, self._base_frame, frame).GetAsMatrix34()
        return X

    def _jacobian(self, chain: _Chain) -> np.ndarray:
        B = self._base_frame
        J: np.ndarray = self._plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, chain.grip, _ORIGIN, B, B
        )
        if not chain.followers:
            return J[:, chain.v]
        own = J[:, chain.v]
        for k, v, ratio in chain.followers:
            own[:, k] += ratio * J[:, v]
        return own

    def follow(self, q: np.ndarray) -> None:
        """Puts the joints that follow others where they belong, in the plant's positions."""
        self._follow(q)

    # ------------------------------------------------------------ read off the model, once
    def _chain(self, side: str, joint: Mapping[str, Joint]) -> _Chain:
        plant, index = self._plant, self.model.robot
        grip = frame_named(plant, index, f"{side}_grip", f"frames.{side}_grip")
        joints = [joint[f"arms.{side}.joints[{k}]"] for k in range(len(self.arms[side]))]
        carried = carriers(plant, index, grip)
        for k, inner in enumerate(joints):
            if inner not in carried:
                raise ConfigError(f"arms.{side}.joints[{k}] must carry {side}_grip, got {shown(inner.name())}")
        order = sorted(joints, key=carried.index, reverse=True)
        if order != joints:
            names = ", ".join(inner.name() for inner in order)
            raise ConfigError(f"arms.{side}.joints must go from the shoulder outwards: {names}")
        self._plant.SetPositions(self._context, self._home_q)
        points = [self._pose(inner.frame_on_parent())[:, 3] for inner in joints] + [self._pose(grip)[:, 3]]
        lengths = [float(np.linalg.norm(b - a)) for a, b in zip(points, points[1:])]
        slides = [inner.position_upper_limits()[0] - inner.position_lower_limits()[0] for inner in joints
                  if isinstance(inner, PrismaticJoint)]  # fmt: skip
        ratios = {inner.name(): (k, 1.0) for k, inner in enumerate(joints)}  # whom each joint follows, and how fast
        followers = []
        for mimic in self.model.mimics:  # a leader comes before its followers, which may lead others
            if mimic.follows not in ratios:
                continue
            k, ratio = ratios[mimic.follows]
            ratios[mimic.joint] = k, ratio * mimic.multiplier
            led = joint_named(plant, index, mimic.joint, "model: mimic")
            if led in carried:
                followers.append((k, led.velocity_start(), ratio * mimic.multiplier))
        return _Chain(
            _positions(joints),
            np.array([inner.velocity_start() for inner in joints]),
            tuple(followers),
            grip,
            joints[0].frame_on_parent(),
            sum(lengths) + float(sum(slides)) + 1e-6,
        )

    def _check_base(self) -> None:
        """Base joints of the model's own are to move B as its odometry counts: x, y, heading."""
        if not len(self.base):
            return
        context, place = self._plant.CreateDefaultContext(), (0.3, 0.2, 0.5)
        q = np.array(self._plant.GetPositions(context))
        q[self.slots(self.base.names)] = place
        self._plant.SetPositions(context, q)
        X_WB = self._base_frame.CalcPoseInWorld(context).GetAsMatrix34()
        off = np.abs(X_WB - planar(*place))
        off[2, 3] = 0.0  # a floor may be anywhere
        names = ", ".join(self.base.names)
        words = f"one that {names} move along x, along y and about z, from the world's origin"
        require(bool(off.max() < _ON_WAY), "base.frame", words, self.description.base.frame)

    def _check_sides(self) -> None:
        left, right = (self.shoulder(side)[1] for side in SIDES)
        if left <= right:
            raise ConfigError(
                f"arms.left must be to the left of arms.right, got shoulders at y = {left:.3g} and {right:.3g} m"
            )

    def _check_posture(self) -> None:
        """What holds still while the hands work carries them: lift and waist."""
        keys = [f"lift.joints[{k}]" for k in range(self.lift)] + ["gaze.waist"] * bool(self.description.gaze.waist)
        for key, name in zip(keys, self.posture.names):
            for side in SIDES:
                shoulder = self._chains[side].shoulder
                carried = [joint.name() for joint in carriers(self._plant, self.model.robot, shoulder)]
                require(name in carried, key, "a joint that carries both arms", name)

    def _check_ahead(self) -> None:
        """Eyes that nothing turns aside look where the base stands: the search turns it by the gaze."""
        x, y, _ = self.X_BL(self.torso.home)[:, 2]
        aside = math.atan2(y, x)
        words = f"a joint, or the left eye has to look ahead within {_AHEAD:g} rad; it looks {aside:.2f} rad left"
        require(bool(self.description.gaze.pan) or abs(aside) < _AHEAD, "gaze.pan", words, "")

    def _gaze(self) -> Gaze:
        """Its signs are read off the model by how the eye's axis moves; 1 for a joint that the robot lacks."""
        d, signs, joints = self.description.gaze, [1.0, 1.0, 1.0], list[int | None]([None] * 3)
        aside = "to the left and right"
        ways = ("waist", 1, 1.0, aside), ("tilt", 2, -1.0, "up and down"), ("pan", 1, 1.0, aside)
        for k, (key, row, sign, words) in enumerate(ways):
            if not (name := getattr(d, key)):
                continue
            torso, joints[k] = self.torso.home.copy(), self.torso.names.index(name)
            torso[joints[k]] += 0.1
            moved = sign * (self.X_BL(torso)[row, 2] - self.X_BL(self.torso.home)[row, 2])
            require(abs(moved) > 0.01, f"gaze.{key}", f"a joint that turns the eye {words}", name)
            signs[k] = math.copysign(1.0, moved)
        waist, tilt, pan = joints
        return Gaze((waist, tilt, pan), self.torso.home, _locked(np.array(signs)))

    def _gripper(self, side: str, joint: Joint) -> Gripper:
        """Opening over position, from the pads' distance along the closing direction; shut is the least."""
        plant, index, key = self._plant, self.model.robot, f"grippers.{side}"
        spec = self.description.gripper(side)
        pads = [frame_named(plant, index, pad, f"{key}.pads[{k}]") for k, pad in enumerate(spec.pads)]
        grip = self._chains[side].grip
        low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        require(math.isfinite(low) and low < high < math.inf, f"{key}.joint", "a joint with limits", joint.name())
        plant.SetPositions(self._context, self._home_q)
        first = np.array(self.description.pad.at)
        mirrored = plant.CalcPointsPositions(self._context, pads[0], first, grip)[:, 0] * [1, -1, 1]
        surfaces = first, plant.CalcPointsPositions(self._context, grip, mirrored, pads[1])[:, 0]
        positions, distances = np.linspace(low, high, _OPENINGS), []
        q = self._home_q.copy()
        for position in positions:
            q[joint.position_start()] = position
            self.follow(q)
            plant.SetPositions(self._context, q)
            points = [plant.CalcPointsPositions(self._context, *pad, grip)[1, 0] for pad in zip(pads, surfaces)]
            distances.append(points[0] - points[1])
        openings = np.array(distances)
        openings *= 1.0 if abs(openings.max()) >= abs(openings.min()) else -1.0
        rising = 1.0 if openings[0] < openings[-1] else -1.0
        if not np.all(rising * np.diff(openings) > 0):
            raise ConfigError(f"{key}.joint must open and shut the pads, got {shown(joint.name())}")
        most, wanted = float(openings.max()), self.description.opening
        require(wanted <= most + _TOUCH, "opening", f"at most {most:.4g} m, which the {side} gripper opens", wanted)
        levers = np.gradient(openings, positions) / 2
        return Gripper(joint.name(), _locked(positions), _locked(openings), _locked(levers))

    def _hand(self, side: str) -> HandLoad:
        """Mass and centre of mass of all bodies beyond the sensor, grippers open, in the sensor's frame."""
        plant, index, d = self._plant, self.model.robot, self.description
        key, name, chain = f"arms.{side}.sensor", d.arm(side).sensor, self._chains[side]
        if name == TORQUE:  # the model bears the weight, and the wrench is that at the grip point
            return HandLoad(0.0, _locked(np.zeros(3)), _locked(np.eye(3, 4)))
        sensor = joint_named(plant, index, name, key)
        carried = carriers(plant, index, chain.grip)
        last = self.arms[side].names[-1]
        beyond = sensor in carried and any(joint.name() == last for joint in carried[carried.index(sensor) :])
        good = sensor.type_name() == "weld" and beyond
        require(good, key, f"a fixed joint between {last} and {side}_grip", name)
        q = self._home_q.copy()
        for other in SIDES:
            joint = joint_named(plant, index, d.gripper(other).joint, "")
            q[joint.position_start()] = self.grippers[other].position(d.opening)
        self.follow(q)
        plant.SetPositions(self._context, q)
        frame = sensor.frame_on_child()
        X_SG = plant.CalcRelativeTransform(self._context, frame, chain.grip).GetAsMatrix34()
        bodies = [plant.get_body(i) for i in plant.GetBodyIndices(index)]
        mass, moment = 0.0, np.zeros(3)
        for body in bodies:
            if sensor in carriers(plant, index, body.body_frame()):
                own = body.default_mass()
                com = body.CalcCenterOfMassInBodyFrame(self._context)
                mass += own
                moment += own * plant.CalcPointsPositions(self._context, body.body_frame(), com, frame)[:, 0]
        require(mass > 0, key, "a joint with a mass beyond it", name)
        weight = 0.0 if d.counterbalanced else mass
        return HandLoad(weight, _locked(np.round(moment / mass, 12)), _locked(np.round(X_SG, 12)))  # to the picometer


_KEPT = 8  # robots that `load` remembers
_loaded: dict[tuple[Any, ...], Robot] = {}


def _locked(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def _positions(joints: list[Joint]) -> np.ndarray:
    return np.array([joint.position_start() for joint in joints], int)


def _joints(joints: list[Joint], speed: list[float], home: list[float]) -> Joints:
    return Joints(**_group(joints, speed, home))


def _group(joints: list[Joint], speed: list[float], home: list[float]) -> dict[str, Any]:
    return {
        "names": tuple(joint.name() for joint in joints),
        "low": _locked(np.array([joint.position_lower_limits()[0] for joint in joints])),
        "high": _locked(np.array([joint.position_upper_limits()[0] for joint in joints])),
        "speed": _locked(np.array(speed, float)),
        "home": _locked(np.array(home, float)),
    }


def _check_room(joints: Mapping[str, Joint]) -> None:
    """A joint whose limits leave it no room cannot do its part: a URDF without limits says so by [0, 0]."""
    for key, joint in joints.items():
        low, high = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        require(low < high, key, f"a joint with room between its limits, [{low:g}, {high:g}]", joint.name())
        slides = isinstance(joint, PrismaticJoint)
        require(not slides or high - low < FAR, key, "a joint with limits, since it slides", joint.name())


def _nearest_zero(joint: Joint) -> float:
    """Where a joint of waist or head is at home."""
    return float(min(max(0.0, joint.position_lower_limits()[0]), joint.position_upper_limits()[0]))


def _check_within(group: Joints, key: str, values: np.ndarray | None = None) -> None:
    for k, value in enumerate(group.home if values is None else values):
        low, high = group.low[k], group.high[k]
        require(
            low <= value <= high,
            f"{key}[{k}]",
            f"within [{low:g}, {high:g}], the limits of {group.names[k]}",
            float(value),
        )


def _check_speeds(key: str, joints: list[Joint], speeds: Sequence[float]) -> None:
    """No joint is asked for more than its model allows."""
    for k, (joint, speed) in enumerate(zip(joints, speeds)):
        most = joint.velocity_upper_limits()[0]
        words = f"at most {most:g}, {joint.name()}'s limit"
        require(speed <= most, f"{key}[{k}]" if len(speeds) > 1 else key, words, speed)


def _base(plant: MultibodyPlant, index: ModelInstanceIndex, d: RobotDescription, frame: Frame) -> Joints:
    chain = base_chain(plant, index, frame.body())
    kinds = [joint.type_name() for joint in chain]
    if d.base.drive == "fixed":
        require(not chain, "base.drive", f"one that moves: {', '.join(j.name() for j in chain)} move the base", "fixed")
        return _joints([], [], [])
    good = kinds == ["prismatic", "prismatic", "revolute"]
    require(good, "base.frame", "moved by two prismatic and one revolute joint of the model, or by none", d.base.frame)
    speed = d.base.speed
    _check_speeds("base.speed", [chain[0], *chain[3 - len(speed) + 1 :]], speed)
    return _joints(chain, [speed[0], speed[-2], speed[-1]], [0.0, 0.0, 0.0])


def _arm(d: RobotDescription, side: str, joint: Mapping[str, Joint]) -> Arm:
    """joint: of the model, by its key in robot.yaml."""
    spec = d.arm(side)
    joints = [joint[f"arms.{side}.joints[{k}]"] for k in range(len(spec.joints))]
    work = _locked(np.array(spec.work or spec.home))
    arm = Arm(**_group(joints, spec.speed or d.arm_speed, spec.home), work=work)
    _check_within(arm, f"arms.{side}.home")
    _check_speeds(f"arms.{side}.speed" if spec.speed else "arm_speed", joints, spec.speed or d.arm_speed)
    _check_within(arm, f"arms.{side}.work", work)
    return arm


def carriers(plant: MultibodyPlant, index: ModelInstanceIndex, frame: Frame) -> list[Joint]:
    """The joints that carry a frame, the nearest first."""
    out: list[Joint] = []
    body = frame.body()
    while (joint := parent_joint(plant, index, body)) is not None:
        out.append(joint)
        body = joint.parent_body()
    return out
