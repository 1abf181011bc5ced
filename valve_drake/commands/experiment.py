"""`valve-drake experiment`: the paper's tables, the bound and robustness, on drawn images."""

import argparse
import json
from pathlib import Path

from valve_drake.checks import ConfigError
from valve_drake.commands.common import OK, Subcommands


def add(commands: Subcommands) -> None:
    p = commands.add_parser("experiment", help="the paper's tables, the bound, robustness, on drawn images")
    p.add_argument("name", choices=("table2", "table3", "bound", "robustness", "hand-eye"))
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--trials", type=int, metavar="N", help="images a row (table2: runs of six poses)")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.add_argument("--out", type=Path, metavar="DIR", help="write NAME.json there, and the plot of the bound")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.analysis import experiments

    if options.out and not options.out.is_dir():
        raise ConfigError(f"--out must be a folder, got {options.out}")
    result = experiments.run(options.name, options.seed, options.trials)
    if options.out:
        (options.out / f"{options.name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        if options.name == "bound":
            experiments.plot_bound(result, options.out / "estimator_bound.svg")
    if options.json:
        print(json.dumps(result))
    else:
        _print_experiment(result)
    return OK


def _print_experiment(result: dict) -> None:
    from rich.console import Console
    from rich.table import Table

    def shown(value: object) -> str:
        return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)

    console = Console(highlight=False, soft_wrap=True)
    console.width = max(console.width, 140)  # of the table, also in a pipe
    columns = list(dict.fromkeys(key for row in result["rows"] for key in row))
    table = Table(*columns, box=None, header_style="dim")
    for row in result["rows"]:
        table.add_row(*(shown(row.get(key)) for key in columns))
    console.print(f"{result['experiment']}: {result['settings']}", markup=False)
    console.print(table)
    for name, value in result.get("totals", {}).items():
        console.print(f"{name}: {value}", markup=False)
