"""scenario.py: what a user may write, and the one line for what may not be."""

import numpy as np
import pytest

from valve_drake import scenario as mut
from valve_drake.checks import ConfigError
from valve_drake.config import Uniform


def test_shipped_scenario_loads_and_round_trips():
    loaded = mut.load()
    again = mut.parse(mut.dump(loaded), "dump")
    assert mut.dump(again) == mut.dump(loaded)
    assert isinstance(loaded.simulation.valve.height, Uniform)


def test_resolve_draws_every_distribution_inside_its_range_and_depends_on_the_seed_alone():
    heights = set()
    for seed in range(20):
        resolved = mut.resolve(mut.load(None, [f"seed={seed}"]))
        again = mut.resolve(mut.load(None, [f"seed={seed}"]))
        assert mut.dump(resolved) == mut.dump(again)
        assert "!Uniform" not in mut.dump(resolved)
        assert 0.81 <= resolved.simulation.valve.height <= 1.22
        heights.add(resolved.simulation.valve.height)
    assert len(heights) == 20


def test_a_fixed_number_changes_no_other_draw():
    free = mut.resolve(mut.load(None, ["seed=3"])).simulation
    fixed = mut.resolve(mut.load(None, ["seed=3", "simulation.valve.height=1.0"])).simulation
    assert fixed.valve.height == 1.0
    assert fixed.valve.friction == free.valve.friction and fixed.start.bearing == free.start.bearing


def test_close_starts_open_and_an_explicit_position_stays():
    assert mut.resolve(mut.load(None, ["command=close"])).simulation.valve.position == pytest.approx(
        np.pi / 2, abs=1e-4
    )
    assert mut.resolve(mut.load(None, [])).simulation.valve.position == 0.0
    given = ["command=close", "simulation.valve.position=0.7"]
    assert mut.resolve(mut.load(None, given)).simulation.valve.position == 0.7


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("simulation.valve.heigth=1", ["unknown key simulation.valve.heigth", "height"]),
        ("simulation.valve.height=abc", ["simulation.valve.height", "number", "abc"]),
        ("simulation.valve.height=9", ["simulation.valve.height", "within", "9"]),
        ("simulation.valve.height=.nan", ["simulation.valve.height", "finite", "nan"]),
        ("angle=!Uniform {min: 1, max: 2}", ["angle must be a finite number, got !Uniform {min: 1, max: 2}"]),
        ("simulation.valve.height=!Gaussian {mean: 1}", ["!Gaussian", "!Uniform"]),
        ("simulation.valve.height=!Uniform {min: 1.2, max: 0.9}", ["simulation.valve.height", "min <= max"]),
        ("simulation.valve.height=!Uniform {max: 1.2}", ["simulation.valve.height", "{min: a, max: b}", "1.2"]),
        ("simulation.valve.height=!Uniform 1.2", ["simulation.valve.height", "{min: a, max: b}", "1.2"]),
        ("simulation.valve.height=!Uniform {min: 1, max: 1.2, mean: 1}", ["unknown key simulation.valve.height.mean"]),
        ("valve.marker.size=[0.2, 0.1]", ["valve.marker.size", "face", "0.2"]),
        ("valve.marker.size=[0.1]", ["valve.marker.size", "2 values"]),
        ("valve.marker.size=0.1", ["valve.marker.size", "list"]),
        ("valve=3", ["valve", "group of keys"]),
        ("command=push", ["command", "open or close", "push"]),
        ("seed=1.5", ["seed", "whole number", "1.5"]),
        ("seed=-1", ["seed", "-1"]),
        ("station=mars", ["station", "mars"]),
        ("hybrid_rotation.torque_limit=99", ["hybrid_rotation.torque_limit", "99"]),
        ("supervisor.deadline.search=-1", ["supervisor.deadline.search", "-1"]),
        ("simulation.camera.head_period=0.1", ["head_period", "1/128", "0.1"]),
        ("nonsense", ["key=value"]),
    ],
)
def test_bad_values_give_one_line_that_names_key_rule_and_value(override, words):
    with pytest.raises(ConfigError) as caught:
        mut.load(None, [override])
    text = str(caught.value)
    assert "\n" not in text
    for word in words:
        assert word in text


def test_a_missing_file_and_one_that_is_not_yaml(tmp_path):
    with pytest.raises(ConfigError, match="no such file: ''"):
        mut.load("")  # a variable of the shell that is empty is no wish for the default scenario
    with pytest.raises(ConfigError, match="no such file: nowhere.yaml"):
        mut.load("nowhere.yaml")
    bad = tmp_path / "bad.yaml"
    bad.write_text("a: [1\nb: 2")
    with pytest.raises(ConfigError, match="bad.yaml: not YAML"):
        mut.load(str(bad))
    empty = tmp_path / "empty.yaml"
    empty.write_text("")
    assert mut.dump(mut.load(str(empty))) == mut.dump(mut.Scenario())


@pytest.mark.parametrize("name", ["n" * 5000, "a\0b", "\udce9.yaml", "/dev/null", ".", ""])
def test_a_name_that_no_scenario_has_gives_one_short_line(name):
    with pytest.raises(ConfigError) as caught:
        mut.load(name or "/")
    assert str(caught.value).startswith("no such file: ") and len(str(caught.value)) < 300


def test_a_log_from_before_the_valve_was_one_value_keeps_its_markers_size():
    unknown = []
    old = mut.parse("marker: {size: [0.12, 0.08], handle_radius: 0.15}\nangle: 0.5\n", "a log", unknown=unknown)
    assert (old.valve.marker.size, old.angle, unknown) == ([0.12, 0.08], 0.5, [])
    with pytest.raises(ConfigError, match="unknown key marker"):
        mut.parse("marker: {size: [0.12, 0.08]}", "a scenario")


def test_loading_twice_shares_nothing():
    a, b = mut.load(), mut.load()
    a.valve.marker.size[0] = 0.05
    a.supervisor.deadline["search"] = 1.0
    assert b.valve.marker.size[0] == 0.098 and b.supervisor.deadline["search"] == 60.0


@pytest.mark.parametrize("old, new", mut.former_names().items())
def test_a_key_that_was_renamed_is_refused_by_its_new_name_but_read_in_a_log(old, new):
    with pytest.raises(ConfigError, match=f"{old} is now called {new}"):
        mut.load(None, [f"{old}=1"])
    (block, name), (_, former) = new.split("."), old.split(".")
    assert len({block, name, former}) == 3
    recorded = mut.parse(f"{block}: {{{former}: 0.0625}}", "a log", unknown=[])
    assert getattr(getattr(recorded, block), name) == 0.0625
