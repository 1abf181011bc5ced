"""Photographs of any origin: bounded before they are decoded, and refused in one line where they are damaged."""

import os
import pathlib
import random
import struct
import zlib

import cv2
import numpy as np
import pytest

from valve_drake.camera import image_file
from valve_drake.camera.image_file import read_image
from valve_drake.checks import ConfigError

KINDS = {
    "png": [],
    "jpg": [cv2.IMWRITE_JPEG_QUALITY, 95],
    "bmp": [],
    "tiff": [],
    "webp": [cv2.IMWRITE_WEBP_QUALITY, 101],
    "gif": [],
    "ppm": [],
    "pgm": [],
}


def picture(shape: tuple[int, ...] = (60, 80, 3)) -> np.ndarray:
    image = np.random.default_rng(1).integers(90, 130, shape).astype(np.uint8)
    image[20:40, 30:60] = 220
    return image


def encoded(kind: str, options: list[int] | None = None) -> bytes:
    image = picture((60, 80) if kind == "pgm" else (60, 80, 3))
    return cv2.imencode(f".{kind}", image, KINDS[kind] if options is None else options)[1].tobytes()


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 4096))
        + chunk(b"IEND", b"")
    )


def jpeg(width: int, height: int) -> bytes:
    data = bytearray(encoded("jpg"))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def tiff(width: int, height: int, tile: int = 0) -> bytes:
    tags = [(256, 4, width), (257, 4, height), (258, 3, 8), (277, 3, 1)]
    tags += [(322, 4, tile), (323, 4, tile)] if tile else []
    return (
        b"II*\0\x08\0\0\0"
        + struct.pack("<H", len(tags))
        + b"".join(struct.pack("<HHII", t, k, 1, v) for t, k, v in tags)
    )


BOMBS = {
    "png": png(65535, 65535),
    "jpeg": jpeg(65000, 65000),
    "bmp": b"BM"
    + struct.pack("<IHHIIiiHHIIIIII", 99, 0, 0, 54, 40, 60000, -60000, 1, 24, 0, 0, 0, 0, 0, 0)
    + b"\0" * 99,
    "gif": b"GIF89a" + struct.pack("<HH", 65535, 65535) + b"\0" * 50,
    "webp": b"RIFF\0\0\0\0WEBPVP8X\n\0\0\0\0\0\0\0\xff\xff\0\xff\xff\0" + b"\0" * 60,
    "ppm": b"P6\n# a comment\n60000 60000 255\n" + b"\0" * 99,
    "tiff": tiff(60000, 60000) + b"\0" * 99,
    "tile of a tiff": tiff(640, 480, tile=60000) + b"\0" * 99,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_read_and_refused_where_it_is_cut(kind, tmp_path):
    data, path = encoded(kind), tmp_path / f"a.{kind}"
    path.write_bytes(data)
    assert read_image(path).shape == (60, 80, 3) and read_image(path, cv2.IMREAD_GRAYSCALE).shape == (60, 80)
    for share in (0.02, 0.3, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(ConfigError, match="damaged|not an image") as error:
            read_image(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", BOMBS)
def test_no_more_is_decoded_than_the_header_may_claim(kind, tmp_path, monkeypatch):
    path = tmp_path / "bomb"
    path.write_bytes(BOMBS[kind])
    monkeypatch.setattr(image_file.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(ConfigError, match="at most 64 megapixels") as error:
        read_image(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [b"IDAT", b"zzzz"])
def test_a_png_whose_chunk_claims_to_be_longer_than_the_file_is_not_decoded(name, monkeypatch):
    data = cv2.imencode(".png", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = data.index(b"IDAT") - 4
    claims = data[:at] + (2**31 - 1).to_bytes(4, "big") + name + data[at + 8 :]
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(ConfigError, match="^image x: a damaged PNG image$"):
        image_file.decode(claims, "image x")


def test_a_file_that_is_no_photograph_is_one_line(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "empty.png").write_bytes(b"")
    os.mkfifo(tmp_path / "fifo")
    for name, says in (
        ("text.png", "not an image"),
        ("empty.png", "empty file"),
        ("fifo", "not a file"),
        (".", "not a file"),
        ("nowhere.png", "no such file"),
        ("a\0b.png", "cannot be read"),
    ):
        with pytest.raises(ConfigError, match=says):
            read_image(tmp_path / name)
    with pytest.raises(ConfigError, match="not a file"):
        read_image(pathlib.Path("/dev/zero"))


def test_a_jpeg_with_turned_bits_is_refused_where_libjpeg_loses_its_place(tmp_path, capfd):
    data, path, rng = encoded("jpg"), tmp_path / "a.jpg", random.Random(2)
    path.write_bytes(data)
    whole, refused = read_image(path), 0
    start = data.index(b"\xff\xda") + 14
    for _ in range(30):
        damaged = bytearray(data)
        for _ in range(20):
            damaged[rng.randrange(start, len(data) - 2)] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            read_image(path)
        except ConfigError as error:
            assert "damaged JPEG" in str(error) and "\n" not in str(error)
            refused += 1
    assert refused >= 25 and capfd.readouterr().err == ""
    # What cameras pad with is no damage; codes that are left over are.
    path.write_bytes(data[:-2] + b"\0\0\0" + data[-2:])
    assert (read_image(path) == whole).all()
    path.write_bytes(data[:-2] + data[-9:-2] + data[-2:])
    with pytest.raises(ConfigError, match="extraneous"):
        read_image(path)


def test_a_turn_that_is_noted_in_the_file_is_not_applied(tmp_path):
    data, path = encoded("jpg"), tmp_path / "a.jpg"
    tag = b"II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHH", 0x112, 3, 1, 6, 0) + b"\0\0\0\0"
    exif = b"Exif\0\0" + tag
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    assert cv2.imread(str(path)).shape == (80, 60, 3)
    assert read_image(path).shape == (60, 80, 3)
