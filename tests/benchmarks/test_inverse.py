"""A hand's inverse from its neighbour, as each tick of a turn asks for it: six joints and seven.

python -m pytest tests/benchmarks/test_inverse.py
"""

import numpy as np
import pytest

from valve_drake.frames import make, rotation
from valve_drake.messages import LEFT
from valve_drake.robot import description
from valve_drake.robot.robot import Robot

pytest.importorskip("pytest_benchmark")
MOST = 0.25e-3  # of a neighbour's inverse on an idle machine [s]


@pytest.mark.benchmark(max_time=2.0)
@pytest.mark.parametrize("name", [description.OURS, "pr2/pr2.robot.yaml"])
def test_a_neighbours_inverse(benchmark, name):
    robot = Robot.load(description.find(name))
    q = robot.arms[LEFT].work
    X = robot.forward(LEFT, q)
    near = make(rotation(np.array([8e-4, 0, 0])) @ X[:, :3], X[:, 3] + [0, 8e-5, 8e-5])  # a tick at 0.1 rad/s
    assert robot.inverse(LEFT, near, q) is not None
    benchmark(robot.inverse, LEFT, near, q)
    assert benchmark.stats.stats.min < MOST
