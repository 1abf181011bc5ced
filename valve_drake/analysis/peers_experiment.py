"""The estimator beside public tag detectors: OpenCV's ArUco, napa-vision and locus-tag (extra `peers`).

Each looks at its own target at the same places, through the same camera without distortion (locus-tag's wheel knows no
other), with the same noise: `refined` at the red rectangle of 98 x 100 mm, the others at a 36h11 tag of 100 mm on a
board of the same light, both drawn with exact integrals (`drawn_images`). The rectangle's contrast is in two of three
colours, the tag's image is grey: its contrast is there once. Each error is taken over the bound of its own target.

A tag detector gives four corners. Their pose is IPPE's, of its two the one nearer the truth (`refined` is told the
truth as its track), then least squares from there. `own pose` is what the library itself makes of its corners.
"""

import dataclasses as dc
import importlib.util
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.analysis import experiments
from valve_drake.analysis.drawn_images import PLATE, Canvas
from valve_drake.camera.lens import Lens, LensModel, StereoHead
from valve_drake.perception.marker import Marker
from valve_drake.perception.rectangle_estimator import Track, estimate

SIZE = 0.100  # side of the tag's black square [m]
DISTANCES = (0.6, 1.0, 2.0)  # [m]
ID = 7
_BLACK, _CELLS = 30.0, 8  # of the print [grey level]; in a side of the black square
_LOOKS = 5  # images of one place, each with its own noise
_TILTS = (10.0, 30.0)  # off the line of sight [deg]
PEERS = {"napa_vision": "napa-vision", "locus": "locus-tag"}  # module, and what pip calls it
Find: TypeAlias = Callable[[np.ndarray], "Seen | None"]


@dc.dataclass(frozen=True)
class Seen:
    """What a detector says of the tag."""

    corners: np.ndarray  # (4, 2) [px], clockwise from the one of the picture's upper left; pixel centres are whole
    own: tuple[tuple[np.ndarray, np.ndarray | None], ...] = ()  # the library's poses (3, 4), covariances of (theta, dp)


def missing() -> list[str]:
    """The peers that are not installed."""
    return [name for module, name in PEERS.items() if importlib.util.find_spec(module) is None]


def pinhole_head() -> StereoHead:
    """Table 1's head with its distortion taken away."""
    eyes = experiments.head()
    left, right = (dc.replace(own_lens(lens), k_u=0.0, k_v=0.0) for lens in eyes.lenses())
    return dc.replace(eyes, left=left, right=right)


def own_lens(lens: LensModel) -> Lens:
    """The lens, known to be of the paper's kind. Raises TypeError for others."""
    if not isinstance(lens, Lens):
        raise TypeError(f"a lens by the paper's eq. (1) is needed, not {type(lens).__name__}")
    return lens


def camera_matrix(lens: Lens) -> np.ndarray:
    """K (3, 3) of a lens without distortion [px]."""
    return np.array([[lens.k_x, 0, lens.u_0], [0, lens.k_y, lens.v_0], [0, 0, 1]])


def model() -> np.ndarray:
    """The tag's corners (4, 3) [m], clockwise as the camera sees them, first the one of the picture's upper left."""
    return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (SIZE / 2)


# ---------------------------------------------------------------- the tag's image


def _white_runs() -> list[tuple[float, float, float]]:
    """Of white cells side by side: middle x and y, half the length [m]."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cell, out = SIZE / _CELLS, []
    for row, cells in enumerate(cv2.aruco.generateImageMarker(tags, ID, _CELLS) > 0):
        steps = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]]).astype(int)))
        for start, end in steps.reshape(-1, 2):
            x, y = (start + end) / 2 - _CELLS / 2, row + 0.5 - _CELLS / 2
            out.append((float(x * cell), float(y * cell), float((end - start) / 2 * cell)))
    return out


def _darkness(
    canvas: Canvas, X_CT: np.ndarray, box: tuple[slice, slice] | None = None, inside: bool = True
) -> tuple[np.ndarray, tuple[slice, slice]]:
    """How much of each pixel within `box` (default: about the tag) is black, 0..1; without its cells, if not
    `inside`. Cells are added up, not painted over each other: light is additive, so that seams do not show."""
    dark, box = canvas.seen(X_CT, (SIZE / 2, SIZE / 2), box)
    for x, y, half in _white_runs() if inside else []:
        at = frames.compose(X_CT, frames.make(np.eye(3), np.array([x, y, 0.0])))
        dark = dark - canvas.seen(at, (half, SIZE / _CELLS / 2), box)[0]
    return dark, box


def draw_tag(canvas: Canvas, X_CT: np.ndarray) -> None:
    """A 36h11 tag on a light board twice its size."""
    canvas.rectangle(X_CT, PLATE, (SIZE, SIZE))
    dark, box = _darkness(canvas, X_CT)
    canvas.image[box] -= (PLATE[0] - _BLACK) * dark[:, :, None]


def grey(canvas: Canvas, rng: np.random.Generator | None, noise: float) -> np.ndarray:
    """What a grey camera sees of a grey scene: one channel, with its own noise."""
    return np.ascontiguousarray(canvas.finish(rng, noise)[:, :, 1])


def tag_information(X_CT: np.ndarray, lens: Lens, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Fisher's matrices (6, 6) of (theta, dp): of all pixels of the tag, and of its outer square alone."""
    canvas = Canvas(lens, experiments.BLUR)
    box = _darkness(canvas, X_CT, inside=False)[1]
    steps = np.append(np.full(3, 2e-4), np.full(3, 2e-5 * X_CT[2, 3]))
    out = []
    for inside in (True, False):
        changes = []
        for step in np.diag(steps):
            there, back = (_darkness(canvas, frames.stepped(X_CT, s * step), box, inside)[0].ravel() for s in (1, -1))
            changes.append((PLATE[0] - _BLACK) * (there - back) / (2 * step.sum()))
        J = np.array(changes)
        out.append(J @ J.T / (noise**2 + 1 / 12))  # rounding adds a twelfth
    return out[0], out[1]


# ---------------------------------------------------------------- the detectors


# OpenCV's port of AprilTag's corners counts from the first pixel's edge, half a pixel before its centre.
_REFINEMENTS = {
    "subpix": (cv2.aruco.CORNER_REFINE_SUBPIX, 0.0),
    "apriltag": (cv2.aruco.CORNER_REFINE_APRILTAG, 0.5),
}


def detectors(lens: Lens) -> dict[str, Find]:
    """Those that are installed, by name: grey image (H, W) uint8 -> what is seen of the tag. One thread each."""
    out = {f"ArUco {name}": _aruco(*how) for name, how in _REFINEMENTS.items()}
    if importlib.util.find_spec("napa_vision") is not None:
        out["napa-vision"] = _napa()
        out["napa-vision, own pose"] = _napa(lens)
    if importlib.util.find_spec("locus") is not None:
        out["locus-tag"] = _locus(lens)
        out["locus-tag, own pose"] = _locus(lens, own=True)
    return out


def _aruco(refinement: int, shift: float) -> Find:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = refinement
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = cv2.aruco.ArucoDetector(tags, settings)

    def find(image: np.ndarray) -> Seen | None:
        corners, ids, _ = detector.detectMarkers(image)
        at = [] if ids is None else list(ids.ravel())
        return Seen(corners[at.index(ID)][0].astype(float) - shift) if ID in at else None

    return find


@dc.dataclass(frozen=True)
class _Geometry:
    """A camera as napa-vision's solver asks for it."""

    calibration_matrix: np.ndarray
    distortion_coefficients: np.ndarray


def _napa(lens: Lens | None = None) -> Find:
    """With a lens: with the library's own two poses and their covariances, at its default corner noise."""
    import napa_vision

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # numpy's about the layout of its C structure
        detector = napa_vision.NapaDetector()
    solver = napa_vision.SingleTagPoseSolver()
    camera = None if lens is None else _Geometry(camera_matrix(lens), np.zeros(5))

    def find(image: np.ndarray) -> Seen | None:
        tags = [tag for tag in detector.detect(image) if tag.tag_id == ID]
        if not tags:
            return None
        got = None if camera is None else solver.solve(tags[0], camera, SIZE)
        own = []
        if got is not None:
            own.append(_from_napa(got.pose_0_rvec, got.pose_0_tvec, got.covariance_0))
            if got.pose_1_rvec is not None:
                own.append(_from_napa(got.pose_1_rvec, got.pose_1_tvec, got.covariance_1))
        return Seen(tags[0].corners, tuple(own))

    return find


def _from_napa(rvec: np.ndarray, tvec: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Its tag has y up and z towards the camera; its covariance is of (dp, theta), both in the camera's axes."""
    R = cv2.Rodrigues(rvec)[0] @ np.diag([1.0, -1.0, -1.0])
    T = np.zeros((6, 6))
    T[:3, 3:], T[3:, :3] = R.T, np.eye(3)
    return frames.make(R, np.ravel(tvec)), T @ covariance @ T.T


def _locus(lens: Lens, own: bool = False) -> Find:
    """With its profile for metrology, which needs the camera; it gives poses, but no covariance."""
    import locus

    detector = locus.Detector("high_accuracy", threads=1)
    # It counts from the first pixel's edge, half a pixel before its centre.
    camera = locus.CameraIntrinsics(fx=lens.k_x, fy=lens.k_y, cx=lens.u_0 + 0.5, cy=lens.v_0 + 0.5)

    def find(image: np.ndarray) -> Seen | None:
        seen = detector.detect(image, intrinsics=camera, tag_size=SIZE)
        at = list(seen.ids)
        if ID not in at:
            return None
        k = at.index(ID)
        poses: tuple[tuple[np.ndarray, None], ...] = ()
        if own and seen.poses is not None:
            p, (w, *v) = seen.poses[k][:3], seen.poses[k][3:]
            turn = 2 * math.atan2(float(np.linalg.norm(v)), float(w)) / max(float(np.linalg.norm(v)), 1e-12)
            poses = ((frames.make(frames.rotation(turn * np.array(v, float)), p.astype(float)), None),)
        return Seen(seen.corners[k].astype(float) - 0.5, poses)

    return find


# ---------------------------------------------------------------- poses of corners


def pose_of(corners: np.ndarray, K: np.ndarray, X_near: np.ndarray | None = None) -> np.ndarray:
    """IPPE's pose (3, 4) of the corners, the better one, or the one turned least from `X_near`; then least squares."""
    flags, points = cv2.SOLVEPNP_IPPE, model()
    _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, corners[:, None, :], K, None, flags=flags)
    k = 0
    if X_near is not None:
        turns = [X_near[:, :3].T @ cv2.Rodrigues(rvec)[0] for rvec in rvecs]
        k = int(np.argmin([np.linalg.norm(frames.rotation_vector(turn)) for turn in turns]))
    rvec, tvec = cv2.solvePnPRefineLM(points, corners[:, None, :], K, None, rvecs[k].copy(), tvecs[k].copy())
    return frames.make(cv2.Rodrigues(rvec)[0], tvec.ravel())


def covariance_of(X: np.ndarray, K: np.ndarray, noise: float) -> np.ndarray:
    """Of (theta, dp) (6, 6), if the corners' own noise [px] is white."""
    rows = []
    for m in model():
        P = frames.apply(X, m)
        by_point = np.hstack([-X[:, :3] @ frames.skew(m), np.eye(3)])
        rows.append(K[:2, :2] @ np.array([[1, 0, -P[0] / P[2]], [0, 1, -P[1] / P[2]]]) / P[2] @ by_point)
    J = np.concatenate(rows)
    return noise**2 * np.linalg.inv(J.T @ J)


# ---------------------------------------------------------------- the experiment


def peers(seed: int = 0, trials: int = 100, distances: Sequence[float] = DISTANCES) -> dict[str, Any]:
    """Corner noise, error over the bound and NEES of each detector at each distance, one camera.

    Each place (tilt of 10 to 30 deg in a direction drawn at random, any roll within 40 deg) is seen five times.
    `corner sd`: of the corners about their mean at one place, `corner rms`: from the truth, which has the detector's
    bias too [px]. `over bound`: sqrt(mean(e^T F e) / 6) with F of all pixels of the own target; `over outer edges`:
    of the rectangle's or the black square's outer edge, which for `refined` is the same. `NEES/6`: with the covariance
    that the detector itself gives. `NEES/6, corners`: with the one that follows from the corner sd at that distance,
    as if its user had measured it by looking at one place again and again; what is bias is not in it.
    """
    eyes, marker = pinhole_head(), Marker()
    lens = own_lens(eyes.left)
    K, finders, rows = camera_matrix(lens), detectors(lens), []
    for z in distances:
        rng = np.random.default_rng([seed, round(1000 * z)])
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in ("refined", *finders)}
        for place in range(0, trials, _LOOKS):
            tilt = math.radians(rng.uniform(*_TILTS))
            towards, roll = rng.uniform(0, 2 * math.pi), rng.uniform(-0.7, 0.7)
            middle = np.array([0.06, 0, z]) + z / 1100 * rng.uniform(-1, 1, 3)
            X = experiments.tilted(middle, tilt, towards, roll)
            F_all, F_outer = tag_information(X, lens, experiments.NOISE)
            F_own = experiments.information(X, eyes, marker, experiments.NOISE)[0, 0]
            tag, own = Canvas(lens, experiments.BLUR), experiments.draw(X, eyes, marker)
            draw_tag(tag, X)
            P = frames.apply(X, model())
            true = lens.project(P[:, :2] / P[:, 2:])
            for _ in range(min(_LOOKS, trials - place)):
                images = [canvas.finish(rng, experiments.NOISE) for canvas in own]
                edges = experiments.one_camera(experiments.read(images, eyes, marker)[1])
                got = estimate(edges, eyes, marker, experiments.REFINED, Track(X))
                if got.found:
                    e = experiments.pose_error(got.X_LV, X)
                    squares = {"NEES/6": float(e @ np.linalg.solve(got.covariance, e)) / 6}
                    found["refined"].append(_errors(e, F_own, F_own) | squares)
                image = grey(tag, rng, experiments.NOISE)
                for name, find in finders.items():
                    seen = find(image)
                    if seen is not None:
                        found[name].append(_one(seen, X, K, true, F_all, F_outer) | {"place": place})
        for name, looks in found.items():
            rows.append({"z [m]": z, "detector": name} | _row(looks, K) | {"found": f"{len(looks)}/{trials}"})
    settings = {
        "lens": "Table 1, left, without distortion",
        "tag": f"36h11, {1000 * SIZE:g} mm, grey",
        "rectangle_mm": [98, 100],
        "tilt_deg": _TILTS,
        "blur_px": experiments.BLUR,
        "noise_grey_levels": experiments.NOISE,
        "trials": trials,
        "seed": seed,
    }
    absent = missing()
    totals = {"not installed": f"{', '.join(absent)}: pip install 'valve-drake[peers]'"} if absent else {}
    return {"experiment": "peers", "settings": settings, "rows": rows, "totals": totals}


def _errors(e: np.ndarray, F_all: np.ndarray, F_outer: np.ndarray) -> dict[str, float]:
    return {
        "over bound": float(e @ F_all @ e) / 6,
        "over outer edges": float(e @ F_outer @ e) / 6,
        "mm": float(e[3:] @ e[3:]) * 1e6,
        "deg": math.degrees(1) ** 2 * float(e[:3] @ e[:3]),
    }


def _one(
    seen: Seen, X: np.ndarray, K: np.ndarray, true: np.ndarray, F_all: np.ndarray, F_outer: np.ndarray
) -> dict[str, Any]:
    """What counts of one image of a tag: squares of errors, corners, and the pose for the corners' covariance."""
    out: dict[str, Any] = {}
    if seen.own:
        turns = [np.linalg.norm(experiments.pose_error(pose, X)[:3]) for pose, _ in seen.own]
        pose, covariance = seen.own[int(np.argmin(turns))]
        e = experiments.pose_error(pose, X)
        if covariance is not None:
            out["NEES/6"] = float(e @ np.linalg.solve(covariance, e)) / 6
    else:
        pose = pose_of(seen.corners, K, X)
        e = experiments.pose_error(pose, X)
        out |= {"pose": pose, "e": e, "corners": seen.corners - true}
    return out | _errors(e, F_all, F_outer)


def _row(looks: list[dict[str, Any]], K: np.ndarray) -> dict[str, Any]:
    names = ("corner sd", "corner rms", "mm", "deg", "over bound", "over outer edges", "NEES/6", "NEES/6, corners")
    row: dict[str, Any] = dict.fromkeys(names)
    for name in ("mm", "deg", "over bound", "over outer edges", "NEES/6"):
        values = [look[name] for look in looks if name in look]
        if values:
            row[name] = float(np.mean(values)) if name == "NEES/6" else math.sqrt(np.mean(values))
    with_corners = [look for look in looks if "corners" in look]
    if with_corners:
        row["corner rms"] = math.sqrt(np.mean([look["corners"] ** 2 for look in with_corners]))
        scatter, freedom = 0.0, 0
        for place in {look["place"] for look in with_corners}:
            again = np.array([look["corners"] for look in with_corners if look["place"] == place])
            scatter += float(((again - again.mean(0)) ** 2).sum())
            freedom += 8 * (len(again) - 1)
        if freedom:
            row["corner sd"] = noise = math.sqrt(scatter / freedom)
            squares = [
                look["e"] @ np.linalg.solve(covariance_of(look["pose"], K, noise), look["e"]) for look in with_corners
            ]
            row["NEES/6, corners"] = float(np.mean(squares)) / 6
    return row
