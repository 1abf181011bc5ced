"""camera_workers: makes the same images as CameraRig in other processes, and begins them early."""

import errno
import gc
import os
import pickle
import signal
import subprocess
import sys

import numpy as np
import pytest
from robot_facts import ROBOT

from valve_drake import named_files, scenario
from valve_drake.camera.lens import load_head
from valve_drake.checks import OperationFailed
from valve_drake.stations import camera_workers
from valve_drake.stations.camera_rig import CameraRig, Capture
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.lcm_channels import image_message
from valve_drake.stations.simulated import make_mounts


@pytest.fixture(scope="module")
def rig_arguments():
    sc = scenario.resolve(scenario.load(None, ["seed=5", "simulation.camera.noise=2", "simulation.camera.blur=0.5"]))
    head = load_head(named_files.find(sc, "head_calibration"))
    mounts = make_mounts(head, sc.simulation, 5, ROBOT.description.cameras)
    return mounts, sc.simulation.valve, sc.valve, sc.simulation.light, sc.simulation.camera, 5


@pytest.fixture(scope="module")
def rig(rig_arguments):
    return CameraRig(*rig_arguments)


@pytest.fixture
def workers(rig_arguments):
    with CameraWorkers(*rig_arguments) as workers:
        yield workers


def captures(rig, count, offset=0.0):
    """The head turns a little from one to the next."""
    out = []
    for k in range(count):
        q = np.zeros(rig.plant.num_positions())
        q[rig.plant.GetJointByName("base_x").position_start()] = -1.5
        q[rig.plant.GetJointByName("neck_yaw").position_start()] = offset + 0.02 * k
        out.append(Capture(k / 8, k, q))
    return out


def test_where_not_all_processes_can_be_started_none_stays(monkeypatch):
    started = []

    def spawn(fd, niceness):
        if started:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        started.append(subprocess.Popen(["sleep", "60"]))
        return started[0], started[0].wait

    monkeypatch.setattr(camera_workers, "_can_fork", lambda: False)
    monkeypatch.setattr(camera_workers, "_spawn", spawn)
    with pytest.raises(OperationFailed, match="no process to render in can be started: Resource"):
        CameraWorkers("rig").__enter__()
    assert started[0].poll() == -signal.SIGTERM


@pytest.mark.system
def test_images_of_both_eyes_are_the_rigs_own_to_the_bit(rig, workers):
    for capture in captures(rig, 3):
        for name in ("head_left", "head_right"):
            workers.captured(name, capture)
        for name in ("head_left", "head_right"):
            made, own = workers.frame(name, capture), rig.frame(name, capture)
            assert made.data == own.data
            assert (made.camera, made.time, made.sequence) == (name, capture.time, capture.sequence)
            np.testing.assert_array_equal(made.image, own.image)


@pytest.mark.system
def test_what_is_read_regularly_is_begun_at_its_capture_and_nothing_else(rig, workers):
    shots = captures(rig, 7)
    for capture in shots[:4]:
        workers.captured("head_left", capture)
    workers.frame("head_left", shots[1])
    workers.frame("head_left", shots[3])  # every second one
    for capture in shots[4:]:
        workers.captured("head_left", capture)
    assert set(workers._asked["head_left"]) - {1, 3} == {5}
    assert workers.frame("head_left", shots[5]).data == rig.frame("head_left", shots[5]).data
    assert workers.frame("head_left", shots[6]).data == rig.frame("head_left", shots[6]).data  # not foreseen


@pytest.mark.system
def test_a_simulation_begun_anew_gets_its_own_images(rig, workers):
    first, second = captures(rig, 1)[0], captures(rig, 1, offset=0.2)[0]
    assert workers.frame("left_wrist", first).data == rig.frame("left_wrist", first).data
    anew = workers.frame("left_wrist", second)
    assert anew.data == rig.frame("left_wrist", second).data


@pytest.mark.parametrize("gone", [True, False])
def test_the_processes_end_with_the_block_and_a_lost_one_is_named(rig, rig_arguments, gone):
    with CameraWorkers(*rig_arguments) as workers:
        processes = [worker.process for worker in workers._workers]
        processes[0].kill()
        if gone:  # before it is asked, else while it is
            processes[0].wait()
        with pytest.raises(OperationFailed, match="renders head_left ended with code -9"):
            workers.frame("head_left", captures(rig, 1)[0])
    assert all(process.poll() is not None for process in processes)
    gc.collect()  # what is left of a failed call must not take the program with it


@pytest.mark.system
def test_the_caller_decides_how_far_the_processes_stand_back(rig, rig_arguments):
    with CameraWorkers(*rig_arguments, niceness=7) as workers:
        workers.frame("head_left", captures(rig, 1)[0])
        pid = workers._worker("head_left").pid
        assert os.getpriority(os.PRIO_PROCESS, pid) == min(os.nice(0) + 7, 19)


FORKED = """
import pickle, sys, threading, warnings
from valve_drake.stations.camera_workers import CameraWorkers
warnings.simplefilter("error")  # of a fork beside threads
rig, capture, beside = pickle.load(sys.stdin.buffer)
threads = [threading.Thread(target=threading.Event().wait, daemon=True) for _ in range(beside)]
for thread in threads:
    thread.start()
with CameraWorkers(*rig) as workers:
    data = workers.frame("head_right", capture).data
    kinds = [type(worker.process).__name__ for worker in workers._workers]
sys.stdout.buffer.write(pickle.dumps((kinds, data)))
"""


@pytest.mark.system
@pytest.mark.parametrize("threads", [0, 1])
def test_a_process_without_threads_is_forked_and_any_other_starts_new_ones(rig, rig_arguments, threads):
    capture = captures(rig, 1)[0]
    result = subprocess.run(
        [sys.executable, "-c", FORKED],
        input=pickle.dumps((rig_arguments, capture, threads)),
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        check=True,
    )
    kinds, data = pickle.loads(result.stdout)
    assert kinds == 2 * (["Popen"] if threads else ["ForkProcess"])
    assert data == rig.frame("head_right", capture).data
    assert result.stderr == b""


def test_an_image_on_its_way_has_no_pixels_and_says_its_size(rig):
    frame = rig.exposed("head_left", captures(rig, 1)[0])
    assert frame.image.size == 0
    image = image_message(frame).images[0]
    assert (image.width, image.height) == (640, 480) and image.data == frame.data
