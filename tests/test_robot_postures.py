"""Postures that check-robot tells where those of robot.yaml do not serve: deterministic, within limits, and of use."""

import dataclasses as dc
import math

import numpy as np
import pytest
from robot_variants import seven_joints, variant, with_roll

from valve_drake import robot_check, robot_postures
from valve_drake import scenario as scenarios
from valve_drake.behaviors.grasp_geometry import Turn
from valve_drake.collision import CollisionModel
from valve_drake.frames import compose, inverse
from valve_drake.messages import SIDES
from valve_drake.robot.robot import Robot
from valve_drake.robot_check import MISSING, NOTE, Reach, Report
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ValveConfig

QUARTER = math.pi / 2


def unworked(given):
    with_roll(given)
    for side in SIDES:
        arm = given["arms"][side]
        arm["work"], arm["home"] = list(arm["home"]), [0.0] * 7


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """Seven joints an arm, stretched at home, and drawn to where it is of no use at a valve."""
    return Robot.load(variant(tmp_path_factory.mktemp("robot"), seven_joints, unworked))


def stances_of(robot):
    scenario = scenarios.load(None, [])
    return robot_check._stances(robot, scenario, CollisionModel(robot))


def margin(stances):
    def with_robot(other, X_BA):
        free = CollisionModel(other).is_free
        return dc.replace(stances, robot=other, is_free=free).best_arc(Turn(X_BA, QUARTER)).margin

    return with_robot


@pytest.mark.system
def test_working_postures_turn_the_valve_for_which_they_were_found(robot, monkeypatch):
    monkeypatch.setattr(robot_postures, "BEGINNINGS", 30)
    monkeypatch.setattr(robot_postures, "PLACES", 3)
    stances = stances_of(robot)
    valves = {1.0: compose(panel_pose(ValveConfig(height=1.0)), inverse(stances.valve.X_AP()))}
    found = [robot_postures.find_work(stances, valves, QUARTER, 0.15, margin(stances)) for _ in range(2)]
    assert found[0] == found[1], "the same question, the same answer"
    work = found[0]
    assert work is not None and work.height == 1.0 and work.margin > 0.4
    assert all(robot.arms[side].within(np.array(work.postures[side])) for side in SIDES)
    assert robot_postures.find_work(stances, valves, QUARTER, 1.0, margin(stances)) is None, "none is that good"


@pytest.mark.system
def test_a_home_is_before_the_shoulders_and_below_them_and_free(robot, monkeypatch):
    monkeypatch.setattr(robot_postures, "HOMES", 25)
    work = {side: robot.arms[side].work.tolist() for side in SIDES}
    asked = []

    def serves(other):
        asked.append(other)
        return len(asked) > 1

    home = robot_postures.find_home(robot, CollisionModel(robot), work, serves)
    assert home is not None and len(asked) == 2, "the second, since the first did not serve"
    assert all(asked[1].arms[side].home.tolist() == home[side] for side in SIDES)
    for side in SIDES:
        off = robot.forward(side, np.array(home[side]))[:, 3] - robot.shoulder(side)
        assert off[0] > 0.1 and off[2] < -0.05
    assert CollisionModel(robot).is_free(None, np.concatenate([home[side] for side in SIDES]))
    assert robot_postures.find_home(robot, CollisionModel(robot), work, lambda other: False) is None


@pytest.mark.system
def test_check_robot_tells_postures_where_those_of_the_file_do_not_serve(robot):
    scenario, report = scenarios.load(None, []), Report("", "")
    report.reach.append(Reach(1.0, 0.0, -1.0))
    report.hidden = {"left": 0.0}
    robot_check._postures(report, robot, scenario, CollisionModel(robot), robot_check._head_of(scenario))
    told = {finding.key: finding.text for finding in report.findings if finding.level == NOTE}
    assert set(told) == {f"arms.{side}.{key}" for side in SIDES for key in ("work", "home")}
    assert "is turned with a margin of" in told["arms.left.work"] and told["arms.left.home"].startswith("try [")
    assert not [finding for finding in report.findings if finding.level == MISSING]


def test_check_robot_tells_none_where_those_of_the_file_serve():
    ours = Robot.load("models/robot/robot.yaml")
    report = Report("", "")
    report.reach.append(Reach(1.0, 0.0, 0.9))
    report.hidden = {"left": 0.0}
    scenario = scenarios.load(None, [])
    robot_check._postures(report, ours, scenario, CollisionModel(ours), robot_check._head_of(scenario))
    assert not report.findings
