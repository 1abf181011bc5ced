"""The paper's experiments on the estimator repeated, and its error over the least that any method can reach.

Images are drawn (`drawn_images`), not rendered: a renderer's anti-aliasing shifts sides by more than the estimator's
own error. Every experiment is deterministic in its seed and returns plain numbers: settings, and rows of a table.

The bound (Cramer and Rao) is taken from the pixels: F = sum (dI/dx)(dI/dx)^T / sigma^2 over all pixels and colours of
the cameras used, dI/dx the derivative of the exact image by the pose, sigma the noise with rounding. It assumes known
colours and blur and uses every pixel up to the corners, so no method can do better on these images. `edge bound` leaves
out pixels nearer than 3 px to a corner: the usual bound for points along the four sides.
"""

import dataclasses as dc
import functools
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from valve_drake import frames, resources, yaml_file
from valve_drake.analysis import hand_eye_experiment
from valve_drake.analysis.drawn_images import GREEN, METAL, PLATE, RED, WALL, Canvas, draw_bar, draw_board
from valve_drake.camera.lens import StereoHead, load_head
from valve_drake.camera.triangulation import triangulate
from valve_drake.checks import require, require_in
from valve_drake.messages import CameraFrame, MarkerEdges, QuadEdges, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segmented
from valve_drake.perception.line_fitting import LineFittingConfig, fit_pair
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate

BLUR, NOISE = 0.7, 2.0  # standard deviations, unless given: of the lens's blur [px], of a pixel's colour [grey levels]
NOISES = (1.0, 2.0, 4.0)
DISTANCES, TILTS = (0.3, 0.5, 0.8, 1.2, 1.8, 2.5), (0, 15, 30, 45)  # of `bound` [m], [deg]
_LOOKS = 5  # image pairs of one pose in `bound`, each with its own noise
# Drawn images have no error that a whole side shares, so `side_bias` would only make the covariance too large.
REFINED = RectangleEstimatorConfig(side_bias=0.0)
PAPER = dc.replace(REFINED, method="paper")
_CAMERAS = ("left", "right")


@functools.cache
def paper_tables() -> dict[str, Any]:
    """The printed tables: T_m, and of each sample T_e, T_c, T_w; lengths in m, rotations made orthonormal (3, 4)."""

    def rigid(rows: list[Any]) -> np.ndarray:
        T = np.array(rows, float)
        u, _, v = np.linalg.svd(T[:, :3])
        return frames.make(u @ v, T[:, 3] / 1000)

    data = yaml_file.read(Path(__file__).with_name("paper_tables.yaml"))
    return {
        "T_m": rigid(data["eq_26_T_m"]),
        "table_2": [{name: rigid(rows) for name, rows in sample.items()} for sample in data["table_2"]],
        "table_3": {"stereovision": [rigid(T) for T in data["table_3"]["stereovision"]]}
        | {"proposed": rigid(data["table_3"]["proposed"])},
        "table_4": {name: np.array(points) / 1000 for name, points in data["table_4"].items()},
    }


def head() -> StereoHead:
    """Table 1's cameras as the robot carries them: parallel, 0.12 m apart."""
    return load_head(resources.models() / "calibration" / "head.yaml")


def converged(distance: float) -> StereoHead:
    """The same with the right camera turned in to the point at `distance` [m] before the left one: nearer than half
    a metre the parallel cameras have no common view of the marker."""
    parallel = head()
    p = parallel.X_LR[:, 3]
    return dc.replace(parallel, X_LR=frames.make(frames.rot_y(-math.atan2(p[0], distance)), p))


# ---------------------------------------------------------------- images and what is read from them


def draw(X_LV: np.ndarray, eyes: StereoHead, marker: Marker, paint: Callable[..., Any] = draw_board) -> list[Canvas]:
    """What both cameras see of the target, still without noise."""
    out = []
    for lens, X_CL in zip(eyes.lenses(), _to_cameras(eyes)):
        canvas = Canvas(lens, BLUR)
        paint(canvas, frames.compose(X_CL, X_LV), marker)
        out.append(canvas)
    return out


def read(images: list[np.ndarray], eyes: StereoHead, marker: Marker) -> tuple[SegmentationPair, MarkerEdges]:
    """Segmentation and edges of two raw images, as the diagram's first blocks make them."""
    config = ColorSegmentationConfig()
    seen = []
    for image, camera in zip(images, _CAMERAS):
        seen.append(segmented(CameraFrame(camera=camera, image=image), config))
    pair = SegmentationPair(left=seen[0], right=seen[1])
    return pair, fit_pair(pair, eyes, marker, LineFittingConfig(), StereoPositioningConfig())


def one_camera(edges: MarkerEdges) -> MarkerEdges:
    """The edges as if the left camera were alone."""
    return dc.replace(edges, right=QuadEdges(reason="not used"))


def pose_error(X: np.ndarray, X_true: np.ndarray) -> np.ndarray:
    """theta in V [rad] and dp in L [m], as in RectangleEstimate.covariance."""
    return np.append(frames.rotation_vector(X_true[:, :3].T @ X[:, :3]), X[:, 3] - X_true[:, 3])


def _to_cameras(eyes: StereoHead) -> tuple[np.ndarray, np.ndarray]:
    return np.eye(3, 4), frames.inverse(eyes.X_LR)


def information(
    X_LV: np.ndarray,
    eyes: StereoHead,
    marker: Marker,
    noise: float,
    blur: float = BLUR,
    contrast: float = float(np.linalg.norm(np.subtract(RED, PLATE))),
) -> np.ndarray:
    """Fisher's matrix of (theta, dp): (2, 2, 6, 6) by camera; of all pixels, and of those 3 px off the corners.

    noise, contrast of the marker and what is behind it [grey levels]; blur of the lens [px].
    """
    half = (marker.size[0] / 2, marker.size[1] / 2)
    steps = np.append(np.full(3, 2e-4), np.full(3, 2e-5 * X_LV[2, 3]))
    out = []
    for lens, X_CL in zip(eyes.lenses(), _to_cameras(eyes)):
        canvas = Canvas(lens, blur)
        X_CV = frames.compose(X_CL, X_LV)
        box = canvas.seen(X_CV, half)[1]
        edge = canvas.off_corners(X_CV, half, box, 3.0).ravel()

        changes = []
        for step in np.diag(steps):
            there, back = (
                canvas.seen(frames.compose(X_CL, frames.stepped(X_LV, sign * step)), half, box)[0].ravel()
                for sign in (1, -1)
            )
            changes.append(contrast * (there - back) / (2 * step.sum()))
        J = np.array(changes)
        out.append([K @ K.T / (noise**2 + 1 / 12) for K in (J, J[:, edge])])  # rounding adds a twelfth
    return np.array(out)


# ---------------------------------------------------------------- peers


def _near_corners(quad: QuadEdges, X_CV: np.ndarray, marker: Marker) -> np.ndarray:
    """The fitted corners (4, 2), ideal, counted from the model's first one."""
    P = frames.apply(X_CV, marker.corners())
    true = P[:, :2] / P[:, 2:]
    return min((np.roll(quad.corners, k, axis=0) for k in range(4)), key=lambda c: float(((c - true) ** 2).sum()))


def ippe(quad: QuadEdges, X_true: np.ndarray, marker: Marker) -> np.ndarray:
    """OpenCV's IPPE on the fitted corners; of its two poses the one nearer the truth."""
    corners = _near_corners(quad, X_true, marker)[:, None, :]
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(marker.corners(), corners, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    poses = [frames.make(cv2.Rodrigues(r)[0], t.ravel()) for r, t in zip(rvecs, tvecs)]
    return min(poses, key=lambda X: float(np.linalg.norm(pose_error(X, X_true)[:3])))


def iterative(quad: QuadEdges, X_true: np.ndarray, marker: Marker) -> np.ndarray:
    """OpenCV's ITERATIVE on the fitted corners, from IPPE's answer."""
    corners, start = _near_corners(quad, X_true, marker)[:, None, :], ippe(quad, X_true, marker)
    rvec, tvec = cv2.Rodrigues(start[:, :3])[0], start[:, 3:].copy()
    flags = cv2.SOLVEPNP_ITERATIVE
    _, rvec, tvec = cv2.solvePnP(marker.corners(), corners, np.eye(3), None, rvec, tvec, True, flags=flags)
    return frames.make(cv2.Rodrigues(rvec)[0], tvec.ravel())


def triangulated(corners_px: list[np.ndarray], eyes: StereoHead, marker: Marker) -> tuple[np.ndarray, np.ndarray]:
    """Traditional stereo vision: every corner, (4, 2) raw px of each camera, alone -> pose that lays the model onto
    the four points, and the points (4, 3)."""
    points = np.array([triangulate(a, b, eyes, 1.0)[0] for a, b in zip(*corners_px)])
    model = marker.corners()
    u, _, v = np.linalg.svd((points - points.mean(0)).T @ model)
    R = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return frames.make(R, points.mean(0)), points


def _corners_px(edges: MarkerEdges, X_LV: np.ndarray, eyes: StereoHead, marker: Marker) -> list[np.ndarray]:
    cameras = zip((edges.left, edges.right), eyes.lenses(), _to_cameras(eyes))
    return [lens.project(_near_corners(q, frames.compose(X_CL, X_LV), marker)) for q, lens, X_CL in cameras]


# ---------------------------------------------------------------- Table 2


def table2(seed: int = 0, trials: int = 20) -> dict[str, Any]:
    """Spread of T_w = T_e T_m T_c over the six poses of Table 2: sample standard deviation, mean of `trials` runs.

    The target stands still, at the mean of the printed T_w; T_c is what each T_e then sees.
    """
    tables, marker, rng = paper_tables(), Marker(), np.random.default_rng(seed)
    to_world = [frames.compose(sample["T_e"], tables["T_m"]) for sample in tables["table_2"]]
    printed = [sample["T_w"] for sample in tables["table_2"]]
    T_w = _mean_pose(printed)
    truths = [frames.compose(frames.inverse(X), T_w) for X in to_world]
    eyes = converged(0.32)
    rows = [{"noise": "printed", "cameras": "paper", "method": "paper"} | _spread_row([printed], T_w)]
    clean = [draw(X, eyes, marker) for X in truths]
    found: dict[tuple[Any, ...], list[Any]] = {}
    for noise in NOISES:
        for _ in range(trials):
            one: dict[tuple[Any, ...], list[Any]] = {}
            for canvases, X, X_WL in zip(clean, truths, to_world):
                edges = read([canvas.finish(rng, noise) for canvas in canvases], eyes, marker)[1]
                for cameras, seen in (("one", one_camera(edges)), ("two", edges)):
                    for config in (PAPER, REFINED):
                        got = estimate(seen, eyes, marker, config, Track(X))
                        if got.found:
                            one.setdefault((noise, cameras, config.method), []).append(frames.compose(X_WL, got.X_LV))
            for key, poses in one.items():
                found.setdefault(key, []).append(poses)
    limit = {key: value / 10 for key, value in rows[0].items() if key.endswith((" mm", " deg"))}
    for (noise, cameras, method), runs in sorted(found.items(), key=lambda item: item[0][1:] + item[0][:1]):
        row = {"noise": noise, "cameras": cameras, "method": method} | _spread_row(runs, T_w)
        row["a tenth"] = all(row[key] <= value for key, value in limit.items()) and row["poses"] == 6 * trials
        rows.append(row)
    settings = {"target_mm": [98, 100], "blur_px": BLUR, "noise_grey_levels": NOISES, "trials": trials, "seed": seed}
    return {"experiment": "table2", "settings": settings, "rows": rows}


def _mean_pose(poses: list[np.ndarray]) -> np.ndarray:
    u, _, v = np.linalg.svd(np.mean([X[:, :3] for X in poses], axis=0))
    return frames.make(u @ v, np.mean([X[:, 3] for X in poses], axis=0))


def _spread_row(runs: list[list[np.ndarray]], T_w: np.ndarray) -> dict[str, Any]:
    """Spread within each run (root mean square over the runs), and the mean's distance from the truth."""
    position, angle, middle = [], [], []
    for poses in runs:
        mean = _mean_pose(poses)
        position.append(np.var([1000 * X[:, 3] for X in poses], axis=0, ddof=1))
        turned = [frames.rotation_vector(mean[:, :3].T @ X[:, :3]) for X in poses]
        angle.append(np.mean(np.sum(np.degrees(turned) ** 2, axis=1)))
        middle.append(1000 * (mean[:, 3] - T_w[:, 3]))
    x, y, z = map(float, np.sqrt(np.mean(position, axis=0)))
    return {
        "x mm": x,
        "y mm": y,
        "z mm": z,
        "rms deg": math.sqrt(np.mean(angle)),
        "mean off [mm]": float(np.linalg.norm(np.mean(middle, axis=0))),
        "poses": sum(map(len, runs)),
    }


# ---------------------------------------------------------------- Tables 3 and 4


def table3(seed: int = 0, trials: int = 60) -> dict[str, Any]:
    """Tables 3 and 4 again: the 120 x 80 mm target at the pose that they print, seen `trials` times by the head."""
    tables, marker, rng, eyes = paper_tables(), Marker(size=[0.12, 0.08]), np.random.default_rng(seed), head()
    X = tables["table_3"]["proposed"]
    clean = draw(X, eyes, marker)
    P = np.array([[0, -0.04, 0], [0, 0.04, 0], [0.06, 0, 0], [-0.06, 0, 0]])
    printed = tables["table_3"]["stereovision"]
    rows = [_table3_row("printed, stereo vision", "", printed, tables["table_4"]["stereovision"], None)]
    for noise in NOISES:
        poses: dict[str, list[Any]] = {}
        points: dict[str, list[Any]] = {}

        for _ in range(trials):
            images = [canvas.finish(rng, noise) for canvas in clean]
            _, edges = read(images, eyes, marker)
            if not (edges.left.found and edges.right.found):
                continue
            corners = _corners_px(edges, X, eyes, marker)
            end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
            grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
            points_px = [
                cv2.cornerSubPix(g, c.astype(np.float32)[:, None].copy(), (5, 5), (-1, -1), end)[:, 0].astype(float)
                for g, c in zip(grey, corners)
            ]
            for method, px in (("stereo vision, corner points", points_px), ("stereo vision, fitted sides", corners)):
                pose, four = triangulated(px, eyes, marker)
                middles = (four + four[[1, 2, 3, 0]]) / 2  # of the sides y < 0, x > 0, y > 0, x < 0
                poses.setdefault(method, []).append(pose)
                points.setdefault(method, []).append(middles[[0, 2, 1, 3]])
            for config in (PAPER, REFINED):
                got = estimate(edges, eyes, marker, config, Track(X))
                if got.found:
                    poses.setdefault(config.method, []).append(got.X_LV)
                    points.setdefault(config.method, []).append(frames.apply(got.X_LV, P))
        for method in poses:
            rows.append(_table3_row(method, noise, poses[method], np.array(points[method]), X))
    settings = {"target_mm": [120, 80], "blur_px": BLUR, "trials": trials, "seed": seed}
    return {"experiment": "table3", "settings": settings, "rows": rows}


def _table3_row(
    method: str, noise: float | str, poses: list[np.ndarray], points: np.ndarray, truth: np.ndarray | None
) -> dict[str, Any]:
    """Spread of poses and of the points (n, 4, 3): root of the summed variances."""
    mean = _mean_pose(poses)
    turned = [np.degrees(frames.rotation_vector(mean[:, :3].T @ X[:, :3])) for X in poses]
    row = {"method": method, "noise": noise}
    row["p mm"] = 1000 * math.sqrt(np.var([X[:, 3] for X in poses], axis=0, ddof=1).sum())
    row["rms deg"] = math.sqrt(np.mean(np.sum(np.square(turned), axis=1)))
    for k in range(4):
        row[f"P{k + 1} mm"] = 1000 * math.sqrt(points[:, k].var(0, ddof=1).sum())
    if truth is not None:
        off = pose_error(mean, truth)
        row |= {"mean off [mm]": 1000 * float(np.linalg.norm(off[3:]))}
        row |= {"mean off [deg]": math.degrees(float(np.linalg.norm(off[:3])))}
    return row | {"n": len(poses)}


# ---------------------------------------------------------------- the bound


def bound(
    seed: int = 0, trials: int = 300, distances: tuple[float, ...] = DISTANCES, tilts: tuple[int, ...] = TILTS
) -> dict[str, Any]:
    """Error over the bound: sqrt(mean(e^T F e) / 6) of each method, 1 at best; and the NEES / 6 of `refined`.
    Column `edge bound`: `refined` against the bound of the pixels 3 px off the corners.

    Each cell has four poses (direction of the tilt and roll drawn at random), each seen trials / 4 times from places
    up to a pixel apart, a new one every fifth time; the other methods look at the first of each five only. Which of
    two mirrored tilts is right is told to every method alike (IPPE: the nearer pose).

    The mean of NEES / 6 over n pairs has a standard error of sqrt(2 / (6 n)): 0.033 for 300. Of 48 cells the extremes
    are then expected at 1 +- 0.08, so that a value outside 0.9 .. 1.1 means a wrong covariance, not chance.
    """
    rows = list(_bound_cells(seed, trials, distances, tilts))
    totals = {}
    for cameras in ("one", "two"):
        own = [row for row in rows if row["cameras"] == cameras]
        totals[cameras] = {
            "refined": math.sqrt(np.mean([row["refined"] ** 2 for row in own])),
            "edge bound": math.sqrt(np.mean([row["edge bound"] ** 2 for row in own])),
            "worst": max(row["refined"] for row in own),
            "NEES/6": float(np.mean([row["NEES/6"] for row in own])),
            "NEES/6 lowest": min(row["NEES/6"] for row in own),
            "NEES/6 highest": max(row["NEES/6"] for row in own),
        }
    settings = {"target_mm": [98, 100], "blur_px": BLUR, "noise_grey_levels": NOISE, "trials": trials, "seed": seed}
    return {"experiment": "bound", "settings": settings, "rows": rows, "totals": totals}


def _bound_cells(
    seed: int, trials: int, distances: tuple[float, ...], tilts: tuple[int, ...]
) -> Iterator[dict[str, Any]]:
    marker = Marker()
    for z in distances:
        eyes = head() if z >= 0.5 else converged(z)
        # Midway between the cameras; for near targets, a point that both cameras see.
        middle = np.array([0.06, 0, z]) if z >= 0.5 else np.array([0, -0.012, z])
        for tilt in tilts:
            rng = np.random.default_rng([seed, round(1000 * z), tilt])
            errors: dict[tuple[Any, ...], list[Any]] = {}
            for _ in range(4):
                roll = rng.uniform(-0.7, 0.7) if z >= 0.5 else rng.uniform(-0.15, 0.15)
                base = tilted(middle, math.radians(tilt), rng.uniform(0, 2 * math.pi), roll)
                F = information(base, eyes, marker, NOISE)
                for k in range(trials // 4):
                    if k % _LOOKS == 0:
                        X = frames.make(base[:, :3], base[:, 3] + z / 1100 * rng.uniform(-1, 1, 3))
                        clean = draw(X, eyes, marker)
                    images = [canvas.finish(rng, NOISE) for canvas in clean]
                    edges = read(images, eyes, marker)[1]
                    _cell_errors(edges, X, eyes, marker, F, errors, peers=k % _LOOKS == 0)
            for cameras in ("one", "two"):
                row: dict[str, Any] = {"cameras": cameras, "z [m]": z, "tilt [deg]": tilt}
                for method in ("refined", "edge bound", "paper", "IPPE", "ITERATIVE", "corners", "NEES/6"):
                    values = errors.get((cameras, method))
                    row[method] = float((_root if method != "NEES/6" else np.mean)(values)) if values else None
                square = errors[cameras, "square"]
                row |= {"deg": math.degrees(_root([e[0] for e in square])), "mm": 1000 * _root([e[1] for e in square])}
                yield row | {"n": len(square)}


def _root(values: Sequence[float] | np.ndarray) -> float:
    return math.sqrt(np.mean(values))


def tilted(p: np.ndarray, tilt: float, direction: float, roll: float) -> np.ndarray:
    """X_LV at p, its normal `tilt` off the line of sight towards `direction`."""
    d = p / np.linalg.norm(p)
    sight = frames.rot_y(math.atan2(d[0], d[2])) @ frames.rot_x(-math.asin(d[1]))
    axis = tilt * np.array([math.cos(direction), math.sin(direction), 0])
    return frames.make(sight @ frames.rotation(axis) @ frames.rot_z(roll), p)


def _cell_errors(
    edges: MarkerEdges,
    X: np.ndarray,
    eyes: StereoHead,
    marker: Marker,
    F: np.ndarray,
    errors: dict[tuple[Any, ...], list[Any]],
    peers: bool,
) -> None:
    """Adds one pair of images: e^T F e / 6 of `refined`, and of the other methods if `peers`."""

    def add(cameras: str, method: str, pose: np.ndarray, bound: int = 0) -> np.ndarray:
        e = pose_error(pose, X)
        known = F[0, bound] if cameras == "one" else F[:, bound].sum(0)
        errors.setdefault((cameras, method), []).append(float(e @ known @ e) / 6)
        return e

    for cameras, seen in (("one", one_camera(edges)), ("two", edges)):
        # If one camera's fit failed, the pair counts as missed (column n): a pose from one camera is not compared.
        needed = 1 + (cameras == "two")
        got = estimate(seen, eyes, marker, REFINED, Track(X))
        if got.found and got.cameras == needed:
            e = add(cameras, "refined", got.X_LV)
            add(cameras, "edge bound", got.X_LV, 1)
            errors.setdefault((cameras, "NEES/6"), []).append(float(e @ np.linalg.solve(got.covariance, e)) / 6)
            errors.setdefault((cameras, "square"), []).append((float(e[:3] @ e[:3]), float(e[3:] @ e[3:])))
        if not peers:
            continue
        got = estimate(seen, eyes, marker, PAPER, Track(X))
        if got.found and got.cameras == needed:
            add(cameras, "paper", got.X_LV)
    if peers and edges.left.found:
        add("one", "IPPE", ippe(edges.left, X, marker))
        add("one", "ITERATIVE", iterative(edges.left, X, marker))
    if peers and edges.left.found and edges.right.found:
        add("two", "corners", triangulated(_corners_px(edges, X, eyes, marker), eyes, marker)[0])


# ---------------------------------------------------------------- robustness


def robustness(seed: int = 0, trials: int = 60, empty: int = 1000) -> dict[str, Any]:
    """How often the valve's marker is found, without a prior pose, in bad conditions and in scenes without it.

    Wrong: reported as found, but more than 10 deg or 3 % of the distance off. NEES / 6 is the mean over the right ones,
    with the default configuration. It is less than 1: `side_bias` allows for errors that drawn images do not have.
    """
    marker, eyes = Marker(), head()
    light = {"30 % darker": (0.7, 0.7, 0.7), "colour cast": (1.25, 1.0, 0.65)}
    rows: list[dict[str, Any]] = []
    for condition in (
        "plain",
        "half in shadow",
        "corner covered",
        "red distractors",
        "30 % darker",
        "colour cast",
        "blur 2 px",
    ):
        rng = np.random.default_rng([seed, len(rows)])
        millimetres, degrees, squares, wrong, reasons = [], [], [], 0, []
        for _ in range(trials):
            X = _somewhere(rng)
            canvases = _scene(rng, eyes, X, marker, condition)
            images = [canvas.finish(rng, NOISE, light.get(condition, (1.0, 1.0, 1.0)), 95) for canvas in canvases]
            got = estimate(read(images, eyes, marker)[1], eyes, marker, RectangleEstimatorConfig())
            if not got.found:
                reasons.append(got.reason)
                continue
            off = pose_error(got.X_LV, X)
            turn, shift = np.degrees(np.linalg.norm(off[:3])), np.linalg.norm(off[3:])
            if turn > 10 or shift > 0.03 * X[2, 3]:
                wrong += 1
                continue
            millimetres.append(1000 * shift)
            degrees.append(turn)
            squares.append(float(off @ np.linalg.solve(got.covariance, off)) / 6)
        row: dict[str, Any] = {
            "condition": condition,
            "n": trials,
            "found %": 100 * (len(degrees) + wrong) / trials,
            "wrong": wrong,
        }
        for name, values in (("mm", millimetres), ("deg", degrees)):
            at = [float(q) for q in np.quantile(values, [0.5, 0.95])] if values else [None, None]
            row |= {f"median {name}": at[0], f"95 % {name}": at[1]}
        row["NEES/6"] = float(np.mean(squares)) if squares else None
        rows.append(row | {"missed because": max(set(reasons), key=reasons.count) if reasons else ""})
    rng = np.random.default_rng([seed, 99])
    detections = 0
    for _ in range(empty):
        canvases = _scene(rng, eyes, None, marker, "red distractors")
        tint = tuple(rng.uniform(0.75, 1.2, 3))
        images = [canvas.finish(rng, rng.uniform(1, 5), tint, 95) for canvas in canvases]
        detections += estimate(read(images, eyes, marker)[1], eyes, marker, RectangleEstimatorConfig()).found
    settings = {"target_mm": [98, 100], "distance_m": [0.6, 2.0], "tilt_deg": [0, 40], "trials": trials, "seed": seed}
    totals = {"scenes without a marker": empty, "wrong detections in them": detections}
    return {"experiment": "robustness", "settings": settings, "rows": rows, "totals": totals}


def _somewhere(rng: np.random.Generator) -> np.ndarray:
    """A marker's pose that both cameras see, its X axis within 1 rad of level."""
    z = rng.uniform(0.6, 2.0)
    p = np.array([0.06 + 0.05 * (z - 0.4) * rng.uniform(-1, 1), 0.08 * (z - 0.4) * rng.uniform(-1, 1), z])
    return tilted(p, math.radians(rng.uniform(0, 40)), rng.uniform(0, 2 * math.pi), rng.uniform(-1, 1))


def _scene(
    rng: np.random.Generator, eyes: StereoHead, X: np.ndarray | None, marker: Marker, condition: str
) -> list[Canvas]:
    """Both images of a wall with the valve at X, or with none, and what the condition asks for."""
    things = _distractors(rng, X, marker) if condition == "red distractors" else []
    corner = np.array([marker.size[0] / 2, marker.size[1] / 2]) * rng.choice([-1, 1], 2)
    shadow = rng.uniform(-math.pi, math.pi)
    out = []
    for lens, X_CL in zip(eyes.lenses(), _to_cameras(eyes)):
        canvas = Canvas(lens, 2.0 if condition == "blur 2 px" else BLUR)
        for shape, X_LS, color, half in things:
            getattr(canvas, shape)(frames.compose(X_CL, X_LS), color, half)
        if X is not None:
            X_CV = frames.compose(X_CL, X)
            draw_bar(canvas, X_CV, marker)
            if condition == "corner covered":
                cover = frames.make(frames.rot_z(0.6), np.array([*corner, -0.001]))
                canvas.rectangle(frames.compose(X_CV, cover), METAL, (0.016, 0.016))
            if condition == "half in shadow":
                canvas.shade(frames.compose(X_CV, frames.make(frames.rot_z(shadow), np.zeros(3))), 0.5, 2.0)
        out.append(canvas)
    return out


def _distractors(rng: np.random.Generator, X: np.ndarray | None, marker: Marker) -> list[tuple[Any, ...]]:
    """Red discs (wheels), signs with a light bar, long boxes, squares at least a quarter larger or smaller than the
    marker, green marks; beside a marker they leave it free."""
    out = []
    for _ in range(rng.integers(2, 6)):
        z = rng.uniform(0.7, 2.5)
        p = np.array([0.06 + 0.22 * z * rng.uniform(-1, 1), 0.18 * z * rng.uniform(-1, 1), z])
        if X is not None and np.linalg.norm(p / z - X[:, 3] / X[2, 3]) < 0.16 / z + 0.24 / X[2, 3]:
            continue
        pose = tilted(p, math.radians(rng.uniform(0, 50)), rng.uniform(0, 2 * math.pi), rng.uniform(-1.5, 1.5))
        red = tuple(np.array(RED) * rng.uniform(0.6, 1.3) + rng.uniform(0, 25, 3))
        kind = rng.integers(5)
        size = max(marker.size) / 2 * (rng.uniform(0.4, 0.75) if rng.random() < 0.5 else rng.uniform(1.25, 1.6))
        if kind == 0:
            out.append(("disc", pose, red, (rng.uniform(0.03, 0.08), rng.uniform(0.03, 0.08))))
        elif kind == 1:
            out += [("disc", pose, red, (0.06, 0.06)), ("rectangle", pose, WALL, (0.04, 0.012))]
        elif kind == 2:
            out.append(("rectangle", pose, red, (size, size / rng.uniform(1.6, 4))))
        elif kind == 3:
            out.append(("rectangle", pose, red, (size, size)))
        else:
            out.append(("rectangle", pose, GREEN, (0.02, 0.011)))
    return out


# ---------------------------------------------------------------- all of them


def peers(seed: int = 0, trials: int = 100) -> dict[str, Any]:
    """See `peers_experiment`, which draws and measures by what is in this module."""
    from valve_drake.analysis import peers_experiment

    return peers_experiment.peers(seed, trials)


def rendered(seed: int = 0, trials: int = 100) -> dict[str, Any]:
    """See `rendered_bound`, which needs the simulated cameras."""
    from valve_drake.analysis import rendered_bound

    return rendered_bound.rendered_bound(seed, trials)


def voice(seed: int = 0, trials: int = 60) -> dict[str, Any]:
    """See voice/experiment.py. trials: minutes of other speech. It takes long, and says how far it is."""
    from valve_drake.voice import experiment

    return experiment.run(seed, trials, lambda line: print(line, file=sys.stderr, flush=True))


EXPERIMENTS: dict[str, Callable[..., dict[str, Any]]] = {
    "hand-eye": hand_eye_experiment.hand_eye,
    "table2": table2,
    "table3": table3,
    "bound": bound,
    "bound_rendered": rendered,
    "robustness": robustness,
    "peers": peers,
    "voice": voice,
}


def run(name: str, seed: int = 0, trials: int | None = None) -> dict[str, Any]:
    """One experiment by name. Raises ConfigError for bad numbers."""
    require(name in EXPERIMENTS, "experiment", f"one of {', '.join(EXPERIMENTS)}", name)
    require(seed >= 0, "--seed", ">= 0", seed)
    if trials is None:
        return EXPERIMENTS[name](seed)
    require_in(trials, 4, 10000, "--trials")
    return EXPERIMENTS[name](seed, trials)


def plot_bound(result: dict[str, Any], file: Path | IO[bytes]) -> None:
    """Error over the bound by distance, a panel for one camera and one for two, and the honesty of the covariance."""
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "valve_drake"  # the same numbers give the same file
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
    names = {
        "refined": "refined",
        "paper": "paper",
        "IPPE": "IPPE",
        "ITERATIVE": "ITERATIVE",
        "corners": "triangulated",
    }
    for axis, cameras in zip(axes, ("one", "two")):
        rows = [row for row in result["rows"] if row["cameras"] == cameras]
        distances = sorted({row["z [m]"] for row in rows})
        for (method, label), mark in zip(names.items(), "osv^D"):
            cells = [[row[method] for row in rows if row["z [m]"] == z and row[method]] for z in distances]
            if all(cells):
                axis.plot(distances, [_root(np.square(cell)) for cell in cells], marker=mark, label=label)
        axis.axhline(1, color="black", linewidth=1)
        axis.axhline(1.3, color="grey", linewidth=1, linestyle=":")
        axis.set(xscale="log", yscale="log", xlabel="distance [m]", title=f"{cameras} camera{'s' * (cameras == 'two')}")
        axis.set_xticks(distances, [f"{z:g}" for z in distances])
        axis.minorticks_off()
        axis.legend(fontsize=8)
    axes[0].set_ylabel("error / Cramer-Rao bound of all pixels")
    for cameras, mark in (("one", "o"), ("two", "s")):
        rows = [row for row in result["rows"] if row["cameras"] == cameras]
        cells = [[row["NEES/6"] for row in rows if row["z [m]"] == z] for z in distances]
        axes[2].plot(distances, [np.mean(cell) for cell in cells], marker=mark, label=f"{cameras}")
        axes[2].vlines(distances, [min(cell) for cell in cells], [max(cell) for cell in cells], linewidth=1)
    axes[2].axhspan(0.9, 1.1, color="lightgrey")
    axes[2].set(xscale="log", ylim=(0.5, 1.5), xlabel="distance [m]", title="refined: NEES / 6, mean and range")
    axes[2].set_xticks(distances, [f"{z:g}" for z in distances])
    axes[2].minorticks_off()
    axes[2].legend(fontsize=8, title="cameras")
    figure.savefig(file, format="svg", metadata={"Date": None})
    plt.close(figure)
