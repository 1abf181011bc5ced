"""A small log as the tests of writer and reader use it; run as a program it is the process that they kill."""

import signal
import sys
import time
from collections.abc import Iterator

import numpy as np

from valve_drake.messages import CameraFrame, Command, Message, RobotState, Status
from valve_drake.recording import foxglove
from valve_drake.recording.writer import LogWriter

TICK = 1 / 128


def samples(seconds: float, image_size: int = 20_000) -> Iterator[tuple[str, object, float]]:
    """(topic, message, time) of a made-up run: two message topics at 128 Hz, one slow, one of images at 8 Hz."""
    rng = np.random.default_rng(5)
    for k in range(round(seconds / TICK)):
        t = k * TICK
        yield "/robot_state/robot_state", RobotState(time=t, odometry=rng.normal(size=5)), t
        yield "/base_approach/command", Command(time=t, base_twist=rng.normal(size=2) if k % 2 else None), t
        if k % 16 == 0:
            frame = CameraFrame("head_left", t, k // 16, data=rng.bytes(image_size))
            yield "/head_left/image", foxglove.image(frame), t
            yield "/base_approach/status", Status(time=t, detail=f"step {k}"), t


def write_log(path: str, seconds: float, image_size: int = 20_000) -> None:
    with LogWriter(path) as writer:
        writer.write_metadata("run", {"seed": "7", "scenario": "a: 1\n"})
        writer.attach("layout.json", "application/json", b"{}")
        for topic, message, t in samples(seconds, image_size):
            writer.write(topic, message, t)
        writer.write_metadata("result", {"outcome": "done"})


def same(a: Message, b: Message) -> bool:
    """Whether two messages of one class agree to the bit, pixels and encoded images aside."""
    if type(a) is not type(b):
        return False
    names = [name for name in a.__dataclass_fields__ if name not in ("image", "data")]
    return all(_same(getattr(a, name), getattr(b, name)) for name in names)


def _same(a: object, b: object) -> bool:
    if isinstance(a, Message):
        return same(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b))
    if isinstance(a, float | np.ndarray):
        return b is not None and np.shape(a) == np.shape(b) and np.asarray(a).tobytes() == np.asarray(b).tobytes()
    return type(a) is type(b) and a == b


if __name__ == "__main__":  # path: writes on in real time, ten times as fast, and says how far it is
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with LogWriter(sys.argv[1]) as log:
        log.write_metadata("run", {"seed": "7"})
        for sample in samples(1000.0):
            log.write(*sample)
            if sample[0] == "/robot_state/robot_state":
                sys.stdout.write(f"{sample[2]}\n")
                sys.stdout.flush()
                time.sleep(TICK / 10)
