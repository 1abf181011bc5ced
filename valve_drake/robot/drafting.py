"""The draft of a robot.yaml: what names and the tree of a model tell, and what is still to be filled in and why.

Two arms are the longest chains whose joints have the same names but for left and right. Guesses are made from names,
axes at zero and the extents of the shapes; each that somebody has to look at is marked `# TODO`.
Lengths [m], angles [rad].
"""

import dataclasses as dc
import math
import re
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from valve_drake.robot.urdf import Joint, Robot, rotation

LEAST_ARM = 4  # joints of a chain that is taken for an arm
SNAP = math.radians(15)  # a grip's axis this near to an axis of its link is that axis
PAD_LENGTH = 0.02  # of a pad's surface; half of it on either side of its middle [m]
_OPTICAL = (-math.pi / 2, 0.0, -math.pi / 2)  # roll, pitch, yaw from x forward, z up to z forward, x to the right
STIFFNESS_PER_EFFORT = 130.0  # a joint's stiffness [N m/rad] for each N m of its limit: full effort at 8 mrad
NOISE_PER_EFFORT = 0.005  # a guess at what a joint's torque reads off by, as a share of its limit
Ask = Callable[[str], str]  # notes what is to be done -> the comment that says it
Boxes = Mapping[str, np.ndarray]  # link -> (2, 3) least and greatest corner of its shapes in its own frame [m]

_SIDE = re.compile(
    r"left|right|Left|Right|LEFT|RIGHT|(?<![A-Za-z0-9])[lrLR](?![A-Za-z0-9])|^[lrLR](?=[aA]rm|ARM)|^[LR](?=[A-Z][a-z])"
)
_OTHER = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}
_OTHER |= {right: left for left, right in _OTHER.items()}
_FINGER = re.compile(r"grip|finger|thumb|jaw|knuckle|hand", re.IGNORECASE)
_LEG = re.compile(r"(?<![a-z])(hip|leg|thigh|knee|calf|ankle|foot)(?![a-z])|_(hip|leg)_", re.IGNORECASE)
_CAMERA = re.compile(r"camera|(?<![a-z])cam(?![a-z])|optical|stereo|(?<![a-z])eye|zed|realsense|kinect", re.IGNORECASE)
_MOUNT = re.compile(r"screw|mount|base", re.IGNORECASE)
_FORCE = re.compile(r"(?<![a-z])ft(?![a-z])|force|torque|wrench|sensor", re.IGNORECASE)
_WHEEL = re.compile(r"wheel|caster", re.IGNORECASE)
_OMNI = re.compile(r"omni|mecanum|caster", re.IGNORECASE)
_WORDS = ("true", "false", "yes", "no", "on", "off", "null", "y", "n")  # YAML reads them as no name


def side_of(name: str) -> str | None:
    """`left` or `right`, as the first word of a name that says so."""
    found = _SIDE.search(name)
    return None if found is None else "left" if found[0][0] in "lL" else "right"


def mirrored(name: str) -> str:
    """The name of the same thing on the other side."""
    return _SIDE.sub(lambda found: _OTHER[found[0]], name, count=1)


@dc.dataclass
class Hand:
    """What is beyond one arm's last joint."""

    link: str
    sensor: str | None = None
    driver: str | None = None
    more_drivers: tuple[str, ...] = ()
    pads: tuple[str, ...] = ()
    opening: float = 0.0
    grip: tuple[str, np.ndarray, np.ndarray] | None = None  # link, xyz, rpy
    camera: str | None = None
    pad_at: np.ndarray | None = None  # in the first pad's link
    pad_size: np.ndarray | None = None


@dc.dataclass
class Guess:
    """The groups of a robot's joints and frames, as far as they can be told."""

    base: str
    drive: str
    footprint: tuple[float, float]
    arms: dict[str, list[str]]
    hands: dict[str, Hand]
    lift: list[str]
    waist: str | None
    pan: str | None
    tilt: str | None
    cameras: dict[str, str]
    turned: list[str]
    second_eye: str | None
    weld: list[str]
    colors: list[str]


def guess(robot: Robot, boxes: Boxes, colors: Mapping[str, tuple[float, ...]], words: Iterable[str]) -> Guess:
    """colors: the materials of the model, r, g, b, a in 0..1. words: names of links and meshes: they tell the drive."""
    arms = find_arms(robot)
    poses = robot.poses()
    common = _common(robot, arms)
    lift = [j.name for j in common if j.type == "prismatic" and abs(_axis(j, poses)[2]) > 0.9]
    waists = [j.name for j in common if j.type != "prismatic" and abs(_axis(j, poses)[2]) > 0.9]
    pan, tilt, eye, second = _head(robot, arms, common, poses)
    hands = {side: _hand(robot, joints, boxes) for side, joints in arms.items()}
    cameras, turned = _cameras(robot, eye, hands, poses)
    named = {*lift, *waists[:1], *(j for arm in arms.values() for j in arm), pan, tilt}
    named |= {hand.driver for hand in hands.values()}
    weld = [j.name for j in robot.joints.values() if j.moving and j.mimic is None and j.name not in named]
    for joint in robot.joints.values():  # what follows a welded joint stands still with it
        if joint.moving and joint.mimic is not None and joint.mimic[0] in weld:
            weld.append(joint.name)
    wheels = [name for name in robot.links if _WHEEL.search(name)]
    drive = "holonomic" if wheels and any(map(_OMNI.search, words)) else "differential" if wheels else "fixed"
    return Guess(
        base=robot.root,
        drive=drive,
        footprint=_footprint(robot, boxes, poses),
        arms=arms,
        hands=hands,
        lift=lift,
        waist=waists[0] if waists else None,
        pan=pan,
        tilt=tilt,
        cameras=cameras,
        turned=turned,
        second_eye=second,
        weld=weld,
        colors=[name for name, rgba in colors.items() if _as_the_marks(rgba)],
    )


def _axis(joint: Joint, poses: Mapping[str, np.ndarray]) -> np.ndarray:
    return poses[joint.child][:3, :3] @ joint.axis


def _next(robot: Robot, link: str) -> list[Joint]:
    """The first moving joints that a link carries."""
    out, todo = [], [link]
    for name in todo:
        for joint in robot.below(name):
            if joint.moving:
                out.append(joint)
            else:
                todo.append(joint.child)
    return out


def find_arms(robot: Robot) -> dict[str, list[str]]:
    """`left` and `right`: the joints of the longest two chains of the same names but for the side; or nothing."""
    best: list[str] = []
    for joint in robot.joints.values():
        twin = robot.joints.get(mirrored(joint.name))
        if (
            not joint.moving
            or _LEG.search(joint.name)
            or side_of(joint.name) != "left"
            or twin is None
            or not twin.moving
        ):
            continue
        chain, current = [joint.name], joint
        while len(following := _next(robot, current.child)) == 1:
            current = following[0]
            last = _FINGER.search(current.name) and len(_next(robot, current.child)) < 2  # a jaw, and no wrist
            if current.type == "prismatic" or current.mimic or last or mirrored(current.name) not in robot.joints:
                break
            chain.append(current.name)
        if len(chain) > len(best):
            best = chain
    if len(best) < LEAST_ARM:
        return {}
    return {"left": best, "right": [mirrored(name) for name in best]}


def _common(robot: Robot, arms: Mapping[str, list[str]]) -> list[Joint]:
    """The moving joints that carry both arms."""
    if not arms:
        return []
    left, right = (robot.path(robot.joints[arms[side][0]].parent) for side in ("left", "right"))
    return [joint for joint in left if joint.moving and joint in right]


def _head(
    robot: Robot, arms: Mapping[str, list[str]], common: list[Joint], poses: Mapping[str, np.ndarray]
) -> tuple[str | None, str | None, str | None, str | None]:
    """Pan, tilt, the left eye's frame, the right eye's."""
    limbs = {link for arm in arms.values() for link in robot.beyond(robot.joints[arm[0]].child)}
    carried = {joint.name for joint in common}

    def own(link: str) -> list[Joint]:
        return [joint for joint in robot.path(link) if joint.moving and joint.name not in carried]

    seen = [link for link in robot.links if _CAMERA.search(link) and link not in limbs]
    eyes = [link for link in seen if own(link)] or [link for link in seen if "head" in link.lower()]
    heads = [link for link in robot.links if link not in limbs and "head" in link.lower() and own(link)]
    eyes.sort(
        key=lambda link: (
            side_of(link) != "left",
            "optical" not in link.lower(),
            side_of(link) == "right",
            bool(_MOUNT.search(link)),
            "depth" in link.lower(),
        )
    )
    top = next((link for link in eyes if own(link)), None) or max(heads, key=lambda x: len(own(x)), default=None)
    pan = tilt = None
    for joint in own(top) if top else ():
        axis = _axis(joint, poses)
        if joint.type == "prismatic" or joint.mimic is not None:
            continue
        if pan is None and abs(axis[2]) > 0.8:
            pan = joint.name
        elif tilt is None and abs(axis[1]) > 0.8:
            tilt = joint.name
    eye = eyes[0] if eyes else None
    second = mirrored(eye) if eye and mirrored(eye) != eye and mirrored(eye) in robot.links else None
    return pan, tilt, eye, second


def _hand(robot: Robot, arm: list[str], boxes: Boxes) -> Hand:
    wrist = robot.joints[arm[-1]].child
    hand = Hand(wrist)
    beyond = robot.beyond(wrist)
    cameras = [link for link in beyond if _CAMERA.search(link)]
    hand.camera = next((link for link in cameras if "optical" in link.lower()), cameras[0] if cameras else None)
    fingers = [j for j in robot.joints.values() if j.moving and j.parent in beyond]
    drivers = [j.name for j in fingers if j.mimic is None]
    if drivers:
        followers = [j.mimic[0] for j in fingers if j.mimic]
        drivers.sort(key=lambda name: -followers.count(name))  # stable: the file's order else
        hand.driver, hand.more_drivers = drivers[0], tuple(drivers[1:])
    branches = []
    for joint in _next(robot, wrist):
        shaped = [link for link in robot.beyond(joint.child) if link in boxes]
        if shaped:
            branches.append(max(shaped, key=lambda link: len(robot.path(link))))
    start = len(robot.path(wrist))
    branches.sort(key=lambda link: start - len(robot.path(link)))
    if len(branches) >= 2:
        hand.pads = (branches[0], branches[1])
    carrier = robot.joints[hand.driver].parent if hand.driver else max(beyond, key=lambda link: len(robot.path(link)))
    rigid = [j for j in robot.path(carrier)[start:] if j.type == "fixed"]
    told = [j.name for j in rigid if _FORCE.search(j.name + " " + j.child)]
    hand.sensor = told[0] if told else rigid[0].name if rigid else None
    palm = robot.joints[hand.sensor].child if hand.sensor else wrist
    if hand.driver and hand.pads:
        _grip(robot, hand, palm, boxes)
    return hand


def _grip(robot: Robot, hand: Hand, palm: str, boxes: Boxes) -> None:
    """The grip between the pads (z the approach, y the closing direction), their surface, and the opening."""
    assert hand.driver is not None
    a, b = hand.pads
    found = []
    for q in robot.joints[hand.driver].range:
        if not math.isfinite(q):
            return
        poses = robot.poses({hand.driver: q})
        X = np.linalg.inv(poses[palm])
        found.append((X @ poses[a], X @ poses[b]))
    middles = [[(X @ np.append(boxes[pad].mean(axis=0), 1.0))[:3] for X, pad in zip(pair, (a, b))] for pair in found]
    gaps = [float(np.linalg.norm(p - r)) for p, r in middles]
    shut, open_ = (0, 1) if gaps[0] < gaps[1] else (1, 0)
    middle = (middles[shut][0] + middles[shut][1]) / 2
    y = middles[open_][0] - middles[open_][1]
    z = middle - (middle @ y) / (y @ y) * y
    if np.linalg.norm(y) < 1e-3 or np.linalg.norm(z) < 1e-3:
        return
    y, z = _snapped(y), _snapped(z)
    z = z - (z @ y) * y
    z /= np.linalg.norm(z)
    hand.pad_at, hand.pad_size = _surface(boxes[a], found[shut][0][:3, :3].T @ np.stack([y, z], axis=1))
    surface = [(pair[0] @ np.append(hand.pad_at, 1.0))[:3] for pair in found]
    xyz = middle + ((surface[shut] - middle) @ z) * z
    hand.opening = math.floor(2e3 * float((surface[open_] - xyz) @ y)) / 1e3
    R = np.stack([np.cross(y, z), y, z], axis=1)
    hand.grip = palm, np.round(xyz, 3) + 0.0, np.round(_rpy(R), 4) + 0.0


def _surface(box: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and size (along the bar, along the approach) of the gripping surface of a pad, near its end.

    axes: (3, 2) the closing direction, from the other pad to this, and the approach, in the pad's link.
    """
    at = box.mean(axis=0)
    close = int(np.argmax(np.abs(axes[:, 0])))
    reach = max((k for k in range(3) if k != close), key=lambda k: abs(axes[k, 1]))
    width = 3 - close - reach
    at[close] = box[0 if axes[close, 0] > 0 else 1, close]
    length = float(np.ptp(box[:, reach]))
    if length > 2 * PAD_LENGTH:  # a long finger holds with its end
        end = box[1, reach] if axes[reach, 1] > 0 else box[0, reach]
        at[reach] = end - np.sign(axes[reach, 1]) * PAD_LENGTH
    size = np.array([min(PAD_LENGTH, float(np.ptp(box[:, width])) / 2), min(0.8 * PAD_LENGTH, length / 2)])
    return np.round(at, 4) + 0.0, np.round(size, 4)


def _snapped(direction: np.ndarray) -> np.ndarray:
    unit = direction / np.linalg.norm(direction)
    k = int(np.argmax(np.abs(unit)))
    return np.sign(unit[k]) * np.eye(3)[k] if abs(unit[k]) > math.cos(SNAP) else unit


def _rpy(R: np.ndarray) -> np.ndarray:
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) < 1e-9:
        return np.array([0.0, pitch, math.atan2(-R[0, 1], R[1, 1])])
    return np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])])


def _footprint(robot: Robot, boxes: Boxes, poses: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Half length and half width of what stands on the floor: all that no joint but a wheel's moves."""
    corners = [np.zeros((1, 3))]
    todo = [robot.root]
    for link in todo:
        if link in boxes:
            corners.append(corners_in(poses[link], boxes[link]))
        todo += [j.child for j in robot.below(link) if j.type == "fixed" or _WHEEL.search(j.name + j.child)]
    x, y, _ = np.abs(np.concatenate(corners)).max(axis=0)
    return math.ceil(x * 100) / 100, math.ceil(y * 100) / 100


def corners_in(X: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(8, 3) a box's corners, taken through X."""
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    return corners @ X[:3, :3].T + X[:3, 3]


def _as_the_marks(rgba: tuple[float, ...]) -> bool:
    """Saturated red or green, as the marker and its handles are."""
    r, g, b = rgba[:3]
    return (r > 0.25 and g < 0.5 * r and b < 0.5 * r) or (g > 0.25 and r < 0.5 * g and b < 0.65 * g)


# ---------------------------------------------------------------- the text


def draft(robot: Robot, found: Guess, model: str, mends: Iterable[str]) -> tuple[str, list[str]]:
    """The robot.yaml, and what is still to be done in it, a line each."""
    todo: list[str] = []

    def ask(text: str) -> str:
        todo.append(text)
        return f"# TODO {text}"

    lines = [f"# Draft of `valve-drake import-robot` for {robot.name}. What is marked TODO has to be looked at."]
    lines += [f"# mended: {line}" for line in mends]
    lines.append(f"model: {model}")
    if found.weld:
        lines += _list("weld", found.weld)
        lines.append(ask("weld: these joints are in no group below and are held at zero. Is any of them needed?"))
    lines.append(
        "counterbalanced: false  " + ask("counterbalanced: true if springs carry the arms, and not their motors")
    )
    lines += [
        "base:",
        f"  frame: {_key(found.base)}",
        f"  drive: {found.drive}  " + ask("base.drive: holonomic, differential or fixed: from the wheels' names"),
        f"  footprint: [{found.footprint[0]:g}, {found.footprint[1]:g}]  # half length, half width of the shapes [m]",
    ]
    if found.drive != "fixed":
        sideways = [0.5] if found.drive == "holonomic" else []
        lines += [
            f"  speed: {_flow([0.5, *sideways, 0.8])}  "
            + ask("base.speed, base.acceleration: forward, (sideways,) yaw: what the drive can do [m/s, rad/s]"),
            f"  acceleration: {_flow([0.5, *sideways, 1.0])}",
        ]
    if found.lift:
        middle = [_home(robot.joints[name]) for name in found.lift]
        speeds = [min(robot.joints[name].limit("velocity") or 0.05, 0.1) for name in found.lift]
        lines.append(f"lift: {{joints: {_flow(found.lift)}, home: {_flow(middle)}, speed: {_flow(speeds)}}}")
    lines += _gaze(robot, found, ask)
    lines += _arm_lines(robot, found, ask)
    lines += _gripper_lines(robot, found, ask)
    lines += _frame_lines(found, ask)
    lines.append("# head_calibration: " + ask("head_calibration: a file by `calibrate stereo`, beside this one")[2:])
    lines.append("# taught: " + ask("taught: a file beside this one, which `teach` makes")[2:])
    if found.colors:
        lines.append("colors:  # red and green are the colours of the marks")
        lines += [f"  {_key(name)}: [0.5, 0.5, 0.5, 1]" for name in found.colors]
    lines.append("collision: {ignore: touching_at_home, padding: 0.01}")
    return "\n".join(lines) + "\n", todo


def _gaze(robot: Robot, found: Guess, ask: Ask) -> list[str]:
    if found.pan is None and found.tilt is None:
        return ["# gaze: " + ask("gaze: no joint of a head was found: the cameras look where the base stands")[2:]]
    poses, lines = robot.poses(), ["gaze:"]
    for key, name, axis, way in (("pan", found.pan, 2, "to the left"), ("tilt", found.tilt, 1, "downwards")):
        if name is None:
            lines.append(f"  # {key}: " + ask(f"gaze.{key}: no such joint of a head was found")[2:])
        else:
            backwards = _axis(robot.joints[name], poses)[axis] < 0
            lines.append(f"  {key}: {_key(name)}  # turns {'the other way than ' if backwards else ''}{way}")
    if found.waist:
        lines.append(f"  waist: {_key(found.waist)}")
    speeds = [robot.joints[name].limit("velocity") or 1.0 for name in (found.pan, found.tilt) if name]
    lines.append(f"  speed: {min(1.5, *speeds, 1.5):g}")
    return lines


def _arm_lines(robot: Robot, found: Guess, ask: Ask) -> list[str]:
    if not found.arms:
        return [
            "# arms: " + ask(f"arms: no two chains of {LEAST_ARM} joints with names that differ by left and right")[2:],
        ]
    lines = ["arms:"]
    for side, names in found.arms.items():
        joints = [robot.joints[name] for name in names]
        home = [_home(joint) for joint in joints]
        efforts = [joint.limit("effort") or 0.0 for joint in joints]
        stiffness = [_round(min(max(STIFFNESS_PER_EFFORT * effort, 200.0), 20000.0)) for effort in efforts]
        lines.append(f"  {side}:")
        lines += _list("joints", names, "    ")
        say = ask if side == "left" else (lambda text: f"# TODO {text}")
        lines += [
            f"    home: {_flow(home)}  " + say("arms.*.home: folded, free of collision, out of the eyes' view"),
            f"    work: {_flow(home)}  " + say("arms.*.work: the arm at the valve, elbow where it should be"),
            f"    stiffness: {_flow(stiffness)}  # {STIFFNESS_PER_EFFORT:g} times the effort limits",
        ]
        weak = [name for name, effort in zip(names, efforts) if not effort]
        if weak:
            lines.append("    " + ask(f"arms.{side}: no effort limit in the model, so no actuator: {', '.join(weak)}"))
        sensor = found.hands[side].sensor
        if sensor is None:
            say_ = ask("arms.*.sensor: no fixed joint beyond the arm: forces come from the joints' torques")
            noise = ask("arms.*.torque_noise: of a joint's torque reading, standard deviation [N m]")
            guess = [round(NOISE_PER_EFFORT * (effort or 1.0), 3) for effort in efforts]
            lines += [f"    sensor: torque  {say_}", f"    torque_noise: {_flow(guess)}  {noise}"]
        else:
            lines.append(
                f"    sensor: {_key(sensor)}  " + say("arms.*.sensor: the fixed joint in which forces are measured")
            )
    fast = []
    for k in range(len(found.arms["left"])):
        limits = [robot.joints[arm[k]].limit("velocity") or 1.0 for arm in found.arms.values()]
        fast.append(round(min(0.6 * min(limits), 2.0), 2))
    lines.append(f"arm_speed: {_flow(fast)}  # 0.6 of the velocity limits, 2 rad/s at most")
    return lines


def _gripper_lines(robot: Robot, found: Guess, ask: Ask) -> list[str]:
    if not found.arms:
        return []
    lines = ["grippers:"]
    for side, hand in found.hands.items():
        if hand.driver is None:
            lines.append(f"  # {side}: " + ask(f"grippers.{side}: no moving joint beyond the arm")[2:])
            continue
        pads = _flow(hand.pads) if hand.pads else "[]  " + ask(f"grippers.{side}.pads: two links that close on the bar")
        lines += [f"  {side}:", f"    joint: {_key(hand.driver)}", f"    pads: {pads}"]
        if not robot.joints[hand.driver].limit("effort"):
            lines[-2] += "  " + ask(f"grippers.{side}: {hand.driver} has no effort limit in the model, so no actuator")
        elif hand.more_drivers:
            rest = ", ".join(hand.more_drivers)
            lines[-2] += "  " + ask(f"grippers.{side}: {rest} do not follow it: give them a <mimic>, or weld them")
    opening = min((hand.opening for hand in found.hands.values()), default=0.0)
    lines += [
        f"opening: {opening:g}  " + ask("opening: between the open pads' surfaces [m], from the shapes' boxes"),
    ]
    shaped = next((hand for hand in found.hands.values() if hand.pad_at is not None), None)
    say = ask("pad: the middle of the gripping surface in the first pad's link [m], its size [m], from its box")
    if shaped is not None and shaped.pad_at is not None and shaped.pad_size is not None:
        lines.append(f"pad: {{at: {_flow(shaped.pad_at)}, size: {_flow(shaped.pad_size)}, friction: 0.8}}  {say}")
    else:
        lines.append("# " + say[2:])
    return lines


def _frame_lines(found: Guess, ask: Ask) -> list[str]:
    frames, grips = [], [(side, hand.grip) for side, hand in found.hands.items() if hand.grip]
    for side, (link, xyz, rpy) in grips:
        frames.append(f"  {side}_grip: {{link: {_key(link)}, xyz: {_flow(xyz)}, rpy: {_flow(rpy)}}}")
    for key in found.turned:
        link = found.cameras[key]
        note = ask(f"frames.{key}_camera: {link} looks along its x, as ROS has it: z must look, x to the right")
        frames.append(f"  {key}_camera: {{link: {_key(link)}, rpy: {_flow(_OPTICAL)}}}  {note}")
    lines = []
    if found.arms and not grips:
        lines.append("# " + ask("frames: left_grip, right_grip {link, xyz, rpy}: no two pads were found")[2:])
    if frames:
        lines += ["frames:", *frames]
    if grips:
        lines.insert(-len(frames), ask("frames: the grips between the pads: z the approach, y the closing direction"))
    if found.cameras:
        names = {key: f"{key}_camera" if key in found.turned else link for key, link in found.cameras.items()}
        lines.append(f"cameras: {{{', '.join(f'{key}: {_key(name)}' for key, name in names.items())}}}")
    if "head_left" not in found.cameras:
        lines.append(ask("cameras.head_left: no camera's frame was found on the head: z forward, x to the right"))
    elif found.second_eye is None:
        lines.append(ask("cameras: no second eye in the model: the valve is found with two"))
    if any(f"{side}_wrist" not in found.cameras for side in found.arms):
        lines.append(ask("cameras.*_wrist: no camera beyond the arms' last joints: mount them, or servo: none"))
    return lines


def _cameras(
    robot: Robot, eye: str | None, hands: Mapping[str, Hand], poses: Mapping[str, np.ndarray]
) -> tuple[dict[str, str], list[str]]:
    """The cameras' links by their keys, and the keys of those that look along x and not along z."""
    cameras, turned = {}, []
    if eye is not None:
        cameras["head_left"] = eye
        if _along_x(poses[eye], np.array([1.0, 0, 0])):
            turned.append("head_left")
    for side, hand in hands.items():
        if hand.camera is None:
            continue
        cameras[f"{side}_wrist"] = hand.camera
        if hand.grip is not None:
            palm, _, rpy = hand.grip
            if _along_x(poses[hand.camera], poses[palm][:3, :3] @ rotation(rpy)[:, 2]):
                turned.append(f"{side}_wrist")
    return cameras, [key for key in turned if f"{key}_camera" not in robot.links]


def _along_x(X: np.ndarray, forward: np.ndarray) -> bool:
    """Whether a frame's x rather than its z looks along a direction of the root."""
    return bool(X[:3, 0] @ forward > max(X[:3, 2] @ forward, 0.5))


def _home(joint: Joint) -> float:
    low, high = joint.range
    if low <= 0.0 <= high and joint.type != "prismatic":
        return 0.0
    return round((low + high) / 2, 3) if math.isfinite(low + high) else 0.0


def _round(value: float) -> float:
    """Two digits."""
    return float(f"{value:.2g}")


def _key(name: str) -> str:
    """A name as a key of YAML."""
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_./-]*", name) and name.lower() not in _WORDS
    return name if plain else "'" + name.replace("'", "''") + "'"


def _flow(values: Iterable[object]) -> str:
    return "[" + ", ".join(_key(v) if isinstance(v, str) else f"{v:g}" for v in values) + "]"


def _list(key: str, names: list[str], indent: str = "") -> list[str]:
    """A list of names, wrapped."""
    lines, current = [], f"{indent}{key}: ["
    space = " " * len(current)
    for k, name in enumerate(names):
        word = _key(name) + (", " if k < len(names) - 1 else "]")
        if len(current) + len(word) > 112 and current.strip():
            lines.append(current.rstrip())
            current = space
        current += word
    return [*lines, current]
