"""Time series from a log, the input of the numbers (metrics.py) and the plots (curves.py).

Truth: the true pose of the marker in the left head camera goes through the true base and marker, the measured torso
and the *nominal* head: an error of the head's mount counts as an error of the estimate.
"""

import dataclasses as dc
import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from valve_drake.checks import ConfigError
from valve_drake.frames import compose, inverse, make, rot_z, rotation_vector, wrap
from valve_drake.messages import SIDES, Mode
from valve_drake.recording.reader import LogReader, Record
from valve_drake.recording.tables import Table
from valve_drake.robot.groups import GROUPS

if TYPE_CHECKING:
    from valve_drake.robot.robot import Robot

SCHEMAS = {  # of the topics that are read here
    "/supervisor/mode": "valve_drake.ModeState",
    "/joint_states": "foxglove.JointStates",
    "/joint_commands": "foxglove.JointStates",
    "/rectangle_estimator/estimate": "valve_drake.RectangleEstimate",
    "/stereo_positioning/position": "valve_drake.StereoPosition",
    "/hybrid_rotation/turn": "valve_drake.TurnState",
    "/image_servo/servo": "valve_drake.ServoState",
    "/health": "valve_drake.Health",
    "/command_selector/report": "valve_drake.SelectorReport",
    "/kinematic_approach/status": "valve_drake.Status",
    "/truth/base_pose": "valve_drake.Vector",
    "/truth/marker_pose": "valve_drake.Vector",
    "/truth/valve_angle": "valve_drake.Vector",
    "/truth/contacts": "valve_drake.Contacts",
}
# Bounds on memory: a topic with more messages is not decoded, a larger message [bytes] is left out, and of more stays
# in modes the first are shown. Raise them for runs of hours.
MOST, LARGEST, MOST_SPANS = 1_000_000, 1 << 20, 2000
HELD = 1.0  # by each of both pads [N]: more than a touch, a tenth of what a pad needs to carry its share by friction
T = TypeVar("T")
D = TypeVar("D")
HALF_TURN = make(rot_z(np.pi), np.zeros(3))


@dc.dataclass(frozen=True)
class ModeSpan:
    """One stay in a mode. `reason` is why it was entered, `attempt` counts the entries before it."""

    mode: str
    activation: int
    start: float  # [s]
    end: float
    reason: str
    attempt: int = 0

    @property
    def duration(self) -> float:
        return self.end - self.start


@dc.dataclass(frozen=True)
class Estimates:
    """Stage 2, one row for each image pair in which the marker was found.

    Errors are estimate minus truth: `angle_error` (N, 3) about the axes of V, modulo the half turn after which the
    rectangle looks the same; `position_error` (N, 3) along those of L. NaN without truth.
    """

    time: np.ndarray  # of capture (N,) [s]
    X_LV: np.ndarray  # (N, 3, 4)
    X_OV: np.ndarray
    covariance: np.ndarray  # (N, 6, 6) [rad^2, m^2]
    residual_px: np.ndarray
    cameras: np.ndarray
    angle_error: np.ndarray  # [rad]
    position_error: np.ndarray  # [m]
    looked: int  # image pairs that were searched, with or without success

    @property
    def distance(self) -> np.ndarray:
        return np.linalg.norm(self.X_LV[:, :, 3], axis=1)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations: about x, y, z of V [rad], along x, y, z of L [m] -> (N, 6)."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))

    @property
    def error(self) -> np.ndarray:
        """[angle; position], in the order of the covariance -> (N, 6)."""
        return np.hstack([self.angle_error, self.position_error])


@dc.dataclass(frozen=True)
class Joints:
    """Measured and commanded joints on the instants of the measured ones. The names are those of the log."""

    time: np.ndarray  # (N,) [s]
    names: tuple[str, ...]
    position: np.ndarray  # (N, J) [rad], [m]
    velocity: np.ndarray
    commanded: np.ndarray  # (N, J) positions; NaN where none is commanded

    def index(self, names: tuple[str, ...]) -> list[int]:
        """Columns of those of the joints that the log has."""
        return [self.names.index(name) for name in names if name in self.names]

    def error(self, names: tuple[str, ...]) -> np.ndarray:
        """Commanded minus measured, of those of the joints that the log has -> (N, n) [rad, m]."""
        at = self.index(names)
        return self.commanded[:, at] - self.position[:, at]


@dc.dataclass(frozen=True)
class Truth:
    """Ground truth of a simulation; row k is valid at time[k]."""

    time: np.ndarray  # (N,) [s]
    base: np.ndarray  # x, y [m], heading [rad] in W, continuous (N, 3)
    X_WV: np.ndarray  # (N, 3, 4)
    angle: np.ndarray  # turned since the start, counter-clockwise for the robot (N,) [rad]


@dc.dataclass(frozen=True)
class Touches:
    """What touched what, by a simulation's truth; row k holds from time[k] until the next one."""

    time: np.ndarray  # (N,) [s]
    pads: dict[str, np.ndarray]  # by side, both pads' pressing on the valve (N, 2) [N]
    slip: dict[str, np.ndarray]  # of the pads along the valve (N,) [m/s]
    internal: np.ndarray  # largest part of a hand's force that does not turn the valve (N,) [N]
    others: list[dict[str, float]]  # bodies that touched besides -> force [N]

    def held(self, side: str) -> np.ndarray:
        """When both pads of a hand pressed on the valve -> (N,) bool."""
        return np.asarray(self.pads[side].min(axis=1) > HELD)

    def at(self, time: np.ndarray) -> np.ndarray:
        """Which row holds at instants (M,) -> (M,); the first one before all rows."""
        return np.clip(np.searchsorted(self.time, time + 1e-6, side="right") - 1, 0, None)


class _Trace(functools.cached_property[T | None]):
    """A time series, read when it is first asked for; None where the log's values make none."""

    def __init__(self, make: Callable[["Traces"], T]):
        name = make.__name__
        super().__init__(lambda traces: traces.attempt(name, lambda: make(traces), None))


class Traces:
    """The time series of one log, each read when it is first asked for. None or empty: the log does not have it.

    missing: topics that could not be read and parts that could not be made of them, with the reason.
    """

    def __init__(self, reader: LogReader):
        self.reader = reader
        self.missing: dict[str, str] = {}

    def attempt(self, name: str, make: Callable[[], T], default: D) -> T | D:
        """The result of `make`; `default` and a line in `missing` if it raises an exception.

        A damaged file, or another program's, can hold messages of the right schema with senseless values: vectors of
        any length, NaN, text in place of numbers. One such topic must not cost the rest of the page.
        """
        try:
            with np.errstate(all="ignore"):  # a warning of numpy's would be a line of its own on the terminal
                return make()
        except Exception as error:
            self.missing[name] = f"holds values that cannot be used: {type(error).__name__}: {str(error)[:120]}"
            return default

    def inside(self, time: np.ndarray, *modes: str) -> np.ndarray:
        """Which instants `time` (N,) [s] lie in one of the modes -> (N,) bool."""
        found = np.zeros(len(time), bool)
        for span in self.spans:
            if span.mode in modes:
                found |= (time > span.start) & (time <= span.end)
        return found

    @functools.cached_property
    def modes(self) -> list[Any]:
        """The supervisor's messages that have a time."""
        return [mode for _, mode in self._messages("/supervisor/mode") if np.isfinite(mode.since)]

    @functools.cached_property
    def spans(self) -> list[ModeSpan]:
        """The stays in modes, in order."""
        starts: list[Any] = []
        for mode in self.modes:
            if not starts or starts[-1].activation != mode.activation:
                starts.append(mode)
        if len(starts) > MOST_SPANS:
            self.missing["modes"] = f"change {len(starts)} times: the first {MOST_SPANS} are shown"
            starts = starts[:MOST_SPANS]
        ends = [mode.since for mode in starts[1:]] + [self.reader.end]
        return [ModeSpan(m.mode, m.activation, m.since, end, m.reason, m.attempt) for m, end in zip(starts, ends)]

    @_Trace
    def joints(self) -> Joints | None:
        """Joints as measured and commanded; None without the measured ones."""
        states, commands = self._table("/joint_states"), self._table("/joint_commands")
        if states is None:
            return None
        time, measured = states
        names = tuple(dict.fromkeys(path.split(".")[1] for path in measured.columns if path.startswith("joints.")))
        position, velocity = (_columns(measured, names, part) for part in ("position", "velocity"))
        commanded = np.full(position.shape, np.nan)
        if commands is not None:
            when, asked = commands
            before = np.clip(np.searchsorted(when, time, side="right") - 1, 0, None)
            for k, name in enumerate(names):
                column = asked.columns.get(f"joints.{name}.position")
                if column is not None and not name.startswith("base"):  # the base is commanded by speed
                    commanded[:, k] = asked.values[before, column]
        return Joints(time, names, position, velocity, commanded)

    @_Trace
    def robot(self) -> "Robot | None":
        """The robot that the log holds; our own where it holds none."""
        from valve_drake.robot import description
        from valve_drake.robot.robot import Robot

        kept = self.reader.attachments.get("robot.yaml")
        if kept is None:
            return Robot.load(description.find(description.OURS))
        source = f"{self.reader.path}: robot.yaml"
        return Robot.of(description.parse(kept.data.decode(), source, self.reader.path), source)

    @functools.cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of the robot's joints by group; none if the log's robot cannot be read."""
        if self.robot is None:
            return {}
        return {group: self.robot.groups.names(group) for group in GROUPS}

    @_Trace
    def truth(self) -> Truth | None:
        """Where base and marker truly were, how far the valve was turned."""
        topics = ("/truth/base_pose", "/truth/marker_pose", "/truth/valve_angle")
        tables = [table for topic in topics if (table := self._table(topic)) is not None]
        rows = [dict(zip(time.tolist(), _vector(numbers))) for time, numbers in tables]
        when = sorted(set.intersection(*map(set, rows))) if len(rows) == len(topics) else []
        if not when:
            return None
        base, marker, angle = (np.array([found[t] for t in when]) for found in rows)
        base = np.column_stack([base[:, :2], np.unwrap(base[:, 2])])
        return Truth(np.array(when), base, marker.reshape(-1, 3, 4), angle[:, 0] - angle[0, 0])

    @_Trace
    def touches(self) -> Touches | None:
        """What touched what."""
        rows = self._messages("/truth/contacts")
        if not rows:
            return None
        for _, row in rows:
            if len(row.touching) != len(row.forces):
                raise ValueError("/truth/contacts: a force for each pair")
        return Touches(
            np.array([time for time, _ in rows]),
            {side: np.array([getattr(m, f"{side}_pads") for _, m in rows]) for side in SIDES},
            {side: np.array([getattr(m, f"{side}_slip") for _, m in rows]) for side in SIDES},
            np.array([m.internal_force for _, m in rows]),
            [dict(zip(m.touching, m.forces.tolist())) for _, m in rows],
        )

    @_Trace
    def estimates(self) -> Estimates | None:
        """Stage 2, with its errors where the truth is known."""
        every = [m for _, m in self._messages("/rectangle_estimator/estimate") if m.sequence >= 0]
        if not every:
            return None
        rows = [m for m in every if m.found]
        time = np.array([m.time for m in rows])
        X_LV = np.array([m.X_LV for m in rows]).reshape(-1, 3, 4)
        errors = self._errors(time, X_LV)
        return Estimates(
            time,
            X_LV,
            np.array([compose(m.X_OL, m.X_LV) for m in rows]).reshape(-1, 3, 4),
            np.array([m.covariance for m in rows]).reshape(-1, 6, 6),
            np.array([m.residual_px for m in rows]),
            np.array([m.cameras for m in rows]),
            errors[:, :3],
            errors[:, 3:],
            len(every),
        )

    def true_X_LV(self, time: np.ndarray) -> np.ndarray | None:
        """The marker in the (nominal) left head camera at these instants -> (N, 3, 4); None without truth."""
        truth, joints = self.truth, self.joints
        names = self.groups.get("torso", ())
        if truth is None or joints is None or self.robot is None or len(joints.index(names)) < len(names):
            return None
        base = interpolate(time, truth.time, truth.base)
        marker = interpolate(time, truth.time, truth.X_WV)
        torso = interpolate(time, joints.time, joints.position[:, joints.index(names)])
        heads = (self.robot.head_pose(b, q) for b, q in zip(base, torso))
        return np.array([compose(inverse(X_WL), X_WV) for X_WL, X_WV in zip(heads, marker)]).reshape(-1, 3, 4)

    def _errors(self, time: np.ndarray, X_LV: np.ndarray) -> np.ndarray:
        true = self.true_X_LV(time)
        if true is None:
            return np.full((len(time), 6), np.nan)
        errors = []
        for X, Y in zip(X_LV, true):
            R = Y[:, :3].T @ X[:, :3]
            angles = min((rotation_vector(R), rotation_vector(R @ HALF_TURN[:, :3])), key=np.linalg.norm)
            errors.append(np.concatenate([angles, X[:, 3] - Y[:, 3]]))
        return np.array(errors).reshape(-1, 6)

    @_Trace
    def stereo(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Stage 1: times of capture and distances where the marker was found."""
        rows = [m for _, m in self._messages("/stereo_positioning/position") if m.found]
        if not rows:
            return None
        return np.array([m.time for m in rows]), np.array([np.linalg.norm(m.p_LV) for m in rows])

    @_Trace
    def turn(self) -> dict[str, np.ndarray] | None:
        """Stage 5 as recorded; forces and moments as magnitudes."""
        names = ("stage", "angle", "angle_reference", "torque", "share_left", "squeeze")
        vectors = ("force_left", "force_right", "moment_left", "moment_right", "stem_force")
        rows = [(t, m) for t, m in self._messages("/hybrid_rotation/turn") if m.stage]
        if not rows:
            return None
        out = {name: np.array([getattr(m, name) for _, m in rows]) for name in names}
        out |= {name: np.linalg.norm([getattr(m, name) for _, m in rows], axis=1) for name in vectors}
        return out | {"time": np.array([t for t, _ in rows])}

    @_Trace
    def camera_angle(self) -> tuple[np.ndarray, np.ndarray] | None:
        """How far the valve has turned since it was measured, by the head cameras: times of capture, angles.

        A rectangle looks the same after half a turn; the hands' angle decides between the two.
        """
        found = self.estimates
        if found is None or len(found.time) == 0:
            return None
        R = np.einsum("ji,njk->nik", found.X_OV[0, :, :3], found.X_OV[:, :, :3])
        raw = -np.arctan2(R[:, 1, 0], R[:, 0, 0])
        measured = self.inside(found.time, Mode.MEASURE)
        zero = raw[measured][-1] if measured.any() else 0.0
        if self.turn is None:
            angle = np.unwrap(raw - zero, period=np.pi)
        else:
            hands = np.interp(found.time, self.turn["time"], self.turn["angle"], left=0.0)
            angle = np.array([h + wrap(a - zero - h, np.pi) for a, h in zip(raw, hands)])
        return found.time, angle - (np.mean(angle[measured]) if measured.any() else 0.0)

    @_Trace
    def servo(self) -> dict[str, np.ndarray] | None:
        """Stage 4 while it is at work: distances from the reference [m] and the hands' measured speeds [m/s]."""
        rows = self._messages("/image_servo/servo")
        working = self.inside(np.array([t for t, _ in rows]), Mode.SERVO)
        rows = [row for row, at_work in zip(rows, working) if at_work]
        if not rows:
            return None
        out = {"time": np.array([t for t, _ in rows])}
        for side in SIDES:
            out[f"{side}_error"] = np.array([np.linalg.norm(getattr(m, f"{side}_error")) for _, m in rows])
            robot = self.robot
            arm = self.groups.get(f"{side}_arm", ())
            if self.joints is not None and robot is not None and len(self.joints.index(arm)) == len(arm):
                at = self.joints.index(arm)
                q = interpolate(out["time"], self.joints.time, self.joints.position[:, at])
                v = interpolate(out["time"], self.joints.time, self.joints.velocity[:, at])
                J = (robot.jacobian(side, row)[3:] for row in q)
                out[f"{side}_speed"] = np.array([np.linalg.norm(j @ row) for j, row in zip(J, v)])
        return out

    @functools.cached_property
    def reports(self) -> list[tuple[float, Any]]:
        """The station's health messages, as protobuf's, with their times."""
        return self._messages("/health", self.reader.parse)

    @_Trace
    def health(self) -> tuple[np.ndarray, tuple[str, ...], np.ndarray] | None:
        """Times, devices, ages (N, D) [s]."""
        rows = [(t, m) for t, m in self.reports if m.devices]
        if not rows:
            return None
        devices = rows[-1][1].devices
        rows = [(t, m) for t, m in rows if m.devices == devices]
        return np.array([t for t, _ in rows]), tuple(devices), np.array([list(m.ages) for _, m in rows])

    @functools.cached_property
    def faults(self) -> list[tuple[float, str]]:
        """When which fault was first reported."""
        out: list[tuple[float, str]] = []
        before: set[str] = set()
        for time, health in self.reports:
            now = set(health.faults) | ({"emergency stop"} if health.estop else set())
            out += [(time, fault) for fault in sorted(now - before)]
            before = now
        return out

    @_Trace
    def selector(self) -> dict[str, dict[str, int]] | None:
        """command_selector's ticks by what it did: "limited", "refused", "tripped" -> name -> ticks."""
        rows = self._messages("/command_selector/report", self.reader.parse)
        if not rows:
            return None
        out: dict[str, dict[str, int]] = {"limited": {}, "refused": {}, "tripped": {}}
        for _, report in rows:
            for did, count in out.items():
                for name in getattr(report, did):
                    count[name] = count.get(name, 0) + 1
        return out

    @_Trace
    def verify_angle(self) -> float | None:
        """The valve's angle by the cameras after the hands have let go [rad]; None if it was not measured."""
        verifying = {span.activation for span in self.spans if span.mode == Mode.VERIFY}
        angle = None
        for _, status in self._messages("/kinematic_approach/status"):
            # A log of a program that had no `seen` says so by its progress.
            if status.activation in verifying and (status.seen or status.progress == 1.0):
                angle = status.value
        return angle

    def _messages(self, topic: str, decode: Callable[[Record], Any] | None = None) -> list[tuple[float, Any]]:
        """(time, message) of a topic; none if it is not there or from another program."""
        decode = decode or self.reader.decode
        try:
            return [(record.time, decode(record)) for record in self._take(topic)]
        except ConfigError as error:
            self.missing[topic] = str(error)
            return []

    def _table(self, topic: str) -> tuple[np.ndarray, Table] | None:
        """The times (n,) [s] and the numbers of a topic's messages; None if there are none."""
        records = self._take(topic)
        try:
            return (np.array([r.time for r in records]), self.reader.table(records)) if records else None
        except ConfigError as error:
            self.missing[topic] = str(error)
            return None

    def _take(self, topic: str) -> list[Record]:
        """A topic's records, which are then forgotten; none if it is not there or from another program."""
        found = self.reader.topics.get(topic)
        if found is None or found.count == 0:
            self.missing[topic] = "not in this log"
        elif found.schema != SCHEMAS[topic]:
            self.missing[topic] = f"holds {found.schema}, not {SCHEMAS[topic]}"
        elif found.count > MOST:
            self.missing[topic] = f"holds {found.count} messages, more than the {MOST} that can be shown"
        else:
            return self._records.pop(topic, None) or list(self._read([topic]))
        return []

    @functools.cached_property
    def _records(self) -> dict[str, list[Record]]:
        """The records of all topics that are read here, in one pass over the log if there are not too many."""
        topics = [topic for topic, found in self.reader.topics.items() if topic in SCHEMAS and found.count <= MOST]
        records: dict[str, list[Record]] = {}
        if sum(self.reader.topics[topic].count for topic in topics) <= MOST:
            for record in self._read(topics):
                records.setdefault(record.topic, []).append(record)
        return records

    def _read(self, topics: list[str]) -> Iterator[Record]:
        return (record for record in self.reader.records(topics) if len(record.data) <= LARGEST)


def _columns(table: Table, names: tuple[str, ...], quantity: str) -> np.ndarray:
    """One quantity of joints (n, J); 0 where a joint has none."""
    values = np.zeros((len(table.values), len(names)))
    for k, name in enumerate(names):
        if (column := table.columns.get(f"joints.{name}.{quantity}")) is not None:
            values[:, k] = table.values[:, column]
    return values


def _vector(table: Table) -> np.ndarray:
    """The values (n, m) of Vector messages."""
    return table.values[:, [k for path, k in table.columns.items() if path.startswith("values.")]]


def interpolate(time: np.ndarray, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Rows of `values` (N, ...), known at `at`, at other instants, linearly -> (len(time), ...)."""
    k = np.clip(np.searchsorted(at, time) - 1, 0, max(len(at) - 2, 0))
    after = np.minimum(k + 1, len(at) - 1)
    step = at[after] - at[k]
    share = np.clip((time - at[k]) / np.where(step > 0, step, 1.0), 0.0, 1.0)
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return values[k] * (1 - share) + values[after] * share
