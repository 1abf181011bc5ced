"""Failures as a list in YAML: what a campaign has found, and what is run again once it is mended."""

import dataclasses as dc
from collections.abc import Iterable
from pathlib import Path

from valve_drake import config, outputs, yaml_file
from valve_drake.campaign.trial import Record
from valve_drake.checks import ConfigError
from valve_drake.config import Config, names, number, plain

MOST = 10_000  # of a list
ROOM = 30  # for its file, as yaml_file.read has it: an entry of a hunt takes 1.5 kB and a number a draw


@dc.dataclass
class Failure(Config):
    """One entry: the run, and how it ended when it was found."""

    KEY = "failures"
    scenario: str = plain("simulated.scenario.yaml", "a file, or a name in diagrams/")
    seed: int = number(0, 0, 2**31 - 1, "of the run")
    set: list[str] = names("overrides, KEY=VALUE", (0, 100))
    ended: str = plain("", "verdict, mode and reason")


@dc.dataclass
class FailureList(Config):
    KEY = ""
    failures: list[Failure] = dc.field(default_factory=list, metadata=config.about("in their order"))


def read(path: Path) -> tuple[Failure, ...]:
    """The entries of a list. Raises ConfigError."""
    tree = yaml_file.read(path, room=ROOM)
    if not isinstance(tree, dict) or not tree.get("failures"):
        raise ConfigError(f"{path}: not a list of failures (it has no key failures, or an empty one)")
    found: FailureList = config.build(FailureList(), tree, str(path))
    for k, entry in enumerate(found.failures):
        entry.check(f"failures[{k}]")
    if len(found.failures) > MOST:
        raise ConfigError(f"{path}: failures must be at most {MOST}, got {len(found.failures)}")
    return tuple(found.failures)


def write(path: Path, records: Iterable[Record]) -> None:
    """The list of these failed runs."""
    entries = []
    for r in records:
        words = r["command"]
        given = [words[k + 1] for k, word in enumerate(words) if word == "--set"]
        ended = f"{r['verdict'] or r['outcome']} in {r['mode'] or '-'}: {r['reason']}"
        entries.append(Failure(words[2], r["seed"], given, ended))
    comment = "Failures that a campaign has found; `valve-drake campaign --again FILE` runs them again."
    outputs.write(path, yaml_file.dump(config.tree(FailureList(entries)), comment))
