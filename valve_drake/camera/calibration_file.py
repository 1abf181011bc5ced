"""Calibration files of any origin: the program's own (one camera, stereo head, hand-eye), and those of others."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import yaml_file
from valve_drake.camera import foreign_files
from valve_drake.camera.lens import LensModel, StereoHead, head_from, lens_from, lens_to, write_yaml
from valve_drake.checks import ConfigError

_HEAD = {"left", "right", "X_LR", "rms_px"}
_CAMERA = {"camera", "X_EC", "X_BC"}  # what `save_camera` writes: a lens, and where it is if that was calibrated


def load_calibration(paths: Sequence[Path]) -> StereoHead | LensModel:
    """A stereo head, or one lens: from one file of any kind, or from the two camera_info files of a ROS stereo pair.

    Raises ConfigError naming the file and the key.
    """
    keys = [f"calibration {path}" for path in paths]
    texts = [yaml_file.read_text(path, key) for path, key in zip(paths, keys)]
    if len(paths) == 2:
        return foreign_files.pair([_mapping(text, key) for text, key in zip(texts, keys)], keys)
    text, key = texts[0], keys[0]
    if text.lstrip().startswith("<"):
        return foreign_files.from_xml(text, key)
    if foreign_files.is_ini(text):
        return foreign_files.from_ini(text, key)
    data = _mapping(text, key)
    if _HEAD & set(data):
        return head_from(data, key)
    if "camera" in data:
        return lens_from(data["camera"], f"{key}: camera")
    if foreign_files.is_kalibr(data):
        return foreign_files.kalibr(data, key)
    if foreign_files.is_camera(data):
        return foreign_files.camera(data, key)
    names = f" (it has {', '.join(sorted(data)[:4])})" if data else ""
    raise ConfigError(f"{key}: not a camera calibration{names}; read are {foreign_files.READ}")


def save_camera(lens: LensModel, path: Path, comment: str = "", **more: np.ndarray) -> None:
    """Writes one lens as `camera`, and named transforms beside it."""
    write_yaml({"camera": lens_to(lens)} | {name: X.tolist() for name, X in more.items()}, path, comment)


def is_own(path: Path) -> bool:
    """Whether a file is a calibration that this program wrote, which a new one may replace: it can be read as one and
    holds nothing else."""
    try:
        data = yaml_file.read(path)
        if not isinstance(data, dict):
            return False
        if "camera" in data:
            lens_from(data["camera"], "camera")
        else:
            head_from(data, "head")
    except ConfigError:
        return False
    return "camera" not in data or set(data) <= _CAMERA


def _mapping(text: str, key: str) -> dict[str, Any]:
    """The one mapping of a YAML text; of several documents, as `topic echo` prints them, if they are one camera."""
    if text.startswith("%YAML:"):  # as OpenCV writes it; YAML's own directive has a space
        text = text.partition("\n")[2]
    trees = yaml_file.documents(text, key, {"!!opencv-matrix": foreign_files.opencv_matrix})
    if not trees or not all(isinstance(tree, dict) for tree in trees):
        raise ConfigError(f"{key}: not a camera calibration; read are {foreign_files.READ}")
    plain = [{name: value for name, value in tree.items() if name != "header"} for tree in trees]
    if any(tree != plain[0] for tree in plain[1:]):
        raise ConfigError(f"{key}: {len(trees)} documents that differ, one camera is read")
    return trees[0]
