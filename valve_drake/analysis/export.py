"""One topic of a log as a table: CSV for spreadsheets, NPZ for numpy.

Columns are named as in Foxglove's message paths: `p_LV[2]`, `left.corners_px[0]`, and `joints[left_arm_1].position` for
elements that have a name of their own. Arrays are flat and row-major, as in the log. Bytes (images) are given by their
number. A message's own `time` and `time_ns` are `message_time` and `message_time_ns`.
"""

import collections
import csv
import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import Message as Proto

from valve_drake import outputs
from valve_drake.messages import Message
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.reader import LogReader
from valve_drake.recording.schemas import Vector

FORMATS = ("csv", "npz")


def write(log: LogReader, topic: str, form: str, path: Path) -> int:
    """Writes a topic to a file -> number of messages. Raises ConfigError if the log has none, OperationFailed."""
    rows = [(record.when, leaves(log.decode(record))) for record in log.records([topic])]
    outputs.write(path, to_csv(rows) if form == "csv" else to_npz(to_arrays(rows)))
    return len(rows)


def was_made(path: Path) -> bool:
    """Whether a file is a table that `write` made."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                return archive.namelist()[:2] == ["time_ns.npy", "time.npy"]
        with open(path, "rb") as file:
            return file.read(12) == b"time_ns,time"
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False


def to_npz(arrays: dict[str, np.ndarray]) -> bytes:
    """As numpy.savez_compressed, which knows no array called `file`."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    return out.getvalue()


def to_csv(rows: Sequence[tuple[int, dict[str, Any]]]) -> str:
    """Columns: time_ns, time [s], then all that any message has; what a message lacks stays empty."""
    flat = [(when, _expanded(row)) for when, row in rows]
    columns = list(dict.fromkeys(name for _, row in flat for name in row))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["time_ns", "time", *columns])
    for when, row in flat:
        writer.writerow([when, repr(when / NANO), *(_cell(row.get(name)) for name in columns)])
    return out.getvalue()


def to_arrays(rows: Sequence[tuple[int, dict[str, Any]]]) -> dict[str, np.ndarray]:
    """Every field as one array (N, ...) beside `time_ns` and `time`; arrays of changing length are padded with NaN."""
    whens = [when for when, _ in rows]
    when = np.array(whens, np.int64 if max(whens, default=0) < 2**63 else np.uint64)
    out = {"time_ns": when, "time": when / NANO}
    for name in dict.fromkeys(name for _, row in rows for name in row):
        out[name] = _stacked([row.get(name) for _, row in rows])
    return out


def leaves(message: Message | Proto, path: str = "") -> dict[str, Any]:
    """The fields of a message by dotted path: numbers, texts, and arrays as they are."""
    if isinstance(message, Vector):
        names = _distinct(message.names)
        return {"message_time": message.time} | dict(zip(names, message.values.tolist()))
    fields: Iterable[tuple[str, Any]]
    if isinstance(message, Message):
        fields = vars(message).items()
    else:
        fields = ((field.name, getattr(message, field.name)) for field in message.DESCRIPTOR.fields)
    out: dict[str, Any] = {}
    for name, value in fields:
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            continue  # pixels are not logged here
        name = f"message_{name}" if name in ("time", "time_ns") and not path else name
        out |= _leaf(f"{path}{name}", value)
    return out


def _leaf(path: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Proto) and value.DESCRIPTOR.full_name == "google.protobuf.Timestamp":
        return {path: value.seconds + value.nanos / NANO}
    if isinstance(value, Message | Proto):
        return leaves(value, f"{path}.")
    if isinstance(value, bytes):
        return {f"{path}.bytes": len(value)}
    if value is None or isinstance(value, str | bool | int | float | np.ndarray):
        return {path: value}
    if isinstance(value, Mapping):
        parts = [_leaf(f"{path}[{key}]", element) for key, element in value.items()]
        return {name: leaf for part in parts for name, leaf in part.items()}
    elements = list(value)
    if all(isinstance(element, int | float) for element in elements):
        return {path: np.array(elements, float)}
    if all(isinstance(element, str) for element in elements):
        return {path: ";".join(elements)}
    out: dict[str, Any] = {}
    names = [getattr(element, "name", "") for element in elements]
    own = [isinstance(name, str) and name != "" and not name.isdecimal() and names.count(name) == 1 for name in names]
    for k, (element, name) in enumerate(zip(elements, names)):
        out |= _leaf(f"{path}[{name if own[k] else k}]", element)
        if own[k]:
            del out[f"{path}[{name}].name"]
    return out


def _distinct(names: Sequence[str]) -> list[str]:
    """The names, those that stand more than once with their number behind them."""
    count = collections.Counter(names)
    return [name if count[name] == 1 else f"{name}[{k}]" for k, name in enumerate(names)]


def _expanded(row: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, np.ndarray):
            out |= {f"{name}[{k}]": number for k, number in enumerate(value.ravel().tolist())}
        elif value is not None:
            out[name] = value
    return out


def _cell(value: Any) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def _stacked(values: list[Any]) -> np.ndarray:
    if any(isinstance(value, str) for value in values):
        return np.array([value if isinstance(value, str) else "" for value in values])  # () has no type
    arrays = [np.asarray(np.nan if value is None else value, float) for value in values]
    depth = max(a.ndim for a in arrays)
    if depth == 0:
        kinds = {type(value) for value in values}
        return np.array(values) if kinds in ({bool}, {int}) else np.array(arrays, float)
    arrays = [a if a.ndim == depth else np.full((0,) * depth, np.nan) for a in arrays]
    shape = np.max([a.shape for a in arrays], axis=0)
    out = np.full((len(arrays), *shape), np.nan)
    for k, a in enumerate(arrays):
        out[k][tuple(slice(n) for n in a.shape)] = a
    return out
