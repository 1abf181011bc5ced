"""signing: a message counts only if it was signed with the key, for its channel, now, and not taken before."""

import pytest

from valve_drake.checks import ConfigError
from valve_drake.stations.signing import WINDOW, Forged, Seal, load_key

KEY = b"sixteen bytes or more"


class Wire:
    """Two ends with one key, on a clock that is moved by hand [s]."""

    def __init__(self, key=KEY):
        self.now = 1000.0
        self.sender, self.receiver = (Seal(k, lambda: int(1e9 * self.now)) for k in (key, KEY))
        self.now += 0.01


@pytest.fixture
def wire():
    return Wire()


def test_what_is_signed_arrives_as_it_was(wire):
    for message in (b"", b"drive", bytes(1000)):
        assert wire.receiver.open("A", wire.sender.close("A", message)) == message
    assert wire.sender.close("A", b"drive").startswith(b"drive"), "Drake's own tools can read it"


def test_another_key_another_channel_or_a_changed_byte_is_forged(wire):
    signed = wire.sender.close("A", b"drive")
    changed = [signed[:k] + bytes([signed[k] ^ 1]) + signed[k + 1 :] for k in range(len(signed))]
    for data in (*changed, signed[:-1], signed + b"x", b"drive", b"", Wire(b"x" * 16).sender.close("A", b"drive")):
        with pytest.raises(Forged):
            wire.receiver.open("A", data)
    with pytest.raises(Forged):
        wire.receiver.open("B", signed)
    assert wire.receiver.open("A", signed) == b"drive"


def test_what_was_said_once_cannot_be_said_again(wire):
    first, second = (wire.sender.close("A", message) for message in (b"1", b"2"))
    assert wire.receiver.open("A", first) == b"1"
    assert wire.receiver.open("A", first) is None
    assert wire.receiver.open("A", second) == b"2"
    assert wire.receiver.open("A", first) is None and wire.receiver.stale == 2


def test_another_sessions_messages_count_as_none(wire):
    signed = wire.sender.close("A", b"drive")
    late = Seal(KEY, lambda: int(1e9 * (wire.now + 0.1)))
    assert late.open("A", signed) is None


def test_what_was_held_back_counts_as_none(wire):
    signed = wire.sender.close("A", b"drive")
    wire.now += WINDOW + 0.01
    assert wire.receiver.open("A", signed) is None


def test_a_clock_that_stands_still_or_goes_back_repeats_no_signature(wire):
    first = wire.sender.close("A", b"drive")
    wire.now -= 0.005
    assert wire.receiver.open("A", first) == b"drive"
    assert wire.receiver.open("A", wire.sender.close("A", b"drive")) == b"drive"


def test_a_key_is_read_from_its_file(tmp_path):
    (tmp_path / "key").write_bytes(KEY + b"\n")
    assert load_key(tmp_path / "key") == KEY


@pytest.mark.parametrize("content", [None, b"", b"short", b" " * 40, b"x" * 5000])
def test_a_bad_key_file_gives_one_line(tmp_path, content):
    path = tmp_path / "key"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"hardware\.key_file: '.*key' (does not exist|must hold)"):
        load_key(path)
    with pytest.raises(ConfigError, match="is not a file"):
        load_key(tmp_path)
