"""Sound of a radio to the sentences of the operator's grammar, while it is spoken.

    80 ms of sound -> 96 numbers (embedding) -> which word has just been said, as probabilities (WordNet)
    -> sentences, or none of them (`step`) -> grammar.Heard

A word's probability is a short spike near its end; all other time is BLANK, and words that are not ours are OTHER. So
the probability that a stretch of sound is one sentence and nothing else is a sum over all places of its spikes (the
forward recursion of connectionist temporal classification). A sentence counts for what it is within all that could
have been said, not only for what it is beside the other sentences of the grammar: speech that was not meant for the
robot is refused by that. `stop` does not wait for the end of a sentence, nor for its beginning; `confirm` not for the
end.

Where the packages of judge.py are installed, a second ear is asked: at a sentence's end, which words it heard, and how
likely the likeliest sentences are in their sound; at a word that may be `stop`, and wherever a short burst of speech
grows quieter, whether it was `stop`: that counts if the burst ends then. Without them the network decides.
"""

import dataclasses as dc
import functools
import math
from typing import Protocol

import numpy as np

from valve_drake import console
from valve_drake.operator import grammar
from valve_drake.operator.grammar import SURE, Heard
from valve_drake.voice import judge as judges
from valve_drake.voice.embedding import BLOCK, ROW, STEP, Stream
from valve_drake.voice.hindsight import Hindsight
from valve_drake.voice.judge import Judge, Look
from valve_drake.voice.radio import RATE
from valve_drake.voice.word_net import WordNet
from valve_drake.voice.words import BLANK, CLASSES, INDEX, OTHER, WORDS, spelt

# Words without which a sentence means the same; they may stand anywhere, or be missed.
FILLERS = ("the", "by", "please", "now", "and", "way")
PAUSE = 10  # steps in which nobody speaks that end a sentence: 0.8 s; raise it for speakers who halt between words
WORDLESS = 20  # steps without a word that end it too, however loud they are: 1.6 s; raise it for slow speakers in noise
LONGEST = 100  # steps of a sentence: 8 s
STOP_SURE = 0.5  # probability from which `stop` is heard; lower: fewer are missed, more are heard in other words
CONFIRM_SURE = 0.2  # of `confirm`; lower: fewer are missed, more other words confirm a move that was read back
SENTENCE_SURE = 0.5  # of a meaning, within the grammar and FOREIGN; lower: fewer are refused, more are confused
WAKE_SURE = 0.95  # of the wake phrase alone, against all other speech; lower: other speech is listened to more often
FOREIGN = 0.07  # weight of all that is no sentence of the grammar; higher: less other speech is taken for one
DEAF = 6  # steps after a `stop` or `confirm` in which the same word is not heard again
ASKED = 12  # sentences that the second ear's decoder is asked about; more cost time (10 ms each)
# ln of a sentence's weight: shares of the logarithms of three probabilities: of the network, of the words that the
# second ear heard, and that it would write the sentence; and WORD for each word. All above 1 would count thrice what
# they have in common.
NETWORK, HEARD, SECOND = 0.1, 0.35, 0.55
WORD = 1.2  # for each spoken word, which makes a sentence less likely to both; lower: fewer long ones, more short
LOWEST = -20.0, -30.0  # ln of the first two counts as no less, or the others could not mend what one of them missed
ALONE = -2.0  # of the wake phrase alone, with which the others begin; lower: a longer sentence is likelier
LATE_STOP = -4.5  # instead of the network's part where `stop` was missed; lower: fewer are found, fewer false ones
ELSE = -5.0  # of all that is no sentence of the grammar; higher: less other speech is taken for one
LEAD = 0.8  # of sound before the first word that was noticed: a word is noticed at its end [s]
FILLED = 6.0  # to which silence fills a sentence up, what the second ear is used to; raise it for longer ones [s]
# `stop`: the network alone is believed from STOP_SURE; beside a second ear it is asked between these two.
STOP_MAYBE = 0.04  # lower: fewer are missed, the second ear is asked more often (30 ms each)
STOP_CERTAIN = 0.99  # lower: fewer are missed, more are heard in other words
STOP_HEARD = 0.5  # share of the ln of the odds that the second ear heard the word, beside that it would write it
STOP_LIKELY = -2.25  # their sum from which it is one; lower: fewer are missed, more are heard in other words
# It is asked too, whatever the network says, wherever a short burst of speech grows quieter: most words are loudest
# before their end, and what follows, a breath, an echo or noise, soon hides from the second ear what they were. The
# beginning of a longer sentence sounds like it as well ("ope..."), so the answer counts when the burst has ended.
BURST = 12  # steps of such a burst, at most; higher: fewer `stop` within longer speech are missed, more asking
FALLEN = 2.0  # below its loudest step [dB]; lower: asked more often, and in the middle of words
RECENT = 5  # steps whose answers count then; higher: words with a longer soft end are heard, and more is that is none
STOP_BACK, STOP_FILLED = 1.0, 3.0  # of sound that it is asked about, and to which silence fills it up [s]
_EARLY = 0.1  # probability of `confirm` from which it is asked whether the sentence is no more than that


# ---------------------------------------------------------------- words to sentences


def _spoken(text: str) -> list[str]:
    """Its words, numbers in words: "by 150 degrees" -> by, one, hundred, fifty, degrees."""
    return " ".join(spelt(int(word)) if word.isdigit() else word for word in text.split()).split()


@dc.dataclass(frozen=True)
class Sentences:
    """Sentences that are listened for. texts: as the grammar reads them. classes: of their words (n, most), 0 beyond
    the end. lengths: (n,). meanings: (n,) int, equal for those that mean the same."""

    texts: tuple[str, ...]
    classes: np.ndarray
    lengths: np.ndarray
    meanings: np.ndarray

    @staticmethod
    def of(texts: list[str]) -> "Sentences":
        """Words beside the vocabulary must not stand in them; numbers are in digits."""
        spoken = []
        for text in texts:
            spoken.append([INDEX[word] for word in _spoken(text) if word not in FILLERS])
        classes = np.zeros((len(texts), max(map(len, spoken))), int)
        for k, row in enumerate(spoken):
            classes[k, : len(row)] = row
        numbers: dict[tuple[object, ...], int] = {}
        meant = [grammar.parse(text) for text in texts]
        keys = [(i.kind, round(i.angle, 6), i.awake) for i in meant]
        meanings = np.array([numbers.setdefault(key, len(numbers)) for key in keys])
        return Sentences(tuple(texts), classes, np.array([len(row) for row in spoken]), meanings)


@functools.cache
def whole_grammar() -> Sentences:
    """Every sentence of grammar.PHRASES but those with `stop`, each with and without the wake phrase."""
    texts = []
    for phrase, kind in grammar.PHRASES.items():
        if kind == grammar.Kind.STOP:
            continue
        for n in grammar.NUMBERS if "<N>" in phrase else (0,):
            text = phrase.replace("<N>", str(n))
            texts += [text] if kind == grammar.Kind.WAKE else [text, f"{grammar.WAKE} {text}"]
            if kind in grammar.MOVES and phrase.count(" "):  # "open the valve half", "open the valve by 20 degrees"
                verb, rest = text.split(" ", 1)
                if not rest.startswith("the"):
                    texts += [f"{verb} the valve {rest}", f"{grammar.WAKE} {verb} the valve {rest}"]
    return Sentences.of(list(dict.fromkeys(texts)))


@functools.cache
def _confirms() -> Sentences:
    return Sentences.of(["confirm", f"{grammar.WAKE} confirm"])


def sentence_probabilities(p: np.ndarray, sentences: Sentences) -> np.ndarray:
    """Probabilities of classes (steps, CLASSES) -> that each sentence, and nothing else, was said (n,)."""
    p = np.asarray(p, float)
    blank = p[:, BLANK] + p[:, [INDEX[word] for word in FILLERS]].sum(1)
    n, most = sentences.classes.shape
    states = np.zeros((n, 2 * most + 1), int)
    states[:, 1::2] = sentences.classes
    real = states > 0
    emitted = np.where(real[None], p[:, states], blank[:, None, None])  # (steps, n, states)
    jumps = np.zeros((n, 2 * most + 1))  # a blank may be left out between two different words
    jumps[:, 3::2] = states[:, 3::2] != states[:, 1:-2:2]
    a = np.zeros((n, 2 * most + 1))
    a[:, :2] = 1.0
    a[:, :2] *= emitted[0, :, :2]
    for step in emitted[1:]:
        b = a.copy()
        b[:, 1:] += a[:, :-1]
        b[:, 2:] += jumps[:, 2:] * a[:, :-2]
        a = b * step
    last = 2 * sentences.lengths
    rows = np.arange(n)
    return a[rows, last] + a[rows, last - 1]


def best_sentence(p: np.ndarray, sentences: Sentences, foreign: float = 1.0) -> tuple[str, float]:
    """The likeliest meaning's likeliest sentence, and the meaning's probability.

    foreign: the weight of all that is none of these sentences. 1: as often as the network was taught.
    """
    each = sentence_probabilities(p, sentences)
    of_meaning = np.bincount(sentences.meanings, each)
    meaning = int(of_meaning.argmax())
    best = int(np.where(sentences.meanings == meaning, each, -1.0).argmax())
    all_of_them = min(float(each.sum()), 1.0)
    weight = all_of_them + foreign * (1.0 - all_of_them)
    return sentences.texts[best], min(float(of_meaning[meaning]) / weight, 1.0) if weight > 0 else 0.0


def transcript(p: np.ndarray) -> str:
    """The likeliest word of each step, words that are not ours as "..."."""
    out: list[str] = []
    before = BLANK
    for c in p.argmax(1).tolist():
        if c not in (before, BLANK) and not (c == OTHER and out[-1:] == ["..."]):
            out.append("..." if c == OTHER else WORDS[c - 2])
        before = c
    return " ".join(out)


def score(probability: float, sure: float) -> float:
    """A probability on the scale of grammar.Heard, where `sure` is SURE; 0 and 1 stay."""
    if probability <= 0.0:
        return 0.0
    return min(probability, 1.0) ** (math.log(SURE) / math.log(sure)) if sure != SURE else min(probability, 1.0)


class SecondEar(Protocol):
    """The sound up to now, and what a judge makes of it (hindsight.Hindsight)."""

    def look(self, back: float, seconds: float) -> Look:
        """At the last `back` seconds, filled up to `seconds`."""
        ...


@functools.cache
def _with_stop() -> Sentences:
    return Sentences.of([*whole_grammar().texts, "stop", f"{grammar.WAKE} stop"])


@functools.cache
def _lengths() -> np.ndarray:
    """Spoken words of the sentences of `_with_stop` (n,)."""
    return np.array([len(_spoken(text)) for text in _with_stop().texts])


def judged(p: np.ndarray, second: SecondEar, back: float) -> tuple[str, float]:
    """The likeliest meaning's likeliest sentence by both ears, and the meaning's probability.

    p: (steps, CLASSES) of the sentence. back: how long ago its sound begins [s].
    """
    known, look = _with_stop(), second.look(back, FILLED)
    network = NETWORK * _log(sentence_probabilities(p, whole_grammar()), LOWEST[0])
    each = np.append(network, [LATE_STOP] * (len(known.texts) - len(network)))
    each += HEARD * _log(sentence_probabilities(look.words, known), LOWEST[1])
    each[known.texts.index(grammar.WAKE)] += ALONE
    chosen = np.argsort(-each, kind="stable")[:ASKED]
    spellings = [judges.written(known.texts[k]) for k in chosen]
    found = iter(look.likelihoods([one for all_ in spellings for one in all_]))
    weights = each[chosen] + WORD * _lengths()[chosen]
    weights += SECOND * np.array([np.logaddexp.reduce([next(found) for _ in all_]) for all_ in spellings])
    meanings = known.meanings[chosen]
    total = {m: float(np.logaddexp.reduce(weights[meanings == m])) for m in meanings.tolist()}
    meaning = max(total, key=lambda m: total[m])
    best = int(chosen[np.where(meanings == meaning, weights, -np.inf).argmax()])
    return known.texts[best], math.exp(total[meaning] - float(np.logaddexp.reduce([*total.values(), ELSE])))


def _log(probabilities: np.ndarray, lowest: float) -> np.ndarray:
    return np.log(np.maximum(probabilities, math.exp(lowest)))


def _sentence(words: np.ndarray, heard: str, second: SecondEar | None, back: float) -> tuple[str, float]:
    """What a sentence that is complete comes to: its text, and its score. heard: its transcript."""
    if second is not None:
        text, probability = judged(words, second, back)
        return text if probability >= SURE else heard, probability
    text, probability = best_sentence(words, whole_grammar(), FOREIGN)
    needed = SENTENCE_SURE
    if text == grammar.WAKE:  # alone, it opens the ear to all that follows
        probability, needed = best_sentence(words, whole_grammar())[1], WAKE_SURE
    return text if probability >= needed else heard, score(probability, needed)


def _stop(second: SecondEar) -> float:
    """How sure the second ear is that `stop` has just been said, as a score."""
    look = second.look(STOP_BACK, STOP_FILLED)
    found = float(look.likelihoods([*judges.written("stop"), *judges.written(f"{grammar.WAKE} stop")]).max())
    heard = float(np.clip(look.words[:, INDEX["stop"]].max(), 0.5, 1 - 1e-6))  # it may speak for it, never against it
    return 1 / (1 + math.exp(STOP_LIKELY - found - STOP_HEARD * math.log(heard / (1 - heard))))


def _without(p: np.ndarray, words: list[str]) -> np.ndarray:
    """The probabilities (CLASSES,) with those of these words given to BLANK."""
    if not words:
        return p
    p = p.copy()
    for word in words:
        p[BLANK] += p[INDEX[word]]
        p[INDEX[word]] = 0.0
    return p


@dc.dataclass(frozen=True)
class Memory:
    """time: steps so far. said: the probabilities since the sentence began, oldest first; empty: nobody speaks.

    burst: levels of the steps in which somebody has spoken without a pause [dB]. ended: a burst of BURST steps at most
    has, one step ago. asked: how sure the second ear was of `stop` in its last RECENT steps. quiet: steps since
    somebody spoke. wordless: since the last word, within the sentence. since: the step before which all sound belongs
    to what was heard already. before: the probabilities of the last step. deaf: steps for which `stop` and `confirm`
    are not heard again.
    """

    time: int = 0
    said: tuple[np.ndarray, ...] = ()
    burst: tuple[float, ...] = ()
    ended: bool = False
    asked: tuple[float, ...] = ()
    quiet: int = 0
    wordless: int = 0
    since: int = 0
    before: np.ndarray | None = None
    deaf: tuple[int, int] = (0, 0)


def step(
    m: Memory, p: np.ndarray, level: float | None = None, second: SecondEar | None = None
) -> tuple[Memory, tuple[Heard, ...]]:
    """The probabilities of the next 80 ms (CLASSES,) -> what was heard in them. begin and end: [s] of the stream.

    level: of the speech in them, ours or not [dB]; None: nobody speaks. second: the second ear, if there is one.
    """
    deaf_stop, deaf_confirm = (max(d - 1, 0) for d in m.deaf)
    p = _without(p, [word for word, deaf in (("stop", deaf_stop), ("confirm", deaf_confirm)) if deaf])
    before = p if m.before is None else m.before
    idle = p[BLANK] + sum(p[INDEX[word]] for word in FILLERS) > 0.5
    active = level is not None or not idle
    said = (*m.said, p) if m.said or active else ()
    quiet = 0 if active else m.quiet + 1
    wordless = m.wordless + 1 if idle and m.said else 0
    time, since = m.time + 1, m.since
    burst = () if level is None else (*m.burst, level)[-BURST - 1 :]
    ended = level is None and 0 < len(m.burst) <= BURST
    falls = 0 < len(burst) <= BURST and burst[-1] <= max(burst) - FALLEN
    over = level is None and m.ended
    asked = m.asked if len(burst) != 1 else ()
    end = (time - quiet) * STEP
    begin = (time - max(len(said), 1)) * STEP

    def spike(word: str) -> float:  # said in this step or in the last one, once
        return float(1 - (1 - p[INDEX[word]]) * (1 - before[INDEX[word]]))

    out: list[Heard] = []
    sure, stop = spike("stop"), 0.0
    if second is None or sure >= STOP_CERTAIN:
        stop = score(sure, STOP_SURE)
    elif not deaf_stop:
        answer = _stop(second) if sure >= STOP_MAYBE or falls or ended or over else 0.0
        asked = (*asked, answer)[-RECENT:]
        stop = max(asked) if over else answer if sure >= STOP_MAYBE else 0.0
    if stop >= SURE:
        out.append(Heard("stop", stop, begin, time * STEP))
        said, quiet, since, deaf_stop, asked, p = (), 0, time, DEAF, (), _without(p, ["stop"])
    elif spike("confirm") > _EARLY and said:
        text, probability = best_sentence(np.stack(said), _confirms())
        if probability >= CONFIRM_SURE:
            out.append(Heard(text, score(probability, CONFIRM_SURE), begin, time * STEP))
            said, quiet, since, deaf_confirm, p = (), 0, time, DEAF, _without(p, ["confirm"])
    if said and (quiet >= PAUSE or wordless >= WORDLESS or len(said) >= LONGEST):
        words = np.stack(said)
        heard = transcript(words)
        if heard.strip(". "):
            back = min(len(said) * STEP + LEAD, (time - since) * STEP)
            out.append(Heard(*_sentence(words, heard, second, back), begin, end))
            since = time - PAUSE // 2
        said, quiet = (), 0
    deaf = deaf_stop, deaf_confirm
    return Memory(time, said, burst, ended, asked, quiet, wordless, since, p, deaf), tuple(out)


# ---------------------------------------------------------------- the whole, on a stream


class Recogniser:
    """Hears a stream of sound: pieces of any length, 16-bit samples at RATE. The same samples give the same words.

    Without the packages of the second ear it hears with the network alone, and says so.
    Raises ConfigError where pyopen-wakeword is not installed.
    """

    def __init__(self, net: WordNet | None = None) -> None:
        self._stream, self._net = Stream(), (net or WordNet.load()).start()
        if not judges.installed():
            _say_what_is_missing()
        self._sound = Hindsight(Judge() if judges.installed() else None)
        self._rest = np.zeros(0, np.int16)
        self._memory = Memory()
        self.probabilities = np.zeros(CLASSES, np.float32)  # of the newest step: scores for a log
        self.probabilities[BLANK] = 1.0

    @property
    def time(self) -> float:
        """How much sound was heard [s]."""
        return self._memory.time * STEP

    def push(self, samples: np.ndarray) -> list[Heard]:
        """(n,) int16 -> what was heard in them; begin and end in seconds since the first sample."""
        rest = np.concatenate([self._rest, np.asarray(samples, np.int16)])
        out: list[Heard] = []
        used = 0
        while len(rest) - used >= BLOCK:
            block = rest[used : used + BLOCK]
            self.probabilities = self._net(self._stream.push(block))
            self._memory, heard = step(self._memory, self.probabilities, self._sound.push(block), self._sound.second)
            out += heard
            used += BLOCK
        self._rest = rest[used:].copy()
        return out


@functools.cache
def _say_what_is_missing() -> None:
    console.complain(
        "the second ear is not installed, fewer commands will be understood: pip install 'valve-drake[voice]'"
    )


def hear(samples: np.ndarray, net: WordNet | None = None) -> list[Heard]:
    """What is heard in a whole sound (n,) int16, a second of silence after it."""
    return Recogniser(net).push(np.concatenate([samples, np.zeros(RATE + BLOCK, np.int16)]))


__all__ = ["ROW", "Heard", "Memory", "Recogniser", "Sentences", "WordNet", "hear", "step", "whole_grammar"]
