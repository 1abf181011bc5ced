"""A small network in numpy: rows of numbers, 80 ms each, to which word has just been said."""

import dataclasses as dc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import resources
from valve_drake.checks import ConfigError, require
from valve_drake.voice.words import WORDS


@dc.dataclass(frozen=True)
class WordNet:
    """The last `span` rows -> the probability of each class.

    weights, biases: of three layers, (span * row, h1), (h1, h2), (h2, CLASSES). mean, scale: of a row's numbers,
    (row,). silence: the row of digital silence, standardised, which stands before the first.
    """

    span: int
    mean: np.ndarray
    scale: np.ndarray
    silence: np.ndarray
    weights: tuple[np.ndarray, np.ndarray, np.ndarray]
    biases: tuple[np.ndarray, np.ndarray, np.ndarray]

    @staticmethod
    def load(path: Path | None = None) -> "WordNet":
        """path: None: the embedding's, which comes with the program. Raises ConfigError where it is no such file."""
        path = path or shipped("words")
        try:
            with np.load(path, allow_pickle=False) as file:
                made = {name: file[name].astype(np.float32) for name in file.files if name != "words"}
                words = tuple(file["words"].tolist())
            layers = range(1, 4)
            net = WordNet(
                int(made["span"]),
                made["mean"],
                made["scale"],
                made["silence"],
                tuple(made[f"weights_{k}"] for k in layers),  # type: ignore[arg-type]
                tuple(made[f"biases_{k}"] for k in layers),  # type: ignore[arg-type]
            )
        except (OSError, ValueError, KeyError, EOFError) as e:
            raise ConfigError(f"not a word network: {path} ({type(e).__name__})") from None
        require(words == WORDS, f"words of {path}", "those of valve_drake.voice.words", words)
        return net

    def save(self, path: Path) -> None:
        arrays: dict[str, Any] = {f"weights_{k + 1}": w.astype(np.float16) for k, w in enumerate(self.weights)}
        arrays |= {f"biases_{k + 1}": b.astype(np.float32) for k, b in enumerate(self.biases)}
        arrays |= {"mean": self.mean, "scale": self.scale, "silence": self.silence, "span": np.array(self.span)}
        np.savez(path, words=np.array(WORDS), **arrays)

    def probabilities(self, rows: np.ndarray) -> np.ndarray:
        """Rows since the beginning of a stream (n, row) -> (n, CLASSES)."""
        x = np.concatenate([np.tile(self.silence, (self.span - 1, 1)), (rows - self.mean) / self.scale])
        n = len(rows)
        return self._classes(np.concatenate([x[k : k + n] for k in range(self.span)], 1))

    def start(self) -> Callable[[np.ndarray], np.ndarray]:
        """A stream's network: the next row (row,) -> (CLASSES,)."""
        last = np.tile(self.silence, (self.span, 1)).astype(np.float32)

        def push(row: np.ndarray) -> np.ndarray:
            last[:-1] = last[1:].copy()
            last[-1] = (row - self.mean) / self.scale
            return self._classes(last.reshape(1, -1))[0]

        return push

    def _classes(self, x: np.ndarray) -> np.ndarray:
        for k in (0, 1):
            x = np.maximum(x @ self.weights[k] + self.biases[k], 0)
        x = x @ self.weights[2] + self.biases[2]
        e = np.exp(x - x.max(1, keepdims=True))
        return e / e.sum(1, keepdims=True)


def shipped(name: str) -> Path:
    """The file of a network that comes with the program."""
    return resources.models() / "voice" / f"{name}.npz"
