"""`python -m valve_drake` is `valve-drake`."""

import sys

from valve_drake.cli import main

if __name__ == "__main__":
    sys.exit(main())
