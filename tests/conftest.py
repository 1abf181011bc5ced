"""What holds for all tests."""

import gc
import os
import signal

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program has it (cli.py); before numpy is imported
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # `nohup make test` hands down that it is ignored
gc.set_threshold(50_000, 20, 100)  # looking for circles takes a twentieth of the tests' time


def pytest_configure(config: pytest.Config) -> None:
    """In a process of pytest-xdist a run copies itself as it does in one of its own; new Pythons take 1 s longer."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        from valve_drake import beside

        beside.harmless_threads = len(os.listdir("/proc/self/task")) - 1  # one waits for the next test's name
        config.addinivalue_line("filterwarnings", "ignore:This process .* is multi-threaded:DeprecationWarning")
