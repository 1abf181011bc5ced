"""robot.yaml: what a program has to know of a robot beside its model file. Typed, bounded, and read without Drake.

A description names joints and frames of the model; whether the model has them is checked where it is read
(robot/model.py, robot/robot.py). SI units and radians. A list of joints goes from the body outwards.
"""

import dataclasses as dc
import os
from pathlib import Path

from valve_drake import config, resources, yaml_file
from valve_drake.checks import ConfigError, require, shown
from valve_drake.config import Config, choice, named, names, number, numbers, plain, texts
from valve_drake.messages import SIDES
from valve_drake.robot import packages
from valve_drake.robot.drive import SPEEDS

MOST_JOINTS = 10  # of an arm or a lift
FAR = 100.0  # of a joint's position: a bound for continuous ones, which have no limits of their own [rad, m]
PACKAGE = "valve_drake_models"
OURS = "robot/robot.yaml"  # our own robot, below models/
TORQUE = "torque"


@dc.dataclass
class BaseDescription(Config):
    """Key `base`. The frame is B of frames.py. A fixed base is bolted down: nothing drives, and speed and acceleration
    mean nothing.

    stand: nearest and farthest place before a panel that are tried; by default from where the footprint is clear of it
    to where the arms end.
    """

    frame: str = plain("", "link or frame on the floor, x forward, z up")
    drive: str = choice("differential", tuple(SPEEDS), "how it moves")
    footprint: list[float] = numbers([0.3, 0.3], 0.05, 2.0, "half length, half width [m]")
    stand: list[float] = numbers([], 0.3, 3.0, "its frame to the panel, along the floor [m]", count=(0, 2))
    speed: list[float] = numbers([0.8, 1.2], 0.01, 3.0, "at most: forward, (sideways,) yaw [m/s, rad/s]", count=(0, 3))
    acceleration: list[float] = numbers([0.8, 2.0], 0.05, 5.0, "of the same [m/s^2, rad/s^2]", count=(0, 3))

    def relations(self, key: str) -> None:
        require(bool(self.frame), f"{key}.frame", "given", self.frame)
        good = not self.stand or (len(self.stand) == 2 and self.stand[0] <= self.stand[1])
        require(good, f"{key}.stand", "none, or the nearest and the farthest", self.stand)
        count = len(SPEEDS[self.drive])
        if count:
            for name in ("speed", "acceleration"):
                value = getattr(self, name)
                require(len(value) == count, f"{key}.{name}", f"{count} values for a {self.drive} base", value)


@dc.dataclass
class LiftDescription(Config):
    """Key `lift`: joints between base and shoulders that hold still while the hands work. None by default."""

    joints: list[str] = names("of the model, the lowest first", (0, MOST_JOINTS))
    home: list[float] = numbers([], -FAR, FAR, "where it stands [rad or m]", count=(0, MOST_JOINTS))
    speed: list[float] = numbers([], 1e-3, 5.0, "at most [1/s]", count=(0, MOST_JOINTS))

    def relations(self, key: str) -> None:
        for name in ("home", "speed"):
            _as_many(self, key, name, len(self.joints))


@dc.dataclass
class GazeDescription(Config):
    """Key `gaze`: what turns the head, whichever way it grows. waist: turns head and arms."""

    waist: str = plain("", "joint, where there is one")
    pan: str = plain("", "joint, to the left and right")
    tilt: str = plain("", "joint, up and down")
    speed: float = number(1.5, 0.05, 10.0, "of pan and tilt, at most [rad/s]")
    waist_speed: float = number(0.8, 0.05, 10.0, "of the waist, at most [rad/s]")


@dc.dataclass
class ArmDescription(Config):
    """Key `arms.left` or `arms.right`.

    home: free of all, and out of the eyes' sight of the valve. work: where a redundant arm is drawn to at the valve,
    and where the search for a pose begins; home by default. speed: of this arm, where the two differ. stiffness: of the
    simulated servos; the model's own by default. sensor: the fixed joint whose load the wrist sensor reads, or `torque`
    for an arm that has none: the wrench is computed from its joints' torques. torque_noise, torque_bias: standard
    deviations of a reading of these, and of its constant error; only with `sensor: torque`, which asks for the first.
    """

    joints: list[str] = names("of the model, from the shoulder on", (0, MOST_JOINTS))
    home: list[float] = numbers([], -FAR, FAR, "[rad]", count=(0, MOST_JOINTS))
    work: list[float] = numbers([], -FAR, FAR, "[rad]", count=(0, MOST_JOINTS))
    speed: list[float] = numbers(
        [], 0.01, 10.0, "of each joint, at most; arm_speed by default [rad/s]", count=(0, MOST_JOINTS)
    )
    stiffness: list[float] = numbers([], 1.0, 1e5, "of each joint's servo [N m/rad]", count=(0, MOST_JOINTS))
    sensor: str = plain("", "fixed joint beyond the arm, or torque")
    torque_noise: list[float] = numbers([], 1e-4, 100.0, "of each joint's torque reading [N m]", count=(0, MOST_JOINTS))
    torque_bias: list[float] = numbers([], 0.0, 100.0, "constant error of the same [N m]", count=(0, MOST_JOINTS))

    def relations(self, key: str) -> None:
        count = len(self.joints)
        require(count >= 5, f"{key}.joints", f"5 to {MOST_JOINTS} joints", self.joints)
        _as_many(self, key, "home", count)
        for name in ("work", "speed", "stiffness"):
            if getattr(self, name):
                _as_many(self, key, name, count)
        require(bool(self.sensor), f"{key}.sensor", f"a fixed joint of the model, or {TORQUE}", self.sensor)
        if self.sensor == TORQUE:
            require(count >= 6, f"{key}.sensor", f"a fixed joint: {TORQUE} needs 6 joints or more", self.sensor)
            _as_many(self, key, "torque_noise", count)
            if self.torque_bias:
                _as_many(self, key, "torque_bias", count)
        for name in ("torque_noise", "torque_bias"):
            given = getattr(self, name)
            require(not given or self.sensor == TORQUE, f"{key}.{name}", f"left out without sensor: {TORQUE}", given)


@dc.dataclass
class GripperDescription(Config):
    """Key `grippers.left` or `grippers.right`: the joint that its motor moves, and the two links that press."""

    joint: str = plain("", "of the model; others follow it by <mimic>")
    effort: float = number(0.0, 0.0, 1e4, "its motor's limit, at the joint; 0: the model's [N m or N]")
    pads: list[str] = names("links or frames", (2, 2))

    def relations(self, key: str) -> None:
        require(bool(self.joint), f"{key}.joint", "given", self.joint)
        require(self.pads[0] != self.pads[1], f"{key}.pads", "two links", self.pads)


@dc.dataclass
class Arms(Config):
    left: ArmDescription = dc.field(default_factory=ArmDescription)
    right: ArmDescription = dc.field(default_factory=ArmDescription)


@dc.dataclass
class Grippers(Config):
    left: GripperDescription = dc.field(default_factory=GripperDescription)
    right: GripperDescription = dc.field(default_factory=GripperDescription)


@dc.dataclass
class PadDescription(Config):
    """Key `pad`: where the pads' surfaces are on their links. size: (0, 0) leaves the model's own contact shapes.

    at: on the first link; on the second one its mirror image, beyond the plane y = 0 of the grip.
    """

    at: list[float] = numbers([0.0, 0.0, 0.0], -0.3, 0.3, "middle of the surface, in the first link [m]")
    size: list[float] = numbers(
        [0.0, 0.0], 0.0, 0.1, "of the grid of contact points that is added, along x and z of the grip [m]"
    )
    friction: float = number(0.8, 0.05, 2.0, "of the added contact points")


@dc.dataclass
class FrameDescription(Config):
    """Key `frames.NAME`: a frame that the model file lacks."""

    link: str = plain("", "of the model")
    xyz: list[float] = numbers([0.0, 0.0, 0.0], -3.0, 3.0, "[m]")
    rpy: list[float] = numbers([0.0, 0.0, 0.0], -6.3, 6.3, "roll, pitch, yaw, as in SDF and URDF [rad]")

    def relations(self, key: str) -> None:
        require(bool(self.link), f"{key}.link", "given", self.link)


@dc.dataclass
class CollisionDescription(Config):
    """Key `collision`: which pairs of links are not looked at, beside those that the model file filters."""

    srdf: str = plain("", "those of its disable_collisions: as model")
    ignore: str = choice("", ("", "touching_at_home"), "pairs that are ignored")
    padding: float = number(0.015, 0.0, 0.1, "least distance that counts as free [m]")


@dc.dataclass
class RobotDescription(Config):
    """A robot.yaml. grips are the frames left_grip and right_grip (G and K of frames.py): z approaches, y closes."""

    model: str = plain("", "SDF, URDF or Drake directives: a path from this file, or a package:// URL")
    weld: list[str] = names("joints that are held fast where they are zero", (0, 1000))
    counterbalanced: bool = plain(False, "springs carry it: no gravity, and hands weigh nothing on their sensors")
    base: BaseDescription = dc.field(default_factory=BaseDescription)
    lift: LiftDescription = dc.field(default_factory=LiftDescription)
    gaze: GazeDescription = dc.field(default_factory=GazeDescription)
    arms: Arms = dc.field(default_factory=Arms)
    arm_speed: list[float] = numbers(
        [], 0.01, 10.0, "of each joint of both arms, at most [rad/s]", count=(0, MOST_JOINTS)
    )
    grippers: Grippers = dc.field(default_factory=Grippers)
    opening: float = number(0.085, 0.01, 0.5, "of an open gripper, between the pads [m]")
    pad: PadDescription = dc.field(default_factory=PadDescription)
    frames: dict[str, FrameDescription] = named("that are added to the model")
    servo: str = choice("camera", ("camera", "none"), "how hands find the handles; none: by the head and touch alone")
    cameras: dict[str, str] = texts(
        {"head_left": "", "left_wrist": "", "right_wrist": ""}, "their frames: x right, y down, z forward"
    )
    head_calibration: str = plain("", "of the stereo head (`calibrate stereo`): as model")
    taught: str = plain("", "references of the hands (`teach`): as model")
    colors: dict[str, list[float]] = named(
        "red, green, blue, opacity of the model's materials (in SDF: of its visuals)", 0.0, 1.0, (4, 4)
    )
    collision: CollisionDescription = dc.field(default_factory=CollisionDescription)

    def relations(self, key: str) -> None:
        prefix = f"{key}." if key else ""
        require(bool(self.model), f"{prefix}model", "given", self.model)
        counts = [len(self.arm(side).joints) for side in SIDES]
        for side, count in zip(SIDES, counts):
            if self.arm(side).speed:
                continue
            alike = counts[0] == counts[1] or count == len(self.arm_speed)
            words = f"given, {count} values: arm_speed is that of arms with as many joints"
            require(alike, f"{prefix}arms.{side}.speed", words, [])
            _as_many(self, key, "arm_speed", count)
        require(bool(self.cameras["head_left"]), f"{prefix}cameras.head_left", "given", "")
        given: dict[str, str] = {}
        for name, joint in self._joints():
            require(joint not in given, prefix + name, f"a joint of its own; {given.get(joint)} has it", joint)
            given[joint] = name

    def _joints(self) -> list[tuple[str, str]]:
        """Every joint that is named, with its key."""
        gaze = [("waist", self.gaze.waist), ("pan", self.gaze.pan), ("tilt", self.gaze.tilt)]
        out = [(f"lift.joints[{k}]", joint) for k, joint in enumerate(self.lift.joints)]
        out += [(f"gaze.{name}", joint) for name, joint in gaze if joint]
        for side in SIDES:
            out += [(f"arms.{side}.joints[{k}]", j) for k, j in enumerate(getattr(self.arms, side).joints)]
            out.append((f"grippers.{side}.joint", getattr(self.grippers, side).joint))
        return out

    # ------------------------------------------------------------ by side, for loops over SIDES
    def arm(self, side: str) -> ArmDescription:
        arm: ArmDescription = getattr(self.arms, side)
        return arm

    def gripper(self, side: str) -> GripperDescription:
        gripper: GripperDescription = getattr(self.grippers, side)
        return gripper


def _as_many(value: Config, key: str, name: str, count: int) -> None:
    given = getattr(value, name)
    inner = f"{key}.{name}" if key else name
    require(len(given) == count, inner, f"one value for each of {count} joints", given)


def load(path: str | Path) -> RobotDescription:
    """A robot.yaml, its `model` made a package URL or a full path. Raises ConfigError in one line."""
    path = Path(path)
    return parse(yaml_file.read_text(path), str(path), path)


def parse(text: str, source: str, path: Path) -> RobotDescription:
    """The same of a text that would stand in the file `path`; `source` is named in errors."""
    given = yaml_file.parse(text, source)
    robot: RobotDescription = config.build(RobotDescription(), {} if given is None else given, source)
    try:
        robot.check("")
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    robot.model = _placed(robot.model, path)
    find_file(robot.model, f"{source}: model", given["model"])
    for name in ("head_calibration", "taught"):  # whoever reads one says that it is not there: a log has its own
        if value := getattr(robot, name):
            setattr(robot, name, _placed(value, path))
    if robot.collision.srdf:
        given_srdf, robot.collision.srdf = robot.collision.srdf, _placed(robot.collision.srdf, path)
        find_file(robot.collision.srdf, f"{source}: collision.srdf", given_srdf)
    return robot


def text(path: str | Path) -> bytes:
    """The description as a file that can lie anywhere: with all values, and a `model` that leads from everywhere."""
    return yaml_file.dump(config.tree(load(path)), "The robot of this run.").encode()


def _placed(name: str, path: Path) -> str:
    """A file that the robot.yaml at `path` names, as a name that leads to it from everywhere."""
    if name.startswith("package://"):
        return name
    file = Path(os.path.abspath(path.parent / name))
    home = resources.models()
    if file.is_relative_to(home):
        return f"package://{PACKAGE}/{file.relative_to(home).as_posix()}"
    return str(file)


def require_file(file: Path, key: str, given: str) -> None:
    try:
        good = file.is_file()
    except (OSError, ValueError):
        good = False
    if not good:
        raise ConfigError(f"{key}: no such file: {shown(given)}")


def model_file(robot: RobotDescription) -> Path:
    """Where the model of a loaded description lies. Raises ConfigError."""
    return find_file(robot.model, "model")


def find_file(name: str, key: str, given: str | None = None) -> Path:
    """A file that a loaded description names. given: how its file writes it. Raises ConfigError that names `key`."""
    if name.startswith("package://"):
        return find_package_file(name, key)
    require_file(Path(name), key, name if given is None else given)
    return Path(name)


def find_package_file(url: str, key: str) -> Path:
    """A package:// URL's file: of our own models, or of a package wherever packages are (robot/packages.py)."""
    package, _, rest = url.removeprefix("package://").partition("/")
    if package == PACKAGE:
        file = resources.models() / rest
        require_file(file, key, url)
        return file
    return packages.resolve(url, None, key)


def find(name: str) -> Path:
    """The robot.yaml that a scenario names: a path, one below models/, or a package:// URL. Raises ConfigError."""
    if name.startswith("package://"):
        return find_package_file(name, "robot")
    return resources.find(name, resources.models())
