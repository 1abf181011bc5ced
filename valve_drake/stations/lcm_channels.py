"""What travels between the program and a robot: one table of LCM channels, in Drake's own message types.

`CHANNELS` is all that a driver's author needs; docs/hardware.md shows it as `table()` makes it. bus.py puts it on the
wire. The scenario's key `hardware` names the channels, the bus and the times that are kept.
"""

import collections
import dataclasses as dc
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from drake import (
    lcmt_drake_signal,
    lcmt_force_torque,
    lcmt_header,
    lcmt_iiwa_command,
    lcmt_iiwa_status,
    lcmt_image,
    lcmt_image_array,
    lcmt_schunk_wsg_command,
    lcmt_schunk_wsg_status,
)

from valve_drake.camera.image_file import jpeg_size
from valve_drake.checks import require
from valve_drake.config import Config, number, numbers, plain, texts
from valve_drake.messages import CAMERAS, POSE_HISTORY, SIDES, CameraFrame, Mode
from valve_drake.ports import SLOT, TICK
from valve_drake.processor import HIGHEST
from valve_drake.robot.drive import SPEEDS
from valve_drake.robot.groups import POSE, Groups
from valve_drake.stations.network import LOOPBACK, NAME, group_of

PROTOCOL = 1  # version of this table; a robot that speaks another one is refused
ROBOT, CONTROLLER, OPERATOR = "robot", "controller", "operator"  # who sends
MODE, REQUEST, STATE = "controller.mode", "cameras.request", "robot.state"
SYNC = {ROBOT: "robot.sync", CONTROLLER: "controller.sync"}
PRESENCE = {ROBOT: "robot.presence", CONTROLLER: "controller.presence", OPERATOR: "operator.presence"}
WORDS, AUDIO, REPORT = "operator.words", "operator.audio", "operator.report"  # between operator and program
UNCOUNTED = frozenset(  # that lock-step's count of messages leaves out
    (*SYNC.values(), *PRESENCE.values(), WORDS, AUDIO, REPORT)
)
LOCKSTEP_TIME = 60.0  # lock-step: how long either side may think about one tick [s, wall]
MM = 1e3  # Drake's gripper messages are in mm
CHANNEL_NAME = re.compile(r"[!-~]{1,63}")  # LCM drops longer ones
MOST_NAMES, LONGEST_NAME = 64, 200  # of a message of named numbers
MOST_SCANS = 20  # of a progressive JPEG: each costs a pass over the image; encoders write about 10

Values = dict[str, np.ndarray]  # port of the contract -> its vector


class WrongMessage(ValueError):
    """A message that does not fit its row of the table; the text says how."""


@dc.dataclass(frozen=True)
class Channel:
    """One row of the table. `key`: its name in the scenario, <device>.<what>. `between`: the program and a robot, or
    the program and an operator."""

    key: str
    sender: str
    kind: Any  # LCM's class
    rate: str
    fields: str  # units and signs, for people
    write: Callable[[Values], Any] | None = None  # values -> message without its stamp; None: made by its sender
    read: Callable[[Any], Values] | None = None
    stamp: str = "utime"
    between: str = ROBOT

    @property
    def device(self) -> str:
        return self.key.partition(".")[0]

    @property
    def default_name(self) -> str:
        return "VALVE_" + self.key.replace(".", "_").upper()

    def encode(self, utime: int, values: Values) -> Any:
        """The message of `values`, stamped `utime` [us]."""
        if self.write is None:
            raise TypeError(f"{self.key}: its sender makes the message")
        message = self.write(values)
        setattr(message, self.stamp, utime)
        return message


def check_sizes(values: Values, sizes: Mapping[str, int]) -> Values:
    """The values of a message, whose vectors have the robot's sizes (contract.vectors). Raises WrongMessage."""
    for port, value in values.items():
        if len(value) != sizes[port]:
            what = "values" if port.startswith("base.") else "joints"
            raise WrongMessage(f"{len(value)} {what}, want {sizes[port]}")
    return values


def _count(wanted: int, found: int, what: str) -> None:
    if found != wanted:
        raise WrongMessage(f"{found} {what}, want {wanted}")


def _base(port: str, before: tuple[str, ...] = ()) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """A vector of `before` and the speeds that the base has, by their names."""
    names = {len(names): names for names in ((*before, *speeds) for speeds in SPEEDS.values())}

    def write(values: Values) -> lcmt_drake_signal:
        vector = values[port].tolist()
        return signal(dict(zip(names[len(vector)], vector)))

    def read(message: lcmt_drake_signal) -> Values:
        return {port: np.array(message.val)}

    return write, read


def signal(values: Mapping[str, float]) -> lcmt_drake_signal:
    """Named numbers as a message."""
    message = lcmt_drake_signal()
    message.dim, message.coord, message.val = len(values), list(values), [float(v) for v in values.values()]
    return message


def _joint_command(port: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    def write(values: Values) -> lcmt_iiwa_command:
        message = lcmt_iiwa_command()
        message.num_joints, message.joint_position = len(values[port]), values[port].tolist()
        return message

    def read(message: lcmt_iiwa_command) -> Values:
        return {port: np.array(message.joint_position)}

    return write, read


def _joint_status(position: str, velocity: str = "", torque: str = "") -> tuple[Callable[..., Any], Callable[..., Any]]:
    def write(values: Values) -> lcmt_iiwa_status:
        zeros = [0.0] * len(values[position])
        message = lcmt_iiwa_status()
        message.num_joints = len(zeros)
        message.joint_position_measured = values[position].tolist()
        message.joint_velocity_estimated = values[velocity].tolist() if velocity else zeros
        message.joint_torque_measured = values[torque].tolist() if torque else zeros
        message.joint_position_commanded = message.joint_position_ipo = zeros
        message.joint_torque_commanded = message.joint_torque_external = zeros
        return message

    def read(message: lcmt_iiwa_status) -> Values:
        out = {position: message.joint_position_measured}
        if velocity:
            out |= {velocity: message.joint_velocity_estimated, torque: message.joint_torque_measured}
        return {port: np.array(value) for port, value in out.items()}

    return write, read


def _gripper(
    kind: type, position: str, force: str, fields: tuple[str, str]
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    opening, newton = fields

    def write(values: Values) -> Any:
        message = kind()
        setattr(message, opening, MM * float(values[position][0]))
        setattr(message, newton, float(values[force][0]))
        return message

    def read(message: Any) -> Values:
        return {position: np.array([getattr(message, opening) / MM]), force: np.array([getattr(message, newton)])}

    return write, read


def _wrench(port: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    def write(values: Values) -> lcmt_force_torque:
        message = lcmt_force_torque()
        message.tx, message.ty, message.tz, message.fx, message.fy, message.fz = values[port].tolist()
        return message

    def read(m: lcmt_force_torque) -> Values:
        return {port: np.array([m.tx, m.ty, m.tz, m.fx, m.fy, m.fz])}

    return write, read


TICKS, ONCE = "every tick, 1/128 s", "robot_period"
_ARM = "joint_position_measured [rad], joint_velocity_estimated [rad/s], joint_torque_measured [N m, of the actuator]"
_UNUSED = "the other fields are not read"


def _rows() -> Iterable[Channel]:
    """Commands, reports, cameras, then what keeps the two sides together."""
    twist = "yaw_rate [rad/s, counter-clockwise from above]; a holonomic base has sideways [m/s, to the left] before it"
    yield Channel(
        "base.command", CONTROLLER, lcmt_drake_signal, TICKS,
        f"forward [m/s], {twist}",
        *_base("base.twist_command"), stamp="timestamp",
    )  # fmt: skip
    joints = "joint_position [rad]; num_torques 0"
    turns = "waist and pan to the left, tilt downwards"
    torso = "lift, waist, tilt, pan, those that the robot has"
    yield Channel(
        "torso.command", CONTROLLER, lcmt_iiwa_command, TICKS, f"{torso}: {joints}; {turns}",
        *_joint_command("torso.position_command"),
    )  # fmt: skip
    for side in SIDES:
        yield Channel(
            f"{side}_arm.command", CONTROLLER, lcmt_iiwa_command, TICKS,
            f"the arm's joints, shoulder to wrist: {joints}",
            *_joint_command(f"{side}_arm.position_command"),
        )  # fmt: skip
        yield Channel(
            f"{side}_gripper.command", CONTROLLER, lcmt_schunk_wsg_command, TICKS,
            "target_position_mm: opening between the pads [mm]; force: limit of the finger actuator, above 0 [N]",
            *_gripper(
                lcmt_schunk_wsg_command, f"{side}_gripper.position_command", f"{side}_gripper.force_limit",
                ("target_position_mm", "force"),
            ),
        )  # fmt: skip
    yield Channel(
        "base.status", ROBOT, lcmt_drake_signal, TICKS,
        "x, y [m], heading [rad], in the frame where odometry began; forward [m/s], (sideways [m/s],) yaw_rate [rad/s]",
        *_base("base.odometry", POSE), stamp="timestamp",
    )  # fmt: skip
    yield Channel(
        "torso.status", ROBOT, lcmt_iiwa_status, TICKS,
        f"{torso}: joint_position_measured [m, rad], signs as commanded; {_UNUSED}",
        *_joint_status("torso.position_measured"),
    )  # fmt: skip
    for side in SIDES:
        arm, gripper = f"{side}_arm", f"{side}_gripper"
        yield Channel(
            f"{arm}.status", ROBOT, lcmt_iiwa_status, TICKS, f"the arm's joints: {_ARM}; {_UNUSED}",
            *_joint_status(f"{arm}.position_measured", f"{arm}.velocity_measured", f"{arm}.torque_measured"),
        )  # fmt: skip
        yield Channel(
            f"{gripper}.status", ROBOT, lcmt_schunk_wsg_status, TICKS,
            f"actual_position_mm: opening [mm]; actual_force: on the pads, positive closes [N]; {_UNUSED}",
            *_gripper(
                lcmt_schunk_wsg_status, f"{gripper}.position_measured", f"{gripper}.force_measured",
                ("actual_position_mm", "actual_force"),
            ),
        )  # fmt: skip
        yield Channel(
            f"{side}_wrist_sensor.status", ROBOT, lcmt_force_torque, TICKS,
            "fx..fz [N], tx..tz [N m]: load that the hand puts on the sensor, at and in the sensor's frame, "
            "gravity and bias included; NaN if the sensor cannot say",
            *_wrench(f"{side}_wrist.wrench"), stamp="timestamp",
        )  # fmt: skip
    for camera in CAMERAS:
        yield Channel(
            f"{camera}.image", ROBOT, lcmt_image_array, "while requested, every capture",
            "one image: JPEG, RGB, of hardware.image_size; images[0].header.seq counts captures from 0, .utime is when "
            "it was taken; "
            "both eyes of the head are captured at once and carry the same utime", stamp="",
        )  # fmt: skip
    yield Channel(
        REQUEST, CONTROLLER, lcmt_drake_signal, "request_period",
        f"{', '.join(CAMERAS)}: 1 while the camera is looked at, else 0; without news for 0.5 s: none",
        stamp="timestamp",
    )  # fmt: skip
    yield Channel(
        STATE, ROBOT, lcmt_drake_signal, "robot_period",
        f"protocol: {PROTOCOL}; torso, left_arm, right_arm: how many joints; estop: 1 while it is pressed; "
        "and 1 for every fault, under the fault's own name", stamp="timestamp",
    )  # fmt: skip
    yield Channel(
        MODE, CONTROLLER, lcmt_drake_signal, "when it changes, for displays and rehearsals",
        "one coordinate, named as the supervisor's mode: how often a mode was entered so far", stamp="timestamp",
    )  # fmt: skip
    for sender in (ROBOT, CONTROLLER):
        yield Channel(
            PRESENCE[sender], sender, lcmt_drake_signal, "every 1/8 s",
            "instance: a random number of this process, so that two of them on one bus are noticed; a robot may leave "
            "it out", stamp="timestamp",
        )  # fmt: skip
        yield Channel(
            SYNC[sender], sender, lcmt_drake_signal, "lock-step only, last in every tick",
            "tick: -1 before the start; messages: how many of this table were sent since the start, but for sync and "
            "presence", stamp="timestamp",
        )  # fmt: skip
    yield Channel(
        WORDS, OPERATOR, lcmt_drake_signal, "every 1/8 s, and at once when something is said",
        "to: `instance` of operator.report; instance: a random number of this operator's desk; sequence: counts what "
        "was said, 0: nothing yet; score: 0 to 1, how sure the recogniser was; said, begin, end: when the words were "
        "complete, and of their sound, on the clock of the stamp [s]; typed: 1 if they were not heard; leaves: 1 "
        "with the last one of a desk; and 1 under `words: ` with the words", stamp="timestamp", between=OPERATOR,
    )  # fmt: skip
    yield Channel(
        AUDIO, OPERATOR, lcmt_image, "while somebody listens by microphone or radio",
        "sound: one row of samples, PIXEL_FORMAT_GRAY of CHANNEL_TYPE_INT16, not compressed; header.seq counts them "
        "from 0, header.utime is the first sample's, header.frame_name the rate [Hz]", stamp="", between=OPERATOR,
    )  # fmt: skip
    yield Channel(
        REPORT, CONTROLLER, lcmt_drake_signal, "every 1/8 s, and at once when it changes",
        "instance: a random number of this program; OperatorState of valve_drake/messages.py by name, its texts as 1 "
        "under `<name>: ` with the text", stamp="timestamp", between=OPERATOR,
    )  # fmt: skip
    yield Channel(
        PRESENCE[OPERATOR], OPERATOR, lcmt_drake_signal, "every 1/8 s",
        "instance: that of operator.words, so that two of them on one bus are noticed", stamp="timestamp",
        between=OPERATOR,
    )  # fmt: skip


CHANNELS: dict[str, Channel] = {row.key: row for row in _rows()}
COMMANDS = tuple(row for row in CHANNELS.values() if row.sender == CONTROLLER and row.write)
REPORTS = tuple(row for row in CHANNELS.values() if row.sender == ROBOT and row.write)
IMAGES = {camera: CHANNELS[f"{camera}.image"] for camera in CAMERAS}


def present(rows: Iterable[Channel], groups: Groups) -> tuple[Channel, ...]:
    """Those of the devices that a robot has: a fixed base, a torso without joints and a hand without a force sensor
    say and hear nothing."""
    return tuple(row for row in rows if row.device not in groups.absent)


def table() -> str:
    """The table in Markdown, for docs/hardware.md."""
    lines = ["| scenario key | channel | from | type | when | fields, units, signs |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {row.key} | {row.default_name} | {row.sender} | {row.kind.__name__} | {row.rate} | {row.fields} |"
        for row in CHANNELS.values()
    ]
    return "\n".join(lines) + "\n"


@dc.dataclass
class HardwareConfig(Config):
    """Scenario key `hardware`: the bus between the program and the robot, and the times that both keep.

    The upper bounds of ages and periods are those that docs/hardware.md promises.
    """

    KEY = "hardware"
    lcm_url: str = plain(
        "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=2097152", "udpm://... or memq://; with room for four images"
    )
    network: str = plain(LOOPBACK, "interface that the group of lcm_url is routed to; lo: only this machine is heard")
    key_file: str = plain(
        "", "holds the key that signs all messages, the same on both sides; empty: they are not signed"
    )
    image_size: list[int] = numbers([640, 480], 16, 4096, "width, height of every camera; others are refused [px]")
    channels: dict[str, str] = texts({row.key: row.default_name for row in CHANNELS.values()}, "names on the bus")
    lockstep: bool = plain(False, "both sides wait for each other instead of the clock: for rehearsals")
    answer_time: float = number(
        30.0, TICK, 600.0, "a robot that has not reported everything after this long does not answer [s]"
    )
    report_age: float = number(0.1, 0.02, 0.1, "a wrist sensor silent for longer reads NaN [s]")
    image_age: float = number(0.8, TICK, POSE_HISTORY, "an image older than this is not shown [s]")
    command_age: float = number(0.1, 0.02, 0.1, "on the robot: without commands for longer its joints stop [s]")
    robot_period: float = number(1 / 32, TICK, 1 / 32, "of robot.state [s]")
    request_period: float = number(1 / 32, TICK, 0.25, "of cameras.request [s]")
    priority: int = number(
        10, 0, HIGHEST, "of a paced loop before the machine's other programs, where the system permits; 0: as they are"
    )

    def relations(self, key: str) -> None:
        group_of(self.lcm_url)
        require(bool(NAME.fullmatch(self.network)), f"{key}.network", "the name of a network interface", self.network)
        names = list(self.channels.values())
        wrong = [name for name in names if not CHANNEL_NAME.fullmatch(name)]
        require(not wrong, f"{key}.channels", "names of 1 to 63 letters, digits and signs", wrong)
        twice = sorted(name for name, count in collections.Counter(names).items() if count > 1)
        require(not twice, f"{key}.channels", "a name of its own for each channel", ", ".join(twice))
        for name in ("robot_period", "request_period"):
            ticks = getattr(self, name) / TICK
            require(ticks == int(ticks), f"{key}.{name}", "a multiple of 1/128 s", getattr(self, name))


def to_utime(time: float) -> int:
    """Seconds -> microseconds."""
    return round(1e6 * time)


def from_utime(utime: int) -> float:
    """Microseconds -> seconds; the grid of slots, that lock-step keeps, comes back exactly."""
    time = utime * 1e-6
    slot = round(time / SLOT) * SLOT
    return slot if abs(slot - time) < 1e-6 else time


def image_message(frame: CameraFrame) -> lcmt_image_array:
    """A camera's JPEG as Drake's message."""
    image = lcmt_image()
    image.header = lcmt_header()
    image.header.utime, image.header.seq, image.header.frame_name = to_utime(frame.time), frame.sequence, frame.camera
    image.width, image.height = jpeg_size(frame.data) or (0, 0)
    image.row_stride = 3 * image.width
    image.data, image.size = frame.data, len(frame.data)
    image.pixel_format, image.channel_type = image.PIXEL_FORMAT_RGB, image.CHANNEL_TYPE_UINT8
    image.compression_method = image.COMPRESSION_METHOD_JPEG
    message = lcmt_image_array()
    message.header, message.num_images, message.images = image.header, 1, [image]
    return message


def read_image(message: lcmt_image_array, size: Sequence[int]) -> lcmt_image:
    """The only image of a message, of (width, height) `size` by its header. Raises WrongMessage."""
    _count(1, message.num_images, "images")
    image = message.images[0]
    if image.compression_method != image.COMPRESSION_METHOD_JPEG:
        raise WrongMessage("an image that is not JPEG")
    if image.header.seq < 0:
        raise WrongMessage(f"image {image.header.seq}, want 0 or more")
    data = bytes(image.data)
    for found in ((image.width, image.height), jpeg_size(data)):
        if found is None:
            raise WrongMessage("an image that cannot be decoded")
        if found != tuple(size):
            raise WrongMessage(f"an image of {found[0]}x{found[1]}, want {size[0]}x{size[1]}")
    if data.count(b"\xff\xda") > MOST_SCANS:
        raise WrongMessage(f"a JPEG of more than {MOST_SCANS} scans")
    return image


def read_named(message: lcmt_drake_signal) -> dict[str, float]:
    """Named numbers. Raises WrongMessage if there are absurdly many, or names of absurd length."""
    if message.dim > MOST_NAMES or any(len(name) > LONGEST_NAME for name in message.coord):
        raise WrongMessage(f"more than {MOST_NAMES} values, or names of more than {LONGEST_NAME} characters")
    return dict(zip(message.coord, message.val))


def read_request(message: lcmt_drake_signal) -> set[str]:
    """The cameras that are wanted. Raises WrongMessage."""
    values = read_named(message)
    if not set(values) <= set(CAMERAS) or not all(value in (0.0, 1.0) for value in values.values()):
        raise WrongMessage(f"a request of other cameras than {', '.join(CAMERAS)}, or not by 0 and 1")
    return {camera for camera, value in values.items() if value}


def read_mode(message: lcmt_drake_signal) -> str:
    """The program's mode. Raises WrongMessage."""
    names = list(read_named(message))
    if len(names) != 1 or names[0] not in set(Mode):
        raise WrongMessage("not one mode of the supervisor")
    return names[0]


def read_presence(message: lcmt_drake_signal) -> float:
    """The sender's number. Raises WrongMessage."""
    number = read_named(message).get("instance", math.nan)
    if not 0 < number < 2.0**53:
        raise WrongMessage("no instance")
    return number
