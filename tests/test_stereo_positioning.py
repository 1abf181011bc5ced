"""Where the marker's centre is: stage 1, and its block."""

import pathlib

import numpy as np
import pytest
from drawn_scene import RED, Drawing, draw_valve, facing
from helpers import Rig, ports, same

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.messages import CameraFrame, RobotState, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segment
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.perception.stereo_positioning import locate
from valve_drake.perception.stereo_positioning_system import StereoPositioningSystem

HEAD = load_head(pathlib.Path(__file__).parents[1] / "models" / "calibration" / "head.yaml")
MARKER, CONFIG = Marker(), StereoPositioningConfig()
VIEWS = ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR)))


def drawn_pair(X_LV, rng, sequence=0):
    both = []
    for lens, X_CL in VIEWS:
        drawing = Drawing(lens)
        for x, half in ((-0.45, (0.12, 0.10)), (0.45, (0.03, 0.035))):  # red boxes of other sizes
            drawing.shape(frames.compose(X_CL, facing(X_LV[2, 3] + 0.3, 0.3, 0.0, 0.1, x)), RED, half)
        draw_valve(drawing, frames.compose(X_CL, X_LV), MARKER)
        image = drawing.finish(rng)
        candidates, green = segment(image, ColorSegmentationConfig())
        both.append(Segmentation(frame=CameraFrame(image=image), candidates=candidates, green=green))
    return SegmentationPair(time=sequence / 8, sequence=sequence, left=both[0], right=both[1])


@pytest.mark.parametrize("z", [1.5, 2.5, 4.0])
def test_drawn_marker_among_distractors_is_located_to_a_percent(z):
    X = facing(z, 0.3, 0.2, 0.4, 0.05, 0.05)
    found = locate(drawn_pair(X, np.random.default_rng(0)), HEAD, MARKER, CONFIG, np.eye(3, 4))
    assert found.found, found.reason
    assert np.linalg.norm(found.p_LV - X[:, 3]) < 0.012 * z
    error = found.p_LV - X[:, 3]
    assert error @ np.linalg.solve(found.covariance, error) < 20


def test_block():
    def head_pose(odometry, torso):
        return frames.planar(*odometry)

    block = StereoPositioningSystem(CONFIG, HEAD, head_pose)
    assert ports(block) == {"segmentation": "in abstract", "robot_state": "in abstract", "position": "out abstract"}
    X = facing(2.0, 0.2, 0.1)
    pair = drawn_pair(X, np.random.default_rng(0), 8)
    history = np.array([[0.5, 0, 0, 0, 0, 0, 0], [1.5, 2, 0, 1, 0, 0, 0]], float)
    dut = Rig(block, segmentation=pair, robot_state=RobotState(history=history))
    first = dut.run(0.1).read("position")
    assert first.found and first.sequence == 8
    np.testing.assert_allclose(first.X_OL, frames.planar(1.0, 0.0, 0.5))  # where the head was at capture, t = 1.0
    assert dut.run(0.4).read("position") is first
    clone = dut.context.Clone()
    dut.fix(segmentation=SegmentationPair(sequence=9, time=1.1))
    lost = dut.run(0.6).read("position")
    assert not lost.found and lost.reason and dut.read("position", clone).found
    fresh = Rig(StereoPositioningSystem(CONFIG, HEAD, head_pose), segmentation=pair)
    fresh.fix(robot_state=RobotState(history=history))
    assert same(fresh.run(0.1).read("position"), first)
