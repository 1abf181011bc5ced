"""yaml_file.py: what a YAML text says by YAML 1.2, and one bounded line for what cannot be taken."""

import os
import time

import numpy as np
import pytest
import yaml

from valve_drake import yaml_file as mut
from valve_drake.checks import MAX_SHOWN, ConfigError, shown


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e2", 100.0),
        ("1.0e6", 1e6),
        ("1e-3", 0.001),
        ("-.5", -0.5),
        ("5.", 5.0),
        ("+3", 3),
        ("010", 10),
        ("0x1F", 31),
        ("0o17", 15),
        ("-.inf", -np.inf),
        ("1:30", "1:30"),
        ("12:30:45", "12:30:45"),
        ("2001-01-01", "2001-01-01"),
        ("2001-99-99", "2001-99-99"),
        ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("yes", "yes"),
        ("off", "off"),
        ("true", True),
        ("~", None),
        ("", None),
        ("'5'", "5"),
        ("! 5", "5"),
        ("!!str 5", "5"),
        ("!!float 5", 5.0),
        ("!!int 5", 5),
        ("=", "="),
        ("<<", "<<"),
        ("[1, {a: [2.5, x]}]", [1, {"a": [2.5, "x"]}]),
        ("[&a {b: 1}, *a]", [{"b": 1}, {"b": 1}]),
        ("{1: a, true: b, ~: c}", {"1": "a", "true": "b", "~": "c"}),
    ],
)
def test_a_value_is_what_yaml_1_2_says(text, value):
    tree = mut.parse(f"k: {text}", "file")["k"]
    assert tree == value and type(tree) is type(value)


def test_nan_is_a_number():
    assert np.isnan(mut.parse(".nan", "file"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\nb: 2\na: 3\n", "key a stands twice (lines 1 and 3)"),
        ("a: {b: {c: 1,\n c: 2}}", "key a.b.c stands twice (lines 1 and 2)"),
        ("a: [{b: 1, 'b': 2}]", "key a[0].b stands twice (lines 1 and 1)"),
        ("{1: a, '1': b}", "key 1 stands twice"),
        ("a: !!int x", "a is no !!int: 'x' (line 1)"),
        ("a: !!int ''", "a is no !!int: ''"),
        ("a: !!int 1.5", "a is no !!int: '1.5'"),
        ("a: !!float x", "a is no !!float: 'x'"),
        ("a: !!bool maybe", "a is no !!bool: 'maybe'"),
        ("a: !!null x", "a is no !!null: 'x'"),
        ("a: !!timestamp x", "a has the unknown tag !!timestamp"),
        ("a: !!binary x", "!!binary"),
        ("a: !!set {x}", "!!set"),
        ("a: !!python/object/apply:os.system [x]", "!!python/object/apply:os.system"),
        ("a: !Other {x: 1}", "a has the unknown tag !Other; known here: !Pair"),
        ("\na: !Pair [1]", "a is no !Pair: two, please (line 2)"),
        ("a: 1" + "0" * 400, "a must be a number of 64 bits, got '1000"),
        ("a: " + "9" * 5000, "a must be a number of 64 bits, got '9999"),
        ("a: 18446744073709551616", "64 bits"),
        ("a: 1e999", "a must be a finite number, got '1e999'"),
        ("[" * 2000, "nested deeper than 32"),
        ("[" * 100 + "]" * 100, "nested deeper than 32"),
        ("{a: " * 100 + "}" * 100, "nested deeper than 32"),
        ("a: [1\nb: 2", "not YAML (line 2)"),
        ("a: *b", "a is an alias of 'b', which is not defined before"),
        ("a: &b [*b]", "a[0] is an alias of 'b'"),
        ("[a]: 1", "must have plain text as its keys"),
        ("a: {{b: 1}: 2}", "a must have plain text as its keys"),
        ("a: 1\n---\nb: 2", "must be one YAML document, got 2"),
        ("\x00", "not YAML"),
        ("a: \ud800", "not YAML"),
    ],
)
def test_what_cannot_be_taken_is_refused_in_one_line(text, words):
    def pair(tree):
        if len(tree) != 2:
            raise ValueError("two, please")
        return tuple(tree)

    with pytest.raises(ConfigError) as error:
        mut.parse(text, "the file", {"!Pair": pair})
    line = str(error.value)
    assert line.startswith("the file") and words in line
    assert line.isprintable() and len(line) < 400


def test_a_handler_makes_what_its_tag_stands_for():
    assert mut.parse("a: !!opencv-matrix {rows: 2}", "f", {"!!opencv-matrix": dict}) == {"a": {"rows": 2}}
    assert mut.parse("!Text x", "f", {"!Text": str.upper}) == "X"


def test_aliases_that_stand_for_gigabytes_are_refused_at_once():
    names = "abcdefgh"
    ten = [f"&{name} [{','.join([f'*{before}' if before else 'x'] * 10)}]" for before, name in zip(" " + names, names)]
    text = "seed: [" + ", ".join(ten).replace("* ", "x") + "]"
    begin = time.process_time()
    with pytest.raises(ConfigError, match="more than 50000 values"):
        mut.parse(text, "laugh.yaml")
    assert time.process_time() - begin < 2.0


def test_a_long_list_is_refused():
    with pytest.raises(ConfigError, match="more than 50000 values"):
        mut.parse("[" + "x," * 60_000 + "]", "long.yaml")


def test_equal_aliases_are_not_one_object():
    tree = mut.parse("{a: &x [1], b: *x}", "file")
    tree["a"].append(2)
    assert tree["b"] == [1]


def test_empty_documents_do_not_count():
    assert mut.parse("---\na: 1\n---\n", "echo") == {"a": 1}
    assert mut.parse("# nothing\n", "empty") is None
    assert mut.documents("a: &x 1\n---\nb: 2\n---\n", "two") == [{"a": 1}, {"b": 2}]
    with pytest.raises(ConfigError, match="alias"):
        mut.documents("a: &x 1\n---\nb: *x\n", "an anchor of another document")


def test_what_is_dumped_is_read_back_as_it_was():
    tree = {
        "numbers": [0.1, 1e-17, -0.0, 1e300, 3, np.inf],
        "texts": ["1e2", "010", "0o7", "5.", "yes", "1:30", "2001-01-01", "null", "", "a: b", "x\ny", "\x1b[0m", "ü"],
        "others": [True, None, {}, []],
    }
    text = mut.dump(tree, "two lines\nof words")
    assert text.startswith("# two lines\n# of words\n")
    assert mut.parse(text, "dump") == tree
    assert str(mut.parse(text, "dump")["numbers"][2]) == "-0.0"
    assert yaml.safe_load(text) == tree  # and by readers of YAML 1.1


def test_files_are_read_with_a_bound_and_only_regular_ones(tmp_path):
    good = tmp_path / "good.yaml"
    good.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    assert mut.read(good) == {"a": 1, "b": 2}
    binary = tmp_path / "picture.png"
    binary.write_bytes(b"\x89PNG\xff\xfe")
    large = tmp_path / "large.yaml"
    large.write_text("#" * 1_000_001)
    os.mkfifo(tmp_path / "fifo")
    for path, words in [
        (binary, "not text in UTF-8"),
        (large, "larger than 1 MB"),
        (tmp_path, "no such file"),
        (tmp_path / "none.yaml", "no such file"),
        (tmp_path / "fifo", "no such file"),
        (tmp_path / ("n" * 5000), "cannot be read"),
        (str(tmp_path) + "/a\0b", "no such file"),
    ]:
        with pytest.raises(ConfigError, match=words):
            mut.read(path, source="the file")


def test_a_value_is_shown_in_one_short_line():
    endless: list = []
    endless.append(endless)
    nested = [["x" * 50] * 50] * 50
    for value in (endless, nested, "x" * 10**6, {str(k): k for k in range(1000)}, 10**6000, np.zeros((5000, 5000))):
        assert len(shown(value)) <= MAX_SHOWN and shown(value).isprintable()
    assert shown("a\nb\x1b[31m\u202e") == "'a\\nb\\x1b[31m\\u202e'"
    assert shown([0.2, 0.1]) == "[0.2, 0.1]"
    assert shown(np.float64(0.5)) == "0.5"
    assert shown({"a": np.array([1.0, 2.0])}) == "{'a': [1.0, 2.0]}"
    assert shown(None) == "None"
    assert shown(object.__new__(type("Odd", (), {"__repr__": lambda self: "one\ntwo"}))) == "one\\ntwo"
