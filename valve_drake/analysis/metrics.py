"""From a log to numbers: what happened in a run. Reads nothing but the log."""

import dataclasses as dc
import os

import numpy as np

from valve_drake.messages import Mode
from valve_drake.recording.reader import LogReader


@dc.dataclass(frozen=True)
class ModeSpan:
    """One stay in a mode. `reason` is why it was entered."""

    mode: str
    activation: int
    start: float  # [s]
    end: float
    reason: str


@dc.dataclass
class Summary:
    """A run in numbers; None where the log does not say. Angles are turned since the start, positive opens."""

    outcome: str = ""  # done | failed | stopped | "" (did not finish)
    verdict: str = ""
    reason: str = ""
    spans: list[ModeSpan] = dc.field(default_factory=list)
    sim_time_s: float = 0.0
    command_rad: float | None = None
    angle_hands_rad: float | None = None
    angle_camera_rad: float | None = None
    angle_true_rad: float | None = None
    peak_hand_force_N: float = 0.0  # whole run
    turn_peak_hand_force_N: float = 0.0  # while turning
    turn_mean_hand_force_N: float = 0.0
    turn_mean_stem_force_N: float = 0.0
    turn_peak_stem_force_N: float = 0.0
    turn_share_left: float | None = None  # mean, where the couple exceeds 1 N m

    def mode_durations(self) -> dict[str, float]:
        """Seconds by mode, in the order of first entry."""
        out: dict[str, float] = {}
        for span in self.spans:
            out[span.mode] = out.get(span.mode, 0.0) + span.end - span.start
        return out


def summarize(log: str | os.PathLike | LogReader) -> Summary:
    """The numbers of one log."""
    reader = log if isinstance(log, LogReader) else LogReader(log)
    out = Summary(sim_time_s=reader.end)
    starts: list[tuple] = []
    if "/supervisor/mode" in reader.topics:
        for _, _, mode in reader.messages(["/supervisor/mode"]):
            if not starts or starts[-1][1] != mode.activation:
                starts.append((mode.mode, mode.activation, mode.since, mode.reason))
            out.verdict, out.reason = mode.verdict, mode.reason
            if mode.turn_angle:
                out.command_rad = mode.turn_angle
    ends = [s[2] for s in starts[1:]] + [reader.end]
    out.spans = [ModeSpan(s[0], s[1], s[2], end, s[3]) for s, end in zip(starts, ends)]
    if starts and starts[-1][0] in (Mode.DONE, Mode.FAILED, Mode.STOPPED):
        out.outcome = starts[-1][0]
    _angles(reader, out)
    _forces(reader, out)
    return out


def _angles(reader: LogReader, out: Summary) -> None:
    if "/kinematic_approach/status" in reader.topics:
        verifying = {span.activation for span in out.spans if span.mode == Mode.VERIFY}
        for _, _, status in reader.messages(["/kinematic_approach/status"]):
            if status.activation in verifying and status.state in ("succeeded", "failed") and status.progress == 1.0:
                out.angle_camera_rad = status.value
    if "/truth/valve_angle" in reader.topics:
        angles = [m.values[0] for _, _, m in reader.messages(["/truth/valve_angle"])]
        out.angle_true_rad = angles[-1] - angles[0]


def _forces(reader: LogReader, out: Summary) -> None:
    if "/hybrid_rotation/turn" not in reader.topics:
        return
    turning = [(s.start, s.end) for s in out.spans if s.mode == Mode.TURN]
    rows = []
    for _, time, turn in reader.messages(["/hybrid_rotation/turn"]):
        hands = [float(np.linalg.norm(turn.force_left)), float(np.linalg.norm(turn.force_right))]
        out.peak_hand_force_N = max(out.peak_hand_force_N, *hands)
        if any(start < time <= end for start, end in turning):
            out.angle_hands_rad = turn.angle
            rows.append((*hands, float(np.linalg.norm(turn.stem_force)), turn.torque, turn.share_left))
    if rows:
        table = np.array(rows)
        out.turn_peak_hand_force_N = float(table[:, :2].max())
        out.turn_mean_hand_force_N = float(table[:, :2].mean())
        out.turn_mean_stem_force_N = float(table[:, 2].mean())
        out.turn_peak_stem_force_N = float(table[:, 2].max())
        loaded = np.abs(table[:, 3]) > 1.0
        out.turn_share_left = float(table[loaded, 4].mean()) if loaded.any() else None
