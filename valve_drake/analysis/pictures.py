"""Camera images of a log as thumbnails, with what was detected in them drawn over."""

import base64
import dataclasses as dc
from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup, escape

from valve_drake.analysis.traces import ModeSpan
from valve_drake.camera.image_file import decode
from valve_drake.checks import ConfigError
from valve_drake.messages import CAMERAS
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.reader import LogReader

THUMB, QUALITY = 400, 80  # width [px], JPEG
OLD = 2.2  # images captured longer before a moment are not shown for it [s]
TEXTS = 3  # labels of detections in one image; more would cover it


@dc.dataclass(frozen=True)
class Thumbnail:
    """One image: `data` for an <img>, "" if it cannot be decoded; `overlay` an SVG of `size` (width, height) [px]."""

    camera: str
    time: float  # of capture [s]
    size: tuple[int, int]
    data: str
    overlay: Markup


@dc.dataclass(frozen=True)
class Moment:
    """A time of interest, with the newest image of each camera that took one."""

    time: float
    title: str
    reason: str
    thumbnails: list[Thumbnail]


class Album:
    """The images of one log, found by their time of capture."""

    def __init__(self, log: LogReader):
        self._log = log
        self._taken: dict[str, list[tuple[float, float]]] = {}  # camera -> (captured, logged), in order
        for camera in CAMERAS:
            rows = [(_capture(m), t) for t, m in _messages(log, f"/{camera}/image")]
            if rows:
                self._taken[camera] = sorted(rows)

    @property
    def cameras(self) -> list[str]:
        """Those that took an image."""
        return list(self._taken)

    def newest(self, camera: str, time: float) -> tuple[float, float] | None:
        """(captured, logged) of a camera's newest image captured up to `time`, if it is not too old."""
        rows = [row for row in self._taken.get(camera, []) if time - OLD <= row[0] <= time]
        return rows[-1] if rows else None

    def thumbnail(self, camera: str, captured: float, logged: float) -> Thumbnail | None:
        """One image with the last detections that belong to it."""
        images = [m for _, m in _messages(self._log, f"/{camera}/image", logged, logged) if _capture(m) == captured]
        if not images:
            return None
        try:
            image = decode(images[-1].data, camera)
        except ConfigError:
            return Thumbnail(camera, captured, (640, 480), "", Markup(""))
        height, width = image.shape[:2]
        size = (THUMB, min(max(round(THUMB * height / width), 1), 4 * THUMB))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        seen = _messages(self._log, f"/{camera}/detections", logged, logged + 0.1)
        drawings = [m for _, m in seen if _stamp(m.timestamp) == captured]
        overlay = draw(drawings[-1]) if drawings else Markup("")
        data = "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode()
        return Thumbnail(camera, captured, (width, height), data, overlay)

    def moment(self, time: float, title: str, reason: str, shown: Iterable[tuple[str, float]] = ()) -> Moment:
        """All cameras at `time`; images in `shown` (camera, captured) are left out."""
        found = []
        for camera in CAMERAS:
            row = self.newest(camera, time)
            if row is None or (camera, row[0]) in shown:
                continue
            if picture := self.thumbnail(camera, *row):
                found.append(picture)
        return Moment(time, title, reason, found)

    def changes_of_mode(self, spans: Sequence[ModeSpan]) -> list[Moment]:
        """What the cameras saw when each mode ended; an image is shown once."""
        out: list[Moment] = []
        shown: set[tuple[str, float]] = set()
        for before, after in zip(spans, spans[1:]):
            moment = self.moment(after.start, f"{before.mode} \u2192 {after.mode}", after.reason, shown)
            shown |= {(picture.camera, picture.time) for picture in moment.thumbnails}
            out.append(moment)
        return out


def draw(annotations: Any) -> Markup:
    """foxglove.ImageAnnotations as the inside of an SVG in the image's pixels."""
    out = []
    for shape in annotations.points:
        points = " ".join(f"{p.x:.1f},{p.y:.1f}" for p in shape.points)
        out.append(f'<polygon points="{points}" stroke="{_color(shape.outline_color)}"/>')
    for circle in annotations.circles:
        x, y, r = circle.position.x, circle.position.y, circle.diameter / 2
        out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:.1f}" stroke="{_color(circle.outline_color)}"/>')
    for text in annotations.texts[:TEXTS]:
        at = f'x="{text.position.x + 4:.1f}" y="{text.position.y + 20:.1f}"'
        out.append(f'<text {at} style="fill:{_color(text.text_color)}">{escape(text.text)}</text>')
    return Markup("".join(out))


def _color(color: Any) -> str:
    return "#" + "".join(f"{round(255 * min(max(v, 0.0), 1.0)):02x}" for v in (color.r, color.g, color.b))


def _messages(log: LogReader, topic: str, start: float = -np.inf, end: float = np.inf) -> list[tuple[float, Any]]:
    if topic not in log.topics:
        return []
    try:
        return [(t, m) for _, t, m in log.messages([topic], start, end) if hasattr(m, "timestamp")]
    except ConfigError:
        return []


def _stamp(timestamp: Any) -> float:
    return timestamp.seconds + timestamp.nanos / NANO


def _capture(image: Any) -> float:
    return _stamp(image.timestamp)
