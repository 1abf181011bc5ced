"""task/modes.py: the task stands in one table, and a table that is wrong is refused in one line."""

import dataclasses as dc
import math
import re
from pathlib import Path

import pytest

from valve_drake.checks import ConfigError
from valve_drake.messages import Cause, Mode, Verdict
from valve_drake.task.modes import BEHAVIORS, HOLD, OPEN, ROWS, RUNNING, TABLE, Retry, Row, checked, document, owned

ROOT = Path(__file__).parent.parent
SOURCES = sorted((ROOT / "valve_drake").rglob("*.py"))


def row(mode: Mode) -> Row:
    return TABLE[mode]


def with_row(mode: Mode, **changes) -> list[Row]:
    return [dc.replace(r, **changes) if r.mode == mode else r for r in ROWS]


@pytest.mark.parametrize(
    "rows, words",
    [
        ([r for r in ROWS if r.mode != Mode.TURN], "mode turn has no row"),
        ([*ROWS, row(Mode.GRASP)], "mode grasp has two rows"),
        (with_row(Mode.TURN, owner="hybrid_rotator"), "the row of turn: owner must be one of .*got 'hybrid_rotator'"),
        (with_row(Mode.SERVO, hands="valve_serch"), "the row of servo: hands must be one of .*got 'valve_serch'"),
        (with_row(Mode.SEARCH, base=OPEN), "the row of search: base must be one of"),
        (with_row(Mode.REACH, deadline=math.inf), "the row of reach: a mode with an owner has a deadline"),
        (with_row(Mode.DONE, next=Mode.IDLE), "the row of done: a final mode has no owner and leads nowhere"),
        (with_row(Mode.TURN, off=Mode.FAILED), "the row of turn: off must be release"),
        (
            with_row(Mode.REACH, retry={Verdict.REACH_LIMIT: Retry("servo", 3, Mode.FOLD)}),
            "retries of servo must be 3, got 2",
        ),
        (
            with_row(Mode.REACH, retry={Verdict.REACH_LIMIT: Retry("again", 1, Mode.RELEASE)}),
            "the row of reach: after_release goes with a retry by release",
        ),
        (
            with_row(Mode.SEARCH, next=None),
            "the row of search: next must be a mode, which only release, fold, retreat leave to the supervisor",
        ),
        (
            with_row(Mode.REACH, retry={"moves": Retry("moved", 2, Mode.FOLD)}),
            "the row of reach: retry must be by a cause or a verdict, got 'moves'",
        ),
    ],
)
def test_a_wrong_table_is_refused_in_one_line_that_names_the_row_and_the_rule(rows, words):
    with pytest.raises(ConfigError, match=words) as error:
        checked(rows)
    assert "\n" not in str(error.value)


def test_every_mode_has_its_row_and_every_way_leads_to_a_final_mode():
    assert set(TABLE) == set(Mode)
    assert {r.owner for r in ROWS if r.owner} == set(BEHAVIORS)
    for mode in RUNNING:
        path = [mode]
        while not TABLE[path[-1]].final:  # giving up in every mode on the way
            path.append(TABLE[path[-1]].off)
            assert len(path) < len(TABLE), path
        assert path[-1] == Mode.FAILED


def test_a_retry_is_found_by_cause_then_by_verdict_then_for_any_failure():
    measure, servo, turn = row(Mode.MEASURE), row(Mode.SERVO), row(Mode.TURN)
    assert measure.retry_of(Cause.STANCE, Verdict.REACH_LIMIT).mode == Mode.FINE_APPROACH
    assert measure.retry_of(Cause.NONE, Verdict.MARKER_LOST).mode == Mode.SEARCH
    assert measure.retry_of(Cause.NONE, Verdict.REACH_LIMIT) is None
    assert servo.retry_of(Cause.NONE, Verdict.FAULT).mode == Mode.REACH
    assert turn.retry_of(Cause.NONE, Verdict.STUCK) is None


def test_hands_that_nobody_commands_open_only_where_the_table_says_so():
    assert row(Mode.FAILED).source("left_gripper") == OPEN and row(Mode.FAILED).source("left_arm") == HOLD
    assert row(Mode.DONE).source("left_gripper") == HOLD
    assert row(Mode.SERVO).source("left_gripper") == row(Mode.SERVO).source("right_arm") == "image_servo"
    assert owned("hybrid_rotation") == (Mode.GRASP, Mode.TURN, Mode.RELEASE)


def test_docs_have_the_table():
    """If this fails: put what modes.document() returns into docs/README.md."""
    assert document() in (ROOT / "docs" / "README.md").read_text(encoding="utf-8")


def test_perception_knows_no_mode():
    for path in SOURCES:
        if path.parent.name == "perception":
            assert not re.search(r"\bMode\b|ModeState\(|[\"'](search|measure|verify|turn)[\"']", path.read_text()), path


def test_no_other_table_lists_modes():
    """Three modes in one line are a table, but for what a behaviour does in each of those that it owns."""
    for path in SOURCES:
        if path.name in ("modes.py", "messages.py"):
            continue
        for line in path.read_text().splitlines():
            modes = {Mode[name] for name in re.findall(r"\bMode\.([A-Z_]+)", line)}
            own = len({TABLE[mode].owner for mode in modes}) == 1 and path.parent.name == "behaviors"
            assert len(modes) < 3 or own, f"{path.name}: {line.strip()}"
