"""Photographs from files, of any origin: bounded before they are decoded, refused in one line if they are damaged.

A decoder allocates what a header claims, and libjpeg goes on where the data are damaged: blocks are then shifted and
the pose is wrong. So the header is read here first, and the decoder's warnings decide whether a file is damaged.
"""

import contextlib
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from valve_drake.checks import ConfigError

MAX_PIXELS = 64_000_000  # of one image; raise it for a larger sensor, a command then needs more than 1 GB of memory
_MAX_DECODED = 400_000_000  # bytes that a decoder may allocate for the image as its file has it
_MAX_FILE = 256_000_000  # bytes; an uncompressed image of MAX_PIXELS has fewer
_MAX_SCANS = 200  # of a progressive JPEG, each of which costs a pass over the whole image; encoders write about 10
_KINDS = "PNG, JPEG, TIFF, BMP, GIF, WebP or PNM"


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """An image file: (H, W, 3) uint8 BGR, or (H, W) with cv2.IMREAD_GRAYSCALE.

    Raises ConfigError naming the file if it cannot be read, is no image, is damaged, or has more than MAX_PIXELS.
    """
    key = f"image {path}"
    return decode(_read_bytes(path, key), key, flags)


def decode(data: bytes, key: str, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """As `read_image`, from a file's bytes; `key` names it in the error line."""
    size = _claimed_size(data)
    if size is None:
        raise ConfigError(f"{key}: not an image ({_KINDS})")
    kind, width, height, pixel_bytes = size
    if width < 1 or height < 1 or width * height > MAX_PIXELS or width * height * pixel_bytes > _MAX_DECODED:
        most = f"at most {MAX_PIXELS / 1e6:.0f} megapixels and {_MAX_DECODED / 1e6:.0f} MB decoded are read"
        raise ConfigError(f"{key}: {width} x {height} pixels of {pixel_bytes} bytes: {most}")
    if kind == "PNG" and not _png_is_whole(data):
        raise ConfigError(f"{key}: a damaged PNG image")
    if kind == "JPEG" and data.count(b"\xff\xda") > _MAX_SCANS:
        raise ConfigError(f"{key}: a JPEG of more than {_MAX_SCANS} scans")
    with _decoder_messages() as messages:
        try:
            # The EXIF orientation is not applied: a calibration refers to the sensor's own pixels.
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
        except (cv2.error, MemoryError):
            image = None
    if image is None or image.shape[:2] != (height, width):
        raise ConfigError(f"{key}: a damaged {kind} image")
    fault = _jpeg_damage(data, messages()) if kind == "JPEG" else None
    if fault:
        raise ConfigError(f"{key}: a damaged JPEG image ({fault})")
    return image


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) that the header of a JPEG claims; None for anything else. Nothing is decoded."""
    size = _claimed_size(data)
    return size[1:3] if size is not None and size[0] == "JPEG" else None


def _read_bytes(path: Path, key: str) -> bytes:
    try:
        about = path.stat()
        readable = stat.S_ISREG(about.st_mode) and about.st_size <= _MAX_FILE
        data = path.read_bytes() if readable else b""
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({type(error).__name__})"
        raise ConfigError(f"{key}: {reason}") from error
    if not stat.S_ISREG(about.st_mode):
        raise ConfigError(f"{key}: not a file")
    if not readable:
        raise ConfigError(f"{key}: a file of {about.st_size} bytes, at most {_MAX_FILE} are read")
    if not data:
        raise ConfigError(f"{key}: empty file")
    return data


@contextlib.contextmanager
def _decoder_messages() -> Iterator[Callable[[], str]]:
    """What C libraries write to the process's standard error meanwhile, instead of on the user's terminal."""
    with tempfile.TemporaryFile() as caught:
        try:
            terminal = os.dup(2)
        except OSError:  # a process without standard error
            yield lambda: ""
            return
        os.dup2(caught.fileno(), 2)
        text = ""
        try:
            yield lambda: text
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
            caught.seek(0)
            text = caught.read(10_000).decode(errors="replace")


def _jpeg_damage(data: bytes, messages: str) -> str | None:
    """The first complaint of libjpeg that means wrong pixels."""
    found = re.search(r"(?:Corrupt JPEG data: |Premature|Invalid SOS|Inconsistent prog)[^\n]*", messages)
    if found is None:
        return None
    text = found[0]
    # Webcams pad their images: that is no damage. Codes that are left over before the end are.
    padding = re.search(r"(\d+) extraneous bytes before marker 0xd9", text)
    if padding is not None:
        end = data.rfind(b"\xff\xd9")
        if not data[max(end - int(padding[1]), 0) : end].strip(b"\x00\xff"):
            return None
    return text.removeprefix("Corrupt JPEG data: ")


# ---------------------------------------------------------------- headers


def _claimed_size(data: bytes) -> tuple[str, int, int, int] | None:
    """(kind, width, height, bytes that decoding takes for a pixel) by the header alone; None for other files."""
    for kind, start, read in _HEADERS:
        if re.match(start, data, re.DOTALL):
            try:
                size = read(data)
            except (LookupError, ValueError):
                return None
            return None if size is None else (kind, *size)
    return None


def _number(data: bytes, at: int, size: int, order: str = "little") -> int:
    if at < 0 or at + size > len(data):
        raise IndexError
    return int.from_bytes(data[at : at + size], "big" if order == "big" else "little")


def _png(data: bytes) -> tuple[int, int, int]:
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(_number(data, 25, 1), 4)
    depth = 2 if _number(data, 24, 1) == 16 else 1
    return _number(data, 16, 4, "big"), _number(data, 20, 4, "big"), channels * depth


def _png_is_whole(data: bytes) -> bool:
    """Whether its chunks follow each other to its end: a decoder allocates what a chunk claims to be long."""
    at = 8
    while at + 12 <= len(data):
        at, kind = at + 12 + _number(data, at, 4, "big"), data[at + 4 : at + 8]
        if kind == b"IEND":
            return at <= len(data)
    return False


def _jpeg(data: bytes) -> tuple[int, int, int] | None:
    at = 2
    while True:
        at = data.index(b"\xff", at)
        while _number(data, at, 1) == 0xFF:
            at += 1
        marker, at = data[at], at + 1
        if marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:
            continue
        if marker in (0xD9, 0xDA):
            return None
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            # Several scans: all coefficients are kept, two bytes each.
            return _number(data, at + 5, 2, "big"), _number(data, at + 3, 2, "big"), 2 * _number(data, at + 7, 1)
        at += _number(data, at, 2, "big")


def _bmp(data: bytes) -> tuple[int, int, int]:
    if _number(data, 14, 4) == 12:
        return _number(data, 18, 2), _number(data, 20, 2), 3
    height = _number(data, 22, 4)
    return _number(data, 18, 4), min(height, 2**32 - height), max(_number(data, 28, 2) // 8, 3)


def _gif(data: bytes) -> tuple[int, int, int]:
    return _number(data, 6, 2), _number(data, 8, 2), 4


def _webp(data: bytes) -> tuple[int, int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        return _number(data, 24, 3) + 1, _number(data, 27, 3) + 1, 4
    if kind == b"VP8L":
        bits = _number(data, 21, 4)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1, 4
    return (_number(data, 26, 2) & 0x3FFF, _number(data, 28, 2) & 0x3FFF, 4) if kind == b"VP8 " else None


def _pnm(data: bytes) -> tuple[int, int, int] | None:
    gap = rb"(?:\s|#[^\n]*\n)+"
    header = re.match(rb"P[1-6]" + gap + rb"(\d{1,9})" + gap + rb"(\d{1,9})\s", data[:4096])
    return None if header is None else (int(header[1]), int(header[2]), 6)


def _tiff(data: bytes) -> tuple[int, int, int]:
    """Of the first image; a decoder allocates whole tiles, which may be larger than the image."""
    order = "little" if data[:2] == b"II" else "big"
    big = _number(data, 2, 2, order) == 43
    width_of = {1: 1, 3: 2, 4: 4, 16: 8}  # bytes of a value, by type
    at = _number(data, 8, 8, order) if big else _number(data, 4, 4, order)
    count = _number(data, at, 8 if big else 2, order)
    at += 8 if big else 2
    found: dict[int, int] = {}
    for _ in range(min(count, 4096)):
        tag, kind = _number(data, at, 2, order), _number(data, at + 2, 2, order)
        values = _number(data, at + 4, 8 if big else 4, order)
        place, room = (at + 12, 8) if big else (at + 8, 4)
        size = width_of.get(kind)
        if tag in (256, 257, 258, 277, 322, 323) and size:
            place = place if values * size <= room else _number(data, place, room, order)
            found[tag] = _number(data, place, size, order)
        at += 20 if big else 12
    width, height = found[256], found[257]
    tiles = max(width, found.get(322, 0)) * max(height, found.get(323, 0))
    pixel_bytes = max(found.get(258, 8) * found.get(277, 1) // 8, 3)
    return width, height, -(-pixel_bytes * tiles // max(width * height, 1))


_HEADERS: tuple[tuple[str, bytes, Callable[[bytes], tuple[int, int, int] | None]], ...] = (
    ("PNG", rb"\x89PNG\r\n\x1a\n....IHDR", _png),
    ("JPEG", rb"\xff\xd8\xff", _jpeg),
    ("TIFF", rb"II[*+]\x00|MM\x00[*+]", _tiff),
    ("BMP", rb"BM", _bmp),
    ("GIF", rb"GIF8", _gif),
    ("WebP", rb"RIFF....WEBP", _webp),
    ("PNM", rb"P[1-6]", _pnm),
)
