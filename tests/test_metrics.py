"""Metrics of a made-up run, against its known truth."""

import dataclasses as dc

import numpy as np
import pytest
import review_samples as sample
from robot_facts import GROUPS

from valve_drake.analysis import integrity
from valve_drake.analysis.metrics import summarize
from valve_drake.analysis.traces import Traces, interpolate
from valve_drake.messages import Mode, ModeState
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recorder_system import ONCE
from valve_drake.recording.schemas import Vector
from valve_drake.recording.signals import signals
from valve_drake.recording.writer import LogWriter


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return sample.write_run(tmp_path_factory.mktemp("log") / "run.mcap")


@pytest.fixture(scope="module")
def traces(path):
    return Traces(LogReader(path))


@pytest.fixture(scope="module")
def summary(traces):
    return summarize(traces)


def test_outcome_verdict_reason_and_command(summary):
    assert (summary.outcome, summary.verdict) == ("done", "turned")
    assert summary.reason == "camera sees 57.30 deg"
    assert summary.command_rad == sample.ANGLE


def test_modes_with_their_durations_attempts_and_reasons(summary):
    assert [(s.start, s.mode, s.attempt, s.reason) for s in summary.spans] == list(sample.MODES)
    assert summary.spans[0].duration == 1.0 and summary.spans[-1].end == pytest.approx(6.0, abs=0.01)
    assert summary.retries == 1
    assert summary.mode_durations()["servo"] == 1.0


def test_a_log_of_before_the_field_seen_shows_the_cameras_angle_too(tmp_path):
    def older(topic, message, time):
        if topic == "/kinematic_approach/status" and message.seen:
            return dc.replace(message, seen=False, progress=1.0)
        return message

    sample.write_run(tmp_path / "run.mcap", change=older)
    assert summarize(tmp_path / "run.mcap").angle_camera_rad == sample.ANGLE + 0.001


def test_angles_by_camera_hands_and_truth(summary):
    assert summary.angle_hands_rad == pytest.approx(sample.ANGLE, abs=0.01)
    assert summary.angle_camera_rad == sample.ANGLE + 0.001
    assert summary.angle_true_rad == pytest.approx(sample.ANGLE, abs=1e-12)


def test_truth_counts_from_the_start_and_stands_at_its_own_time(traces):
    assert traces.truth.time[0] == 0.0
    assert traces.truth.angle[0] == 0.0
    assert np.allclose(traces.truth.base[0], sample.base(traces.truth.time[0]), atol=1e-12)


def test_estimates_against_truth_even_while_base_and_neck_turn(traces):
    found = traces.estimates
    assert np.allclose(found.position_error, sample.ERROR_P, atol=1e-6)
    assert np.allclose(found.angle_error, sample.ERROR_W, atol=1e-6)
    assert np.allclose(found.sigma, sample.SIGMA)


def test_an_estimate_turned_by_half_a_turn_is_the_same_rectangle(path, tmp_path):
    turn = np.diag([-1.0, -1.0, 1.0])

    def change(topic, message, t):
        if topic != "/rectangle_estimator/estimate":
            return message
        return dc.replace(message, X_LV=np.column_stack([message.X_LV[:, :3] @ turn, message.X_LV[:, 3]]))

    found = Traces(LogReader(sample.write_run(tmp_path / "half.mcap", change=change))).estimates
    assert np.allclose(np.linalg.norm(found.angle_error, axis=1), 0.005, atol=1e-5)


def test_estimate_numbers_by_mode(summary):
    numbers = summary.estimates["measure"]
    assert numbers.found == 4
    assert numbers.position_rms_m == pytest.approx(0.003, abs=1e-6)
    assert numbers.angle_rms_rad == pytest.approx(0.005, abs=1e-5)
    assert numbers.sigma_position_m == pytest.approx(np.linalg.norm(sample.SIGMA[3:]))
    assert numbers.spread == pytest.approx(0.0, abs=1e-3)  # a constant offset is no scatter
    assert "turn" not in summary.estimates  # nothing was looked at


def test_the_spread_of_an_honest_covariance_is_one(tmp_path):
    rng = np.random.default_rng(1)

    def change(topic, message, t):
        if topic != "/rectangle_estimator/estimate":
            return message
        X = np.array(message.X_LV)
        X[:, 3] += rng.normal(size=3) * sample.SIGMA[3:]
        X[:, :3] = X[:, :3] @ sample.rotation(rng.normal(size=3) * sample.SIGMA[:3])
        return dc.replace(message, X_LV=X)

    numbers = summarize(sample.write_run(tmp_path / "noisy.mcap", change=change)).estimates
    spreads = [numbers[mode].spread for mode in ("search", "measure", "servo", "verify")]
    assert np.sqrt(np.mean(np.square(spreads))) == pytest.approx(1.0, abs=0.15)


def test_the_cameras_angle_follows_the_valve(traces):
    time, angle = traces.camera_angle
    assert np.allclose(angle[time < 3.5], 0.0, atol=1e-6)
    assert np.allclose(angle[time > 4.5], sample.ANGLE, atol=1e-4)


def test_forces_and_couple_while_turning(summary):
    assert summary.turn_peak_hand_force_N == sample.FORCE == summary.peak_hand_force_N
    assert summary.turn_mean_hand_force_N == pytest.approx(0.75 * sample.FORCE, rel=0.02)
    assert summary.turn_mean_stem_force_N == pytest.approx(sample.STEM)
    assert summary.turn_mean_squeeze_N == pytest.approx(-1.0)
    assert summary.turn_mean_torque_Nm == pytest.approx(sample.TORQUE, rel=0.02)
    assert summary.turn_share_left == 0.5
    assert summary.turn_peak_moment_Nm == pytest.approx(0.3)


def test_servo_errors_at_the_end_of_the_last_servo(traces, summary):
    assert summary.servo_final_error_m["left"] == pytest.approx(0.1 * sample.TICK, abs=1e-3)
    assert summary.servo_final_error_m["right"] == pytest.approx(1.5 * summary.servo_final_error_m["left"])
    assert summary.servo_peak_speed_m_s["left"] > 0.01
    assert traces.inside(traces.servo["time"], Mode.SERVO).all()


def test_joint_tracking(summary):
    assert set(summary.tracking) == set(sample.JOINTS)
    assert all(
        t.rms_rad == pytest.approx(sample.LAG) and t.max_rad == pytest.approx(sample.LAG)
        for t in summary.tracking.values()
    )


def test_health_and_faults(summary):
    assert summary.health_max_age_s == pytest.approx(0.3) and summary.health_oldest == "head_left"
    assert summary.faults == [(4.0, "base: late")]


def test_what_the_selector_limited(summary):
    assert summary.selector_limited == {"left_arm.velocity": 6} and summary.selector_refused == {}


@pytest.mark.parametrize(
    "gone", ["/truth", "/joint_states", "/hybrid_rotation/turn", "/supervisor/mode", "/rectangle_estimator"]
)
def test_what_a_log_lacks_is_none_and_named(tmp_path, gone):
    traces = Traces(LogReader(sample.write_run(tmp_path / "less.mcap", end=2.0, without=(gone,))))
    summary = summarize(traces)
    assert any(topic.startswith(gone) for topic in traces.missing)
    if gone == "/truth":
        assert summary.angle_true_rad is None and summary.estimates["measure"].position_rms_m is None
        assert summary.worst_estimate_time_s is not None  # by the residual


def test_an_empty_log_has_a_summary(tmp_path):
    with LogWriter(tmp_path / "empty.mcap"):
        pass
    summary = summarize(tmp_path / "empty.mcap")
    assert summary.outcome == "" and summary.spans == [] and summary.angle_true_rad is None


def test_a_topic_of_another_kind_is_left_out_with_a_reason(tmp_path):
    def change(topic, message, t):
        return Vector(t, ("a",), np.zeros(1)) if topic == "/health" else message

    traces = Traces(LogReader(sample.write_run(tmp_path / "odd.mcap", end=1.0, change=change)))
    assert summarize(traces).health_max_age_s is None
    assert "valve_drake.Vector" in traces.missing["/health"]


def test_interpolation_holds_at_the_ends():
    at, values = np.array([0.0, 1.0]), np.array([[0.0, 10.0], [2.0, 20.0]])
    assert interpolate(np.array([-1.0, 0.25, 5.0]), at, values).tolist() == [[0.0, 10.0], [0.5, 12.5], [2.0, 20.0]]
    assert interpolate(np.array([3.0]), np.array([1.0]), np.array([[7.0]])).tolist() == [[7.0]]


# ---------------------------------------------------------------- integrity


def rows(path):
    return {row.topic: row for row in integrity.examine(LogReader(path)).topics}


def test_a_whole_log_has_no_gap_at_any_rate(path):
    found = integrity.examine(LogReader(path))
    assert found.sound and found.finished and found.troubles == [] and found.gaps() == []
    late = [row.topic for row in found.late]
    assert late == []
    assert {row.topic for row in found.topics if row.kind == "steady"} >= {
        "/joint_states",
        "/health",
        "/truth/base_pose",
    }


def test_a_gap_is_found_with_its_place_and_count(tmp_path):
    def change(topic, message, t):
        return None if topic == "/joint_states" and 2.0 <= t < 2.25 else message

    path = sample.write_run(tmp_path / "gap.mcap", end=3.0, change=change)
    found = integrity.examine(LogReader(path))
    (row,) = found.late
    (gap,) = row.gaps
    assert row.topic == "/joint_states" and row.lost == 0  # the writer never had them
    assert (gap.start, gap.end, gap.missing) == (2.0 - sample.TICK, 2.25, 32)
    assert found.gaps() == [(2.0 - sample.TICK, 2.25)]
    assert found.sound  # the file itself is whole


def test_a_topic_that_stops_early_or_begins_late_has_a_gap_there(tmp_path):
    def change(topic, message, t):
        return None if topic == "/health" and not 0.5 <= t < 1.5 else message

    row = rows(sample.write_run(tmp_path / "short.mcap", end=2.0, change=change))["/health"]
    assert [(gap.start, gap.end, gap.missing) for gap in row.gaps] == [
        (0.0, 0.5, 16),
        (1.5 - 1 / 32, 2.0 - sample.TICK, 16),
    ]


def test_messages_lost_from_the_file_are_counted_by_their_numbers(path, tmp_path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "hurt.mcap").write_bytes(data)
    found = integrity.examine(LogReader(tmp_path / "hurt.mcap"))
    assert not found.sound and found.lost > 0 and found.gaps()
    assert any("damaged" in line for line in found.troubles)
    images = next(row for row in found.topics if row.topic == "/head_left/image")
    assert images.kind == "gated" and images.period_s is None


def test_a_steady_block_is_held_to_its_own_rate(tmp_path):
    def change(topic, message, t):
        slow = topic == "/valve_search/command" and round(t * 128) % 2
        return None if slow or (topic == "/valve_search/command" and 0.5 <= t < 0.75) else message

    row = rows(sample.write_run(tmp_path / "slow.mcap", end=2.0, change=change))["/valve_search/command"]
    assert row.period_s == 1 / 64
    assert [(gap.start, gap.end, gap.missing) for gap in row.gaps] == [(0.5 - 1 / 64, 0.75, 16)]


def test_the_tables_of_rates_agree_with_the_recorders_own():
    calibrations = {camera: ((4, 4), np.eye(3)) for camera in integrity.CAMERAS}
    table = signals(GROUPS, lambda *_: (), calibrations=calibrations)
    topics = {row.topic for row in table}
    assert set(integrity.PERIODS) <= topics and integrity.GATED <= topics and integrity.STEADY <= topics
    assert not (set(integrity.PERIODS) & integrity.STEADY or integrity.GATED & integrity.STEADY)
    exact = {
        row.topic: row.period
        for row in table
        if row.key is None and all(isinstance(kind, int) for kind in row.inputs.values()) and row.period != ONCE
    }
    assert integrity.PERIODS == exact


def test_in_a_log_of_several_runs_truth_counts_from_the_last_ones_beginning(tmp_path):
    modes = ("idle", "search", "turn", "stopped", "idle", "search", "turn", "done")
    names = {"/truth/valve_angle": 2, "/truth/base_pose": 3, "/truth/marker_pose": 12}
    with LogWriter(tmp_path / "two.mcap") as writer:
        for k, mode in enumerate(modes):
            state = ModeState(time=float(k), mode=mode, activation=k, since=float(k), turn_angle=-0.5)
            writer.write("/supervisor/mode", state, float(k))
            for topic, size in names.items():
                values = np.full(size, 0.1 * k if topic == "/truth/valve_angle" else 0.0)
                writer.write(topic, Vector(float(k), tuple("abcdefghijkl"[:size]), values), float(k))
    assert summarize(tmp_path / "two.mcap").angle_true_rad == pytest.approx(0.7 - 0.5)
