"""Makes models/voice/*.npz: synthetic voices through radios and noises, and networks that learn their words.

    python -m valve_drake.voice.training FOLDER --count 8000               # examples into FOLDER, some 20 each second
    python -m valve_drake.voice.training FOLDER --fit words.npz            # 15 minutes
    python -m valve_drake.voice.training FOLDER --count 8000 --second      # the same for the second ear
    python -m valve_drake.voice.training FOLDER --fit second.npz --second

Needs Debian's espeak-ng, flite and fortunes, and pyopen-wakeword. The voices are those of espeak-ng and flite only, so
that every other voice is a new one to the network. The loss is that of connectionist temporal classification (Graves
et al. 2006): of the sequence of words only, since nobody says when in the sound each of them ends.
"""

import argparse
import dataclasses as dc
import math
import re
import subprocess
from pathlib import Path

import numpy as np
from scipy import signal

from valve_drake.checks import OperationFailed
from valve_drake.voice import judge, radio, words
from valve_drake.voice.embedding import Batch, pcm
from valve_drake.voice.radio import RATE, Radio
from valve_drake.voice.recogniser import FILLED, STOP_FILLED
from valve_drake.voice.synthesis import Speaker, say
from valve_drake.voice.word_net import WordNet
from valve_drake.voice.words import BLANK, CLASSES, INDEX, OTHER, WEAK

Example = tuple[np.ndarray, list[int]]  # rows (n, ROW), and the classes of the words that are said in them

FORTUNES = Path("/usr/share/games/fortunes")
TAUGHT = ("art", "computers", "literature", "men-women", "definitions", "law", "kids", "miscellaneous", "food")
SHORT = (
    *("stop", "stop", "stop", "robot, stop", "confirm", "confirm", "robot, confirm", "half", "cancel"),
    *("robot, status", "robot, reset", "robot"),
)
STOPS = ("stop", "robot, stop", "stop", "please stop", "stop now")
_NAMES = {False: "examples", True: "second"}  # of files, by whether they are the second ear's
_ACCENTS = ["en-us"] * 4 + ["en-gb"] * 2 + ["en-gb-scotland", "en-gb-x-rp", "en-gb-x-gbclan", "en-gb-x-gbcwmd"]
_ACCENTS += ["en-029", "en-us-nyc"]
_FLITE = {"kal": 105, "kal16": 105, "awb": 120, "rms": 95, "slt": 170}  # voices and their pitch [Hz]


def sentences(files: tuple[str, ...], most: int) -> list[str]:
    """Sentences of fortunes, of 10 to `most` characters."""
    out = []
    for name in files:
        text = (FORTUNES / name).read_text(encoding="utf-8", errors="ignore")
        for piece in re.split(r"\n%\n|(?<=[.!?;:])\s+", text):
            piece = " ".join(piece.split())
            if 10 <= len(piece) <= most and re.fullmatch(r"[A-Za-z0-9,.'!?;: -]+", piece):
                out.append(piece)
    return out


# ---------------------------------------------------------------- examples


class Examples:
    """Makes examples; each draws its sentence, voice, room, noise and radio.

    encoder: whose rows they are; None: the speech embedding's.
    """

    def __init__(self, seed: int, encoder: judge.Encoder | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        self.prose = sentences(TAUGHT, 55)
        listed = subprocess.run(["espeak-ng", "--voices=variant"], capture_output=True, text=True, check=True).stdout
        no_voice = ("whisper", "croak", "Demonic", "Tweaky")
        self.variants = [v for v in re.findall(r"!v/(\S+)", listed) if not v.startswith(no_voice)]
        self.batch, self.encoder = Batch(), encoder

    def text(self) -> str:
        rng = self.rng
        if self.encoder is not None and rng.random() < 0.15:
            return str(rng.choice(STOPS))
        kinds = (words.command, words.jumble, words.near_miss, words.chatter)
        which = int(rng.choice(6, p=(0.56, 0.14, 0.04, 0.04, 0.16, 0.06)))
        if which < 4:
            return kinds[which](rng)
        return str(rng.choice(SHORT if which == 4 else self.prose))

    def speaker(self) -> Speaker:
        rng = self.rng
        if rng.random() < 0.55:
            voice = str(rng.choice(_ACCENTS)) + (f"+{rng.choice(self.variants)}" if rng.random() < 0.9 else "")
            speed, size = rng.uniform(0.75, 1.35), rng.uniform(0.85, 1.15)
            return Speaker("espeak", voice, float(speed), int(rng.integers(20, 80)), float(size))
        voice = str(rng.choice(list(_FLITE), p=(0.125, 0.125, 0.25, 0.25, 0.25)))
        speed, pitch, size = rng.uniform(0.8, 1.3), _FLITE[voice] * rng.uniform(0.8, 1.3), rng.uniform(0.82, 1.18)
        return Speaker("flite", voice, float(speed), int(pitch), float(size))

    def noise(self, n: int) -> np.ndarray:
        """(n,) of root mean square 1: white, coloured, a machine's hum, or knocks."""
        rng = self.rng
        x = rng.normal(size=n)
        match int(rng.integers(4)):
            case 1:
                x = np.fft.irfft(
                    np.fft.rfft(x) / np.maximum(np.fft.rfftfreq(n, 1 / RATE), 30) ** rng.uniform(0.4, 1.2), n
                )
            case 2:
                t, pitch = np.arange(n) / RATE, rng.uniform(40, 400)
                x = 0.1 * x
                for k in range(1, 15):
                    x = x + rng.uniform(0, 1) / k * np.sin(2 * np.pi * k * pitch * t + rng.uniform(0, 6))
            case 3:
                x = 0.1 * x
                for _ in range(rng.integers(1, 8)):
                    begin = int(rng.integers(n))
                    length = min(n - begin, int(rng.uniform(0.01, 0.15) * RATE))
                    knock = rng.normal(size=length) * np.exp(-np.linspace(0, 5, length))
                    x[begin : begin + length] += knock * rng.uniform(0.5, 3)
        return x / (math.sqrt(np.mean(x * x)) + 1e-9)

    def received(self, x: np.ndarray) -> np.ndarray:
        """A sound as it arrives: in a room, beside a noise, through a radio (88 %) or a microphone; int16."""
        rng, n = self.rng, len(x)
        if rng.random() < 0.25:
            fade = rng.uniform(0.08, 0.4)  # of the room, to 60 dB [s]
            echo = rng.normal(size=int(fade * RATE)) * np.exp(-6.9 * np.arange(int(fade * RATE)) / RATE / fade)
            echo *= rng.uniform(0.1, 0.6) / math.sqrt((echo * echo).sum())
            echo[0] = 1.0
            x = signal.fftconvolve(x, echo)[:n]
        if rng.random() < 0.4:
            x = signal.lfilter([1, rng.uniform(-0.7, 0.5)], [1], x)
        level = radio.loudness(x)
        if rng.random() < 0.35:
            x = x + self.noise(n) * level * 10 ** (-rng.uniform(5, 30) / 20)
        if rng.random() < 0.12:
            out = x * (radio.LEVEL / level)
            if rng.random() < 0.5:
                out = out + rng.normal(size=n) * radio.LEVEL * 10 ** (-rng.uniform(15, 45) / 20)
        else:
            snr = math.inf if rng.random() < 0.12 else rng.uniform(3, 24)
            clipping = math.inf if rng.random() < 0.3 else rng.uniform(1.2, 4)
            dropouts = 0.0 if rng.random() < 0.4 else rng.uniform(0, 1)
            made = Radio(rng.uniform(200, 400), rng.uniform(2900, 3600), snr, clipping, dropouts)
            out = radio.transmit(x, made, int(rng.integers(1 << 30)), level)
        return pcm(out * 10 ** (rng.uniform(-12, 9) / 20))

    def rows(self, sound: np.ndarray) -> np.ndarray:
        if self.encoder is None:
            return self.batch.rows(sound)
        alone = len(sound) < 1.6 * RATE and self.rng.random() < 0.6  # as a burst that may be `stop` is looked at
        return judge.rows(self.encoder.frames(sound, STOP_FILLED if alone else FILLED), len(sound))

    def next(self, receptions: int = 1) -> list[Example]:
        """One sentence of one voice, received so often."""
        rng, text = self.rng, self.text()
        while True:
            try:
                said = say(text, self.speaker())
                break
            except OperationFailed:  # some variants of espeak-ng cannot say every word
                continue
        labels, out = words.labels(text), []
        if rng.random() < 0.04:  # nobody speaks
            said, labels = 0.02 * self.noise(int(rng.uniform(1, 4) * RATE)), []
        edges = ((0.05, 0.6), (0.3, 0.6)) if self.encoder is None else ((0.05, 0.9), (0.08, 0.9))  # of silence [s]
        for _ in range(receptions):
            before, after = (np.zeros(int(rng.uniform(*part) * RATE), np.float32) for part in edges)
            out.append((self.rows(self.received(np.concatenate([before, said, after]))), labels))
        return out


def collect(folder: Path, count: int, seed: int, second: bool) -> None:
    """Writes `count` examples into files of 500."""
    examples = Examples(seed, judge.Encoder() if second else None)
    for part in range(math.ceil(count / 500)):
        made: list[Example] = []
        while len(made) < min(500, count - 500 * part):
            made += examples.next(2 if second else 1)
        rows = np.concatenate([row for row, _ in made]).astype(np.float16)
        labels = np.array([word for _, row in made for word in row], np.int16)
        lengths = np.array([(len(row), len(said)) for row, said in made])
        np.savez(folder / f"{_NAMES[second]}_{seed}_{part:03d}.npz", rows=rows, labels=labels, lengths=lengths)
        print(f"{500 * part + len(made)} examples", flush=True)


def load(folder: Path, second: bool) -> list[Example]:
    out: list[Example] = []
    for path in sorted(folder.glob(f"{_NAMES[second]}_*.npz")):
        with np.load(path) as file:
            ends = file["lengths"].cumsum(0)
            rows = np.split(file["rows"], ends[:-1, 0])
            labels = np.split(file["labels"], ends[:-1, 1])
        out += [(row, said.tolist()) for row, said in zip(rows, labels)]
    return out


# ---------------------------------------------------------------- loss

# What counts as an OTHER word while one is said: also a pause, and our short words, of which other sentences are full.
_OTHER = np.zeros(CLASSES, np.float32)
_OTHER[[BLANK, *(INDEX[word] for word in WEAK)]] = 0.1
_OTHER[OTHER] = 1.0
# How much more often than in training the words are ours, and `stop`, at a radio that commands a robot. A word that is
# missed costs a repetition, and one that is heard wrongly a read-back.
PRIOR, PRIOR_STOP = 6.0, 2.0
_NEVER = -1e30


def _log_sum(*terms: np.ndarray) -> np.ndarray:
    most = terms[0]
    for term in terms[1:]:
        most = np.maximum(most, term)
    return most + np.log(sum(np.exp(term - most) for term in terms))


def loss(p: np.ndarray, said: list[list[int]], lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-log of the probability that exactly these words are said, for each of a batch, and its slope by the logits.

    p: probabilities of classes (batch, steps, CLASSES). said: the words' classes. lengths: of each example [steps].
    An example that is too short for its words has loss and slope 0. -> (batch,), (batch, steps, CLASSES)
    """
    many, steps, _ = p.shape
    states = 2 * max(map(len, said)) + 1
    classes, count = np.zeros((many, states), int), np.array([2 * len(row) + 1 for row in said])
    for k, row in enumerate(said):
        classes[k, 1 : 2 * len(row) : 2] = row
    emits = np.zeros((many, states, CLASSES), np.float32)
    emits[np.arange(many)[:, None], np.arange(states)[None], classes] = 1
    emits[classes == OTHER] = _OTHER
    emitted = np.matmul(p, emits.transpose(0, 2, 1))
    log_p = np.log(np.maximum(emitted, 1e-20))
    log_p = np.where((np.arange(states)[None] < count[:, None])[:, None], log_p, _NEVER)
    jump = np.zeros((many, states), bool)
    jump[:, 3::2] = classes[:, 3::2] != classes[:, 1:-2:2]

    def shifted(a: np.ndarray, by: int) -> np.ndarray:
        out = np.full_like(a, _NEVER)
        if by > 0:
            out[:, by:] = a[:, :-by]
        else:
            out[:, :by] = a[:, -by:]
        return out

    forth, back = (np.full((steps, many, states), _NEVER) for _ in range(2))
    forth[0, :, :2] = log_p[:, 0, :2]
    for t in range(1, steps):
        a = forth[t - 1]
        forth[t] = _log_sum(a, shifted(a, 1), np.where(jump, shifted(a, 2), _NEVER)) + log_p[:, t]
    rows, last = np.arange(many), lengths - 1
    final = np.full((many, states), _NEVER)
    final[rows, count - 1] = 0.0
    some = count > 1
    final[rows[some], count[some] - 2] = 0.0
    for t in range(steps - 1, -1, -1):
        if t < steps - 1:
            b = back[t + 1] + log_p[:, t + 1]
            back[t] = _log_sum(b, shifted(b, -1), shifted(np.where(jump, b, _NEVER), -2))
        back[t] = np.where((last == t)[:, None], final, back[t])
    both = forth + back
    ends = both[last, rows]
    most = ends.max(1)
    total = most + np.log(np.exp(ends - most[:, None]).sum(1))
    share = np.exp(np.minimum(both - total[None, :, None], 0)).transpose(1, 0, 2)
    share /= np.maximum(share.sum(2, keepdims=True), 1e-20)
    slope = p - p * np.matmul((share / np.maximum(emitted, 1e-20)).astype(np.float32), emits)
    slope *= (np.arange(steps)[None] < lengths[:, None])[:, :, None]
    impossible = total < -1e5
    slope[impossible] = 0
    return np.where(impossible, 0.0, -total), slope


# ---------------------------------------------------------------- fit


def fit(
    examples: list[Example],
    epochs: int,
    seed: int,
    start: WordNet | None = None,
    rate: float = 2e-3,
    span: int = 8,
    hidden: tuple[int, int] = (192, 96),
    many: int = 48,
    silent: np.ndarray | None = None,
) -> WordNet:
    """Adam with a rate that falls to 0, noise on the rows, and a part of all numbers left out in each example.

    start: a network that learns on; rate: of the first steps. silent: the row of digital silence; None: that of the
    speech embedding.
    """
    rng = np.random.default_rng(seed)
    seen = np.concatenate([row for row, _ in examples[::5]]).astype(np.float32)
    mean, scale = seen.mean(0), seen.std(0) + 1e-3
    if start is not None:
        mean, scale, span = start.mean, start.scale, start.span
        hidden = (start.weights[0].shape[1], start.weights[1].shape[1])
    if silent is None:
        silent = Batch().rows(np.zeros(4 * RATE, np.int16))[-1]
    silence = ((silent - mean) / scale).astype(np.float32)
    rows = [(row.astype(np.float32) - mean) / scale for row, said in examples if len(said) + 3 < len(row) < 150]
    said = [said for row, said in examples if len(said) + 3 < len(row) < 150]
    width = len(mean)
    sizes = (span * width, *hidden, CLASSES)
    weights = [(rng.normal(size=(a, b)) * math.sqrt(2 / a)).astype(np.float32) for a, b in zip(sizes, sizes[1:])]
    weights[2] *= 0.3
    biases = [np.zeros(b, np.float32) for b in sizes[1:]]
    biases[2][BLANK] = 2.0
    if start is not None:
        weights, biases = ([v.copy() for v in part] for part in (start.weights, start.biases))
    values = [*weights, *biases]
    first, second = ([np.zeros_like(v) for v in values] for _ in range(2))
    batches, now = len(rows) // many, 0
    for epoch in range(epochs):
        total = 0.0
        near = sorted(range(len(rows)), key=lambda k: len(rows[k]) + rng.uniform(0, 6))  # of like length together
        for batch in rng.permutation(batches):
            chosen = near[batch * many : (batch + 1) * many]
            lengths = np.array([len(rows[k]) for k in chosen])
            steps = int(lengths.max())
            x = np.zeros((many, steps, width), np.float32)
            for k, row in enumerate(chosen):
                x[k, : lengths[k]] = rows[row]
            x += 0.15 * rng.normal(size=x.shape).astype(np.float32)
            x = np.concatenate([np.broadcast_to(silence, (many, span - 1, width)), x], 1)
            x = np.concatenate([x[:, k : k + steps] for k in range(span)], 2)
            kept = [
                (rng.random((many, 1, size), dtype=np.float32) > out) / np.float32(1 - out)
                for size, out in zip(sizes[:3], (0.1, 0.15, 0.1))
            ]
            layers = [(x * kept[0]).reshape(many * steps, -1)]
            for k in (0, 1):
                h = np.maximum(layers[k] @ weights[k] + biases[k], 0).reshape(many, steps, -1)
                layers.append((h * kept[k + 1]).reshape(many * steps, -1))
            z = layers[2] @ weights[2] + biases[2]
            e = np.exp(z - z.max(1, keepdims=True))
            p = (e / e.sum(1, keepdims=True)).reshape(many, steps, CLASSES)
            each, slope = loss(p, [said[k] for k in chosen], lengths)
            total += float(each.sum())
            d = (slope * (30 / lengths.sum())).astype(np.float32).reshape(many * steps, -1)
            slopes: list[np.ndarray] = [None] * 6  # type: ignore[list-item]
            for k in (2, 1, 0):
                slopes[k], slopes[3 + k] = layers[k].T @ d, d.sum(0)
                if k:
                    d = (d @ weights[k].T).reshape(many, steps, -1) * kept[k]
                    d = d.reshape(many * steps, -1) * (layers[k] > 0)
            now += 1
            pace = rate * min(1, now / 200) * (0.5 * (1 + math.cos(math.pi * now / (epochs * batches))) + 0.01)
            cut = min(1.0, 5 / math.sqrt(sum(float((g * g).sum()) for g in slopes)))
            for v, g, m1, m2 in zip(values, slopes, first, second):
                m1 += 0.1 * (cut * g - m1)
                m2 += 0.001 * ((cut * g) ** 2 - m2)
                v -= pace * (m1 / (1 - 0.9**now) / (np.sqrt(m2 / (1 - 0.999**now)) + 1e-8) + 1e-4 * v)
        print(f"epoch {epoch + 1} of {epochs}: loss {total / (batches * many):.3f}", flush=True)
    return WordNet(span, mean, scale, silence, tuple(weights), tuple(biases))  # type: ignore[arg-type]


def weighted(net: WordNet) -> WordNet:
    """The network for people who command a robot, instead of training's mixture."""
    last = net.biases[2].copy()
    last[2:] += math.log(PRIOR)
    last[INDEX["stop"]] += math.log(PRIOR_STOP)
    return dc.replace(net, biases=(*net.biases[:2], last))


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", type=Path, help="of the examples")
    p.add_argument("--count", type=int, default=0, help="examples to make")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--fit", type=Path, metavar="FILE", help="where the network goes")
    p.add_argument("--epochs", type=int, default=14)
    p.add_argument("--second", action="store_true", help="examples and network are the second ear's")
    p.add_argument("--check", type=Path, metavar="FILE", help="a network to try, with voices for choosing thresholds")
    options = p.parse_args()
    if options.count:
        collect(options.folder, options.count, options.seed, options.second)
    if options.fit is not None:
        examples = load(options.folder, options.second)
        if options.second:
            silent = np.zeros(examples[0][0].shape[1])  # no row before the first one is looked at
            net = fit(examples, options.epochs, options.seed, None, 3e-3, 1, (128, 64), silent=silent)
        else:
            net = weighted(fit(examples, options.epochs, options.seed))
        net.save(options.fit)
    if options.check is not None:
        from valve_drake.voice import experiment

        experiment.choose(experiment.Ear(WordNet.load(options.check)), 20, print)


if __name__ == "__main__":
    main()
