"""The gaze: the search for the valve, and keeping it in view afterwards.

Owns the torso (waist twist, neck pitch, neck yaw) in every mode but the final ones, and the base while searching.

    search   The gaze (waist + neck yaw) sweeps to one end and across, the base turns by half a turn to that side, so
             that the gaze goes on over what is new, and it sweeps back (three sweeps and thirds of a turn if the gaze
             does not reach so far, and so on): that is a round, one for each neck pitch in `pitches`. A sighting stops
             the sweep and is centred; it counts when the last `sightings` of stage 1 agree within 3 sigma or 5 % of the
             distance, else the sweep goes on. Fails with not_found after the last round.
             The gaze waits for images, so that a slow camera makes the search slower and not blind.
             A fixed base does not turn: then a round is one sweep, and the rounds go on downwards as far as the head
             does, since a valve that such a robot can reach is near (`bolted`). A head that does not turn sees as far
             as its images: the base turns it, by so much between two looks, or it looks again.
    others   The neck keeps the last known p_OV on the optical axis of the left camera, the waist comes back to zero;
             only while driving it helps when the neck is at its end.
             Without a sighting for `lost_after` while driving or measuring: failed with marker_lost; while it drives
             across, so that neck and waist do not turn as far as the marker, that does not count. While the hands go to
             the handles, two estimates that agree on another place than the one measured: failed with cause moved.

Sightings carry the camera's pose X_OL of their capture time: p_OV = X_OL p_LV holds in motion too. Frames: frames.py.
"""

import copy
import dataclasses as dc
import math
from collections.abc import Callable

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number, numbers
from valve_drake.frames import apply, wrap
from valve_drake.memory import changed
from valve_drake.messages import (
    Cause,
    Command,
    Mode,
    ModeState,
    RectangleEstimate,
    RobotState,
    Status,
    StereoPosition,
    Verdict,
)
from valve_drake.motion import follow, slew, towards
from valve_drake.robot.drive import DIFFERENTIAL, Drive
from valve_drake.task.modes import FIXED, HOLD, TABLE, WATCHED

HeadPose = Callable[[np.ndarray, np.ndarray], np.ndarray]  # base (x, y, heading) in O, torso (3,) -> X_OL (3, 4)

# A valve that is seen so far from where it was measured may have been moved; estimates scatter by 2 mm [m].
MOVED = 0.03
TURNED = 0.05  # left of the base's turn between two sweeps: the next one begins [rad]
BEHIND = 0.1  # of the neck behind the gaze: the gaze waits for it [rad]
JOINS = 0.1  # an end of a sweep that images have come so near to has been seen [rad]
DRIVING = tuple(mode for mode in WATCHED if TABLE[mode].base != HOLD)


@dc.dataclass
class ValveSearchConfig(Config):
    """Scenario key `valve_search`."""

    KEY = "valve_search"
    sweep_yaw: float = number(1.4, 0.0, 1.6, "neck yaw at the ends of a sweep [rad]")
    sweep_waist: float = number(0.5, 0.0, 0.6, "waist twist there [rad]")
    sweep_speed: float = number(1.0, 0.05, 3.0, "of the gaze [rad/s]")
    pitches: list[float] = numbers([0.15, 0.4, -0.05], -0.5, 1.1, "neck pitch of each round [rad]", count=(1, 20))
    turn_speed: float = number(0.8, 0.05, 2.0, "of the base between sweeps [rad/s]")
    turn_acceleration: float = number(1.0, 0.1, 4.0, "[rad/s^2]")
    sightings: int = number(3, 1, 20, "that must agree")
    spread: float = number(0.05, 0.005, 0.5, "agreement: this share of the distance, or 3 sigma")
    confirm_time: float = number(1.0, 0.1, 10.0, "a sighting has to be confirmed within, [s]")
    confirm_looks: int = number(5, 1, 100, "or within so many pairs of images, whichever takes longer")
    ahead: float = number(0.4, 0.05, 1.0, "the gaze waits for images when it is so far ahead of the last one's [rad]")
    skip_time: float = number(0.5, 0.05, 10.0, "then images are ignored while the sweep moves on [s]")
    lost_after: float = number(2.0, 0.2, 30.0, "without a sighting while driving or measuring [s]")
    moved_by: float = number(
        0.04,
        MOVED,
        0.5,
        "a valve so far from where it was measured was moved; less than that the hands make up for [m]",
    )
    jump: float = number(
        0.5, 0.05, 5.0, "a sighting this far from the last is believed only when the old place is empty [m]"
    )
    jump_after: float = number(0.5, 0.05, 10.0, "for so long [s]")
    neck_speed: float = number(1.5, 0.1, 3.0, "[rad/s]")
    waist_speed: float = number(0.4, 0.05, 1.5, "[rad/s]")
    acceleration: float = number(5.0, 0.2, 20.0, "of waist and neck [rad/s^2]")
    yaw_limit: float = number(1.55, 0.0, 1.6, "of the neck, to both sides [rad]")
    pitch_low: float = number(-0.45, -0.5, 1.1, "of the neck [rad]")
    pitch_high: float = number(1.05, -0.5, 1.1, "of the neck [rad]")

    def relations(self, key: str) -> None:
        low, high = self.pitch_low, self.pitch_high
        require(low <= high, f"{key}.pitch_low", f"at most pitch_high, {high:g}", low)
        within = all(low <= pitch <= high for pitch in self.pitches)
        require(within, f"{key}.pitches", f"within pitch_low and pitch_high, [{low:g}, {high:g}]", self.pitches)
        within = self.sweep_yaw <= self.yaw_limit
        require(within, f"{key}.sweep_yaw", f"at most yaw_limit, {self.yaw_limit:g}", self.sweep_yaw)


@dc.dataclass(frozen=True)
class GazeLimits:
    """What a robot's joints can do: pitches are downwards, pan and waist go as far to both sides [rad].

    None: there is no such joint.
    """

    pitch: tuple[float, float] | None
    pan: float | None
    waist: float | None


@dc.dataclass(frozen=True)
class Sight:
    """What the eyes see at once [rad]; the defaults are those of lenses that are as long as ours, or shorter.

    aside: a marker so far beside the optical axis is seen whole, by both. lower: between two rounds of a fixed robot.
    """

    aside: float = 0.2
    lower: float = 0.22

    @staticmethod
    def of(half_width: float, half_height: float) -> "Sight":
        """half_width, half_height: half the field of the narrower eye [rad]."""
        return Sight(min(Sight.aside, 0.8 * half_width), min(Sight.lower, 1.2 * half_height))


USUAL = Sight()


def reachable(config: ValveSearchConfig, limits: GazeLimits) -> tuple[ValveSearchConfig, list[str]]:
    """The gaze as this robot's joints can do it, and a line for every value that is not as configured.

    A default is clipped; a value that was chosen is refused, by a ConfigError that names the key. A value that equals
    the default counts as one. A head without a tilt or a pan looks along its mount: one line says so.
    """
    default, fitted = ValveSearchConfig(), copy.deepcopy(config)
    ways = {"tilt": "up or down", "pan": "aside"}
    lacks = {joint for joint, limit in (("tilt", limits.pitch), ("pan", limits.pan)) if limit is None}
    notes = [f"gaze.{joint}: none: the head does not turn {ways[joint]}" for joint in ways if joint in lacks]
    pitch, yaw = limits.pitch or (0.0, 0.0), (0.0, limits.pan or 0.0)
    asked = [("tilt", name, pitch) for name in ("pitch_low", "pitch_high", "pitches")]
    asked += [("pan", name, yaw) for name in ("yaw_limit", "sweep_yaw")]
    if limits.waist is not None:
        asked.append(("waist", "sweep_waist", (0.0, limits.waist)))
    for joint, name, (low, high) in asked:
        value = getattr(config, name)
        values = value if isinstance(value, list) else [value]
        clipped = [_within(one, low, high) for one in values]
        if clipped == values:
            continue
        words = f"within what the robot's joint can do, [{low:g}, {high:g}]"
        require(value == getattr(default, name), f"{config.KEY}.{name}", words, value)
        new = list(dict.fromkeys(clipped)) if isinstance(value, list) else clipped[0]  # no round twice
        setattr(fitted, name, new)
        if joint not in lacks:
            notes.append(f"{config.KEY}.{name}: {_said(new)} instead of {_said(value)}: what the robot's joint can do")
    return fitted, notes


def _said(value: float | list[float]) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "[" + ", ".join(f"{one:.4g}" for one in value) + "]"


@dc.dataclass(frozen=True, eq=False)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    since: float = 0.0  # of this activation [s]
    result: str = "running"  # running | succeeded | failed
    verdict: str = Verdict.NONE.value
    detail: str = ""
    cause: str = Cause.NONE.value
    # torso
    started: bool = False  # the torso has been measured: its command starts there
    torso: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # command [rad]
    velocity: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # of the command [rad/s]
    goal: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # of the previous step [rad]
    lift: np.ndarray | None = None  # where it is sent, as a stance asked for last; None: home [m, rad]
    # the marker
    target: np.ndarray | None = None  # p_OV [m]
    aside: np.ndarray | None = None  # where it looks, off the target, in O [m]; None: at it
    target_time: float = -np.inf  # its capture time [s]
    averted: float = -np.inf  # when the gaze last did not reach it while driving [s]
    capture_time: float = -np.inf  # of the newest sighting looked at [s]
    estimate_time: float = -np.inf  # capture time of the newest pose of the marker [s]
    estimated: np.ndarray | None = None  # p_OV by it [m]
    measured: np.ndarray | None = None  # p_OV when the hands set out for the handles [m]
    elsewhere: np.ndarray | None = None  # p_OV of the last pose, if it is far from there [m]
    # search
    sweeps: int = -1  # completed across; -1: on the way to the first end
    side: float = 1.0  # the end it is moving to
    gaze: float = 0.0  # waist + neck yaw asked for [rad]
    to_turn: float = 0.0  # left of the base's turn between two sweeps, positive to the left [rad]
    owed: float = 0.0  # by which the last turn of this round fell short, added to the next [rad]
    heading: float = 0.0  # of the base at the previous step [rad]
    turn_rate: float = 0.0  # commanded [rad/s]
    looks: tuple[tuple[np.ndarray, float], ...] = ()  # p_OV [m] and its sigma [m], of the last sightings
    confirm_until: float = -np.inf  # [s]
    confirm_left: int = 0  # pairs of images that a sighting may still be confirmed by
    seen_time: float = -np.inf  # capture time of the newest pair of images, whatever it shows [s]
    seen_azimuth: float = 0.0  # of the left camera's axis then, in O [rad]
    looked: bool = False  # there was a pair of images in this sweep
    ignore_until: float = -np.inf  # capture time [s]


def aim(head_pose: HeadPose, base: np.ndarray, torso: np.ndarray, p_OV: np.ndarray) -> tuple[float, float]:
    """Neck pitch and yaw that bring p_OV nearer to the left camera's optical axis.

    One step of a fixed-point iteration from `torso`: turn by the difference of azimuth and elevation between the axis
    and the line to the point. Exact but for the eye's offset from the neck, so each step divides the error by distance
    over offset (> 6); the caller takes one each tick, from its last result. Joint limits are the caller's.
    """
    X_OL = head_pose(base, torso)
    x, y, z = X_OL[:, 2].tolist()
    dx, dy, dz = (p_OV - X_OL[:, 3]).tolist()
    _, pitch, yaw = torso.tolist()
    yaw += wrap(math.atan2(dy, dx) - math.atan2(y, x))
    pitch += math.atan2(z, math.hypot(x, y)) - math.atan2(dz, math.hypot(dx, dy))
    return pitch, yaw


def agree(config: ValveSearchConfig, looks: tuple[tuple[np.ndarray, float], ...], eye: np.ndarray) -> bool:
    """Whether the last sightings show one place."""
    if len(looks) < config.sightings:
        return False
    points = np.array([p for p, _ in looks])
    mean = points.mean(axis=0)
    allowed = max(3 * max(sigma for _, sigma in looks), config.spread * float(np.linalg.norm(mean - eye)))
    return float(np.max(np.linalg.norm(points - mean, axis=1))) < allowed


def step(
    config: ValveSearchConfig,
    memory: Memory,
    time: float,
    dt: float,
    robot_state: RobotState,
    mode: ModeState,
    position: StereoPosition,
    estimate: RectangleEstimate,
    head_pose: HeadPose,
    look: np.ndarray | None = None,
    drive: Drive = DIFFERENTIAL,
    sight: Sight = USUAL,
) -> tuple[Memory, Command, Status]:
    """One tick of length dt -> memory, command, status. look: where to look, off the marker's middle, in V (3,)."""
    m = memory
    if look is not None and estimate.found and estimate.axis_known:
        m = changed(m, aside=estimate.X_OL[:, :3] @ estimate.X_LV[:, :3] @ look)
    base = robot_state.odometry[:3]
    if not m.started:
        if len(robot_state.history) == 0:  # nothing was measured yet
            return m, Command(time=time), Status(time=time, activation=mode.activation)
        m = changed(m, started=True, torso=robot_state.torso, goal=robot_state.torso, velocity=np.zeros(3))
    if mode.activation != m.activation:
        m = _begin(m, time, mode, base)

    twist = None
    if mode.mode == Mode.SEARCH:
        m, goal = _search(config, m, time, dt, base, position, head_pose, _sweeps(config, drive, sight), sight)
        twist = None if drive.fixed else drive.part(np.array([0.0, 0.0, m.turn_rate]))
    else:
        m = _sight(config, m, position, estimate)
        m = _place(config, m, estimate, mode.mode in FIXED and m.result == "running")
        if mode.mode in WATCHED and m.result == "running":
            if mode.mode in DRIVING and _out_of_reach(config, m, base, robot_state.torso, head_pose, sight):
                m = changed(m, averted=time)
            blind = time - max(m.since, m.target_time, m.averted)
            if blind > config.lost_after:
                m = _end(m, "failed", Verdict.MARKER_LOST, f"marker not seen for {blind:.1f} s")
        waist = float(robot_state.torso[0])
        goal = _gaze(config, m, base, waist, mode.mode in DRIVING, head_pose)
    speed, now = (config.waist_speed, config.neck_speed, config.neck_speed), m.torso.tolist()
    new = [
        follow(*joint, config.acceleration, dt)
        for joint in zip(goal.tolist(), ((goal - m.goal) / dt).tolist(), now, m.velocity.tolist(), speed)
    ]
    torso, velocity = np.array(new), np.array([(after - before) / dt for after, before in zip(new, now)])
    m = changed(m, torso=torso, velocity=velocity, goal=goal)
    return (
        m,
        Command(time=time, torso=torso, base_twist=twist),
        _status(config, m, time, mode, _sweeps(config, drive, sight)),
    )


def _begin(m: Memory, time: float, mode: ModeState, base: np.ndarray) -> Memory:
    """A fresh activation: keeps the command and the last known place of the marker, forgets the rest."""
    gaze = float(m.torso[0] + m.torso[2])
    return Memory(
        activation=mode.activation,
        since=time,
        started=m.started,
        torso=m.torso,
        velocity=m.velocity,
        goal=m.goal,
        lift=m.lift,
        target=m.target,
        aside=m.aside,
        target_time=m.target_time,
        capture_time=m.capture_time,
        estimate_time=m.estimate_time,
        estimated=m.estimated,
        measured=_measured(m, mode),
        side=1.0 if gaze >= 0 else -1.0,  # the nearer end first
        gaze=gaze,
        heading=float(base[2]),
        seen_time=time,
        seen_azimuth=float(base[2]) + gaze,
    )


def _measured(m: Memory, mode: ModeState) -> np.ndarray | None:
    """Where the marker was when the hands set out, for as long as they follow that measurement."""
    if mode.mode == Mode.SEARCH or mode.mode in WATCHED:
        return None
    return m.estimated if m.measured is None and mode.mode in FIXED else m.measured


def _end(m: Memory, result: str, verdict: str = Verdict.NONE, detail: str = "") -> Memory:
    return changed(m, result=result, verdict=str(verdict), detail=detail)


def bolted(config: ValveSearchConfig, sight: Sight = USUAL) -> ValveSearchConfig:
    """The config of a search without a base that turns."""
    steeper = np.arange(max(config.pitches) + sight.lower, config.pitch_high, sight.lower).tolist()
    first = [pitch for pitch in sorted(config.pitches) if pitch >= config.pitches[0]]
    rest = [pitch for pitch in config.pitches if pitch not in first]
    pitches = [*first, *steeper, *rest]
    if len(pitches) == 1 and config.sweep_yaw + config.sweep_waist == 0.0:  # nothing turns: it looks again, and waits
        pitches *= config.confirm_looks
    return dc.replace(config, pitches=pitches)


def _sweeps(config: ValveSearchConfig, drive: Drive, sight: Sight) -> int:
    """Of a round: as many as see all round, from as many headings of the base."""
    if drive.fixed:
        return 1
    return math.ceil(np.pi / (config.sweep_yaw + config.sweep_waist + sight.aside))


def _status(config: ValveSearchConfig, m: Memory, time: float, mode: ModeState, sweeps: int) -> Status:
    if mode.mode != Mode.SEARCH and mode.mode not in WATCHED and m.result == "running":
        return Status(time=time, activation=mode.activation)
    progress = 0.0
    if mode.mode == Mode.SEARCH:
        progress = 1.0 if m.result == "succeeded" else max(m.sweeps, 0) / (sweeps * len(config.pitches))
    return Status(time, mode.activation, m.result, m.verdict, m.detail, progress, cause=m.cause)


# ---------------------------------------------------------------- gaze


def _sight(config: ValveSearchConfig, m: Memory, position: StereoPosition, estimate: RectangleEstimate) -> Memory:
    """Takes the newer of the sightings of stages 1 and 2 as the marker's place."""
    if estimate.found and not (position.found and position.time > estimate.time):
        time, X_OL, p_LV = estimate.time, estimate.X_OL, estimate.X_LV[:, 3]
    elif position.found:
        time, X_OL, p_LV = position.time, position.X_OL, position.p_LV
    else:
        return m
    if time <= m.capture_time:
        return m
    m = changed(m, capture_time=time)
    p_OV = apply(X_OL, p_LV)
    if not np.all(np.isfinite(p_OV)):  # it would stay in the memory
        return m
    far = m.target is not None and np.linalg.norm(p_OV - m.target) > config.jump
    if far and time - m.target_time < config.jump_after:
        return m
    return changed(m, target=p_OV, target_time=time)


def _place(config: ValveSearchConfig, m: Memory, estimate: RectangleEstimate, judge: bool) -> Memory:
    """Takes a new pose of the marker; judge: whether it ends the mode if the valve is not where it was measured.

    Stage 1 has no say in this: the middle of a marker that an arm covers in part is not its middle."""
    if not estimate.found or estimate.time <= m.estimate_time:
        return m
    p_OV = apply(estimate.X_OL, estimate.X_LV[:, 3])
    if not np.all(np.isfinite(p_OV)):
        return m
    m = changed(m, estimate_time=estimate.time, estimated=p_OV)
    if not judge or m.measured is None or estimate.time <= m.since:
        return m
    off = float(np.linalg.norm(p_OV - m.measured))
    if off < config.moved_by:
        return changed(m, elsewhere=None)
    if m.elsewhere is None or np.linalg.norm(p_OV - m.elsewhere) > config.moved_by / 2:
        return changed(m, elsewhere=p_OV)
    words = f"marker {1e3 * off:.0f} mm from where it was measured"
    return changed(_end(m, "failed", Verdict.MARKER_LOST, words), cause=Cause.MOVED.value)


def _gaze(
    config: ValveSearchConfig, m: Memory, base: np.ndarray, waist: float, driving: bool, head_pose: HeadPose
) -> np.ndarray:
    """Torso goal that keeps the target centred; without a target the neck stays."""
    if m.target is None:
        return np.array([0.0, *m.goal.tolist()[1:]])
    there = m.target if m.aside is None else m.target + m.aside
    pitch, yaw = aim(head_pose, base, np.array([waist, *m.goal.tolist()[1:]]), there)
    # The waist turns by what the neck cannot, but only while the arms are folded.
    beyond = waist + yaw - _within(waist + yaw, -config.sweep_yaw, config.sweep_yaw)
    twist = _within(beyond, -config.sweep_waist, config.sweep_waist) if driving else 0.0
    return np.array([twist, *neck(config, pitch, yaw)])


def _out_of_reach(
    config: ValveSearchConfig, m: Memory, base: np.ndarray, torso: np.ndarray, head_pose: HeadPose, sight: Sight
) -> bool:
    """Whether neck and waist together do not turn as far as the marker."""
    if m.target is None:
        return False
    _, yaw = aim(head_pose, base, torso, m.target)
    return abs(wrap(float(torso[0]) + yaw)) > config.yaw_limit + config.sweep_waist + sight.aside


def neck(config: ValveSearchConfig, pitch: float, yaw: float) -> tuple[float, float]:
    """Neck pitch and yaw, clipped to the joints' limits."""
    return (
        _within(pitch, config.pitch_low, config.pitch_high),
        _within(yaw, -config.yaw_limit, config.yaw_limit),
    )


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


# ---------------------------------------------------------------- search


def _search(
    config: ValveSearchConfig,
    m: Memory,
    time: float,
    dt: float,
    base: np.ndarray,
    position: StereoPosition,
    head_pose: HeadPose,
    sweeps: int,
    sight: Sight,
) -> tuple[Memory, np.ndarray]:
    """One tick of the search -> memory, torso goal. sweeps: of a round; between two the base turns."""
    turned = wrap(float(base[2]) - m.heading)
    m = changed(m, heading=float(base[2]))
    if m.to_turn:
        m = changed(m, to_turn=m.to_turn - turned)
    elif m.owed:
        m = changed(m, owed=m.owed - turned)
    if m.result == "running":
        m = _look(config, m, time, position)
    confirming = bool(m.looks) and (time < m.confirm_until or m.confirm_left > 0)
    if m.looks and not confirming and m.result == "running":
        m = changed(m, looks=(), ignore_until=time + config.skip_time)
    if confirming or m.result != "running":
        m = changed(m, turn_rate=slew(m.turn_rate, 0.0, config.turn_acceleration * dt))
        if not m.looks:
            return m, m.goal
        way = aim(head_pose, base, m.goal, m.looks[-1][0])
        return m, np.array([m.goal[0], *neck(config, *way)])
    return _sweep(config, m, dt, float(base[2]), sweeps, sight)


def _look(config: ValveSearchConfig, m: Memory, time: float, position: StereoPosition) -> Memory:
    """Takes a new sighting of both cameras, and decides whether the last ones agree."""
    if position.time > m.seen_time:
        axis = position.X_OL[:, 2]
        azimuth, left = float(np.arctan2(axis[1], axis[0])), max(m.confirm_left - 1, 0)
        m = changed(m, seen_time=position.time, seen_azimuth=azimuth, confirm_left=left, looked=True)
    if not position.found or position.time <= max(m.capture_time, m.since, m.ignore_until):
        return m
    p_OV = apply(position.X_OL, position.p_LV)
    if not np.all(np.isfinite(p_OV)):
        return m
    sigma = float(np.sqrt(np.trace(position.covariance)))
    looks = (*m.looks, (p_OV, sigma))[-config.sightings :]
    if not m.looks:
        m = changed(m, confirm_until=time + config.confirm_time, confirm_left=config.confirm_looks)
    m = changed(m, looks=looks, capture_time=position.time)
    if not agree(config, looks, position.X_OL[:, 3]):
        return m
    p_OV = np.mean([p for p, _ in looks], axis=0)
    distance = float(np.hypot(*(p_OV - position.X_OL[:, 3])[:2]))
    m = changed(m, target=p_OV, target_time=position.time)
    return _end(m, "succeeded", detail=f"marker {distance:.2f} m away, {p_OV[2]:.2f} m high")


def _sweep(
    config: ValveSearchConfig, m: Memory, dt: float, heading: float, round_: int, sight: Sight
) -> tuple[Memory, np.ndarray]:
    """Moves the gaze on, or the base between two sweeps -> memory, torso goal. round_: sweeps of one."""
    end = config.sweep_yaw + config.sweep_waist
    pitch = config.pitches[max(m.sweeps, 0) // round_]
    goal = _sweep_torso(config, m.gaze, pitch)
    if abs(m.to_turn) > TURNED:
        rate = towards(m.to_turn, config.turn_speed, config.turn_acceleration, dt)
        return changed(m, turn_rate=slew(m.turn_rate, rate, config.turn_acceleration * dt)), goal
    m = changed(m, turn_rate=slew(m.turn_rate, 0.0, config.turn_acceleration * dt))
    if m.to_turn:
        m = changed(m, to_turn=0.0, owed=m.to_turn)
    if np.max(np.abs(goal - m.torso)[1:]) > BEHIND:  # the neck is still on its way, after a look aside or a new pitch
        return m, goal
    if m.side * wrap(heading + m.gaze - m.seen_azimuth) > config.ahead:  # or a slow camera would miss what is passed
        return m, goal
    gaze = slew(m.gaze, m.side * end, config.sweep_speed * dt)
    m = changed(m, gaze=float(gaze))
    # It does not turn back before its images join those of the next sweep.
    unseen = m.side * wrap(heading + m.gaze - m.seen_azimuth)
    if gaze == m.side * end and m.looked and unseen <= max(end + sight.aside - np.pi / round_, JOINS):
        sweeps = m.sweeps + 1
        onward = m.side if sweeps % round_ % 2 else -m.side  # every turn of a round goes the same way
        turn = onward * 2 * np.pi / round_ + m.owed if sweeps % round_ else 0.0
        m = changed(m, sweeps=sweeps, side=-m.side, to_turn=turn, owed=0.0, looked=False)
        if sweeps == round_ * len(config.pitches):
            where = "all round" if round_ > 1 else "as far as the head turns"
            m = _end(m, "failed", Verdict.NOT_FOUND, f"no marker in {sweeps} sweeps {where}")
            return m, goal
    return m, _sweep_torso(config, m.gaze, pitch)


def _sweep_torso(config: ValveSearchConfig, gaze: float, pitch: float) -> np.ndarray:
    """Waist and neck share the gaze in proportion to their ranges."""
    whole = config.sweep_waist + config.sweep_yaw
    share = config.sweep_waist / whole if whole else 0.0  # a head that does not turn
    return np.array([share * gaze, pitch, (1 - share) * gaze])
