"""What goes wrong in the simulated world in the middle of a run: scenario key `simulation.mishap`.

The station's systems stay as they are; a mishap stands between the commands and the plant.
"""

import math

from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from valve_drake.messages import ModeState, OperatorCommand
from valve_drake.ports import TICK, PythonSystem
from valve_drake.robot.robot import Robot
from valve_drake.stations.simulation_config import MishapConfig
from valve_drake.task.modes import TERMINAL

THERE = 1e-3  # a valve that begins so near to where a hand lets go is there [rad]
OPENING_FORCE = 40.0  # of the finger actuator of a hand that lets go [N]


class LostGripSystem(PythonSystem):
    """A hand that lets go by itself once the valve has turned so far, and obeys again after a while.

    port      dir  type        notes
    --------  ---  ----------  --------------------------------------------
    angle     in   vector(1)   of the valve's stem [rad]
    position  in   vector(1)   commanded opening [m]
    force     in   vector(1)   commanded limit of the finger actuator [N]
    position_command, force_limit   out  vector(1)   what the hand does
    """

    def __init__(self, mishap: MishapConfig, closed: float, robot: Robot):
        """closed: the stem's angle when the valve is closed [rad]."""
        super().__init__()
        self.set_name("lost_grip")
        self._mishap, self._closed, self._open = mishap, closed, robot.opening
        ports = (self.DeclareVectorInputPort(name, 1) for name in ("angle", "position", "force"))
        self._angle, self._position, self._force = ports
        self._since = self.DeclareDiscreteState([math.inf])  # when it let go [s]
        self._from = self.DeclareDiscreteState([math.nan])  # on which side of the place the valve began: -1, 0, 1
        self.DeclarePeriodicDiscreteUpdateEvent(TICK, 0.0, self._watch)
        self.DeclareVectorOutputPort("position_command", 1, self._calc_position)
        self.DeclareVectorOutputPort("force_limit", 1, self._calc_force)

    def _calc_position(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._open] if self._lost(context) else self._position.Eval(context))

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([OPENING_FORCE] if self._lost(context) else self._force.Eval(context))

    def _watch(self, context: Context, values: DiscreteValues) -> None:
        since, side = (float(context.get_discrete_state(k)[0]) for k in (self._since, self._from))
        beyond = abs(self._angle.Eval(context)[0] - self._closed) - self._mishap.grip_lost_at
        if math.isnan(side):
            side = math.copysign(1.0, beyond) if abs(beyond) > THERE else 0.0
            values.set_value(self._from, [side])
        if since == math.inf and side * beyond <= 0:  # it comes to the place, from whichever side
            values.set_value(self._since, [context.get_time()])

    def _lost(self, context: Context) -> bool:
        since = float(context.get_discrete_state(self._since)[0])
        return since <= context.get_time() < since + self._mishap.grip_lost_for


def slips(mishap: MishapConfig, time: float) -> float:
    """The share of the wheels' way that is lost now."""
    begin = mishap.wheel_slip_at
    return mishap.wheel_slip_share if begin >= 0 and begin <= time < begin + mishap.wheel_slip_for else 0.0


class WheelSlipSystem(PythonSystem):
    """A base that does not go where its wheels turn.

    Ports: twist (count,) in, commanded; twist_command (count,) out, done.
    """

    def __init__(self, mishap: MishapConfig, count: int):
        """count: of the speeds that the base has."""
        super().__init__()
        self.set_name("wheel_slip")
        twist = self.DeclareVectorInputPort("twist", count)

        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector((1.0 - slips(mishap, context.get_time())) * twist.Eval(context))

        self.DeclareVectorOutputPort("twist_command", count, calc)


class InterruptingOperator:
    """Stops the run at a time, and says go again a while later. One serves one run."""

    def __init__(self, mishap: MishapConfig, go: OperatorCommand):
        """go: the command that begins the run."""
        self._mishap, self._go = mishap, go
        self._sequence = go.sequence + 1  # that number is the user's own stop
        self._left = ["stop", "reset", go.command] if mishap.operator_stop_at >= 0 else []

    @property
    def waits(self) -> bool:
        """Whether there is more to come: the run is not over, even if its mode is final."""
        return bool(self._left)

    def say(self, time: float, mode: ModeState) -> OperatorCommand | None:
        """What is said now, if anything."""
        final = mode.mode in TERMINAL
        if not self._left:
            return None
        if len(self._left) == 3:
            if final:  # it was over before
                self._left = []
                return None
            if time < self._mishap.operator_stop_at:
                return None
        elif len(self._left) == 2 and not (final and time >= mode.since + self._mishap.operator_go_after):
            return None
        self._sequence += 1
        word = self._left.pop(0)
        return OperatorCommand(sequence=self._sequence, command=word, angle=self._go.angle)
