"""`valve-drake experiment`: the paper's tables, the bound, robustness, hand-eye calibration, tag detectors, voice."""

import argparse
import importlib.util
import json
import os
from pathlib import Path
from typing import Any

from valve_drake import outputs
from valve_drake.checks import ConfigError, require
from valve_drake.commands.common import OK, Subcommands
from valve_drake.console import console as make_console


def add(commands: Subcommands) -> None:
    p = commands.add_parser(
        "experiment", help="the paper's tables, the bound, robustness, hand-eye, tag detectors, voice"
    )
    p.add_argument("name", choices=("table2", "table3", "bound", "robustness", "hand-eye", "peers", "voice"))
    p.add_argument("--seed", type=int, default=0)
    p.add_argument(
        "--trials",
        type=int,
        metavar="N",
        help="images a row (table2: runs of six poses; voice: minutes of other speech)",
    )
    p.add_argument(
        "--images",
        choices=("drawn", "rendered"),
        default="drawn",
        help="of `bound`: exact ones, or what the simulated cameras deliver (default drawn)",
    )
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.add_argument("--out", type=Path, metavar="DIR", help="write NAME.json there, and the plot of the bound")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.analysis import experiments

    rendered = options.images == "rendered"
    if rendered:
        require(options.name == "bound", "--images rendered", "an option of `bound`", options.name)
    name = "bound_rendered" if rendered else options.name
    numbers, plot = f"{name}.json", "estimator_bound.svg"
    if options.out is not None:
        names = (numbers, plot) if name == "bound" else (numbers,)
        require(os.path.isdir(options.out), "--out", "a folder that exists", options.out)
        outputs.check_folder(options.out, "--out", names, made_before=_made_before)
        if plot in names and importlib.util.find_spec("matplotlib") is None:
            raise ConfigError("--out of `bound` needs matplotlib for its plot: pip install 'valve-drake[bench]'")
    result = experiments.run(name, options.seed, options.trials)
    if options.out is not None:
        outputs.write(options.out / numbers, outputs.json_text(result, indent=1) + "\n")
        if name == "bound":
            with outputs.replacing(options.out / plot) as file:
                experiments.plot_bound(result, file)
    if options.json:
        print(outputs.json_text(result))
    else:
        _print_experiment(result)
    return OK


def _made_before(path: Path) -> bool:
    """Whether a file is an experiment's table of that name, or the plot of the bound."""
    try:
        text = path.read_text(encoding="utf-8")
        return "Cramer-Rao bound" in text if path.suffix == ".svg" else json.loads(text)["experiment"] == path.stem
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _print_experiment(result: dict[str, Any]) -> None:
    from rich.table import Table

    def shown(value: object) -> str:
        return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)

    console = make_console()
    console.width = max(console.width, 140)  # of the table, also in a pipe
    columns = list(dict.fromkeys(key for row in result["rows"] for key in row))
    table = Table(*columns, box=None, header_style="dim")
    for row in result["rows"]:
        table.add_row(*(shown(row.get(key)) for key in columns))
    console.print(f"{result['experiment']}: {result['settings']}")
    console.print(table)
    for name, value in result.get("totals", {}).items():
        console.print(f"{name}: {value}")
