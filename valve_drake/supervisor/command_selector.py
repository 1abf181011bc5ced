"""The only writer to the robot: one command per tick, taken from the block that owns each group in this mode.

Each mode's row says who commands which group (task/modes.py). A group that nobody commands holds: the base brakes to
zero twist, joints brake and stay. So does a group whose command is missing, older than `max_age`, not finite or
otherwise wrong, every group while the robot's state or the mode is that old, and a group whose device has reported
nothing for that long (both arms if one of them is silent, or the other would pull at what both hold). An emergency stop
holds everything but the grippers, so that a hand can always be opened. In failed and stopped the hands open, whatever
happened before.

Position, speed and acceleration are bounded by motion.follow: within the bounds a command passes unchanged.
The first command of each joint is its measured position.
"""

import dataclasses as dc
import functools
import math
from collections.abc import Mapping

import numpy as np

from valve_drake.checks import ConfigError
from valve_drake.config import Config, number
from valve_drake.memory import changed
from valve_drake.messages import LEFT, RIGHT, SIDES, Command, Health, ModeState, RobotState, SelectorReport
from valve_drake.motion import follow
from valve_drake.robot.drive import DIFFERENTIAL, Drive
from valve_drake.robot.kinematics import Joints
from valve_drake.task.modes import HOLD, OPEN, TABLE

GRIPPERS = ("left_gripper", "right_gripper")
ARMS = ("left_arm", "right_arm")
JOINTS = ("torso", *ARMS, *GRIPPERS)  # commanded by position, in this order in every vector of this file
GROUPS = ("base", *JOINTS)
FOLLOWERS = ("base", "torso", *ARMS)  # that are where they are commanded; fingers stop at what they hold

SOURCE: dict[str, dict[str, str]] = {
    mode: {group: row.source(group) for group in GROUPS} for mode, row in TABLE.items()
}


@dc.dataclass
class CommandSelectorConfig(Config):
    """Scenario key `command_selector`. Positions and speeds of the joints, speeds and accelerations of the base are
    bounded by the robot (robot.yaml).

    Upper bounds of times and forces are those of docs/hardware.md: a scenario can be stricter than what is promised
    there, and never laxer.
    """

    KEY = "command_selector"
    acceleration_torso: float = number(6.0, 0.5, 20.0, "of lift, waist, tilt and pan [m/s^2, rad/s^2]")
    acceleration_arm: float = number(8.0, 0.5, 20.0, "[rad/s^2]")
    gripper_high: float = number(0.09, 0.03, 0.09, "opening; the lower limit is 0 [m]")
    gripper_speed: float = number(0.1, 0.01, 0.2, "[m/s]")
    gripper_acceleration: float = number(2.0, 0.1, 10.0, "[m/s^2]")
    gripper_force: float = number(80.0, 5.0, 100.0, "of the finger actuator [N]")
    max_age: float = number(
        0.1, 0.02, 0.1, "of a command, a device's report, the robot's state and the mode, before the robot holds [s]"
    )
    trip_force: float = number(90.0, 10.0, 90.0, "raw force at a wrist sensor, gravity included, that trips [N]")
    trip_ticks: int = number(3, 1, 3, "ticks in a row above it")
    follow_error: float = number(0.15, 0.02, 0.15, "of arms and torso behind their command [rad]")
    follow_speed: float = number(0.25, 0.02, 0.25, "of the base off its command [m/s, rad/s]")
    follow_time: float = number(0.25, 0.03, 0.25, "for so long: the group does not follow [s]")


@dc.dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of all n joints in the order of JOINTS, and where each group stands among them."""

    parts: Mapping[str, slice]  # by group
    low: np.ndarray  # (n,) [rad or m]
    high: np.ndarray  # (n,)
    speed: np.ndarray  # (n,) [1/s]
    acceleration: np.ndarray  # (n,) [1/s^2]
    drive: Drive

    @functools.cached_property
    def rows(self) -> list[tuple[float, float, float, float]]:
        """Of each joint: low, high, speed, acceleration."""
        limits = (self.low, self.high, self.speed, self.acceleration)
        return list(zip(*(limit.tolist() for limit in limits)))


def bounds(
    config: CommandSelectorConfig, torso: Joints, arms: Mapping[str, Joints], drive: Drive = DIFFERENTIAL
) -> Bounds:
    """torso, arms, drive: of the robot, the arms by side."""
    c = config
    sizes = {"torso": len(torso)} | {f"{side}_arm": len(arms[side]) for side in SIDES} | dict.fromkeys(GRIPPERS, 1)
    ends = np.cumsum([sizes[group] for group in JOINTS]).tolist()
    parts = {group: slice(end - sizes[group], end) for group, end in zip(JOINTS, ends)}
    joints = (torso, *(arms[side] for side in SIDES))
    accelerations = (c.acceleration_torso, c.acceleration_arm, c.acceleration_arm)
    return Bounds(
        parts=parts,
        low=np.concatenate([*(group.low for group in joints), np.zeros(2)]),
        high=np.concatenate([*(group.high for group in joints), np.full(2, c.gripper_high)]),
        speed=np.concatenate([*(group.speed for group in joints), np.full(2, c.gripper_speed)]),
        acceleration=np.concatenate(
            [
                *(np.full(len(group), most) for group, most in zip(joints, accelerations)),
                np.full(2, c.gripper_acceleration),
            ]
        ),
        drive=drive,
    )


@dc.dataclass(frozen=True, eq=False)
class Memory:
    """What was commanded last."""

    bounds: Bounds
    position: np.ndarray  # (n,) command [rad or m]
    velocity: np.ndarray  # (n,) of the command [1/s]
    target: np.ndarray  # (n,) what the sources asked for, within the position limits
    force: np.ndarray  # (2,) force limits of the grippers [N]
    twist: np.ndarray  # of the base, as many speeds as it has
    started: bool = False  # the measured position was taken over
    activation: int = -1
    over: tuple[int, int] = (0, 0)  # ticks in a row with a force above the trip
    tripped: tuple[str, ...] = ()
    behind: tuple[int, ...] = (0,) * len(FOLLOWERS)  # ticks in a row behind the command


def ports(bounds: Bounds) -> dict[str, int]:
    """The station's command ports: name -> size."""
    out = {"base.twist_command": len(bounds.drive.names)}
    out |= {f"{group}.position_command": part.stop - part.start for group, part in bounds.parts.items()}
    return out | {f"{group}.force_limit": 1 for group in GRIPPERS}


def start(
    config: CommandSelectorConfig,
    initial: Mapping[str, np.ndarray],
    torso: Joints,
    arms: Mapping[str, Joints],
    drive: Drive = DIFFERENTIAL,
) -> Memory:
    """Memory before the first step, holding `initial` (port name -> vector). Raises ConfigError if one does not fit."""
    limits = bounds(config, torso, arms, drive)
    for port, size in ports(limits).items():
        if port not in initial or np.shape(initial[port]) != (size,) or not np.all(np.isfinite(initial[port])):
            raise ConfigError(f"command_selector: initial {port} must be {size} finite numbers")
    position = np.concatenate([np.asarray(initial[f"{group}.position_command"], float) for group in JOINTS])
    force = np.concatenate([np.asarray(initial[f"{group}.force_limit"], float) for group in GRIPPERS])
    twist = np.array(initial["base.twist_command"], float)
    return Memory(limits, position, np.zeros(len(position)), position, force, twist)


def outputs(memory: Memory) -> dict[str, np.ndarray]:
    """The station's command ports: name -> vector."""
    out = {"base.twist_command": memory.twist}
    for group, part in memory.bounds.parts.items():
        out[f"{group}.position_command"] = memory.position[part]
    for k, group in enumerate(GRIPPERS):
        out[f"{group}.force_limit"] = memory.force[k : k + 1]
    return out


def changes(memory: Memory, before: Memory) -> dict[str, np.ndarray]:
    """Those of `outputs` that are not as they were: most joints stand still most of the time."""
    was = outputs(before)
    return {port: value for port, value in outputs(memory).items() if value.tobytes() != was[port].tobytes()}


def step(
    config: CommandSelectorConfig,
    memory: Memory,
    time: float,
    dt: float,
    mode: ModeState,
    robot_state: RobotState,
    health: Health,
    commands: Mapping[str, Command],
) -> tuple[Memory, SelectorReport]:
    """One tick of length dt -> memory (outputs(memory) are the commands), report.

    commands: block name -> its Command; a block that is missing counts as silent.
    """
    m = memory
    if not m.started:
        # An empty history marks a state that nobody has measured yet.
        if len(robot_state.history) == 0 or not np.all(np.isfinite(measured(robot_state))):
            return m, SelectorReport(time=time, source=(HOLD,) * len(GROUPS), refused=("robot_state: none yet",))
        position = measured(robot_state)
        m = changed(m, position=position, target=position, started=True)

    source, refused = _sources(config, time, mode, robot_state, health)
    wanted: dict[str, np.ndarray] = {}
    for group, block in source.items():
        if block == HOLD:
            continue
        if block == OPEN:
            k = GRIPPERS.index(group)
            wanted[group] = np.array([config.gripper_high, m.force[k]])
            continue
        value, problem = _asked(config, time, group, commands.get(block), _size(m, group))
        if problem:
            refused.append(f"{group}: {problem}")
        if value is None:
            source[group] = HOLD
        else:
            wanted[group] = value

    twist, base_limited = _base(m, wanted.get("base"), dt)
    position, velocity, target, joints_limited = _joints(m, wanted, dt)
    force, force_limited = _force(config, m, wanted)
    over, tripped = _trip(config, m, mode, robot_state)
    behind, astray = _follow(config, m, robot_state, dt)
    memory = changed(
        m,
        position=position,
        velocity=velocity,
        target=target,
        force=force,
        twist=twist,
        activation=mode.activation,
        over=over,
        tripped=tripped,
        behind=behind,
    )
    report = SelectorReport(
        time=time,
        source=tuple(source[group] for group in GROUPS),
        limited=(*base_limited, *joints_limited, *force_limited),
        refused=tuple(refused),
        tripped=tripped,
        astray=astray,
    )
    return memory, report


def measured(state: RobotState) -> np.ndarray:
    """Measured joint positions in the order of JOINTS -> (n,)."""
    return np.concatenate([state.torso, state.left_arm, state.right_arm, [state.left_gripper, state.right_gripper]])


def _sources(
    config: CommandSelectorConfig, time: float, mode: ModeState, robot_state: RobotState, health: Health
) -> tuple[dict[str, str], list[str]]:
    """Who commands each group now, and what keeps the robot still."""
    source = dict(SOURCE[mode.mode])
    late = [
        f"{name}: {time - stamp:.2f} s old"
        for name, stamp in (("robot_state", robot_state.time), ("mode", mode.time))
        if not time - stamp <= config.max_age
    ]
    if late:
        return dict.fromkeys(GROUPS, HOLD), late
    if health.estop:
        return {g: s if g in GRIPPERS else HOLD for g, s in source.items()}, ["emergency stop"]
    silent = {device: age for device, age in zip(health.devices, health.ages.tolist()) if not age <= config.max_age}
    if not silent:
        return source, []
    problems = []
    for group in source:
        for device in ARMS if group in ARMS else (group,):
            if device in silent:
                source[group] = HOLD
                problems.append(f"{group}: {device} silent for {silent[device]:.2f} s")
    return source, problems


def _asked(
    config: CommandSelectorConfig, time: float, group: str, command: Command | None, count: int
) -> tuple[np.ndarray | None, str]:
    """What a block asks of a group, or None with the reason if it cannot be used ("" if it does not ask).

    count: of the group's values.
    """
    if command is None:
        return None, "no command"
    if not abs(time - command.time) <= config.max_age:
        return None, f"command {time - command.time:.2f} s old"
    value = getattr(command, "base_twist" if group == "base" else group)
    if value is None:
        return None, ""
    if len(value) != count:
        return None, f"a twist of {len(value)} speeds" if group == "base" else f"{len(value)} values, not {count}"
    if not all(map(math.isfinite, value.tolist())):  # of so few numbers a fifth of numpy's time
        return None, "not finite"
    if group in GRIPPERS and value[1] < 0:
        return None, f"force limit {value[1]:.1f} N"
    return value, ""


def _size(m: Memory, group: str) -> int:
    """How many values a command of this group has."""
    if group in GRIPPERS:
        return 2  # opening and force limit
    part = m.bounds.parts.get(group)
    return len(m.twist) if part is None else part.stop - part.start


def _base(m: Memory, wanted: np.ndarray | None, dt: float) -> tuple[np.ndarray, list[str]]:
    now = m.twist.tolist()
    goal = [0.0] * len(now) if wanted is None else wanted.tolist()
    twist, limits = [], set()
    limited = zip(goal, now, m.bounds.drive.speed.tolist(), m.bounds.drive.acceleration.tolist())
    for asked, now, speed, acceleration in limited:
        allowed = min(max(asked, -speed), speed)
        step = acceleration * dt
        reached = now + min(max(allowed - now, -step), step)
        if allowed != asked:
            limits.add("velocity")
        if abs(reached - allowed) > 1e-12:
            limits.add("acceleration")
        else:
            reached = allowed
        twist.append(reached)
    return np.array(twist), [f"base.{limit}" for limit in ("velocity", "acceleration") if limit in limits]


def _joints(
    m: Memory, wanted: dict[str, np.ndarray], dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Moves every joint one step -> position, velocity and target (n,), what was limited."""
    b = m.bounds
    asked: list[float | None] = [None] * len(m.position)  # None: held
    for group, part in b.parts.items():
        if group in wanted:
            asked[part] = wanted[group].tolist()[:1] if group in GRIPPERS else wanted[group].tolist()
    now, rates, lasts = m.position.tolist(), m.velocity.tolist(), m.target.tolist()
    limits = b.rows
    position: list[float] = []
    target: list[float] = []
    for group, part in b.parts.items():
        if group in wanted:
            for want, (low, high, speed, acceleration), last, at, rate in zip(
                asked[part], limits[part], lasts[part], now[part], rates[part]
            ):
                goal = min(max(at if want is None else want, low), high)
                target.append(goal)
                position.append(follow(goal, (goal - last) / dt, at, rate, speed, acceleration, dt))
            continue
        target += [min(max(at, low), high) for at, (low, high, _, _) in zip(now[part], limits[part])]
        if any(rates[part]):
            position += [
                _braked(at, rate, low, high, acceleration, dt)
                for at, rate, (low, high, _, acceleration) in zip(now[part], rates[part], limits[part])
            ]
        else:  # it stands, as most groups do most of the time
            position += now[part]
    velocity = [(new - at) / dt for new, at in zip(position, now)]
    limited = _limited(wanted, asked, target, position, velocity, b)
    return np.array(position), np.array(velocity), np.array(target), limited


def _braked(at: float, rate: float, low: float, high: float, acceleration: float, dt: float) -> float:
    """A held joint has no target: it brakes, and stays."""
    if rate == 0:
        return at
    speed = math.copysign(max(abs(rate) - acceleration * dt, 0.0), rate)
    # A joint that was measured outside its limits stays where it is until a command brings it back.
    return min(max(at + speed * dt, min(low, at)), max(high, at))


def _limited(
    wanted: dict[str, np.ndarray],
    asked: list[float | None],
    target: list[float],
    position: list[float],
    velocity: list[float],
    b: Bounds,
) -> list[str]:
    """What of the commanded groups is not as it was asked."""
    limited: list[str] = []
    for group, part in b.parts.items():
        if group not in wanted or asked[part] == target[part] == position[part]:  # nearly always
            continue
        if asked[part] != target[part]:
            limited.append(f"{group}.position")
        short = [
            "velocity" if abs(rate) >= speed * (1 - 1e-9) else "acceleration"
            for goal, new, rate, speed in zip(target[part], position[part], velocity[part], b.speed[part].tolist())
            if new != goal
        ]
        limited += [f"{group}.{kind}" for kind in ("velocity", "acceleration") if kind in short]
    return limited


def _force(config: CommandSelectorConfig, m: Memory, wanted: dict[str, np.ndarray]) -> tuple[np.ndarray, list[str]]:
    asked = [float(wanted[g][1] if g in wanted else m.force[k]) for k, g in enumerate(GRIPPERS)]
    force = [min(limit, config.gripper_force) for limit in asked]
    return np.array(force), [f"{g}.force" for g, want, limit in zip(GRIPPERS, asked, force) if limit != want]


def _trip(
    config: CommandSelectorConfig, m: Memory, mode: ModeState, state: RobotState
) -> tuple[tuple[int, int], tuple[str, ...]]:
    """Counts ticks above the trip for each hand; a trip is kept until the mode changes, so that nobody misses it."""
    kept = m.tripped if mode.activation == m.activation else ()
    over = []
    for count, wrench in zip(m.over, (state.left_wrench, state.right_wrench)):
        safe = math.hypot(*wrench[3:].tolist()) <= config.trip_force  # False for NaN
        over.append(0 if safe else count + 1)
    now = [side for side, count in zip(SIDES, over) if count >= config.trip_ticks]
    return (over[0], over[1]), tuple(side for side in (LEFT, RIGHT) if side in kept or side in now)


def _follow(
    config: CommandSelectorConfig, m: Memory, state: RobotState, dt: float
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Counts ticks for which each group is behind its last command; written so that NaN is behind."""
    commanded = m.position.tolist()
    near = {"base": _close(state.twist.tolist(), m.twist.tolist(), config.follow_speed)}
    for group, found in zip(("torso", *ARMS), (state.torso, state.left_arm, state.right_arm)):
        near[group] = _close(found.tolist(), commanded[m.bounds.parts[group]], config.follow_error)
    behind = tuple(0 if near[group] else count + 1 for group, count in zip(FOLLOWERS, m.behind))
    return behind, tuple(group for group, count in zip(FOLLOWERS, behind) if count * dt > config.follow_time)


def _close(found: list[float], wanted: list[float], error: float) -> bool:
    """Whether all are within `error`; plain numbers, of which numpy takes five times as long to compare so few."""
    return all(abs(a - b) <= error for a, b in zip(found, wanted))
