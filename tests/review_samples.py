"""A made-up run of six seconds with known truth, for the tests of metrics, page and comparison: no simulation.

The marker's estimate is off by ERROR_P in the left camera and ERROR_W about the marker's axes, the joints lag by LAG,
the valve turns by ANGLE between 3.5 s and 4.5 s, and servo is entered twice.
"""

import cv2
import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from robot_facts import GROUPS, ROBOT

from valve_drake.frames import compose, inverse, make, planar, rot_y, rot_z, rotation
from valve_drake.messages import (
    SIDES,
    CameraFrame,
    Command,
    Health,
    MarkerCandidate,
    ModeState,
    RectangleEstimate,
    Segmentation,
    SelectorReport,
    ServoState,
    Status,
    StereoPosition,
    TurnState,
)
from valve_drake.recording import foxglove
from valve_drake.recording.schemas import Vector, Wrench
from valve_drake.recording.signals import BEHAVIORS, TRUTH
from valve_drake.recording.writer import LogWriter
from valve_drake.robot.groups import GROUPS as ROBOT_GROUPS

TICK = 1 / 128
END = 6.0
MODES = (  # from, mode, attempt, reason
    (0.0, "search", 0, "operator: open"),
    (1.0, "measure", 0, "marker <2 m> away"),
    (1.5, "servo", 0, "at the stand-off"),
    (2.0, "reach", 0, "servo failed"),
    (2.5, "servo", 1, "at the stand-off"),
    (3.0, "grasp", 0, "left 0.4 mm, right 0.6 mm"),
    (3.5, "turn", 0, "held"),
    (4.5, "release", 0, "turned"),
    (5.0, "verify", 0, "released"),
    (5.5, "done", 0, "camera sees 57.30 deg"),
)
ANGLE = 1.0
ERROR_P = np.array([1e-3, 2e-3, -2e-3])  # 3 mm
ERROR_W = np.array([0.0, 0.003, 0.004])  # 5 mrad
SIGMA = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 2e-3])
LAG = 0.002  # [rad]
FORCE, STEM, TORQUE = 20.0, 0.5, 5.5
SCENARIO = "seed: 7\ncommand: open\nsimulation:\n  valve: {friction: 5.1}\n"
JOINTS = tuple(name for group in ROBOT_GROUPS for name in GROUPS.names(group))
HOME = {"waist": 0.1, "neck_pitch": 0.2}


def valve_angle(t):
    return ANGLE * float(np.clip(t - 3.5, 0.0, 1.0))


def base(t):
    """The base turns at 1 rad/s for the first second, the neck against it: an error of one tick in time shows."""
    return np.array([0.1, 0.2, 3.0 + min(t, 1.0)])


def torso(t):
    return np.array([HOME["waist"], HOME["neck_pitch"], -min(t, 1.0)])


def X_WV(t):
    head = compose(planar(*base(0.0)), ROBOT.X_BL(torso(0.0)))
    return compose(head, make(rot_y(0.2), np.array([0.1, -0.05, 1.5])), make(rot_z(0.3 - valve_angle(t)), np.zeros(3)))


def X_LV(t):
    return compose(inverse(compose(planar(*base(t)), ROBOT.X_BL(torso(t)))), X_WV(t))


def mode_at(t):
    index = max(k for k, row in enumerate(MODES) if row[0] <= t)
    return index, MODES[index]


def estimate(t, sequence):
    true = X_LV(t)
    X = make(true[:, :3] @ rotation(ERROR_W), true[:, 3] + ERROR_P)
    X_OL = compose(planar(*base(t)), ROBOT.X_BL(torso(t)))
    return RectangleEstimate(
        time=t,
        sequence=sequence,
        found=True,
        cameras=2,
        X_LV=X,
        covariance=np.diag(SIGMA**2),
        residual_px=0.1,
        X_OL=X_OL,
    )


def jpeg(seed):
    noise = np.random.default_rng(seed).integers(0, 255, (24, 32, 3), np.uint8)
    return cv2.imencode(".jpg", cv2.resize(noise, (320, 240)))[1].tobytes()


def joints(positions, velocity=0.0):
    states = JointStates()
    for name in JOINTS:
        states.joints.add(name=name, position=positions.get(name, 0.5), velocity=velocity)
    return states


def camera_images(t, k):
    frame = CameraFrame("head_left", t, k, data=jpeg(k))
    square = np.array([[100.0, 80.0], [140, 80], [140, 120], [100, 120]])
    seen = Segmentation(frame=frame, candidates=(MarkerCandidate(corners=square, score=9.0),))
    yield "/head_left/image", foxglove.image(frame)
    yield "/head_left/detections", foxglove.detections(seen, None)
    yield "/head_right/image", foxglove.image(CameraFrame("head_right", t, k, data=jpeg(1000 + k)))


def every_tick(t, k):
    index, (since, mode, _, _) = mode_at(t)
    q = dict(zip(GROUPS.torso, torso(t)))
    yield "/joint_states", joints(q, velocity=0.1)
    yield "/joint_commands", joints({name: q.get(name, 0.5) + LAG for name in JOINTS})
    for side in SIDES:
        yield f"/{side}_wrist/wrench", Wrench(time=t)
    for block in BEHAVIORS:
        yield f"/{block}/command", Command(time=t)
    for block in ("valve_search", "base_approach"):
        yield f"/{block}/status", Status(time=t)
    limited = ("left_arm.velocity",) if k % 128 == 0 else ()
    yield "/command_selector/report", SelectorReport(time=t, limited=limited)
    left = np.array([0.1 * max(3.0 - t, 0.004), 0.0, 0.0]) if mode == "servo" else np.zeros(3)
    yield "/image_servo/servo", ServoState(time=t, left_error=left, right_error=1.5 * left)
    if 3.0 <= t < 5.0:
        turning = mode == "turn"
        yield (
            "/hybrid_rotation/turn",
            TurnState(
                time=t,
                stage=mode,
                angle=valve_angle(t),
                angle_reference=valve_angle(t),
                torque=TORQUE * turning,
                squeeze=-1.0,
                force_left=np.array([0.0, FORCE * turning, 0.0]),
                force_right=np.array([0.0, 0.0, FORCE * turning / 2]),
                moment_left=np.array([0.3, 0.0, 0.0]),
                stem_force=np.array([STEM, 0.0, 0.0]),
            ),
        )


def every_fourth(t):
    index, (since, mode, attempt, reason) = mode_at(t)
    verdict = "turned" if mode == "done" else ""
    state = ModeState(t, mode, index + 1, since, attempt, ANGLE, verdict, reason)
    yield "/supervisor/mode", state
    if t == since:
        yield "/events", foxglove.mode_event(state)
        yield "/log", foxglove.mode_log(state)
    ages = np.array([0.02, 0.3 if 2.0 <= t < 2.1 else 0.01])
    yield (
        "/health",
        Health(time=t, devices=("base", "head_left"), ages=ages, faults=("base: late",) if t == 4.0 else ()),
    )
    values = {
        "truth.valve_angle": [0.3 + valve_angle(t), 0.0],
        "truth.base_pose": base(t),
        "truth.marker_pose": X_WV(t).ravel(),
        "truth.stem_wrench": np.zeros(6),
    }
    for port, names in TRUTH.items():
        yield "/" + port.replace(".", "/"), Vector(t, names, np.array(values[port]))


def messages(end=END):
    """(topic, message, time) in order."""
    for k in range(round(end / TICK)):
        t = k * TICK
        found = list(every_tick(t, k))
        if k % 4 == 0:
            found += every_fourth(t)
        if k % 16 == 8 and not 3.0 < t < 5.0:
            capture = t - TICK
            found += camera_images(capture, k // 16)
            found.append(("/rectangle_estimator/estimate", estimate(capture, k // 16)))
            p = X_LV(capture)[:, 3] * 1.01
            found.append(
                ("/stereo_positioning/position", StereoPosition(time=capture, sequence=k // 16, found=True, p_LV=p))
            )
        if t == 5.25:
            done = Status(time=t, activation=9, state="succeeded", value=ANGLE + 0.001, seen=True)
            found.append(("/kinematic_approach/status", done))
        for topic, message in found:
            yield topic, message, t


def write_run(path, *, end=END, without=(), change=None, scenario=SCENARIO, finished=True):
    """Writes the run.

    without: topics to leave out. change: (topic, message, time) -> another message, or None to drop it.
    """
    with LogWriter(path) as writer:
        writer.write_metadata("run", {"seed": "7", "station": "simulated", "commit": "f" * 40, "scenario": scenario})
        for topic, message, t in messages(end):
            if topic in without or topic.startswith(tuple(f"{name}/" for name in without)):
                continue
            message = message if change is None else change(topic, message, t)
            if message is not None:
                writer.write(topic, message, t)
        if finished:
            writer.write_metadata("result", {"outcome": "done"})
    return path
