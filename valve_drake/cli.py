"""The commands. Exit 0 success, 1 the operation failed, 2 bad input or scenario, 3 damaged log; errors are one line."""

from collections.abc import Sequence

from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.commands import (
    calibrate,
    draw,
    estimate,
    experiment,
    recover,
    replay,
    review,
    run,
    scenario,
    teach,
    twin,
)
from valve_drake.commands.common import BAD_INPUT, FAILED, Parser
from valve_drake.console import complain

COMMANDS = (
    run,
    twin,
    scenario,
    draw,
    teach,
    review,
    experiment,
    replay,
    recover,
    estimate,
    calibrate,
)  # as --help lists them


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command -> exit code."""
    try:
        options = _parser().parse_args(arguments)
        return options.command(options)
    except ConfigError as error:
        complain(error)
        return BAD_INPUT
    except OperationFailed as error:
        complain(error)
        return FAILED
    except KeyboardInterrupt:
        complain("interrupted")
        return FAILED


def _parser() -> Parser:
    parser = Parser(prog="valve-drake", description="A robot finds, grasps and turns a valve by colour and shape.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for module in COMMANDS:
        module.add(commands)
    return parser
