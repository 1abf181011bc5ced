"""A campaign: trials in a folder, one record a trial, that can be broken off at any time and goes on where it was.

    OUT/campaign.json           what is run: scenarios, first seed, overrides, versions
    OUT/records/NAME-SEED.json  one record a trial, written whole or not at all
    OUT/logs/NAME-SEED.mcap     the logs that are kept

A trial without a record has not been run: it is run again from its beginning, so that none is lost and none counts
twice. A campaign may choose what is drawn itself (`hunt`), or run a list of failures again. Where the trials run is an
executor's matter: threads that wait for processes here, or workers of Dask.
"""

import concurrent.futures
import contextlib
import dataclasses as dc
import fcntl
import itertools
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import config, named_files, outputs, scenario
from valve_drake.analysis.metrics import Summary, figures
from valve_drake.camera.lens import load_head
from valve_drake.campaign import hunting
from valve_drake.campaign.failures import Failure
from valve_drake.campaign.statistics import interval
from valve_drake.campaign.trial import AT_ANGLE, Record, Trial, files_of, perform, turned
from valve_drake.checks import ConfigError, OperationFailed, is_number, require, shown
from valve_drake.config import Uniform
from valve_drake.diagram import robot_of
from valve_drake.messages import Verdict
from valve_drake.versions import versions

PLAN, RECORDS, LOGS = "campaign.json", "records", "logs"
SAMPLE = 50  # of the turned runs, the log of every so many'th seed is kept as well, unless none are
MOST = 100_000  # runs of one campaign
MANY = 256  # trials that wait for an executor at a time
_FIGURES = figures(Summary()).keys() - {"contact_honesty", "slips", "collided"}  # of a record, that are one number
LATEST = 1e6  # that a run may take, by the wall's clock [s]


@dc.dataclass(frozen=True)
class Campaign:
    """What is run. scenarios: names or files, each with seeds first_seed .. first_seed + runs - 1.

    hunt: draws are chosen where failures are likely (hunting.py), instead of by the seeds. again: failures that are run
    again, in place of scenarios and seeds.
    """

    scenarios: tuple[str, ...]
    runs: int
    first_seed: int
    overrides: tuple[str, ...]
    out: Path
    keep: str = "failed"
    time_out: float = 900.0  # of one run, by the wall's clock [s]
    hunt: bool = False
    again: tuple[Failure, ...] = ()

    @property
    def total(self) -> int:
        return len(self.again) or len(self.scenarios) * self.runs

    @property
    def named(self) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Name of each scenario -> its file, overrides. Raises ConfigError for two with one name."""
        if self.again:
            return {
                f"{name_of(entry.scenario)}.{k}": (entry.scenario, (*entry.set, *self.overrides))
                for k, entry in enumerate(self.again)
            }
        names = [name_of(path) for path in self.scenarios]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ConfigError(f"campaign: two scenarios are called {twice}: their records would be one")
        return {name: (path, self.overrides) for name, path in zip(names, self.scenarios)}

    def check(self) -> None:
        """Raises ConfigError: numbers out of range, a scenario or robot that no run can use, two with one name,
        nothing to hunt in.
        """
        require(1 <= self.runs <= MOST, "--runs", f"within 1 and {MOST}", self.runs)
        last = self.first_seed + self.runs - 1
        require(
            0 <= self.first_seed and last < 2**31, "--first-seed", "0 or more, the last below 2^31", self.first_seed
        )
        require(0 < self.time_out <= LATEST, "--time-out", f"above 0 s and at most {LATEST:g} s", self.time_out)
        for path, overrides in self.named.values():
            given = scenario.load(path, overrides)
            wire = given.operator_channel.wire
            require(wire == "none", "operator_channel.wire", "none in a campaign: its runs wait for nobody", wire)
            require(given.station != "replay", "station", "one that runs (a log is replayed by `replay LOG`)", "replay")
            robot_of(given)
            load_head(named_files.find(given, "head_calibration"))
            if self.hunt and not _ranges(given):
                raise ConfigError(f"{path}: there is nothing to hunt in: no key has a distribution")

    def batches(self, records: Mapping[str, Record]) -> Iterator[list[Trial]]:
        """All trials in their order, a batch at a time; of a hunt, each by the records of those before it.

        records: by the trials' keys, filled in between the batches. Raises ConfigError as `check` does.
        """
        self.check()
        known: list[Trial] = []  # without looking at records
        for (name, (path, overrides)), entry in itertools.zip_longest(self.named.items(), self.again):
            given = scenario.load(path, overrides)
            if self.hunt:
                yield from self._hunted(name, path, given, records)
            else:
                seeds = range(self.first_seed, self.first_seed + self.runs) if entry is None else (entry.seed,)
                known += [self._trial(name, path, given, seed, overrides) for seed in seeds]
        if known:
            yield known

    def _hunted(
        self, name: str, path: str, given: scenario.Scenario, records: Mapping[str, Record]
    ) -> Iterator[list[Trial]]:
        ranges = _ranges(given)
        low, high = np.array([[r.min, r.max] for r in ranges.values()]).T
        seen: list[tuple[np.ndarray, float]] = []
        for batch, first in enumerate(range(0, self.runs, hunting.BATCH)):
            places = hunting.propose(seen, hunting.BATCH, len(ranges), self.first_seed, batch)
            trials = []
            for k, place in enumerate(places[: self.runs - first]):
                drawn_here = (f"{key}={value!r}" for key, value in zip(ranges, (low + place * (high - low)).tolist()))
                overrides = (*self.overrides, *drawn_here)
                trials.append(self._trial(name, path, given, self.first_seed + first + k, overrides))
            yield trials
            seen += [(place, hunting.margin(records[trial.key])) for place, trial in zip(places, trials)]

    def _trial(self, name: str, path: str, given: scenario.Scenario, seed: int, overrides: tuple[str, ...]) -> Trial:
        """given: the scenario with its distributions; what they come to is what the trial draws."""
        log = (self.out / LOGS / f"{name}-{seed}.mcap").resolve()
        resolved = scenario.resolve(dc.replace(scenario.with_overrides(given, overrides), seed=seed))
        return Trial(name, path, seed, overrides, drawn(given, resolved), log, self.time_out, os.getcwd())


def name_of(path: str) -> str:
    """A scenario's name: its file without folder and suffixes."""
    return Path(path).name.split(".")[0]


def _ranges(given: scenario.Scenario) -> dict[str, Uniform]:
    """The distributions of a scenario that leave something to choose, by key."""
    return {
        leaf.key: leaf.value
        for leaf in config.leaves(given)
        if isinstance(leaf.value, Uniform) and leaf.value.max > leaf.value.min
    }


def drawn(given: scenario.Scenario, resolved: scenario.Scenario) -> tuple[tuple[str, float], ...]:
    """What was drawn: key and value of every distribution of a scenario."""
    values = {leaf.key: leaf.value for leaf in config.leaves(resolved)}
    return tuple((leaf.key, values[leaf.key]) for leaf in config.leaves(given) if isinstance(leaf.value, Uniform))


@dc.dataclass
class Progress:
    """What a display shows after each trial."""

    done: int
    total: int
    turned: int

    @property
    def low(self) -> float:
        """Lower bound of the success rate, at 95 %."""
        return interval(self.turned, self.done)[0]


def run(
    campaign: Campaign,
    executor: concurrent.futures.Executor,
    show: Callable[[Progress], None] = lambda progress: None,
    say: Callable[[str], None] = lambda line: None,
) -> list[Record]:
    """Runs what has no record yet -> all records, in the order of the trials.

    Raises ConfigError if the folder holds another campaign, or one that is under way; OperationFailed if the executor
    loses a trial, which then has no record and is run by the next call.
    """
    campaign.check()
    records: dict[str, Record] = {}
    with _claimed(campaign):
        progress = Progress(0, campaign.total, 0)
        for trials in campaign.batches(records):
            there = {trial.key: record for trial in trials if (record := read(campaign.out, trial)) is not None}
            records |= there
            if there:
                say(f"{len(there)} of {len(trials)} runs are there already")
            progress.done += len(there)
            progress.turned += sum(map(turned, there.values()))
            show(progress)
            left = [trial for trial in trials if trial.key not in records]
            with contextlib.closing(_performed(left, executor)) as ended:
                for trial, record in ended:
                    records[trial.key] = finished(campaign, trial, record)
                    progress.done += 1
                    progress.turned += turned(record)
                    show(progress)
            for trial in trials:  # in the order of the trials
                records[trial.key] = records.pop(trial.key)
    return list(records.values())


def _performed(
    trials: Sequence[Trial], executor: concurrent.futures.Executor
) -> Generator[tuple[Trial, Record], None, None]:
    """Each trial and its record, as they end; MANY wait at a time: what is broken off leaves little behind."""
    left = iter(trials)
    waiting: dict[concurrent.futures.Future[Record], Trial] = {}
    try:
        while True:
            for trial in itertools.islice(left, MANY - len(waiting)):
                waiting[executor.submit(perform, trial)] = trial
            if not waiting:
                break
            done, _ = concurrent.futures.wait(waiting, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in done:
                trial = waiting.pop(future)
                yield trial, _made(future, trial)
    finally:
        for future in waiting:
            future.cancel()


def _made(future: "concurrent.futures.Future[Record]", trial: Trial) -> Record:
    """The record that an executor has made. `perform` does not fail; where it runs may: a worker dies."""
    try:
        return future.result()
    except Exception as error:  # of any executor
        words = str(error).splitlines() or [type(error).__name__]
        raise OperationFailed(f"campaign: {trial.key} was lost: {words[0]}") from error


def finished(campaign: Campaign, trial: Trial, record: Record) -> Record:
    """Keeps the log or not, and writes the record: from then on the trial counts."""
    keep = campaign.keep == "all" or (campaign.keep == "failed" and (not turned(record) or trial.seed % SAMPLE == 0))
    log = None if record["log"] is None else trial.log.with_name(record["log"])
    if log is not None and not keep:
        for path in files_of(log):
            with contextlib.suppress(FileNotFoundError):
                path.unlink()
    record = record | {"log": f"{LOGS}/{log.name}" if log is not None and keep else None}
    outputs.write(record_path(campaign.out, trial), outputs.json_text(record, indent=1) + "\n")
    return record


def record_path(out: Path, trial: Trial) -> Path:
    return out / RECORDS / f"{trial.key}.json"


def read(out: Path, trial: Trial) -> Record | None:
    """The record of a trial; None if there is none. Raises ConfigError for a file that is no record of it."""
    path = record_path(out, trial)
    if not path.exists():
        return None
    record = _load(path)
    its = record["scenario"], record["seed"], record["draws"]
    if its != (trial.name, trial.seed, dict(trial.draws)) or "command" not in record:
        raise ConfigError(f"{path}: not the record of {trial.key}; remove it, and the trial is run again")
    return record


def read_all(out: Path) -> list[Record]:
    """All records of a campaign's folder, by scenario and seed. Raises ConfigError unless it is one."""
    plan(out)
    records = map(_load, (out / RECORDS).glob("*.json"))
    return sorted(records, key=lambda record: (record["scenario"], record["seed"]))


def _load(path: Path) -> Record:
    """One record. Raises ConfigError."""
    try:
        record: Record = outputs.parse_json(path.read_bytes())
    except (OSError, ValueError):
        record = {}
    if not _is_record(record):
        raise ConfigError(f"{path}: not a record of a campaign; remove it, and the trial is run again")
    return record


def _is_record(record: Any) -> bool:
    """Whether all that is made of records can be made of this one."""

    def numbers(value: Any) -> bool:
        return isinstance(value, dict) and all(map(is_number, value.values()))

    if not isinstance(record, dict):
        return False
    texts = (record.get(key) for key in ("scenario", "outcome", "verdict", "reason", "mode"))
    known = (record.get(key) for key in _FIGURES)
    several = (record.get(key) for key in ("contact_honesty", "slips"))
    times = record.get("times")
    spent = times.get("processor_s") if isinstance(times, dict) else None
    words = record.get("command", [])
    return (
        all(isinstance(text, str) for text in texts)
        and isinstance(record.get("seed"), int)
        and isinstance(times, dict)
        and numbers(record.get("draws"))
        and all(value is None or is_number(value) for value in known)
        and all(value is None or numbers(value) for value in several)
        and (spent is None or (isinstance(spent, dict) and is_number(spent.get("total"))))
        and isinstance(words, list)
        and all(isinstance(word, str) for word in words)
        and isinstance(record.get("log"), str | None)
    )


def plan(out: Path) -> dict[str, Any]:
    """What a campaign's folder says that it is. Raises ConfigError."""
    try:
        found = outputs.parse_json((out / PLAN).read_bytes())
    except OSError:
        raise ConfigError(f"{out}: not the folder of a campaign (it has no {PLAN})") from None
    except ValueError:
        found = None
    if not (isinstance(found, dict) and all(isinstance(found.get(key), dict) for key in ("scenarios", "versions"))):
        raise ConfigError(f"{out}: not the folder of a campaign ({PLAN} is damaged)")
    return found


@contextlib.contextmanager
def _claimed(campaign: Campaign) -> Iterator[None]:
    """The folder is this campaign's, and nobody else's meanwhile."""
    out = campaign.out
    wanted: dict[str, Any] = {
        "scenarios": {
            name: scenario.dump(scenario.load(path, overrides)) for name, (path, overrides) in campaign.named.items()
        },
        "first_seed": campaign.first_seed,
        "hunt": campaign.hunt,
        "overrides": list(campaign.overrides),
        "seeds": [entry.seed for entry in campaign.again],
        "versions": versions(),
    }
    begun = os.path.lexists(out / PLAN)
    if os.path.lexists(out) and not begun and not _is_empty(out):
        raise ConfigError(f"--out must be a new folder or that of a campaign, got {shown(str(out))}")
    for folder in (out / RECORDS, out / LOGS):
        outputs.make_folder(folder)
    try:
        lock = os.open(out / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise OperationFailed(f"--out {str(out)!r} cannot be written: {error.strerror}") from None
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"--out {str(out)!r}: a campaign is under way there") from None
        there = plan(out) if os.path.lexists(out / PLAN) else None
        if there is not None:
            _same(there, wanted, out, len(campaign.again))
        if there is None or len(there["scenarios"]) < len(wanted["scenarios"]):
            outputs.write(out / PLAN, outputs.json_text(wanted, indent=1) + "\n")
        yield
    finally:
        os.close(lock)


def _is_empty(out: Path) -> bool:
    """Whether it is an empty folder."""
    try:
        return not any(out.iterdir())
    except OSError:  # no folder, for one
        return False


def _same(there: dict[str, Any], wanted: dict[str, Any], out: Path, listed: int) -> None:
    """Refuses to go on with another campaign: its records would be mixed with this one's.

    listed: how many entries of a list of failures are run again; of one list, there may have been more or less before.
    """
    one, other = dict(there), dict(wanted)
    if listed and (count := min(len(one["scenarios"]), listed)):
        for part in (one, other):
            part["scenarios"] = dict(itertools.islice(part["scenarios"].items(), count))
            part["seeds"] = part["seeds"][:count] if isinstance(part.get("seeds"), list) else None
    for name in ("scenarios", "seeds", "first_seed", "overrides", "hunt"):
        if one.get(name) != other[name]:
            words = "draws (--hunt)" if name == "hunt" else name.replace("_", " ")
            raise ConfigError(f"--out {str(out)!r} holds a campaign of other {words}: choose another folder")
    changed = [k for k, v in wanted["versions"].items() if there["versions"].get(k) != v]
    if changed:
        words = ", ".join(f"{k} {there['versions'].get(k)} -> {wanted['versions'][k]}" for k in changed)
        raise ConfigError(f"--out {str(out)!r} holds records of another program ({words}): choose another folder")


def failures(records: Sequence[Record]) -> list[Record]:
    return [record for record in records if not turned(record)]


def least_honesty(record: Record) -> float | None:
    """The smaller share of both hands of the valve's way that their pads held; None: not known, or it did not move."""
    shares = record.get("contact_honesty")
    return min(shares.values()) if shares else None


def false_verdicts(records: Sequence[Record], tolerance: float = AT_ANGLE) -> dict[str, Any]:
    """The verdict against the truth: `turned` though the valve is not where it should be, and the other way round, with
    the interval of the rate of each. `unverified` claims neither: such runs are counted apart, with how many of their
    valves are where they should be.

    tolerance: of the angle [rad].
    """
    known, false = 0, {"turned": 0, "failure": 0}
    unverified: list[bool] = []
    seeds: list[list[Any]] = []
    for r in records:
        asked, true = r.get("valve_angle_command_rad"), r.get("valve_angle_true_rad")
        if asked is None or true is None:
            continue
        there = abs(true - asked) <= tolerance
        if r["verdict"] == Verdict.UNVERIFIED:
            unverified.append(there)
            continue
        known += 1
        kind = "turned" if turned(r) and not there else "failure" if r["outcome"] == "failed" and there else ""
        if kind:
            false[kind] += 1
            seeds.append([r["scenario"], r["seed"], f"false {kind}"])
    return {
        "known": known,
        "false_turned": false["turned"],
        "false_turned_interval_95": list(interval(false["turned"], known)),
        "false_failure": false["failure"],
        "false_failure_interval_95": list(interval(false["failure"], known)),
        "unverified": len(unverified),
        "unverified_but_turned": sum(unverified),
        "seeds": seeds,
    }


def summary(records: Sequence[Record]) -> dict[str, Any]:
    """The object of `campaign --json`."""
    count = sum(map(turned, records))
    spent = [t["total"] for r in records if (t := r["times"].get("processor_s"))]
    held = [share for r in records if turned(r) and (share := least_honesty(r)) is not None]
    return {
        "runs": len(records),
        "turned": count,
        "interval_95": list(interval(count, len(records))),
        "failures": [
            {k: r[k] for k in ("scenario", "seed", "verdict", "mode", "outcome", "reason")} for r in failures(records)
        ],
        "verdicts_against_truth": false_verdicts(records),
        "contact_honesty_least": min(held) if held else None,
        "collisions": sum(r.get("collisions") or 0 for r in records),
        "processor_s_per_run": sum(spent) / len(spent) if spent else None,
    }
