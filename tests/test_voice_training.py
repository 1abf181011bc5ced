"""The loss is the probability of the words in any place, its slope is its derivative, and the fit learns."""

import itertools

import numpy as np
import pytest

from valve_drake.operator.grammar import Kind, parse
from valve_drake.voice import embedding, words
from valve_drake.voice import training as mut
from valve_drake.voice.embedding import ROW
from valve_drake.voice.words import BLANK, CLASSES, INDEX, OTHER

OPEN, CLOSE = INDEX["open"], INDEX["close"]


def some(steps, seed=0, many=1):
    e = np.exp(np.random.default_rng(seed).normal(size=(many, steps, CLASSES)))
    return (e / e.sum(-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("said", [[], [OPEN], [OPEN, CLOSE], [OPEN, OPEN]])
def test_the_loss_is_of_all_places_where_the_words_may_be(said):
    p, total = some(5), 0.0
    for path in itertools.product((BLANK, OPEN, CLOSE), repeat=5):
        if said == [c for k, c in enumerate(path) if c != BLANK and (k == 0 or path[k - 1] != c)]:
            total += np.prod([p[0, k, c] for k, c in enumerate(path)])
    assert mut.loss(p, [said], np.array([5]))[0] == pytest.approx([-np.log(total)], rel=1e-4)


def test_the_slope_is_the_derivative_by_the_logits():
    said, lengths = [[OPEN, CLOSE, CLOSE], [], [CLOSE, OTHER]], np.array([9, 7, 8])
    z = np.random.default_rng(1).normal(size=(3, 9, CLASSES))

    def at(z):
        e = np.exp(z)
        return mut.loss(e / e.sum(-1, keepdims=True), said, lengths)

    slope = at(z)[1]
    for place in ((0, 3, OPEN), (2, 4, OTHER), (2, 1, BLANK), (1, 2, CLOSE)):
        step = np.zeros_like(z)
        step[place] = 1e-4
        by_hand = (at(z + step)[0].sum() - at(z - step)[0].sum()) / 2e-4
        assert slope[place] == pytest.approx(by_hand, rel=1e-3, abs=1e-7)
    assert not slope[1, 7:].any(), "beyond the end of an example"


def test_what_is_too_short_for_its_words_teaches_nothing():
    loss, slope = mut.loss(some(2), [[OPEN, CLOSE, OPEN]], np.array([2]))
    assert loss == [0.0] and not slope.any()


@pytest.mark.parametrize(
    "text, classes",
    [
        ("Robot, open the valve.", ["robot", "open", "the", "valve"]),
        ("robot open the window", ["robot", "open", None]),
        ("one by one they come to a stop", [None, "stop"]),
        ("mountains and rivers", [None]),
    ],
)
def test_other_words_are_one_and_take_the_short_words_beside_them(text, classes):
    assert words.labels(text) == [OTHER if word is None else INDEX[word] for word in classes]


def test_the_sentences_that_are_taught_as_commands_are_of_the_grammar():
    rng = np.random.default_rng(2)
    kinds = [parse(words.command(rng)).kind for _ in range(300)]
    assert Kind.UNKNOWN not in kinds and len(set(kinds)) >= 8


@pytest.mark.skipif(not embedding.installed(), reason="pip install .[voice]")
def test_a_fit_learns_two_words_and_goes_on_from_where_it_was(capsys):
    rng = np.random.default_rng(3)
    sounds = rng.normal(size=(2, ROW)) * 3
    examples = []
    for k in range(32):
        rows = rng.normal(size=(12, ROW)) * 0.3
        rows[4:7] += sounds[k % 2]
        examples.append((rows.astype(np.float32), [(OPEN, CLOSE)[k % 2]]))
    net = mut.fit(examples, 60, 0, span=2, hidden=(16, 12), many=16, rate=0.02)
    more = mut.fit(examples, 2, 0, start=net, rate=1e-4, many=16)
    for each in (net, more, mut.weighted(net)):
        p = each.probabilities(examples[0][0]), each.probabilities(examples[1][0])
        assert p[0][:, OPEN].max() > 0.8 > 0.2 > p[0][:, CLOSE].max()
        assert p[1][:, CLOSE].max() > 0.8 > 0.2 > p[1][:, OPEN].max()
