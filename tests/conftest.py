"""What holds for all tests."""

import gc
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program has it (cli.py); before numpy is imported
gc.set_threshold(50_000, 20, 100)  # looking for circles takes a twentieth of the tests' time
