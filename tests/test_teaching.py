"""teaching.py: the references and Jacobians from images, against the simulated cameras' true geometry."""

import numpy as np
import pytest

from valve_drake import resources, teaching
from valve_drake import scenario as scenarios
from valve_drake.behaviors.taught import load_taught
from valve_drake.messages import SIDES


@pytest.fixture(scope="module")
def taught():
    patch = pytest.MonkeyPatch()
    patch.setattr(teaching, "IMAGES", 1)
    try:
        return teaching.teach(scenarios.load())[0]
    finally:
        patch.undo()


def test_the_shipped_references_are_current(taught):
    shipped = load_taught(resources.models() / "taught" / "hands.yaml")
    for side in SIDES:
        np.testing.assert_allclose(taught[side].feature, shipped[side].feature, rtol=0.01)
        scale = np.abs(shipped[side].jacobian).max(axis=1, keepdims=True)
        assert np.abs((taught[side].jacobian - shipped[side].jacobian) / scale).max() < 0.05


def test_the_view_direction_learned_from_images_is_the_cameras(taught):
    for side, sign in zip(SIDES, (-1.0, 1.0)):
        true = np.array([sign * 0.075, 0.0, 0.13])  # from the camera to the grip point, models/robot/robot.sdf
        assert np.degrees(np.arccos(taught[side].view @ true / np.linalg.norm(true))) < 5.0


def test_a_mark_out_of_sight_is_one_clear_line():
    scenario = scenarios.load(None, ["handle_marker.segmentation.min_area=200000"])
    with pytest.raises(teaching.ConfigError, match="no mark in the left wrist image"):
        teaching.teach(scenario)
