"""Files that commands write: nothing is destroyed, nothing is half written, a refusal is one line."""

import math
import os
import resource
import signal
import socket
import stat

import pytest

from valve_drake import outputs
from valve_drake.checks import ConfigError, OperationFailed, shown


def refused(words, path, option="--out", **options):
    with pytest.raises(ConfigError) as caught:
        outputs.check(path, option, **options)
    line = str(caught.value)
    assert line.startswith(f"{option} must be ") and words in line and "\n" not in line
    assert line.endswith(f"got {shown(path)}")


def test_a_new_name_is_taken_as_it_is_and_nothing_is_created(tmp_path):
    assert outputs.check(tmp_path / "new.txt", "--out") == tmp_path / "new.txt"
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_refused_unless_asked_for_or_of_the_same_kind(tmp_path):
    old = tmp_path / "old.txt"
    old.write_text("mine")
    refused("does not exist yet, got", old)
    refused("--overwrite", old, overwrite=False)
    refused("does not exist yet", old, made_before=lambda path: path.read_text() == "yours")
    assert outputs.check(old, "--out", overwrite=True) == old
    assert outputs.check(old, "--out", made_before=lambda path: path.read_text() == "mine") == old
    assert old.read_text() == "mine"


def test_an_empty_file_holds_nothing_and_may_be_filled(tmp_path):
    (tmp_path / "empty").touch()
    assert outputs.check(tmp_path / "empty", "--out") == tmp_path / "empty"


@pytest.mark.parametrize("name", ["", ".", "..", "/", "folder", "folder/."])
def test_a_folder_is_no_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError, match=r"^--out must be "):
        outputs.check(name, "--out", overwrite=True)
    with pytest.raises(OperationFailed):
        outputs.write(name, "text")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize("name", ["no/such/folder.txt", "file/below.txt", "x" * 256, "a\0b"])
def test_a_name_that_cannot_be_written_is_refused(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    refused("", name)


def test_only_a_regular_file_is_written(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(str(tmp_path / "socket"))
        (tmp_path / "link").symlink_to(tmp_path / "pipe")
        for name in ("pipe", "socket", "link"):
            refused("regular file", tmp_path / name, overwrite=True)
            with pytest.raises(OperationFailed, match="regular file"):
                outputs.write(tmp_path / name, "text")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode) and (tmp_path / "link").is_symlink()


def test_a_link_is_followed_and_kept(tmp_path):
    (tmp_path / "there").mkdir()
    real, link = tmp_path / "there" / "real.txt", tmp_path / "link.txt"
    link.symlink_to("there/real.txt")
    assert outputs.check(link, "--out") == real
    outputs.write(link, "one")
    refused("does not exist yet", link)
    outputs.write(link, "two")
    assert link.is_symlink() and real.read_text() == "two"


def test_a_link_that_leads_in_a_circle_is_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    refused("", tmp_path / "a")


def test_an_input_is_refused_by_whatever_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "source"
    source.write_text("the only copy")
    os.link(source, "hard")
    os.symlink("source", "soft")
    for name in (source, "source", "./source", "hard", "soft"):
        refused("another file than", name, inputs=["other", source], overwrite=True)


def test_two_outputs_of_one_command_are_two_files(tmp_path):
    (tmp_path / "link").symlink_to("page.html")
    page = outputs.check(tmp_path / "page.html", "--html")
    refused("another file than", tmp_path / "page.html", inputs=[page])
    refused("another file than", tmp_path / "link", inputs=[page])


def test_the_unfinished_file_of_an_input_is_no_output(tmp_path):
    (tmp_path / "run.mcap.active").write_text("")
    refused("another file than", tmp_path / "run.mcap.active", inputs=[tmp_path / "run.mcap"], overwrite=True)
    assert outputs.check(tmp_path / "run.mcap", "--out", inputs=[tmp_path / "run.mcap.active"])


def test_a_name_that_is_not_utf8_is_shown_in_ascii(tmp_path):
    path = os.fsdecode(bytes(tmp_path / "a") + b"\xff")
    outputs.write(path, f"{path}")
    assert open(path, encoding="utf-8").read().endswith("a\\udcff")
    with pytest.raises(ConfigError) as caught:
        outputs.check(path, "--out")  # exists
    str(caught.value).encode("ascii")


def test_a_file_is_written_whole_with_the_usual_permissions(tmp_path):
    outputs.write(tmp_path / "a", "text\n")
    outputs.write(tmp_path / "b", b"\0\1")
    assert (tmp_path / "a").read_bytes() == b"text\n" and (tmp_path / "b").read_bytes() == b"\0\1"
    (tmp_path / "c").touch()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "c").stat().st_mode
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "c"]


def test_what_fails_in_writing_leaves_the_old_file_and_no_other(tmp_path):
    outputs.write(tmp_path / "a", "old")
    with pytest.raises(ZeroDivisionError), outputs.replacing(tmp_path / "a") as file:
        file.write(b"new")
        raise ZeroDivisionError
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "old"


def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path):
    outputs.write(tmp_path / "a", "old")
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OperationFailed, match=r"a' cannot be written: File too large"):
            outputs.write(tmp_path / "a", bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "old"


def test_a_folder_that_went_away_is_one_line(tmp_path):
    (tmp_path / "logs").mkdir()
    with pytest.raises(OperationFailed, match="cannot be written"), outputs.replacing(tmp_path / "logs" / "a") as file:
        file.write(b"x")
        (tmp_path / "logs").rename(tmp_path / "logs2")


def test_a_folder_may_be_new_but_no_file_and_no_link_to_nowhere(tmp_path):
    for name in ("new", "new/deep"):
        assert outputs.check_folder(tmp_path / name, "--out", ["a"]) == tmp_path / name
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    (tmp_path / "dangling").symlink_to("nowhere")
    for name in ("file", "file/below", "dangling"):
        with pytest.raises(ConfigError, match=r"^--out must be "):
            outputs.check_folder(tmp_path / name, "--out", ["a"])


def test_the_files_in_a_folder_are_checked_like_any_other(tmp_path):
    (tmp_path / "a").write_text("mine")
    with pytest.raises(ConfigError, match="does not exist yet, got '.*/a'"):
        outputs.check_folder(tmp_path, "--out", ["b", "a"])
    assert outputs.check_folder(tmp_path, "--out", ["b", "a"], made_before=lambda path: path.name == "a") == tmp_path
    os.mkfifo(tmp_path / "b")
    with pytest.raises(ConfigError, match="regular file"):
        outputs.check_folder(tmp_path, "--out", ["a", "b"], made_before=lambda path: True)


def test_whether_a_file_holds_a_text_is_asked_of_anything(tmp_path):
    page = tmp_path / "page"
    assert not outputs.holds(tmp_path / "none", "Made by us") and not outputs.holds(tmp_path, "Made by us")
    page.write_bytes(bytes(1 << 20))
    assert not outputs.holds(page, "Made by us")
    with open(page, "ab") as file:
        file.write(b"\xff Made by us")
    assert outputs.holds(page, "Made by us")
    page.write_bytes(b"")
    assert not outputs.holds(page, "Made by us")


def test_json_that_is_written_has_no_numbers_that_json_does_not_know():
    tree = {"a": [math.nan, (1.5, -math.inf)], "b": {"c": math.inf, "d": "x", "e": True}}
    assert outputs.json_text(tree) == '{"a": [null, [1.5, null]], "b": {"c": null, "d": "x", "e": true}}'
    assert outputs.parse_json(b'[NaN, -Infinity, {"a": 1}]') == [None, None, {"a": 1}]
    for text in (b"", b"{", b"[" * 100_000, b"\xff", b"9" * 5000):
        with pytest.raises(ValueError):
            outputs.parse_json(text)
