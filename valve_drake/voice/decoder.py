"""Whisper's decoder in numpy: how likely each of many sentences is, where all that they begin alike is worked out once.

CTranslate2 offers the same a sentence at a time, each with all that stands before it, in four times the time. The
weights are read from its file, model.bin.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.special import erf

_KINDS = (np.float32, np.int8, np.int16, np.int32, np.float16)  # of numbers in a file


def weights(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a CTranslate2 model, by name. Raises OSError, or ValueError where it is no such file."""
    data, at = path.read_bytes(), 0

    def take(what: str) -> int:
        nonlocal at
        (value,) = struct.unpack_from("<" + what, data, at)
        at += struct.calcsize(what)
        return int(value)

    def text() -> str:
        nonlocal at
        size = take("H")
        at += size
        return data[at - size : at].rstrip(b"\0").decode()

    try:
        take("I"), text(), take("I")  # versions of the format and of the kind of model
        out: dict[str, np.ndarray] = {}
        for _ in range(take("I")):
            name = text()
            shape = [take("I") for _ in range(take("B"))]
            kind, size = np.dtype(_KINDS[take("B")]), take("I")
            out[name] = np.frombuffer(data, kind, size // kind.itemsize, at).reshape(shape)
            at += size
    except (struct.error, IndexError, ValueError) as error:
        raise ValueError(f"not a model of CTranslate2: {path} ({error})") from None
    return out


class Tree:
    """Sentences as tokens, and what stands before them, so that what they share is there once."""

    def __init__(self, before: Sequence[int], sentences: Sequence[Sequence[int]]) -> None:
        rows: dict[tuple[int, ...], int] = {(): len(before) - 1}
        tokens, parents = list(before), list(range(-1, len(before) - 1))
        asked: list[tuple[int, int]] = []  # of each token of a sentence: the row before it, and the token
        for sentence in sentences:
            for k, token in enumerate(sentence):
                row, longer = rows[tuple(sentence[:k])], tuple(sentence[: k + 1])
                asked.append((row, token))
                if longer not in rows and k + 1 < len(sentence):
                    rows[longer] = len(tokens)
                    tokens.append(token)
                    parents.append(row)
        self.tokens = np.array(tokens)
        self.seen = np.eye(len(tokens), dtype=bool)  # which rows each row follows, itself among them
        for k, parent in enumerate(parents):
            if parent >= 0:
                self.seen[k] |= self.seen[parent]
        self.places = self.seen.sum(1) - 1
        self.rows, self.numbers = np.unique([row for row, _ in asked], return_inverse=True)
        self.wanted = np.array([token for _, token in asked])
        self.ends = np.cumsum([len(sentence) for sentence in sentences])[:-1]


class Decoder:
    """arrays: of `weights`. Works in 32 bits; tiny.en's takes 0.12 GB of memory."""

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        def of(name: str) -> np.ndarray:
            return np.ascontiguousarray(arrays[f"decoder/{name}"], np.float32)

        def pair(name: str, first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
            return of(f"{name}/{first}"), of(f"{name}/{second}")

        self._heads = int(arrays["decoder/num_heads"])
        self._tokens, self._places = of("embeddings/weight"), of("position_encodings/encodings")
        self._last = pair("layer_norm", "gamma", "beta")
        self._layers: list[dict[str, tuple[np.ndarray, np.ndarray]]] = []
        while f"decoder/layer_{len(self._layers)}/ffn/linear_0/weight" in arrays:
            layer = {}
            for part, many in (("self_attention", 2), ("attention", 3), ("ffn", 2)):
                name = f"layer_{len(self._layers)}/{part}"
                layer[part] = pair(f"{name}/layer_norm", "gamma", "beta")
                for k in range(many):
                    matrix, bias = pair(f"{name}/linear_{k}", "weight", "bias")
                    layer[f"{part} {k}"] = np.ascontiguousarray(matrix.T), bias
            self._layers.append(layer)

    def likelihoods(self, seen: np.ndarray, tree: Tree) -> np.ndarray:
        """Logarithms of the sentences' probabilities (n,) in what the encoder made of a sound (frames, width)."""
        seen = np.asarray(seen, np.float32)
        x = self._tokens[tree.tokens] + self._places[tree.places]
        hidden = np.where(tree.seen, 0.0, -1e9).astype(np.float32)
        for layer in self._layers:
            own = np.split(_linear(_norm(x, layer["self_attention"]), layer["self_attention 0"]), 3, 1)
            x = x + _linear(self._attend(own[0], own[1], own[2], hidden), layer["self_attention 1"])
            asked = _linear(_norm(x, layer["attention"]), layer["attention 0"])
            sound = np.split(_linear(seen, layer["attention 1"]), 2, 1)
            x = x + _linear(self._attend(asked, sound[0], sound[1]), layer["attention 2"])
            h = _linear(_norm(x, layer["ffn"]), layer["ffn 0"])
            x = x + _linear(0.5 * h * (1 + erf(h * np.float32(np.sqrt(0.5)))), layer["ffn 1"])
        logits = _norm(x[tree.rows], self._last) @ self._tokens.T
        most = logits.max(1)
        total = most + np.log(np.exp(logits - most[:, None]).sum(1))
        each = logits[tree.numbers, tree.wanted] - total[tree.numbers]
        return np.array([part.sum() for part in np.split(each, tree.ends)])

    def _attend(
        self, asked: np.ndarray, keys: np.ndarray, values: np.ndarray, hidden: float | np.ndarray = 0.0
    ) -> np.ndarray:
        a, k, v = (x.reshape(len(x), self._heads, -1).transpose(1, 0, 2) for x in (asked, keys, values))
        e = a @ k.transpose(0, 2, 1) / np.float32(np.sqrt(a.shape[2])) + hidden
        e = np.exp(e - e.max(2, keepdims=True))
        return ((e / e.sum(2, keepdims=True)) @ v).transpose(1, 0, 2).reshape(len(asked), -1)


def _linear(x: np.ndarray, layer: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return x @ layer[0] + layer[1]


def _norm(x: np.ndarray, layer: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    x = x - x.mean(1, keepdims=True)
    return x / np.sqrt((x * x).mean(1, keepdims=True) + 1e-5) * layer[0] + layer[1]
