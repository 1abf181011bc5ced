"""Stages 1 and 2 on wheels: drives the base to the stance before the valve, and away again.

    rough_approach  turns towards the marker's position of stage 1, drives until it is nearer than 2 m, and brakes.
    fine_approach   by the pose of stage 2, to the stance that stance_planner has found:
                        turn    to point the front or the back to the pre-stance, a point straight behind the stance
                        drive   to it, forwards or backwards, whichever keeps the marker better in view
                        align   to the stance's heading
                        line    straight in, steering onto the line through the stance
                        settle  trim heading and distance, wait for the lift, stand still, check
                    A differential drive cannot step sideways: if it ends beside the stance, it backs off and goes
                    through all phases again. A holonomic one has two phases:
                        go      straight to the stance, whichever way it looks, turning to its heading meanwhile
                        settle  as above, sideways too
                    A fixed base stays where it is: the stance is there, or the run ends with reach_limit.
    retreat         straight back; the arms are folded.

The base's centre never comes nearer to the panel's plane than `clearance`. A stance nearer than that is refused; from
an allowed start the base drives straight lines between allowed points, so no line can cross the clearance. From a
start nearer than that the base only moves away: the pre-stance is farther out. About a valve whose axis is upright,
which has no panel to stay before, the base drives round: it keeps `clearance` from the panel's corners till it is on
the line in.

In the stance's frame: s along its heading, e to its left, psi the heading against it.
Line law: psi_ref = -atan(e / look_ahead).
Frames: frames.py; everything here is on the floor, in O.
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number
from valve_drake.frames import apply, compose, wrap
from valve_drake.memory import changed
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
from valve_drake.motion import slew, towards
from valve_drake.robot.drive import DIFFERENTIAL, Drive, whole
from valve_drake.task.modes import owned
from valve_drake.valve.valve import Valve, has_heading

MODES = owned("base_approach")
BEYOND = 0.35  # of a way round a post, past where it touches the circle about it [rad]
ROUND = 0.05  # by which that circle is wider than what has to be kept clear of [m]
SLIM = 0.15  # so much nearer to an upright axis than to a panel may the base come; lower it for a wide post [m]
STILL = np.zeros(3)
STILL.setflags(write=False)
NEAR = 0.03  # a holonomic base that is within the clearance by more moves away first; above a stance's noise [m]
# A differential drive on its way to the stance; looser ones are sooner met, and leave more to the line law.
POINTED, POINTED_RATE = 0.05, 0.2  # it points to the pre-stance, and turns no faster: it drives [rad], [rad/s]
THERE = 0.02  # left along its way to the pre-stance: it is there [m]
CLOSE = 0.15  # so close to the pre-stance the way to it swings round: the heading is kept [m]
ALIGNED, ALIGNED_RATE = 0.03, 0.1  # off the stance's heading, and turning no faster: it drives in [rad], [rad/s]
BESIDE = 1 / 5  # of the pre-stance's distance, aside there: more is a new attempt
FUNNEL, FUNNEL_SLOPE = 2, 1 / 8  # so many pre-stances' distances before the stance, so far aside: straight in
AT_PRE_STANCE = 0.05  # so near to it, it only has to align [m]
RATHER_FORWARDS = 0.1  # by which the marker may be farther off the robot's front than going backwards [rad]
LINE_END = 0.005  # left of the line: the rest is trimmed [m]
RETREATED = 0.01  # left of the way back: it is done [m]
RAISED = 0.01  # lift and waist are at the stance's when they are off by less [m, rad]


@dc.dataclass
class BaseApproachConfig(Config):
    """Scenario key `base_approach`."""

    KEY = "base_approach"
    FORMER = {"closing": "approach_gain", "look": "look_ahead"}
    speed: float = number(0.7, 0.05, 1.5, "in the rough approach, at most [m/s]")
    fine_speed: float = number(0.5, 0.02, 1.5, "to the pre-stance, at most [m/s]")
    line_speed: float = number(0.3, 0.02, 1.0, "from the pre-stance to the stance, at most [m/s]")
    reverse_speed: float = number(0.3, 0.02, 1.0, "backwards to the pre-stance, at most [m/s]")
    trim_speed: float = number(0.05, 0.005, 0.3, "at the stance, at most [m/s]")
    yaw_rate: float = number(1.0, 0.05, 2.0, "at most [rad/s]")
    acceleration: float = number(0.7, 0.05, 1.5, "of the command [m/s^2]")
    yaw_acceleration: float = number(1.5, 0.1, 4.0, "[rad/s^2]")
    braking: float = number(0.6, 0.1, 1.0, "share of the accelerations used to brake; lower it if the base overshoots")
    steering: float = number(
        3.0, 0.2, 10.0, "yaw rate <= steering * heading error; lower it if the heading oscillates [1/s]"
    )
    approach_gain: float = number(
        2.5, 0.2, 10.0, "speed <= gain * distance to go; lower it if the base overshoots [1/s]"
    )
    rough_distance: float = number(2.0, 1.2, 6.0, "the rough approach ends nearer to the marker than this [m]")
    rough_stop: float = number(1.85, 1.2, 6.0, "where it comes to rest; it never drives nearer [m]")
    facing: float = number(0.4, 0.05, 1.5, "with a larger bearing it turns on the spot before it drives [rad]")
    sightings: int = number(5, 1, 50, "it steers by the median of this many; raise it against wild estimates")
    odometry_check: float = number(0.6, 0.1, 3.0, "driven so far, odometry is held against the cameras [m]")
    odometry_error: float = number(
        0.35, 0.05, 0.5, "share of what was driven: more is a fault; raise it for wheels that slip"
    )
    pre_stance: float = number(0.6, 0.1, 2.0, "distance of the pre-stance behind the stance [m]")
    look_ahead: float = number(0.22, 0.05, 2.0, "of the line law; raise it if the base swings about the line [m]")
    clearance: float = number(0.62, 0.55, 1.5, "base centre to panel plane, at least; a long base keeps more [m]")
    position_tolerance: float = number(0.015, 0.002, 0.1, "of the base at the stance [m]")
    heading_tolerance: float = number(0.0175, 0.002, 0.2, "of the base at the stance [rad]")
    still_time: float = number(0.3, 0.05, 5.0, "at rest for so long, the stance is reached [s]")
    still_speed: float = number(0.01, 0.001, 0.05, "a base that is measured slower is at rest [m/s]")
    still_rate: float = number(0.02, 0.002, 0.1, "a base that turns slower is at rest [rad/s]")
    attempts: int = number(4, 1, 20, "at driving in straight, before it fails")
    stance_patience: float = number(
        12.0, 0.5, 60.0, "waits so long for the marker's pose, or for another one where none has a stance [s]"
    )
    retreat_distance: float = number(0.5, 0.05, 2.0, "straight back from the stance [m]")
    retreat_speed: float = number(0.3, 0.02, 0.5, "[m/s]")

    def relations(self, key: str) -> None:
        below = self.rough_stop < self.rough_distance
        require(below, f"{key}.rough_stop", f"below rough_distance, {self.rough_distance:g}", self.rough_stop)


def bounded(config: BaseApproachConfig, drive: Drive, room: float) -> BaseApproachConfig:
    """The config with no more than the base can do, and the room that it needs to turn before a panel [m]."""
    if drive.fixed:
        return config
    speeds = ("speed", "fine_speed", "line_speed", "reverse_speed", "trim_speed", "retreat_speed")
    most = dict.fromkeys(speeds, float(drive.speed[0])) | {
        "yaw_rate": float(drive.speed[-1]),
        "acceleration": float(np.min(drive.acceleration[:-1])),
        "yaw_acceleration": float(drive.acceleration[-1]),
    }
    lower = {name: min(getattr(config, name), value) for name, value in most.items()}
    return dc.replace(config, clearance=max(config.clearance, room), **lower)


@dc.dataclass(frozen=True, eq=False)
class MedianPlace:
    """The median of the last few places (x, y, heading) on the floor: one wild estimate does not move it."""

    seen: float = -np.inf  # capture time of the newest; older ones do not count [s]
    places: tuple[np.ndarray, ...] = ()
    median: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # means nothing while there are no places

    def add(self, time: float, place: np.ndarray, count: int) -> "MedianPlace":
        places = (*self.places, place)[-count:]
        rows = np.array(places)
        rows[:, 2] = [place[2] + wrap(h - place[2]) for h in rows[:, 2]]
        return MedianPlace(time, places, np.median(rows, axis=0))


@dc.dataclass(frozen=True, eq=False)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    since: float = 0.0  # of this activation [s]
    result: str = "running"  # running | succeeded | failed
    verdict: str = Verdict.NONE.value
    detail: str = ""
    progress: float = 0.0
    twist: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # command: forward, sideways, yaw [m/s, rad/s]
    start: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # base at the activation [m, m, rad]
    marker: MedianPlace = MedianPlace()  # stage 1: heading means nothing
    first_seen: np.ndarray | None = None  # marker's x, y when it was sure first, and the base's then [m]
    panel: MedianPlace = MedianPlace()  # a point of its plane, and the heading of the normal into it
    stance: MedianPlace = MedianPlace()
    posture: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))  # of the newest stance [m, rad]
    phase: str = "plan"
    direction: float = 1.0  # of driving to the pre-stance: 1 forwards, -1 backwards
    attempt: int = 0
    quiet_since: float = 0.0  # since when the base is at rest [s]


def step(
    config: BaseApproachConfig,
    valve: Valve,
    memory: Memory,
    time: float,
    dt: float,
    robot_state: RobotState,
    mode: ModeState,
    position: StereoPosition,
    estimate: RectangleEstimate,
    stance: Stance,
    drive: Drive = DIFFERENTIAL,
) -> tuple[Memory, Command, Status]:
    """One tick of length dt -> memory, command, status."""
    if mode.mode not in MODES:
        return Memory(), Command(time=time), Status(time=time, activation=mode.activation)
    base = robot_state.odometry[:3]
    m = memory
    if mode.activation != m.activation:
        # The twist goes on from where it is, so that two approaches in a row join smoothly.
        fresh = MedianPlace(seen=time)
        m = Memory(mode.activation, time, twist=m.twist, start=base, quiet_since=time)
        m = changed(m, marker=fresh, panel=fresh, stance=fresh)
    goal = STILL
    if m.result == "running":
        if mode.mode == Mode.ROUGH_APPROACH:
            m, goal = _rough(config, m, dt, robot_state, position, drive)
        elif mode.mode == Mode.FINE_APPROACH:
            m, goal = _fine(config, valve, m, time, dt, robot_state, estimate, stance, drive)
        else:
            m, goal = _retreat(config, m, dt, robot_state, drive)
    rates = np.array([config.acceleration, config.acceleration, config.yaw_acceleration])
    m = changed(m, twist=slew(m.twist, goal, rates * dt))
    status = Status(time, m.activation, m.result, m.verdict, m.detail, m.progress)
    return m, Command(time=time, base_twist=None if drive.fixed else drive.part(m.twist)), status


# ---------------------------------------------------------------- common


def _end(m: Memory, result: str, verdict: str = Verdict.NONE, detail: str = "") -> tuple[Memory, np.ndarray]:
    progress = 1.0 if result == "succeeded" else m.progress
    return changed(m, result=result, verdict=str(verdict), detail=detail, progress=progress), STILL


def _motion(forward: float = 0.0, rate: float = 0.0) -> np.ndarray:
    """Straight on, or on an arc."""
    return np.array([forward, 0.0, rate])


def _towards(
    config: BaseApproachConfig, drive: Drive, way: np.ndarray, heading: float, speed: float, rate: float, dt: float
) -> np.ndarray:
    """A holonomic base's motion along `way`, that stops at its end -> forward, sideways, yaw rate.

    way: (x, y) in the frame that the heading counts in. speed: at most; less where one of the base's own is the limit.
    """
    left = math.hypot(*way.tolist())
    if left == 0.0:
        return _motion(rate=rate)
    angle = math.atan2(way[1], way[0]) - heading
    along = np.array([math.cos(angle), math.sin(angle)])
    v = _drive(config, left, min(speed, *(drive.speed[:2] / np.maximum(np.abs(along), 1e-9)).tolist()), dt)
    return np.array([*(v * along), rate])


def _drive(config: BaseApproachConfig, gap: float, speed: float, dt: float) -> float:
    """Forward speed that stops after `gap` [m]."""
    return towards(gap, min(speed, config.approach_gain * abs(gap)), config.braking * config.acceleration, dt)


def _turn(config: BaseApproachConfig, angle: float, dt: float) -> float:
    """Yaw rate that stops after `angle` [rad]."""
    rate = min(config.yaw_rate, config.steering * abs(angle))
    return towards(angle, rate, config.braking * config.yaw_acceleration, dt)


def _still(config: BaseApproachConfig, state: RobotState) -> bool:
    forward, sideways, rate = whole(state.twist)
    return math.hypot(forward, sideways) < config.still_speed and abs(rate) < config.still_rate


def _sure(config: BaseApproachConfig, track: MedianPlace) -> bool:
    """Whether there are enough places: a single estimate can be wrong."""
    return len(track.places) >= min(3, config.sightings)


# ---------------------------------------------------------------- stage 1


def _rough(
    config: BaseApproachConfig, m: Memory, dt: float, state: RobotState, position: StereoPosition, drive: Drive
) -> tuple[Memory, np.ndarray]:
    if position.found and position.time > m.marker.seen:
        p_OV = apply(position.X_OL, position.p_LV)
        m = changed(m, marker=m.marker.add(position.time, np.array([p_OV[0], p_OV[1], 0.0]), config.sightings))
    if not m.marker.places:
        return m, STILL
    x, y, heading = state.odometry[:3]
    p = m.marker.median
    m = _watch_odometry(config, m, state.odometry[:2])
    if m.result == "failed":
        return m, STILL
    distance = float(np.hypot(p[0] - x, p[1] - y))
    bearing = wrap(float(np.arctan2(p[1] - y, p[0] - x)) - heading)
    m = changed(
        m,
        detail=f"marker {distance:.2f} m away",
        progress=float(np.clip(config.rough_distance / distance, 0, 1)),
    )
    if distance < config.rough_distance and _still(config, state):
        return _end(m, "succeeded", detail=m.detail) if _sure(config, m.marker) else (m, STILL)
    if drive.fixed:
        if not _sure(config, m.marker):
            return m, STILL
        return _end(m, "failed", Verdict.REACH_LIMIT, f"{m.detail}, and the base is fixed")
    if drive.sideways and distance >= config.rough_distance:
        left = max(distance - config.rough_stop, 0.0)
        way, rate = (p[:2] - [x, y]) * (left / distance), _turn(config, bearing, dt)
        return m, _towards(config, drive, way, float(heading), config.speed, rate, dt)
    forward = 0.0
    if abs(bearing) < config.facing and distance >= config.rough_distance:  # nearer it comes to rest where it is
        forward = _drive(config, max(distance - config.rough_stop, 0.0), config.speed, dt) * np.cos(bearing)
    rate = _turn(config, bearing, dt) if distance > config.rough_stop else 0.0
    return m, _motion(forward, rate)


def _watch_odometry(config: BaseApproachConfig, m: Memory, base: np.ndarray) -> Memory:
    """The marker does not move: where it seems to, in the odometry's frame, the odometry counts wrong.

    A fault, since every approach and the verify of the turn's place stand on the odometry.
    """
    marker = m.marker.median[:2]
    if m.first_seen is None:
        return changed(m, first_seen=np.concatenate([marker, base])) if _sure(config, m.marker) else m
    driven = float(np.linalg.norm(base - m.first_seen[2:]))
    moved = float(np.linalg.norm(marker - m.first_seen[:2]))
    if driven < config.odometry_check or moved < config.odometry_error * driven:
        return m
    detail = f"odometry: the marker moved by {moved:.2f} m while the base counted {driven:.2f} m"
    return _end(m, "failed", Verdict.FAULT, detail)[0]


# ---------------------------------------------------------------- stage 2


@dc.dataclass(frozen=True)
class _Offset:
    """The base against the stance."""

    s: float  # along the stance's heading [m]
    e: float  # to its left [m]
    psi: float  # heading [rad]


def _offset(base: np.ndarray, goal: np.ndarray) -> _Offset:
    c, s = np.cos(goal[2]), np.sin(goal[2])
    dx, dy = base[:2] - goal[:2]
    return _Offset(float(c * dx + s * dy), float(c * dy - s * dx), wrap(float(base[2] - goal[2])))


def _fine(
    config: BaseApproachConfig,
    valve: Valve,
    m: Memory,
    time: float,
    dt: float,
    state: RobotState,
    estimate: RectangleEstimate,
    stance: Stance,
    drive: Drive,
) -> tuple[Memory, np.ndarray]:
    if estimate.found and estimate.time > m.panel.seen:
        m = changed(m, panel=m.panel.add(estimate.time, _panel(valve, estimate), config.sightings))
    if stance.found and stance.time > m.stance.seen:
        m = changed(m, stance=m.stance.add(stance.time, stance.base, config.sightings), posture=stance.posture)
    if not (_sure(config, m.panel) and _sure(config, m.stance)):
        # A search that is under way ends by itself, sooner or later by how many joints and places there are; without a
        # marker in sight none is.
        seen = time - m.panel.seen <= config.stance_patience
        under_way = seen and _sure(config, m.panel) and not stance.reason
        if time - m.since > config.stance_patience and not under_way:
            return _end(m, "failed", Verdict.REACH_LIMIT, stance.reason or "no stance: the marker's pose is not known")
        return changed(m, detail="waiting for a stance"), STILL
    base, goal, panel = state.odometry[:3], m.stance.median, m.panel.median
    there, upright = _pre_stance(config, goal), bool(np.isnan(panel[2]))
    if upright:  # round its post, and a plane behind it that faces the stance
        corners = math.hypot(valve.panel.width, valve.panel.height) / 2
        there = _round(base[:2], there, panel[:2], config.clearance + corners)
        panel = np.array([*_ahead(np.array([*panel[:2], goal[2]]), SLIM), goal[2]])
    room = -_offset(goal, panel).s - config.clearance
    if room < 0 and not drive.fixed:
        return _end(m, "failed", Verdict.REACH_LIMIT, f"the stance is {-room:.3f} m too near to the panel")
    at = _offset(base, goal)
    if m.phase != "settle":
        m = changed(m, quiet_since=time)  # stillness counts from there on
    if m.phase == "plan":
        m = _plan(config, m, base, there, at, _ahead(panel, valve.marker.xyz[2] - valve.panel.depth), drive)
        if m.result == "failed":
            return m, STILL
    if m.phase == "settle":
        m, twist = _settle(config, m, time, dt, state, at, drive)
    elif drive.sideways:
        first = _offset(base, panel).s + config.clearance > NEAR  # away from the panel
        first |= upright and (at.s > 0 or abs(at.e) > BESIDE * config.pre_stance)  # round the post to the line in
        m, twist = _go(config, drive, m, dt, base, there if first else goal[:2], at, first)
    else:
        m, twist = PHASES[m.phase](config, m, dt, base, there, at)
    if m.result == "running":
        m = changed(m, detail=f"{m.phase}: {-at.s:.3f} m to go, {at.e:+.3f} m aside, {np.degrees(at.psi):+.1f} deg")
    return m, twist


def _ahead(pose: np.ndarray, distance: float) -> np.ndarray:
    """The point `distance` ahead of a pose (x, y, heading) -> (2,)."""
    return pose[:2] + distance * np.array([np.cos(pose[2]), np.sin(pose[2])])


def _round(start: np.ndarray, goal: np.ndarray, post: np.ndarray, keep: float) -> np.ndarray:
    """Where to drive from `start` to come to `goal` and keep clear of a post by `keep` [m], all on the floor (2,).

    It is the goal if the straight way there is clear, else a point on the tangent to the circle about the post. From a
    start or to a goal within the circle the way may come no nearer than that.
    """
    way, off = goal - start, start - post
    share = float(np.clip(-(off @ way) / max(float(way @ way), 1e-12), 0.0, 1.0))
    least = min(keep, math.hypot(*off), math.hypot(*(goal - post)))
    if math.hypot(*(off + share * way)) >= least - 1e-6:
        return goal
    radius, far = keep + ROUND, math.hypot(*off)
    bearing, to = math.atan2(off[1], off[0]), math.atan2(*(goal - post)[::-1])
    side = math.copysign(1.0, wrap(to - bearing))
    angle = bearing + side * (math.acos(min(radius / far, 1.0)) + BEYOND)
    return post + radius / math.cos(BEYOND) * np.array([math.cos(angle), math.sin(angle)])


def _panel(valve: Valve, estimate: RectangleEstimate) -> np.ndarray:
    """The stem at the panel and the heading of the panel's normal into it, on the floor -> (3,).

    A valve whose axis is upright has no such heading: not a number.
    """
    X_OA = compose(estimate.X_OL, estimate.X_LV, valve.X_VA())
    upright = not has_heading(X_OA)
    return np.array([*compose(X_OA, valve.X_AP())[:2, 3], np.nan if upright else np.arctan2(X_OA[1, 2], X_OA[0, 2])])


def _pre_stance(config: BaseApproachConfig, goal: np.ndarray) -> np.ndarray:
    return _ahead(goal, -config.pre_stance)


def _within(config: BaseApproachConfig, at: _Offset) -> bool:
    return np.hypot(at.s, at.e) <= config.position_tolerance and abs(at.psi) <= config.heading_tolerance


def _plan(
    config: BaseApproachConfig,
    m: Memory,
    base: np.ndarray,
    there: np.ndarray,
    at: _Offset,
    marker: np.ndarray,
    drive: Drive,
) -> Memory:
    """Chooses the first phase of a new attempt. there: where it leads first; marker: its centre, on the floor (2,)."""
    if _within(config, at):
        return changed(m, phase="settle")
    if drive.fixed:
        return _end(m, "failed", Verdict.REACH_LIMIT, "the stance is elsewhere, and the base is fixed")[0]
    if m.attempt >= config.attempts:
        return _end(m, "failed", Verdict.REACH_LIMIT, f"still {at.e:+.3f} m aside after {m.attempt} attempts")[0]
    m = changed(m, attempt=m.attempt + 1)
    if drive.sideways:
        return changed(m, phase="go")
    # In the funnel before the stance the line law alone brings it in.
    if -FUNNEL * config.pre_stance < at.s < 0 and abs(at.e) < -at.s * FUNNEL_SLOPE and abs(at.psi) < config.facing:
        return changed(m, phase="line")
    way = there - base[:2]
    if np.linalg.norm(way) < AT_PRE_STANCE:
        return changed(m, phase="align")
    # The widest angle between the robot's front and the marker on the way, for driving forwards and backwards.
    lines = [marker - base[:2], marker - base[:2] - way]
    course = np.arctan2(way[1], way[0])
    angles = [abs(wrap(float(np.arctan2(line[1], line[0]) - course))) for line in lines]
    forwards, backwards = max(angles), np.pi - min(angles)
    return changed(m, phase="turn", direction=1.0 if forwards <= backwards + RATHER_FORWARDS else -1.0)


def _course_error(m: Memory, base: np.ndarray, way: np.ndarray) -> float:
    """How far the base has to turn to drive along `way` in its direction."""
    course = float(np.arctan2(way[1], way[0])) + (0.0 if m.direction > 0 else np.pi)
    return wrap(course - float(base[2]))


def _turn_phase(
    config: BaseApproachConfig, m: Memory, dt: float, base: np.ndarray, there: np.ndarray, at: _Offset
) -> tuple[Memory, np.ndarray]:
    error = _course_error(m, base, there - base[:2])
    if abs(error) < POINTED and abs(m.twist[2]) < POINTED_RATE:
        return changed(m, phase="drive"), STILL
    return m, _motion(rate=_turn(config, error, dt))


def _drive_phase(
    config: BaseApproachConfig, m: Memory, dt: float, base: np.ndarray, there: np.ndarray, at: _Offset
) -> tuple[Memory, np.ndarray]:
    way = there - base[:2]
    left = m.direction * float(way @ [np.cos(base[2]), np.sin(base[2])])
    if left < THERE:
        return changed(m, phase="align"), STILL
    error = _course_error(m, base, way)
    speed = config.fine_speed if m.direction > 0 else config.reverse_speed
    far = np.linalg.norm(way) > CLOSE
    rate = _turn(config, error, dt) if far else 0.0
    if abs(error) > config.facing and far:
        return changed(m, phase="turn"), _motion(rate=rate)
    return m, _motion(m.direction * _drive(config, left, speed, dt), rate)


def _align_phase(
    config: BaseApproachConfig, m: Memory, dt: float, base: np.ndarray, there: np.ndarray, at: _Offset
) -> tuple[Memory, np.ndarray]:
    if abs(at.psi) < ALIGNED and abs(m.twist[2]) < ALIGNED_RATE:
        # Too far aside for the line law: a new attempt.
        return changed(m, phase="line" if abs(at.e) < BESIDE * config.pre_stance else "plan"), STILL
    return m, _motion(rate=_turn(config, -at.psi, dt))


def _line_phase(
    config: BaseApproachConfig, m: Memory, dt: float, base: np.ndarray, there: np.ndarray, at: _Offset
) -> tuple[Memory, np.ndarray]:
    if at.s > -LINE_END:
        return changed(m, phase="settle"), STILL
    psi_ref = float(-np.arctan(at.e / config.look_ahead))
    rate = float(np.clip(config.steering * wrap(psi_ref - at.psi), -config.yaw_rate, config.yaw_rate))
    return m, _motion(_drive(config, -at.s, config.line_speed, dt), rate)


def _go(
    config: BaseApproachConfig,
    drive: Drive,
    m: Memory,
    dt: float,
    base: np.ndarray,
    there: np.ndarray,
    at: _Offset,
    first: bool,
) -> tuple[Memory, np.ndarray]:
    """Straight to the stance. there: to it (2,), or, if `first`, to where it has to go before."""
    way = there - base[:2]
    left = math.hypot(*way.tolist())
    if not first and left < config.position_tolerance and abs(at.psi) < config.heading_tolerance:
        return changed(m, phase="settle"), STILL
    speed = config.line_speed if left < config.pre_stance else config.fine_speed
    return m, _towards(config, drive, way, float(base[2]), speed, _turn(config, -at.psi, dt), dt)


PHASES = {"turn": _turn_phase, "drive": _drive_phase, "align": _align_phase, "line": _line_phase}


def _settle(
    config: BaseApproachConfig, m: Memory, time: float, dt: float, state: RobotState, at: _Offset, drive: Drive
) -> tuple[Memory, np.ndarray]:
    """Trims heading and distance; succeeds when the base has been at rest within the tolerances."""
    turn = abs(at.psi) > config.heading_tolerance / 3 and not drive.fixed
    off = math.hypot(at.s, at.e) if drive.sideways else abs(at.s)
    shift = off > config.position_tolerance / 3 and not drive.fixed
    rises = _rises(m, state)
    busy = rises or turn or (shift and (drive.sideways or abs(at.e) < config.position_tolerance))
    if busy or not _still(config, state):
        m = changed(m, quiet_since=time)
    elif time - m.quiet_since >= config.still_time:
        if _within(config, at):
            detail = f"{1e3 * at.s:+.0f} mm along, {1e3 * at.e:+.0f} mm aside, {np.degrees(at.psi):+.2f} deg"
            return _end(m, "succeeded", detail=detail)
        return changed(m, phase="plan"), STILL
    rate = _turn(config, -at.psi, dt) if turn else 0.0
    if drive.sideways:
        way = np.array([-at.s, -at.e]) if shift else STILL[:2]
        return m, _towards(config, drive, way, at.psi, config.trim_speed, rate, dt)
    return m, _motion(_drive(config, -at.s, config.trim_speed, dt) if shift else 0.0, rate)


def _rises(m: Memory, state: RobotState) -> bool:
    """Whether lift or waist is still on its way to the stance's."""
    there = state.torso[: len(m.posture)]
    return len(there) == len(m.posture) and bool(np.any(np.abs(m.posture - there) > RAISED))


# ---------------------------------------------------------------- retreat


def _retreat(
    config: BaseApproachConfig, m: Memory, dt: float, state: RobotState, drive: Drive
) -> tuple[Memory, np.ndarray]:
    if drive.fixed:
        return _end(m, "succeeded", detail="the base is fixed")
    x, y, heading = state.odometry[:3]
    c, s = np.cos(m.start[2]), np.sin(m.start[2])
    back = float(c * (m.start[0] - x) + s * (m.start[1] - y))
    left = config.retreat_distance - back
    m = changed(m, detail=f"{back:.2f} m back", progress=float(np.clip(back / config.retreat_distance, 0, 1)))
    if left < RETREATED and _still(config, state):
        return _end(m, "succeeded", detail=f"{back:.2f} m back")
    rate = _turn(config, wrap(float(m.start[2]) - heading), dt)
    if drive.sideways:
        aside = float(c * (y - m.start[1]) - s * (x - m.start[0]))
        way = np.array([[c, -s], [s, c]]) @ [-max(left, 0.0), -aside]
        return m, _towards(config, drive, way, float(heading), config.retreat_speed, rate, dt)
    return m, _motion(-_drive(config, max(left, 0.0), config.retreat_speed, dt), rate)
