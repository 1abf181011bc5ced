"""teaching.py: the references and Jacobians from images, against the simulated cameras' true geometry."""

import numpy as np
import pytest

from valve_drake import resources, teaching
from valve_drake import scenario as scenarios
from valve_drake.behaviors.taught import load_taught
from valve_drake.messages import SIDES, HandleMark


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
    with pytest.raises(teaching.ConfigError, match="no mark in 8 of 8 left wrist images"):
        teaching.teach(scenario)


def test_noise_that_hides_the_mark_in_one_image_of_eight_does_not_end_it(monkeypatch):
    find, count = teaching.find_mark, iter(range(10**6))

    def noisy(image, config):
        return find(image, config) if next(count) % 8 > 0 else HandleMark(reason="noise")

    monkeypatch.setattr(teaching, "find_mark", noisy)
    taught, _ = teaching.teach(scenarios.load(None))
    assert set(taught) == set(SIDES)
    monkeypatch.setattr(teaching, "find_mark", lambda image, config: HandleMark(reason="noise"))
    with pytest.raises(teaching.ConfigError, match="no mark in 8 of 8 left wrist images: noise"):
        teaching.teach(scenarios.load(None))
