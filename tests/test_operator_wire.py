"""The operators' wire: a desk and the program on one bus, within this process; whatever comes on the channels."""

import math

import numpy as np
import pytest
from bad_messages import bad_messages, on
from pydrake.lcm import DrakeLcm

from valve_drake import scenario as scenarios
from valve_drake.checks import OperationFailed
from valve_drake.messages import OperatorPacket, OperatorState
from valve_drake.operator.desk_link import PATIENCE, SILENT, DeskLink
from valve_drake.operator.grammar import LONGEST, Heard
from valve_drake.operator.operator_link import MOST, OperatorLink
from valve_drake.operator.wire import (
    MOST_COUNTED,
    RATE,
    News,
    Sound,
    Tail,
    read_report,
    read_sound,
    read_words,
    report_message,
    sound_message,
    words_message,
)
from valve_drake.stations.bus import Bus
from valve_drake.stations.lcm_channels import (
    AUDIO,
    CONTROLLER,
    OPERATOR,
    PRESENCE,
    REPORT,
    WORDS,
    HardwareConfig,
    WrongMessage,
    signal,
)

PACKET = OperatorPacket(speaker=7, sent=12.5, sequence=3, words="robot: open", score=0.75, said=12.25, typed=True)
STATE = OperatorState(
    speaker=7, linked=True, heard=3, words="a: b", outcome="asked", answers=9, says="open: say confirm", done=False,
    mode="turn", turned=42.0, held=True, sees="marker at 1.00 m",
)  # fmt: skip


def same(a, b):
    return vars(a) == vars(b)


class Pair:
    """A program and desks on one bus, all by one clock."""

    def __init__(self, desks=1, **hardware):
        self.config = HardwareConfig(lcm_url="memq://", **hardware)
        self.lcm, self.time = DrakeLcm("memq://"), 100.0
        self.program = OperatorLink(self.bus())
        self.desks = [DeskLink(self.bus(), lambda: self.time) for _ in range(desks)]
        self.desk = self.desks[0]
        self.state, self.packets = OperatorState(), []

    def bus(self):
        bus = Bus(self.config, self.lcm)
        bus.clock = lambda: self.time
        return bus

    def run(self, seconds=0.3, answer=True):
        for _ in range(math.ceil(seconds * 32)):
            self.time += 1 / 32
            if answer:
                self.program.tell(self.state)
            for desk in self.desks:
                desk.poll()
            taken = self.program.take(self.time)
            self.packets += taken.packets if taken else ()
        return self

    def words(self):
        return [packet.words for packet in self.packets if packet.words]


# ---------------------------------------------------------------- messages


def test_words_report_and_sound_arrive_as_they_were_sent():
    to, packet = read_words(words_message(PACKET, 99))
    assert to == 99 and same(packet, PACKET)
    program, state = read_report(report_message(STATE, 5))
    assert program == 5 and same(state, STATE)
    sound = Sound(1.5, 4, RATE, np.arange(-640, 640, dtype=np.int16))
    back = read_sound(sound_message(sound))
    assert (back.time, back.sequence, back.rate) == (1.5, 4, RATE)
    assert np.array_equal(back.samples, sound.samples)


def test_a_text_that_is_too_long_for_the_wire_is_cut():
    _, state = read_report(report_message(OperatorState(says="x" * 1000), 5))
    assert 100 < len(state.says) < 200


@pytest.mark.parametrize(
    "changes",
    [
        {"instance": 0.0},
        {"instance": 1.5},
        {"instance": 2.0**60},
        {"instance": math.nan},
        {"sequence": -1.0},
        {"score": 1.1},
        {"score": -0.1},
        {"said": 13.0},
        {"end": math.inf},
        {"to": -1.0},
        {"words: " + "x" * (LONGEST + 1): 1.0},
    ],
)
def test_words_with_a_number_that_cannot_be_are_refused(changes):
    message = words_message(PACKET, 99)
    values = dict(zip(message.coord, message.val)) | changes
    bad = signal({k: v for k, v in values.items() if k != "words: robot: open" or len(changes) == 0})
    bad.timestamp = message.timestamp
    with pytest.raises(WrongMessage):
        read_words(bad)


# ---------------------------------------------------------------- a desk and the program


def test_words_are_said_until_they_are_heard_one_after_the_other():
    pair = Pair().run()
    pair.desk.say(Heard("robot open", typed=True))
    pair.desk.say(Heard("confirm", typed=True))
    pair.run()
    assert set(pair.words()) == {"robot open"} and len(pair.words()) >= 3
    pair.state = OperatorState(speaker=pair.desk.number, linked=True, heard=1)
    pair.run()
    assert pair.words()[-1] == "confirm" and pair.desk.waiting
    pair.state = OperatorState(speaker=pair.desk.number, linked=True, heard=2)
    pair.run()
    assert not pair.desk.waiting and pair.packets[-1].words == ""


def test_a_stop_goes_at_once_and_before_all_that_waits():
    pair = Pair().run()
    for words in ("robot open", "confirm", "robot status"):
        pair.desk.say(Heard(words))
    pair.desk.say(Heard("stop"))
    assert [packet.words for packet in pair.program.take(pair.time).packets][-1] == "stop"
    pair.state = OperatorState(speaker=pair.desk.number, heard=2)
    pair.run()
    assert not pair.desk.waiting


def test_words_with_what_is_no_character_are_said_all_the_same():
    pair = Pair().run()
    pair.desk.say(Heard("robot \udcff open"))
    assert pair.run().words()[0] == "robot ? open"


def test_words_that_nobody_hears_are_given_up_and_said_to_be_so():
    pair = Pair()
    pair.desk.say(Heard("robot open"))
    pair.run(PATIENCE + 0.2, answer=False)
    assert pair.desk.notes == ["not heard by the robot: robot open"] and pair.desk.unheard == 1
    pair.run()
    assert pair.words() == []


def test_a_program_that_falls_silent_is_noticed():
    pair = Pair().run()
    assert pair.desk.linked and pair.desk.program == pair.program.bus.instance
    pair.run(SILENT + 0.2, answer=False)
    assert pair.desk.notes == ["the program is not heard any more"]


def test_words_for_another_program_or_of_an_earlier_one_count_as_none():
    pair = Pair().run()
    message = words_message(PACKET, pair.program.bus.instance + 1)
    pair.desk.bus.send(WORDS, message)
    assert pair.run().words() == []


def test_a_second_desk_is_refused_at_its_start_and_both_are_told_if_it_comes_all_the_same():
    pair = Pair(desks=2).run()
    with pytest.raises(OperationFailed, match="another operator's desk is on"):
        pair.desks[1].claim()()
    assert all("another operator's desk is on the bus: one of you has to leave" in desk.notes for desk in pair.desks)


def test_a_desk_that_is_refused_says_who_commands():
    pair = Pair(desks=2).run()
    pair.desks[1].notes.clear()
    pair.state = OperatorState(speaker=pair.desks[0].number, other=pair.desks[1].number)
    pair.desks[1].say(Heard("robot open"))
    pair.run()
    assert any(note.startswith("refused: operator ") for note in pair.desks[1].notes)
    assert not pair.desks[1].waiting and not pair.desks[1].commanding


def test_a_second_program_is_refused_and_a_desk_does_not_listen_to_it():
    pair = Pair().run()
    other = OperatorLink(pair.bus())
    pair.run()
    with pytest.raises(OperationFailed, match="another program is on"):
        other.claim()
    other.tell(OperatorState(speaker=pair.desk.number, says="go"))
    pair.run()
    assert pair.desk.program == pair.program.bus.instance and pair.desk.state.says == ""
    for _ in range(30):
        other.tell(OperatorState(speaker=pair.desk.number))
        pair.run(0.2)
    assert len([note for note in pair.desk.notes if "a second program answers" in note]) == 1


def test_sound_reaches_the_program_and_no_more_is_kept_than_has_room():
    pair = Pair().run()
    for k in range(MOST + 5):
        pair.desk.sound(np.full(80, k, np.int16))
        pair.program.take(pair.time)
    assert [sound.samples.tolist() for sound in pair.program.sounds()] == [[k] * 80 for k in range(MOST)]
    assert pair.program.sounds() == []


def test_pieces_that_are_lost_are_made_good_by_those_that_follow_and_none_comes_twice():
    whole = (np.arange(40 * 1280) % 30000).astype(np.int16)
    tail, news = Tail(), News()
    sent = [tail.add(piece, 5.0 + k * 0.08) for k, piece in enumerate(whole.reshape(40, 1280))]
    got = []
    for sound in sent[3::4]:  # a program that looks every 0.32 s: the bus keeps one message
        got += [news.take(read_sound(sound_message(sound))) for _ in range(2)]
    assert [sound is None for sound in got] == [False, True] * 10
    assert np.array_equal(np.concatenate([sound.samples for sound in got[::2]]), whole)
    assert [sound.sequence for sound in got[::2]] == [5120 * k for k in range(10)]
    assert [sound.time for sound in got[::2]] == pytest.approx([5.0 + 0.32 * k for k in range(10)])


def test_a_desk_that_listens_to_the_bus_hears_what_a_radio_puts_there_once_and_in_order():
    pair = Pair(desks=2).run()
    radio, desk = pair.desks
    heard = []
    desk.listen(heard.append)
    whole = (np.arange(10 * 1280) % 30000).astype(np.int16)
    for piece in whole.reshape(10, 1280):
        radio.sound(piece)
        pair.run(1 / 32)
    assert np.array_equal(np.concatenate(heard), whole)
    pair.lcm.Publish(desk.bus.name(AUDIO), b"no sound")
    before = desk.dropped
    pair.run(1 / 32)
    assert desk.dropped == before + 1


def test_another_desks_sound_begins_anew():
    pair = Pair(desks=2).run()
    for desk in pair.desks:
        for _ in range(20):
            desk.sound(np.ones(1280, np.int16))
            pair.program.take(pair.time)
    assert sum(len(sound.samples) for sound in pair.program.sounds()) == 2 * 20 * 1280


def test_a_desk_whose_first_messages_are_lost_is_heard_though_another_has_spoken_for_hours():
    first, second, news = Tail(), Tail(), News()
    for _ in range(100):
        news.take(first.add(np.ones(1280, np.int16), 5.0))
    sent = [second.add(np.full(1280, k, np.int16), 9.0) for k in range(10)]
    assert news.take(sent[-1]).samples[-1] == 9


def test_sound_goes_on_when_its_count_has_no_more_room():
    tail, news = Tail(), News()
    tail._count = MOST_COUNTED - 10 * 1280
    got = []
    for k in range(20):
        image = sound_message(tail.add(np.full(1280, k, np.int16), 5.0 + k * 0.08))
        sound = news.take(read_sound(type(image).decode(image.encode())))
        got += [] if sound is None else [sound.samples]
    assert np.array_equal(np.concatenate(got), np.repeat(np.arange(20), 1280))


# ---------------------------------------------------------------- signatures, bad messages


def test_only_a_desk_with_the_key_is_heard_and_nothing_that_was_said_before(tmp_path):
    key = tmp_path / "key"
    key.write_bytes(b"0123456789abcdef")
    pair = Pair(key_file=str(key)).run()
    kept = []
    name = pair.desk.bus.name(WORDS)
    pair.lcm.Subscribe(name, kept.append)
    pair.desk.say(Heard("confirm"))
    pair.run()
    assert "confirm" in pair.words() and kept
    pair.state = OperatorState(speaker=pair.desk.number, heard=1)
    pair.run()
    pair.packets = []
    for data in kept[:5]:
        pair.lcm.Publish(name, data)  # said again
        pair.run(1 / 32)
    pair.lcm.Publish(name, words_message(PACKET, pair.program.bus.instance).encode())  # not signed
    pair.run(1 / 32)
    assert pair.words() == []
    assert pair.program.dropped == {WORDS: 1}


@pytest.mark.system
def test_whatever_comes_on_the_channels_both_sides_go_on_and_count_it():
    rng = np.random.default_rng(8)
    pair = Pair().run()
    for sender in (OPERATOR, CONTROLLER):
        for message in bad_messages(rng, sender, 600):
            on(pair.desk.bus, message)
            pair.program.take(pair.time)
            pair.program.sounds()
            pair.desk.poll()
    assert pair.program.dropped[WORDS] > 50 and pair.program.dropped[AUDIO] > 50 and pair.desk.dropped > 10
    pair.time += 2.0
    pair.run(1.0)
    pair.desk.notes.clear()
    pair.desk.say(Heard("stop"))
    pair.run()
    assert "stop" in pair.words() and pair.desk.linked


def test_damaged_words_report_and_sound_never_raise_anything_but_their_refusal():
    rng = np.random.default_rng(9)
    sound = Sound(1.5, 4, RATE, np.arange(100, dtype=np.int16))
    for message, read in (
        (words_message(PACKET, 1), read_words),
        (report_message(STATE, 1), read_report),
        (sound_message(sound), read_sound),
    ):
        data = message.encode()
        for _ in range(500):
            damaged = bytearray(data)
            for k in rng.integers(8, len(data), 3):
                damaged[k] = int(rng.integers(256))
            try:
                again = type(message).decode(bytes(damaged[: len(data) - int(rng.integers(3))]))
            except Exception:  # as Bus takes it
                continue
            try:
                read(again)
            except WrongMessage:
                pass


def test_the_operators_channels_are_no_part_of_lock_step_and_no_names_are_taken_twice():
    bus = Bus(HardwareConfig(lcm_url="memq://"), DrakeLcm("memq://"))
    for key, message in ((WORDS, words_message(PACKET, 1)), (REPORT, report_message(STATE, 1))):
        bus.send(key, message)
    bus.announce(OPERATOR)
    assert bus.sent == 0 and PRESENCE[OPERATOR] == "operator.presence"
    scenarios.load(None, ["operator_channel.wire=lcm"])


def test_no_bus_is_opened_unless_the_scenario_says_so():
    assert scenarios.load().operator_channel.wire == "none"
