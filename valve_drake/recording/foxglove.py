"""The program's messages in Foxglove's schemas, which viewers show without configuration.

Frames agree with the viewers' (cameras: x right, y down, z forward). Pixels do not: here (0, 0) is the centre
of the first pixel, in annotations its top-left corner. Half a pixel is added in this file and nowhere else.
"""

import functools
import math
from collections.abc import Iterable

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawAudio_pb2 import RawAudio
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from valve_drake.messages import (
    CameraFrame,
    HandleMark,
    Health,
    ModeState,
    OperatorState,
    QuadEdges,
    RectangleEstimate,
    Segmentation,
    Status,
)
from valve_drake.recording.refilled import STAMP, Refilled, slot
from valve_drake.recording.schemas import Encoded

NANO = 1_000_000_000  # [ns/s]
AUDIO = "/operator/audio"  # its topic
ACCEPTED = Color(r=0.0, g=0.9, b=1.0, a=1.0)
REJECTED = Color(r=1.0, g=0.6, b=0.0, a=1.0)
FITTED = Color(r=1.0, g=1.0, b=0.0, a=1.0)
GREEN = Color(r=0.2, g=1.0, b=0.2, a=1.0)
SHADE = Color(r=0.0, g=0.0, b=0.0, a=0.6)
STROKE, FONT_SIZE = 1.5, 14.0  # [px]


def nanoseconds(time: float) -> int:
    """Seconds of the station's clock -> ns; exact for every multiple of 1/512 s."""
    return round(time * NANO)


def stamp(time: float) -> Timestamp:
    """Seconds of the station's clock as protobuf's time."""
    seconds, nanos = divmod(nanoseconds(time), NANO)
    return Timestamp(seconds=seconds, nanos=nanos)


def image(frame: CameraFrame) -> CompressedImage | None:
    """The encoded image as the program saw it, stamped with its capture time; None before the first capture."""
    if frame.sequence < 0:
        return None
    return CompressedImage(timestamp=stamp(frame.time), frame_id=frame.camera, data=frame.data, format="jpeg")


def calibration(camera: str, time: float, size: tuple[int, int], K: np.ndarray) -> CameraCalibration:
    """The pinhole `K` (3, 3) [px] of a camera with `size` = (width, height) [px]: frusta and 3D overlays."""
    return CameraCalibration(
        timestamp=stamp(time),
        frame_id=camera,
        width=size[0],
        height=size[1],
        K=np.ravel(K).tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    )


def quaternions(R: np.ndarray) -> np.ndarray:
    """Rotation matrices (n, 3, 3) as unit quaternions x, y, z, w (n, 4)."""
    M = R.reshape(-1, 9) @ _TO_SQUARE + _EYE
    # The column of the largest component is well conditioned.
    q = M.reshape(-1, 4, 4)[_first(len(M)), M[:, ::5].argmax(axis=1)]
    return q / np.sqrt((q * q).sum(axis=1, keepdims=True))


def _to_square() -> np.ndarray:
    """(9, 16) that makes 4 q q^T - 1 of a rotation matrix, both row by row."""
    out = np.zeros((3, 3, 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for a in range(3):
            out[a, k, a, k] += 1
            out[k, a, a, k] += 1
        out[j, i, 3, k] = out[j, i, k, 3] = 1
        out[i, j, 3, k] = out[i, j, k, 3] = -1
        out[i, i, k, k] -= 1
        out[j, j, k, k] -= 1
        out[k, k, k, k] -= 1
        out[k, k, 3, 3] = 1
    return out.reshape(9, 16)


_TO_SQUARE = _to_square()
_EYE = np.eye(4).ravel()
_first = functools.cache(np.arange)


def pose(X: np.ndarray) -> Pose:
    """X (3, 4) as position and quaternion."""
    px, py, pz = X[:, 3].tolist()
    x, y, z, w = quaternions(X[None, :, :3])[0].tolist()
    return Pose(position=Vector3(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def transforms(time: float, tree: Iterable[tuple[str, str, np.ndarray]]) -> Encoded:
    """FrameTransforms: poses X (3, 4) of child frames in their parents, as (parent, child, X), valid at `time`."""
    parents, children, poses = zip(*tree)
    X = np.array(poses)
    numbers = np.empty((len(X), 7))
    numbers[:, :3], numbers[:, 3:] = X[:, :, 3], quaternions(X[:, :, :3])
    return _tree(parents, children).fill(nanoseconds(time), numbers.ravel().tolist())


@functools.cache
def _tree(parents: tuple[str, ...], children: tuple[str, ...]) -> Refilled:
    """The form of a FrameTransforms; seven numbers a frame."""
    form = FrameTransforms()
    for k, (parent, child) in enumerate(zip(parents, children)):
        x, y, z, qx, qy, qz, qw = (slot(7 * k + n) for n in range(7))
        p, q = Vector3(x=x, y=y, z=z), Quaternion(x=qx, y=qy, z=qz, w=qw)
        form.transforms.add(timestamp=STAMP, parent_frame_id=parent, child_frame_id=child, translation=p, rotation=q)
    return Refilled(form, 7 * len(parents))


def estimated_pose(camera: str, estimate: RectangleEstimate) -> PoseInFrame | None:
    """Stage 2's pose of the marker in the camera's frame; None when nothing was found."""
    if not estimate.found:
        return None
    return PoseInFrame(timestamp=stamp(estimate.time), frame_id=camera, pose=pose(estimate.X_LV))


def detections(seen: Segmentation, edges: QuadEdges | None) -> ImageAnnotations | None:
    """What was found in one head image: candidates with the reason against them, fitted edges, green marks.

    `edges`: of the same image; None when they are not known yet.
    """
    if seen.frame.sequence < 0:
        return None
    drawing = ImageAnnotations(timestamp=stamp(seen.frame.time))
    for candidate in seen.candidates:
        color = REJECTED if candidate.rejected else ACCEPTED
        _outline(drawing, candidate.corners, color)
        _text(drawing, candidate.corners.max(axis=0), candidate.rejected or f"score {candidate.score:.2f}", color)
    for u, v, area in seen.green:
        _circle(drawing, np.array([u, v]), 2 * math.sqrt(area / math.pi), GREEN)
    if edges is not None and edges.found:
        _outline(drawing, edges.corners_px, FITTED)
        _circle(drawing, edges.center_px, 4.0, FITTED)
    return drawing


def mark_detections(mark: HandleMark) -> ImageAnnotations | None:
    """The green mark found in one wrist image."""
    if mark.frame.sequence < 0:
        return None
    drawing = ImageAnnotations(timestamp=stamp(mark.frame.time))
    color = GREEN if mark.found else REJECTED
    if len(mark.corners) > 0:
        _outline(drawing, mark.corners, color)
    if mark.area > 0:
        _circle(drawing, mark.center, 6.0, color)
    if mark.reason:
        _text(drawing, np.array([4.0, FONT_SIZE]), mark.reason, color)
    return drawing


def _point(pixel: np.ndarray) -> Point2:
    return Point2(x=float(pixel[0]) + 0.5, y=float(pixel[1]) + 0.5)


def _outline(drawing: ImageAnnotations, corners: np.ndarray, color: Color) -> None:
    drawing.points.add(
        timestamp=drawing.timestamp,
        type=PointsAnnotation.LINE_LOOP,
        points=[_point(corner) for corner in corners],
        outline_color=color,
        thickness=STROKE,
    )


def _circle(drawing: ImageAnnotations, center: np.ndarray, diameter: float, color: Color) -> None:
    drawing.circles.add(
        timestamp=drawing.timestamp,
        position=_point(center),
        diameter=diameter,
        thickness=STROKE,
        outline_color=color,
    )


def _text(drawing: ImageAnnotations, pixel: np.ndarray, text: str, color: Color) -> None:
    drawing.texts.add(
        timestamp=drawing.timestamp,
        position=_point(pixel),
        text=text,
        font_size=FONT_SIZE,
        text_color=color,
        background_color=SHADE,
    )


def mode_event(state: ModeState) -> Event:
    """Entry into a mode, or the verdict in it."""
    event = Event(start_time=stamp(state.since), end_time=stamp(state.since))
    facts = {
        "mode": state.mode,
        "activation": str(state.activation),
        "attempt": str(state.attempt),
        "verdict": state.verdict,
        "reason": state.reason,
    }
    for key, value in facts.items():
        event.metadata.add(key=key, value=value)
    return event


def log(time: float, name: str, text: str, level: Log.Level.ValueType = Log.INFO) -> Log:
    """One line for people; `name`: who says it."""
    return Log(timestamp=stamp(time), level=level, name=name, message=text)


def mode_log(state: ModeState) -> Log:
    """Entry into a mode as a line."""
    parts = (state.mode, f"retry {state.attempt}" if state.attempt else "", state.verdict, state.reason)
    return log(state.time, "supervisor", ": ".join(part for part in parts if part))


def status_log(block: str, status: Status) -> Log:
    """What a behaviour says of itself as a line; a warning when it failed."""
    level = Log.WARNING if status.state == "failed" else Log.INFO
    parts = (status.state, status.verdict, status.detail)
    return log(status.time, block, ": ".join(part for part in parts if part), level)


def health_log(health: Health) -> Log | None:
    """The station's faults as a line; nothing while there are none."""
    faults = (("emergency stop",) if health.estop else ()) + health.faults
    return log(health.time, "station", ", ".join(faults), Log.ERROR) if faults else None


def operator_log(state: OperatorState) -> Log | None:
    """What an operator said and the robot answered, as a line."""
    if not state.answers:
        return None
    heard = f"{state.words!r} ({state.score:.2f}, {state.outcome}): " if state.words else ""
    return log(state.time, "operator", f"{heard}{state.says}")


def audio(time: float, rate: int, samples: np.ndarray) -> RawAudio:
    """Sound (n,) of 16 bits and one channel; `time`: of its first sample [s], `rate` [Hz]."""
    data = np.ascontiguousarray(samples, "<i2").tobytes()
    return RawAudio(timestamp=stamp(time), data=data, format="pcm-s16", sample_rate=rate, number_of_channels=1)
