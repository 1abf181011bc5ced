"""The draft of a robot.yaml: what names and the tree of a model tell, and what is still to be filled in and why.

Two arms are the longest chains whose joints have the same names but for left and right. Guesses are made from names,
axes at zero and the extents of the shapes; each that somebody has to look at is marked `# TODO`.
Lengths [m], angles [rad].
"""

import dataclasses as dc
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from valve_drake.robot.urdf import Joint, Robot, rotation

LEAST_ARM = 4  # joints of a chain that is taken for an arm
SERVES = 5  # joints that an arm of a run has at least
SIDES_APART = 0.05  # between the beginnings of two arms that names do not tell apart [m]
ABOVE = 0.15  # the shoulders: where an eye may be mounted on a robot without a head [m]
LEAST_FOOTPRINT = 0.05  # that a robot.yaml may have [m]
SPEED_SHARE = 0.6  # of a joint's velocity limit
LEAST_OPEN = 0.01  # that a robot.yaml may have [m]
MOST_OPEN = 0.085  # of which a draft makes use [m]
SNAP = math.radians(15)  # a grip's axis this near to an axis of its link is that axis
PAD_LENGTH = 0.02  # of a pad's surface; half of it on either side of its middle [m]
_OPTICAL = (-math.pi / 2, 0.0, -math.pi / 2)  # roll, pitch, yaw from x forward, z up to z forward, x to the right
STIFFNESS_PER_EFFORT = 130.0  # a joint's stiffness [N m/rad] for each N m of its limit: full effort at 8 mrad
NOISE_PER_EFFORT = 0.005  # a guess at what a joint's torque reads off by, as a share of its limit
Ask = Callable[[str], str]  # notes what is to be done -> the comment that says it
Boxes = Mapping[str, np.ndarray]  # link -> (2, 3) least and greatest corner of its shapes in its own frame [m]
Points = Mapping[str, np.ndarray]  # link -> (n, 3) corners of its shapes' faces, in its own frame [m]

_SIDE = re.compile(
    r"left|right|Left|Right|LEFT|RIGHT|(?<![A-Za-z0-9])[lrLR](?![A-Za-z0-9])|^[lrLR](?=[aA]rm|ARM)|^[LR](?=[A-Z][a-z])"
)
_OTHER = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}
_OTHER |= {right: left for left, right in _OTHER.items()}
_FINGER = re.compile(r"grip|finger|thumb|jaw|knuckle|hand", re.IGNORECASE)
_LEG = re.compile(r"(?<![a-z])(hip|leg|thigh|knee|calf|ankle|foot)(?![a-z])|_(hip|leg)_", re.IGNORECASE)
_CAMERA = re.compile(r"camera|(?<![a-z])cam(?![a-z])|optical|stereo|(?<![a-z])eye|zed|realsense|kinect", re.IGNORECASE)
_HEAD = re.compile(r"head|neck", re.IGNORECASE)
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
    opening: float = 0.0  # what the fingers open to; 0: not told
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
    eye: tuple[str, np.ndarray, np.ndarray] | None  # where one may be mounted if there is none: link, xyz, rpy
    weld: list[str]
    carrying: list[str]  # of `weld`: those between the base and both arms
    by_place: bool  # the arms are told by where they are, and not by their names
    colors: list[str]


def guess(
    robot: Robot, boxes: Boxes, points: Points, colors: Mapping[str, tuple[float, ...]], words: Iterable[str]
) -> Guess:
    """colors: the materials of the model, r, g, b, a in 0..1. words: names of links and meshes: they tell the drive."""
    arms = find_arms(robot)
    poses = robot.poses()
    common = _common(robot, arms)
    lift = [j.name for j in common if j.type == "prismatic" and abs(_axis(j, poses)[2]) > 0.9]
    waists = [j.name for j in common if j.type != "prismatic" and abs(_axis(j, poses)[2]) > 0.9]
    pan, tilt, eye, second, top = _head(robot, arms, common, poses)
    hands = {side: _hand(robot, joints, boxes, points) for side, joints in arms.items()}
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
        eye=_mounted(robot, arms, top, boxes, poses) if eye is None else None,
        weld=weld,
        carrying=[joint.name for joint in common if joint.name in weld],
        by_place=bool(arms) and mirrored(arms["left"][0]) != arms["right"][0],
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
    """`left` and `right`: the joints of the two longest chains that begin with the same name but for the side.

    If names tell of none, the two longest that begin at the same place but for the side; or nothing.
    """
    best: tuple[list[str], list[str]] = [], []
    for joint in robot.joints.values():
        twin = robot.joints.get(mirrored(joint.name))
        if _begins(joint) and side_of(joint.name) == "left" and twin is not None and twin.moving:
            pair = _chain(robot, joint), _chain(robot, twin)
            if min(map(len, pair)) > min(map(len, best)):
                best = pair
    if min(map(len, best)) < LEAST_ARM:
        best = _arms_by_place(robot)
    return dict(zip(("left", "right"), best)) if min(map(len, best)) >= LEAST_ARM else {}


def _begins(joint: Joint) -> bool:
    return joint.moving and not _LEG.search(joint.name)


def _chain(robot: Robot, joint: Joint) -> list[str]:
    """A joint and those that follow it one by one, up to a hand."""
    chain, current = [joint.name], joint
    while len(following := _next(robot, current.child)) == 1:
        current = following[0]
        last = _FINGER.search(current.name) and len(_next(robot, current.child)) < 2  # a jaw, and no wrist
        if current.type == "prismatic" or current.mimic or last:
            break
        chain.append(current.name)
    return chain


def _arms_by_place(robot: Robot) -> tuple[list[str], list[str]]:
    """The longest two chains whose beginnings are mirror images of each other; of several, those in front."""
    poses = robot.poses()
    found: list[tuple[list[str], np.ndarray]] = []
    for joint in robot.joints.values():
        chain = _chain(robot, joint) if _begins(joint) else []
        if len(chain) >= LEAST_ARM:
            inner = {name for other, _ in found for name in other}
            found = [(other, place) for other, place in found if other[0] not in chain]
            if joint.name not in inner:
                found.append((chain, poses[joint.child][:3, 3]))
    pairs = []
    for left, p in found:
        for right, r in found:
            off = float(np.linalg.norm(p - r * [1, -1, 1]))
            if p[1] - r[1] > SIDES_APART and off < (p[1] - r[1]) / 2:
                pairs.append((min(len(left), len(right)), round(float(p[0]), 3), -off, left, right))
    return max(pairs)[3:] if pairs else ([], [])


def _common(robot: Robot, arms: Mapping[str, list[str]]) -> list[Joint]:
    """The moving joints that carry both arms."""
    if not arms:
        return []
    left, right = (robot.path(robot.joints[arms[side][0]].parent) for side in ("left", "right"))
    return [joint for joint in left if joint.moving and joint in right]


def _head(
    robot: Robot, arms: Mapping[str, list[str]], common: list[Joint], poses: Mapping[str, np.ndarray]
) -> tuple[str | None, str | None, str | None, str | None, str | None]:
    """Pan, tilt, the left eye's frame, the right eye's, and the head's last link."""
    limbs = {link for arm in arms.values() for link in robot.beyond(robot.joints[arm[0]].child)}
    carried = {joint.name for joint in common}

    def own(link: str) -> list[Joint]:
        return [joint for joint in robot.path(link) if joint.moving and joint.name not in carried]

    seen = [link for link in robot.links if _CAMERA.search(link) and link not in limbs]
    eyes = [link for link in seen if own(link)] or [link for link in seen if "head" in link.lower()]
    others = [link for link in robot.links if link not in limbs and own(link)]
    heads = [link for link in others if _HEAD.search(link) or any(_HEAD.search(joint.name) for joint in own(link))]
    if not heads and arms:
        heads = _above_the_arms(robot, arms, others, own, poses)
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
    return pan, tilt, eye, second, top


def _above_the_arms(
    robot: Robot,
    arms: Mapping[str, list[str]],
    links: Iterable[str],
    own: Callable[[str], list[Joint]],
    poses: Mapping[str, np.ndarray],
) -> list[str]:
    """Links that stand for a head which is not called one: above the shoulders, turned by one to three joints."""
    shoulders = min(poses[robot.joints[arm[0]].child][2, 3] for arm in arms.values())
    legs = (_LEG, _WHEEL, _FINGER)

    def turns(joint: Joint) -> bool:
        return joint.type != "prismatic" and not any(kind.search(joint.name + " " + joint.child) for kind in legs)

    return [
        link for link in links if poses[link][2, 3] > shoulders and len(own(link)) <= 3 and all(map(turns, own(link)))
    ]


def _mounted(
    robot: Robot, arms: Mapping[str, list[str]], top: str | None, boxes: Boxes, poses: Mapping[str, np.ndarray]
) -> tuple[str, np.ndarray, np.ndarray] | None:
    """Where an eye may be mounted, looking ahead: on the front of the head, else above the middle of the shoulders."""
    if top is not None:
        box = corners_in(poses[top], boxes[top]) if top in boxes else poses[top][None, :3, 3]
        low, high = box.min(axis=0), box.max(axis=0)
        link, at = top, np.array([high[0] + 0.01, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2])
    elif arms:
        first = [robot.joints[arm[0]] for arm in arms.values()]
        paths = [[robot.root, *(joint.child for joint in robot.path(joint.parent))] for joint in first]
        link = [a for a, b in zip(*paths) if a == b][-1]
        at = np.mean([poses[joint.child][:3, 3] for joint in first], axis=0) + [0, 0, ABOVE]
    else:
        return None
    X = np.linalg.inv(poses[link])
    rpy = _rpy(X[:3, :3] @ rotation(np.array(_OPTICAL)))
    return link, np.round((X @ np.append(at, 1.0))[:3], 3) + 0.0, np.round(rpy, 4) + 0.0


def _hand(robot: Robot, arm: list[str], boxes: Boxes, points: Points) -> Hand:
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
        _grip(robot, hand, palm, boxes, points)
    return hand


def couple_fingers(robot: Robot) -> list[str]:
    """Makes the second of two fingers of a hand follow the first, if they are mirror images -> a line for each.

    A gripper of a run has one motor; a file whose fingers both have one, as simulators like it, says how they close
    together by their places, axes and ranges.
    """
    lines = []
    for arm in find_arms(robot).values():
        beyond = robot.beyond(robot.joints[arm[-1]].child)
        both = [j for j in robot.joints.values() if j.moving and j.parent in beyond]
        if len(both) != 2 or any(j.mimic for j in both) or both[0].type != both[1].type:
            continue
        first, second = both
        scale = _mirrors(robot, first, second)
        if scale is None:
            continue
        ET.SubElement(second.element, "mimic", {"joint": first.name, "multiplier": f"{scale:g}"})
        for part in robot.element.findall("transmission"):
            driven = part.find("joint")
            if driven is not None and driven.get("name") == second.name:
                robot.element.remove(part)
        lines.append(
            f"joint '{second.name}': follows '{first.name}' by {scale:g}: its finger is that one's mirror image"
        )
    return lines


def _mirrors(robot: Robot, first: Joint, second: Joint) -> float | None:
    """1 or -1: how the second finger's joint follows the first one's for both to close alike; None: they do not."""
    low, high = first.range
    poses = robot.poses()
    for scale in (-1.0, 1.0):
        alike = math.isfinite(low + high) and np.allclose(sorted((scale * low, scale * high)), second.range, atol=1e-3)
        if alike and np.linalg.norm(_axis(first, poses) + scale * _axis(second, poses)) < 0.05:
            return scale
    return None


def _grip(robot: Robot, hand: Hand, palm: str, boxes: Boxes, points: Points) -> None:
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
    y = middles[1][0] - middles[1][1] - (middles[0][0] - middles[0][1])  # how the first pad leaves the other
    middle = (middles[0][0] + middles[0][1]) / 2
    if np.linalg.norm(y) < 1e-3:
        return
    z = middle - (middle @ y) / (y @ y) * y
    if np.linalg.norm(z) < 1e-3:
        return
    y, z = _snapped(y), _snapped(z)
    z = z - (z @ y) * y
    z /= np.linalg.norm(z)
    ends = [[_end(X, points.get(pad), boxes[pad], z) for X, pad in zip(pair, (a, b))] for pair in found]
    gaps = [float((p - r) @ y) for p, r in ends]
    shut, open_ = (0, 1) if abs(gaps[0]) < abs(gaps[1]) else (1, 0)
    y = y * np.sign(gaps[open_])
    middle = (middles[shut][0] + middles[shut][1]) / 2
    axes = np.stack([y, z], axis=1)
    hand.pad_at, hand.pad_size = _surface(boxes[a], points.get(a), found[shut][0][:3, :3].T @ axes)
    other, _ = _surface(boxes[b], points.get(b), found[shut][1][:3, :3].T @ (axes * [-1, 1]))
    surface = [(pair[0] @ np.append(hand.pad_at, 1.0))[:3] for pair in found]
    opposite = (found[shut][1] @ np.append(other, 1.0))[:3]
    xyz = middle + ((surface[shut] - middle) @ z) * z + (((surface[shut] + opposite) / 2 - middle) @ y) * y
    hand.opening = math.floor(2e3 * float((surface[open_] - xyz) @ y) + 1e-6) / 1e3
    R = np.stack([np.cross(y, z), y, z], axis=1)
    hand.grip = palm, np.round(xyz, 3) + 0.0, np.round(_rpy(R), 4) + 0.0


def _end(X: np.ndarray, points: np.ndarray | None, box: np.ndarray, z: np.ndarray) -> np.ndarray:
    """The middle of what is near the end of a finger whose link is at X, along the approach z (3,)."""
    corners = corners_in(X, box) if points is None else points @ X[:3, :3].T + X[:3, 3]
    along = corners @ z
    near = corners[along > along.max() - 2 * PAD_LENGTH]
    return np.mean([near.min(axis=0), near.max(axis=0)], axis=0)


def _surface(box: np.ndarray, points: np.ndarray | None, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and size (along the bar, along the approach) of the gripping surface of a pad, near its end.

    points: corners of the pad's shapes (n, 3): those near its end tell where the surface is, since a finger may be
    crooked. axes: (3, 2) the closing direction, from the other pad to this, and the approach. All in the pad's link.
    """
    close = int(np.argmax(np.abs(axes[:, 0])))
    reach = max((k for k in range(3) if k != close), key=lambda k: abs(axes[k, 1]))
    width = 3 - close - reach
    length = float(np.ptp(box[:, reach]))
    end = box[1, reach] if axes[reach, 1] > 0 else box[0, reach]
    if points is not None:
        near = points[np.abs(points[:, reach] - end) <= 2 * PAD_LENGTH]
        if len(near) >= 4 and min(np.ptp(near[:, close]), np.ptp(near[:, width])) > 1e-3:
            box = np.stack([near.min(axis=0), near.max(axis=0)])
    at = box.mean(axis=0)
    at[close] = box[0 if axes[close, 0] > 0 else 1, close]
    if length > 2 * PAD_LENGTH:  # a long finger holds with its end
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
        if found.carrying:
            names = ", ".join(found.carrying)
            lines.append(
                ask(f"lift: {names}: below both arms: those that are not to stand at zero belong in lift.joints")
            )
    lines.append(
        "counterbalanced: false  " + ask("counterbalanced: true if springs carry the arms, and not their motors")
    )
    footprint = "# half length, half width of the shapes [m]"
    if min(found.footprint) < LEAST_FOOTPRINT:
        footprint = ask("base.footprint: half length, half width [m]: the base has no shape in the model")
    lines += [
        "base:",
        f"  frame: {_key(found.base)}",
        f"  drive: {found.drive}  " + ask("base.drive: holonomic, differential or fixed: from the wheels' names"),
        "  footprint: " + _flow(max(half, LEAST_FOOTPRINT) for half in found.footprint) + "  " + footprint,
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
        return ["# gaze: " + ask("gaze: no joint of a head was found: the eyes look where they are mounted")[2:]]
    poses, lines = robot.poses(), ["gaze:"]
    for key, name, axis, way in (("pan", found.pan, 2, "to the left"), ("tilt", found.tilt, 1, "downwards")):
        if name is None:
            lines.append(f"  # {key}: " + ask(f"gaze.{key}: no such joint of a head was found: does it turn so?")[2:])
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
    if found.by_place:
        lines.append(ask("arms: told by where they are, since their names differ by more than left and right"))
    alike = len({len(names) for names in found.arms.values()}) == 1
    for side, names in found.arms.items():
        if len(names) < SERVES:
            lines.append(ask(f"arms.{side}.joints: a run needs {SERVES} joints or more, these are {len(names)}"))
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
        if not alike:
            lines.append(f"    speed: {_flow(_speeds([joint] for joint in joints))}  # {SPEED_SHARE:g} of its limits")
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
    if alike:
        pairs = zip(*([robot.joints[name] for name in names] for names in found.arms.values()))
        lines.append(f"arm_speed: {_flow(_speeds(pairs))}  # {SPEED_SHARE:g} of the velocity limits, 2 rad/s at most")
    return lines


def _speeds(groups: Iterable[Iterable[Joint]]) -> list[float]:
    """What the slowest of each group's joints may do [rad/s]."""
    return [
        round(min(2.0, *(SPEED_SHARE * (joint.limit("velocity") or 1.0) for joint in group)), 2) for group in groups
    ]


def _gripper_lines(robot: Robot, found: Guess, ask: Ask) -> list[str]:
    if not found.arms:
        return []
    lines = ["grippers:"]
    for side, hand in found.hands.items():
        if hand.driver is None:
            what = f"no moving joint beyond the arm: a run needs a gripper, so add one to the URDF (link {hand.link})"
            lines.append(f"  # {side}: " + ask(f"grippers.{side}: {what}")[2:])
            continue
        pads = _flow(hand.pads) if hand.pads else "[]  " + ask(f"grippers.{side}.pads: two links that close on the bar")
        lines += [f"  {side}:", f"    joint: {_key(hand.driver)}", f"    pads: {pads}"]
        if not robot.joints[hand.driver].limit("effort"):
            lines[-2] += "  " + ask(f"grippers.{side}: {hand.driver} has no effort limit in the model, so no actuator")
        elif hand.more_drivers:
            rest = ", ".join(hand.more_drivers)
            lines[-2] += "  " + ask(f"grippers.{side}: {rest} do not follow it: give them a <mimic>, or weld them")
    if all(hand.driver is None for hand in found.hands.values()):
        lines[0] = "# grippers:"
    opening = min((hand.opening for hand in found.hands.values()), default=0.0)
    used = min(opening, MOST_OPEN)
    if used < LEAST_OPEN:
        lines.append("# " + ask("opening: between the open pads' surfaces [m]: the shapes do not tell it")[2:])
    else:
        of = f", of {opening:g}" if used < opening else ""
        lines.append(f"opening: {used:g}  " + ask(f"opening: between the open pads' surfaces [m]{of}, from the shapes"))
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
    if found.eye is not None:
        link, xyz, rpy = found.eye
        note = ask("frames.left_eye: a place for the left camera of a stereo head, since the model has none; z looks")
        frames.append(f"  left_eye: {{link: {_key(link)}, xyz: {_flow(xyz)}, rpy: {_flow(rpy)}}}  {note}")
    lines = []
    if found.arms and not grips:
        lines.append("# " + ask("frames: left_grip, right_grip {link, xyz, rpy}: no two pads were found")[2:])
    if frames:
        lines += ["frames:", *frames]
    if grips:
        lines.insert(-len(frames), ask("frames: the grips between the pads: z the approach, y the closing direction"))
    names = {key: f"{key}_camera" if key in found.turned else link for key, link in found.cameras.items()}
    if found.eye is not None:
        names = {"head_left": "left_eye", **names}
    if names:
        lines.append(f"cameras: {{{', '.join(f'{key}: {_key(name)}' for key, name in names.items())}}}")
    if "head_left" not in names:
        lines.append(ask("cameras.head_left: no camera's frame was found on the head: z forward, x to the right"))
    elif found.second_eye is None:
        lines.append(ask("cameras: no second eye in the model: the valve is found with two"))
    if found.arms and any(f"{side}_wrist" not in found.cameras for side in found.arms):
        lines.append(
            "servo: none  " + ask("servo: camera, with cameras.*_wrist beyond the arms' last joints: it has none")
        )
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
