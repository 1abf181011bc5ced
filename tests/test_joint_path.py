"""joint_path: a path is free, continuous and within its speed and acceleration; a blocked goal has none."""

import numpy as np
import pytest

from valve_drake.behaviors.joint_path import PORTION, STEP, Path, PathSearch, find_path, line_is_free

SPEED, ACCELERATION = 0.9, 2.0


def random_points(rng, count: int, size: float) -> np.ndarray:
    return np.cumsum(rng.uniform(-size, size, (count, 12)), axis=0)


# ---------------------------------------------------------------- timing


@pytest.mark.parametrize("size", [1e-3, 0.05, 0.5, 2.0])  # legs too short for full speed, and long ones
def test_speed_and_acceleration_stay_within_their_limits(size):
    rng = np.random.default_rng(1)
    for _ in range(3):
        path = Path(random_points(rng, 4, size), 1.0, SPEED, ACCELERATION)
        dt = path.end() / 3000
        t = np.arange(path.start - 5 * dt, path.end() + 5 * dt, dt)
        q = np.array([path.sample(x) for x in t])
        speed = np.diff(q, axis=0) / dt
        acceleration = np.diff(speed, axis=0) / dt
        assert np.abs(speed).max() <= SPEED * (1 + 1e-9)
        assert np.abs(acceleration).max() <= ACCELERATION * (1 + 1e-6)
        # and it uses them: the fastest joint is at one of them most of the time
        lead = np.abs(speed).max(axis=1) > 0.98 * min(SPEED, np.abs(speed).max())
        push = np.abs(acceleration).max(axis=1) > 0.98 * ACCELERATION
        inside = (t[2:] > path.start) & (t[2:] < path.end())
        assert np.mean((lead[1:] | push)[inside]) > 0.95


@pytest.mark.system
@pytest.mark.parametrize("size", [0.05, 0.5, 2.0])
def test_no_joint_is_faster_than_its_own_limit_and_one_of_them_is_as_fast(size):
    limits = np.array([0.1, 2.0, 0.5, 0.4, 3.0, 0.9] * 2)
    points = random_points(np.random.default_rng(3), 4, size)
    points = np.vstack([points, points[-1:], points[-1:] + np.eye(12)[1]])  # a leg without length; one of a fast joint
    path = Path(points, 1.0, SPEED, ACCELERATION, limits)
    dt = path.end() / 20000
    q = np.array([path.sample(t) for t in np.arange(path.start, path.end() + dt, dt)])
    speed = np.abs(np.diff(q, axis=0)) / dt
    most = np.minimum(limits, SPEED)
    assert (speed <= most * (1 + 1e-9)).all() and speed[:, 1].max() == pytest.approx(SPEED)
    assert size < 0.5 or speed[:, 0].max() > 0.98 * limits[0]
    assert q[-1] == pytest.approx(points[-1])


def test_limits_that_no_joint_needs_change_no_leg():
    points = random_points(np.random.default_rng(4), 6, 0.6)
    plain = Path(points, 0.0, SPEED, ACCELERATION).durations()
    assert Path(points, 0.0, SPEED, ACCELERATION, np.full(12, SPEED)).durations() == pytest.approx(plain, rel=1e-12)


def test_it_rests_at_every_way_point_and_beyond_both_ends():
    points = random_points(np.random.default_rng(2), 5, 0.6)
    path = Path(points, 2.0, SPEED, ACCELERATION)
    arrivals = path.start + np.concatenate([[0], np.cumsum(path.durations())])
    assert arrivals[-1] == pytest.approx(path.end())
    for t, point in zip(arrivals, points):
        assert path.sample(t) == pytest.approx(point, abs=1e-9)
        assert np.abs(path.sample(t + 1e-3) - path.sample(t - 1e-3)).max() < 1e-5
    assert np.array_equal(path.sample(-5.0), points[0])
    assert np.array_equal(path.sample(1e3), points[-1])


def test_joints_move_along_straight_lines_between_way_points():
    points = random_points(np.random.default_rng(3), 2, 0.8)
    path = Path(points, 0.0, SPEED, ACCELERATION)
    for t in np.linspace(0, path.end(), 20):
        share = (path.sample(t) - points[0]) / (points[1] - points[0])
        assert share == pytest.approx(np.full(12, share[0]), abs=1e-9)
        assert -1e-12 <= share[0] <= 1 + 1e-12


def test_a_leg_without_length_takes_no_time():
    a, b = np.zeros(12), np.ones(12)
    path = Path(np.array([a, a, b, b]), 0.0, SPEED, ACCELERATION)
    direct = Path(np.array([a, b]), 0.0, SPEED, ACCELERATION)
    assert path.end() == pytest.approx(direct.end())
    for t in np.linspace(-0.1, path.end() + 0.1, 50):
        assert path.sample(t) == pytest.approx(direct.sample(t), abs=1e-9)


# ---------------------------------------------------------------- search


class Ball:
    """A forbidden ball in the first two joints; counts the questions."""

    def __init__(self, centre=(0.5, 0.0), radius=0.35):
        self.centre, self.radius, self.asked = np.array(centre), radius, 0

    def __call__(self, q: np.ndarray) -> bool:
        self.asked += 1
        return bool(np.linalg.norm(q[:2] - self.centre) > self.radius)


def joints(*first: float) -> np.ndarray:
    return np.concatenate([first, np.zeros(12 - len(first))])


def check_free(points: np.ndarray, is_free) -> None:
    """At a finer step than the search's own."""
    for a, b in zip(points, points[1:]):
        for s in np.linspace(0, 1, max(2, int(np.abs(b - a).max() / (STEP / 4)))):
            q = a + s * (b - a)
            assert is_free(q) or np.linalg.norm(q[:2] - is_free.centre) > is_free.radius - STEP


def test_a_free_line_is_taken_as_it_is():
    points = find_path(joints(0, 1), joints(1, 1), [], Ball())
    assert np.array_equal(points, [joints(0, 1), joints(1, 1)])


def test_a_via_that_serves_is_taken_before_any_search():
    ball = Ball()
    beyond, before = joints(1.1), joints(-0.1)  # seen from one end only
    points = find_path(joints(0), joints(1), [joints(0.5, 0.1), beyond, before, joints(0.5, 0.9)], ball)
    assert np.array_equal(points, [joints(0), joints(0.5, 0.9), joints(1)])
    assert ball.asked < 100


@pytest.mark.parametrize(
    "start, goal", [((0,), (1,)), ((1,), (0,)), ((0.1, -0.3), (0.9, 0.4)), ((0.5, 0.5), (0.5, -0.5))]
)
def test_the_search_goes_round_an_obstacle(start, goal):
    ball = Ball()
    points = find_path(joints(*start), joints(*goal), [], ball)
    assert np.array_equal(points[0], joints(*start)) and np.array_equal(points[-1], joints(*goal))
    for k in range(len(points) - 2):  # no way point that could be left out
        assert not line_is_free(points[k], points[k + 2], ball)
    assert np.abs(np.diff(points, axis=0)).max(axis=1).min() > 0
    check_free(points, ball)


def test_the_search_finds_its_way_out_of_a_pocket():
    """A wall with one gap, both arms' joints in it."""

    class Wall:
        centre, radius = np.zeros(2), 0.0

        def __call__(self, q):
            return bool(abs(q[0] - 0.5) > 0.08 or 0.35 < q[7] < 0.75)

    points = find_path(joints(0), joints(1), [], Wall())
    assert points is not None
    check_free(points, Wall())


def test_the_same_problem_has_the_same_path():
    a, b = (find_path(joints(0), joints(1), [], Ball()) for _ in range(2))
    assert a.tobytes() == b.tobytes()


def test_a_portion_asks_few_questions_and_portions_make_the_same_path():
    """However long the lines are: nobody waits for more than PORTION answers."""
    ball, most = Ball(), 0
    search = PathSearch(joints(0), joints(1), (joints(0.5, 0.1),))
    while not search.done:
        before = ball.asked
        search = search.advance(ball)
        most = max(most, ball.asked - before)
    assert 0 < most <= PORTION
    assert search.points.tobytes() == find_path(joints(0), joints(1), [joints(0.5, 0.1)], Ball()).tobytes()


def test_a_blocked_goal_has_no_path_and_costs_one_question():
    ball = Ball()
    assert find_path(joints(0), joints(0.5), [joints(0.5, 0.9)], ball) is None
    assert ball.asked == 1


def test_a_goal_walled_in_has_no_path_and_the_search_ends():
    asked = []

    def is_free(q):
        asked.append(q)
        return abs(q[0] - 0.5) > 0.1  # a wall without a gap

    assert find_path(joints(0), joints(1), [], is_free, tries=60) is None
    assert len(asked) < 3000


def test_a_start_that_touches_may_be_left():
    ball = Ball(centre=(0.0, 0.0), radius=0.05)
    assert not ball(joints(0))
    assert find_path(joints(0), joints(1), [], ball) is not None


def test_a_line_is_checked_at_steps_that_no_joint_exceeds_its_end_included():
    seen = []
    assert line_is_free(joints(0), joints(1.0, -0.5), lambda q: not seen.append(q))
    x = np.sort([q[0] for q in seen])
    assert x[-1] == 1.0 and x[0] > 0
    assert np.diff(np.concatenate([[0], x])).max() <= STEP + 1e-12
    assert not line_is_free(joints(0), joints(1.0), lambda q: q[0] < 1.0)
