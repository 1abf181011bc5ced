"""The commands. Exit 0 success, 1 the operation failed, 2 bad input or scenario, 3 damaged log; errors are one line."""

import atexit
import contextlib
import errno
import gc
import io
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.commands import (
    calibrate,
    campaign,
    check_robot,
    draw,
    estimate,
    experiment,
    import_robot,
    operator,
    recover,
    replay,
    review,
    run,
    scenario,
    teach,
    twin,
)
from valve_drake.commands.common import BAD_INPUT, FAILED, OK, Interrupted, Parser, break_off, signals
from valve_drake.console import complain

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

COMMANDS = (
    run,
    campaign,
    check_robot,
    operator,
    twin,
    scenario,
    draw,
    teach,
    import_robot,
    review,
    experiment,
    replay,
    recover,
    estimate,
    calibrate,
)  # as --help lists them

GARBAGE = 20_000  # new objects until those in circles are looked for: at Python's 700 none are found, at some cost
atexit.register(gc.freeze)  # the process's own end frees all at once: looking through every object would take 0.2 s


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command -> exit code."""
    # Of BLAS, that no matrix here is large enough for: a process with one thread can be forked (beside.py).
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(GARBAGE)
    logging.getLogger("drake").addFilter(_is_warning)  # its news would stand between the program's lines
    logging.getLogger("valve_drake").addHandler(logging.NullHandler())  # the commands say it themselves
    with _terminal() as output:
        code = _run(arguments)
    if output.failure is None or output.failure.errno == errno.EPIPE:  # who closes a pipe has seen enough
        return code
    complain(f"standard output cannot be written: {output.failure.strerror}")
    return code or FAILED


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING


def _run(arguments: Sequence[str] | None) -> int:
    with signals(break_off):
        try:
            options = _parser().parse_args(arguments)
            return options.command(options)
        except ConfigError as error:
            complain(error)
            return BAD_INPUT
        except OperationFailed as error:
            complain(error)
            return FAILED
        except KeyboardInterrupt as interrupt:
            complain("interrupted")
            return interrupt.exit_code if isinstance(interrupt, Interrupted) else FAILED
        except SystemExit as end:  # of argparse, after --help
            return int(end.code or OK)


class _Stream(io.FileIO):
    """Standard output or error that never interrupts the work: from the first failure on, all is dropped.

    A reader may close its pipe, a terminal may go away while a robot holds a valve.
    """

    failure: OSError | None = None

    def write(self, data: "ReadableBuffer") -> int:
        if self.failure is None:
            try:
                return super().write(data)
            except OSError as error:
                self.failure = error
        return memoryview(data).nbytes


@contextlib.contextmanager
def _terminal() -> Iterator[_Stream]:
    """Standard output and error as such streams; -> that of the output. Text that they cannot show is escaped."""
    for descriptor in range(3):  # one that the shell has closed would be given to the next file that is opened: the log
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    streams = {name: _Stream(k, "w", closefd=False) for k, name in ((1, "stdout"), (2, "stderr"))}
    old = {name: getattr(sys, name) for name in streams}
    for name, raw in streams.items():
        if old[name] is getattr(sys, f"__{name}__"):  # not where a caller collects the text
            encoding = getattr(old[name], "encoding", None) or "utf-8"
            buffer = io.BufferedWriter(raw)
            by_line = name == "stderr" or raw.isatty()
            setattr(sys, name, io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=by_line))
    try:
        yield streams["stdout"]
    finally:
        for name in streams:
            getattr(sys, name).flush()
            setattr(sys, name, old[name])


def _parser() -> Parser:
    parser = Parser(prog="valve-drake", description="A robot finds, grasps and turns a valve by colour and shape.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for module in COMMANDS:
        module.add(commands)
    return parser
