"""The program's messages in Foxglove's schemas, which the viewers show without being told how.

Frames agree with the viewers' (cameras: x right, y down, z forward). Pixels do not: here (0, 0) is the centre
of the first pixel, in annotations its top-left corner. Half a pixel is added in this file and nowhere else.
"""

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
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from valve_drake.messages import (
    CameraFrame,
    HandleMark,
    Health,
    ModeState,
    QuadEdges,
    RectangleEstimate,
    Segmentation,
    Status,
)

NANO = 1_000_000_000
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
    M = np.empty((len(R), 4, 4))  # 4 q q^T
    M[:, :3, :3] = R + R.transpose(0, 2, 1)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        M[:, 3, k] = M[:, k, 3] = R[:, j, i] - R[:, i, j]
        M[:, k, k] = 1 + R[:, k, k] - R[:, i, i] - R[:, j, j]
    M[:, 3, 3] = 1 + np.trace(R, axis1=1, axis2=2)
    rows = np.arange(len(R))
    q = M[rows, np.argmax(M[:, range(4), range(4)], axis=1)]  # the row of the largest component: never ill-conditioned
    return q / np.sqrt((q * q).sum(axis=1, keepdims=True))


def pose(X: np.ndarray) -> Pose:
    """X (3, 4) as position and quaternion."""
    px, py, pz = X[:, 3].tolist()
    x, y, z, w = quaternions(X[None, :, :3])[0].tolist()
    return Pose(position=Vector3(x=px, y=py, z=pz), orientation=Quaternion(x=x, y=y, z=z, w=w))


def transforms(
    time: float, tree: Iterable[tuple[str, str, np.ndarray]], message: FrameTransforms | None = None
) -> FrameTransforms:
    """Poses X (3, 4) of child frames in their parents, as (parent, child, X), valid at `time`.

    `message`: one to fill again, which is faster than a new one.
    """
    message, now, tree = message or FrameTransforms(), stamp(time), list(tree)
    del message.transforms[len(tree) :]
    while len(message.transforms) < len(tree):
        message.transforms.add()
    poses = np.array([X for _, _, X in tree]).reshape(-1, 3, 4)
    positions, rotations = poses[:, :, 3].tolist(), quaternions(poses[:, :, :3]).tolist()
    for at, (parent, child, _), p, q in zip(message.transforms, tree, positions, rotations):
        at.timestamp.CopyFrom(now)
        at.parent_frame_id, at.child_frame_id = parent, child
        t, r = at.translation, at.rotation
        t.x, t.y, t.z = p
        r.x, r.y, r.z, r.w = q
    return message


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


def log(time: float, name: str, text: str, level: int = Log.INFO) -> Log:
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
