"""Stereo pair to refined pose with covariance, beside tag detectors (ArUco; extra `peers`): one thread, 640x480.

python -m pytest tests/benchmarks
"""

import time

import cv2
import numpy as np
import pytest

from valve_drake import frames
from valve_drake.analysis import peers_experiment as peers
from valve_drake.analysis.drawn_images import Canvas, draw_bar
from valve_drake.analysis.experiments import draw, head
from valve_drake.perception import estimate_rectangle
from valve_drake.perception.marker import Marker

pytest.importorskip("pytest_benchmark")
HEAD, MARKER = head(), Marker()
PINHOLES = peers.pinhole_head()
TAG_DETECTORS = ["ArUco subpix", "ArUco apriltag", "napa-vision", "napa-vision, own pose", "locus-tag"]
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


def marker_images(z, eyes=HEAD):
    rng = np.random.default_rng(0)
    return [canvas.finish(rng, 2.0, jpeg=95) for canvas in draw(pose(z), eyes, MARKER, paint=draw_bar)]


@pytest.mark.benchmark(max_time=3.0)  # longer than what else a machine does for a moment
@pytest.mark.parametrize("z", DISTANCES)
def test_stereo_pair_to_refined_pose(benchmark, z):
    found = benchmark(estimate_rectangle, *marker_images(z), HEAD)
    assert found.found and found.cameras == 2
    assert np.linalg.norm(found.X_LV[:, 3] - pose(z)[:, 3]) < 0.001 * z
    assert benchmark.stats.stats.median < 0.010


def tag_images(z):
    """The same place with a 36h11 tag of the marker's size on a light board, grey, in both cameras."""
    rng, out = np.random.default_rng(0), []
    for lens, X_CL in zip(PINHOLES.lenses(), (np.eye(3, 4), frames.inverse(PINHOLES.X_LR))):
        canvas = Canvas(lens, blur=0.7)
        peers.draw_tag(canvas, frames.compose(X_CL, pose(z)))
        out.append(peers.grey(canvas, rng, 2.0))
    return out


def tag_detection(name, z):
    """Detection and pose of the tag in both images, each by itself, as a function to be timed."""
    eyes = list(zip(tag_images(z), [peers.detectors(lens)[name] for lens in PINHOLES.lenses()], PINHOLES.lenses()))

    def work():
        poses = []
        for image, find, lens in eyes:
            seen = find(image)
            poses.append(seen.own[0][0] if seen.own else peers.pose_of(seen.corners, peers.camera_matrix(lens)))
        return poses

    return work


def installed(name):
    return not any(name.startswith(peer) for peer in peers.missing())


@pytest.mark.parametrize("z", DISTANCES)
@pytest.mark.parametrize("name", TAG_DETECTORS)
def test_tag_detector_on_both_images(benchmark, name, z):
    if not installed(name):
        pytest.skip(f"{name.split(',')[0]} is not installed: pip install 'valve-drake[peers]'")
    left, _ = benchmark(tag_detection(name, z))
    assert np.linalg.norm(left[:, 3] - pose(z)[:, 3]) < 0.02 * z


@pytest.mark.parametrize("z", DISTANCES)
def test_side_by_side_with_tag_detectors(z, record_property):
    """Taken in turns in one run, so that whatever else the machine does strikes all alike; processor time."""
    images = marker_images(z, PINHOLES)
    works = {"refined": lambda: estimate_rectangle(*images, PINHOLES)}
    works |= {name: tag_detection(name, z) for name in TAG_DETECTORS if installed(name)}
    taken = {name: [] for name in works}
    for _ in range(15):
        for name, work in works.items():
            start = time.process_time()
            work()
            taken[name].append(1000 * (time.process_time() - start))
    median = {name: float(np.median(values[2:])) for name, values in taken.items()}
    for name, value in median.items():
        record_property(f"{name} [ms]", round(value, 2))
    print(f"{z} m:", "; ".join(f"{name} {value:.2f} ms" for name, value in median.items()))
    assert median["ArUco apriltag"] > 5 * median["refined"]
