"""A stage written from nothing, in the whole system: it adds up how far the base has driven.

python examples/own_stage.py [SECONDS]

A stage is its inputs, its memory, its outputs and a pure step. docs/your_stage.md has the way from here to a stage that
commands the robot and has a mode of its own.
"""

import sys

import numpy as np
from pydrake.systems.analysis import Simulator

from valve_drake import scenario
from valve_drake.diagram import command, make_diagram
from valve_drake.messages import ModeState, OperatorCommand, RobotState
from valve_drake.ports import Block, Inputs


class TripInputs(Inputs):
    robot_state: RobotState
    mode: ModeState


class Trip(Block[TripInputs, tuple[float, float]]):
    """The way driven [m], and the part of it in the present mode."""

    OUTPUTS = {"driven": 2}

    def initial(self) -> tuple[float, float]:
        return 0.0, 0.0

    def step(self, time: float, inputs: TripInputs, memory: tuple[float, float]):
        way = abs(inputs.robot_state.odometry[3]) * self.period
        total = memory[0] + way
        here = way + (memory[1] if inputs.mode.since < time - self.period else 0.0)
        return (total, here), {"driven": np.array([total, here])}


def main(seconds: float = 6.0) -> None:
    trip = Trip("trip")
    inputs = {"robot_state": "robot_state.robot_state", "mode": "supervisor.mode"}
    system = make_diagram(scenario.resolve(scenario.load(None, ["seed=1"])), added={trip: inputs})
    simulator = Simulator(system.diagram)
    command(system, simulator.get_mutable_context(), OperatorCommand(sequence=0, command="open"))
    simulator.AdvanceTo(seconds)
    driven = trip.GetOutputPort("driven").Eval(trip.GetMyContextFromRoot(simulator.get_context()))
    print(f"{driven[0]:.2f} m in {seconds:g} s, {driven[1]:.2f} m of it in the present mode")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
