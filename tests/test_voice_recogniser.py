"""Words' probabilities become sentences of the grammar, other speech does not, `stop` waits for nothing."""

import itertools
import shutil

import numpy as np
import pytest

from valve_drake.checks import ConfigError
from valve_drake.operator import grammar
from valve_drake.operator.grammar import SURE, Kind, Talk, converse, parse
from valve_drake.voice import embedding, radio, words
from valve_drake.voice import recogniser as mut
from valve_drake.voice.embedding import BLOCK, ROW, STEP
from valve_drake.voice.words import BLANK, CLASSES, INDEX, OTHER

with_embedding = pytest.mark.skipif(not embedding.installed(), reason="pip install .[voice]")
with_espeak = pytest.mark.skipif(shutil.which("espeak-ng") is None, reason="apt-get install espeak-ng")


def silence(steps=1):
    p = np.zeros((steps, CLASSES), np.float32)
    p[:, BLANK] = 1.0
    return p


def spikes(text, sure=0.97, gap=3):
    """The probabilities while these words are said: one step for each, `gap` steps between; "..." is another word."""
    rows = [silence(2)]
    for word in text.split():
        p = silence()
        p[0, OTHER if word == "..." else INDEX[word]] = sure
        p[0, BLANK] = 1 - sure
        rows += [p, silence(gap)]
    return np.concatenate(rows)


def heard(p, memory=None):
    memory, out = memory or mut.Memory(), []
    for k, row in enumerate(p):
        memory, found = mut.step(memory, row)
        out += [(k, each) for each in found]
    return out, memory


def sentences(text, **kind):
    return [each for _, each in heard(np.concatenate([spikes(text, **kind), silence(mut.PAUSE + 1)]))[0]]


# ---------------------------------------------------------------- probabilities of sentences


def test_a_sentences_probability_is_the_sum_over_all_places_of_its_words():
    rng = np.random.default_rng(1)
    used = [BLANK, INDEX["robot"], INDEX["open"], INDEX["valve"]]
    p = np.zeros((5, CLASSES))
    p[:, used] = rng.dirichlet(np.ones(4), 5)
    asked = mut.Sentences.of(["robot", "open valve", "robot open valve", "open"])
    by_hand = dict.fromkeys([(used[1],), (used[2], used[3]), (used[1], used[2], used[3]), (used[2],)], 0.0)
    for path in itertools.product(used, repeat=5):
        said = tuple(c for k, c in enumerate(path) if c != BLANK and (k == 0 or path[k - 1] != c))
        if said in by_hand:
            by_hand[said] += np.prod([p[k, c] for k, c in enumerate(path)])
    assert mut.sentence_probabilities(p, asked) == pytest.approx(list(by_hand.values()), rel=1e-12)


def test_every_sentence_listened_for_is_one_of_the_grammar_and_all_its_phrases_are():
    found = mut.whole_grammar()
    assert all(parse(text).kind != Kind.UNKNOWN for text in found.texts)
    kinds = {parse(text).kind for text in found.texts}
    assert kinds == set(grammar.PHRASES.values()) - {Kind.STOP}
    for number in grammar.NUMBERS:
        assert f"robot close by {number} degrees" in found.texts
    same = [text for text, m in zip(found.texts, found.meanings) if m == found.meanings[found.texts.index("open half")]]
    assert set(same) == {"open half", "open the valve half", "open by 45 degrees", "open the valve by 45 degrees"}


@pytest.mark.parametrize("number", grammar.NUMBERS)
def test_numbers_are_listened_for_as_the_grammar_says_them(number):
    assert words.spelt(number) == grammar.spoken(number)
    assert set(words.spelt(number).split()) <= set(words.WORDS)


# ---------------------------------------------------------------- streaming


@pytest.mark.parametrize(
    "said, kind, degrees",
    [
        ("robot open the valve", Kind.OPEN, 90),
        ("robot please close the valve half way", Kind.CLOSE, 45),
        ("robot open by one hundred and thirty five degrees", Kind.OPEN, 135),
        ("robot close the valve by fifteen degrees now", Kind.CLOSE, 15),
        ("by two hundred seventy degrees", Kind.AMOUNT, 270),
        ("robot status", Kind.STATUS, 0),
        ("cancel", Kind.CANCEL, 0),
        ("robot", Kind.WAKE, 0),
    ],
)
def test_a_sentence_is_heard_when_a_pause_follows(said, kind, degrees):
    p = np.concatenate([silence(7), spikes(said), silence(mut.PAUSE)])
    ((k, found),), memory = heard(p)
    intent = parse(found.text)
    assert (intent.kind, round(np.degrees(intent.angle))) == (kind, degrees)
    assert intent.awake == said.startswith("robot")
    spoken = [i for i, row in enumerate(p) if row[BLANK] + sum(row[INDEX[word]] for word in mut.FILLERS) < 0.5]
    last = spoken[-1] + 1
    assert k + 1 == last + mut.PAUSE and found.end == pytest.approx(last * STEP)
    assert found.score > SURE and found.begin == pytest.approx(spoken[0] * STEP)
    assert not memory.said


@pytest.mark.parametrize("said", ["stop", "robot stop", "... ... stop ...", "robot open the stop"])
def test_stop_is_heard_at_once_wherever_it_stands(said):
    p = spikes(said)
    at = int(p[:, INDEX["stop"]].argmax())
    (k, found), *_ = heard(p)[0]
    assert k == at and parse(found.text).kind == Kind.STOP and found.score > SURE


def test_a_stop_whose_spike_falls_between_two_steps_is_heard_once():
    p = silence(20)
    p[4:6, INDEX["stop"]], p[4:6, BLANK] = 0.4, 0.6
    found = heard(p)[0]
    assert [k for k, _ in found] == [5]
    p[5, INDEX["stop"]], p[5, BLANK] = 0.1, 0.9
    assert heard(p)[0] == [] or all(each.score < SURE for _, each in heard(p)[0])


def test_stop_twice_is_heard_twice():
    found = heard(spikes("stop stop", gap=mut.DEAF + 1))[0]
    assert [each.text for _, each in found] == ["stop", "stop"]


def test_confirm_is_heard_at_once_and_not_within_other_words():
    p = spikes("confirm")
    (k, found), *_ = heard(p)[0]
    assert k == int(p[:, INDEX["confirm"]].argmax()) and parse(found.text).kind == Kind.CONFIRM
    for said in ("... confirm", "open confirm", "confirm ..."):
        kinds = [parse(each.text).kind for each in sentences(said) if each.score >= SURE]
        assert Kind.CONFIRM not in kinds[:1] or said.startswith("confirm")


@pytest.mark.parametrize(
    "said", ["robot open the ...", "... robot open", "robot ... the valve", "robot open close", "open open", "degrees"]
)
def test_other_words_in_a_sentence_refuse_it(said):
    assert all(each.score < SURE for each in sentences(said))


def test_a_sentence_is_weighed_against_the_others_of_the_grammar_and_less_against_other_speech():
    p = spikes("robot open the valve", sure=0.4)
    asked = mut.Sentences.of(["robot open", "robot close"])
    alone = mut.best_sentence(p, asked)[1]
    assert alone < mut.best_sentence(p, asked, foreign=0.1)[1] < 1.0
    either = silence(4)
    either[2, [INDEX["open"], INDEX["close"], BLANK]] = 0.5, 0.4, 0.1
    either[1, [INDEX["robot"], BLANK]] = 1.0, 0.0
    assert mut.best_sentence(either, asked, foreign=0.0)[1] == pytest.approx(0.5 / 0.9)
    assert mut.best_sentence(silence(3), asked, foreign=0.0) == ("robot open", 0.0)


def test_the_wake_phrase_alone_must_be_surer_than_a_whole_sentence():
    assert sentences("robot", sure=0.97)[0].score >= SURE > sentences("robot", sure=0.9)[0].score
    assert sentences("robot status", sure=0.9)[0].score >= SURE


def test_a_refused_sentence_says_what_was_heard():
    assert [each.text for each in sentences("robot open the ...")] == ["robot open the ..."]
    assert sentences("... ...") == [], "speech without a word of ours is nothing"


def test_unsure_words_make_an_unsure_sentence():
    scores = [sentences("robot open by one hundred thirty five degrees", sure=s)[0].score for s in (0.99, 0.9, 0.75)]
    assert scores[0] > 0.9 and scores == sorted(scores, reverse=True) and scores[2] < SURE


def test_silence_is_nothing_and_endless_speech_needs_no_memory():
    assert heard(silence(200))[0] == []
    _, memory = heard(spikes("... " * 200, gap=1))
    assert len(memory.said) <= mut.LONGEST


# ---------------------------------------------------------------- the network


def some_net(seed=0, span=3):
    rng = np.random.default_rng(seed)
    sizes = (span * ROW, 8, 6, CLASSES)
    weights = [rng.normal(size=(a, b)).astype(np.float16).astype(np.float32) for a, b in zip(sizes, sizes[1:])]
    biases = [rng.normal(size=b).astype(np.float32) for b in sizes[1:]]
    row = [rng.normal(size=ROW).astype(np.float32) for _ in range(2)]
    return mut.WordNet(span, row[0], np.ones(ROW, np.float32), row[1], tuple(weights), tuple(biases))


def test_a_stream_has_the_probabilities_of_the_whole():
    net = some_net()
    rows = np.random.default_rng(2).normal(size=(9, ROW)).astype(np.float32)
    whole, push = net.probabilities(rows), net.start()
    assert np.allclose([push(row) for row in rows], whole, atol=1e-6)
    assert np.allclose(whole.sum(1), 1.0, atol=1e-5)


def test_a_saved_network_is_the_same_and_what_is_none_is_refused(tmp_path):
    net, path = some_net(), tmp_path / "net.npz"
    net.save(path)
    rows = np.ones((4, ROW), np.float32)
    assert np.array_equal(mut.WordNet.load(path).probabilities(rows), net.probabilities(rows))
    np.savez(tmp_path / "other.npz", words=np.array(["yes"]))
    (tmp_path / "text.npz").write_text("no archive")
    for name in ("other.npz", "text.npz", "missing.npz"):
        with pytest.raises(ConfigError) as refused:
            mut.WordNet.load(tmp_path / name)
        assert "\n" not in str(refused.value) and name in str(refused.value)


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(embedding, "installed", lambda: False)
    with pytest.raises(ConfigError, match=r"pip install 'valve-drake\[voice\]'"):
        mut.Recogniser(some_net())


# ---------------------------------------------------------------- with the embedding


def some_sound(seconds=2.5):
    rng = np.random.default_rng(4)
    x = rng.normal(size=int(seconds * radio.RATE)) * np.repeat(rng.uniform(0, 0.3, 25), int(seconds * radio.RATE) // 25)
    return embedding.pcm(x)


@with_embedding
def test_a_whole_sound_has_the_rows_of_its_stream():
    sound = some_sound()
    stream = embedding.Stream()
    one_by_one = [stream.push(sound[k : k + BLOCK]) for k in range(0, len(sound) - BLOCK + 1, BLOCK)]
    rows = embedding.Batch().rows(sound)
    assert rows.shape == (len(sound) // BLOCK, ROW)
    assert np.abs(rows - one_by_one).max() < 1e-3 < np.abs(rows).mean()


@with_embedding
def test_the_pieces_that_sound_comes_in_change_nothing():
    sound = some_sound()
    seen = []
    for size in (BLOCK, 777, len(sound)):
        ear, rows = mut.Recogniser(some_net(span=8)), []
        for k in range(0, len(sound), size):
            ear.push(sound[k : k + size])
            rows.append(ear.probabilities)
        seen.append((rows[-1].tobytes(), ear.time))
    assert len(set(seen)) == 1 and seen[0][1] == pytest.approx(2.48)


@with_embedding
@with_espeak
def test_words_over_the_radio_move_the_robot_after_confirm_only_and_alike_in_a_thread():
    from valve_drake.operator.ear import Beside, pieces
    from valve_drake.voice.synthesis import Speaker, say

    speaker = Speaker("espeak", "en-us")
    gap = np.zeros(radio.RATE * 3 // 2, np.float32)
    said = ("robot, open the valve", "confirm", "stop", "the weather is fine in the mountains today")
    sound = np.concatenate([part for text in said for part in (gap, say(text, speaker))] + [gap])
    samples = embedding.pcm(radio.transmit(sound, radio.AT_20_DB, seed=1))
    found = mut.hear(samples)
    beside, again = Beside(mut.Recogniser()), []
    for piece in pieces(samples):
        again += beside.push(piece)
    while beside.busy:
        again += beside.push(samples[:0])
    assert again == found
    talk, outcomes = Talk(), []
    for each in found:
        talk, decision = converse(talk, each, each.end)
        if decision.outcome != "ignored":
            outcomes.append((decision.outcome, decision.intent.kind))
    assert outcomes == [("asked", Kind.OPEN), ("given", Kind.OPEN), ("given", Kind.STOP)]
