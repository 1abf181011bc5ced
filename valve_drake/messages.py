"""The messages on the ports between blocks: frozen dataclasses of numpy arrays, no pydrake.

A message is immutable: its arrays are read-only and copying it returns itself, so that Drake's copies of a state cost
nothing and a reader may keep the message.
Times are seconds of the station's clock. Frames and units: frames.py.
"""

import dataclasses as dc
import enum
from typing import Any, Self

import numpy as np

POSE_HISTORY = 1.0  # length of the buffers of head and hand poses; older images are rejected [s]
LEFT, RIGHT = "left", "right"
SIDES = (LEFT, RIGHT)
HEAD, WRISTS = ("head_left", "head_right"), ("left_wrist", "right_wrist")  # cameras
CAMERAS = HEAD + WRISTS
DEVICES = ("base", "torso", *(f"{s}_{d}" for s in SIDES for d in ("arm", "gripper", "wrist_sensor")), *CAMERAS, "robot")


def array(*shape: int, fill: float = 0.0, optional: bool = False) -> Any:
    """A float64 array field of this shape; -1 is any length. `optional` fields are None by default."""
    if optional:
        return dc.field(default=None, metadata={"shape": shape, "optional": True, "default": None})
    return _shared(np.full(tuple(0 if n < 0 else n for n in shape), fill), shape)


def transform() -> Any:
    """A field for a rigid transform X as its 3x4 matrix [R | p]; identity by default."""
    return _shared(np.eye(3, 4), (3, 4))


def _shared(default: np.ndarray, shape: tuple[int, ...]) -> Any:
    """A field whose default all messages share: it is read-only."""
    default.setflags(write=False)
    return dc.field(default_factory=lambda: default, metadata={"shape": shape, "optional": False, "default": default})


@dc.dataclass(frozen=True, eq=False)
class Message:
    """Base of all messages. Array fields are checked for shape and made read-only."""

    def __post_init__(self) -> None:
        values = self.__dict__
        for name, shape, default in _array_fields(type(self)):
            value = values[name]
            if value is default:
                continue
            # Arrays that nobody can change are shared. The commonest tests first: messages are made in every tick.
            if not (
                type(value) is np.ndarray
                and value.dtype is _DOUBLE
                and value.base is None
                and not value.flags.writeable
            ):
                value = np.array(value, dtype=_DOUBLE)
                value.setflags(write=False)
                values[name] = value
            if value.shape == shape:  # an array of the field's own fixed shape needs no check
                continue
            if value.size == 0 and -1 in shape:
                value = value.reshape([0 if n < 0 else n for n in shape])
                value.setflags(write=False)
                values[name] = value
            if value.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, value.shape)):
                raise ValueError(f"{type(self).__name__}.{name} must have shape {shape}, got {value.shape}")

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self


_DOUBLE = np.dtype(np.float64)


_ARRAY_FIELDS: dict[type, list[tuple[str, tuple[int, ...], np.ndarray | None]]] = {}


def _array_fields(kind: type) -> list[tuple[str, tuple[int, ...], np.ndarray | None]]:
    """Name, shape and default of each array field; the default, None or an array that all share, needs no check."""
    fields = _ARRAY_FIELDS.get(kind)
    if fields is None:
        fields = _ARRAY_FIELDS[kind] = [
            (f.name, f.metadata["shape"], f.metadata["default"]) for f in dc.fields(kind) if "shape" in f.metadata
        ]
    return fields


# ---------------------------------------------------------------- station


@dc.dataclass(frozen=True, eq=False)
class CameraFrame(Message):
    """One image, as the program sees it: `image` is what the encoded bytes `data` decode to.

    `sequence` counts captures of this camera from 0; -1 means that nothing was captured yet.
    """

    camera: str = ""
    time: float = -1.0  # of capture [s]
    sequence: int = -1
    image: np.ndarray = dc.field(default_factory=lambda: np.zeros((0, 0, 3), np.uint8))  # (H, W, 3) RGB
    data: bytes = b""  # JPEG

    def __post_init__(self) -> None:
        self.image.setflags(write=False)


@dc.dataclass(frozen=True, eq=False)
class Health(Message):
    """The station's own report: seconds since each device last spoke, faults by name, e-stop."""

    time: float = 0.0
    devices: tuple[str, ...] = ()
    ages: np.ndarray = array(-1)  # [s], one for each device
    faults: tuple[str, ...] = ()
    estop: bool = False


@dc.dataclass(frozen=True, eq=False)
class RobotState(Message):
    """All joint-side measurements of one instant, and the head's recent motion."""

    time: float = 0.0
    # x, y [m], heading [rad], then the speeds that the base has: forward, sideways [m/s], yaw rate [rad/s]
    odometry: np.ndarray = _shared(np.zeros(5), (-1,))
    torso: np.ndarray = array(-1)  # lift, waist, tilt, pan, as far as there are [m, rad]
    left_arm: np.ndarray = array(-1)  # [rad]
    right_arm: np.ndarray = array(-1)
    left_arm_velocity: np.ndarray = array(-1)  # [rad/s]
    right_arm_velocity: np.ndarray = array(-1)
    left_arm_torque: np.ndarray = array(-1)  # [N m]
    right_arm_torque: np.ndarray = array(-1)
    left_gripper: float = 0.0  # opening between the pads [m]
    right_gripper: float = 0.0
    left_gripper_force: float = 0.0  # on the pads [N]
    right_gripper_force: float = 0.0
    left_wrench: np.ndarray = array(6)  # [torque; force] felt by the sensor, in its frame, raw
    right_wrench: np.ndarray = array(6)
    history: np.ndarray = array(-1, -1)  # rows, oldest first: t, x, y, heading, torso

    @property
    def twist(self) -> np.ndarray:
        """The base's speeds, as many as it has."""
        return self.odometry[3:]

    def head_at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Base (x, y, heading) in O [m, rad] and torso's joints at `time` [s], interpolated -> (3,), (n,)."""
        if len(self.history) == 0:
            return self.odometry[:3], self.torso
        t = self.history[:, 0]
        rows = self.history[:, 1:].T.copy()
        rows[2] = np.unwrap(rows[2])  # a heading may jump by a turn
        row = [np.interp(time, t, values) for values in rows]
        return np.array(row[:3]), np.array(row[3:])


# ---------------------------------------------------------------- perception


@dc.dataclass(frozen=True, eq=False)
class MarkerCandidate(Message):
    """One red region of one image; `rejected` says why it is not the marker ("" if it may be)."""

    corners: np.ndarray = array(4, 2)  # coarse, in order round the contour [px of the raw image]
    center: np.ndarray = array(2)  # centroid of the region [px]
    area: float = 0.0  # [px^2]
    score: float = 0.0
    rejected: str = ""


@dc.dataclass(frozen=True, eq=False)
class Segmentation(Message):
    """What color_segmentation found in one image of one head camera."""

    frame: CameraFrame = dc.field(default_factory=CameraFrame)
    candidates: tuple[MarkerCandidate, ...] = ()  # best first, rejected ones last
    green: np.ndarray = array(-1, 3)  # green marks: u, v [px], area [px^2]


@dc.dataclass(frozen=True, eq=False)
class SegmentationPair(Message):
    """Both head cameras at one capture time."""

    time: float = -1.0  # of capture [s]
    sequence: int = -1
    left: Segmentation = dc.field(default_factory=Segmentation)
    right: Segmentation = dc.field(default_factory=Segmentation)


@dc.dataclass(frozen=True, eq=False)
class QuadEdges(Message):
    """Sub-pixel edge of one quadrilateral in one image, in ideal (distortion-free) coordinates."""

    found: bool = False
    points: np.ndarray = array(-1, 2)  # edge points (x', y'), normalised, undistorted
    side: np.ndarray = array(-1)  # 0..3: the side that each point belongs to
    sigma: float = 0.0  # standard deviation of a point along the edge's normal [px]
    bias: np.ndarray = array(4)  # standard deviation of an error that moves all sides inward, or all outward [px]
    corners: np.ndarray = array(4, 2)  # intersections of the fitted lines, normalised
    # Of the distances of eight points, two on each side of `corners` at joint_fit.NODES of its length, from the side
    # (px of the raw image, positive inward); all zero where the points are all that is known [1/px^2].
    information: np.ndarray = array(8, 8)
    corners_px: np.ndarray = array(4, 2)  # the same in the raw image [px]
    center_px: np.ndarray = array(2)  # centroid of the coloured area in the raw image [px]
    green: np.ndarray = array(-1, 2)  # green marks (x', y'), normalised
    reason: str = ""  # why nothing was found


@dc.dataclass(frozen=True, eq=False)
class MarkerEdges(Message):
    time: float = -1.0
    sequence: int = -1
    left: QuadEdges = dc.field(default_factory=QuadEdges)
    right: QuadEdges = dc.field(default_factory=QuadEdges)


@dc.dataclass(frozen=True, eq=False)
class StereoPosition(Message):
    """Stage 1: the marker's centre."""

    time: float = -1.0
    sequence: int = -1
    found: bool = False
    p_LV: np.ndarray = array(3)  # in the left head camera [m]
    covariance: np.ndarray = array(3, 3)  # of p_LV [m^2]
    X_OL: np.ndarray = transform()  # the left head camera in odometry at `time`
    reason: str = ""


@dc.dataclass(frozen=True, eq=False)
class RectangleEstimate(Message):
    """Stage 2: the marker's pose.

    covariance: of (theta, dp) in R = R0 exp([theta]x), p = p0 + dp: theta in V, dp in L [rad^2, m^2].
    ambiguity: how much worse the mirrored candidate fits, as a difference of chi^2 (large is good).
    axis_known: the green marks or the track say which of the rectangle's axes is X.
    angle, angle_sigma: of a marker on the panel: how far the valve is turned from the zero of its keys, as the green
        marks beside it show, counter-clockwise for the robot, and its standard deviation [rad]; angle_seen: there were
        any. Valves that look alike after a part of a turn leave that open: it is followed from image to image.
    """

    time: float = -1.0
    sequence: int = -1
    found: bool = False
    method: str = ""
    cameras: int = 0  # 1 or 2 cameras took part
    X_LV: np.ndarray = transform()
    covariance: np.ndarray = array(6, 6)
    X_LV_other: np.ndarray = transform()  # the other candidate
    ambiguity: float = 0.0
    residual_px: float = 0.0
    axis_known: bool = False
    corners_left: np.ndarray = array(-1, 2)  # [px of the raw image]
    corners_right: np.ndarray = array(-1, 2)
    X_OL: np.ndarray = transform()
    reason: str = ""
    angle: float = 0.0
    angle_sigma: float = 0.0
    angle_seen: bool = False


@dc.dataclass(frozen=True, eq=False)
class HandleMark(Message):
    """The green mark in one wrist image. feature = (u, v, 1) / sqrt(area): see image_servo."""

    time: float = -1.0
    sequence: int = -1
    found: bool = False
    frame: CameraFrame = dc.field(default_factory=CameraFrame)
    center: np.ndarray = array(2)  # [px]
    area: float = 0.0  # of the fitted quadrilateral [px^2]
    corners: np.ndarray = array(-1, 2)  # [px]
    feature: np.ndarray = array(3)
    reason: str = ""


@dc.dataclass(frozen=True, eq=False)
class HandleMarks(Message):
    time: float = -1.0
    left: HandleMark = dc.field(default_factory=HandleMark)
    right: HandleMark = dc.field(default_factory=HandleMark)


# ---------------------------------------------------------------- behaviours and supervision


class Mode(enum.StrEnum):
    """What the robot is doing. Only the supervisor changes it."""

    IDLE = "idle"
    SEARCH = "search"
    ROUGH_APPROACH = "rough_approach"
    FINE_APPROACH = "fine_approach"
    MEASURE = "measure"
    REACH = "reach"
    SERVO = "servo"
    GRASP = "grasp"
    TURN = "turn"
    RELEASE = "release"
    FOLD = "fold"
    VERIFY = "verify"
    RETREAT = "retreat"
    DONE = "done"
    FAILED = "failed"
    STOPPED = "stopped"


class Cause(enum.StrEnum):
    """What a behaviour found where the verdict alone does not say what to try next; NONE: nothing more to say."""

    NONE = ""
    STANCE = "stance"  # the arms would reach from another place
    MOVED = "moved"  # the valve is no longer where it was measured
    UNSEEN = "unseen"  # the camera did not see the marker
    LOST_COUNT = "lost_count"  # tracking was lost: the valve may have turned by half a turn more, or less
    REGRASP = "regrasp"  # the hands turned the valve as far as one grasp reaches, and more is asked for


class Verdict(enum.StrEnum):
    """How a run ended; NONE while it is under way."""

    NONE = ""
    TURNED = "turned"
    END_STOP = "end_stop"
    STUCK = "stuck"
    SLIP = "slip"
    REACH_LIMIT = "reach_limit"
    NOT_FOUND = "not_found"
    MARKER_LOST = "marker_lost"
    GRASP_MISSED = "grasp_missed"
    TIMEOUT = "timeout"
    UNVERIFIED = "unverified"  # the hands turned it, but the camera could not confirm an angle that stands still
    FAULT = "fault"
    STOPPED = "stopped"


@dc.dataclass(frozen=True, eq=False)
class OperatorCommand(Message):
    """An operator's request; a new `sequence` makes it a new one. angle > 0 [rad]."""

    sequence: int = -1
    command: str = ""  # open | close | stop | reset; hold | resume: of a turn, the grasp is kept meanwhile
    angle: float = np.pi / 2


@dc.dataclass(frozen=True, eq=False)
class OperatorPacket(Message):
    """What one operator's desk said at one moment: that it is there, and its last words.

    Times are of the desk's own clock. sequence counts what was said from 1; 0: nothing yet.
    """

    speaker: int = 0  # a random number of the desk
    sent: float = 0.0  # [s]
    sequence: int = 0
    words: str = ""
    score: float = 0.0  # how sure the recogniser was, 0 to 1
    said: float = 0.0  # when the words were complete [s]
    begin: float = 0.0  # of the sound that they were heard in [s]
    end: float = 0.0
    typed: bool = False  # not heard, but entered
    leaves: bool = False  # it gives the robot's ear back


@dc.dataclass(frozen=True, eq=False)
class OperatorPackets(Message):
    """What has arrived from operators since the last time, in order; `count` makes it new."""

    time: float = 0.0  # of arrival [s]
    count: int = 0
    packets: tuple[OperatorPacket, ...] = ()


@dc.dataclass(frozen=True, eq=False)
class OperatorState(Message):
    """What the robot answers its operator, and what the desk shows."""

    time: float = 0.0  # of the last change [s]
    speaker: int = 0  # who has the robot's ear; 0: nobody
    linked: bool = False  # it was heard of late
    other: int = 0  # another one that spoke, and was refused; 0: none
    heard: int = 0  # sequence of the last words taken from `speaker`
    words: str = ""  # they
    score: float = 0.0
    outcome: str = ""  # ignored | listening | asked | answered | refused | given
    answers: int = 0  # counts what the robot has said; new: there is something new to read
    says: str = ""
    task: int = 0  # sequence of the words that gave the last command to turn
    done: bool = True  # it has ended
    verdict: str = ""  # how
    mode: str = Mode.IDLE.value
    reason: str = ""
    turned: float = 0.0  # by the hands, in whole degrees [deg]
    held: bool = False  # the turn waits for the operator
    sees: str = ""  # what the cameras make of their last images


@dc.dataclass(frozen=True, eq=False)
class ModeState(Message):
    """The mode, for all blocks. `activation` counts entries into a mode: a behaviour that reads a new number starts
    afresh, and its Status carries the number back."""

    time: float = 0.0
    mode: str = Mode.IDLE.value
    activation: int = 0
    since: float = 0.0  # when this mode was entered [s]
    attempt: int = 0  # retries of this mode so far, with the present grasp
    turn_angle: float = 0.0  # commanded turn, counter-clockwise for the robot [rad]
    verdict: str = Verdict.NONE.value
    reason: str = ""
    head_every: int = 0  # perception looks at every n-th pair of the head's images; 0: at none
    wrist_every: int = 0  # the same of the wrists' images
    afresh: bool = False  # it forgets what it followed from image to image
    held: bool = False  # the turn stands still and the grasp is kept, until the operator goes on


@dc.dataclass(frozen=True, eq=False)
class Status(Message):
    """The state of a behaviour in its present activation."""

    time: float = 0.0
    activation: int = -1
    state: str = "idle"  # idle | running | succeeded | failed
    verdict: str = Verdict.NONE.value  # why it failed
    detail: str = ""  # one line for people
    progress: float = 0.0  # 0..1
    value: float = 0.0  # the turned angle, in turn and verify [rad]
    seen: bool = False  # of verify: `value` is what the camera saw
    cause: str = Cause.NONE.value  # beside the verdict: what decides what is tried next


@dc.dataclass(frozen=True, eq=False)
class Command(Message):
    """What a behaviour commands the robot to do. None: it commands nothing to that group."""

    time: float = 0.0
    base_twist: np.ndarray | None = array(-1, optional=True)  # the speeds that the base has, as in RobotState.odometry
    torso: np.ndarray | None = array(-1, optional=True)  # [m, rad]
    left_arm: np.ndarray | None = array(-1, optional=True)  # [rad]
    right_arm: np.ndarray | None = array(-1, optional=True)
    left_gripper: np.ndarray | None = array(2, optional=True)  # opening [m], force limit [N]
    right_gripper: np.ndarray | None = array(2, optional=True)


@dc.dataclass(frozen=True, eq=False)
class PlanRequest(Message):
    """What kinematic_approach asks stance_planner for; a new `number` makes it a new question.

    kind: "grasps": where both hands hold the valve at X_BA from here, for a turn by `turn_angle`;
    "path": a collision-free way of both arms from `start` to `goal`, past the valve at X_BA.
    """

    number: int = -1
    kind: str = ""
    valve: bool = False  # there is a valve, at X_BA
    X_BA: np.ndarray = transform()  # its axis frame (valve/valve.py)
    posture: np.ndarray = array(-1)  # lift and waist as measured [m, rad]
    turn_angle: float = 0.0  # counter-clockwise for the robot [rad]
    start: np.ndarray = array(-1)  # both arms, left first [rad]
    goal: np.ndarray = array(-1)


@dc.dataclass(frozen=True, eq=False)
class PathPlan(Message):
    """The answer to a PlanRequest for a path: way points of both arms, left first."""

    number: int = -1
    found: bool = False
    points: np.ndarray = array(-1)  # N of them, one after the other (N * n,) [rad]


@dc.dataclass(frozen=True, eq=False)
class GraspPlan(Message):
    """The answer to a PlanRequest for grasps; kinematic_approach adds what it measured and passes it on.

    A hand's pose in the axis frame A (valve/valve.py) is constant while the valve turns, since A turns with it.
    """

    time: float = -1.0
    number: int = -1
    found: bool = False
    X_BA: np.ndarray = transform()  # the valve
    covariance: np.ndarray = array(6, 6)  # of the marker's pose in B, as in RectangleEstimate with L replaced by B
    handle_left: int = 0  # which of the valve's handles the hands take
    handle_right: int = 1
    turned: float = 0.0  # by the valve in this run before these grasps, as the camera saw it [rad]
    turn: float = 0.0  # how far these grasps turn it, at most what was asked for [rad]
    X_BG_left: np.ndarray = transform()  # grasps
    X_BG_right: np.ndarray = transform()
    q_standoff: np.ndarray = array(-1)  # both arms at the stand-offs before the grasps, left first [rad]
    posture: np.ndarray = array(-1)  # lift and waist from which they are reached [m, rad]
    margin: float = 0.0  # least arm margin over the whole turn, 1 is comfortable
    way: np.ndarray = array(-1)  # both arms at angles spread evenly over the turn, left first, pose by pose [rad]


@dc.dataclass(frozen=True, eq=False)
class ServoState(Message):
    """Image servoing of both hands; error is the hand's estimated distance from the reference, in its frame."""

    time: float = 0.0
    left_error: np.ndarray = array(3)  # [m]
    right_error: np.ndarray = array(3)
    left_converged: bool = False
    right_converged: bool = False


@dc.dataclass(frozen=True, eq=False)
class TurnState(Message):
    """The closed chain of both hands and the valve, as hybrid_rotation sees it.

    Wrenches are felt by the hands, in B, without gravity and bias. u is the valve's axis towards the robot.
    """

    time: float = 0.0
    number: int = -1  # of the GraspPlan that the hands follow
    stage: str = ""
    angle: float = 0.0  # turned in this run: the plan's `turned`, and since by the line between the hands [rad]
    angle_reference: float = 0.0
    rate: float = 0.0  # [rad/s]
    torque: float = 0.0  # that the hands put on the valve about u [N m]
    share_left: float = 0.5  # the left hand's part of it
    force_left: np.ndarray = array(3)  # [N]
    force_right: np.ndarray = array(3)
    moment_left: np.ndarray = array(3)  # at the grip point [N m]
    moment_right: np.ndarray = array(3)
    stem_force: np.ndarray = array(3)  # sum of both: the load on the stem beyond the couple [N]
    squeeze: float = 0.0  # along the bar, positive compresses it [N]
    center: np.ndarray = array(3)  # of the turn, between the hands along the axis, in B [m]
    axis: np.ndarray = array(3)  # u, as the turn has shown it so far, in B


@dc.dataclass(frozen=True, eq=False)
class Stance(Message):
    """Where the base should stand so that both handles can be held through the whole turn."""

    time: float = -1.0  # capture time of the estimate that it was computed from [s]
    found: bool = False
    base: np.ndarray = array(3)  # x, y [m], heading [rad] in O
    posture: np.ndarray = array(-1)  # lift and waist, if there are [m, rad]
    margin: float = 0.0  # smallest normalised joint margin on the way, 0..1
    reason: str = ""


@dc.dataclass(frozen=True, eq=False)
class SelectorReport(Message):
    """What command_selector did to the command of this tick."""

    time: float = 0.0
    source: tuple[str, ...] = ()  # block that each group was taken from ("hold" when held)
    limited: tuple[str, ...] = ()  # what was changed, e.g. "left_arm.velocity"
    refused: tuple[str, ...] = ()  # what was refused, e.g. "base: not finite"
    tripped: tuple[str, ...] = ()  # hands whose force was above the trip since this mode was entered
    astray: tuple[str, ...] = ()  # groups that do not follow their command


# ---------------------------------------------------------------- truth of a simulation


@dc.dataclass(frozen=True, eq=False)
class Contacts(Message):
    """What touches what, as only a simulation knows it; no controller reads it.

    {side}_pads: how hard each of the hand's two pads presses on the valve's moving part towards the other pad; negative
    where its outer side pushes [N]. {side}_slip: how fast the pads slide along it [m/s]. internal_force: the largest
    part of a hand's force on the valve that does not help to turn it [N]. touching: every other pair of bodies of which
    one is the robot's, "body, body", with the force between them [N].
    """

    time: float = 0.0
    left_pads: np.ndarray = array(2)
    right_pads: np.ndarray = array(2)
    left_slip: float = 0.0
    right_slip: float = 0.0
    internal_force: float = 0.0
    touching: tuple[str, ...] = ()
    forces: np.ndarray = array(-1)  # one for each pair of `touching`
