"""Draws what was seen on the photographs: candidates with the reason for their rejection, edges, corners, axes."""

from collections.abc import Sequence

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel
from valve_drake.perception.photograph import Look

_REJECTED, _ACCEPTED, _EDGE, _CORNER = (110, 110, 255), (0, 220, 255), (255, 255, 255), (255, 255, 0)  # BGR
_AXES = ((60, 60, 255), (60, 220, 60), (255, 140, 60))  # x, y, z of V
_SUB = 4  # bits of sub-pixel drawing
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def overlay(
    look: Look, lenses: Sequence[LensModel], X_CL: Sequence[np.ndarray], size: tuple[float, float], scale: int = 2
) -> np.ndarray:
    """The photographs side by side, enlarged, (H, W, 3) uint8 BGR.

    X_CL: camera 0 in each camera (3, 4); size: of the marker [m].
    """
    panels = []
    for k, (seen, quad, lens) in enumerate(zip(look.seen, look.edges, lenses)):
        image = seen.frame.image[:, :, ::-1]
        canvas = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        for candidate in reversed(seen.candidates):
            color = _REJECTED if candidate.rejected else _ACCEPTED
            _polygon(canvas, candidate.corners, color, scale)
            _text(canvas, candidate.rejected, candidate.corners.max(0), color, scale)
        for point in lens.project(quad.points) if quad.found else ():
            cv2.circle(canvas, _at(point, scale), 1 << _SUB, _EDGE, -1, cv2.LINE_AA, _SUB)
        corners = look.corners_px[k]
        if corners is not None:
            _polygon(canvas, corners, _CORNER, scale)
            for n, corner in enumerate(corners):
                _text(canvas, str(n), corner, _CORNER, scale)
            X_CV = frames.compose(X_CL[k], look.estimate.X_LV)
            _axes(canvas, X_CV, lens, corners.mean(0), 0.6 * max(size), scale)
        _text(canvas, _verdict(look, quad.found, quad.reason), np.array([2.0, 12.0]), _EDGE, scale)
        panels.append(canvas)
    height = max(panel.shape[0] for panel in panels)
    panels = [cv2.copyMakeBorder(p, 0, height - p.shape[0], 0, 0, cv2.BORDER_CONSTANT) for p in panels]
    return np.hstack(panels)


def _verdict(look: Look, edges: bool, reason: str) -> str:
    if not edges:
        return f"no edges: {reason}"
    found = look.estimate
    if not found.found:
        return f"not found: {found.reason}"
    return f"{found.method}: {np.linalg.norm(found.X_LV[:, 3]):.3f} m, residual {found.residual_px:.2f} px"


def _axes(canvas: np.ndarray, X_CV: np.ndarray, lens: LensModel, origin: np.ndarray, length: float, scale: int) -> None:
    """V's axes from the rectangle's centre; z is drawn towards the viewer, since V's z leads into the panel."""
    tips = frames.apply(X_CV, length * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -1]]))
    if not (tips[:, 2] > 1e-3).all():
        return
    px = lens.project(tips[:, :2] / tips[:, 2:])
    px += origin - px[0]
    for tip, color, name in zip(px[1:], _AXES, ("x", "y", "-z")):
        cv2.line(canvas, _at(px[0], scale), _at(tip, scale), color, 2, cv2.LINE_AA, _SUB)
        _text(canvas, name, tip, color, scale)


def _polygon(canvas: np.ndarray, corners: np.ndarray, color: tuple[int, ...], scale: int) -> None:
    points = np.array([_at(corner, scale) for corner in corners], np.int32)
    cv2.polylines(canvas, [points], True, color, 1, cv2.LINE_AA, _SUB)


def _text(canvas: np.ndarray, text: str, at: np.ndarray, color: tuple[int, ...], scale: int) -> None:
    x, y = (np.asarray(at) * scale).round().astype(int)
    width = cv2.getTextSize(text, _FONT, 0.45, 1)[0][0]
    x = int(np.clip(x + 3, 0, max(canvas.shape[1] - width - 3, 0)))
    y = int(np.clip(y, 12, canvas.shape[0] - 4))
    cv2.putText(canvas, text, (x, y), _FONT, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(canvas, text, (x, y), _FONT, 0.45, color, 1, cv2.LINE_AA)


def _at(px: np.ndarray, scale: int) -> tuple[int, int]:
    """Raw px -> fixed-point coordinates of the enlarged canvas, where pixel k covers k scale .. (k + 1) scale - 1."""
    x, y = ((np.asarray(px) + 0.5) * scale - 0.5) * (1 << _SUB)
    return int(round(x)), int(round(y))
