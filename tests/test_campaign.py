"""campaign: no run is lost or counted twice, a crash is a failure, and the numbers say what may be said."""

import concurrent.futures
import csv
import functools
import io
import json
import math
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
import types
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from markupsafe import escape

from valve_drake import cli
from valve_drake.campaign import campaign, comparison, executors, failures, hunting, report, statistics, trial
from valve_drake.campaign.campaign import Campaign
from valve_drake.campaign.trial import Trial, perform, turned
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.recording.active import ActiveFile

# Stands for `valve-drake run`: it answers after a while, by its seed. It leaves a log, and a line of every run begun.
FAKE = """
import json, os, sys, time
words = sys.argv[1:]
seed, log = int(words[words.index("--seed") + 1]), words[words.index("--log") + 1]
with open(os.environ["BEGUN"], "a") as file:
    file.write(f"{seed}\\n")
with open(os.environ["BEGUN"] + ".pids", "a") as file:
    file.write(f"{os.getpid()}\\n")
with open(os.environ["BEGUN"] + ".parents", "a") as file:
    file.write(f"{os.getppid()}\\n")
time.sleep(float(os.environ.get("TAKES", "0")))
if seed == 13:
    sys.exit("segmentation fault, or so")
if seed == 14:
    time.sleep(60)
open(log, "wb").write(b"log")
good = seed % 10 != 7
numbers = {"outcome": "done" if good else "failed", "verdict": "turned" if good else "slip", "reason": "",
    "mode_durations_s": {"search": 1.0, "turn": 2.0, "done" if good else "failed": 0.1}, "sim_time_s": 60.0,
    "valve_angle_command_rad": 1.57, "valve_angle_true_rad": 1.56 if good else 0.5, "valve_angle_estimated_rad": 1.56,
    "contact_honesty": {"left": 0.99, "right": 0.97}, "slips": {"left": 0, "right": 1}, "collisions": 1,
    "peak_internal_force_N": 11.0, "estimator_nees": 0.8, "measured_position_rms_m": 0.002, "retries": 0,
    "turn_peak_hand_force_N": 20.0 + seed, "wall_time_s": time.time(), "processor_s": {"total": 30.0 + seed}}
print(json.dumps(numbers))
"""


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """The file of runs that were begun."""
    program = tmp_path / "fake.py"
    program.write_text(FAKE)
    monkeypatch.setattr(trial, "PROGRAM", (sys.executable, "-S", str(program)))
    monkeypatch.setenv("BEGUN", str(tmp_path / "begun"))
    return tmp_path / "begun"


def run(wanted: Campaign, jobs: int = 4, **options):
    with executors.executor("local", jobs) as pool:
        return campaign.run(wanted, pool, **options)


def wanted(out: Path, runs: int = 6, first: int = 1, **options) -> Campaign:
    return Campaign(("simulated.scenario.yaml",), runs, first, (), out, **options)


# ---------------------------------------------------------------- numbers


@pytest.mark.parametrize(
    "successes, trials, low, high",
    [
        (299, 299, 0.98774, 1.0),
        (256, 256, 0.98569, 1.0),
        (20, 20, 0.83157, 1.0),
        (19, 20, 0.75127, 0.99873),
        (0, 0, 0, 1),
    ],
)
def test_the_interval_is_clopper_and_pearsons(successes, trials, low, high):
    assert statistics.interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


def test_mcnemars_exact_test_looks_at_the_seeds_that_differ_only():
    assert statistics.mcnemar(0, 0) == 1.0
    assert statistics.mcnemar(6, 0) == pytest.approx(2 * 0.5**6)
    a, b = [True] * 50 + [False] * 6, [True] * 56
    found = statistics.compare(a, b)
    assert (found.both, found.better, found.worse, found.verdict) == (50, 6, 0, "better")
    assert statistics.compare(b, a).verdict == "worse"


def test_what_cannot_be_told_yet_says_how_many_runs_would_tell():
    found = statistics.compare([True] * 17 + [False] * 3, [True] * 20)
    assert found.verdict == "cannot tell yet" and found.p == 0.25
    assert 15 <= found.more <= 25  # six of a kind tell: twice as many runs
    assert statistics.compare([True, False], [False, True]).more is None


def test_differences_come_with_students_interval():
    found = statistics.difference([1.0, 2.0, 3.0, 4.0], [2.0, 3.0, 4.5, 4.5])
    assert found.mean == pytest.approx(1.0) and found.low == pytest.approx(0.3504, abs=1e-3)
    assert statistics.difference([1.0], [2.0]) is None


# ---------------------------------------------------------------- running


def test_every_trial_has_its_seed_its_draws_and_its_command(tmp_path):
    def trials_of():
        return [trial for batch in wanted(tmp_path, 3, 40).batches({}) for trial in batch]

    trials = trials_of()
    assert [t.seed for t in trials] == [40, 41, 42]
    assert trials[0].command() == ["valve-drake", "run", "simulated.scenario.yaml", "--seed", "40"]
    draws = [dict(t.draws) for t in trials]
    assert "simulation.valve.friction" in draws[0] and draws[0] != draws[1]
    assert draws == [dict(t.draws) for t in trials_of()]


def test_a_campaign_leaves_a_record_a_run_and_the_logs_of_failures(tmp_path, fake):
    records = run(wanted(tmp_path / "out", 6, 5))
    assert [r["seed"] for r in records] == [5, 6, 7, 8, 9, 10]
    assert [turned(r) for r in records] == [True, True, False, True, True, True]
    assert records[2]["mode"] == "turn" and records[2]["verdict"] == "slip"
    assert [path.name for path in (tmp_path / "out/logs").iterdir()] == ["simulated-7.mcap"]
    assert campaign.read_all(tmp_path / "out") == records
    numbers = campaign.summary(records)
    assert (numbers["runs"], numbers["turned"], numbers["processor_s_per_run"]) == (6, 5, pytest.approx(37.5))
    assert [(f["seed"], f["verdict"], f["mode"]) for f in numbers["failures"]] == [(7, "slip", "turn")]


@pytest.mark.parametrize("keep, kept", [("all", 3), ("failed", 1), ("none", 0)])
def test_logs_are_kept_as_asked(tmp_path, fake, keep, kept):
    run(wanted(tmp_path / "out", 3, 6, keep=keep))
    assert len(list((tmp_path / "out/logs").glob("*.mcap"))) == kept


@pytest.mark.system
def test_a_crash_and_a_time_out_are_failures_with_their_reason(tmp_path, fake):
    start = time.monotonic()
    crash, late = run(wanted(tmp_path / "out", 2, 13, time_out=2.0))
    assert time.monotonic() - start < 30, "a run that is late goes on"  # of the 60 s that it sleeps
    assert crash["outcome"] == "crashed" and "segmentation fault, or so" in crash["reason"]
    assert late["outcome"] == "timed_out" and late["reason"] == "not ended after 2 s"
    assert not turned(crash) and not turned(late)


def test_a_second_call_runs_nothing_again_and_more_runs_go_on(tmp_path, fake):
    first = run(wanted(tmp_path / "out", 4))
    lines = []
    again = run(wanted(tmp_path / "out", 6), say=lines.append)
    assert again[:4] == first and "4 of 6 runs are there already" in lines[0]
    assert sorted(map(int, fake.read_text().split())) == [1, 2, 3, 4, 5, 6]


def test_a_trial_finds_its_files_from_wherever_it_is_run(tmp_path, fake, monkeypatch):
    (tmp_path / "fake.py").write_text('open("mine.yaml").close()\n' + FAKE)
    (tmp_path / "here").mkdir()
    (tmp_path / "here/mine.yaml").write_text("command: open\n")
    monkeypatch.chdir(tmp_path / "here")
    ((one,),) = Campaign(("mine.yaml",), 1, 1, (), tmp_path / "out").batches({})
    (tmp_path / "out/logs").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)  # as a worker of Dask, which was started elsewhere
    assert turned(perform(one))


@pytest.mark.system
def test_records_are_equal_but_for_their_times(tmp_path, fake):
    a, b = run(wanted(tmp_path / "a")), run(wanted(tmp_path / "b"), jobs=1)
    assert [r | {"times": 0} for r in a] == [r | {"times": 0} for r in b]


@pytest.mark.system
def test_jobs_run_at_the_same_time(tmp_path, fake, monkeypatch):
    monkeypatch.setenv("TAKES", "1")
    start = time.monotonic()
    run(wanted(tmp_path / "out", 4), jobs=4)
    assert time.monotonic() - start < 3.5


KILLED = """
import sys
from pathlib import Path
from valve_drake.campaign import campaign, executors, trial
trial.PROGRAM = (sys.executable, "-S", {program!r})
with executors.executor("local", 2) as pool:
    campaign.run(campaign.Campaign(("simulated.scenario.yaml",), 12, 1, (), Path({out!r})), pool)
"""


@pytest.mark.system
def test_killed_five_times_and_resumed_no_run_is_lost_or_counted_twice(tmp_path, fake, monkeypatch):
    monkeypatch.setenv("TAKES", "0.1")
    out = tmp_path / "out"
    script = KILLED.format(program=str(tmp_path / "fake.py"), out=str(out))
    counts = []
    for _ in range(5):
        process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)])
        before = len(list((out / "records").glob("*.json"))) if out.exists() else 0
        deadline = time.monotonic() + 30
        while len(list((out / "records").glob("*.json"))) <= before and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        counts.append(len(campaign.read_all(out)))
    assert counts == sorted(counts) and counts[-1] < 12
    time.sleep(0.5)  # runs of a killed campaign die with it
    begun = len(fake.read_text().split())
    time.sleep(0.5)
    assert len(fake.read_text().split()) == begun
    records = run(wanted(out, 12))
    assert [r["seed"] for r in records] == list(range(1, 13)) == [r["seed"] for r in campaign.read_all(out)]


def test_a_trial_that_its_executor_loses_is_one_line_and_is_run_by_the_next_call(tmp_path, fake, monkeypatch):
    def lost(one):
        raise RuntimeError("worker died\nand more")

    monkeypatch.setattr(campaign, "perform", lost)
    with pytest.raises(OperationFailed, match="^campaign: simulated-1 was lost: worker died$"):
        run(wanted(tmp_path / "out", 1))
    monkeypatch.setattr(campaign, "perform", perform)
    assert [r["seed"] for r in run(wanted(tmp_path / "out", 1))] == [1]


HALF = '{"scenario": "simulated", "seed": 1, "outcome": "done"}'


@pytest.mark.parametrize("text", ["", "[]", "{}", "[" * 100_000, HALF, HALF.replace("1", "2")])
def test_a_file_that_is_not_the_record_is_one_line_that_names_it(tmp_path, fake, text):
    run(wanted(tmp_path / "out", 1))
    path = tmp_path / "out/records/simulated-1.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match="simulated-1.json: not .* remove it, and the trial is run again"):
        run(wanted(tmp_path / "out", 1))


WHOLE = {"scenario": "s", "seed": 1, "outcome": "done", "verdict": "turned", "reason": "", "mode": "turn"}
WHOLE |= {"draws": {"a": 1.0}, "times": {}}


def folder(out: Path, *records: object, plan: object = None) -> str:
    """A campaign's folder with these records; text stands for itself."""
    (out / "records").mkdir(parents=True)
    for k, one in enumerate((plan or {"scenarios": {}, "versions": {}}, *records)):
        path = out / (f"records/{k}.json" if k else "campaign.json")
        path.write_text(one if isinstance(one, str) else json.dumps(one))
    return str(out)


@pytest.mark.parametrize(
    "change",
    [
        {"seed": "a"},
        {"times": None},
        {"times": {"processor_s": 3}},
        {"verdict": None},
        {"draws": []},
        {"draws": {"a": "low"}},
        {"contact_honesty": {"left": None, "right": 1.0}},
        {"slips": 3},
        {"estimator_nees": "0.8"},
        {"retries": 10**400},
        {"command": 7},
    ],
)
def test_a_record_that_is_damaged_within_is_one_line_that_names_it(tmp_path, capsys, change):
    wrong = folder(tmp_path / "out", WHOLE, WHOLE | {"seed": 2} | change)
    for words in (["runs", wrong], ["campaign", "compare", wrong, wrong]):
        assert cli.main(words) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and "records/2.json: not a record of a campaign" in lines[0]


@pytest.mark.parametrize("plan", ["[" * 100_000, "3", '{"scenarios": {}, "versions": []}'])
def test_a_damaged_plan_is_one_line(tmp_path, capsys, plan):
    wrong = folder(tmp_path / "out", WHOLE, plan=plan)
    for words in (["runs", wrong], ["campaign", "--runs", "1", "--out", wrong]):
        assert cli.main(words) == 2
        assert "out: not the folder of a campaign (campaign.json is damaged)" in capsys.readouterr().err


def test_numbers_that_are_none_are_not_known_and_no_json_has_them(tmp_path, capsys):
    values = {"valve_angle_true_rad": math.nan, "valve_angle_command_rad": 1.0, "estimator_nees": math.inf}
    one = folder(tmp_path / "out", WHOLE | values, WHOLE | {"seed": 2})
    assert cli.main(["runs", one, "--html", str(tmp_path / "page.html"), "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))
    assert numbers["runs"] == 2 and numbers["verdicts_against_truth"]["known"] == 0
    assert not {"nan", "inf"} & set((tmp_path / "page.html").read_text().lower().replace("<", ">").split(">"))


def test_figures_that_differ_by_rounding_only_have_a_distribution(tmp_path):
    shares = [1.0, 0.9999999999999999, 0.9999999999999998]
    rows = [WHOLE | {"seed": k, "contact_honesty": {"left": 1.0, "right": share}} for k, share in enumerate(shares)]
    page = report.page(rows, tmp_path)
    assert page.count("<title>held by both pads, worse hand [%]</title>") == 2


def test_a_page_elsewhere_leads_to_the_logs_and_reviews_whatever_they_are_called(tmp_path, capsys):
    logs = [WHOLE | {"seed": 1, "log": "logs/50% #1?-1.mcap"}, WHOLE | {"seed": 2, "log": "logs/a-2.mcap"}]
    out = Path(folder(tmp_path / "out", *logs))
    (out / "logs").mkdir()
    (out / "logs/a-2.review.html").touch()
    for html in (out / "page.html", tmp_path / "page.html"):
        assert cli.main(["runs", str(out), "--html", str(html)]) == 0
        links = re.findall(r'href="([^"]*)"', html.read_text())
        there = [str((html.parent / unquote(link)).relative_to(out)) for link in links]
        assert there == ["logs/50% #1?-1.mcap", "logs/a-2.review.html"] and not any(set("#?") & set(x) for x in links)


# Stands for a run that is killed in the midst of its log; of another one, it takes the next free name, as logs do.
LOGGED = """
import json, os, signal, sys
from pathlib import Path
words = sys.argv[1:]
seed, log = int(words[words.index("--seed") + 1]), Path(words[words.index("--log") + 1])
if Path(f"{log}.active").exists():
    log = log.with_name(f"{log.stem}-2.mcap")
Path(f"{log}.active").write_bytes(b"half")
if seed == 7:
    os.kill(os.getpid(), signal.SIGKILL)
os.replace(f"{log}.active", log)
log.with_suffix(".json").write_text("{}")
numbers = {"outcome": "done" if seed != 8 else "failed", "verdict": "turned", "reason": "", "log": str(log)}
numbers |= {"mode_durations_s": {"measure": 1.0, "turn": 2.0}, "last_mode": "measure"}
print(json.dumps(numbers))
"""


@pytest.mark.parametrize(
    "keep, kept",
    [
        ("all", ["simulated-6.mcap", "simulated-7.mcap.active", "simulated-8.mcap"]),
        ("failed", ["simulated-7.mcap.active", "simulated-8.mcap"]),
        ("none", []),
    ],
)
def test_what_a_killed_run_has_logged_is_kept_as_other_logs_and_is_in_nobodys_way(tmp_path, monkeypatch, keep, kept):
    program = tmp_path / "logged.py"
    program.write_text(LOGGED)
    monkeypatch.setattr(trial, "PROGRAM", (sys.executable, "-S", str(program)))
    logs = tmp_path / "out/logs"
    run(wanted(tmp_path / "out", 1, 6, keep="none"))
    (tmp_path / "out/records/simulated-6.json").unlink()
    for seed in (6, 8):  # the campaign was killed before these had ended
        (logs / f"simulated-{seed}.mcap.active").write_bytes(b"old")
    records = run(wanted(tmp_path / "out", 3, 6, keep=keep))
    assert sorted(path.name for path in logs.iterdir() if path.suffix != ".json") == kept
    assert [r["log"] for r in records if r["log"]] == [f"logs/{name}" for name in kept]
    assert records[1]["outcome"] == "crashed" and "exit code -9" in records[1]["reason"]
    assert (
        records[0]["mode"] == "measure"
    )  # where it ended, which is not the one that it entered last for the first time
    assert keep != "none" or list(logs.iterdir()) == []


def test_a_trial_whose_log_another_run_still_writes_has_its_own_log(tmp_path, monkeypatch):
    program = tmp_path / "logged.py"
    program.write_text(LOGGED)
    monkeypatch.setattr(trial, "PROGRAM", (sys.executable, "-S", str(program)))
    run(wanted(tmp_path / "out", 1, 8, keep="none"))
    (tmp_path / "out/records/simulated-8.json").unlink()
    under_way = ActiveFile(tmp_path / "out/logs/simulated-8.mcap")
    (record,) = run(wanted(tmp_path / "out", 1, 8))
    assert record["log"] == "logs/simulated-8-2.mcap" and (tmp_path / "out" / record["log"]).exists()
    assert under_way.where() is not None
    under_way.discard()


@pytest.mark.system
def test_the_runs_of_a_campaign_that_is_killed_die_with_it(tmp_path, fake, monkeypatch):
    monkeypatch.setenv("TAKES", "60")
    script = KILLED.format(program=str(tmp_path / "fake.py"), out=str(tmp_path / "out"))
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)])
    pids = tmp_path / "begun.pids"
    deadline = time.monotonic() + 30
    while not (pids.exists() and len(pids.read_text().split()) == 2) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    runs = [Path("/proc") / pid / "cmdline" for pid in pids.read_text().split()]
    assert len(runs) == 2
    deadline = time.monotonic() + 10
    while any(run.exists() and run.read_bytes() for run in runs):  # an orphan that is dead may wait to be reaped
        assert time.monotonic() < deadline, "a run goes on without its campaign"
        time.sleep(0.02)


def test_an_interrupt_ends_the_runs_that_are_under_way(tmp_path, fake, monkeypatch):
    monkeypatch.setenv("TAKES", "20")

    def interrupt(progress):
        raise KeyboardInterrupt

    start = time.monotonic()
    monkeypatch.setattr(campaign.concurrent.futures, "wait", lambda *a, **k: interrupt(None))
    with pytest.raises(KeyboardInterrupt):
        run(wanted(tmp_path / "out", 4))
    assert time.monotonic() - start < 10 and campaign.read_all(tmp_path / "out") == []


# ---------------------------------------------------------------- hunting

# Stands for a program that fails where friction is high and the valve low, and is close to it round there.
EDGE = """
import json, sys
words = sys.argv[1:]
draws = dict(w.split("=") for w in words if w.startswith("simulation."))
seed, log = int(words[words.index("--seed") + 1]), words[words.index("--log") + 1]
high = (float(draws["simulation.valve.friction"]) - 2.5) / 4.8
low = (1.22 - float(draws["simulation.valve.height"])) / 0.41
far = max(1 - high, 1 - low)
open(log, "wb").write(b"log")
good = far > 0.2
numbers = {"outcome": "done" if good else "failed", "verdict": "turned" if good else "stuck", "reason": "",
    "mode_durations_s": {"turn": 2.0}, "turn_peak_hand_force_N": 55 * (1 - far), "processor_s": {"total": 1.0}}
print(json.dumps(numbers))
"""


@pytest.fixture
def edge(tmp_path, monkeypatch):
    program = tmp_path / "edge.py"
    program.write_text(EDGE)
    monkeypatch.setattr(trial, "PROGRAM", (sys.executable, "-S", str(program)))


@pytest.mark.system
def test_a_hunt_finds_the_corner_where_runs_fail(tmp_path, edge):
    records = run(wanted(tmp_path / "out", 48, hunt=True))
    failed = [k for k, record in enumerate(records) if not turned(record)]
    assert len(failed) >= 8  # 4 % of the room: even draws would find two
    assert sum(k >= 24 for k in failed) > sum(k < 24 for k in failed)
    assert records[0]["command"][-1].startswith("simulation.")  # says its draws, to be run again
    draws = records[failed[0]]["draws"]
    assert f"simulation.valve.friction={draws['simulation.valve.friction']!r}" in records[failed[0]]["command"]


@pytest.mark.system
def test_a_hunt_that_is_broken_off_goes_on_as_it_would_have_gone(tmp_path, edge):
    whole = run(wanted(tmp_path / "whole", 20, hunt=True))
    run(wanted(tmp_path / "parts", 11, hunt=True))
    (tmp_path / "parts/records/simulated-3.json").unlink()
    parts = run(wanted(tmp_path / "parts", 20, hunt=True), jobs=1)
    assert [r | {"times": 0} for r in parts] == [r | {"times": 0} for r in whole]
    other = run(wanted(tmp_path / "other", 8, first=50, hunt=True))
    assert other[0]["draws"] != whole[0]["draws"]


def test_hunts_and_campaigns_do_not_share_a_folder_and_a_hunt_needs_a_distribution(tmp_path, edge):
    run(wanted(tmp_path / "out", 2, hunt=True))
    with pytest.raises(ConfigError, match=r"holds a campaign of other draws \(--hunt\)"):
        run(wanted(tmp_path / "out", 2))
    plain = tmp_path / "plain.yaml"
    plain.write_text("command: open\n")
    with pytest.raises(ConfigError, match="nothing to hunt in"):
        campaign.Campaign((str(plain),), 2, 1, (), tmp_path / "none", hunt=True).check()


def test_proposals_stay_within_the_ranges_and_explore():
    seen = [(np.array([0.99, 0.01]), 0.0)] * 4 + [(np.array([0.5, 0.5]), 1.0)] * 16
    found = np.concatenate([hunting.propose(seen, 8, 2, 1, k) for k in range(30)])
    assert found.min() >= 0 and found.max() <= 1
    near = np.abs(found - [0.99, 0.01]).max(axis=1) < 0.1
    assert 0.55 < near.mean() < 0.8


@pytest.mark.parametrize(
    "change, left",
    [
        ({}, 1.0),
        ({"outcome": "failed"}, 0.0),
        ({"valve_angle_true_rad": 1.0 + math.radians(1.5)}, 0.5),
        ({"contact_honesty": {"left": 1.0, "right": 0.96}}, 0.2),
        ({"turn_peak_hand_force_N": 44.0}, 0.2),
        ({"retries": 9}, 0.0),
    ],
)
def test_a_runs_margin_is_what_its_worst_figure_leaves(change, left):
    record = {"outcome": "done", "verdict": "turned", "valve_angle_command_rad": 1.0, "valve_angle_true_rad": 1.0}
    assert hunting.margin(record | change) == pytest.approx(left)


@pytest.mark.system
def test_failures_are_a_list_that_is_run_again(tmp_path, edge, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["campaign", "--hunt", "--runs", "32", "--out", "hunt", "--jobs", "4", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["failures"]
    entries = failures.read(Path("hunt/failures.yaml"))
    assert [entry.seed for entry in entries] == [row["seed"] for row in found] and len(entries) > 2
    assert all(entry.ended.startswith("stuck in turn") for entry in entries)
    assert cli.main(["campaign", "--again", "hunt/failures.yaml", "--runs", "2", "--out", "again", "--json"]) == 1
    numbers = json.loads(capsys.readouterr().out)
    assert (numbers["runs"], numbers["turned"]) == (2, 0)
    assert [row["seed"] for row in numbers["failures"]] == [row["seed"] for row in found[:2]]
    (tmp_path / "edge.py").write_text(EDGE.replace("far > 0.2", "True"))  # mended
    assert cli.main(["campaign", "--again", "hunt/failures.yaml", "--runs", "2", "--out", "mended", "--json"]) == 0


@pytest.mark.system
def test_a_long_list_of_a_hunts_failures_can_be_read(tmp_path):
    draws = [word for k in range(14) for word in ("--set", f"simulation.valve.of_a_long_name_{k}=1.2345678901234567")]
    record = WHOLE | {"verdict": "slip", "reason": "why" * 20, "command": ["valve-drake", "run", "a #1.yaml", *draws]}
    failures.write(tmp_path / "list.yaml", [record | {"seed": k} for k in range(2000)])
    entries = failures.read(tmp_path / "list.yaml")
    assert len(entries) == 2000 and len(entries[-1].set) == 14 and entries[-1].scenario == "a #1.yaml"


def listed(path: Path, *seeds: int) -> str:
    path.write_text("failures: [" + ", ".join(f"{{seed: {seed}}}" for seed in seeds) + "]")
    return str(path)


@pytest.mark.system
def test_failures_run_again_at_the_same_time_and_more_of_a_list_go_on(tmp_path, fake, monkeypatch, capsys):
    monkeypatch.setenv("TAKES", "1")
    monkeypatch.chdir(tmp_path)
    words = ["campaign", "--again", listed(tmp_path / "list.yaml", 3, 4, 5, 6), "--jobs", "4", "--json", "--out", "out"]
    start = time.monotonic()
    assert cli.main([*words, "--runs", "3"]) == 0
    assert time.monotonic() - start < 2.9, "one after the other"
    capsys.readouterr()
    assert cli.main(words) == 0
    out = capsys.readouterr()
    assert json.loads(out.out)["runs"] == 4 and out.err.count("3 of 4 runs are there already") == 1
    assert cli.main([*words, "--runs", "2"]) == 0  # of them
    assert sorted(fake.read_text().split()) == ["3", "4", "5", "6"]
    listed(tmp_path / "list.yaml", 3, 4, 8)
    capsys.readouterr()
    assert cli.main(words) == 2
    assert "holds a campaign of other seeds" in capsys.readouterr().err
    assert len(campaign.plan(Path("out"))["scenarios"]) == 4


def test_the_list_that_ci_repeats_can_be_run(tmp_path):
    entries = failures.read(Path(__file__).with_name("failures.yaml"))
    assert len(entries) >= 2
    campaign.Campaign(("again",), 1, 1, (), tmp_path, again=entries).check()


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "not a list of failures"),
        ("failures: []", "not a list of failures"),
        ("failures: [{seed: -1}]", "failures[0].seed must be within"),
        ("failures: [{seed: 1, sed: []}]", "sed"),
        ("failures: [{seed: 1, set: [what]}]", "--set must be key=value"),
        ("failures: [{scenario: none.yaml}]", "none.yaml"),
    ],
)
def test_a_wrong_list_of_failures_is_one_line(tmp_path, monkeypatch, capsys, text, words):
    monkeypatch.chdir(tmp_path)
    Path("list.yaml").write_text(text)
    assert cli.main(["campaign", "--again", "list.yaml"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and words in lines[0], lines
    assert [path.name for path in tmp_path.iterdir()] == ["list.yaml"]


# ---------------------------------------------------------------- refusals


def test_a_folder_of_another_campaign_is_refused(tmp_path, fake):
    run(wanted(tmp_path / "out", 1))
    with pytest.raises(ConfigError, match="holds a campaign of other first seed"):
        run(wanted(tmp_path / "out", 1, 2))
    plan = json.loads((tmp_path / "out/campaign.json").read_text())
    plan["versions"]["numpy"] = "1.0"
    (tmp_path / "out/campaign.json").write_text(json.dumps(plan))
    with pytest.raises(ConfigError, match=r"records of another program \(numpy 1.0 -> "):
        run(wanted(tmp_path / "out", 1))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("mine")
    with pytest.raises(ConfigError, match="--out must be a new folder or that of a campaign"):
        run(wanted(tmp_path / "mine", 1))


def test_two_campaigns_do_not_share_a_folder(tmp_path, fake):
    pool = concurrent.futures.ThreadPoolExecutor(1)

    def second(progress):
        with pytest.raises(ConfigError, match="a campaign is under way there"):
            campaign.run(wanted(tmp_path / "out", 1), pool)

    run(wanted(tmp_path / "out", 1), show=second)


@pytest.mark.parametrize(
    "words, error",
    [
        (["--runs", "0"], "--runs must be within 1 and 100000, got 0"),
        (["--first-seed", "-1"], "--first-seed must be 0 or more"),
        (["--jobs", "0"], "--jobs must be within 1 and 1024, got 0"),
        (["--scheduler", "tcp://x"], "--scheduler goes with --backend dask"),
        (["--set", "operator_channel.wire=lcm"], "operator_channel.wire must be none in a campaign"),
        (["simulated.scenario.yaml", "simulated"], "two scenarios are called simulated"),
        (["nothing.yaml"], "nothing.yaml"),
        (["--set", "station=replay"], "station must be one that runs (a log is replayed by `replay LOG`), got"),
        (["--set", "robot=nothing.yaml"], "no such file: nothing.yaml"),
        (["--set", "head_calibration=robot/robot.yaml"], "robot.yaml lacks X_LR"),
        (["--set", "valve.model=nothing.sdf"], "valve.model: no such file: nothing.sdf"),
        (["--time-out", "0"], "--time-out must be above 0"),
        (["--time-out", "inf"], "--time-out must be above 0 s and at most 1e+06 s, got inf"),
        (["--time-out", "nan"], "--time-out must be above 0"),
        (["--out", "/dev/null"], "--out must be a new folder or that of a campaign, got '/dev/null'"),
        (["compare", "a", "b", "--hunt"], "campaign compare takes no --hunt: its runs have been made"),
        (["compare", "a", "b", "--first-seed", "3"], "campaign compare takes no --first-seed"),
        (["--again", "a.yaml", "--hunt"], "--again goes with no scenario and no --hunt"),
        (["--again", "a.yaml"], "a.yaml"),
        (["compare", "a"], "campaign compare takes the folders of two campaigns, got 1"),
        (["compare", "a", "b"], "a: not the folder of a campaign"),
    ],
)
def test_wrong_arguments_are_one_line(tmp_path, monkeypatch, capsys, words, error):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["campaign", *words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and error in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_compare_pairs_no_runs_that_have_nothing_in_common(tmp_path):
    one, two = folder(tmp_path / "one", WHOLE), folder(tmp_path / "two", WHOLE | {"scenario": "t"})
    assert comparison.compare(Path(one), Path(two))["pairs"] == 1  # another name, the same seed
    both = folder(tmp_path / "both", WHOLE | {"scenario": "u"}, WHOLE | {"scenario": "v"})
    with pytest.raises(ConfigError, match="have no run in common, and .*both has 2 scenarios"):
        comparison.compare(Path(one), Path(both))
    hunted = folder(tmp_path / "hunt", WHOLE, plan={"scenarios": {}, "versions": {}, "hunt": True})
    with pytest.raises(ConfigError, match="hunt is a hunt"):
        comparison.compare(Path(one), Path(hunted))


# ---------------------------------------------------------------- pages and comparison


def test_the_command_prints_the_numbers_and_writes_page_and_table(tmp_path, fake, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["campaign", "--runs", "3", "--first-seed", "6", "--out", "out", "--json"]) == 1  # seed 7 fails
    numbers = json.loads(capsys.readouterr().out)
    assert (numbers["runs"], numbers["turned"]) == (3, 2)
    page = (tmp_path / "out/report.html").read_text()
    assert "2 of 3 turned" in page and "<b>0 + 0</b>" in page and ", of 3</span>" in page
    assert "--seed 7" in page and "simulated-7.mcap" in page
    rows = (tmp_path / "out/runs.csv").read_text().splitlines()
    assert len(rows) == 4 and rows[0].startswith("scenario,seed,outcome,verdict,mode,reason,")
    assert cli.main(["runs", "out", "--json"]) == 0


@pytest.mark.system
def test_compare_pairs_the_seeds_of_two_campaigns(tmp_path, fake):
    run(wanted(tmp_path / "a", 10, 1))
    run(wanted(tmp_path / "b", 8, 5))
    found = comparison.compare(tmp_path / "a", tmp_path / "b")
    assert (found["pairs"], found["turned_a"], found["turned_b"], found["better"], found["worse"]) == (6, 5, 5, 0, 0)
    assert found["differences"]["turn_peak_hand_force_N"]["mean"] == 0.0
    run(wanted(tmp_path / "c", 1, 100))
    with pytest.raises(ConfigError, match="have no seed in common"):
        comparison.compare(tmp_path / "a", tmp_path / "c")


def test_the_report_holds_the_verdict_against_the_truth(tmp_path, fake):
    records = run(wanted(tmp_path / "out", 3, 6))

    def counts():
        found = campaign.false_verdicts(records)
        return found["known"], found["false_turned"], found["false_failure"], [seed for _, seed, _ in found["seeds"]]

    assert counts() == (3, 0, 0, [])
    records[0]["valve_angle_true_rad"] = 1.0  # it says turned, and is not
    records[1]["valve_angle_true_rad"] = 1.57  # it says slip, and is turned
    assert counts() == (3, 1, 1, [6, 7])
    found = campaign.summary(records)["verdicts_against_truth"]
    assert found["false_turned_interval_95"] == pytest.approx([0.0084, 0.9057], abs=1e-3)
    page = report.page(records, tmp_path)
    assert "<b>1 + 1</b>" in page and "seed 6: false turned" in page and "seed 7: false failure" in page
    assert "could not say" not in page
    records[1]["verdict"] = "unverified"  # neither turned nor not turned is claimed
    assert counts() == (2, 1, 0, [6])
    found = campaign.summary(records)["verdicts_against_truth"]
    assert (found["unverified"], found["unverified_but_turned"]) == (1, 1)
    page = report.page(records, tmp_path)
    assert "1 <code>unverified</code> besides: the camera could not say. 1 of these valves" in page
    assert "could not say" in report.page(records[1:2], tmp_path)


def test_records_and_page_have_contact_honesty_collisions_and_the_estimators_consistency(tmp_path, fake):
    records = run(wanted(tmp_path / "out", 3, 8))
    assert records[0]["contact_honesty"] == {"left": 0.99, "right": 0.97} and records[0]["estimator_nees"] == 0.8
    numbers = campaign.summary(records)
    assert (numbers["contact_honesty_least"], numbers["collisions"]) == (0.97, 3)
    rows = list(csv.DictReader(io.StringIO(report.table(records))))
    assert rows[0]["held by both pads, worse hand [%]"] == "97.0" and rows[0]["estimator's NEES at rest"] == "0.8"
    page = report.page(records, tmp_path)
    assert "97.0 %" in page and "3 collisions in all" in page


def test_every_figure_and_the_success_stand_against_every_drawn_value(tmp_path, fake):
    records = run(wanted(tmp_path / "out", 12, 1))
    page = report.page(records, tmp_path)
    for key in records[0]["draws"]:
        assert f"<summary>{key}</summary>" in page
        assert page.count(f"<title>{key}</title>") == 1  # the share that turned
    known = [title for title, figure in report.FIGURES.items() if figure(records[0]) is not None]
    assert len(known) > 8
    for title in known:  # its distribution, and one plot for each drawn value
        assert page.count(f"<title>{escape(title)}</title>") == 1 + len(records[0]["draws"])


def test_a_page_of_300_runs_stays_small(tmp_path, fake):
    records = run(wanted(tmp_path / "out", 2, 8))
    many = [
        records[0] | {"seed": k, "draws": {key: v * k for key, v in records[0]["draws"].items()}} for k in range(300)
    ]
    page = report.page(many, tmp_path)
    assert len(page) < 2_500_000 and page.count("<") < 30_000  # elements: what a browser takes its time for


# ---------------------------------------------------------------- the sequential test


def test_without_its_package_compare_says_how_to_get_the_sequential_test(tmp_path, fake, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sequentialized_barnard_tests", None)
    for name in "ab":
        run(wanted(tmp_path / name, 3))
    assert cli.main(["campaign", "compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    assert "pip install 'valve-drake[step]'" in " ".join(capsys.readouterr().out.split())
    assert comparison.compare(tmp_path / "a", tmp_path / "b")["step"] is None


def test_the_sequential_test_tells_a_great_difference_early_and_none_never():
    pytest.importorskip("sequentialized_barnard_tests")
    good, bad = [True] * 60, [k % 2 == 0 for k in range(60)]
    assert (found := statistics.sequential(bad, good)).verdict == "better" and found.pairs < 40
    assert statistics.sequential(good, bad).verdict == "worse"
    assert statistics.sequential(good, good) == statistics.Sequential("cannot tell yet", 60, None)
    few = statistics.sequential(bad[:6], good[:6])
    assert few.verdict == "cannot tell yet" and 0 < few.more < 60
    assert statistics.sequential([], []).verdict == "cannot tell yet"


@pytest.mark.parametrize(
    "error, words", [(TypeError("no ssl_context\nat all"), "no ssl_context"), (TimeoutError(), "TimeoutError")]
)
def test_whatever_dask_raises_is_one_line(tmp_path, monkeypatch, capsys, error, words):
    def client(*args, **options):
        raise error

    monkeypatch.setitem(sys.modules, "distributed", types.SimpleNamespace(Client=client))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["campaign", "--runs", "1", "--backend", "dask", "--scheduler", "tls://x:1"]) == 1
    assert capsys.readouterr().err == f"valve-drake: Dask does not answer at 'tls://x:1': {words}\n"
    assert list(tmp_path.iterdir()) == []


def test_dask_gives_the_same_records(tmp_path, fake, monkeypatch):
    pytest.importorskip("distributed")
    local = run(wanted(tmp_path / "a", 4))
    monkeypatch.setenv("DASK_DISTRIBUTED__WORKER__DAEMON", "False")
    trials = wanted(tmp_path / "b", 4)
    with executors.executor("dask", 2) as pool:
        # Workers are processes of their own: the stand-in goes with the trial's function.
        program = trial.PROGRAM
        monkeypatch.setattr(campaign, "perform", lambda t: _performed(t, program))
        there = campaign.run(trials, pool)
    strip = [[r | {"times": 0} for r in records] for records in (local, there)]
    assert strip[0] == strip[1]


@pytest.fixture
def workers(tmp_path, fake):
    """A scheduler and two workers, each a process of its own on this machine: its address, the workers."""
    pytest.importorskip("distributed")
    address = tmp_path / "scheduler.json"
    here = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}  # of the stand-in
    programs = [["dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]]
    programs += [["dask_worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny", "--no-dashboard"]] * 2
    started = []
    try:
        for name, *options in programs:
            words = [sys.executable, "-m", f"distributed.cli.{name}", *options, "--scheduler-file", str(address)]
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            started.append(subprocess.Popen(words, env=os.environ | here, cwd=tmp_path, **quiet))
            deadline = time.monotonic() + 60
            while not address.exists() and time.monotonic() < deadline:
                time.sleep(0.05)
        yield json.loads(address.read_text())["address"], started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_a_scheduler_and_two_workers_as_processes_of_their_own_give_the_same_records(
    tmp_path, fake, workers, monkeypatch
):
    address, processes = workers
    local = run(wanted(tmp_path / "a", 8))
    program = trial.PROGRAM
    monkeypatch.setattr(campaign, "perform", lambda t: _performed(t, program))
    (fake.with_name("begun.parents")).unlink()
    with executors.executor("dask", 1, address) as pool:
        pool._client.wait_for_workers(2, timeout=60)
        there = campaign.run(wanted(tmp_path / "b", 8), pool)
    assert [r | {"times": 0} for r in there] == [r | {"times": 0} for r in local]
    assert {int(pid) for pid in fake.with_name("begun.parents").read_text().split()} == {p.pid for p in processes}


def test_a_worker_that_dies_loses_no_run(tmp_path, fake, workers, monkeypatch):
    address, processes = workers
    monkeypatch.setattr(campaign, "perform", functools.partial(_performed, program=trial.PROGRAM))

    def show(progress):
        if progress.done == 2:
            processes[0].kill()

    with executors.executor("dask", 1, address) as pool:
        pool._client.wait_for_workers(2, timeout=60)
        records = campaign.run(wanted(tmp_path / "out", 8), pool, show)
    assert [r["seed"] for r in records] == list(range(1, 9))
    assert [turned(r) for r in records] == [k != 7 for k in range(1, 9)]


def _performed(one: Trial, program: tuple[str, ...]):
    trial.PROGRAM = program
    return perform(one)
