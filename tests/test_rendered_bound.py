"""rendered_bound: the estimator on the images of the simulated cameras, beside the bound."""

import numpy as np
import pytest

from valve_drake.analysis import rendered_bound as mut
from valve_drake.cli import main
from valve_drake.stations.simulation_config import CameraConfig


@pytest.mark.system
def test_the_error_on_rendered_images_is_a_small_multiple_of_the_bound_and_its_covariance_covers_it():
    rows = mut.rendered_bound(trials=6, bands=((0.9, 1.4),))["rows"]
    assert [row["cameras"] for row in rows] == ["one", "two"]
    for row in rows:
        assert row["n"] == row["of"] == 6
        assert 1 < row["over the bound"] < 12  # one point a pixel: 14
        assert 0.05 < row["NEES/6"] < 2
    assert rows[1]["mm"] < rows[0]["mm"] < 0.5


@pytest.mark.system
def test_the_same_seed_gives_the_same_figures():
    first, second = (mut.rendered_bound(seed=3, trials=1, bands=((0.6, 0.9),)) for _ in range(2))
    assert first == second


def test_the_true_pose_is_that_of_the_image():
    """The red of the image is where the corners are projected to."""
    studio = mut._Studio(0, CameraConfig(noise=0.0))
    place = studio.place(np.random.default_rng(0), (0.6, 0.9))
    image = studio.images(place, 0)[0].astype(int)
    red = np.argwhere((image[..., 0] > 120) & (image[..., 1:] < 60).all(axis=-1))[:, ::-1]
    P = place.X_LV[:, :3] @ studio.marker.corners().T + place.X_LV[:, 3:]
    px = studio.eyes.left.project((P[:2] / P[2]).T)
    inside = (red > px.min(axis=0) - 1).all(axis=1) & (red < px.max(axis=0) + 1).all(axis=1)
    assert np.abs(red[inside].mean(axis=0) - px.mean(axis=0)).max() < 0.7


def test_rendered_images_are_an_option_of_the_bound_alone(capsys):
    assert main(["experiment", "table2", "--images", "rendered"]) == 2
    assert capsys.readouterr().err.strip().endswith("got 'table2'")
