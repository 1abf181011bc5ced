"""Two campaigns on the same seeds: does one program turn more valves than the other?"""

import dataclasses as dc
from pathlib import Path
from typing import Any

from valve_drake.campaign import campaign, statistics
from valve_drake.campaign.trial import turned
from valve_drake.checks import ConfigError

FIGURES = {
    "contact_honesty": campaign.least_honesty,
    "peak_internal_force_N": lambda r: r.get("peak_internal_force_N"),
    "measured_position_rms_m": lambda r: r.get("measured_position_rms_m"),
    "estimator_nees": lambda r: r.get("estimator_nees"),
    "turn_peak_hand_force_N": lambda r: r.get("turn_peak_hand_force_N"),
    "turn_mean_stem_force_N": lambda r: r.get("turn_mean_stem_force_N"),
    "sim_time_s": lambda r: r.get("sim_time_s"),
    "processor_s": lambda r: (r["times"].get("processor_s") or {}).get("total"),
}


def compare(a: Path, b: Path) -> dict[str, Any]:
    """The object of `compare --json`: pairs of runs by scenario and seed. Raises ConfigError without pairs."""
    for folder in (a, b):
        if campaign.plan(folder).get("hunt"):
            raise ConfigError(f"compare: {folder} is a hunt: what its runs draw is not their seeds'")
    one, other = ({(r["scenario"], r["seed"]): r for r in campaign.read_all(folder)} for folder in (a, b))
    keys = sorted(one.keys() & other.keys())
    if not keys:  # their scenarios may be called differently
        for folder, records in ((a, one), (b, other)):
            names = sorted({name for name, _ in records})
            if len(names) > 1:
                raise ConfigError(
                    f"compare: {a} and {b} have no run in common, and {folder} has {len(names)} scenarios"
                )
        one, other = ({("", seed): r for (_, seed), r in records.items()} for records in (one, other))
        keys = sorted(one.keys() & other.keys())
    if not keys:
        raise ConfigError(f"compare: {a} and {b} have no seed in common")
    pairs = [(one[key], other[key]) for key in keys]
    successes = [turned(r) for r, _ in pairs], [turned(r) for _, r in pairs]
    found, step = statistics.compare(*successes), statistics.sequential(*successes)
    differences = {}
    for name, figure in FIGURES.items():
        both = [(figure(r), figure(s)) for r, s in pairs if turned(r) and turned(s)]
        both = [(x, y) for x, y in both if x is not None and y is not None]
        difference = statistics.difference([x for x, _ in both], [y for _, y in both])
        if difference is not None:
            differences[name] = dc.asdict(difference)
    return {
        "pairs": len(pairs),
        "turned_a": sum(turned(r) for r, _ in pairs),
        "turned_b": sum(turned(r) for _, r in pairs),
        **dc.asdict(found),
        "step": None if step is None else dc.asdict(step),
        "differences": differences,
    }
