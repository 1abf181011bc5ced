"""A run that an operator commands, within this process: the program, a desk, and a wire that can be cut."""

import numpy as np
from pydrake.lcm import DrakeLcm

from valve_drake import runner
from valve_drake import scenario as scenarios
from valve_drake.operator.desk import Desk
from valve_drake.operator.desk_link import DeskLink
from valve_drake.operator.ear import PIECE, pieces
from valve_drake.operator.grammar import Heard
from valve_drake.operator.operator_link import OperatorLink
from valve_drake.operator.wire import RATE
from valve_drake.stations.bus import Bus


class Session:
    """Runs a story: steps of (when, what), one after the other. `when(state)`: whether it is time for it, by what the
    robot answers; what: words to say, or called with the session. The run ends after the last one."""

    def __init__(self, *overrides, limit=200.0, ear=None, noise=lambda count: np.zeros(count, np.int16)):
        """ear: words are said as sound (n,) int16, and heard by it; noise: what it hears else, so many samples."""
        given = ["operator_channel.wire=lcm", "hardware.lcm_url=memq://", *overrides]
        self.scenario = scenarios.load(None, given)
        self.lcm, self.now, self.limit = DrakeLcm("memq://"), 0.0, limit
        self.links = OperatorLink(self.bus())
        self.desk = DeskLink(self.bus(), lambda: self.now)
        self._office = None if ear is None else Desk(self.desk, ear, clock=lambda: self.now)
        self._sound, self._noise, self._heard = [], noise, 0  # pieces that wait; how many were heard
        self.cut = False
        self.modes, self.told = [], []  # (time, mode); (time, what the robot said)
        self._story, self._over = [], False

    def bus(self):
        bus = Bus(self.scenario.hardware, self.lcm)
        bus.clock = lambda: self.now
        return bus

    def run(self, path, *story):
        self._story = list(story)
        return runner.run(
            self.scenario, path, operators=self.links, show=self._show, stop=lambda: self._over, truth=True
        )

    def _show(self, progress):
        self.now = progress.sim_time
        mode = progress.mode
        if not self.modes or self.modes[-1][1] != mode.mode:
            self.modes.append((self.now, mode.mode))
        if self._office is not None:
            while (self._heard + 1) * PIECE <= self.now:
                self._heard += 1
                self._office.sound(self._sound.pop(0) if self._sound else self._noise(round(PIECE * RATE)))
            self._office.poll()
        elif not self.cut:
            self.desk.poll()
        state = self.desk.state
        if not self.told or self.told[-1][1] != state.says:
            self.told.append((self.now, state.says))
        if self._story and not self.desk.waiting and not self._sound and self._story[0][0](state):
            what = self._story.pop(0)[1]
            if callable(what):
                what(self)
            elif isinstance(what, np.ndarray):
                self._sound += pieces(what)
            else:
                self.desk.say(Heard(what, 0.9))
        self._over = not self._story or self.now > self.limit

    def at(self, mode):
        """When it was entered first [s]."""
        return next(time for time, name in self.modes if name == mode)


def said(words):
    """When the robot's last answer has these words in it."""
    return lambda state: words in state.says


def ended(mode):
    """When the last task has ended in this mode."""
    return lambda state: state.mode == mode and state.done
