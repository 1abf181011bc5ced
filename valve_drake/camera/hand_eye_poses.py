"""The arm's poses, one for each image, from a JSON file."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import frames
from valve_drake.checks import ConfigError, require, shown

_MAX_SIZE = 50_000_000  # [bytes] far above any list of poses
_FAR = 1e6  # [m] also in millimetres no arm is so long


def read_poses(path: Path) -> dict[str, np.ndarray]:
    """Image name -> X_BE (3, 4) from a list of {"image": name, "X_BE": 4x4, m}. Other keys are ignored.

    Raises ConfigError, one line that names the row.
    """
    rows = _json(path)
    require(isinstance(rows, list) and len(rows) > 0, f"--poses {path}", 'a list of {"image", "X_BE"}', rows)
    out: dict[str, np.ndarray] = {}
    for k, row in enumerate(rows):
        key = f"--poses {path}[{k}]"
        require(isinstance(row, dict) and {"image", "X_BE"} <= set(row), key, '{"image": name, "X_BE": 4x4}', row)
        require(isinstance(row["image"], str), f"{key}.image", "the name of an image", row["image"])
        name = Path(row["image"]).name
        require(bool(name), f"{key}.image", "the name of an image", row["image"])
        require(name not in out, f"{key}.image", "named once", name)
        out[name] = _rigid(row["X_BE"], f"{key}.X_BE")
    return out


def _json(path: Path) -> Any:
    try:
        if not path.is_file():
            raise ConfigError(f"--poses {path}: cannot be read (no such file)")
        require(path.stat().st_size <= _MAX_SIZE, f"--poses {path}", f"at most {_MAX_SIZE} bytes", path.stat().st_size)
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"--poses {path}: cannot be read ({error.strerror})") from error
    except RecursionError as error:
        raise ConfigError(f"--poses {path}: nested too deeply for a list of poses") from error
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"--poses {path}: not JSON") from error


def _rigid(rows: Any, key: str) -> np.ndarray:
    """A rigid transform (3, 4) from 4 rows of 4 numbers. Raises ConfigError."""
    four = isinstance(rows, list) and len(rows) == 4 and all(isinstance(row, list) and len(row) == 4 for row in rows)
    four = four and all(isinstance(v, int | float) and not isinstance(v, bool) for row in rows for v in row)
    require(four, key, "4 rows of 4 numbers", rows)
    try:
        X = np.array(rows, float)
    except OverflowError:
        X = np.full((4, 4), np.inf)
    require(bool((np.abs(X) < _FAR).all()), key, f"finite numbers below {_FAR:g}", rows)
    if np.abs(X[3] - [0, 0, 0, 1]).max() > 1e-6:
        wrong = "transposed: the position is its last column" if np.abs(X[:, 3] - [0, 0, 0, 1]).max() < 1e-6 else ""
        raise ConfigError(f"{key} {'is ' + wrong if wrong else 'must end with the row 0 0 0 1'}, got {shown(rows)}")
    R = X[:3, :3]
    require(bool(np.abs(R @ R.T - np.eye(3)).max() < 1e-3), key, "a rotation in its first 3 rows and columns", rows)
    require(bool(np.linalg.det(R) > 0), key, "a rotation, not a mirror image", rows)
    U, _, Vt = np.linalg.svd(R)  # a few printed digits are no exact rotation
    return frames.make(U @ Vt, X[:3, 3])
