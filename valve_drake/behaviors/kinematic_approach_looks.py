"""Stage 3: the measurements at rest before the turn (mode `measure`) and after it (mode `verify`)."""

import dataclasses as dc

import numpy as np

from valve_drake.behaviors.kinematic_approach_motion import Inputs, Memory, Motion
from valve_drake.frames import compose, inverse, planar, wrap
from valve_drake.memory import changed
from valve_drake.messages import (
    Cause,
    GraspPlan,
    ModeState,
    RectangleEstimate,
    Status,
    TurnState,
    Verdict,
)
from valve_drake.perception.fusion import fuse
from valve_drake.valve.valve import angle_turned

STILL = 0.005  # lift and waist have not moved by more in the last second: they stand [rad, m]
DOUBT = 0.25  # share of the angle after which the marker looks alike: camera and hands may differ by so much
AGREE = 0.1  # camera and hands, on a turn in which nothing slipped [rad]


class Looks(Motion):
    """Modes `measure` and `verify`."""

    # ------------------------------------------------------------ measure
    def _look(self, m: Memory, estimate: RectangleEstimate) -> Memory:
        """Gathers estimates whose images were taken after `since` + settle."""
        if (
            self.valve.seen_by(estimate)
            and estimate.sequence != m.seen
            and estimate.time >= m.since + self.config.settle
            and (not m.looks or estimate.time > m.looks[-1].time)  # an image may come late, after a newer one
        ):
            m = changed(m, looks=(*m.looks, estimate), seen=estimate.sequence)
        return m

    def _measure(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(changed(m, phase="look", since=time), time, "running")
        if m.phase == "planning":
            return self._plan(time, m, inputs.grasps)
        if m.phase != "look":
            return m
        m = self._look(m, inputs.estimate)
        if len(m.looks) < self.config.frames:
            return m
        fused = fuse(m.looks)
        if not fused.found:
            return self._status(changed(m, phase="end"), time, "failed", Verdict.MARKER_LOST, fused.reason)
        past = self.robot.held(inputs.state.history[:, 4:])
        if past.size and not np.max(np.ptp(past, axis=0)) <= STILL:
            return m  # lift or waist is on its way
        X_OA = self.valve.place(fused.X_OV, fused.angle)
        X_BA = compose(inverse(planar(*inputs.state.odometry[:3])), X_OA)
        counted = 0.0
        if m.X_OA0 is not None:
            hands = self._by_hands(m, inputs.turn)
            counted = self.seen_angle(m.X_OA0, X_OA, fused.axis_known, hands)
            if lost := self._lost_count(time, m, counted, hands, fused.axis_known):
                return lost
        first = X_OA if m.X_OA0 is None else m.X_OA0
        m = changed(m, phase="planning", X_OA0=first, X_OA=X_OA, counted=counted, covariance=fused.covariance)
        m = changed(m, p_OV=fused.X_OV[:, 3], plan=GraspPlan())  # what the hands did by it is counted
        posture = self.robot.held(inputs.state.torso)
        return self._ask(m, "grasps", X_BA, posture=posture, turn_angle=inputs.mode.turn_angle - counted)

    def _plan(self, time: float, m: Memory, grasps: GraspPlan) -> Memory:
        """Takes the grasps that were asked for."""
        if grasps.number != m.request.number:
            return m
        m = changed(m, phase="end")
        if not grasps.found:
            detail = f"arm margin {grasps.margin:.2f} from here"
            return self._status(m, time, "failed", Verdict.REACH_LIMIT, detail, cause=Cause.STANCE)
        p = grasps.X_BA[:, 3]
        detail = f"valve {np.hypot(p[0], p[1]):.3f} m ahead, {p[2]:.3f} m high, margin {grasps.margin:.2f}"
        m = changed(m, plan=dc.replace(grasps, time=time, covariance=m.covariance, turned=m.counted))
        return self._status(m, time, "succeeded", detail=detail)

    # ------------------------------------------------------------ verify
    def _verify(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(changed(m, phase="look", since=time), time, "running")
        if m.phase != "look":
            return m
        m = self._look(m, inputs.estimate)
        newest = m.looks[-1].time if m.looks else 0.0
        m = changed(m, looks=tuple(look for look in m.looks if look.time >= newest - self.config.still_time))
        drift = self._drift(m.looks)
        if drift is None or abs(drift) > self.config.still_rate:
            patient = time - m.since <= self.config.look_time
            return m if patient else self._unverified(m, time, inputs.mode, inputs.turn, drift)
        fused = fuse(m.looks)
        m = changed(m, phase="end")
        if not fused.found or m.X_OA0 is None:
            return self._status(m, time, "failed", Verdict.MARKER_LOST, fused.reason)
        X_OA = self.valve.place(fused.X_OV, fused.angle)
        hands = self._by_hands(m, inputs.turn)
        seen = self.seen_angle(m.X_OA0, X_OA, fused.axis_known, hands)
        if lost := self._lost_count(time, m, seen, hands, fused.axis_known):
            return lost
        asked, tolerance = inputs.mode.turn_angle, self.config.angle_tolerance
        detail = f"camera sees {np.degrees(seen):.2f} deg of {np.degrees(asked):.2f} deg"
        if abs(asked - seen) <= tolerance:
            return changed(m, status=self._seen(time, m, "succeeded", Verdict.NONE, detail, seen))
        if not inputs.mode.verdict and abs(asked - hands) > tolerance and abs(hands - seen) < AGREE:
            # The turn ended as it should, where the arms reach no farther.
            status = self._seen(time, m, "failed", Verdict.REACH_LIMIT, detail, seen)
            return changed(m, status=dc.replace(status, cause=Cause.REGRASP.value))
        return changed(m, status=self._seen(time, m, "failed", Verdict.SLIP, detail, seen))

    def _drift(self, looks: tuple[RectangleEstimate, ...]) -> float | None:
        """How fast the valve turns, by the slope of its angle over the looks [rad/s]; None: too few of them to tell.

        A valve without friction goes on turning when the hands let go of it: its angle at one moment is no result.
        """
        if len(looks) < self.config.frames or looks[-1].time - looks[0].time < 0.8 * self.config.still_time:
            return None
        poses = [self.valve.place(compose(look.X_OL, look.X_LV), look.angle) for look in looks]
        period = self.valve.repeats(False)
        slopes = [  # of all pairs: their median is not moved by one wrong estimate
            wrap(angle_turned(poses[i], poses[k]), period) / (looks[k].time - looks[i].time)
            for k in range(len(looks))
            for i in range(k)
        ]
        return float(np.median(slopes))

    def _unverified(self, m: Memory, time: float, mode: ModeState, turn: TurnState, drift: float | None) -> Memory:
        """The camera cannot say how far the valve is turned: what the hands felt is told, and not taken for it."""
        asked, felt = np.degrees(mode.turn_angle), np.degrees(self._by_hands(m, turn))
        hands = f"hands turned {felt:.2f} deg of {asked:.2f} deg"
        m = changed(m, phase="end")
        if drift is None or m.X_OA0 is None:
            words = f"camera does not see the marker, {hands}"
            return self._status(m, time, "failed", Verdict.UNVERIFIED, words, cause=Cause.UNSEEN)
        fused = fuse(m.looks[-1:])
        X_OA = self.valve.place(fused.X_OV, fused.angle)
        seen = self.seen_angle(m.X_OA0, X_OA, fused.axis_known, self._by_hands(m, turn))
        camera = f"camera sees {np.degrees(seen):.2f} deg, turning by {np.degrees(drift):+.2f} deg/s"
        status = self._seen(time, m, "failed", Verdict.UNVERIFIED, f"{camera}, {hands}", seen)
        return changed(m, status=status)

    def _seen(self, time: float, m: Memory, state: str, verdict: str, detail: str, angle: float) -> Status:
        """A status with the angle that the camera saw [rad]."""
        return Status(time, m.activation, state, verdict, detail, 1.0, angle, seen=True)

    def _lost_count(self, time: float, m: Memory, seen: float, hands: float, axis_known: bool) -> Memory | None:
        """The memory of a run that has lost count of the turn; None: it has not.

        Camera and hands that differ by nearly half of what the marker repeats after say nothing of which of two
        positions that look alike it is."""
        period = self.valve.repeats(axis_known)
        if abs(seen - hands) <= DOUBT * period:
            return None
        words = f"tracking was lost: camera sees {np.degrees(seen):.1f} deg, hands turned {np.degrees(hands):.1f} deg"
        detail = f"{words}, and the marker looks alike every {np.degrees(period):.0f} deg"
        return self._status(changed(m, phase="end"), time, "failed", Verdict.UNVERIFIED, detail, Cause.LOST_COUNT)

    def seen_angle(self, X_OA0: np.ndarray, X_OA1: np.ndarray, axis_known: bool, by_hands: float) -> float:
        """The turned angle by camera [rad]. Of the angles that look alike (Valve.repeats) it is the one nearest to what
        the hands felt; the value is the camera's."""
        return by_hands + wrap(angle_turned(X_OA0, X_OA1) - by_hands, self.valve.repeats(axis_known))
