"""base_approach: on a unicycle with limits, lag, delay and noise it arrives, stays off the panel, fails honestly."""

import dataclasses as dc

import numpy as np
import pytest
from helpers import Rig, assert_clones_are_independent, assert_holds_between_updates, ports
from robot_facts import ROBOT

from valve_drake.behaviors import base_approach, valve_search
from valve_drake.behaviors.base_approach import BaseApproachConfig, MedianPlace, Memory, bounded, step
from valve_drake.behaviors.base_approach_system import BaseApproachSystem
from valve_drake.checks import ConfigError
from valve_drake.frames import apply, inverse, make, rot_z, wrap
from valve_drake.messages import (
    Command,
    Mode,
    ModeState,
    RectangleEstimate,
    RobotState,
    Stance,
    Status,
    StereoPosition,
    Verdict,
)
from valve_drake.ports import TICK
from valve_drake.robot.drive import DIFFERENTIAL
from valve_drake.robot.drive import drive as base_drive
from valve_drake.valve.valve import Valve

DT = 1 / 64  # half the real rate: the laws do not depend on it, and the tests are quicker
CONFIG = BaseApproachConfig()
VALVE = Valve()
DEPTH = 0.131  # of our panel behind the marker [m]
STANCE = 0.72  # base to the panel [m]


@dc.dataclass
class Wheels:
    """A differential drive: the command arrives two ticks late, is followed with a lag, within acceleration limits."""

    pose: np.ndarray  # x, y, heading
    twist: np.ndarray = dc.field(default_factory=lambda: np.zeros(2))
    queue: list = dc.field(default_factory=lambda: [np.zeros(2)] * 2)

    def drive(self, command: np.ndarray) -> None:
        self.queue.append(command)
        wanted = self.queue.pop(0)
        self.twist = self.twist + np.clip((wanted - self.twist) / 0.08, [-1.0, -2.5], [1.0, 2.5]) * DT
        v, w = self.twist
        middle = self.pose[2] + w * DT / 2
        self.pose = self.pose + DT * np.array([v * np.cos(middle), v * np.sin(middle), w])


OMNI = base_drive("holonomic", [0.8, 0.5, 1.2], [0.8, 0.6, 2.0])
FIXED = base_drive("fixed", [], [])


@dc.dataclass
class Omniwheels(Wheels):
    """The same of a base that goes sideways, too."""

    twist: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))
    queue: list = dc.field(default_factory=lambda: [np.zeros(3)] * 2)

    def drive(self, command: np.ndarray) -> None:
        self.queue.append(command)
        wanted = self.queue.pop(0)
        self.twist = self.twist + np.clip((wanted - self.twist) / 0.08, [-1, -1, -2.5], [1, 1, 2.5]) * DT
        v, u, w = self.twist
        c, s = np.cos(self.pose[2] + w * DT / 2), np.sin(self.pose[2] + w * DT / 2)
        self.pose = self.pose + DT * np.array([v * c - u * s, v * s + u * c, w])


@dc.dataclass
class Bolted:
    pose: np.ndarray
    twist: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))

    def drive(self, command: None) -> None:
        assert command is None  # nobody asks it to move


def valve(depth: float) -> Valve:
    """Our valve, its panel so far behind its marker."""
    return dc.replace(VALVE, panel=dc.replace(VALVE.panel, depth=depth + VALVE.marker.xyz[2]))


@dc.dataclass
class Scene:
    """A marker at (x, y, heading of the normal into the panel); what stages 1 to 3 say of it, 8 times a second."""

    marker: np.ndarray
    rng: np.random.Generator
    noise: float = 1.0
    depth: float = DEPTH  # of the panel behind the marker [m]

    def stance(self) -> np.ndarray:
        x, y, h = self.marker
        back = STANCE - self.depth
        return np.array([x - back * np.cos(h), y - back * np.sin(h), h])

    def clear(self, poses: np.ndarray) -> float:
        """Base centre to the panel's plane, the least of all poses (..., 3)."""
        h = self.marker[2]
        return float(np.min((self.marker[:2] - poses[..., :2]) @ [np.cos(h), np.sin(h)])) + self.depth

    def look(self, time: float, pose: np.ndarray) -> tuple[StereoPosition, RectangleEstimate, Stance]:
        far = np.hypot(*(self.marker - pose)[:2]) * self.noise
        shift = self.rng.normal(size=3) * np.array([0.003, 0.003, np.deg2rad(0.4)]) * far
        x, y, h = self.marker + shift
        normal = np.array([np.cos(h), np.sin(h), 0.0])
        R = np.column_stack([np.cross([0.0, 0, -1], normal), [0.0, 0, -1], normal])
        seen = Scene(self.marker + shift, self.rng, depth=self.depth)
        return (
            StereoPosition(time=time, found=True, p_LV=np.array([x, y, 1.0]), covariance=np.eye(3) * 1e-4),
            RectangleEstimate(time=time, found=True, X_LV=make(R, np.array([x, y, 1.0]))),
            Stance(time=time, found=True, base=seen.stance(), margin=0.5),
        )


@dc.dataclass
class Run:
    status: Status
    time: float
    poses: np.ndarray  # (n, 3)
    twists: np.ndarray  # commanded (n, 2)
    details: set


def drive(
    mode,
    wheels,
    scene,
    *,
    limit=40.0,
    config=CONFIG,
    alter=None,
    visible=None,
    watch=None,
    scale=1.0,
    base=DIFFERENTIAL,
):
    """Runs one activation until it ends -> Run.

    alter(t, messages) changes what is seen, visible() says whether anything is,
    watch(robot_state, mode, messages) is called each tick. scale: of the odometry's distances.
    """
    memory, poses, twists, details = Memory(), [], [], set()
    seen = (StereoPosition(), RectangleEstimate(), Stance())
    state = ModeState(mode=mode.value, activation=3)
    for k in range(int(limit / DT)):
        t = k * DT
        if k % 8 == 4 and (visible is None or visible()):
            seen = scene.look(t, wheels.pose)
            seen = alter(t, seen) if alter else seen
        units = [scale, scale, 1, *[scale] * (len(wheels.twist) - 1), 1][: 3 + len(wheels.twist)]
        odometry = np.concatenate([wheels.pose, wheels.twist]) * units
        if scene.noise:
            odometry[:3] += scene.rng.normal(size=3) * np.array([3e-4, 3e-4, 3e-4])
        robot = RobotState(time=t, odometry=odometry)
        if watch:
            watch(robot, state, seen)
        memory, command, status = step(config, valve(scene.depth), memory, t, DT, robot, state, *seen, base)
        wheels.drive(command.base_twist)
        poses.append(wheels.pose)
        twists.append(command.base_twist)
        details.add(status.detail.split(":")[0])
        if status.state != "running":
            break
    assert status.activation == 3
    return Run(status, t, np.array(poses), np.array(twists), details)


def place(scene: Scene, bearing: float, distance: float, off: float = 0.0) -> np.ndarray:
    """A base at `distance` from the marker, `bearing` from its normal, looking at it but for `off`."""
    x, y, h = scene.marker
    towards = h + bearing
    return np.array([x - distance * np.cos(towards), y - distance * np.sin(towards), wrap(towards + off)])


def random_scene(rng) -> Scene:
    return Scene(np.array([*rng.uniform(-3, 3, 2), rng.uniform(-np.pi, np.pi)]), rng)


def random_start(rng) -> tuple[Scene, np.ndarray]:
    """A scene, and a base where rough_approach may have left it."""
    scene = random_scene(rng)
    return scene, place(scene, rng.uniform(-1, 1) * np.deg2rad(70), rng.uniform(1.2, 2.2), rng.uniform(-0.3, 0.3))


def assert_arrived(run: Run, scene: Scene) -> None:
    assert run.status.state == "succeeded", run.status.detail
    error = run.poses[-1] - scene.stance()
    assert np.hypot(*error[:2]) < 0.020  # tolerance, and the noise of the stance itself
    assert abs(wrap(error[2])) < np.deg2rad(1.4)


def assert_clear(run: Run, scene: Scene, start: np.ndarray) -> None:
    """Never nearer than the clearance; a start that is nearer may only move away."""
    nearest = min(scene.clear(start), CONFIG.clearance)
    assert scene.clear(run.poses) > nearest - 0.001


@dc.dataclass
class Post(Scene):
    """A valve that lies flat on a post: `marker` has the heading of the stance, which may be on any side."""

    depth: float = 0.22  # the stance is half a metre from the stem

    def look(self, time, pose):
        found = super().look(time, pose)
        flat = make(np.diag([1.0, -1.0, -1.0]), found[1].X_LV[:, 3])
        return found[0], dc.replace(found[1], X_LV=flat), found[2]


# ---------------------------------------------------------------- fine approach


@pytest.mark.parametrize("base, wheels", [(DIFFERENTIAL, Wheels), (OMNI, Omniwheels)], ids=["wheels", "omniwheels"])
def test_the_base_drives_round_a_valve_that_lies_flat_and_not_against_it(base, wheels):
    """The stance is on another side of the post than the robot, up to just behind it."""
    rng, panel = np.random.default_rng(5), VALVE.panel
    keep = min(CONFIG.clearance + np.hypot(panel.width, panel.height) / 2, 0.5 + CONFIG.pre_stance)
    for bearing in (-175, -120, -60, 0, 45, 90, 150):
        scene = Post(np.array([*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)]), rng)
        start = place(scene, np.deg2rad(bearing), 1.3, rng.uniform(-0.3, 0.3))
        run = drive(Mode.FINE_APPROACH, wheels(start), scene, base=base, limit=60.0)
        assert_arrived(run, scene)
        off = run.poses[:, :2] - scene.marker[:2]
        far = np.hypot(*off.T)
        h = scene.marker[2]
        aside = np.abs(off @ [-np.sin(h), np.cos(h)])
        behind = off @ [np.cos(h), np.sin(h)] < 0  # on the side of the stance
        on_line = behind & (aside < CONFIG.pre_stance / 4)
        assert far[~on_line].min(initial=np.inf) > keep - 0.04, bearing
        assert far.min() > 0.48


@pytest.mark.parametrize("way", [0.3, 1.0, -1.6, 3.0])
def test_a_way_round_a_post_touches_its_circle_and_leads_to_the_goal(way):
    post, keep = np.array([0.4, -0.2]), 0.8
    goal = post + 1.1 * np.array([np.cos(way), np.sin(way)])
    at, went = post + np.array([1.3, 0.0]), 0.0
    for _ in range(2000):
        there = base_approach._round(at, goal, post, keep)
        step_ = there - at
        if np.hypot(*step_) < 0.01:
            break
        step_ *= min(1.0, 0.01 / np.hypot(*step_))
        at, went = at + step_, went + np.hypot(*step_)
        assert np.hypot(*(at - post)) > keep
    assert np.hypot(*(at - goal)) < 0.01 and went < 1.3 * abs(way) + 0.5


@pytest.mark.system
def test_fine_approach_arrives_from_50_random_starts_within_30_s_and_off_the_panel():
    rng = np.random.default_rng(5)
    times = []
    for _ in range(50):
        scene, start = random_start(rng)
        run = drive(Mode.FINE_APPROACH, Wheels(start), scene)
        assert_arrived(run, scene)
        assert_clear(run, scene, start)
        times.append(run.time)
    assert max(times) < 30
    assert np.median(times) < 18


@pytest.mark.parametrize("bearing", [-70, 70])
@pytest.mark.parametrize("distance", [1.2, 2.2])
def test_on_the_fine_approach_the_gaze_does_not_lose_the_marker(bearing, distance):
    """With valve_search moving the head, and sightings only while both cameras see the marker."""
    scene = Scene(np.array([1.0, -2.0, 0.4]), np.random.default_rng(1))
    wheels = Wheels(place(scene, np.deg2rad(bearing), distance))
    head = ROBOT.head_pose
    gaze = {"memory": valve_search.Memory(), "torso": np.zeros(3), "states": set()}
    p_OV = np.array([*scene.marker[:2], 1.0])

    def visible():
        p_L = apply(inverse(head(wheels.pose, gaze["torso"])), p_OV)
        return p_L[2] > 0 and abs(p_L[0] / p_L[2]) < np.tan(0.18) and abs(p_L[1] / p_L[2]) < np.tan(0.15)

    def watch(robot, mode, seen):
        robot = dc.replace(robot, torso=gaze["torso"], history=np.zeros((1, 7)))
        gaze["memory"], command, status = valve_search.step(
            valve_search.ValveSearchConfig(), gaze["memory"], robot.time, DT, robot, mode, seen[0], seen[1], head
        )
        gaze["torso"] = command.torso
        gaze["states"].add(status.state)

    yaw = np.arctan2(*(p_OV[:2] - wheels.pose[:2])[::-1]) - wheels.pose[2]
    gaze["torso"] = np.array([0.0, 0.2, wrap(yaw)])
    run = drive(Mode.FINE_APPROACH, wheels, scene, visible=visible, watch=watch)
    assert_arrived(run, scene)
    assert gaze["states"] == {"running"}  # it would say failed, marker_lost
    assert abs(gaze["torso"][0]) < 1e-6  # the waist came back


def test_fine_approach_without_noise_ends_within_half_the_tolerance():
    scene = Scene(np.array([0.0, 0.0, 1.0]), np.random.default_rng(0), noise=0.0)
    run = drive(Mode.FINE_APPROACH, Wheels(place(scene, 0.5, 1.9)), scene)
    error = run.poses[-1] - scene.stance()
    assert np.hypot(*error[:2]) < 0.0075 and abs(error[2]) < 0.009
    assert np.hypot(*run.twists[-1]) < 0.01


def test_fine_approach_at_the_stance_already_only_stands_still_and_succeeds():
    scene = Scene(np.array([0.0, 0.0, 1.0]), np.random.default_rng(0), noise=0.0)
    run = drive(Mode.FINE_APPROACH, Wheels(scene.stance() + [0.004, -0.004, 0.003]), scene)
    assert run.status.state == "succeeded"
    assert 2.5 / 8 + CONFIG.still_time - 0.02 < run.time < 1.5  # three looks, then stillness
    assert np.max(np.abs(run.twists)) < 1e-9


def test_fine_approach_beside_the_stance_backs_off_and_comes_in_again():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    start = scene.stance() + [0.0, 0.04, 0.0]
    run = drive(Mode.FINE_APPROACH, Wheels(start), scene)
    assert_arrived(run, scene)
    back = run.poses[:, 0].min() - start[0]
    assert -0.75 < back < -0.4  # it went back, by about half a metre
    assert np.max(np.abs(run.poses[:, 2])) < 0.3  # backwards, without turning round


def test_fine_approach_follows_a_stance_that_is_corrected_on_the_way():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)

    def alter(t, seen):  # from afar the stance is wrong by 8 cm and 4 degrees
        wrong = np.array([0.03, 0.08, np.deg2rad(4)]) if t < 4 else np.zeros(3)
        return (*seen[:2], dc.replace(seen[2], base=seen[2].base + wrong))

    run = drive(Mode.FINE_APPROACH, Wheels(place(scene, 0.6, 2.0)), scene, alter=alter)
    assert_arrived(run, scene)


def test_fine_approach_ignores_single_wild_stances():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)

    def alter(t, seen):
        wild = int(t * 8) % 4 == 3
        return (*seen[:2], dc.replace(seen[2], base=seen[2].base + [1.0, 2.0, 1.0])) if wild else seen

    run = drive(Mode.FINE_APPROACH, Wheels(place(scene, 0.3, 1.8)), scene, alter=alter)
    assert_arrived(run, scene)
    assert_clear(run, scene, place(scene, 0.3, 1.8))


@pytest.mark.parametrize("depth", [0.05, DEPTH, 0.30])
def test_fine_approach_brakes_for_a_stance_at_the_very_edge_of_the_forbidden_zone(depth):
    """Whatever the stem's length: the clearance is kept from the panel, not from a place behind the marker."""
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0, depth=depth)
    start = place(scene, 0.0, 2.2)
    edge = np.array([depth - CONFIG.clearance - 0.002, 0.0, 0.0])
    run = drive(
        Mode.FINE_APPROACH,
        Wheels(start),
        scene,
        alter=lambda t, seen: (*seen[:2], dc.replace(seen[2], base=edge)),
    )
    assert run.status.state == "succeeded"
    assert CONFIG.clearance < scene.clear(run.poses) < CONFIG.clearance + 0.02


def straight_in(scene, alter):
    """A fine approach from 1.6 m before the stance, with what the base is told changed by `alter`."""
    return drive(Mode.FINE_APPROACH, Wheels(place(scene, 0.0, 1.6)), scene, alter=alter)


@pytest.mark.parametrize("depth", [0.05, DEPTH, 0.30])
def test_fine_approach_refuses_a_stance_within_the_clearance(depth):
    """A stance 5 cm too near to the panel. With a short stem panel and stance are nearer to the marker."""
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0, depth=depth)
    run = straight_in(scene, lambda t, seen: (*seen[:2], dc.replace(seen[2], base=seen[2].base + [0.15, 0, 0])))
    assert (run.status.state, run.status.verdict) == ("failed", Verdict.REACH_LIMIT)
    assert "too near" in run.status.detail
    assert np.max(np.abs(run.twists)) == 0


def test_fine_approach_without_a_stance_fails_with_its_reason_and_never_moves():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
    run = straight_in(scene, lambda t, seen: (*seen[:2], dc.replace(seen[2], found=False, reason="too low")))
    assert (run.status.state, run.status.verdict, run.status.detail) == ("failed", Verdict.REACH_LIMIT, "too low")
    assert np.max(np.abs(run.twists)) == 0
    assert run.time == pytest.approx(CONFIG.stance_patience, abs=0.1)


def test_fine_approach_waits_for_a_search_that_takes_longer_than_its_patience():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
    long = CONFIG.stance_patience + 8
    run = straight_in(scene, lambda t, seen: seen if t > long else (*seen[:2], Stance()))
    assert_arrived(run, scene)
    assert run.time > long


def test_fine_approach_does_not_wait_for_a_search_without_a_pose():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
    run = straight_in(scene, lambda t, seen: (seen[0], RectangleEstimate(time=t), Stance()))
    assert (run.status.verdict, run.status.detail) == (Verdict.REACH_LIMIT, "no stance: the marker's pose is not known")
    assert run.time == pytest.approx(CONFIG.stance_patience, abs=0.1)


def test_fine_approach_does_not_wait_for_a_marker_that_is_seen_no_more():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
    run = straight_in(
        scene,
        lambda t, seen: (
            seen[0],
            seen[1] if t < 2.0 else RectangleEstimate(time=t),
            Stance(time=1.0, found=True, base=np.zeros(3)) if t > 1.5 else Stance(),
        ),
    )
    assert (run.status.verdict, run.status.detail) == (Verdict.REACH_LIMIT, "no stance: the marker's pose is not known")
    assert 2.0 + CONFIG.stance_patience - 0.5 < run.time < 2.0 + CONFIG.stance_patience + 0.1


def test_fine_approach_gives_up_after_its_attempts():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)

    wheels = Wheels(place(scene, 0.0, 1.8))

    def alter(t, seen):  # the stance steps aside whenever the robot comes near
        near = np.hypot(*(wheels.pose - scene.stance())[:2]) < 0.1
        return (*seen[:2], dc.replace(seen[2], base=seen[2].base + [0.0, 0.05 * near, 0.0]))

    run = drive(Mode.FINE_APPROACH, wheels, scene, alter=alter, limit=120)
    assert run.time < 45  # the supervisor's deadline
    assert (run.status.state, run.status.verdict) == ("failed", Verdict.REACH_LIMIT)
    assert f"{CONFIG.attempts} attempts" in run.status.detail


def test_commands_stay_within_speed_and_acceleration():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    run = drive(Mode.FINE_APPROACH, Wheels(place(scene, -1.0, 2.0, 0.3)), scene)
    limit = np.array([CONFIG.acceleration, CONFIG.yaw_acceleration]) * DT
    assert np.all(np.abs(np.diff(run.twists, axis=0)) <= limit + 1e-12)
    assert np.all(np.abs(run.twists) <= np.array([CONFIG.fine_speed, CONFIG.yaw_rate]) + 1e-12)


# ---------------------------------------------------------------- rough approach


def test_rough_approach_turns_to_the_marker_and_stops_between_its_two_distances():
    rng = np.random.default_rng(8)
    for _ in range(12):
        scene = random_scene(rng)
        wheels = Wheels(place(scene, rng.uniform(-1, 1), rng.uniform(2.4, 5), rng.uniform(-np.pi, np.pi)))
        run = drive(Mode.ROUGH_APPROACH, wheels, scene, limit=25)
        assert run.status.state == "succeeded"
        assert abs(wheels.twist[0]) < 2 * CONFIG.still_speed  # at rest
        x, y, heading = run.poses[-1]
        to = scene.marker[:2] - [x, y]
        assert CONFIG.rough_stop - 0.05 < np.hypot(*to) < CONFIG.rough_distance + 0.02
        assert abs(wrap(np.arctan2(to[1], to[0]) - heading)) < 0.1
        assert np.max(run.twists[:, 0]) <= CONFIG.speed + 1e-12
        line = scene.marker[:2] - run.poses[:, :2]
        bearing = np.abs([wrap(a) for a in np.arctan2(line[:, 1], line[:, 0]) - run.poses[:, 2]])
        assert np.all(run.twists[bearing > CONFIG.facing + 0.1, 0] == 0)  # turns first


def test_rough_approach_brakes_as_soon_as_it_is_near_enough_and_does_not_creep_on():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(1))
    run = drive(Mode.ROUGH_APPROACH, Wheels(place(scene, 0.0, 3.5)), scene, limit=25)
    near = np.linalg.norm(scene.marker[:2] - run.poses[:, :2], axis=1) < CONFIG.rough_distance
    assert run.status.state == "succeeded"
    speed = CONFIG.approach_gain * (CONFIG.rough_distance - CONFIG.rough_stop)  # there
    assert np.count_nonzero(near) * DT < speed / CONFIG.acceleration + 0.3  # the lag of drive and stillness


@pytest.mark.parametrize("distance", [1.0, 1.3, 1.9])
def test_rough_approach_nearer_than_2_m_succeeds_without_moving(distance):
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
    run = drive(Mode.ROUGH_APPROACH, Wheels(place(scene, 0.2, distance)), scene)
    assert run.status.state == "succeeded" and run.time < 0.6
    assert np.max(np.abs(run.twists[:, 0])) == 0


def test_rough_approach_does_not_end_on_one_wild_first_sighting():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)

    def alter(t, seen):
        return (dc.replace(seen[0], p_LV=np.array([-2.5, 0.0, 1.0])), *seen[1:]) if t < 0.1 else seen

    run = drive(Mode.ROUGH_APPROACH, Wheels(place(scene, 0.0, 3.5)), scene, alter=alter)
    assert run.status.state == "succeeded"
    assert np.hypot(*run.poses[-1][:2]) < CONFIG.rough_distance + 0.02


def test_rough_approach_waits_for_a_sighting():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
    blind = lambda t, seen: (dc.replace(seen[0], found=False), *seen[1:])  # noqa: E731
    run = drive(Mode.ROUGH_APPROACH, Wheels(place(scene, 0.2, 3.0)), scene, alter=blind, limit=3)
    assert run.status.state == "running" and np.max(np.abs(run.twists)) == 0


# ---------------------------------------------------------------- retreat


def test_retreat_goes_straight_back_half_a_metre():
    scene = Scene(np.array([0.0, 0.0, 0.7]), np.random.default_rng(2))
    wheels = Wheels(scene.stance())
    run = drive(Mode.RETREAT, wheels, scene)
    assert run.status.state == "succeeded" and run.time < 6
    moved = rot_z(-0.7)[:2, :2] @ (run.poses[-1] - scene.stance())[:2]
    assert moved == pytest.approx([-CONFIG.retreat_distance, 0.0], abs=0.015)
    assert np.max(np.abs(run.twists[:, 0])) <= CONFIG.retreat_speed + 1e-12


# ---------------------------------------------------------------- shape of the behaviour


def test_a_track_takes_the_median_heading_across_half_a_turn():
    track = MedianPlace()
    for k, turn in enumerate((-0.1, 0.0, 0.1, 0.02, 3.0)):
        track = track.add(k, np.array([0.0, 0, wrap(np.pi + turn)]), 5)
    assert abs(wrap(track.median[2] - np.pi)) < 0.03


@pytest.mark.parametrize("mode", [m for m in Mode if m not in (Mode.ROUGH_APPROACH, Mode.FINE_APPROACH, Mode.RETREAT)])
def test_outside_its_modes_it_is_idle_and_asks_for_nothing(mode):
    scene = Scene(np.zeros(3), np.random.default_rng(0))
    robot = RobotState(odometry=np.zeros(5))
    _, command, status = step(
        CONFIG,
        VALVE,
        Memory(),
        1.0,
        DT,
        robot,
        ModeState(mode=mode.value, activation=7),
        *scene.look(1.0, np.zeros(3)),
    )
    assert status.state == "idle"
    assert all(getattr(command, f.name) is None for f in dc.fields(Command) if f.name != "time")


def test_a_new_activation_starts_afresh():
    scene = Scene(np.zeros(3), np.random.default_rng(0), noise=0.0)
    robot = RobotState(odometry=np.array([-1.5, 0.0, 0, 0, 0]))
    memory, result = Memory(), []
    for activation, count in ((1, 200), (2, 1)):
        for _ in range(count):
            t = len(result) * DT
            seen = scene.look(t, robot.odometry[:3])
            mode = ModeState(mode="rough_approach", activation=activation)
            memory, _, status = step(CONFIG, VALVE, memory, t, DT, robot, mode, *seen)
            result.append((status.activation, status.state))
    assert result[199] == (1, "succeeded")
    assert result[200] == (2, "running")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"speed": 0.0}, "base_approach.speed"),
        ({"yaw_rate": float("nan")}, "base_approach.yaw_rate"),
        ({"rough_stop": 1.0}, "base_approach.rough_stop"),
        ({"braking": 1.5}, "base_approach.braking"),
    ],
)
def test_bad_config_is_refused_by_name(changes, words):
    with pytest.raises(ConfigError, match=words):
        BaseApproachConfig(**changes).check()
    with pytest.raises(ConfigError, match=words):
        BaseApproachSystem(BaseApproachConfig(**changes), VALVE)


# ---------------------------------------------------------------- block


def rig(**inputs) -> Rig:
    robot = RobotState(odometry=np.array([-3.0, 0.5, 0.1, 0, 0]))
    fixed = {
        "robot_state": robot,
        "mode": ModeState(mode="rough_approach", activation=1),
        "position": StereoPosition(time=0.001, found=True, covariance=np.eye(3) * 1e-4),
    }
    return Rig(BaseApproachSystem(CONFIG, VALVE), **fixed | inputs)


def test_ports():
    assert ports(BaseApproachSystem(CONFIG, VALVE)) == {
        "robot_state": "in abstract",
        "mode": "in abstract",
        "position": "in abstract",
        "estimate": "in abstract",
        "stance": "in abstract",
        "command": "out abstract",
        "status": "out abstract",
    }


def test_block_waits_for_a_sighting_that_is_newer_than_its_activation():
    dut = rig().run(0.5)
    assert np.all(dut.read("command").base_twist == 0)
    dut.fix(position=StereoPosition(time=0.5, found=True))
    dut.run(1.0)
    assert dut.read("command").base_twist[0] > 0.1
    assert (dut.read("status").activation, dut.read("status").state) == (1, "running")


def test_block_holds_its_outputs_between_updates():
    for port in ("command", "status"):
        assert_holds_between_updates(rig(), port, slot=1, period=2 * TICK)


def test_block_clones_are_independent():
    assert_clones_are_independent(rig, {"mode": ModeState(mode="retreat", activation=2)}, ("command", "status"))


def test_block_refuses_a_wrong_message_and_needs_the_robot_state():
    with pytest.raises(TypeError, match="want Stance"):
        rig(stance=StereoPosition(), mode=ModeState(mode="fine_approach", activation=1)).run(0.1)
    with pytest.raises(RuntimeError, match="robot_state.*base_approach.*nothing is connected"):
        Rig(BaseApproachSystem(CONFIG, VALVE), mode=ModeState(mode="retreat", activation=1)).run(0.1)


# ---------------------------------------------------------------- other bases


@pytest.mark.system
def test_a_holonomic_base_arrives_from_50_random_starts_sooner_and_off_the_panel():
    rng = np.random.default_rng(5)
    times = []
    for _ in range(50):
        scene, start = random_start(rng)
        run = drive(Mode.FINE_APPROACH, Omniwheels(start), scene, base=OMNI)
        assert_arrived(run, scene)
        assert_clear(run, scene, start)
        assert np.all(np.abs(run.twists) <= OMNI.speed + 1e-9)
        assert run.details <= {"waiting for a stance", "plan", "go", "settle", *(d for d in run.details if " mm" in d)}
        times.append(run.time)
    assert max(times) < 15 and np.median(times) < 9


def test_a_holonomic_base_beside_the_stance_steps_aside_and_does_not_back_off():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    start = scene.stance() + [0.0, 0.2, 0.0]
    run = drive(Mode.FINE_APPROACH, Omniwheels(start), scene, base=OMNI)
    assert_arrived(run, scene)
    assert run.poses[:, 0].min() > start[0] - 0.01 and np.max(np.abs(run.poses[:, 2])) < 0.01
    assert np.max(np.abs(run.twists[:, 0])) < 0.03 < np.max(np.abs(run.twists[:, 1]))


def test_a_holonomic_base_that_is_too_near_moves_away_from_the_panel_first():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    start = np.array([DEPTH - 0.4, 0.5, 0.2])
    run = drive(Mode.FINE_APPROACH, Omniwheels(start), scene, base=OMNI)
    assert_arrived(run, scene)
    inside = run.poses[:, 0] > DEPTH - CONFIG.clearance
    first_out = int(np.argmin(inside))
    assert 0 < first_out and not inside[first_out:].any()
    assert np.all(np.diff(run.poses[:first_out, 0]) < 1e-6)


def test_a_holonomic_base_drives_to_the_marker_while_it_still_turns_to_it():
    times = []
    for base, wheels in ((DIFFERENTIAL, Wheels), (OMNI, Omniwheels)):
        scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0))
        run = drive(Mode.ROUGH_APPROACH, wheels(place(scene, 0.0, 4.0, 1.2)), scene, base=base)
        assert run.status.state == "succeeded"
        last = run.poses[-1]
        assert np.hypot(*last[:2]) < CONFIG.rough_distance and np.hypot(*last[:2]) > CONFIG.rough_stop - 0.05
        times.append(run.time)
    assert times[1] < times[0] - 0.3
    assert np.ptp(run.poses[:, 1]) < 0.12  # straight there


def test_a_holonomic_base_goes_straight_back():
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    start = np.array([-0.6, 0.1, 0.3])
    run = drive(Mode.RETREAT, Omniwheels(start, twist=np.array([0.0, 0.05, 0.0])), scene, base=OMNI)
    way = run.poses[-1] - start
    along = np.array([np.cos(0.3), np.sin(0.3)])
    assert run.status.state == "succeeded" and -way[:2] @ along == pytest.approx(0.5, abs=0.02)
    assert abs(way[0] * along[1] - way[1] * along[0]) < 0.01


def test_a_base_that_is_slower_than_the_config_is_asked_for_no_more_than_it_can():
    slow = base_drive("holonomic", [0.2, 0.1, 0.3], [0.3, 0.2, 0.4])
    config = bounded(CONFIG, slow, 0.7)
    assert config.clearance == 0.7 and config.yaw_rate == 0.3 and config.acceleration == 0.2
    scene = Scene(np.array([0.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    scene.stance = lambda: np.array([DEPTH - 0.8, 0.0, 0.0])
    run = drive(Mode.FINE_APPROACH, Omniwheels(place(scene, 0.8, 2.0)), scene, config=CONFIG, base=slow, limit=60.0)
    assert np.all(np.abs(run.twists[:, :2]) <= slow.speed[:2] + 1e-9)
    assert np.max(np.abs(run.twists[:, 1])) == pytest.approx(0.1, abs=0.01)  # the direction is kept
    assert bounded(CONFIG, DIFFERENTIAL, 0.0) == CONFIG  # ours can do all that the config asks


def at_origin(seen, reason=""):
    """A fixed robot's stance is where it stands, if there is one."""
    found = dc.replace(seen[2], base=np.zeros(3), found=not reason, reason=reason)
    return (*seen[:2], found)


def test_a_fixed_base_looks_whether_it_stands_well_and_never_moves():
    scene = Scene(np.array([0.6, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    for mode, detail in (
        (Mode.ROUGH_APPROACH, "marker 0.60 m away"),
        (Mode.FINE_APPROACH, "+0 mm along"),
        (Mode.RETREAT, "the base is fixed"),
    ):
        run = drive(mode, Bolted(np.zeros(3)), scene, base=FIXED, alter=lambda t, seen: at_origin(seen))
        assert run.status.state == "succeeded" and detail in run.status.detail and run.time < 2


def test_a_valve_out_of_a_fixed_robots_reach_ends_the_run_honestly():
    far = Scene(np.array([3.0, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    run = drive(Mode.ROUGH_APPROACH, Bolted(np.zeros(3)), far, base=FIXED)
    assert run.status.verdict == Verdict.REACH_LIMIT and "3.00 m away, and the base is fixed" in run.status.detail
    near = Scene(np.array([1.2, 0.0, 0.0]), np.random.default_rng(0), noise=0.0)
    run = drive(
        Mode.FINE_APPROACH, Bolted(np.zeros(3)), near, base=FIXED, alter=lambda t, seen: at_origin(seen, "too far")
    )
    assert run.status.verdict == Verdict.REACH_LIMIT and run.status.detail == "too far"


# ---------------------------------------------------------------- odometry


@pytest.mark.parametrize("scale, ends", [(0.5, "fault"), (0.75, ""), (1.0, ""), (1.3, ""), (2.0, "fault")])
def test_odometry_that_counts_half_or_double_is_a_fault_in_rough_approach(scale, ends):
    """The distance to the marker by the cameras shrinks by another length than the wheels report."""
    rng = np.random.default_rng(3)
    scene = Scene(np.array([6.0, 0.0, 0.0]), rng)
    wheels = Wheels(np.zeros(3))

    def alter(t, seen):  # what is seen lies in the odometry's frame, which has moved on by (scale - 1) of the way
        position, estimate, stance = seen
        shift = np.array([(scale - 1.0) * wheels.pose[0], (scale - 1.0) * wheels.pose[1], 0.0])
        return dc.replace(position, p_LV=position.p_LV + shift), estimate, stance

    run = drive(Mode.ROUGH_APPROACH, wheels, scene, alter=alter, scale=scale)
    assert run.status.verdict == ends
    assert run.status.state == ("failed" if ends else "succeeded")
    if ends:
        assert "odometry: the marker moved by" in run.status.detail
