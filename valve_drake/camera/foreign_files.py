"""Camera calibrations as other programs write them: ROS, OpenCV, Kalibr and ViSP.

Each reader gives a lens, or a stereo head, that projects as the writer's own model does. A key that no reader knows is
refused by its name, since it may be a misspelt one, and so is a model that is none of OpenCV's.
"""

import difflib
import re
from collections.abc import Iterable
from typing import Any, NoReturn
from xml.etree import ElementTree

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel, OpenCvLens, StereoHead, check_rigid, head_of
from valve_drake.checks import ConfigError, require, shown

READ = (
    "its own calibrations, ROS camera_info (YAML, ini, or as `topic echo` prints it), OpenCV FileStorage (YAML, XML), "
    "Kalibr camchain and ViSP XML"
)
_COEFFICIENTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "none": (0,)}
_FISHEYES = ("equidistant", "fisheye", "kannala", "omni", "eucm", "ds", "fov", "mei")
_NUMBERS_AND_SIZE = {
    "K": ("camera_matrix", "K", "k", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix"),
    "D": ("distortion_coefficients", "D", "d", "distCoeffs", "Distortion_Coefficients", "dist_coeffs"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
    "width": ("image_width", "width", "image_Width"),
    "height": ("image_height", "height", "image_Height"),
    "model": ("distortion_model", "camera_model"),
}
# Keys that are accepted and ignored: they do not change where a point is projected.
_HARMLESS = {
    *("header", "camera_name", "frame_id", "calibration_time", "calibration_date", "nframes", "nr_of_frames", "flags"),
    *("board_width", "board_height", "square_size", "marker_size", "aspectRatio", "fix_aspect_ratio"),
    *("fix_principal_point_at_the_center", "avg_reprojection_error", "Avg_Reprojection_Error", "reprojection_error"),
    *("per_view_reprojection_errors", "extrinsic_parameters", "image_points", "grid_points", "rms", "RMS"),
}
_CHECKED = {"binning_x", "binning_y", "roi", "fisheye_model"}


def is_camera(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like one camera of ROS or OpenCV."""
    return any(name in data for key in ("K", "D", "width") for name in _NUMBERS_AND_SIZE[key])


def camera(data: dict[str, Any], key: str) -> LensModel:
    """One camera of ROS (camera_info as a file, or as a message) or OpenCV. Raises ConfigError naming the key."""
    _refuse_unknown(data, {name for names in _NUMBERS_AND_SIZE.values() for name in names} | _HARMLESS | _CHECKED, key)
    model_name, model = _one_of(data, "model", key)
    for name in _NUMBERS_AND_SIZE["model"]:
        if name in data and name != model_name:
            require(data[name] in (model, "pinhole", ""), f"{key}: {name}", f"as {model_name} says", data[name])
    if data.get("fisheye_model") not in (None, 0, False):
        _refuse_model("fisheye", f"{key}: fisheye_model")
    K = _matrix(data, "K", 9, key)
    D = _matrix(data, "D", None, key)
    if model in (None, "", "pinhole"):
        model = next((name for name, counts in _COEFFICIENTS.items() if len(D) in counts), "plumb_bob")
    if not isinstance(model, str) or model not in _COEFFICIENTS:
        _refuse_model(model, f"{key}: {model_name}")
    counts = _COEFFICIENTS[model]
    rule = f"the {' or '.join(map(str, counts))} numbers of {model}"
    require(len(D) in counts, f"{key}: {_one_of(data, 'D', key)[0]}", rule, D.tolist())
    _refuse_parts(data, key)
    size = [_one_of(data, name, key, needed=True)[1] for name in ("width", "height")]
    return _lens(K.reshape(3, 3), D, size, key)


def pair(data: list[dict[str, Any]], keys: list[str]) -> StereoHead:
    """Both cameras of a ROS pair, left first. X_LR is that of the rectification: rotations R, baseline -P[3] / P[0].

    Raises ConfigError naming the key.
    """
    for one, key in zip(data, keys):
        require(is_camera(one), key, "a ROS camera_info file, as the other of a pair", sorted(one)[:4])
    lenses = [camera(one, key) for one, key in zip(data, keys)]
    R = []
    for one, key in zip(data, keys):
        R.append(_matrix(one, "R", 9, key).reshape(3, 3))
        rotation = np.abs(R[-1] @ R[-1].T - np.eye(3)).max() < 1e-3 and np.linalg.det(R[-1]) > 0
        require(bool(rotation), f"{key}: rectification_matrix", "a rotation", R[-1].tolist())
    P = _matrix(data[1], "P", 12, keys[1])
    require(P[0] > 0, f"{keys[1]}: projection_matrix", "of a positive focal length", P.tolist())
    if abs(P[7]) > abs(P[3]):
        raise ConfigError(
            f"{keys[1]}: projection_matrix has its baseline along y: cameras one above the other are not supported"
        )
    require(P[3] < 0, f"{keys[1]}: projection_matrix[3]", "< 0: the right camera comes second", float(P[3]))
    X_LR = frames.make(R[0].T @ R[1], R[0].T @ np.array([-P[3] / P[0], 0, 0]))
    return head_of(lenses[0], lenses[1], X_LR, f"{keys[1]}: the cameras' transform")


# ---------------------------------------------------------------- Kalibr


_KALIBR = {
    *("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "T_cn_cnm1"),
    *("rostopic", "cam_overlaps", "T_cam_imu", "T_imu_cam", "timeshift_cam_imu", "line_delay"),
}


def is_kalibr(data: dict[str, Any]) -> bool:
    """Whether a mapping looks like a camchain of Kalibr."""
    return any(re.fullmatch(r"cam\d+", name) for name in data)


def kalibr(data: dict[str, Any], key: str) -> LensModel | StereoHead:
    """A camchain of one camera, or of two: cam0 is the left one. Raises ConfigError naming the key."""
    names = sorted((name for name in data if re.fullmatch(r"cam\d+", name)), key=lambda name: int(name[3:]))
    _refuse_unknown(data, names, key)
    if len(names) > 2:
        raise ConfigError(f"{key}: a camchain of {len(names)} cameras, one or two are read")
    lenses = [_kalibr_lens(data[name], f"{key}: {name}") for name in names]
    if len(lenses) == 1:
        return lenses[0]
    inner = f"{key}: {names[1]}.T_cn_cnm1"
    T = _numbers(data[names[1]].get("T_cn_cnm1"), inner)  # takes points from cam0 to cam1
    require(len(T) == 16, inner, "4 rows of 4 numbers", T.tolist())
    X_RL = T.reshape(4, 4)[:3]
    check_rigid(X_RL, inner)
    return head_of(lenses[0], lenses[1], frames.inverse(X_RL), inner)


def _kalibr_lens(data: Any, key: str) -> OpenCvLens:
    require(isinstance(data, dict), key, "a mapping", data)
    _refuse_unknown(data, _KALIBR, key)
    if data.get("camera_model") != "pinhole":
        _refuse_model(data.get("camera_model"), f"{key}.camera_model")
    model = data.get("distortion_model")
    if model not in ("radtan", "none"):
        _refuse_model(model, f"{key}.distortion_model")
    f = _numbers(data.get("intrinsics"), f"{key}.intrinsics")
    require(len(f) == 4, f"{key}.intrinsics", "fu, fv, pu, pv", f.tolist())
    D = _numbers(data.get("distortion_coeffs", []), f"{key}.distortion_coeffs")
    require(len(D) == (4 if model == "radtan" else 0), f"{key}.distortion_coeffs", f"those of {model}", D.tolist())
    size = data.get("resolution")
    require(isinstance(size, list) and len(size) == 2, f"{key}.resolution", "width and height", size)
    return _lens(np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1]]), D, size, key)


# ---------------------------------------------------------------- XML and ini


def from_xml(text: str, key: str) -> LensModel | StereoHead:
    """OpenCV's FileStorage or ViSP's camera parameters. Raises ConfigError."""
    # A document type can define entities that expand to gigabytes; no calibration needs one.
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise ConfigError(f"{key}: XML with a document type is not read")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise ConfigError(f"{key}: not XML ({error})") from error
    if root.tag == "opencv_storage":
        _refuse_twice(root, key)
        return camera({node.tag: _opencv_node(node, key) for node in root}, key)
    cameras = root.findall("camera")
    if not cameras:
        raise ConfigError(f"{key}: XML without a camera; read are {READ}")
    if len(cameras) > 1:
        raise ConfigError(f"{key}: {len(cameras)} cameras, one is read")
    return _visp(cameras[0], key)


def _refuse_twice(node: ElementTree.Element, key: str) -> None:
    """Raises ConfigError where a name stands twice inside a node: nobody sees which of the two is meant."""
    names = [part.tag for part in node]
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise ConfigError(f"{key}: {shown(twice)} stands twice")


def _opencv_node(node: ElementTree.Element, key: str) -> Any:
    text = (node.text or "").strip()
    if node.get("type_id") == "opencv-matrix":
        _refuse_twice(node, f"{key}: {node.tag}")
        return {
            part.tag: (part.text or "").split() if part.tag == "data" else (part.text or "").strip() for part in node
        }
    return _number(text) if len(node) == 0 else text


def _visp(node: ElementTree.Element, key: str) -> OpenCvLens:
    _refuse_unknown(
        [part.tag for part in node],
        ("name", "image_width", "image_height", "sampling_width", "sampling_height", "model", "additional_information"),
        key,
    )
    sizes = ("image_width", "image_height")
    for name in sizes:
        require(
            len(node.findall(name)) == 1, f"{key}: {name}", "given once", [part.text for part in node.findall(name)]
        )
    size = [_number(node.findtext(name, "").strip()) for name in sizes]
    for name in ("sampling_width", "sampling_height"):
        step = _number(node.findtext(name, "1").strip())
        require(step in (0, 1), f"{key}: {name}", "1", step)
    models = {model.findtext("type", "").strip(): model for model in node.findall("model")}
    require(len(models) == len(node.findall("model")), f"{key}: model", "given once of each type", list(models))
    kinds = {"perspectiveProjWithDistortion": 5, "perspectiveProjWithoutDistortion": 4}
    kind = next((name for name in kinds if name in models), None)
    if kind is None:
        _refuse_model(next(iter(models), None), f"{key}: model")
    _refuse_twice(models[kind], f"{key}: {kind}")
    names = ("px", "py", "u0", "v0", "kud")[: kinds[kind]]
    _refuse_unknown([part.tag for part in models[kind]], ("type", "px", "py", "u0", "v0", "kud", "kdu"), key)
    px, py, u0, v0, *kud = _numbers(
        [_number(models[kind].findtext(name, "").strip()) for name in names], f"{key}: {kind}"
    )
    # x' = x (1 + kud r^2) at unit focal length: OpenCV's k1.
    return _lens(np.array([[px, 0, u0], [0, py, v0], [0, 0, 1]]), np.array([*kud, 0, 0, 0] if kud else []), size, key)


def is_ini(text: str) -> bool:
    """Whether a text looks like ROS's ini: it begins with a section and has a camera matrix."""
    first = re.search(r"^[ \t]*([^#;\s][^\n]*)", text, re.MULTILINE)
    return bool(first and re.fullmatch(r"\[[\w /.-]+\]\s*", first[1])) and "camera matrix" in text


def from_ini(text: str, key: str) -> LensModel:
    """ROS's ini (ost.txt): a section [image] with the size, and one of the camera, a name above its numbers."""
    values: dict[str, list[str]] = {}
    sections, name = [], ""
    for line in (line.split("#")[0].strip() for line in text.splitlines()):
        if line.startswith("["):
            sections.append(line.strip("[]"))
        elif re.match(r"[A-Za-z]", line) and not re.match(r"(nan|inf)\b", line, re.IGNORECASE):
            name = line
            require(name not in values, f"{key}: {shown(name)}", "of one camera", sections)
            values[name] = []
        elif line:
            require(name in values, key, "names above numbers", line)
            values[name] += line.split()
    known = {"width": "width", "height": "height", "camera matrix": "K", "distortion": "D"}
    known |= {"rectification": "R", "projection": "P"}
    _refuse_unknown(values, [*known, "translation", "rotation"], key)
    data: dict[str, Any] = {
        known[name]: [_number(one) for one in given] for name, given in values.items() if name in known
    }
    for name in ("width", "height"):
        require(len(data.get(name, [])) == 1, f"{key}: {name}", "one number", data.get(name))
        data[name] = data[name][0]
    return camera(data, key)


# ---------------------------------------------------------------- shared


def opencv_matrix(tree: Any) -> Any:
    """The mapping below YAML's tag !!opencv-matrix. Raises ValueError if it has no data."""
    if not isinstance(tree, dict) or "data" not in tree:
        raise ValueError("it must have rows, cols, dt and data")
    return tree


def _lens(K: np.ndarray, D: np.ndarray, size: list[Any], key: str) -> OpenCvLens:
    width, height = (int(n) if isinstance(n, float) and n.is_integer() else n for n in size)
    lens = OpenCvLens(K, D, width, height)
    lens.check(key)
    return lens


def _refuse_unknown(names: Iterable[str], known: Iterable[str], key: str) -> None:
    known = sorted(known)
    unknown = [name for name in names if name not in known]
    if not unknown:
        return
    near = difflib.get_close_matches(str(unknown[0]), known, 1, 0.8)
    raise ConfigError(
        f"{key} has unknown {', '.join(shown(name)[1:-1] for name in unknown[:6])}"
        + (f", is it {near[0]}?" if near else "")
    )


def _refuse_model(model: Any, key: str) -> NoReturn:
    text = str(model).lower()
    more = " (a fisheye's, which this program does not have)" if any(one in text for one in _FISHEYES) else ""
    raise ConfigError(f"{key} must be plumb_bob, rational_polynomial or their like, got {shown(model)}{more}")


def _refuse_parts(data: dict[str, Any], key: str) -> None:
    """Raises ConfigError for a region of interest or binning: the camera matrix is that of the whole sensor."""
    for name in ("binning_x", "binning_y"):
        require(data.get(name, 0) in (0, 1), f"{key}: {name}", "0 or 1", data.get(name))
    roi = data.get("roi") or {}
    require(isinstance(roi, dict), f"{key}: roi", "a mapping", roi)
    size = [_one_of(data, name, key)[1] for name in ("width", "height")]
    whole = all(roi.get(name, 0) == 0 for name in ("x_offset", "y_offset"))
    whole = whole and [roi.get(name, 0) for name in ("width", "height")] in ([0, 0], size)
    require(whole, f"{key}: roi", "the whole image", roi)


def _one_of(data: dict[str, Any], what: str, key: str, needed: bool = False) -> tuple[str, Any]:
    """(name, value) under the first of the names for `what` that is there."""
    names = [name for name in _NUMBERS_AND_SIZE[what] if name in data]
    if not names and needed:
        raise ConfigError(f"{key} lacks {_NUMBERS_AND_SIZE[what][0]}")
    if len(names) > 1 and what != "model":
        raise ConfigError(f"{key} has both {names[0]} and {names[1]}")
    return (names[0], data[names[0]]) if names else (_NUMBERS_AND_SIZE[what][0], None)


def _matrix(data: dict[str, Any], what: str, size: int | None, key: str) -> np.ndarray:
    """A matrix, flat: {rows, cols, data} as in files, or a list as in messages."""
    name, value = _one_of(data, what, key, needed=True)
    inner = f"{key}: {name}"
    if isinstance(value, dict):
        _refuse_unknown(value, ("rows", "cols", "dt", "data", "type_id"), inner)
        numbers = _numbers(value.get("data"), f"{inner}.data")
        shape = [_number(value.get(side, 0)) for side in ("rows", "cols")]
        if "rows" in value and "cols" in value and all(isinstance(n, int) for n in shape):
            require(shape[0] * shape[1] == len(numbers), f"{inner}.data", f"{shape[0]} x {shape[1]} numbers", numbers)
    else:
        numbers = _numbers(value, inner)
    require(size is None or len(numbers) == size, inner, f"{size} numbers", numbers)
    return numbers


def _numbers(value: Any, key: str) -> np.ndarray:
    """Numbers of a list, or of lists of lists, flat; that they are finite is for the lens to check."""
    flat: list[Any] = []

    def collect(one: Any) -> None:
        if isinstance(one, list):
            for inner in one:
                collect(inner)
        else:
            flat.append(_number(one))

    collect(value)
    ok = isinstance(value, list) and all(isinstance(n, int | float) and not isinstance(n, bool) for n in flat)
    require(ok, key, "a list of numbers", value)
    return np.array(flat, float)


def _number(text: Any) -> Any:
    """The number that a text of an XML or ini file stands for; anything that is no such text is returned as it is."""
    if not isinstance(text, str) or len(text) > 64:
        return text
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
