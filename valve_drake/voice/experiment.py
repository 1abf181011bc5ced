"""How well the recogniser hears, through the radio: voices that training has not heard, and other people's speech.

All voices are synthetic; none of them, and no synthesiser of theirs, was heard in training. The operator of a dialogue
does what the desk asks of people: the wrong move read back, `cancel`; nothing read back, once more; what was meant,
`confirm`.
"""

import dataclasses as dc
import functools
import itertools
import math
import re
import time as clocks
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake.checks import ConfigError
from valve_drake.operator.grammar import MOVES, NUMBERS, SURE, Heard, Intent, Kind, Talk, converse, parse
from valve_drake.voice import radio, words
from valve_drake.voice.embedding import BLOCK, STEP, Batch, pcm
from valve_drake.voice.hindsight import Hindsight
from valve_drake.voice.judge import Judge
from valve_drake.voice.radio import RATE, Radio
from valve_drake.voice.recogniser import Memory, Recogniser, WordNet, step
from valve_drake.voice.synthesis import Speaker, installed, say

RADIOS = {"clean": radio.CLEAN, "20 dB": radio.AT_20_DB, "10 dB": radio.AT_10_DB}
SPEAKERS = (
    Speaker("kokoro", "jf_alpha"),
    Speaker("kokoro", "jf_gongitsune", speed=0.95),
    Speaker("kokoro", "jf_nezumi"),
    Speaker("kokoro", "jf_tebukuro", speed=1.05),
    Speaker("kokoro", "jm_kumo"),
    Speaker("joe", "joe"),
    Speaker("festival", "ked_diphone"),
    Speaker("pico", "en-GB"),
)
_MORE = (  # hibari's voice, and voices that training has heard, other sentences of them
    *(Speaker("hibari", "heart", speed) for speed in (0.9, 1.15)),
    *(Speaker("flite", voice) for voice in ("slt", "rms", "awb")),
    *(Speaker("espeak", voice) for voice in ("en-us+m3", "en-gb+f2", "en-gb-scotland+m7", "en-us+f4")),
)
OTHERS = (  # who speaks in the hour of other speech
    *(Speaker("joe", "joe", speed) for speed in (0.9, 1.1)),
    *(Speaker("pico", "en-GB", speed) for speed in (0.9, 1.1)),
    *_MORE,
)
UNTAUGHT = ("cookie", "fortunes", "people", "politics", "science")
# What thresholds are chosen with: neither in training nor in the test.
CHOOSING = (
    Speaker("pico", "en-US"),
    Speaker("pico", "en-US", 1.1, size=1.2),
    Speaker("pico", "en-US", 0.9, 80, size=1.1),
    Speaker("pico", "en-US", 1.15, 115, size=0.95),
    Speaker("hibari", "heart"),
    Speaker("hibari", "heart", 1.15, size=1.15),
)
CHOOSING_PROSE = ("wisdom", "work", "platitudes", "songs-poems")
FORTUNES = Path("/usr/share/games/fortunes")
_BEFORE, _AFTER = 0.6, 1.4  # silence of the speaker around a sentence [s]


def needed() -> None:
    """Raises ConfigError where a voice of the test is missing."""
    missing = sorted({speaker.engine for speaker in (*SPEAKERS, *OTHERS) if not installed(speaker)})
    if missing or not FORTUNES.is_dir():
        raise ConfigError(
            f"experiment voice lacks {', '.join([*missing, *([] if FORTUNES.is_dir() else ['fortunes'])])}: pip install"
            " 'valve-drake[voices]'; apt-get install espeak-ng flite festival festvox-kdlpc16k fortunes"
        )


def commands(rng: np.random.Generator) -> list[str]:
    """The sentences of one voice."""
    n = [words.spelt(int(number)) for number in rng.permutation(NUMBERS)]
    return [
        *("robot, open the valve", "robot, close the valve", "robot, open", "robot, close"),
        *("robot open half", "robot, close the valve half way"),
        *(f"robot, open by {number} degrees" for number in n[:4]),
        *(f"robot, close by {number} degrees" for number in n[4:8]),
        *(f"robot, open the valve by {n[8]} degrees", f"robot close the valve by {n[9]} degrees"),
        *("confirm", "confirm", "robot, confirm", "cancel", "robot, status", "robot, reset"),
        *("stop", "stop", "robot, stop", "robot", "half", f"by {n[10]} degrees"),
    ]


class Ear:
    """What the recogniser makes of whole sounds, faster than `Recogniser` and equal to it but for rounding.

    Raises ConfigError where the extra `voice` is not installed, the second ear included.
    """

    def __init__(self, net: WordNet | None = None) -> None:
        self.net, self.batch = net or WordNet.load(), Batch()
        self.judge = Judge()

    def hear(self, samples: np.ndarray) -> list[tuple[float, Heard]]:
        """(n,) int16 -> when it was decided [s], and what was heard."""
        memory, sound, out = Memory(), Hindsight(self.judge), []
        for k, p in enumerate(self.net.probabilities(self.batch.rows(samples))):
            level = sound.push(samples[k * BLOCK : (k + 1) * BLOCK])
            memory, heard = step(memory, p, level, sound.second)
            out += [((k + 1) * STEP, each) for each in heard]
        return out


@functools.cache
def _said(text: str, speaker: Speaker) -> np.ndarray:
    return say(text, speaker)


def received(text: str, speaker: Speaker, by: Radio, seed: int) -> tuple[np.ndarray, float]:
    """A sentence over the radio: samples int16, and when its last word ends [s]."""
    said = _said(text, speaker)
    before, after = (np.zeros(int(part * RATE), np.float32) for part in (_BEFORE, _AFTER))
    return pcm(radio.transmit(np.concatenate([before, said, after]), by, seed)), _BEFORE + len(said) / RATE


def _answers(heard: list[tuple[float, Heard]]) -> list[tuple[str, Kind, float]]:
    """What the robot makes of one speaker's words while a move waits for `confirm`: outcome, kind and angle of each."""
    talk = Talk(waiting=Intent(Kind.CLOSE, 0.3), since=0.0)
    out: list[tuple[str, Kind, float]] = []
    for when, each in heard:
        talk, decision = converse(talk, each, when)
        if decision.outcome != "ignored":
            out.append((decision.outcome, decision.intent.kind, round(decision.intent.angle, 4)))
    return [each for each in out if each[0] != "listening"] if len(out) > 1 else out  # "robot", a breath, the rest


def _is(heard: Heard, kind: Kind) -> bool:
    return heard.score >= SURE and parse(heard.text).kind == kind


# ---------------------------------------------------------------- the three measurements


def _heard_right(ear: Ear, name: str, seed: int, speakers: Sequence[Speaker]) -> dict[str, Any]:
    """Single sentences, and many a `stop`."""
    right, wrong, late = [], [], []
    for number, speaker in enumerate(speakers):
        for k, text in enumerate(commands(np.random.default_rng(100 * seed + number))):
            samples, end = received(text, speaker, RADIOS[name], 1000 * (100 * seed + number) + k)
            heard = ear.hear(samples)
            want, got = _answers([(0.0, Heard(text))]), _answers(heard)
            is_stop = want[0][1] == Kind.STOP
            good = want[0] in got if is_stop else got == want
            right.append(good)
            wrong.append(any(each not in want and each[0] in ("asked", "given") for each in got))
            if good and text.endswith("confirm"):
                late.append(next(when for when, h in heard if _is(h, Kind.CONFIRM)) - end)
    stops = []
    for number, speaker in enumerate(speakers):
        for k, (text, speed) in enumerate(itertools.product(("stop", "robot, stop"), (0.85, 1.0, 1.15))):
            who = dc.replace(speaker, speed=speed * speaker.speed)
            for again in range(2):
                samples, end = received(text, who, RADIOS[name], 1000 * (100 * seed + number) + 500 + 10 * k + again)
                when = [when for when, h in ear.hear(samples) if _is(h, Kind.STOP)]
                stops.append(bool(when))
                late += [each - end for each in when[:1]]
    return {
        "sentences": len(right),
        "right [%]": 100 * float(np.mean(right)),
        "something else done or asked [%]": 100 * float(np.mean(wrong)),
        "refused [%]": 100 * float(np.mean([not (good or bad) for good, bad in zip(right, wrong)])),
        "stops": len(stops),
        "stop heard [%]": 100 * float(np.mean(stops)),
        "word to decision: median [s]": float(np.median(late)),
        "95 % [s]": float(np.quantile(late, 0.95)),
        "longest [s]": float(np.max(late)),
    }


@dc.dataclass
class _Dialogue:
    """One operator at the radio."""

    ear: Ear
    speaker: Speaker
    by: Radio
    seeds: Iterator[int]
    time: float = 0.0
    talk: Talk = dc.field(default_factory=Talk)

    def say(self, text: str) -> list[tuple[Talk, Intent, str]]:
        """What the robot's answers to it were."""
        samples, _ = received(text, self.speaker, self.by, next(self.seeds))
        out: list[tuple[Talk, Intent, str]] = []
        for when, heard in self.ear.hear(samples):
            self.talk, decision = converse(self.talk, heard, self.time + when)
            out.append((self.talk, decision.intent, decision.outcome))
        self.time += len(samples) / RATE
        return out


def _dialogue(d: _Dialogue, text: str) -> tuple[bool, bool, int]:
    """A move asked for until it starts, or four times -> it started, another one started, sentences said."""
    want = parse(text)
    count = 0
    for _ in range(4):
        answers = d.say(text)
        count += 1
        if any(outcome == "given" and intent.kind in MOVES for _, intent, outcome in answers):
            return False, True, count
        while d.talk.waiting is not None:
            read = d.talk.waiting
            meant = read.kind == want.kind and abs(read.angle - want.angle) < 1e-6
            answers = d.say("confirm" if meant else "cancel")
            count += 1
            for _, intent, outcome in answers:
                if outcome == "given" and intent.kind in MOVES:
                    same = intent.kind == want.kind and abs(intent.angle - want.angle) < 1e-6
                    return same, not same, count
            if count > 12:
                return False, False, count
    return False, False, count


def _dialogues(ear: Ear, name: str, seed: int, many: int, speakers: Sequence[Speaker]) -> dict[str, Any]:
    started, wrong, said = [], [], []
    for number, speaker in enumerate(speakers):
        moves = [text for text in commands(np.random.default_rng(100 * seed + number)) if parse(text).kind in MOVES]
        seeds = iter(range(10_000_000 + 10_000 * (100 * seed + number), 1 << 40))
        for k in range(many):
            d = _Dialogue(ear, speaker, RADIOS[name], seeds)
            good, bad, count = _dialogue(d, moves[k % len(moves)])
            started.append(good)
            wrong.append(bad)
            said.append(count)
    return {
        "dialogues": len(started),
        "started [%]": 100 * float(np.mean(started)),
        "wrong move started": int(np.sum(wrong)),
        "sentences each": float(np.mean(said)),
    }


def _other_speech(
    ear: Ear, minutes: int, seed: int, tell: Callable[[str], None], others: Sequence[Speaker], files: tuple[str, ...]
) -> dict[str, Any]:
    """What is made of speech that is not meant for the robot, and of noises, one after the other."""
    rng = np.random.default_rng(seed + 7)
    prose = untaught(files)
    names = list(RADIOS)
    talk, time, noise = Talk(), 0.0, 0.0
    found = {"asked": 0, "starts": 0, "stops": 0, "stops that were said": 0, "called": 0}
    while time < 60.0 * minutes:
        by = RADIOS[names[int(rng.integers(len(names)))]]
        if rng.random() < 0.1:  # a minute of a tenth is noise: of the radio, a hum, knocks, a squelch
            sound = _noise(rng, 10 * RATE)
            noise += 10.0
            text = ""
        else:
            speaker = others[int(rng.integers(len(others)))]
            lines = [prose[int(rng.integers(len(prose)))] for _ in range(4)]
            gap = np.zeros(int(rng.uniform(0.1, 1.5) * RATE), np.float32)
            sound = np.concatenate([part for line in lines for part in (say(line, speaker), gap)])
            text = " ".join(lines)
        samples = pcm(radio.transmit(sound, by, int(rng.integers(1 << 40))))
        stops = 0
        for when, heard in ear.hear(samples):
            talk, decision = converse(talk, heard, time + when)
            sure = heard.score >= SURE
            found["asked"] += decision.outcome == "asked"
            found["starts"] += decision.outcome == "given" and decision.intent.kind in MOVES
            found["called"] += sure and decision.intent.awake and decision.intent.kind != Kind.STOP
            stops += sure and decision.intent.kind == Kind.STOP
        said = len(re.findall(r"\bstop\b", text.lower()))
        found["stops"] += max(stops - said, 0)
        found["stops that were said"] += min(stops, said)
        time += len(samples) / RATE
        if int(time / 300) != int((time - len(samples) / RATE) / 300):
            tell(f"{time / 60:.0f} min: {found}")
    return {"minutes": time / 60, "of them noise": noise / 60, **found}


def _noise(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n,): hiss, a hum, knocks, or a tone that comes and goes."""
    t = np.arange(n) / RATE
    x = 0.05 * rng.normal(size=n)
    match int(rng.integers(4)):
        case 1:
            x = x + sum(np.sin(2 * np.pi * k * rng.uniform(40, 200) * t) / k for k in range(1, 12))
        case 2:
            for begin in rng.integers(0, n - RATE, 20):
                x[begin : begin + RATE // 5] += rng.normal(size=RATE // 5) * np.exp(-np.linspace(0, 6, RATE // 5))
        case 3:
            x = x + np.sin(2 * np.pi * rng.uniform(400, 2500) * t) * (np.sin(2 * np.pi * rng.uniform(0.3, 4) * t) > 0)
    return x


def untaught(files: tuple[str, ...] = UNTAUGHT) -> list[str]:
    """Sentences that training has not seen."""
    from valve_drake.voice.training import sentences

    return sentences(tuple(name for name in files if (FORTUNES / name).is_file()), 200)


def _cost(seed: int) -> float:
    """Processor time of the recogniser for one second of sound, by itself, on speech [s]."""
    samples = np.concatenate([received(text, SPEAKERS[6], radio.AT_20_DB, seed)[0] for text in ("robot, open", "stop")])
    samples = np.tile(samples, math.ceil(20 * RATE / len(samples)))
    recogniser = Recogniser()
    before = clocks.process_time()
    for k in range(0, len(samples), BLOCK):
        recogniser.push(samples[k : k + BLOCK])
    return (clocks.process_time() - before) / (len(samples) / RATE)


def choose(ear: Ear, minutes: int, tell: Callable[[str], None]) -> None:
    """The same with the voices that thresholds are chosen with. Nothing of the test is read."""
    for name in RADIOS:
        tell(f"{name}: {_heard_right(ear, name, 1, CHOOSING)}")
    tell(str(_other_speech(ear, minutes, 1, lambda line: None, (*CHOOSING, *_MORE), CHOOSING_PROSE)))


def run(seed: int = 0, minutes: int = 60, tell: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """The tables. Raises ConfigError where a voice is missing."""
    needed()
    ear = Ear()
    rows = []
    for name in RADIOS:
        heard = _heard_right(ear, name, seed, SPEAKERS)
        rows.append({"radio": name, **heard, **_dialogues(ear, name, seed, 4, SPEAKERS)})
        tell(str(rows[-1]))
    other = _other_speech(ear, minutes, seed, tell, OTHERS, UNTAUGHT)
    return {
        "experiment": "voice",
        "settings": {"seed": seed, "voices (all synthetic)": [str(speaker) for speaker in SPEAKERS]},
        "rows": rows,
        "totals": {
            "other speech": other,
            "processor time for a second of sound [s]": _cost(seed),
        },
    }
