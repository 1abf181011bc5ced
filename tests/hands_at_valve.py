"""The simulated plant alone, its hands at the valve's handles where a test puts them: no program, no cameras."""

import numpy as np
from pydrake.systems.analysis import Simulator
from robot_facts import GROUPS, ROBOT

from valve_drake.analysis.metrics import Summary, summarize
from valve_drake.frames import compose, inverse, make, planar, rot_z
from valve_drake.messages import LEFT, RIGHT, SIDES, ModeState
from valve_drake.recording.schemas import Vector
from valve_drake.recording.signals import SLOW, TRUTH
from valve_drake.recording.writer import LogWriter
from valve_drake.stations.contract import vectors
from valve_drake.stations.plant_system import PlantSystem
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ValveConfig
from valve_drake.valve.valve import Valve

VALVE = ValveConfig(height=1.0, friction=4.0, position=0.0)
BASE = np.array([-0.76, 0.0, 0.0])
RADIUS, FRONT = 0.15, -0.09  # of the handles in V, z into the panel [m]
OUTWARD = {LEFT: -1.0, RIGHT: 1.0}
SHUT = {f"{side}_gripper.position_command": np.zeros(1) for side in SIDES}


def at_handle(side, angle=0.0, off=(0.0, 0.0, 0.0), near=None):
    """The arm's joints with the hand round its handle when the valve has turned by `angle`; off: from there, in V."""
    X_BV = compose(inverse(planar(*BASE)), panel_pose(VALVE), make(rot_z(-angle), np.zeros(3)))
    X_VG = make(np.eye(3), np.array([OUTWARD[side] * RADIUS, 0, FRONT]) + off)
    found = ROBOT.inverse(side, compose(X_BV, X_VG), near)
    assert found is not None
    return found


class Hands:
    """The simulated plant alone, arms where a test puts them; what the recorder would write is kept."""

    def __init__(self, left, right, opening=ROBOT.opening, valve=VALVE):
        self.arms = arms = {LEFT: left, RIGHT: right}
        start = ROBOT.named(base=BASE, torso=ROBOT.torso.home, arms=arms, opening=opening)
        offsets = {side: np.zeros(len(arms[side])) for side in SIDES}
        self.plant = PlantSystem(valve, Valve(), start, offsets, ROBOT)
        self.simulator = Simulator(self.plant)
        self.context = self.simulator.get_mutable_context()
        zeros = {name: np.zeros(size) for name, size in vectors(GROUPS, "in").items()}
        self.command(zeros | {"torso.position_command": ROBOT.torso.home})
        for side in SIDES:
            self.command({f"{side}_arm.position_command": arms[side]})
            self.command({f"{side}_gripper.position_command": np.array([opening])})
            self.command({f"{side}_gripper.force_limit": np.array([60.0])})
        self.simulator.Initialize()
        stem = self.plant.plant.GetJointByName("stem")
        self._angle = stem.position_start()
        self.kept = []

    def command(self, values):
        for name, value in values.items():
            self.plant.GetInputPort(name).FixValue(self.context, value)

    def run(self, time, arms=lambda share: {}):
        """arms: share of the time that is over -> commands."""
        begin = self.context.get_time()
        for k in range(1, round(time / SLOW) + 1):
            self.command(arms(k * SLOW / time))
            self.simulator.AdvanceTo(begin + k * SLOW)
            angle = self.plant.GetOutputPort("now").Eval(self.context)[self._angle]
            self.kept.append((begin + k * SLOW, angle, self.plant.GetOutputPort("contacts").Eval(self.context)))
        return self

    def turn(self, angle, sides, **where):
        """Moves the hands of `sides` along their arcs; where: of a hand, off its handle."""
        arms = dict(self.arms)

        def follow(share):
            for side in sides:
                arms[side] = at_handle(side, share * angle, where.get(side, (0, 0, 0)), arms[side])
            return {f"{side}_arm.position_command": q for side, q in arms.items()}

        return self.run(2.0, follow)

    def summary(self, path) -> Summary:
        """By way of a log."""
        with LogWriter(path) as writer:
            last = None
            for time, angle, found in self.kept:
                writer.write("/supervisor/mode", ModeState(time, "turn", 1), time)
                for port, value in {"truth.valve_angle": [angle, 0], "truth.base_pose": BASE}.items():
                    writer.write("/" + port.replace(".", "/"), Vector(time, TRUTH[port], np.array(value)), time)
                writer.write("/truth/marker_pose", Vector(time, TRUTH["truth.marker_pose"], np.zeros(12)), time)
                if found is not last:
                    writer.write("/truth/contacts", found, time)
                last = found
        return summarize(path)
