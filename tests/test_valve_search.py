"""valve_search: finds the marker in any direction, ignores false detections, keeps it centred, reports its loss."""

import dataclasses as dc
import itertools
import sys

import numpy as np
import pytest
from helpers import Rig, assert_clones_are_independent, assert_holds_between_updates, ports
from robot_facts import ROBOT, robot_state

from valve_drake.behaviors.valve_search import USUAL, Memory, Sight, ValveSearchConfig, aim, bolted, step
from valve_drake.behaviors.valve_search_system import ValveSearchSystem
from valve_drake.checks import ConfigError
from valve_drake.frames import apply, inverse, make
from valve_drake.messages import Cause, Mode, ModeState, RectangleEstimate, RobotState, StereoPosition, Verdict
from valve_drake.ports import TICK
from valve_drake.robot.drive import DIFFERENTIAL, drive
from valve_drake.robot.gaze import Gaze

DT = 1 / 64  # half the real rate: the laws do not depend on it, and the tests are quicker
CONFIG = ValveSearchConfig()
HEAD, GAZE = ROBOT.head_pose, ROBOT.gaze
VIEW = (np.deg2rad(14.5), np.deg2rad(11))  # half the field of the narrower camera
BASELINE = 0.12


def in_view(X_OL: np.ndarray, p_OV: np.ndarray, shift: float = 0.0) -> bool:
    x, y, z = apply(inverse(X_OL), p_OV) - [shift, 0, 0]
    return z > 0 and abs(np.arctan2(x, z)) < VIEW[0] and abs(np.arctan2(y, z)) < VIEW[1]


@dc.dataclass
class World:
    """A robot that follows commands with a lag, and stereo sightings at most 8 times a second.

    Making a pair of images takes `late` seconds; the next pair is begun when it is finished.
    """

    p_OV: np.ndarray | None  # the marker, if there is one
    rng: np.random.Generator
    base: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))
    rate: float = 0.0
    torso: np.ndarray = dc.field(default_factory=lambda: np.array([0.0, 0.1, 0.0]))
    late: float = 0.03  # [s]
    lag: float = 0.05  # of the torso [s]
    ghosts: float = 0.0  # chance that an image without the marker shows something anywhere in view
    pending: list = dc.field(default_factory=list)
    position: StereoPosition = StereoPosition()

    def tick(self, k: int) -> RobotState:
        t = k * DT
        if self.pending and self.pending[0][0] <= t:
            self.position = self.pending.pop(0)[1]
        if k % 8 == 0 and not self.pending:
            X_OL = HEAD(self.base, self.torso)
            self.pending.append((t + self.late, self._shot(t, k // 8, X_OL)))
        odometry = np.array([*self.base, 0.0, self.rate])
        return RobotState(time=t, odometry=odometry, torso=self.torso, history=np.array([[t, *self.base, *self.torso]]))

    def _shot(self, t: float, sequence: int, X_OL: np.ndarray) -> StereoPosition:
        p_LV = None
        if self.p_OV is not None and in_view(X_OL, self.p_OV) and in_view(X_OL, self.p_OV, BASELINE):
            p_LV = apply(inverse(X_OL), self.p_OV)
        elif self.rng.random() < self.ghosts:
            p_LV = self.rng.uniform([-0.2, -0.15, 1], [0.2, 0.15, 1]) * self.rng.uniform(1, 6)
        if p_LV is None:
            return StereoPosition(time=t, sequence=sequence, X_OL=X_OL, reason="nothing red")
        sigma = np.array([1e-3, 1e-3, 3e-3 * p_LV[2]]) * p_LV[2]
        seen = p_LV + sigma * self.rng.normal(size=3)
        return StereoPosition(t, sequence, True, seen, np.diag(sigma**2), X_OL)

    def obey(self, command) -> None:
        self.torso = self.torso + (command.torso - self.torso) * DT / self.lag
        if command.base_twist is not None:
            assert command.base_twist[0] == 0
            self.rate += (command.base_twist[1] - self.rate) * DT / 0.08
            self.base = self.base + [0, 0, self.rate * DT]


def search(
    world: World, limit: float = 60.0, config: ValveSearchConfig = CONFIG, base=DIFFERENTIAL, sight: Sight = USUAL
):
    """Runs one search -> status, time, commanded torsos (n, 3)."""
    memory, mode, torsos = Memory(), ModeState(mode="search", activation=4), []
    for k in range(int(limit / DT)):
        robot = world.tick(k)
        memory, command, status = step(
            config, memory, k * DT, DT, robot, mode, world.position, RectangleEstimate(), HEAD, drive=base, sight=sight
        )
        world.obey(command)
        torsos.append(command.torso)
        if status.state != "running":
            break
    assert status.activation == 4
    return status, k * DT, np.array(torsos), memory


FIXED = drive("fixed", [], [])


@pytest.mark.parametrize("height", [0.6, 0.81, 1.0, 1.22, 1.4])
@pytest.mark.parametrize("bearing", [-0.6, 0.0, 0.6])
def test_a_fixed_robot_finds_a_valve_within_its_reach_with_the_head_alone(bearing, height):
    p_OV = around(bearing, 0.75, height)
    world = World(p_OV, np.random.default_rng(3))
    status, time, _, memory = search(world, config=bolted(CONFIG), base=FIXED)
    assert status.state == "succeeded", status.detail
    assert np.linalg.norm(memory.target - p_OV) < 0.04 and time < 35
    assert world.base.tolist() == [0, 0, 0]


@pytest.mark.system
@pytest.mark.parametrize("pan", [0.7, 1.0, 1.3, 1.37])
def test_a_head_that_turns_little_leaves_no_direction_out(pan):
    """Without a waist, and with a neck that follows late: turns of the base close what the sweeps leave open."""
    config = dc.replace(CONFIG, sweep_yaw=pan, yaw_limit=pan, sweep_waist=0.0, pitches=[CONFIG.pitches[0]])
    for bearing in np.linspace(-np.pi, np.pi, 12, endpoint=False):
        world = World(around(bearing + 0.03, 3.0, 1.0), np.random.default_rng(3), lag=0.2)
        status, time, torsos, _ = search(world, config=config)
        assert status.state == "succeeded", (bearing, status.detail)
        assert np.abs(torsos[:, 2]).max() <= pan and time < 45


def test_eyes_with_a_long_lens_leave_no_direction_out(monkeypatch):
    """A head that turns to 80 degrees sees all round from two headings of the base by our lens, and not by theirs."""
    half = (0.12, VIEW[1])
    monkeypatch.setattr(sys.modules[__name__], "VIEW", half)
    config = dc.replace(CONFIG, sweep_yaw=1.4, yaw_limit=1.4, sweep_waist=0.0, pitches=[CONFIG.pitches[0]])
    for bearing in (1.53, 1.57, 1.61, -1.57):
        status, *_ = search(
            World(around(bearing, 3.0, 1.0), np.random.default_rng(3)), config=config, sight=Sight.of(*half)
        )
        assert status.state == "succeeded", (bearing, status.detail)


def test_a_fixed_robot_looks_down_in_steps_that_its_lens_sees():
    assert Sight.of(*VIEW) == USUAL  # ours
    half = 0.09
    pitches = bolted(CONFIG, Sight.of(half, half)).pitches
    steps = np.diff([pitch for pitch in pitches if pitch >= max(CONFIG.pitches)])
    assert steps.max() < 2 * half and max(pitches) > CONFIG.pitch_high - 2 * half


def test_a_fixed_robot_that_sees_nothing_says_so_within_the_modes_deadline():
    status, time, torsos, _ = search(World(around(np.pi, 2.0, 1.0), np.random.default_rng(3)), config=bolted(CONFIG),
                                     base=FIXED)  # fmt: skip
    assert status.verdict == "not_found" and "as far as the head turns" in status.detail and time < 50
    assert np.max(torsos[:, 1]) > CONFIG.pitch_high - 0.25  # it has looked down, too


STIFF = dc.replace(
    CONFIG, sweep_yaw=0.0, yaw_limit=0.0, sweep_waist=0.0, pitch_low=0.0, pitch_high=0.0, pitches=[0.0]
)  # a head that does not turn


@pytest.mark.parametrize("bearing", [-2.8, -1.5, -0.1, 0.7, 3.1])
def test_a_head_that_does_not_turn_is_turned_by_the_base_and_leaves_no_direction_out(bearing):
    p_OV = around(bearing, 3.0, 1.1)
    world = World(p_OV, np.random.default_rng(3), torso=np.zeros(3))
    status, time, torsos, memory = search(world, config=STIFF)
    assert status.state == "succeeded", status.detail
    assert np.linalg.norm(memory.target - p_OV) < 0.1 and time < 40
    assert not torsos.any()


def test_a_head_that_does_not_turn_has_looked_all_round_before_it_gives_up():
    world = World(None, np.random.default_rng(3), torso=np.zeros(3))
    status, time, _, _ = search(world, config=STIFF)
    assert status.verdict == "not_found" and status.detail == "no marker in 16 sweeps all round" and time < 50
    assert abs(world.base[2]) == pytest.approx(15 / 16 * 2 * np.pi, abs=0.06)  # what one turn leaves, the next makes up


@pytest.mark.parametrize("late", [0.03, 0.6])
def test_a_fixed_head_on_a_fixed_base_waits_for_images_and_looks_at_several(late):
    p_OV = around(0.0, 1.2, 1.2)
    config = bolted(STIFF)
    world = World(p_OV, np.random.default_rng(3), torso=np.zeros(3), late=late)
    status, _, _, memory = search(world, config=config, base=FIXED)
    assert status.state == "succeeded" and np.linalg.norm(memory.target - p_OV) < 0.02
    world = World(None, np.random.default_rng(3), torso=np.zeros(3), late=late)
    status, time, _, _ = search(world, config=config, base=FIXED)
    assert status.verdict == "not_found" and time > (CONFIG.confirm_looks - 1) * max(late, 1 / 8)


def around(bearing: float, distance: float, height: float) -> np.ndarray:
    return np.array([distance * np.cos(bearing), distance * np.sin(bearing), height])


# ---------------------------------------------------------------- search


@pytest.mark.parametrize(
    "bearing, distance, height",
    [
        (0.0, 3.0, 1.0),
        (1.0, 2.5, 0.81),
        (-1.7, 5.0, 1.22),
        (2.4, 1.1, 0.81),
        (-2.6, 1.1, 1.22),
        (np.pi, 6.0, 0.81),
        (-3.0, 2.0, 1.0),
        (2.0, 4.0, 1.22),
    ],
)
def test_search_finds_the_marker_wherever_it_is(bearing, distance, height):
    p_OV = around(bearing, distance, height)
    status, time, _, memory = search(World(p_OV, np.random.default_rng(3)))
    assert status.state == "succeeded", status.detail
    assert np.linalg.norm(memory.target - p_OV) < 0.05 * distance
    assert time < 45


@pytest.mark.parametrize("late", [0.2, 0.4, 0.6, 0.79])
@pytest.mark.parametrize("bearing", [0.4, -2.2])
def test_a_slow_camera_makes_the_search_slower_and_not_blind(bearing, late):
    p_OV = around(bearing, 3.0, 1.0)
    status, time, _, memory = search(World(p_OV, np.random.default_rng(3), late=late))
    assert status.state == "succeeded", status.detail
    assert np.linalg.norm(memory.target - p_OV) < 0.15 and time < 40


def test_without_images_the_gaze_waits_where_nothing_is_missed():
    world = World(around(1.5, 3.0, 1.0), np.random.default_rng(3), late=1e9)
    status, _, torsos, _ = search(world, limit=10)
    assert status.state == "running"
    assert np.abs(torsos[:, 0] + torsos[:, 2]).max() < CONFIG.ahead + 0.05


def test_search_of_a_marker_within_the_first_half_circle_takes_under_12_s():
    for bearing, distance in itertools.product((-1.5, 0.7), (2.5, 4.5)):
        status, time, _, _ = search(World(around(bearing, distance, 1.0), np.random.default_rng(1)))
        assert status.state == "succeeded" and time < 12


def test_search_without_a_marker_looks_all_round_at_every_pitch_and_fails_with_not_found():
    world = World(None, np.random.default_rng(0))
    looked = []
    shot = world._shot
    world._shot = lambda t, n, X: looked.append(X[:, 2]) or shot(t, n, X)
    status, time, _, _ = search(world)
    assert (status.state, status.verdict) == ("failed", Verdict.NOT_FOUND)
    assert time < 55  # before the supervisor's deadline
    axes = np.array(looked)
    down = -np.arcsin(axes[:, 2])
    for pitch in CONFIG.pitches:
        azimuth = np.sort(np.arctan2(axes[:, 1], axes[:, 0])[np.abs(down - pitch) < 0.02])
        gaps = np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi))
        assert gaps.max() < 2 * VIEW[0] - np.arctan(BASELINE / 2.5)  # both cameras, from 2.5 m on


def test_search_is_not_fooled_by_scattered_sightings_and_still_finds_the_marker():
    p_OV = around(2.0, 3.0, 1.0)
    status, _, _, memory = search(World(p_OV, np.random.default_rng(7), ghosts=0.3))
    assert status.state == "succeeded"
    assert np.linalg.norm(memory.target - p_OV) < 0.15


def test_search_full_of_scattered_sightings_never_succeeds():
    status, _, _, _ = search(World(None, np.random.default_rng(2), ghosts=0.5), limit=30)
    assert status.state != "succeeded"


def test_search_looks_aside_for_a_second_then_moves_on_deaf_then_listens_again():
    robot, mode, memory = robot_state(), ModeState(mode="search", activation=1), Memory()
    gaze, position, shown = [], StereoPosition(), (0.5, 1.75, 2.5)  # one sighting at each of these times
    for k in range(int(3 / DT)):
        if k % 8 == 0 and memory.torso is not None:
            X_OL = HEAD(np.zeros(3), memory.torso)
            position = StereoPosition(time=k * DT, X_OL=X_OL)
            if k * DT in shown:
                position = dc.replace(position, found=True, p_LV=np.array([k * DT, 0, 3.0]))
        memory, _, status = step(CONFIG, memory, k * DT, DT, robot, mode, position, RectangleEstimate(), HEAD)
        gaze.append(memory.gaze)
    sweeping = np.diff(gaze) != 0

    def share(start, end):
        return np.mean(sweeping[int(start / DT) : int(end / DT)])

    assert status.state == "running"
    assert share(0.2, 0.45) == 1
    assert share(0.52, 1.48) == 0  # looks at the first
    assert share(2.0, 2.48) == 1  # the second came too soon
    assert share(2.52, 2.98) == 0  # looks at the third


def test_search_ignores_images_from_before_it_began():
    old = StereoPosition(time=9.0, found=True, p_LV=np.array([0, 0, 3.0]), covariance=np.eye(3) * 1e-6)
    robot = robot_state(time=10.0)
    memory, mode = Memory(), ModeState(mode="search", activation=1)
    for k in range(20):
        old = dc.replace(old, time=9.0 + 0.01 * k)
        memory, _, status = step(CONFIG, memory, 10 + k * DT, DT, robot, mode, old, RectangleEstimate(), HEAD)
    assert status.state == "running" and not memory.looks


def test_search_stops_the_base_when_it_sees_something_while_turning():
    world = World(around(np.pi, 3.0, 1.0), np.random.default_rng(3))
    memory, mode, states, rates = Memory(), ModeState(mode="search", activation=4), ["running"], [0.0]
    while states.count("succeeded") < 1 / DT:  # a second beyond the success
        robot = world.tick(len(states))
        memory, command, status = step(
            CONFIG, memory, robot.time, DT, robot, mode, world.position, RectangleEstimate(), HEAD
        )
        world.obey(command)
        states.append(status.state)
        rates.append(command.base_twist[1])
    assert np.max(np.abs(rates)) == pytest.approx(CONFIG.turn_speed)
    assert 0.5 < abs(world.base[2]) < 2.8  # it did not turn on to the end of its half turn
    assert rates[-1] == 0.0 and abs(world.rate) < 0.01


def test_torso_commands_start_where_the_robot_is_and_stay_within_speed_and_range():
    world = World(around(2.5, 3.0, 1.0), np.random.default_rng(3), torso=np.array([0.2, 0.3, -1.0]))
    _, _, torsos, _ = search(world)
    speed = np.array([CONFIG.waist_speed, CONFIG.neck_speed, CONFIG.neck_speed])
    assert np.all(np.abs(torsos[0] - [0.2, 0.3, -1.0]) <= speed * DT)
    assert np.all(np.abs(np.diff(torsos, axis=0)) <= speed * DT + 1e-12)
    assert np.all(np.abs(torsos) <= [0.6, 1.1, 1.6])


def test_nothing_is_commanded_before_the_robot_was_measured():
    memory, command, status = step(
        CONFIG, Memory(), 0.0, DT, RobotState(), ModeState(mode="search"), StereoPosition(), RectangleEstimate(), HEAD
    )
    assert command.torso is None and command.base_twist is None and status.state == "idle"


# ---------------------------------------------------------------- gaze


@pytest.mark.parametrize("waist", [-0.4, 0.0, 0.3])
@pytest.mark.parametrize("point", [(1.0, 0.3, 0.8), (0.7, -0.2, 0.81), (4.0, 3.0, 1.2), (-0.5, 1.5, 1.0)])
def test_aim_puts_a_point_on_the_optical_axis(waist, point):
    base, p_OV = np.array([0.1, -0.2, 0.3]), np.array(point)
    neck = np.zeros(2)
    for _ in range(8):  # ticks
        neck = aim(HEAD, base, np.array([waist, *neck]), p_OV)
    x, y, z = apply(inverse(HEAD(base, np.array([waist, *neck]))), p_OV)
    assert z > 0 and np.hypot(x, y) / z < 1e-4


def gaze(
    mode: str,
    p_OV: np.ndarray,
    seconds: float,
    *,
    base=lambda t: np.zeros(3),
    source="position",
    torso=None,
    config=CONFIG,
    until=np.inf,
):
    """Gaze in one mode on a marker that is always seen, `until` then -> torsos (n, 3), last status, memory."""
    memory = Memory()
    torso = np.zeros(3) if torso is None else torso
    torsos = []
    for k in range(int(seconds / DT)):
        t = k * DT
        pose = base(t)
        X_OL = HEAD(pose, torso)
        p_L = apply(inverse(X_OL), p_OV)
        position, estimate = StereoPosition(), RectangleEstimate()
        if t > until:
            pass
        elif source == "position":
            position = StereoPosition(time=t, found=True, p_LV=p_L, X_OL=X_OL)
        elif source == "estimate":
            estimate = RectangleEstimate(time=t, found=True, X_LV=make(np.eye(3), p_L), X_OL=X_OL)
        robot = RobotState(time=t, odometry=np.array([*pose, 0, 0]), torso=torso, history=np.zeros((1, 7)))
        state = ModeState(mode=mode, activation=2)
        memory, command, status = step(config, memory, t, DT, robot, state, position, estimate, HEAD)
        torso = command.torso
        torsos.append(torso)
    return np.array(torsos), status, memory


@pytest.mark.parametrize("mode", [m.value for m in Mode if m != Mode.SEARCH])
@pytest.mark.parametrize("source", ["position", "estimate"])
def test_gaze_centres_the_marker_in_every_mode_with_the_waist_back_at_zero(mode, source):
    p_OV = np.array([0.7, 0.25, 0.9])
    torsos, _, _ = gaze(mode, p_OV, 3.0, source=source, torso=np.array([0.4, 0.0, -0.5]))
    x, y, z = apply(inverse(HEAD(np.zeros(3), torsos[-1])), p_OV)
    assert np.hypot(x, y) / z < 1e-3
    assert torsos[-1][0] == 0.0
    assert np.max(np.abs(np.diff(torsos[:, 0]))) <= CONFIG.waist_speed * DT + 1e-12


def test_gaze_keeps_the_marker_centred_while_the_base_turns_and_drives():
    p_OV = np.array([2.0, 0.5, 1.0])

    def base(t):
        return np.array([0.5 * t, 0.0, 0.6 * np.sin(t)])

    torsos, _, _ = gaze("rough_approach", p_OV, 2.0, base=base)
    for k in range(int(0.5 / DT), len(torsos)):
        x, y, z = apply(inverse(HEAD(base(k * DT), torsos[k])), p_OV)
        assert np.hypot(x, y) / z < np.deg2rad(1)


def test_gaze_takes_the_fresher_of_both_stages():
    memory = Memory()
    robot = robot_state()
    near, far = np.array([0.0, 0.0, 2.0]), np.array([0.1, 0.0, 2.0])
    for newer in ("position", "estimate"):
        times = {"position": 1.0, "estimate": 1.0} | {newer: 1.1}
        position = StereoPosition(time=times["position"], found=True, p_LV=near)
        estimate = RectangleEstimate(time=times["estimate"], found=True, X_LV=make(np.eye(3), far))
        memory, _, _ = step(CONFIG, Memory(), 1.2, DT, robot, ModeState(), position, estimate, HEAD)
        assert np.array_equal(memory.target, near if newer == "position" else far)


def test_gaze_does_not_follow_a_single_false_sighting_but_a_marker_that_moved():
    robot = robot_state()
    memory = Memory()

    def see(t, p):
        nonlocal memory
        position = StereoPosition(time=t, found=True, p_LV=np.array(p, float))
        memory, _, _ = step(CONFIG, memory, t, DT, robot, ModeState(), position, RectangleEstimate(), HEAD)
        return memory.target

    see(1.0, (0, 0, 3))
    assert np.array_equal(see(1.125, (1.5, 0, 3)), [0, 0, 3])
    assert np.array_equal(see(1.25, (0, 0, 3.01)), [0, 0, 3.01])
    for k in range(1, 6):
        target = see(1.25 + k / 8, (1.5, 0, 3))
    assert np.array_equal(target, [1.5, 0, 3])


def looked(modes, *places) -> list:
    """The last status after an image at each place, in the modes one after the other."""
    memory, k, out = Memory(), 0, []
    for activation, (mode, count) in enumerate(modes):
        for place in places[k : k + count]:
            k += 1
            estimate = RectangleEstimate(time=k + 0.2, found=True, X_LV=make(np.eye(3), np.array([*place, 1.0])))
            state = ModeState(mode=mode, activation=activation)
            inputs = (robot_state(), state, StereoPosition(), estimate, HEAD)
            memory, _, status = step(CONFIG, memory, k + 0.1, DT, *inputs)
        out.append(status)
    return out


HERE, THERE, NEAR_BY = (0.0, 0.0), (0.1, 0.0), (0.02, 0.01)


@pytest.mark.parametrize("modes", [[("measure", 1), ("reach", 2)], [("measure", 1), ("reach", 1), ("servo", 2)]])
def test_a_valve_that_was_moved_while_the_hands_are_on_their_way_is_noticed_by_two_looks(modes):
    count = sum(n for _, n in modes)
    moved = looked(modes, *[HERE] * (count - 2), THERE, THERE)[-1]
    assert (moved.state, moved.cause) == ("failed", Cause.MOVED)
    assert "100 mm from where it was measured" in moved.detail
    for last in ([HERE, THERE], [THERE, HERE], [NEAR_BY, NEAR_BY], [THERE, (-0.1, 0.0)]):
        assert looked(modes, *[HERE] * (count - 2), *last)[-1].state == "idle"


def test_a_move_is_forgotten_by_the_next_measurement_and_none_while_the_hands_go_the_same_way():
    again = [("measure", 1), ("reach", 2), ("fold", 1), ("measure", 1), ("reach", 2)]
    assert looked(again, HERE, *[THERE] * 6)[-1].state == "idle"
    way = [("measure", 1), ("reach", 1), ("servo", 1), ("grasp", 1), ("release", 1), ("reach", 2)]
    assert looked(way, HERE, HERE, HERE, THERE, THERE, THERE, THERE)[-1].cause == Cause.MOVED


def test_gaze_survives_a_sighting_that_is_not_finite():
    torsos, _, memory = gaze("measure", np.array([2.0, np.nan, 1.0]), 0.5)
    assert np.all(np.isfinite(torsos)) and memory.target is None


def test_neck_stays_within_its_limits_and_the_waist_helps_only_while_driving():
    p_OV = np.array([-1.0, 1.0, 1.0])  # 135 deg to the left
    for mode, waist in (("fine_approach", CONFIG.sweep_waist), ("reach", 0.0)):
        torsos, _, _ = gaze(mode, p_OV, 4.0)
        assert torsos[-1][0] == pytest.approx(waist, abs=1e-9)
        assert np.max(np.abs(torsos[:, 2])) <= CONFIG.yaw_limit
        assert torsos[-1][2] == pytest.approx(CONFIG.yaw_limit)


def test_without_any_sighting_the_neck_stays():
    torsos, _, _ = gaze("idle", np.zeros(3), 1.0, source="none", torso=np.array([0.0, 0.3, 0.2]))
    assert np.allclose(torsos, [0.0, 0.3, 0.2])


# ---------------------------------------------------------------- lost


@pytest.mark.parametrize("mode", [m.value for m in Mode if m != Mode.SEARCH])
def test_a_lost_marker_fails_where_it_matters_and_nowhere_else(mode):
    matters = mode in ("rough_approach", "fine_approach", "measure")
    _, status, _ = gaze(mode, np.zeros(3), CONFIG.lost_after - 0.1, source="none")
    assert status.state == ("running" if matters else "idle")
    _, status, _ = gaze(mode, np.zeros(3), CONFIG.lost_after + 0.1, source="none")
    assert (status.state, status.verdict) == (("failed", Verdict.MARKER_LOST) if matters else ("idle", ""))
    assert status.activation == 2


def test_a_marker_that_is_seen_is_not_lost():
    _, status, _ = gaze("measure", np.array([1.0, 0.0, 1.0]), CONFIG.lost_after + 0.5)
    assert status.state == "running"


def test_a_marker_that_a_stiff_neck_cannot_face_is_not_lost_while_the_base_drives_across():
    """A base that drives aside to its stance turns from the marker by more than neck and waist make up for."""
    stiff = dc.replace(CONFIG, yaw_limit=0.5, sweep_yaw=0.5, sweep_waist=0.0)

    def base(t):
        return np.array([0.0, 0.0, 1.6 if 0.5 < t < 5.0 else 0.0])

    def state(mode, seconds):
        return gaze(mode, np.array([2.0, 0.0, 1.0]), seconds, base=base, config=stiff, until=0.5)[1].state

    assert state("fine_approach", 4.9) == "running" and state("measure", 4.9) == "failed"
    assert state("fine_approach", 5.0 + CONFIG.lost_after - 0.1) == "running"
    assert state("fine_approach", 5.0 + CONFIG.lost_after + 0.1) == "failed", "it faces where the marker was"


# ---------------------------------------------------------------- block


def rig(**inputs) -> Rig:
    robot = robot_state(time=0.0)
    return Rig(
        ValveSearchSystem(CONFIG, HEAD, GAZE),
        **{"robot_state": robot, "mode": ModeState(mode="search", activation=1)} | inputs,
    )


def test_ports():
    assert ports(ValveSearchSystem(CONFIG, HEAD, GAZE)) == {
        "robot_state": "in abstract",
        "mode": "in abstract",
        "position": "in abstract",
        "estimate": "in abstract",
        "stance": "in abstract",
        "command": "out abstract",
        "status": "out abstract",
    }


@pytest.mark.parametrize(
    ("rest", "gaze"), [([0.3], (None, None, None)), ([0.3, 0.1], (None, 1, None)), ([0.3, 0.2, 0.1], (1, None, 2))]
)
def test_joints_that_a_head_lacks_are_not_commanded_and_count_as_zero(rest, gaze):
    rest = np.array(rest)

    def head(base, torso):
        assert torso.shape == rest.shape
        return HEAD(base, np.array([0.0 if joint is None else torso[joint] for joint in gaze]))

    block = ValveSearchSystem(CONFIG, head, Gaze(gaze, rest))
    seen = block._seen(robot_state(torso=rest)).torso
    assert seen.tolist() == [0.0 if joint is None else rest[joint] for joint in gaze]
    dut = Rig(
        block,
        robot_state=robot_state(torso=rest, history=np.zeros((1, 4 + len(rest)))),
        mode=ModeState(mode="measure", activation=2),
        position=StereoPosition(0.1, 1, True, np.array([0.3, 0.2, 2.0]), 1e-6 * np.eye(3), HEAD(np.zeros(3), seen)),
    )
    torso = dut.run(1.0).read("command").torso
    assert torso.shape == rest.shape and torso[0] == 0.3
    for joint in gaze[1:]:
        assert joint is None or abs(torso[joint] - rest[joint]) > 0.02


@pytest.mark.parametrize(("rest", "waist"), [([0.3, 0.1, 0.0], None), ([0.3, 0.0, 0.1, 0.0], 1)])
def test_a_lift_stays_where_it_rests_and_a_robot_without_a_waist_turns_its_head_alone(rest, waist):
    rest = np.array(rest)
    gazes = []

    def head(base, torso):
        assert torso.shape == rest.shape
        gazes.append(torso)
        return HEAD(base, np.array([0.0 if waist is None else torso[waist], *torso[-2:]]))

    dut = Rig(
        ValveSearchSystem(CONFIG, head, Gaze((waist, len(rest) - 2, len(rest) - 1), rest)),
        robot_state=robot_state(torso=rest, history=np.zeros((1, 4 + len(rest)))),
        mode=ModeState(mode="search", activation=1),
    )
    swept = []
    for k in range(1, 60):
        dut.fix(position=StereoPosition(time=k / 16, sequence=k, X_OL=HEAD(np.zeros(3), np.array([0, 0.1, 0.02 * k]))))
        swept.append(dut.run(k / 16).read("command").torso)
    swept = np.array(swept)
    assert np.all(swept[:, 0] == 0.3)  # the lift
    assert np.ptp(swept[:, -1]) > 0.2  # pan
    if waist is not None:
        assert np.ptp(swept[:, waist]) > 0.05
    dut.fix(  # a sighting is centred: tilt and pan of the robot's own joints
        mode=ModeState(mode="measure", activation=2),
        position=StereoPosition(4.0, 99, True, np.array([0.0, 0.3, 2.0]), X_OL=HEAD(np.zeros(3), np.zeros(3))),
    )
    assert dut.run(4.5).read("command").torso[-2] > rest[-2] + 0.02 and gazes


def test_block_begins_its_sweep_with_open_perception_ports_and_waits_for_an_image():
    dut = rig().run(1.0)
    assert 0.2 < abs(dut.read("command").torso[2]) < CONFIG.ahead
    assert dut.read("command").base_twist is not None
    assert (dut.read("status").activation, dut.read("status").state) == (1, "running")


def test_block_holds_its_outputs_between_updates():
    for port in ("command", "status"):
        assert_holds_between_updates(rig(), port, slot=1, period=2 * TICK)


def test_block_clones_are_independent():
    assert_clones_are_independent(rig, {"mode": ModeState(mode="idle", activation=2)}, ("command", "status"))


def test_block_refuses_a_wrong_message_and_needs_the_mode():
    with pytest.raises(TypeError, match="want StereoPosition"):
        rig(position=RectangleEstimate()).run(0.1)
    with pytest.raises(RuntimeError, match="mode.*valve_search.*nothing is connected"):
        Rig(ValveSearchSystem(CONFIG, HEAD, GAZE), robot_state=robot_state()).run(0.1)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"sweep_speed": -1.0}, "valve_search.sweep_speed"),
        ({"pitches": []}, "valve_search.pitches"),
        ({"pitches": [2.0]}, "valve_search.pitches"),
        ({"pitch_low": 2.0}, "valve_search.pitch_low"),
        ({"sweep_yaw": 1.6}, "valve_search.sweep_yaw"),
        ({"lost_after": float("nan")}, "valve_search.lost_after"),
    ],
)
def test_bad_config_is_refused_by_name(changes, words):
    with pytest.raises(ConfigError, match=words):
        ValveSearchSystem(ValveSearchConfig(**changes), HEAD, GAZE)
