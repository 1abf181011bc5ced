"""Calibration files of any origin: the program's own (one camera, stereo head, hand-eye) and ROS camera_info YAML."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import (
    LensModel,
    OpenCvLens,
    StereoHead,
    lens_from,
    lens_to,
    load_head,
    read_yaml,
    write_yaml,
)
from valve_drake.checks import ConfigError, require

_ROS_MODELS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "none": (0,)}


def load_calibration(paths: Sequence[Path]) -> StereoHead | LensModel:
    """A stereo head, or one lens: from one file, or from the two camera_info files of a ROS stereo pair.

    Raises ConfigError naming the file and the key.
    """
    data = [read_yaml(path) for path in paths]
    keys = [f"calibration {path}" for path in paths]
    if len(data) == 2:
        return _ros_pair(data, keys)
    if _is_ros(data[0]):
        return _ros_lens(data[0], keys[0])
    if "camera" in data[0]:
        return lens_from(data[0]["camera"], f"{keys[0]}: camera")
    return load_head(paths[0])


def save_camera(lens: LensModel, path: Path, comment: str = "", **more: np.ndarray) -> None:
    """Writes one lens as `camera`, and named transforms beside it."""
    write_yaml({"camera": lens_to(lens)} | {name: X.tolist() for name, X in more.items()}, path, comment)


def _is_ros(data: dict[str, Any]) -> bool:
    return "camera_matrix" in data or "image_width" in data or {"K", "D"} <= set(data) or {"k", "d"} <= set(data)


def _numbers(data: dict[str, Any], names: tuple[str, ...], key: str) -> np.ndarray | None:
    """The matrix under the first of `names`, flat: {rows, cols, data} as in files, or a list as in messages."""
    for name in names:
        if name in data:
            value = data[name]["data"] if isinstance(data[name], dict) and "data" in data[name] else data[name]
            try:
                return np.array(value, float).ravel()
            except (TypeError, ValueError) as error:
                raise ConfigError(f"{key}: {name} must be numbers") from error
    return None


def _ros_lens(data: dict[str, Any], key: str) -> OpenCvLens:
    K = _numbers(data, ("camera_matrix", "K", "k"), key)
    D = _numbers(data, ("distortion_coefficients", "D", "d"), key)
    model = data.get("distortion_model", "plumb_bob") or "plumb_bob"
    if model not in _ROS_MODELS:
        raise ConfigError(f"{key}: distortion_model must be plumb_bob or rational_polynomial, got {model!r}")
    require(K is not None and len(K) == 9, f"{key}: camera_matrix", "9 numbers", None if K is None else K.tolist())
    D = np.zeros(0) if D is None else D
    require(len(D) in _ROS_MODELS[model], f"{key}: distortion_coefficients", f"those of {model}", D.tolist())
    size = [data.get(f"image_{name}", data.get(name)) for name in ("width", "height")]
    lens = OpenCvLens(K.reshape(3, 3), D, *size)
    lens.check(key)
    return lens


def _ros_pair(data: list[dict[str, Any]], keys: list[str]) -> StereoHead:
    """Both lenses, and X_LR from the rectification: rotations R of both, and the baseline -P[0, 3] / P[0, 0]."""
    for one, key in zip(data, keys):
        require(_is_ros(one), key, "a ROS camera_info file, as the other of a pair", sorted(one)[:4])
    lenses = [_ros_lens(one, key) for one, key in zip(data, keys)]
    R = [_numbers(one, ("rectification_matrix", "R", "r"), key) for one, key in zip(data, keys)]
    for one, key in zip(R, keys):
        require(one is not None and len(one) == 9, f"{key}: rectification_matrix", "9 numbers", one)
    P = _numbers(data[1], ("projection_matrix", "P", "p"), keys[1])
    require(P is not None and len(P) == 12 and P[0] > 0, f"{keys[1]}: projection_matrix", "12 numbers", P)
    require(P[3] < 0, f"{keys[1]}: projection_matrix[3]", "< 0: the right camera comes second", P[3])
    R_L, R_R = (one.reshape(3, 3) for one in R)
    return StereoHead(lenses[0], lenses[1], frames.make(R_L.T @ R_R, R_L.T @ np.array([-P[3] / P[0], 0, 0])))
