"""Malformed LCM messages, as a faulty driver or somebody else on the network may send them."""

import math
import struct

import numpy as np
from robot_facts import SIZES

from valve_drake.messages import CAMERAS
from valve_drake.stations.camera_rig import encode_frame
from valve_drake.stations.lcm_channels import CHANNELS, UNCOUNTED, image_message, signal

WILD = (math.nan, math.inf, -math.inf, 1e300, -1e300, 2.0**63, 0.5, 0.0, -1.0)
STAMPS = (0, 1, -1, 2**63 - 1, -(2**63), 2**62, 10**12)
NAMES = ("", "nose", "turn", "instance", "tick", "protocol", "estop", "x" * 5000, "\x1b[31m", *CAMERAS)


def wild_signal(rng):
    """Named numbers of any count, names and values."""
    count = int(rng.choice([0, 1, 2, 3, 5, 200]))
    message = signal({})
    message.coord = [str(rng.choice(NAMES)) for _ in range(count)]
    message.val = [float(rng.choice(WILD)) for _ in range(count)]
    message.dim = count
    message.timestamp = int(rng.choice(STAMPS))
    return message


def wild_image(rng):
    """An image message whose data, size or stamp is wrong."""
    camera = str(rng.choice(CAMERAS))
    pixels = rng.integers(0, 255, tuple(rng.choice([8, 16, 24], 2)) + (3,), np.uint8)
    message = image_message(encode_frame(camera, 0.0, 0, pixels, 90))
    image = message.images[0]
    data = bytes(image.data)
    cut = int(rng.integers(len(data)))
    bomb = data.find(b"\xff\xc0")
    image.data = [
        data,
        data[:cut],
        data[cut:],
        b"",
        rng.bytes(300),
        data[:bomb] + b"\xff\xc0" + struct.pack(">HBHH", 17, 8, 65500, 65500) + data[bomb + 9 :],
        data * 3,
    ][int(rng.integers(7))]
    image.size = len(image.data)
    image.width, image.height = (int(n) for n in rng.choice([0, -1, 16, 640, 2**31 - 1], 2))
    image.header.utime, image.header.seq = int(rng.choice(STAMPS)), int(rng.choice([-1, 0, 7, 2**31 - 1]))
    image.compression_method = int(rng.choice([0, image.COMPRESSION_METHOD_JPEG, 77]))
    return message


def wild_values(row, rng):
    """The right type and count, with NaN, infinite or absurd numbers and any stamp."""
    ports = {port: rng.choice(WILD, size) for port, size in SIZES.items()}
    return row.encode(int(rng.choice(STAMPS)), ports)


def bad_messages(rng, sender, count):
    """`count` times (key, bytes), on all channels of `sender`."""
    rows = [row for row in CHANNELS.values() if row.sender == sender]
    for _ in range(count):
        row = rows[int(rng.integers(len(rows)))]
        other = rows[int(rng.integers(len(rows)))]
        ways = [wild_signal(rng).encode(), wild_image(rng).encode(), rng.bytes(int(rng.integers(200))), b"\xff" * 40]
        if other.write is not None:
            ways.append(wild_values(other, rng).encode())
        if row.write is not None:
            own = wild_values(row, rng).encode()
            ways += [own, own, own[: int(rng.integers(len(own)))], own[:8] + b"\x7f" + own[9:]]
        yield row.key, ways[int(rng.integers(len(ways)))]


def on(bus, message):
    """Publishes (key, bytes)."""
    key, data = message
    bus.lcm.Publish(bus.name(key), data)
    bus.sent += key not in UNCOUNTED
