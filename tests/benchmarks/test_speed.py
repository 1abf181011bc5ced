"""Stereo pair to refined pose with covariance, beside OpenCV's ArUco detection and solvePnP: one thread, 640x480.

python -m pytest tests/benchmarks
"""

import time

import cv2
import numpy as np
import pytest

from valve_drake import frames
from valve_drake.analysis.drawn_images import draw_bar
from valve_drake.analysis.experiments import draw, head
from valve_drake.perception import estimate_rectangle
from valve_drake.perception.marker import Marker

pytest.importorskip("pytest_benchmark")
HEAD, MARKER = head(), Marker()
DISTANCES = [0.6, 1.0, 2.0]


@pytest.fixture(autouse=True)
def one_thread():
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    yield
    cv2.setNumThreads(before)


def pose(z):
    R = frames.rot_y(0.3) @ frames.rot_x(-0.25) @ frames.rot_z(0.3)
    return frames.make(R, np.array([0.06, 0.0, z]))


def marker_images(z):
    rng = np.random.default_rng(0)
    return [canvas.finish(rng, 2.0, jpeg=95) for canvas in draw(pose(z), HEAD, MARKER, paint=draw_bar)]


@pytest.mark.benchmark(max_time=3.0)  # longer than what else a machine does for a moment
@pytest.mark.parametrize("z", DISTANCES)
def test_stereo_pair_to_refined_pose(benchmark, z):
    found = benchmark(estimate_rectangle, *marker_images(z), HEAD)
    assert found.found and found.cameras == 2
    assert np.linalg.norm(found.X_LV[:, 3] - pose(z)[:, 3]) < 0.001 * z
    assert benchmark.stats.stats.median < 0.010


def tag_images(z):
    """The same place with a 36h11 tag of the marker's size, black and white on a light board, in both cameras."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tag = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(tags, 7, 400), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=190
    )
    half = MARKER.size[0] / 2 * 520 / 400
    out = []
    for lens, X_CL in ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR))):
        X = frames.compose(X_CL, pose(z))
        v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(float)
        xy = lens.normalize(np.stack([u, v], -1))
        H = np.linalg.inv(np.column_stack([X[:, 0], X[:, 1], X[:, 3]]))
        q = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1) @ H.T
        at = ((q[..., :2] / q[..., 2:] / half + 1) * 260 - 0.5).astype(np.float32)
        smooth = cv2.GaussianBlur(tag, (0, 0), 2.0)
        image = cv2.remap(
            smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120
        )
        noisy = image + np.random.default_rng(0).normal(0, 2.0, image.shape)
        out.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return out


def tag_detection(corners, z):
    """Detection and pose of the tag in both images, as a function to be timed."""
    settings = cv2.aruco.DetectorParameters()
    kinds = {"apriltag": cv2.aruco.CORNER_REFINE_APRILTAG, "subpix": cv2.aruco.CORNER_REFINE_SUBPIX}
    settings.cornerRefinementMethod = kinds[corners]
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = cv2.aruco.ArucoDetector(tags, settings)
    images, half = tag_images(z), MARKER.size[0] / 2
    model = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half

    def work():
        out = []
        for image, lens in zip(images, HEAD.lenses()):
            seen, ids, _ = detector.detectMarkers(image)
            xy = lens.normalize(seen[0][0].astype(float))
            out.append(cv2.solvePnP(model, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE))
        return out

    return work


@pytest.mark.parametrize("z", DISTANCES)
@pytest.mark.parametrize("corners", ["apriltag", "subpix"])
def test_opencv_aruco_on_both_images(benchmark, corners, z):
    left, _ = benchmark(tag_detection(corners, z))
    assert abs(np.linalg.norm(left[2]) - np.linalg.norm(pose(z)[:, 3])) < 0.02 * z


@pytest.mark.parametrize("z", DISTANCES)
def test_side_by_side_with_opencv(z, record_property):
    """Taken in turns in one run, so that whatever else the machine does strikes all alike; processor time."""
    images = marker_images(z)
    works = {"refined": lambda: estimate_rectangle(*images, HEAD)}
    works |= {corners: tag_detection(corners, z) for corners in ("subpix", "apriltag")}
    taken = {name: [] for name in works}
    for _ in range(15):
        for name, work in works.items():
            start = time.process_time()
            work()
            taken[name].append(1000 * (time.process_time() - start))
    median = {name: float(np.median(values[2:])) for name, values in taken.items()}
    for name, value in median.items():
        record_property(f"{name} [ms]", round(value, 2))
    print(f"{z} m:", *(f"{name} {value:.1f} ms" for name, value in median.items()))
    assert median["apriltag"] > 5 * median["refined"]
