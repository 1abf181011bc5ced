"""Camera files of other programs: one camera gives the same lens from every kind of file; unknown keys are refused."""

import copy
import pathlib
import re

import cv2
import numpy as np
import pytest
import yaml

from valve_drake import frames
from valve_drake.camera.calibration_file import is_own, load_calibration, save_camera
from valve_drake.camera.lens import OpenCvLens, StereoHead, lens_to, save_head
from valve_drake.checks import ConfigError

SIZE = (640, 480)
K = np.array([[600.5, 0, 318.25], [0, 605.75, 243.5], [0, 0, 1]])
DIST = np.array([-0.2, 0.08, 1e-3, -5e-4, 0.0])
LENS = OpenCvLens(K, DIST)
X_LR = frames.make(frames.rotation(np.array([0.01, -0.03, 0.005])), np.array([0.09, 0.001, -0.002]))


def matrix(M: np.ndarray) -> dict:
    M = np.atleast_2d(M)
    return {"rows": len(M), "cols": M.shape[1], "data": M.ravel().tolist()}


def ros(lens: OpenCvLens = LENS, R: np.ndarray | None = None, P: np.ndarray | None = None) -> dict:
    return {
        "image_width": lens.width,
        "image_height": lens.height,
        "camera_name": "camera",
        "camera_matrix": matrix(lens.K),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": matrix(lens.dist),
        "rectification_matrix": matrix(np.eye(3) if R is None else R),
        "projection_matrix": matrix(np.eye(3, 4) if P is None else P),
    }


def message(big: bool) -> dict:
    """As `topic echo` prints it: ROS 1 has capital letters, ROS 2 small ones."""
    names = "DKRP" if big else "dkrp"
    values = (DIST, K.ravel(), np.eye(3).ravel(), np.eye(3, 4).ravel())
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    out = {"header": {"stamp": {"secs": 15, "nsecs": 2}, "frame_id": "cam"}, "height": 480, "width": 640}
    out |= {"distortion_model": "plumb_bob"} | {n: v.tolist() for n, v in zip(names, values)}
    return out | {"binning_x": 0, "binning_y": 0, "roi": roi}


def opencv(path: pathlib.Path, **names: str) -> str:
    """As OpenCV itself writes it, by the path's ending."""
    names = {"K": "camera_matrix", "D": "distortion_coefficients"} | names
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Thu 16 Jun 2022 10:00:00")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write(names["K"], K)
    storage.write(names["D"], DIST.reshape(-1, 1))
    storage.write("avg_reprojection_error", 0.22)
    storage.release()
    return path.read_text()


def numbers(M: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value!r}" for value in row) for row in np.atleast_2d(M).tolist())


INI = f"""# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo/left]

camera matrix
{numbers(K)}

distortion
{numbers(DIST)}

rectification
{numbers(np.eye(3))}

projection
{numbers(np.eye(3, 4))}
"""

VISP = """<?xml version="1.0"?>
<root>
  <!--intrinsic camera parameters-->
  <camera>
    <name>Camera</name>
    <image_width>640</image_width>
    <image_height>480</image_height>
    <model>
      <type>perspectiveProjWithoutDistortion</type>
      <px>611</px><py>612</py><u0>320</u0><v0>240</v0>
    </model>
    <model>
      <type>perspectiveProjWithDistortion</type>
      <px>600.5</px><py>605.75</py><u0>318.25</u0><v0>243.5</v0>
      <kud>-0.2</kud>
      <kdu>0.21</kdu>
    </model>
  </camera>
</root>
"""


def kalibr(cameras: int = 1) -> dict:
    one = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": DIST[:4].tolist(),
        "distortion_model": "radtan",
        "intrinsics": K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
        "resolution": [640, 480],
        "rostopic": "/cam0/image_raw",
    }
    T = np.vstack([frames.inverse(X_LR), [0, 0, 0, 1]])
    return {"cam0": one} | ({"cam1": copy.deepcopy(one) | {"T_cn_cnm1": T.tolist()}} if cameras == 2 else {})


def written(tmp_path: pathlib.Path, content: str | dict | list, name: str = "cam.yaml") -> pathlib.Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content, sort_keys=False))
    return path


def refused(tmp_path: pathlib.Path, content: str | dict) -> str:
    with pytest.raises(ConfigError) as error:
        load_calibration([written(tmp_path, content)])
    text = str(error.value)
    assert "\n" not in text and "cam.yaml" in text and len(text) < 800
    return text


ECHO = {f"ROS {k} echo": yaml.safe_dump(message(k == 1)) + "---\n" for k in (1, 2)}


@pytest.mark.parametrize(
    "kind", ["ROS", *ECHO, "two messages", "ini", "OpenCV YAML", "OpenCV XML", "OpenCV JSON", "Kalibr"]
)
def test_one_camera_is_the_same_in_every_kind_of_file(tmp_path, kind):
    content = {
        "ROS": ros(),
        **ECHO,
        "two messages": ECHO["ROS 1 echo"] + ECHO["ROS 1 echo"].replace("nsecs: 2", "nsecs: 3"),
        "ini": INI,
        "OpenCV YAML": opencv(tmp_path / "a.yaml"),
        "OpenCV XML": opencv(tmp_path / "a.xml", K="cameraMatrix", D="distCoeffs"),
        "OpenCV JSON": opencv(tmp_path / "a.json"),
        "Kalibr": kalibr(),
    }[kind]
    lens = load_calibration([written(tmp_path, content)])
    np.testing.assert_array_equal(lens.K, K)
    np.testing.assert_array_equal(np.append(lens.dist, 0.0)[:5], DIST)
    assert (lens.width, lens.height) == SIZE


def test_visps_distortion_is_read_as_its_model_projects(tmp_path):
    lens = load_calibration([written(tmp_path, VISP, "camera.xml")])
    xy = np.array([0.3, -0.2])
    expected = K[:2, 2] + xy * (1 - 0.2 * (xy @ xy)) * np.diag(K)[:2]
    np.testing.assert_allclose(lens.project(xy), expected, atol=1e-9)
    plain = VISP[: VISP.index("<model>\n      <type>perspectiveProjWithDistortion")] + "</camera></root>"
    lens = load_calibration([written(tmp_path, plain, "camera.xml")])
    np.testing.assert_allclose(lens.project(xy), [320 + 611 * 0.3, 240 - 612 * 0.2])


def test_a_pair_of_ros_and_one_of_kalibr_are_the_same_head(tmp_path):
    X_RL = frames.inverse(X_LR)
    R1, R2, P1, P2 = cv2.stereoRectify(K, DIST, K, DIST, SIZE, X_RL[:, :3], X_RL[:, 3])[:4]
    paths = [written(tmp_path, ros(LENS, R, P), f"{k}.yaml") for k, R, P in ((0, R1, P1), (1, R2, P2))]
    heads = [load_calibration(paths), load_calibration([written(tmp_path, kalibr(2))])]
    for head in heads:
        np.testing.assert_allclose(head.X_LR, X_LR, atol=1e-12)
        np.testing.assert_array_equal(head.left.K, K)
    with pytest.raises(ConfigError, match="the right camera comes second"):
        load_calibration(paths[::-1])


def test_cameras_above_one_another_are_refused_in_a_sentence(tmp_path):
    P = np.eye(3, 4)
    P[1, 3] = -60.0
    paths = [written(tmp_path, ros(), "0.yaml"), written(tmp_path, ros(P=P), "1.yaml")]
    with pytest.raises(ConfigError, match="one above the other are not supported") as error:
        load_calibration(paths)
    assert "np." not in str(error.value)
    tree = kalibr(2)
    tree["cam1"]["T_cn_cnm1"] = [[1, 0, 0, 0], [0, 1, 0, -0.1], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert "above the other" in refused(tmp_path, tree)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"distortion_coefficents": [0]}, "unknown distortion_coefficents, is it distortion_coefficients?"),
        ({"gain": 3}, "unknown gain"),
        ({"distortion_model": "equidistant"}, "distortion_model must be .*a fisheye's"),
        ({"distortion_model": "Inverse Brown Conrady"}, "distortion_model must be"),
        ({"camera_model": "fisheye"}, "camera_model must be"),
        ({"distortion_model": None, "camera_model": "fisheye"}, "camera_model must be .*a fisheye's"),
        ({"fisheye_model": 1}, "fisheye_model must be"),
        ({"camera_matrix": {"data": [1, 2]}}, "camera_matrix must be 9 numbers"),
        ({"camera_matrix": {"rows": 3, "cols": 3, "datta": [1] * 9}}, "unknown datta"),
        ({"camera_matrix": matrix(K + [[0, 5, 0], [0, 0, 0], [0, 0, 0]])}, "skew"),
        ({"camera_matrix": matrix(K * [[-1], [1], [1]])}, "K must be of focal lengths"),
        ({"camera_matrix": {"data": [float("nan")] * 9}}, "K must be"),
        ({"camera_matrix": {"data": ["a"] * 9}}, "a list of numbers"),
        ({"camera_matrix": {"data": [1e300] * 9}}, "K must be"),
        ({"camera_matrix": None}, "camera_matrix"),
        ({"distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1] * 4}}, "1 x 5 numbers"),
        ({"distortion_coefficients": {"data": [0.1] * 3}}, "distortion_coefficients must be"),
        ({"distortion_coefficients": {"data": [0.1] * 8}}, "distortion_coefficients must be"),
        ({"distortion_coefficients": {"data": [-0.9, 0, 0, 0, 0]}}, "folds back"),
        ({"image_width": None}, "width"),
        ({"image_width": True}, "width"),
        ({"width": 640}, "both image_width and width"),
        ({"binning_x": 2}, "binning_x must be 0 or 1"),
        ({"roi": {"x_offset": 12, "width": 320, "height": 240}}, "roi must be the whole image"),
    ],
)
def test_a_key_or_value_that_is_not_understood_is_refused_by_its_name(tmp_path, change, says):
    tree = ros() | change
    if change.get("distortion_model", 0) is None:
        del tree["distortion_model"]
    assert re.search(says, refused(tmp_path, tree))


def test_a_key_that_is_lacking_is_named(tmp_path):
    for name in ("camera_matrix", "distortion_coefficients", "image_width"):
        tree = ros()
        del tree[name]
        assert f"lacks {name}" in refused(tmp_path, tree)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"camera_model": "omni"}, "camera_model must be"),
        ({"distortion_model": "equidistant"}, "a fisheye's"),
        ({"distortion_coeffs": [0.1]}, "distortion_coeffs must be"),
        ({"intrinsics": [1, 2]}, "intrinsics must be"),
        ({"intrinsics": None}, "intrinsics must be"),
        ({"resolution": 640}, "resolution must be"),
        ({"focal": 3}, "unknown focal"),
    ],
)
def test_bad_kalibr_file_is_one_clear_line(tmp_path, change, says):
    tree = kalibr()
    tree["cam0"] |= change
    assert says in refused(tmp_path, tree)
    assert "4 rows" in refused(tmp_path, kalibr(2) | {"cam1": kalibr()["cam0"] | {"T_cn_cnm1": [1]}})


def test_a_transform_that_is_none_is_named_by_the_files_key(tmp_path):
    tree = kalibr(2)
    for value in (0.5, float("nan")):
        tree["cam1"]["T_cn_cnm1"][0][0] = value
        assert "cam1.T_cn_cnm1 must be a 3x4 rigid transform" in refused(tmp_path, tree)


def test_what_is_no_calibration_is_told_what_can_be_read(tmp_path):
    for content in (
        {"a": 1},
        "hello",
        "",
        "<root/>",
        "[1, 2]",
        "- 1\n---\n- 2\n",
        {"M1": matrix(K), "D1": matrix(DIST)},
    ):
        text = refused(tmp_path, content)
        assert all(kind in text for kind in ("ROS", "OpenCV", "Kalibr", "ViSP"))
    with pytest.raises(ConfigError, match="no such file"):
        load_calibration([tmp_path / "nowhere.yaml"])
    assert "differ" in refused(tmp_path, ECHO["ROS 1 echo"] + ECHO["ROS 1 echo"].replace("480", "481"))


def test_xml_expands_nothing(tmp_path):
    entities = "".join(f"<!ENTITY a{k + 1} '{f'&a{k};' * 10}'>" for k in range(9))
    bomb = f"<!DOCTYPE r [<!ENTITY a0 'aaaaaaaaaa'>{entities}]><opencv_storage><K>&a9;</K></opencv_storage>"
    assert "document type" in refused(tmp_path, bomb)
    assert "not XML" in refused(tmp_path, "<opencv_storage><a>")
    many = VISP.replace("</root>", VISP[VISP.index("<camera>") :])
    assert "2 cameras" in refused(tmp_path, many)
    fish = VISP.replace("perspectiveProjWithDistortion", "ProjWithKannalaBrandtDistortion")
    only = fish[: fish.index("<model>")] + fish[fish.rindex("<model>") :]
    assert "a fisheye's" in refused(tmp_path, only)


def test_xml_that_says_a_thing_twice_is_refused_by_its_name(tmp_path):
    width = "<image_width>640</image_width>"
    opencv = f"<opencv_storage>{width}{width}</opencv_storage>"
    assert "'image_width' stands twice" in refused(tmp_path, opencv)
    rows = "<rows>3</rows>"
    matrix = f"<K type_id='opencv-matrix'>{rows}{rows}</K>"
    assert "K: 'rows' stands twice" in refused(tmp_path, f"<opencv_storage>{matrix}</opencv_storage>")
    assert "image_width must be given once" in refused(tmp_path, VISP.replace(width, 2 * width))
    assert "'px' stands twice" in refused(tmp_path, VISP.replace("<px>600.5</px>", "<px>600.5</px><px>601</px>"))
    other = VISP.replace("perspectiveProjWithoutDistortion", "perspectiveProjWithDistortion")
    assert "model must be given once of each type" in refused(tmp_path, other)


# ---------------------------------------------------------------- the program's own


def own(tmp_path: pathlib.Path) -> dict:
    save_head(StereoHead(LENS, LENS, X_LR, rms_px=0.2), tmp_path / "head.yaml")
    return yaml.safe_load((tmp_path / "head.yaml").read_text())


@pytest.mark.parametrize(
    ("where", "value", "says"),
    [
        (("X_LR", 0, 3), 83.2, "0.001 to 10 m apart"),
        (("X_LR",), np.eye(3, 4).tolist(), "0.001 to 10 m apart"),
        (("X_LR",), None, "X_LR must be"),
        (("X_LR", 1, 1), "one", "X_LR must be"),
        (("X_LR", 1, 1), [1], "X_LR must be"),
        (("left", "K", 0, 0), -600.0, "left.K must be"),
        (("left", "K", 0, 0), None, "left.K must be"),
        (("left", "K"), "abc", "left.K must be"),
        (("left", "dist"), [[0.1]], "left.dist must be"),
        (("left", "dist"), "abc", "left.dist must be"),
        (("left", "dist", 1), float("inf"), "left.dist must be"),
        (("left", "width"), 10**18, "left.width must be"),
        (("left", "width"), True, "left.width must be"),
        (("left", "wdith"), 640, "left has unknown wdith"),
        (("left", "sigma_px"), [[0.1, 0.2]], "left.sigma_px must be"),
        (("left", "sigma_px"), [[0.1, -0.2], [1, 1]], "left.sigma_px must be"),
        (("left",), None, "left must be a mapping"),
        (("X_LR", 0, 0), 0.9, "cam.yaml: X_LR must be a 3x4 rigid transform"),
        (("rms_px",), True, "rms_px must be"),
        (("rms_px",), "x", "rms_px must be"),
        (("rms_px",), [1], "rms_px must be"),
    ],
)
def test_bad_value_of_a_calibration_is_one_clear_line(tmp_path, where, value, says):
    tree = own(tmp_path)
    inner = tree
    for name in where[:-1]:
        inner = inner[name]
    inner[where[-1]] = value
    assert says in refused(tmp_path, tree)


def test_only_a_calibration_of_this_program_may_be_replaced(tmp_path):
    save_head(StereoHead(LENS, LENS, X_LR), tmp_path / "head.yaml")
    save_camera(LENS, tmp_path / "hand.yaml", X_EC=np.eye(4))
    assert is_own(tmp_path / "head.yaml") and is_own(tmp_path / "hand.yaml")
    whole = yaml.safe_load((tmp_path / "hand.yaml").read_text())
    for others in (
        {"camera": "front", "robot": "mine"},
        {"left": 1, "right": 2, "X_LR": 3},
        whole | {"notes": "kept here"},
        own(tmp_path) | {"notes": "kept here"},
        {"camera": whole["camera"] | {"exposure": 3}},
        [1, 2],
    ):
        assert not is_own(written(tmp_path, others))


def test_the_map_of_standard_deviations_survives_the_file(tmp_path):
    lens = OpenCvLens(K, DIST, 640, 480, [[0.1, 0.5, 2.0], [0.3, 0.1, 4.0]])
    save_head(StereoHead(lens, LENS, X_LR), tmp_path / "head.yaml")
    back = load_calibration([tmp_path / "head.yaml"])
    assert lens_to(back.left) == lens_to(lens) and "sigma_px" not in lens_to(back.right)
    px = np.array([[0.0, 0.0], [639, 479], [319.5, 479], [319.5, 0], [159.75, 0], [-50, 900]])
    np.testing.assert_allclose(back.left.sigma(px), [0.1, 4.0, 0.1, 0.5, 0.3, 0.3])
    assert back.right.sigma(px).tolist() == [0.0] * 6
