"""The lens of eq. (1), (2), OpenCV's lens behind the same interface, and the head's calibration file."""

import pathlib

import cv2
import numpy as np
import pytest

from valve_drake.camera.lens import Lens, OpenCvLens, StereoHead, distortion_maps, load_head, save_head
from valve_drake.checks import ConfigError

HEAD = pathlib.Path(__file__).parents[1] / "models" / "calibration" / "head.yaml"
LEFT = Lens(k_u=4.2180e-07, k_v=3.6959e-07, k_x=1082.3, k_y=1067.8, u_0=324.6, v_0=248.3)
OPENCV = OpenCvLens([[533, 0, 342], [0, 534, 234], [0, 0, 1]], [-0.28, 0.1, 0.001, -0.0005, -0.02])
LENSES = pytest.mark.parametrize("lens", [LEFT, OPENCV], ids=["paper", "opencv"])


def pixels(n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform([0, 0], [639, 479], (n, 2))


def test_head_file_is_table_1():
    head = load_head(HEAD)
    assert head.left == LEFT
    assert head.right == Lens(k_u=3.4849e-07, k_v=3.6927e-07, k_x=1252.2, k_y=1242.3, u_0=335.0, v_0=292.0)
    np.testing.assert_array_equal(head.X_LR, np.column_stack([np.eye(3), [0.12, 0, 0]]))


def test_equation_1_by_hand():
    # 300 px right of the axis on its row: u' - u_0 = 300 (1 + k_u 300^2).
    xy = LEFT.normalize(np.array([624.6, 248.3]))
    np.testing.assert_allclose(xy, [300 * (1 + 4.2180e-07 * 9e4) / 1082.3, 0.0], atol=1e-15)


@LENSES
def test_project_is_the_inverse_of_normalize_over_the_whole_image(lens):
    px = pixels(2000)
    np.testing.assert_allclose(lens.project(lens.normalize(px)), px, atol=1e-8)


@LENSES
def test_jacobian_equals_finite_differences(lens):
    px, e = pixels(200), 1e-3
    numeric = np.stack([(lens.normalize(px + e * d) - lens.normalize(px - e * d)) / (2 * e) for d in np.eye(2)], -1)
    np.testing.assert_allclose(lens.normalize_jacobian(px), numeric, atol=1e-9)


@LENSES
def test_one_point_no_point_and_grids_are_taken(lens):
    grid = pixels(6).reshape(2, 3, 2)
    assert lens.normalize(grid).shape == lens.project(lens.normalize(grid)).shape == (2, 3, 2)
    np.testing.assert_allclose(lens.project(lens.normalize(grid[0, 0])), grid[0, 0], atol=1e-8)
    assert lens.normalize_jacobian(grid).shape == (2, 3, 2, 2)
    assert lens.normalize(np.zeros((0, 2))).shape == lens.project(np.zeros((0, 2))).shape == (0, 2)
    assert lens.normalize_jacobian(np.zeros((0, 2))).shape == (0, 2, 2)


def test_distortion_maps_put_a_point_where_project_says():
    K = np.array([[1000.0, 0, 330], [0, 1000.0, 250], [0, 0, 1]])
    v, u = np.mgrid[0:500, 0:660].astype(np.float32)
    xy = np.array([0.2, -0.1])
    at = K[:2, :2] @ xy + K[:2, 2]
    spot = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * 3.0**2)).astype(np.float32)
    raw = cv2.remap(spot, *distortion_maps(LEFT, K), cv2.INTER_CUBIC)
    assert raw.shape == (480, 640)
    vv, uu = np.mgrid[0:480, 0:640]
    found = np.array([(raw * uu).sum(), (raw * vv).sum()]) / raw.sum()
    np.testing.assert_allclose(found, LEFT.project(xy), atol=0.03)


def test_calibration_survives_the_file_bit_for_bit(tmp_path):
    R_LR = cv2.Rodrigues(np.array([0.01, -0.02, 0.003]))[0]
    head = StereoHead(LEFT, OPENCV, np.column_stack([R_LR, [0.1, 1e-7, -3e-9]]))
    save_head(head, tmp_path / "head.yaml", "made by a test\nsecond line")
    back = load_head(tmp_path / "head.yaml")
    assert back.left == head.left
    assert back.right.K.tolist() == OPENCV.K.tolist() and back.right.dist.tolist() == OPENCV.dist.tolist()
    np.testing.assert_array_equal(back.X_LR, head.X_LR)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("k_u: 4.2180e-07", "k_u: fast"), "left.k_u must be"),
        (("k_x: 1082.3", "k_x: -1"), "left.k_x must be"),
        (("k_v: 3.6959e-07, ", ""), "left lacks k_v"),
        (("k_u: 4.2180e-07", "k_u: -5.0e-06, k_w: 1"), "left has unknown k_w"),
        (("k_u: 4.2180e-07", "k_u: -5.0e-06"), "does not fold back"),
        (("width: 640", "width: 640.5"), "left.width must be"),
        (("- [1.0, 0.0, 0.0, 0.12]", "- [1.0, 0.1, 0.0, 0.12]"), "rigid transform"),
        (("- [1.0, 0.0, 0.0, 0.12]\n", ""), "3 rows of 4"),
        (("X_LR:", "X_RL:"), "X_LR"),
        (("left:", "left: ["), "not YAML"),
    ],
)
def test_bad_calibration_is_one_clear_line(tmp_path, change, says):
    path = tmp_path / "bad.yaml"
    path.write_text(HEAD.read_text().replace(*change, 1))
    with pytest.raises(ConfigError) as error:
        load_head(path)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_missing_calibration_names_the_file(tmp_path):
    with pytest.raises(ConfigError, match="nowhere.yaml"):
        load_head(tmp_path / "nowhere.yaml")
