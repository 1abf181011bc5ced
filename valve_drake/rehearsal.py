"""Rehearsing a hardware run: the twin of a scenario, as a process of its own or beside the program in one."""

import contextlib
import dataclasses as dc
import functools
import gc
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import cv2
from pydrake.lcm import DrakeLcm

from valve_drake.checks import require
from valve_drake.console import complain
from valve_drake.diagram import initial_commands, make_station, rig_of, robot_of
from valve_drake.messages import CAMERAS, SIDES
from valve_drake.pace import Pace, Pacer
from valve_drake.ports import SLOT
from valve_drake.processor import goes_first
from valve_drake.scenario import Scenario, resolve
from valve_drake.stations.bus import Bus
from valve_drake.stations.camera_rate import CameraRate, limits
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.faults import Faults
from valve_drake.stations.hardware import RobotLink
from valve_drake.stations.reports import listed
from valve_drake.stations.twin import LiveImages, Twin


@dc.dataclass(frozen=True)
class Rehearsed:
    """What became of the twin."""

    time: float  # that passed in it [s]
    valve_start: float  # opened since closed [rad]
    valve_end: float
    pace: Pace | None
    slowest_cameras: int  # by which factor they were slowed down, at most
    dropped: Mapping[str, int]  # bad messages, by what they were for

    def as_json(self) -> dict[str, Any]:
        """The object of `twin --json`."""
        return {
            "sim_time_s": self.time,
            "valve_angle_true_rad": self.valve_end - self.valve_start,
            "valve_start_rad": self.valve_start,
            "valve_end_rad": self.valve_end,
            "missed_ticks": self.pace and self.pace.missed,
            "ticks": self.pace and self.pace.ticks,
            "lost_s": self.pace and self.pace.lost,
            "cameras_slowed_by": self.slowest_cameras,
            "dropped_messages": dict(self.dropped),
        }


def make_twin(
    scenario: Scenario,
    *,
    workers: CameraWorkers | None = None,
    rate: CameraRate | None = None,
    lcm: DrakeLcm | None = None,
) -> Twin:
    """The twin of a resolved scenario. workers: make its images; LiveImages, and their rate, to keep real time."""
    robot = robot_of(dc.replace(scenario, station="hardware"))  # the program at the other end takes no others
    for k, fault in enumerate(scenario.faults):
        require(fault.device not in robot.groups.absent, f"faults[{k}].device", "one that the robot has", fault.device)
        if fault.kind == "stuck":
            last = robot.groups.size(fault.device) - 1
            require(fault.joint <= last, f"faults[{k}].joint", f"within [0, {last}]", fault.joint)
    station = make_station(dc.replace(scenario, station="simulated"), workers=workers)
    return Twin(
        station,
        initial_commands(scenario),
        {"torso": robot.torso.speed, **{f"{side}_arm": robot.arms[side].speed for side in SIDES}},
        scenario.hardware,
        scenario.simulation.camera,
        Faults(scenario.faults, scenario.seed),
        absent=robot.groups.absent,
        images=workers if isinstance(workers, LiveImages) else None,
        rate=rate,
        lcm=lcm,
    )


@contextlib.contextmanager
def beside(scenario: Scenario) -> Iterator[tuple[RobotLink, Twin]]:
    """A twin and the link to it in one process, in lock-step, without any network."""
    scenario = resolve(scenario)
    lcm = DrakeLcm("memq://")
    hardware = dc.replace(scenario.hardware, lockstep=True)
    with CameraWorkers(*rig_of(scenario)) as workers:
        twin = make_twin(dc.replace(scenario, hardware=hardware), workers=workers, lcm=lcm)
        yield RobotLink(Bus(hardware, lcm), robot_of(scenario).groups, idle=twin.poll), twin


def run_twin(
    scenario: Scenario,
    *,
    duration: float | None = None,
    show: Callable[[float], None] = lambda time: None,
    stop: Callable[[], bool] = lambda: False,
    notice: Callable[[str], None] = complain,
) -> Rehearsed:
    """Runs the twin of a scenario until the program at the other end has gone, or for `duration` [s] of its time.

    show: called with its time, every tick. stop: True ends it. notice: tells the user, one line, what takes long.
    Raises ConfigError for a bad scenario or bus, OperationFailed if another robot is on the bus.
    """
    scenario = resolve(scenario)
    scenario.check()
    cv2.setNumThreads(1)
    lockstep = scenario.hardware.lockstep
    ages = {camera: scenario.supervisor.oldest(camera) for camera in CAMERAS}
    rate = CameraRate(limits(scenario.simulation.camera, ages), notice)
    with (CameraWorkers if lockstep else LiveImages)(*rig_of(scenario)) as workers:
        twin = make_twin(scenario, workers=workers, rate=rate)
        begin = float(twin.read("truth.valve_angle")[0])
        if isinstance(workers, LiveImages):
            workers.settle(stop, notice)
        twin.claim(stop)
        pacer = None if lockstep else Pacer(idle=twin.pass_time)
        gc.collect()
        gc.freeze()
        with goes_first(0 if lockstep else scenario.hardware.priority) as first:
            rate.loops_first = first
            if isinstance(workers, LiveImages):
                workers.yield_to(first)
            while not (stop() or twin.gone or (duration is not None and twin.time >= duration)):
                show(twin.time)
                if pacer is None:
                    twin.wait()
                else:
                    pacer.tick(functools.partial(_tick, twin, pacer))
        if twin.dropped:
            notice(f"bad messages of the program were dropped: {listed(twin.dropped)}")
        end = float(twin.read("truth.valve_angle")[0])
        return Rehearsed(twin.time, begin, end, pacer.report(twin.time) if pacer else None, rate.largest, twin.dropped)


def _tick(twin: Twin, pacer: Pacer) -> None:
    """Reports, gives the program until slot 3 to answer, moves."""
    twin.fell_behind(pacer.lost)
    twin.report()
    pacer.wait(pacer.due + 3 * SLOT)
    twin.hear()
    twin.move()
