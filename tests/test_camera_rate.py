"""camera_rate: how many images a twin makes; processor: whose turn it is."""

import math
import os
import threading

import pytest

from valve_drake.checks import ConfigError
from valve_drake.messages import CAMERAS
from valve_drake.processor import goes_first
from valve_drake.stations.camera_rate import ROOM, CameraRate, limits
from valve_drake.stations.simulation_config import CameraConfig
from valve_drake.supervisor.supervisor import SupervisorConfig

AGES = SupervisorConfig().max_age
FAST = dict.fromkeys(CAMERAS, 0.02)


@pytest.fixture
def told():
    return []


@pytest.fixture
def rate(told):
    return CameraRate(limits(CameraConfig(), AGES), told.append)


def periods(rate):
    return rate.period("head_left"), rate.period("left_wrist")


def test_a_twin_in_real_time_makes_all_images_and_says_nothing(rate, told):
    for _ in range(20):
        rate.judge(0.01, FAST)
    assert periods(rate) == (0.125, 0.0625) and rate.largest == 1 and not told


def test_a_twin_that_falls_behind_says_by_how_much_and_halves_its_cameras_rates_at_once(rate, told):
    rate.judge(0.12, FAST)
    assert periods(rate) == (0.25, 0.125)
    (line,) = told
    assert line.startswith("the twin is 12 % slower than real time: its cameras go down to 4 and 8 Hz; ")
    assert line.endswith("simulation.camera.supersample=1, or leave to go before them (docs/hardware.md), would help")
    rate.loops_first = True
    rate.judge(0.12, FAST)
    assert told[1].endswith("simulation.camera.supersample=1, would help")


def test_the_cameras_go_down_to_the_floor_and_then_the_twin_says_that_it_is_slow(rate, told):
    for _ in range(6):
        rate.judge(0.4, FAST)
    assert periods(rate) == (0.25, 0.25)
    assert [line.partition(";")[0] for line in told] == [
        "the twin is 40 % slower than real time: its cameras go down to 4 and 8 Hz",
        "the twin is 40 % slower than real time: its cameras go down to 4 Hz",
        "the twin is 40 % slower than real time with its cameras at the floor, 4 Hz: it goes on, slower",
    ]


def test_a_renderer_that_cannot_follow_is_told_and_asked_for_less(rate, told):
    rate.judge(0.0, FAST | {"right_wrist": 0.09})
    assert periods(rate) == (0.25, 0.125)
    assert told[0].startswith("the twin needs 90 ms for an image of right_wrist: ")


def test_a_twin_with_which_no_program_can_work_says_so_to_the_program(rate):
    rate.judge(0.4, FAST)
    assert rate.trouble == ""
    rate.judge(0.62, FAST)
    assert rate.trouble == "the twin is 62 % slower than real time"
    rate.judge(0.1, FAST)
    assert rate.trouble == ""


def test_with_room_the_cameras_are_as_fast_as_before_and_a_vain_attempt_makes_it_patient(rate, told):
    def calm_until_faster():
        factor, seconds = rate.factor, 0
        while rate.factor == factor:
            rate.judge(0.0, FAST)
            seconds += 1
        return seconds

    rate.judge(0.1, FAST)
    assert [calm_until_faster() for _ in range(1)] == [ROOM] and rate.factor == 1
    waits = []
    for _ in range(7):
        rate.judge(0.1, FAST)
        waits.append(calm_until_faster())
    assert waits == [8, 16, 32, 64, 64, 64, 64]
    assert len(told) == 1, "the user is told of what is new"


def test_without_room_for_twice_the_images_they_stay_slow(rate):
    rate.judge(0.1, FAST)
    for _ in range(50):
        rate.judge(0.0, dict.fromkeys(CAMERAS, 0.07))
    assert rate.factor == 2


@pytest.mark.parametrize("age", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("floor", [0.1, 0.25, 0.5])
def test_whatever_is_configured_a_slow_camera_does_not_look_dead(age, floor):
    """Images of the floor's period, each of which takes a random time up to what the floor leaves of the age."""
    ages = AGES | {"head_left": age}
    camera = CameraConfig(slowest_period=floor, head_period=0.125)
    rate = CameraRate(limits(camera, ages), lambda line: None)
    for _ in range(9):
        rate.judge(0.5, FAST)
    period = rate.period("head_left")
    longest = age - rate.limits.slowest
    assert period <= max(floor, camera.head_period)
    captured, arrived, gaps = 0.0, 0.0, []
    for k in range(200):
        takes = longest * ((k * 37) % 100) / 100
        captured = math.ceil(max(captured + period, arrived) / camera.head_period) * camera.head_period
        gaps.append(captured + takes - arrived)
        arrived = captured + takes
    assert max(gaps) < age


def test_the_age_of_a_camera_that_is_not_named_is_that_of_other_devices():
    config = SupervisorConfig(max_age={"head_left": 0.5})
    assert (config.oldest("head_left"), config.oldest("head_right")) == (0.5, config.other_age)


@pytest.mark.parametrize("key", ["head_period", "wrist_period"])
def test_a_camera_that_would_look_dead_by_its_own_period_is_refused(key):
    words = (
        rf"^simulation.camera.{key} must be for a twin at most half of supervisor.max_age of the cameras, 0.5 s, got 2"
    )
    with pytest.raises(ConfigError, match=words):
        limits(CameraConfig(**{key: 2.0}), AGES)


def test_a_process_that_goes_first_does_so_with_all_its_threads_and_only_for_that_time():
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    try:
        before = os.sched_getscheduler(0)
        with goes_first(10) as permitted:
            if permitted:
                assert os.sched_getscheduler(0) == os.sched_getscheduler(other.native_id) == os.SCHED_FIFO
                assert os.sched_getparam(0).sched_priority == 10
                assert os.sched_getparam(other.native_id).sched_priority == 9
        assert os.sched_getscheduler(0) == os.sched_getscheduler(other.native_id) == before
    finally:
        done.set()
        other.join()


def test_where_it_is_not_permitted_nothing_changes(monkeypatch):
    def refused(*_):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    with goes_first(10) as permitted:
        assert not permitted
    with goes_first(0) as permitted:
        assert not permitted
