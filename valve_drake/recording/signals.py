"""The recorder's table: every topic of a log, and the makers of its rows.

/<block>/<port>           a block's output as it is (schemas.py)
/<camera>/image           foxglove.CompressedImage: the bytes that the program decoded, of images that it looked at
/<camera>/calibration     foxglove.CameraCalibration     /<camera>/detections   foxglove.ImageAnnotations
/tf  /scene               foxglove.FrameTransforms, SceneUpdate
/joint_states  /joint_commands   foxglove.JointStates of the station's measured and commanded vectors
/<side>_wrist/wrench      schemas.Wrench, as the sensor gives it
/events  /log             foxglove.Event, foxglove.Log
/health  /operator/command   the station's and the program's own messages
/operator/packets            what operators' desks have sent; /operator/audio: foxglove.RawAudio, as it came
/truth/...                schemas.Vector, and /truth/contacts as messages.Contacts: simulation only; left out when the
                          ports are not connected
"""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from valve_drake.messages import (
    SIDES,
    CameraFrame,
    Command,
    Contacts,
    GraspPlan,
    HandleMarks,
    Health,
    MarkerEdges,
    Message,
    ModeState,
    OperatorCommand,
    OperatorPackets,
    OperatorState,
    PathPlan,
    PlanRequest,
    RectangleEstimate,
    RobotState,
    SegmentationPair,
    SelectorReport,
    ServoState,
    Stance,
    Status,
    StereoPosition,
    TurnState,
)
from valve_drake.ports import TICK
from valve_drake.recording import foxglove
from valve_drake.recording.recorder_system import ONCE, Signal
from valve_drake.recording.refilled import STAMP, Refilled, slot
from valve_drake.recording.schemas import Encoded, Vector, Wrench, proto_class, serialized
from valve_drake.robot.groups import POSE, Groups
from valve_drake.task.modes import BEHAVIORS

SLOW = 1 / 32  # period of large messages and of those that only people look at [s]

OUTPUTS: tuple[tuple[str, str, type[Message]], ...] = (  # block, port, kind: recorded as they are
    ("color_segmentation", "segmentation", SegmentationPair),
    ("line_fitting", "edges", MarkerEdges),
    ("stereo_positioning", "position", StereoPosition),
    ("rectangle_estimator", "estimate", RectangleEstimate),
    ("handle_marker", "marks", HandleMarks),
    *((block, "command", Command) for block in BEHAVIORS),
    *((block, "status", Status) for block in BEHAVIORS),
    ("stance_planner", "stance", Stance),
    ("stance_planner", "path", PathPlan),
    ("kinematic_approach", "request", PlanRequest),
    ("kinematic_approach", "plan", GraspPlan),
    ("image_servo", "servo", ServoState),
    ("hybrid_rotation", "turn", TurnState),
    ("command_selector", "report", SelectorReport),
    ("supervisor", "mode", ModeState),
    ("operator", "command", OperatorCommand),
    ("operator", "packets", OperatorPackets),  # these: where operators are listened to
    ("operator_channel", "command", OperatorCommand),
    ("operator_channel", "state", OperatorState),
)

FRAMES: dict[str, tuple[str, type[Message], Callable[[Any], CameraFrame]]] = {  # camera -> who looks at its images
    **{
        f"head_{side}": ("color_segmentation.segmentation", SegmentationPair, operator.attrgetter(f"{side}.frame"))
        for side in SIDES
    },
    **{f"{side}_wrist": ("handle_marker.marks", HandleMarks, operator.attrgetter(f"{side}.frame")) for side in SIDES},
}

BELIEF: dict[str, type[Message]] = {  # what the 3D view is made of
    "robot_state.robot_state": RobotState,
    "rectangle_estimator.estimate": RectangleEstimate,
    "kinematic_approach.plan": GraspPlan,
    "hybrid_rotation.turn": TurnState,
}

TRUTH: dict[str, tuple[str, ...]] = {  # port of the simulated station -> names of its values
    "truth.valve_angle": ("angle", "rate"),
    "truth.base_pose": ("x", "y", "heading"),
    "truth.marker_pose": tuple(f"X_WV_{row}{column}" for row in range(3) for column in range(4)),
    "truth.stem_wrench": ("tx", "ty", "tz", "fx", "fy", "fz"),
}
CONTACTS = "truth.contacts"


def measured(groups: Groups) -> dict[str, tuple[str, ...]]:
    """Ports of the station with what its joints do -> <joint>.<quantity> of each of their values."""
    out: dict[str, tuple[str, ...]] = {
        "base.odometry": (*(f"base_{name}.position" for name in POSE), *_speeds(groups)),
        "torso.position_measured": tuple(f"{joint}.position" for joint in groups.torso),
    }
    for side in SIDES:
        arm = groups.names(f"{side}_arm")
        out |= {
            f"{side}_arm.position_measured": tuple(f"{joint}.position" for joint in arm),
            f"{side}_arm.velocity_measured": tuple(f"{joint}.velocity" for joint in arm),
            f"{side}_arm.torque_measured": tuple(f"{joint}.effort" for joint in arm),
            f"{side}_gripper.position_measured": (f"{side}_gripper.position",),
            f"{side}_gripper.force_measured": (f"{side}_gripper.effort",),
        }
    return out


def commanded(groups: Groups) -> dict[str, tuple[str, ...]]:
    """The same of the station's inputs."""
    out: dict[str, tuple[str, ...]] = {"base.twist_command": _speeds(groups)} if groups.twist else {}
    out["torso.position_command"] = tuple(f"{joint}.position" for joint in groups.torso)
    for side in SIDES:
        out |= {
            f"{side}_arm.position_command": tuple(f"{joint}.position" for joint in groups.names(f"{side}_arm")),
            f"{side}_gripper.position_command": (f"{side}_gripper.position",),
            f"{side}_gripper.force_limit": (f"{side}_gripper.effort",),
        }
    return out


def _speeds(groups: Groups) -> tuple[str, ...]:
    """Of the base."""
    return tuple(f"base_{'heading' if name == 'yaw_rate' else name}.velocity" for name in groups.twist)


# Vectors that the recorder reads through one port, which is cheaper: its name -> of a robot, the ports that it joins.
JOINED = {"measured": measured, "commanded": commanded}


def signals(
    groups: Groups,
    frames: Callable[..., Iterable[tuple[str, str, np.ndarray]]],
    scene: SceneUpdate | None = None,
    calibrations: Mapping[str, tuple[tuple[int, int], np.ndarray]] | None = None,
) -> list[Signal]:
    """All rows of the program's log.

    groups: the robot's joints.
    frames: (robot state, estimate, plan, turn) -> (parent, child, X (3, 4)) of every frame to show.
    scene: the shapes that are drawn in these frames.
    calibrations: camera -> its (width, height) and pinhole matrix (3, 3) [px].
    """
    rows = [output(block, port, kind) for block, port, kind in OUTPUTS]
    rows += [output("robot_state", "robot_state", RobotState, SLOW)]
    rows += [joints("/joint_states", "measured", groups), joints("/joint_commands", "commanded", groups)]
    rows += [wrench(side) for side in SIDES]
    rows += [Signal("/health", {"health": Health}, as_it_is)]
    rows += [row for side in SIDES for row in (*head_camera(side), *wrist_camera(side))]
    rows += [calibration(camera, size, K) for camera, (size, K) in (calibrations or {}).items()]
    rows += [transforms(BELIEF, frames), marker_pose()]
    if scene is not None:
        looks = serialized(scene)  # once, at the start: it takes several ms
        rows += [Signal("/scene", {}, lambda time: looks, period=ONCE)]
    rows += [*mode_events(), operator_line(), health_line(), *(status_line(block) for block in BEHAVIORS)]
    rows += [vector(topic_of(port), port, names, SLOW) for port, names in TRUTH.items()]
    rows += [Signal(topic_of(CONTACTS), {CONTACTS: Contacts}, as_it_is, SLOW)]
    return rows


def topic_of(port: str) -> str:
    """<block>.<port> -> /<block>/<port>."""
    return "/" + port.replace(".", "/")


# ---- makers of rows


def as_it_is(time: float, message: Message) -> Message:
    """An encoder (Signal.encode) that logs the message of a port unchanged."""
    return message


def output(block: str, port: str, kind: type[Message], period: float = TICK) -> Signal:
    """A block's output, on topic /<block>/<port>."""
    name = f"{block}.{port}"
    return Signal(topic_of(name), {name: kind}, as_it_is, period)


def vector(topic: str, port: str, names: Sequence[str], period: float = TICK) -> Signal:
    """A vector port with a name for each value."""
    count = len(names)
    form = proto_class(Vector)(time=slot(0), names=names, values=[slot(k + 1) for k in range(count)])
    return Signal(topic, {port: count}, numbers(Refilled(form, count + 1)), period)


def wrench(side: str) -> Signal:
    """A wrist's [torque; force]."""
    t, *F = (slot(k) for k in range(7))
    form = proto_class(Wrench)(time=t, torque=F[:3], force=F[3:])
    return Signal(f"/{side}_wrist/wrench", {f"{side}_wrist.wrench": 6}, numbers(Refilled(form, 7)))


def numbers(form: Refilled) -> Callable[..., Encoded]:
    """An encoder that fills the time and the values of a vector port into a form."""
    return lambda time, values: form.fill(foxglove.nanoseconds(time), [time, *values.tolist()])


def joints(topic: str, port: str, groups: Groups) -> Signal:
    """A port that joins others (JOINED) as JointStates; the quantities are position, velocity and effort."""
    states, by_name = JointStates(timestamp=STAMP), {}
    values = [value.split(".") for names in JOINED[port](groups).values() for value in names]
    for k, (joint, quantity) in enumerate(values):
        if joint not in by_name:
            by_name[joint] = states.joints.add(name=joint)
        setattr(by_name[joint], quantity, slot(k))
    form = Refilled(states, len(values))

    def encode(time: float, numbers: np.ndarray) -> Encoded:
        return form.fill(foxglove.nanoseconds(time), numbers.tolist())

    return Signal(topic, {port: len(values)}, encode)


def image(camera: str) -> Signal:
    """The images of a camera that its consumer has looked at."""
    port, kind, frame = FRAMES[camera]

    def key(message: Message) -> tuple[float, int]:
        return frame(message).time, frame(message).sequence

    return Signal(f"/{camera}/image", {port: kind}, lambda time, message: foxglove.image(frame(message)), key=key)


def head_camera(side: str) -> list[Signal]:
    """Images and detections of one head camera. The fitted edges follow the candidates a little later."""

    def encode(time: float, pair: SegmentationPair, edges: MarkerEdges) -> Any:
        fitted = getattr(edges, side) if edges.sequence == pair.sequence else None
        return foxglove.detections(getattr(pair, side), fitted)

    inputs = {"color_segmentation.segmentation": SegmentationPair, "line_fitting.edges": MarkerEdges}
    return [image(f"head_{side}"), Signal(f"/head_{side}/detections", inputs, encode)]


def wrist_camera(side: str) -> list[Signal]:
    """Images and detections of one wrist camera."""

    def encode(time: float, marks: HandleMarks) -> Any:
        return foxglove.mark_detections(getattr(marks, side))

    return [image(f"{side}_wrist"), Signal(f"/{side}_wrist/detections", {"handle_marker.marks": HandleMarks}, encode)]


def calibration(camera: str, size: tuple[int, int], K: np.ndarray) -> Signal:
    """A camera's pinhole matrix, repeated every second so that a viewer that joins late gets it."""
    return Signal(f"/{camera}/calibration", {}, lambda time: foxglove.calibration(camera, time, size, K), period=1.0)


def transforms(
    inputs: Mapping[str, type[Message]], frames: Callable[..., Iterable[Any]], period: float = SLOW
) -> Signal:
    """Frames computed from messages, valid at the first message's time."""

    def encode(time: float, *messages: Any) -> Encoded:
        return foxglove.transforms(messages[0].time, frames(*messages))

    return Signal("/tf", inputs, encode, period)


def marker_pose() -> Signal:
    """Stage 2's estimate for the 3D panel."""
    return Signal(
        "/rectangle_estimator/pose",
        {"rectangle_estimator.estimate": RectangleEstimate},
        lambda time, estimate: foxglove.estimated_pose("head_left", estimate),
    )


def log_line(port: str, kind: type[Message], encode: Callable[[Any], Log | None], key: Callable[[Any], Any]) -> Signal:
    """A line on /log whenever `key`(message) changes."""
    return Signal("/log", {port: kind}, lambda time, message: encode(message), key=key)


def status_line(block: str) -> Signal:
    """What a behaviour says when its state changes."""

    def key(status: Status) -> tuple[Any, ...]:
        return status.activation, status.state, status.verdict

    return log_line(f"{block}.status", Status, lambda status: foxglove.status_log(block, status), key)


def health_line() -> Signal:
    """The station's faults."""
    return log_line("health", Health, foxglove.health_log, lambda health: (health.faults, health.estop))


def operator_line() -> Signal:
    """What an operator said and the robot answered."""
    return log_line("operator_channel.state", OperatorState, foxglove.operator_log, lambda state: state.answers)


def mode_events(port: str = "supervisor.mode") -> list[Signal]:
    """Every change of mode, and the verdict, flushed to the disk at once."""

    def key(state: ModeState) -> tuple[Any, ...]:
        return state.mode, state.activation, state.verdict

    return [
        log_line(port, ModeState, foxglove.mode_log, key),
        Signal("/events", {port: ModeState}, lambda time, state: foxglove.mode_event(state), key=key, urgent=True),
    ]
