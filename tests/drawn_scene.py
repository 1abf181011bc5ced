"""Images drawn from geometry for the perception tests: area-sampled shapes through a lens, noise, JPEG."""

import dataclasses as dc

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.messages import MarkerEdges, QuadEdges
from valve_drake.perception.joint_fit import NODES
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.quadrilateral import meet, side_lines

FINE = 8  # sub-samples per pixel and direction on a shape's outline

RED, GREEN, PLATE, WALL, METAL = (190, 30, 28), (20, 140, 45), (190, 190, 186), (118, 122, 126), (90, 92, 96)


class Drawing:
    """One raw image (float RGB) of planar shapes, drawn back to front."""

    def __init__(self, lens: LensModel, background: tuple[float, float, float] = WALL):
        self.lens = lens
        self.image = np.empty((lens.height, lens.width, 3))
        self.image[:] = background

    def shape(self, X_CS: np.ndarray, color: tuple, half: tuple[float, float], kind: str = "box") -> None:
        """A rectangle (half sizes) or an ellipse in the plane z = 0 of S, S in this camera; [m]."""
        margin = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 1.05 * np.array([*half, 0])
        outline = frames.apply(X_CS, margin)
        if (outline[:, 2] < 0.05).any():
            return
        px = self.lens.project(outline[:, :2] / outline[:, 2:])
        low = np.maximum(np.floor(px.min(0)).astype(int) - 3, 0)
        high = np.minimum(np.ceil(px.max(0)).astype(int) + 4, [self.lens.width, self.lens.height])
        if (high <= low).any():
            return
        v, u = np.mgrid[low[1] : high[1], low[0] : high[0]].astype(float)
        level = self._level(X_CS, np.stack([u, v], -1), half, kind)
        cover = (level < 1).astype(float)
        step = np.maximum(cv2.dilate(cover, np.ones((3, 3))) - cv2.erode(cover, np.ones((3, 3))), 0)
        edge = np.argwhere(step > 0)
        sub = (np.arange(FINE) + 0.5) / FINE - 0.5
        du, dv = np.meshgrid(sub, sub)
        fine = np.stack([edge[:, 1:2] + low[0] + du.ravel(), edge[:, 0:1] + low[1] + dv.ravel()], -1)
        cover[edge[:, 0], edge[:, 1]] = (self._level(X_CS, fine, half, kind) < 1).mean(1)
        part = self.image[low[1] : high[1], low[0] : high[0]]
        part += cover[:, :, None] * (np.asarray(color, float) - part)

    def _level(self, X_CS: np.ndarray, px: np.ndarray, half: tuple[float, float], kind: str) -> np.ndarray:
        """< 1 inside the shape, exactly: the lens's eq. (1) and the plane's homography at every sample."""
        xy = self.lens.normalize(px)
        H = np.linalg.inv(np.column_stack([X_CS[:, 0], X_CS[:, 1], X_CS[:, 3]]))
        q = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1) @ H.T
        a, b = np.abs(q[..., 0] / q[..., 2] / half[0]), np.abs(q[..., 1] / q[..., 2] / half[1])
        return a * a + b * b if kind == "disc" else np.maximum(a, b)

    def finish(
        self, rng: np.random.Generator | None, noise: float = 2.0, blur: float = 0.7, light: tuple = (1.0, 1.0, 1.0)
    ) -> np.ndarray:
        """Light's colour, the lens's blur [px], noise [grey levels] and the camera's JPEG -> (H, W, 3) uint8."""
        image = self.image * np.asarray(light)
        if blur > 0:
            image = cv2.GaussianBlur(image, (0, 0), blur)
        if rng is not None:
            image = image + rng.normal(0, noise, image.shape)
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        flags = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        data = cv2.imencode(".jpg", image[:, :, ::-1], flags)[1]
        return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1])


def draw_valve(drawing: Drawing, X_CV: np.ndarray, marker: Marker, marks: bool = True) -> None:
    """Bar with green marks, light round plate, red rectangle."""

    def at(x: float, y: float, z: float) -> np.ndarray:
        return frames.compose(X_CV, frames.make(np.eye(3), np.array([x, y, z])))

    r, _, depth = (float(n) for n in marker.marks[0])
    drawing.shape(at(0, 0, depth + 0.001), METAL, (r + 0.03, 0.0125))
    for x in (-r, r) if marks else ():
        drawing.shape(at(x, 0, depth), GREEN, (0.020, 0.011))
    plate = 1.5 * max(marker.size) / 2
    drawing.shape(at(0, 0, 0.001), PLATE, (plate, plate), "disc")
    drawing.shape(X_CV, RED, (marker.size[0] / 2, marker.size[1] / 2))


def facing(z: float, pan: float = 0.0, tilt: float = 0.0, roll: float = 0.0, x: float = 0.0, y: float = 0.0):
    """X_LV of a marker at (x, y, z) [m], turned by pan about y, tilt about x, roll about z [rad]."""
    return frames.make(frames.rot_y(pan) @ frames.rot_x(tilt) @ frames.rot_z(roll), np.array([x, y, z]))


def edge_points(
    X_LV: np.ndarray,
    head: StereoHead,
    marker: Marker,
    sigma: float,
    rng: np.random.Generator | None = None,
    cameras: str = "both",
    first: int = 0,
) -> MarkerEdges:
    """Points every pixel along the true sides, 3 px off the corners, with noise sigma [px] along the raw normals.

    first: which corner of the rectangle is the image's corner 0 (a real image does not know).
    """
    quads = []
    for name, lens, X_CL in (("left", head.left, np.eye(3, 4)), ("right", head.right, frames.inverse(head.X_LR))):
        if cameras not in ("both", name):
            quads.append(QuadEdges(reason="not used"))
            continue
        P = frames.apply(frames.compose(X_CL, X_LV), np.roll(marker.corners(), -first, axis=0))
        xy = P[:, :2] / P[:, 2:]
        points, side = [], []
        for k in range(4):
            a, b = xy[k], xy[(k + 1) % 4]
            length = np.linalg.norm(lens.project(b) - lens.project(a))
            n = max(int(length - 6), 2)
            q = a + ((3 + (length - 6) * (np.arange(n) + 0.5) / n) / length)[:, None] * (b - a)
            if rng is not None:
                px = lens.project(q)
                normal = np.einsum("nij,i->nj", lens.normalize_jacobian(px), [-(b - a)[1], (b - a)[0]])
                normal /= np.linalg.norm(normal, axis=1, keepdims=True)
                q = lens.normalize(px + normal * rng.normal(0, sigma, (n, 1)))
            points.append(q)
            side += [k] * n
        corners_px = lens.project(xy)
        quads.append(
            QuadEdges(found=True, points=np.vstack(points), side=side, sigma=sigma, corners=xy, corners_px=corners_px)
        )
    return MarkerEdges(time=0.0, sequence=0, left=quads[0], right=quads[1])


def pose_error(X: np.ndarray, X_true: np.ndarray) -> np.ndarray:
    """(theta in V, dp in L) of an estimate against the truth, as in RectangleEstimate.covariance."""
    return np.append(frames.rotation_vector(X_true[:, :3].T @ X[:, :3]), X[:, 3] - X_true[:, 3])


def nees(error, covariance):
    return float(error @ np.linalg.solve(covariance, error)) / 6


def with_information(edges, turn=0):
    """The same edges as corners and the information of two nodes on each side; the right image's sides counted anew."""
    quads = []
    for quad, k in ((edges.left, 0), (edges.right, turn)):
        side = quad.side.astype(int)
        corners = meet(side_lines(quad.points, side)[0])
        along = corners[NEXT] - corners
        share = ((quad.points - corners[side]) * along[side]).sum(1) / (along[side] ** 2).sum(1)
        second = (share - NODES[0]) / (NODES[1] - NODES[0])
        information = np.zeros((8, 8))
        for n in range(4):
            rows = np.column_stack([1 - second, second])[side == n] / quad.sigma
            information[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] = rows.T @ rows
        order = (np.arange(8) + 2 * k) % 8
        quads.append(
            dc.replace(
                quad,
                side=(side - k) % 4,
                corners=np.roll(corners, -k, axis=0),
                information=information[np.ix_(order, order)],
            )
        )
    return dc.replace(edges, left=quads[0], right=quads[1])


def off_the_epipolar_line(edges: MarkerEdges, px: float, head: StereoHead) -> MarkerEdges:
    """The right image's points, moved down by `px`."""
    down = np.array([0.0, px / head.right.focal()])
    right = dc.replace(edges.right, points=edges.right.points + down, corners=edges.right.corners + down)
    return dc.replace(edges, right=right)
