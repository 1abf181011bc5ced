"""reports: stamps, bad messages, second senders, clock alignment and lock-step's count of messages."""

import math

import pytest

from valve_drake.ports import TICK
from valve_drake.stations.lcm_channels import signal
from valve_drake.stations.reports import MANY, PATIENCE, BadMessages, LeastDelay, Lockstep, Senders, Stamps

NEWS, OLD, STRANGE, RESTARTED = Stamps.NEWS, Stamps.OLD, Stamps.STRANGE, Stamps.RESTARTED
DAY = 86_400_000_000  # [us]


def judged(sent, quiet=0.0):
    """sent: (stamp [s], time [s]) of each report -> the verdict on it (NEWS, OLD, ...)."""
    stamps = Stamps(quiet)
    return [stamps.judge("a", round(1e6 * stamp), time) for stamp, time in sent]


def test_later_stamps_are_news_and_the_same_or_earlier_ones_are_old():
    assert judged([(5.0, 0.0), (5.1, 0.1), (5.1, 0.2), (5.05, 0.3), (5.2, 0.4)]) == [NEWS, NEWS, OLD, OLD, NEWS]


@pytest.mark.parametrize("wild", [0, DAY, 2**63 - 1, -(2**63)])
def test_a_single_wild_stamp_changes_nothing(wild):
    stamps = Stamps()
    assert stamps.judge("a", 5_000_000, 0.0) == NEWS
    assert stamps.judge("a", wild, 0.1) == STRANGE
    assert stamps.judge("a", 5_200_000, 0.2) == NEWS
    assert stamps.judge("a", wild, 0.3) == STRANGE


def test_a_clock_begun_anew_is_believed_at_its_second_stamp():
    assert judged([(5.0, 0.0), (0.0, 0.1), (0.0, 0.15), (0.1, 0.2), (0.2, 0.3)]) == [
        NEWS, STRANGE, STRANGE, RESTARTED, NEWS,
    ]  # fmt: skip


def test_a_pause_is_no_restart():
    assert judged([(5.0, 0.0), (65.0, 60.0)]) == [NEWS, NEWS]


def test_one_message_again_and_again_is_never_a_new_clock():
    assert set(judged([(5.0, 0.0), *((1.0, 1.0 + k * TICK) for k in range(300))])[1:]) == {STRANGE}
    assert set(judged([(5.0, 0.0), *((5.0, 1.0 + k * TICK) for k in range(300))])[1:]) == {OLD}


def test_a_second_sender_is_not_believed_while_the_first_one_speaks():
    sent = [(5.0, 0.0)]
    for k in range(1, 50):
        sent += [(5.0 + k * TICK, k * TICK), (90.0 + k * TICK, k * TICK), (90.001 + k * TICK, k * TICK)]
    verdicts = judged(sent, quiet=0.1)
    assert verdicts[0::3] == [NEWS] + [STRANGE] * 49 or set(verdicts[1::3]) == {NEWS}
    assert set(verdicts[2::3]) | set(verdicts[3::3]) == {STRANGE}
    assert judged([(5.0, 0.0), (90.0, 0.2), (90.01, 0.21)], quiet=0.1)[-1] == RESTARTED


# ---------------------------------------------------------------- bad messages


def faults(bad, time):
    return list(bad.faults(time))


def test_a_single_bad_message_is_counted_and_no_fault():
    bad = BadMessages({})
    bad.bad("torso", "nonsense", 1.0)
    bad.good("torso", 1.0 + TICK)
    assert bad.counts == {"torso": 1} and not faults(bad, 1.0 + TICK) and not faults(bad, 1.1)


def test_bad_messages_that_go_on_are_a_fault_until_half_a_second_after_the_last_one():
    bad = BadMessages({})
    for k in range(4):
        bad.bad("torso", "nonsense", 1.0 + k * TICK)
    assert faults(bad, 1.0 + 3 * TICK) == ["nonsense"]
    bad.good("torso", 1.0 + 4 * TICK)
    assert faults(bad, 1.4) == ["nonsense"] and not faults(bad, 1.6)


def test_silence_after_a_bad_message_is_a_fault():
    bad = BadMessages({})
    bad.bad("torso", "nonsense", 1.0)
    assert not faults(bad, 1.0 + PATIENCE) and faults(bad, 1.0 + PATIENCE + 1e-6) == ["nonsense"]


def test_many_bad_messages_are_a_fault_though_good_ones_come_too():
    bad = BadMessages({})
    for k in range(MANY):
        assert not faults(bad, k * TICK)
        bad.bad("torso", "nonsense", k * TICK)
        bad.good("torso", k * TICK)
    assert faults(bad, MANY * TICK) == ["nonsense"]


def test_a_device_that_reports_seldom_has_patience_of_its_own():
    bad = BadMessages({"head_left": 0.5})
    bad.bad("head_left", "cut", 1.0)
    assert not faults(bad, 1.4) and faults(bad, 1.6) == ["cut"]
    bad.good("head_left", 1.65)
    bad.bad("head_left", "cut", 3.0)
    bad.good("head_left", 3.25)
    assert not faults(bad, 3.3)


# ---------------------------------------------------------------- the others


def test_senders_are_present_while_they_say_so():
    senders = Senders()
    senders.hear("robot", 1.0, 0.0)
    senders.hear("robot", 2.0, 0.3)
    assert [senders.present("robot", t) for t in (0.3, 0.6, 0.9)] == [2, 1, 0]
    assert senders.present("controller", 0.3) == 0


def test_the_least_delay_is_of_the_last_two_seconds():
    delay = LeastDelay()
    assert delay.least() is None
    for tick, late in ((0, 0.01), (1, 0.03), (3, 0.02)):
        delay.add(late + 0.005)
        delay.add(late)
        delay.close(float(tick))
    assert delay.least() == 0.02
    delay.forget()
    assert delay.least() is None


def test_a_tick_is_complete_when_what_was_announced_has_come():
    end = Lockstep()
    assert end.hear(signal({"tick": -1, "messages": 0}))
    end.begin(sent=7)
    for _ in range(3):
        end.count()
    assert end.hear(signal({"tick": 0, "messages": 3})) and end.complete(0) and not end.complete(1)
    assert end.announcement(4, sent=17) == {"tick": 4, "messages": 10}


@pytest.mark.parametrize("numbers", [[], [1.0], [1.0, math.nan], [math.inf, 0.0], [0.5, 1.0], [1e300, 0.0], [1.0] * 3])
def test_an_announcement_of_other_numbers_is_none(numbers):
    end = Lockstep()
    assert not end.hear(signal({str(k): value for k, value in enumerate(numbers)})) and end.tick is None
