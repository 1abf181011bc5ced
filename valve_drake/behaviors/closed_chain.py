"""Both hands and the valve as one closed chain with a single free motion, the turn: wrenches in, twists out.

With everything at a point c of the valve's axis, u the axis towards the robot, the wrenches felt by the hands and
their twists are split into common and relative parts [Uchiyama, Dauchez 1988]:

    h_i = [m_i + (p_i - c) x f_i ; f_i]       h_a = h_1 + h_2       h_r = (h_2 - h_1) / 2              (1)
    V_1 = V_a - V_r / 2,  V_2 = V_a + V_r / 2                                                          (2)
    u . w_a = turn rate;   the other five of V_a = D_a^-1 (h_a - h_a*)                                 (3)
    V_r = D_r^-1 (h_r - h_r*)                                                                          (4)
    f_i* = -tau / (r_1 + r_2) t_i  -+ squeeze b,   and its moment about c                               (5)

hand 1 left, 2 right; r_i each hand's own radius and t_i = u x r_i / |r_i| its tangent, b from hand 1 to 2, tau the
couple on the valve: each hand drives with the same force. h_a*, h_r* follow from (5) as h_a, h_r from h_i. D_a = 2 D
and D_r = D / 2 give each hand the same damping D. The terms of (5) in tau are necessary: the driving forces are
themselves a relative wrench, and with a constant target the hands yield to the couple that they should apply. With
handles that face each other at equal radii h_a* is zero and h_r* = squeeze b - (tau / L) t.

All vectors are in the base's frame B.
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.frames import cross
from valve_drake.robot.kinematics import HandLoad

GRAVITY = 9.81
SOFT_TORQUE, SOFT_LEAD = 0.3, 0.25  # last shares of the limits, over which the rate falls to zero
BELOW_TRIP = 0.9  # of the force that ends a turn: what the hands drive with, at most


def gravity_wrench(R_BG: np.ndarray, hand: HandLoad) -> np.ndarray:
    """The load of the hand's own weight on the wrist sensor, in its frame -> [torque; force] (6,)."""
    R_SB = hand.X_SG[:, :3] @ R_BG.T
    force = R_SB @ np.array([0.0, 0.0, -GRAVITY * hand.mass])
    return np.concatenate([cross(hand.p_SCom, force), force])


def contact_wrench(raw: np.ndarray, bias: np.ndarray, R_BG: np.ndarray, hand: HandLoad) -> np.ndarray:
    """The external load on the hand at its grip point, in B: the reading `raw` without bias and weight.

    raw, bias: in the sensor's frame (6,). -> [torque; force] (6,).
    """
    load = raw - bias - gravity_wrench(R_BG, hand)
    torque = load[:3] - cross(hand.X_SG[:, 3], load[3:])
    R_BS = R_BG @ hand.X_SG[:, :3].T
    return np.concatenate([R_BS @ torque, R_BS @ load[3:]])


@dc.dataclass(frozen=True)
class Chain:
    """The closed chain at one instant, measured (all in B)."""

    p: np.ndarray  # grip points (2, 3), left first
    f: np.ndarray  # forces felt (2, 3) [N]
    m: np.ndarray  # moments felt at the grip points (2, 3) [N m]
    c: np.ndarray  # a point of the axis (3,)
    u: np.ndarray  # axis towards the robot
    b: np.ndarray  # from the left hand to the right one, across the axis
    t: np.ndarray  # each hand's tangent (2, 3)
    r: np.ndarray  # each hand's radius (2,) [m]

    h: np.ndarray  # h_1, h_2 of (1) (2, 6)
    couples: np.ndarray  # that each hand exerts on the valve about u (2,) [N m]
    torque: float  # their sum

    @property
    def share(self) -> float:
        """The left hand's part of the torque if both drive with the same force."""
        return float(self.r[0] / (self.r[0] + self.r[1]))


def make_chain(p: np.ndarray, wrenches: np.ndarray, u: np.ndarray, middle: np.ndarray | None = None) -> Chain:
    """p (2, 3), wrenches at the grip points (2, 6), axis u -> Chain.

    middle: of both hands from the axis, as multiples of b and of u x b (2,) [m]; None: it is on the axis.
    """
    c = (p[0] + p[1]) / 2
    line = p[1] - p[0]
    line = line - u * (u @ line)
    b = line / math.sqrt(line @ line)
    if middle is not None:
        c = c - middle[0] * b - middle[1] * cross(u, b)
    m, f = wrenches[:, :3], wrenches[:, 3:]
    h = wrenches.copy()
    t, r = np.empty((2, 3)), np.empty(2)
    for k in range(2):
        arm = p[k] - c
        h[k, :3] += cross(arm, f[k])
        arm = arm - u * (u @ arm)
        r[k] = math.sqrt(arm @ arm)
        t[k] = cross(u, arm / r[k])
    couples = -(h[:, :3] @ u)
    return Chain(p, f, m, c, u, b, t, r, h, couples, float(couples[0] + couples[1]))


def torque_limit(chain: Chain, config: HybridRotationConfig, share: float) -> float:
    """What the hands may put on the valve [N m]: `share` of the limit, which near the axis is that of their forces."""
    by_force = BELOW_TRIP * config.force_trip * float(chain.r[0] + chain.r[1])
    return share * min(config.torque_limit, by_force)


def twists(
    chain: Chain,
    turn_rate: float | None,
    config: HybridRotationConfig,
    extra: np.ndarray,
    limit: float | None = None,
) -> np.ndarray:
    """Eq. (2)-(5): the twists [w; v at c] of both hands -> (2, 6).

    turn_rate: about u [rad/s]; None lets the hands yield in that direction too.
    extra: added to the common twist (6,), e.g. a tug. limit: of the torque [N m]; None: the config's.
    """
    limit = config.torque_limit if limit is None else limit
    h1, h2 = chain.h
    D = np.array([config.angular_damping] * 3 + [config.damping] * 3)
    h_a, h_r = h1 + h2, (h2 - h1) / 2
    V_a = h_a / (2 * D)
    target = np.zeros(6)
    if turn_rate is not None:
        # Beyond the limit the target is constant, or the relative loop would build up force on a stuck valve.
        couple = min(max(chain.torque, -limit), limit)
        force = couple / (chain.r[0] + chain.r[1])
        V_a[3:] += force * (chain.t[0] + chain.t[1]) / (2 * D[3:])
        V_a[:3] += chain.u * (turn_rate - chain.u @ V_a[:3])
        target[:3] = force * (chain.r[0] - chain.r[1]) / 2 * chain.u
        target[3:] = config.squeeze * chain.b - force * (chain.t[1] - chain.t[0]) / 2
    V_a = V_a + extra
    V_r = (h_r - target) / (D / 2)
    return np.array([V_a - V_r / 2, V_a + V_r / 2])


def turn_rate(
    left: float,
    rate: float,
    torque: float,
    lead: float,
    config: HybridRotationConfig,
    dt: float,
    limit: float | None = None,
) -> float:
    """The rate for the next tick [rad/s]. All numbers count along the sense of the turn: positive = towards the goal.

    left: still to turn [rad]; rate: now; torque, lead: see the config's limits; limit: of the torque [N m], None: the
    config's. A negative result yields to a torque above its limit.
    """
    limit = config.torque_limit if limit is None else limit
    if torque > limit:
        return (limit - torque) / (2 * config.angular_damping)
    acceleration = config.rate / config.ramp
    brake = math.sqrt(2 * acceleration * max(left, 0.0))
    wanted = max(config.slow, min(config.rate, brake)) if left > 0 else 0.0
    by_torque = (limit - torque) / (SOFT_TORQUE * limit)
    by_lead = (config.lead_limit - lead) / (SOFT_LEAD * config.lead_limit)
    scaled = wanted * min(max(min(by_torque, by_lead), 0.0), 1.0)
    return min(scaled, max(rate, 0.0) + acceleration * dt)
