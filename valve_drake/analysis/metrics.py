"""The numbers of a run, computed from its log alone (by way of traces.py)."""

import dataclasses as dc
import functools
import itertools
import os
from typing import Any

import numpy as np

from valve_drake.analysis.traces import Estimates, ModeSpan, Touches, Traces
from valve_drake.messages import SIDES, Mode
from valve_drake.recording.reader import LogReader
from valve_drake.task.modes import TERMINAL

LOADED = 1.0  # below this couple the hands' shares are noise and are left out [N m]


TURNED = 0.02  # a valve that moved less than this in all has not been turned [rad]
SLIPPING = 0.005  # of pads along a handle; hands that hold creep by less than a fifth of it [m/s]
PERIOD = 1 / 16  # of looks at the contacts [s]
APART = 0.25  # two touches of one pair of bodies with less between them are one [s]


@dc.dataclass(frozen=True)
class Collision:
    """Two bodies that should not have touched, one of them the robot's."""

    bodies: str
    time_s: float  # of the first touch
    duration_s: float
    peak_force_N: float


@dc.dataclass(frozen=True)
class EstimateNumbers:
    """Stage 2 within one mode. Errors against truth include the head's mount (traces.py); None without truth.

    spread: scatter of the errors about their mean against the claimed covariance, as the root of the mean normalised
    square; 1 is an honest covariance. Nothing that is constant enters it, such as the mount. None below 4 estimates.
    """

    found: int
    distance_m: float  # median
    position_rms_m: float | None
    position_max_m: float | None
    angle_rms_rad: float | None
    sigma_position_m: float  # claimed: root mean square, all three axes together
    sigma_angle_rad: float
    spread: float | None
    residual_px: float  # median


@dc.dataclass(frozen=True)
class TrackingNumbers:
    """Commanded minus measured position of one joint over the whole run."""

    rms_rad: float
    max_rad: float
    max_time_s: float


@dc.dataclass
class Summary:
    """A run in numbers; None where the log does not say.

    Angles are turned since the start, counter-clockwise for the robot.
    """

    outcome: str = ""  # done | failed | stopped | "" (did not finish)
    verdict: str = ""
    reason: str = ""
    spans: list[ModeSpan] = dc.field(default_factory=list)
    sim_time_s: float = 0.0
    retries: int = 0  # entries into a mode that had been entered before, with the same grasp
    command_rad: float | None = None
    angle_hands_rad: float | None = None
    angle_camera_rad: float | None = None
    angle_true_rad: float | None = None
    peak_hand_force_N: float = 0.0  # whole run
    turn_peak_hand_force_N: float = 0.0  # while turning
    turn_mean_hand_force_N: float = 0.0
    turn_mean_stem_force_N: float = 0.0
    turn_peak_stem_force_N: float = 0.0
    turn_mean_squeeze_N: float | None = None
    turn_mean_torque_Nm: float | None = None
    turn_peak_torque_Nm: float | None = None
    turn_peak_moment_Nm: float | None = None  # of one hand at its grip
    turn_share_left: float | None = None  # mean, where the couple exceeds 1 N m
    # By the simulation's truth; None where the log has none. Of a hand: the share of the valve's way during which both
    # its pads held (None too if the valve did not move), how often it slipped or lost hold while turning.
    contact_honesty: dict[str, float] | None = None
    slips: dict[str, int] | None = None
    collisions: int | None = None
    collided: list[Collision] = dc.field(default_factory=list)
    peak_internal_force_N: float | None = None
    estimates: dict[str, EstimateNumbers] = dc.field(default_factory=dict)  # by mode
    pairs_looked_at: int = 0  # image pairs
    pairs_found: int = 0  # those in which the estimator found the marker
    worst_estimate_time_s: float | None = None  # largest position error, without truth largest residual
    servo_final_error_m: dict[str, float] = dc.field(default_factory=dict)  # by side, at the end of the last servo
    servo_peak_speed_m_s: dict[str, float] = dc.field(default_factory=dict)
    tracking: dict[str, TrackingNumbers] = dc.field(default_factory=dict)  # by joint
    health_max_age_s: float | None = None
    health_oldest: str = ""  # the device of that age
    faults: list[tuple[float, str]] = dc.field(default_factory=list)  # first reported at [s]
    selector_limited: dict[str, int] = dc.field(default_factory=dict)  # ticks, by what was limited
    selector_refused: dict[str, int] = dc.field(default_factory=dict)
    selector_tripped: dict[str, int] = dc.field(default_factory=dict)

    @property
    def last_mode(self) -> str:
        """The mode in which the run ended: the last one before its outcome; "" if there was none."""
        return next((span.mode for span in reversed(self.spans) if span.mode != self.outcome), "")

    def mode_durations(self) -> dict[str, float]:
        """Seconds by mode, in the order of first entry."""
        out: dict[str, float] = {}
        for span in self.spans:
            out[span.mode] = out.get(span.mode, 0.0) + span.duration
        return out


def figures(s: Summary) -> dict[str, Any]:
    """The numbers of a run for programs: what `run --json` and a campaign's records have of them.

    estimator_nees: normalised estimation error squared, a degree of freedom, of the pose measured at rest, about the
    errors' mean (see EstimateNumbers.spread); 1 is an honest covariance, below it is cautious.
    """
    rest = s.estimates.get(Mode.MEASURE)
    spread = rest.spread if rest is not None else None
    return {
        "sim_time_s": s.sim_time_s,
        "retries": s.retries,
        "valve_angle_command_rad": s.command_rad,
        "valve_angle_estimated_rad": s.angle_camera_rad,
        "valve_angle_hands_rad": s.angle_hands_rad,
        "valve_angle_true_rad": s.angle_true_rad,
        "peak_hand_force_N": s.peak_hand_force_N,
        "turn_peak_hand_force_N": s.turn_peak_hand_force_N,
        "turn_mean_hand_force_N": s.turn_mean_hand_force_N,
        "turn_mean_stem_force_N": s.turn_mean_stem_force_N,
        "turn_share_left": s.turn_share_left,
        "contact_honesty": s.contact_honesty,
        "slips": s.slips,
        "collisions": s.collisions,
        "collided": [dc.asdict(found) for found in s.collided],
        "peak_internal_force_N": s.peak_internal_force_N,
        "estimator_nees": None if spread is None else spread**2,
        "measured_position_rms_m": None if rest is None else rest.position_rms_m,
        "measured_angle_rms_rad": None if rest is None else rest.angle_rms_rad,
    }


def summarize(log: str | os.PathLike[str] | LogReader | Traces) -> Summary:
    """The numbers of one log."""
    if not isinstance(log, Traces):
        log = Traces(log if isinstance(log, LogReader) else LogReader(log))
    out = Summary(spans=log.spans, sim_time_s=log.reader.end)
    out.retries = sum(span.attempt > 0 for span in log.spans)
    if log.modes:
        out.verdict, out.reason = log.modes[-1].verdict, log.modes[-1].reason
        asked = [mode.turn_angle for mode in log.modes if mode.turn_angle]
        out.command_rad = asked[-1] if asked else None
    if log.spans and log.spans[-1].mode in TERMINAL:
        out.outcome = log.spans[-1].mode
    out.angle_camera_rad = log.verify_angle
    out.angle_true_rad = _true_angle(log)
    for part in (_turning, _contacts, _estimates, _servo, _joints, _health):
        log.attempt(part.__name__.removeprefix("_"), functools.partial(part, log, out), None)
    out.faults = log.faults
    if log.selector is not None:
        did = log.selector
        out.selector_limited, out.selector_refused, out.selector_tripped = (
            did["limited"],
            did["refused"],
            did["tripped"],
        )
    return out


def _true_angle(log: Traces) -> float | None:
    """Turned since the last run began: a log of an operator's session holds several [rad]."""
    if log.truth is None:
        return None
    begun = [after.start for before, after in itertools.pairwise(log.spans) if before.mode == Mode.IDLE]
    angle = log.truth.angle
    before = float(np.interp(begun[-1], log.truth.time, angle)) if len(begun) > 1 else 0.0
    return float(angle[-1]) - before


def _health(log: Traces, out: Summary) -> None:
    if log.health is None:
        return
    _, devices, ages = log.health
    out.health_max_age_s = float(ages.max())
    out.health_oldest = devices[int(ages.max(axis=0).argmax())] if ages.max() > 0 else ""


def _turning(log: Traces, out: Summary) -> None:
    turn = log.turn
    if turn is None:
        return
    hands = np.column_stack([turn["force_left"], turn["force_right"]])
    out.peak_hand_force_N = float(hands.max())
    at = log.inside(turn["time"], Mode.TURN)
    if not at.any():
        return
    out.angle_hands_rad = float(turn["angle"][at][-1])
    out.turn_peak_hand_force_N = float(hands[at].max())
    out.turn_mean_hand_force_N = float(hands[at].mean())
    out.turn_mean_stem_force_N = float(turn["stem_force"][at].mean())
    out.turn_peak_stem_force_N = float(turn["stem_force"][at].max())
    out.turn_mean_squeeze_N = float(turn["squeeze"][at].mean())
    torque = np.abs(turn["torque"][at])
    out.turn_mean_torque_Nm, out.turn_peak_torque_Nm = float(torque.mean()), float(torque.max())
    out.turn_peak_moment_Nm = float(max(turn["moment_left"][at].max(), turn["moment_right"][at].max()))
    loaded = torque > LOADED
    out.turn_share_left = float(turn["share_left"][at][loaded].mean()) if loaded.any() else None


def _contacts(log: Traces, out: Summary) -> None:
    touches, truth = log.touches, log.truth
    if touches is None:
        return
    turning = log.inside(touches.time, Mode.TURN)
    held = {side: touches.held(side) for side in SIDES}
    out.peak_internal_force_N = float(touches.internal.max())
    out.slips = {}
    for side in SIDES:
        sliding = held[side] & (touches.slip[side] > SLIPPING)
        lost = np.append(False, held[side][:-1] & ~held[side][1:])
        out.slips[side] = _begins(turning & sliding) + int((turning & lost).sum())
    out.collided = _collisions(touches)
    out.collisions = len(out.collided)
    if truth is not None and len(truth.time) > 1:
        way = np.abs(np.diff(truth.angle))
        if way.sum() > TURNED:
            at = touches.at(truth.time[1:])
            out.contact_honesty = {side: float(way[held[side][at]].sum() / way.sum()) for side in SIDES}


def _begins(happens: np.ndarray) -> int:
    """How often something begins (n,) bool."""
    return int(np.sum(happens & ~np.append(False, happens[:-1])))


def _collisions(touches: Touches) -> list[Collision]:
    """In the order of their beginnings. A row holds until the next one."""
    ends = np.append(touches.time[1:], touches.time[-1:] + PERIOD)
    out: list[Collision] = []
    open_: dict[str, int] = {}  # bodies -> the last one's place in `out`
    for time, end, others in zip(
        touches.time.tolist(), np.minimum(ends, touches.time + PERIOD).tolist(), touches.others
    ):
        for bodies, force in others.items():
            last = out[open_[bodies]] if bodies in open_ else None
            if last is not None and time - last.time_s - last.duration_s < APART:
                peak = max(last.peak_force_N, force)
                out[open_[bodies]] = dc.replace(last, duration_s=end - last.time_s, peak_force_N=peak)
            else:
                open_[bodies] = len(out)
                out.append(Collision(bodies, time, end - time, force))
    return out


def _estimates(log: Traces, out: Summary) -> None:
    found = log.estimates
    if found is None:
        return
    out.pairs_looked_at, out.pairs_found = found.looked, len(found.time)
    if len(found.time) == 0:
        return
    errors = np.linalg.norm(found.position_error, axis=1)
    worst = errors if np.isfinite(errors).all() else found.residual_px
    out.worst_estimate_time_s = float(found.time[int(np.argmax(worst))])
    for mode in dict.fromkeys(span.mode for span in log.spans):
        at = log.inside(found.time, mode)
        if at.any():
            out.estimates[mode] = _estimate_numbers(found, at)


def _estimate_numbers(found: Estimates, at: np.ndarray) -> EstimateNumbers:
    error, sigma = found.error[at], found.sigma[at]
    known = bool(np.isfinite(error).all())
    position = np.linalg.norm(error[:, 3:], axis=1)
    return EstimateNumbers(
        found=int(at.sum()),
        distance_m=float(np.median(found.distance[at])),
        position_rms_m=_rms(position) if known else None,
        position_max_m=float(position.max()) if known else None,
        angle_rms_rad=_rms(np.linalg.norm(error[:, :3], axis=1)) if known else None,
        sigma_position_m=_rms(np.linalg.norm(sigma[:, 3:], axis=1)),
        sigma_angle_rad=_rms(np.linalg.norm(sigma[:, :3], axis=1)),
        spread=_spread(error, found.covariance[at]) if known else None,
        residual_px=float(np.median(found.residual_px[at])),
    )


def _spread(error: np.ndarray, covariance: np.ndarray) -> float | None:
    if len(error) < 4:
        return None
    off = error - error.mean(axis=0)
    try:
        squares = [e @ np.linalg.solve(C, e) for e, C in zip(off, covariance)]
    except np.linalg.LinAlgError:
        return None
    return float(np.sqrt(np.sum(squares) / (6 * (len(error) - 1))))


def _servo(log: Traces, out: Summary) -> None:
    if log.servo is None:
        return
    for side in SIDES:
        out.servo_final_error_m[side] = float(log.servo[f"{side}_error"][-1])
        if f"{side}_speed" in log.servo:
            out.servo_peak_speed_m_s[side] = float(log.servo[f"{side}_speed"].max())


def _joints(log: Traces, out: Summary) -> None:
    joints = log.joints
    if joints is None:
        return
    for name in (name for group in log.groups.values() for name in group):
        error = joints.error((name,))
        error = np.abs(error[:, 0]) if error.shape[1] else error
        if error.size and np.isfinite(error).all():
            k = int(error.argmax())
            out.tracking[name] = TrackingNumbers(_rms(error), float(error[k]), float(joints.time[k]))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
