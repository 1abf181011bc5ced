"""The operator's desk: its keys, its page, what it hears; and the command around it."""

import io
import json
import os
import threading
import time
import types
import wave

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm

from valve_drake import cli
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.commands import operator
from valve_drake.console import console
from valve_drake.messages import ModeState, OperatorCommand, OperatorPackets, OperatorState, Status
from valve_drake.operator.desk import KEYS, Desk
from valve_drake.operator.desk_link import DeskLink
from valve_drake.operator.ear import PIECE, Beside, pieces, read_wav
from valve_drake.operator.grammar import Heard, Kind, parse
from valve_drake.operator.operator_channel import OperatorChannelConfig, State, step
from valve_drake.operator.operator_link import OperatorLink
from valve_drake.operator.wire import RATE
from valve_drake.stations.bus import Bus
from valve_drake.stations.lcm_channels import HardwareConfig


class Ear:
    """A recogniser that hears what it is told to, at the piece that it is told."""

    def __init__(self, *heard):
        self.heard, self.pieces = dict(heard), 0

    def push(self, samples):
        self.pieces += bool(len(samples))
        return [self.heard[self.pieces]] if len(samples) and self.pieces in self.heard else []


class Office:
    """A desk and a program that hears it and answers what it is told."""

    def __init__(self, ear=None):
        self.time = 50.0
        lcm, config = DrakeLcm("memq://"), HardwareConfig(lcm_url="memq://")
        buses = [Bus(config, lcm) for _ in range(2)]
        for bus in buses:
            bus.clock = lambda: self.time
        self.program = OperatorLink(buses[0])
        self.desk = Desk(DeskLink(buses[1], lambda: self.time), ear, clock=lambda: self.time)
        self.state, self.words, self.beats = {}, [], 0
        self.answer()

    def answer(self, **state):
        """The program answers; and hears what the desk says."""
        self.state |= state
        for _ in range(4):
            self.time += 1 / 16
            self.program.tell(OperatorState(speaker=self.desk.link.number, linked=True, **self.state))
            self.desk.poll()
            packets = self.program.take(self.time)
            self.beats += bool(packets)
            for packet in packets.packets if packets else ():
                if packet.words and packet.sequence > self.state.get("heard", 0):
                    self.words.append(packet.words)
                    self.state["heard"] = packet.sequence
        return self

    def press(self, keys):
        for key in keys:
            self.desk.press(key)
        return self.answer()

    def page(self, height=30, width=100):
        file = io.StringIO()
        out = console()
        out.file, out.width = file, width
        out.print(self.desk.shown(height))
        return file.getvalue()


def test_every_key_says_a_sentence_of_the_grammar():
    for key, words in KEYS.items():
        assert parse(words).kind not in (Kind.UNKNOWN, Kind.WAKE)
        assert Office().press(key).words == [words]
    assert Office().press("\r").words == ["confirm"]
    assert Office().press("zZ#\x1b").words == []


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("\x1b[A ", " "),  # an arrow, and the stop that a slow page has read with it
        (" \x1b[C", " "),  # no `close` of the C
        ("o\x1b[1;5C\x1bOPc", "oc"),
        ("\x1b", "\x1b"),
        ("\x1b ", "\x1b "),
        ("\x1b[200~stop\x1b[201~", "stop"),  # pasted
        ("°", "°"),
    ],
)
def test_keys_without_a_character_are_left_out_and_no_other(monkeypatch, text, keys):
    """However the terminal's bytes are cut into pieces; but for an escape, which alone is a key."""
    ours, terminal = os.openpty()
    monkeypatch.setattr("sys.stdin", types.SimpleNamespace(fileno=lambda: terminal))
    data = text.encode()
    for cut in (0, *range(2, len(data))):
        if data[:cut].endswith(b"\x1b"):
            continue
        with operator._keys() as pressed:
            found = ""
            for piece in (data[:cut], data[cut:]):
                os.write(ours, piece)
                found += pressed(0.1) if piece else ""
        assert found == keys, cut
    os.close(ours)
    os.close(terminal)


def test_a_sentence_is_typed_said_by_enter_and_forgotten_by_escape():
    assert Office().press("topen by 2\x7f30 degrees\r").words == ["open by 30 degrees"]
    office = Office().press("topen")
    assert office.words == [] and "say: open" in office.page()
    assert office.press("\x1b").press("o").words == ["open"]


def test_stop_needs_no_enter_while_typing():
    office = Office().press("topen by stop")
    assert office.words == ["stop"] and office.desk.typing is None


def test_leaving_while_the_robot_is_under_way_is_asked_twice():
    office = Office().answer(mode="turn", done=False)
    assert not office.press("q").desk.left and "q again leaves" in office.page()
    assert not office.press("sq").desk.left
    assert office.press("q").desk.left
    assert Office().answer(mode="idle").press("q").desk.left


def test_the_page_shows_who_commands_mode_answer_and_what_the_cameras_see():
    office = Office().answer(mode="turn", reason="openings 24 mm", turned=42.0, held=True, sees="marker at 0.79 m")
    office.press("s").answer(answers=3, says="turn, 42 degrees turned")
    page = office.page()
    for words in ("you command", "turn  ", "openings 24 mm", "42 deg", "HELD", "marker at 0.79 m", "SPACE stop"):
        assert words in page
    assert "robot turn, 42 degrees turned" in page and "you   status" in page
    office.time += 5.0
    office.desk.poll()
    assert "no program is heard" in office.page()


def test_the_page_fits_any_terminal_and_escapes_what_the_wire_brings():
    office = Office().answer(mode="\x1b[31mred", answers=2, says="\x1b]0;title\x07", sees="a\nb")
    for height, width in ((24, 80), (10, 40), (60, 200)):
        page = office.page(height, width)
        assert "\x1b" not in page and "\x07" not in page
        assert max(len(line) for line in page.splitlines()) <= width or width < 100
        assert len(page.splitlines()) <= max(height, 14)


def test_what_was_said_before_the_desk_came_is_not_shown():
    office = Office()
    desk = Desk(office.desk.link, clock=lambda: office.time)
    office.desk = desk
    assert office.answer(answers=7, says="old").desk.lines == []


# ---------------------------------------------------------------- by ear


def test_what_the_ear_believes_is_said_and_the_rest_too_with_its_score_which_the_robot_ignores():
    ear = Ear((2, Heard("robot open", 0.93)), (3, Heard("stop", 0.2)))
    office = Office(ear)
    for piece in pieces(np.zeros(int(4 * PIECE * RATE), np.int16)):
        office.desk.sound(piece)
        office.answer()
    assert office.words == ["robot open", "stop"]
    page = office.page()
    assert "robot open (0.93)" in page and "not clear: stop (0.20)" in page


class SlowEar:
    """It hears nothing until it is let; then the first sample of each piece, as a word."""

    def __init__(self):
        self.let = threading.Event()

    def push(self, samples):
        assert self.let.wait(5.0)
        if samples[0] == 13:
            raise OperationFailed("the thirteenth")
        return [Heard(f"word {samples[0]}", 0.9)]


def test_a_slow_ear_keeps_the_link_alive_and_its_words_come_in_order_at_last():
    ear = SlowEar()
    beside = Beside(ear)
    office = Office(beside)
    for k in range(6):
        office.desk.sound(np.full(4000, k, np.int16))
        office.answer()
    assert "hears 1.5 s late" in office.page(width=120)
    assert office.words == [] and office.desk.link.commanding and beside.busy
    assert office.beats >= 6, "it beat all the time"
    ear.let.set()
    for _ in range(3000):
        office.desk.poll()
        if not beside.busy:
            break
        time.sleep(0.01)
    assert "late" not in office.page(width=120)
    said = [line.text for line in office.desk.lines if line.who == "you"]
    assert said == [f"word {k} (0.90)" for k in range(6)]
    with pytest.raises(OperationFailed, match="the thirteenth"):
        beside.push(np.full(1, 13, np.int16))  # may be heard at once
        for _ in range(3000):
            beside.push(np.zeros(0, np.int16))
            time.sleep(0.01)
    beside.close()


def test_the_sound_reaches_the_program_whole_and_in_order():
    office = Office(Ear())
    sound = np.arange(3000, dtype=np.int16)
    for piece in pieces(sound):
        office.desk.sound(piece)
        office.answer()
    got = office.program.sounds()
    assert np.array_equal(np.concatenate([one.samples for one in got])[:3000], sound)
    assert [one.sequence for one in got] == [0, 1280, 2560]


def wav(path, samples, rate=RATE, channels=1, width=2):
    with wave.open(str(path), "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(width)
        file.setframerate(rate)
        file.writeframes(np.asarray(samples, "<i2").tobytes())
    return path


def test_a_wav_file_is_read_at_any_rate_and_by_its_first_channel(tmp_path):
    sound = (8000 * np.sin(np.arange(4800) * 2 * np.pi * 440 / 48000)).astype(np.int16)
    assert np.array_equal(read_wav(wav(tmp_path / "a.wav", sound), "--file"), sound)
    stereo = np.column_stack([sound, -sound]).ravel()
    assert np.array_equal(read_wav(wav(tmp_path / "b.wav", stereo, channels=2), "--file"), sound)
    slow = read_wav(wav(tmp_path / "c.wav", sound, rate=48000), "--file")
    assert len(slow) == 1600
    wanted = 8000 * np.sin(np.arange(1600) * 2 * np.pi * 440 / RATE)
    assert np.abs(slow - wanted)[100:-100].max() < 100


def test_what_is_no_wav_file_is_refused_in_one_line(tmp_path):
    short = wav(tmp_path / "short.wav", np.zeros(100))
    cut = tmp_path / "cut.wav"
    cut.write_bytes(short.read_bytes()[:30])
    text = tmp_path / "text.wav"
    text.write_text("RIFF no")
    bytes_8 = wav(tmp_path / "8.wav", np.zeros(100), width=1)
    for path in (cut, text, bytes_8, tmp_path / "none.wav", tmp_path, wav(tmp_path / "r.wav", [0], rate=4)):
        with pytest.raises(ConfigError, match="--file") as refusal:
            read_wav(path, "--file")
        assert "\n" not in str(refusal.value)


# ---------------------------------------------------------------- the command


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "standard input must be a terminal"),
        (["--json"], "--json must be given with --say or --file"),
        (["--radio"], "--radio must be given with --file"),
        (["--radio", "--file", "a.wav", "--say", "stop"], "--radio must be given without --say"),
        (["--radio", "--file", "a.wav", "--voice", "wire"], "--radio must be given without --voice"),
        (["--say", "  "], "--say must be 1 to 120 characters, got '  '"),
        (["--say", "open " * 25], "--say must be 1 to 120 characters"),
        (["--file", "none.wav"], "--file: none.wav cannot be read"),
        (["--say", "stop", "nothing.yaml"], "nothing.yaml"),
        (["--say", "stop", "--set", "hardware.lcm_url=tcp://x"], "hardware.lcm_url"),
    ],
)
def test_bad_arguments_are_one_line(arguments, words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main(["operator", *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and words in lines[0]


def test_a_script_whose_words_nobody_hears_fails_in_one_line(capsys, monkeypatch):
    monkeypatch.setattr("valve_drake.commands.operator.ANSWER", 0.1)
    assert cli.main(["operator", "--say", "stop", "--set", "hardware.lcm_url=memq://"]) == 1
    assert "no program listens" in capsys.readouterr().err


class Elsewhere:
    """Instead of `time` in the command: while it sleeps, a program in the same process listens and answers."""

    def __init__(self, monkeypatch, mode="idle"):
        self.lcm, self.now, self.modes = DrakeLcm("memq://"), 200.0, [mode]
        monkeypatch.setattr("valve_drake.stations.bus.DrakeLcm", lambda url: self.lcm)
        monkeypatch.setattr("valve_drake.stations.bus.wall", self)
        monkeypatch.setattr("valve_drake.commands.operator.time", self)
        monkeypatch.setattr(DeskLink.__init__, "__defaults__", (self.monotonic,))
        monkeypatch.setattr(Desk.__init__, "__defaults__", (None, True, self.monotonic))
        self.program = OperatorLink(Bus(HardwareConfig(lcm_url="memq://"), self.lcm))
        self.program.bus.clock = self.monotonic
        self.state, self.sounds, self.ahead = State(), [], []

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += max(seconds, 0.01)
        self.sounds += self.program.sounds()
        packets = self.program.take(self.now) or OperatorPackets(count=self.state.packets)
        mode = ModeState(mode=self.modes[-1], activation=len(self.modes), verdict="turned", reason="seen")
        config = OperatorChannelConfig(wire="lcm")
        before = self.state.command
        self.state = step(config, 1.5, 12.6, self.state, self.now, packets, OperatorCommand(), mode, Status(), "")
        if self.state.command is not before:
            runs = {"open": ["search"] + ["turn"] * 30 + ["done"], "stop": ["stopped"]}
            self.ahead = runs.get(self.state.command.command, [])
        if self.ahead:
            self.modes.append(self.ahead.pop(0))
        self.program.tell(self.state.shown)


def script(capsys, *arguments):
    code = cli.main(["operator", "--set", "hardware.lcm_url=memq://", *arguments])
    return code, capsys.readouterr()


def test_a_script_says_its_words_waits_for_the_end_of_its_run_and_tells_it(monkeypatch, capsys):
    elsewhere = Elsewhere(monkeypatch)
    code, told = script(capsys, "--say", "robot, open the valve", "--say", "confirm", "--json")
    found = json.loads(told.out)
    assert code == 0 and found["good"] and (found["mode"], found["verdict"]) == ("done", "turned")
    assert [line["text"] for line in found["said"] if line["who"] == "you"] == ["robot, open the valve", "confirm"]
    elsewhere.sleep(0.1)
    assert elsewhere.state.holder == 0  # it has left


def test_a_script_whose_words_are_lost_on_the_wire_exits_1(monkeypatch, capsys):
    elsewhere = Elsewhere(monkeypatch)
    elsewhere.take = elsewhere.program.take

    def deaf(now):
        """The program hears nothing that is said after the first sentence."""
        found = elsewhere.take(now)
        kept = tuple(one for one in found.packets if one.sequence <= 1) if found else ()
        return OperatorPackets(found.time, found.count, kept) if found else None

    elsewhere.program.take = deaf
    code, told = script(capsys, "--say", "status", "--say", "robot, open the valve")
    assert code == 1 and "the robot did not answer to robot, open the valve" in told.err


def test_a_script_whose_words_are_refused_exits_1(monkeypatch, capsys):
    Elsewhere(monkeypatch, mode="turn")
    code, told = script(capsys, "--say", "robot, open the valve")
    assert code == 1 and "robot: not now: turn is under way, say stop first" in told.out


def test_a_wav_file_is_heard_and_sent_at_its_own_speed(monkeypatch, capsys, tmp_path):
    ear = Ear((3, Heard("robot open", 0.9)), (5, Heard("confirm", 0.8)), (6, Heard("hm", 0.1)))
    monkeypatch.setattr("valve_drake.operator.ear.recogniser", lambda: ear)
    elsewhere = Elsewhere(monkeypatch)
    sound = np.arange(16000, dtype=np.int16)
    code, told = script(capsys, "--file", str(wav(tmp_path / "a.wav", sound)))
    assert code == 0 and "you: robot open (0.90)" in told.out and "robot: turned: seen" in told.out
    assert "not clear: hm (0.10)" in told.out
    got = np.concatenate([one.samples for one in elsewhere.sounds])
    assert np.array_equal(got[:16000], sound)


def test_a_radio_puts_sound_on_the_bus_and_says_nothing(monkeypatch, capsys, tmp_path):
    elsewhere = Elsewhere(monkeypatch)
    code, told = script(capsys, "--file", str(wav(tmp_path / "a.wav", np.ones(16000))), "--radio")
    assert code == 0 and told.out == "1.0 s of sound were sent\n"
    elsewhere.sleep(0.1)
    elsewhere.sleep(0.1)
    assert sum(len(one.samples) for one in elsewhere.sounds) == 13 * 1280
    assert elsewhere.state.holder == 0


def test_listening_without_the_extra_is_refused_in_one_line(monkeypatch, capsys, tmp_path):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr("valve_drake.operator.ear.importlib.import_module", missing)
    code, told = script(capsys, "--file", str(wav(tmp_path / "a.wav", np.zeros(100))))
    assert code == 2 and "pip install 'valve-drake[voice]'" in told.err and len(told.err.splitlines()) == 1
