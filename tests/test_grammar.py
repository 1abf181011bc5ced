"""What an operator may say, and the conversation that leads to a command."""

import math

import pytest

from valve_drake.operator.grammar import (
    LISTENING,
    NUMBERS,
    PHRASES,
    WAITING,
    Heard,
    Intent,
    Kind,
    Talk,
    converse,
    normal,
    parse,
    spoken,
)


def degrees(text):
    return round(math.degrees(parse(text).angle), 6)


@pytest.mark.parametrize(
    "text, kind, angle",
    [
        ("robot, open the valve", Kind.OPEN, 90),
        ("Robot open", Kind.OPEN, 90),
        ("robot, close the valve half", Kind.CLOSE, 45),
        ("robot open half way please", Kind.OPEN, 45),
        ("robot, open by thirty degrees", Kind.OPEN, 30),
        ("robot, open the valve by one hundred and thirty-five degrees", Kind.OPEN, 135),
        ("close by 22.5°", Kind.CLOSE, 22.5),
        ("close 720 degrees", Kind.CLOSE, 720),
        ("by forty five", Kind.AMOUNT, 45),
        ("half", Kind.AMOUNT, 45),
    ],
)
def test_a_move_says_which_way_and_how_far(text, kind, angle):
    assert parse(text).kind == kind
    assert degrees(text) == angle


@pytest.mark.parametrize(
    "text",
    [
        "robot, open the door",
        "robot, do not open the valve",
        "robot, open the valve and close it",
        "robot, open by 0 degrees",
        "robot, open by 721 degrees",
        "robot, open by zero degrees",
        "robot, open 45",  # neither `by` nor `degrees`: a number that may be of anything
        "robot, open by many degrees",
        "open robot",
        "",
        "\x1b[31mopen\x00 sesame",
        "open by ٣٠ degrees",
        "x" * 100000,
    ],
)
def test_what_is_not_of_the_grammar_is_unknown(text):
    assert parse(text).kind == Kind.UNKNOWN


@pytest.mark.parametrize("text", ["stop", "STOP!", "robot stop", "stop stop stop", "please halt now", "open, no, stop"])
def test_stop_is_heard_in_any_sentence(text):
    assert parse(text).kind == Kind.STOP


def test_numbers_are_the_same_in_words_and_in_digits():
    for number in range(1, 721):
        assert normal(f"open by {spoken(number)} degrees") == f"open by {number} degrees"


def test_every_phrase_of_the_recogniser_means_what_it_says():
    for phrase, kind in PHRASES.items():
        for number in NUMBERS:
            text = phrase.replace("<N>", spoken(number))
            assert parse(text if phrase == "robot" else f"robot {text}").kind == kind
            if "<N>" in phrase:
                assert degrees(text) == number


# ---------------------------------------------------------------- the conversation


def talk(*utterances, **facts):
    """Outcome and answer of each (time, text) or (time, Heard), from the beginning."""
    state, out = Talk(), []
    for time, said in utterances:
        heard = said if isinstance(said, Heard) else Heard(said, 0.9)
        state, decision = converse(state, heard, time, **facts)
        out.append(decision)
    return out


def outcomes(*utterances, **facts):
    return [decision.outcome for decision in talk(*utterances, **facts)]


def test_a_move_is_read_back_and_begins_with_confirm():
    asked, given = talk((0, "robot, open the valve"), (3, "confirm"))
    assert (asked.outcome, asked.says) == ("asked", "open by 90 degrees: say confirm")
    assert (given.outcome, given.intent) == ("given", Intent(Kind.OPEN, math.pi / 2, True))


def test_nothing_moves_without_the_wake_phrase():
    assert outcomes((0, "open the valve"), (1, "confirm")) == ["ignored", "ignored"]


def test_the_wake_phrase_alone_opens_the_ear_for_a_while():
    assert outcomes((0, "robot"), (LISTENING, "close the valve")) == ["listening", "asked"]
    assert outcomes((0, "robot"), (LISTENING + 0.1, "close the valve")) == ["listening", "ignored"]


def test_typed_words_need_no_wake_phrase_but_a_confirm():
    assert outcomes((0, Heard("open", typed=True)), (1, Heard("confirm", typed=True))) == ["asked", "given"]


def test_a_late_confirm_begins_nothing():
    assert outcomes((0, "robot open"), (WAITING, "confirm"))[-1] == "given"
    assert outcomes((0, "robot open"), (WAITING + 0.1, "confirm"))[-1] == "ignored"
    assert outcomes((0, "robot open"), (WAITING + 0.1, "robot confirm"))[-1] == "refused"


def test_a_confirm_counts_once():
    assert outcomes((0, "robot open"), (1, "confirm"), (2, "confirm")) == ["asked", "given", "ignored"]


def test_an_angle_can_be_corrected_until_it_is_confirmed():
    _, again, given = talk((0, "robot, close"), (1, "by thirty degrees"), (2, "confirm"))
    assert again.says == "close by 30 degrees: say confirm"
    assert (given.intent.kind, round(math.degrees(given.intent.angle))) == (Kind.CLOSE, 30)


def test_other_speech_between_does_not_confirm_and_does_not_forget():
    assert outcomes((0, "robot open"), (1, "the weather is fine"), (2, "open"), (3, "confirm")) == [
        "asked",
        "ignored",
        "ignored",
        "given",
    ]


def test_cancel_forgets_the_move():
    assert outcomes((0, "robot open"), (1, "cancel"), (2, "confirm")) == ["asked", "answered", "ignored"]


def test_a_new_move_replaces_the_one_that_waits():
    *_, given = talk((0, "robot open"), (1, "robot close half"), (2, "confirm"))
    assert given.intent.kind == Kind.CLOSE


def test_stop_is_given_in_every_state_and_forgets_what_waits():
    for before in ([], [(0, "robot")], [(0, "robot open")], [(0, "robot open"), (1, "confirm")]):
        assert outcomes(*before, (2, "stop"), (3, "confirm"))[-2:] == ["given", "ignored"]
        assert outcomes(*before, (2, "stop"), refusal="it is turning", faulty=True)[-1] == "given"


def test_what_is_not_heard_well_is_ignored_whatever_it_is():
    for text in ("stop", "robot open", "robot"):
        assert outcomes((0, Heard(text, 0.49))) == ["ignored"]
        assert outcomes((0, Heard(text, math.nan))) == ["ignored"]
    assert outcomes((0, "robot open"), (1, Heard("confirm", 0.3))) == ["asked", "ignored"]


def test_a_move_that_cannot_begin_is_refused_with_the_reason_also_at_its_confirm():
    (refused,) = talk((0, "robot open"), refusal="it is turning")
    assert (refused.outcome, refused.says) == ("refused", "not now: it is turning")
    state, _ = converse(Talk(), Heard("robot open"), 0.0)
    assert converse(state, Heard("confirm"), 1.0, refusal="it is turning")[1].outcome == "refused"


def test_a_held_turn_goes_on_by_confirm_alone():
    assert outcomes((0, "confirm")) == ["ignored"]
    (given,) = talk((0, "confirm"), held=True, refusal="it is turning")
    assert (given.outcome, given.intent.kind) == ("given", Kind.RESUME)
    assert outcomes((0, "half"), (1, "cancel"), (2, "the weather"), held=True) == ["ignored", "answered", "ignored"]


def test_status_answers_and_reset_leads_out_of_a_failure_only():
    (answer,) = talk((0, "robot, status"), status="idle")
    assert (answer.outcome, answer.says) == ("answered", "idle")
    asked, given = talk((0, "robot reset"), (1, "confirm"), faulty=True, refusal="the last run has failed")
    assert (asked.says, given.outcome, given.intent.kind) == (
        "reset, the arms go home: say confirm",
        "given",
        Kind.RESET,
    )
    assert outcomes((0, "robot reset")) == ["answered"]
    assert outcomes((0, "status"), (1, "reset"), faulty=True) == ["ignored", "ignored"]


def test_what_is_meant_for_the_robot_and_not_understood_is_said_to_be_so():
    assert [d.says for d in talk((0, "robot, open the door"))] == ["not understood"]
