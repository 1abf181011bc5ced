"""config.py and the bounds of every key: what a scenario may say, and that it cannot turn the safety promises off."""

import ast
import dataclasses as dc
import functools
import math
import re
import time
import typing
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from robot_facts import ROBOT

from valve_drake import cli, config, resources
from valve_drake import scenario as scenarios
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.behaviors.stance_search import Stances
from valve_drake.checks import ConfigError
from valve_drake.config import Config, Number, Uniform, number, numbers, plain, table
from valve_drake.frames import make, rot_x, rot_y
from valve_drake.messages import DEVICES, SIDES
from valve_drake.scenario import Scenario
from valve_drake.stations.faults import FaultConfig
from valve_drake.valve.valve import Valve

LEAVES = {leaf.key: leaf for leaf in config.leaves(Scenario())}


@dc.dataclass
class Wheel(Config):
    KEY = "wheel"
    radius: float = number(0.2, 0.1, 0.5, "of the tyre [m]")
    spokes: int = number(5, 0, 9, "")


@dc.dataclass
class Cart(Config):
    KEY = "cart"
    load: Number = number(1.0, 0.0, 10.0, "[kg]")
    brakes: bool = plain(True, "")
    name: str = plain("", "")
    seats: list[float] = numbers([1.0, 2.0], 0.0, (5.0, 6.0), "")
    routes: dict[str, int] = table({"home": 1}, 0, {"home": 3, "away": 9}, "", ("home", "away"))
    front: Wheel = dc.field(default_factory=Wheel)
    spare: list[Wheel] = dc.field(default_factory=list)


def made(given, **changes):
    cart = config.build(dc.replace(Cart(), **changes), given, "file")
    cart.check()
    return cart


def test_a_tree_is_put_on_top_of_the_defaults():
    cart = made({"load": 2, "front": {"spokes": 7}, "routes": {"away": 4}, "seats": [3, 3], "spare": [{"radius": 0.3}]})
    assert (cart.load, type(cart.load)) == (2.0, float)
    assert cart.front == Wheel(0.2, 7) and cart.spare == [Wheel(0.3)]
    assert cart.routes == {"home": 1, "away": 4} and cart.seats == [3.0, 3.0]
    assert made({}, load=5.0).load == 5.0


def test_what_is_built_shares_nothing_with_its_defaults():
    default = Cart()
    cart = config.build(default, {}, "file")
    cart.seats.append(0.0)
    cart.front.radius = 0.4
    assert default == Cart()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"wheels": 4}, "file: unknown key wheels; known here: brakes, front, load, name, routes, seats, spare"),
        ({"front": {"tyre": 1}}, "file: unknown key front.tyre"),
        ({"front": 1}, "file: front must be a group of keys, got 1"),
        ([], "file must be a group of keys, got []"),
        ({"load": True}, "file: load must be a finite number, got True"),
        ({"load": None}, "file: load must be a finite number or !Uniform {min: a, max: b}, got None"),
        ({"load": math.inf}, "file: load must be a finite number, got inf"),
        ({"load": "1:30"}, "file: load must be a finite number or !Uniform {min: a, max: b}, got '1:30'"),
        ({"brakes": 1}, "file: brakes must be true or false, got 1"),
        ({"name": 1}, "file: name must be text, got 1"),
        ({"seats": 3}, "file: seats must be a list, got 3"),
        ({"seats": [1, []]}, "file: seats[1] must be a finite number, got []"),
        ({"seats": [1]}, "cart.seats must be 2 values, got [1.0]"),
        ({"seats": [6, 6]}, "cart.seats[0] must be within [0, 5], got 6.0"),
        ({"routes": []}, "file: routes must be a group of keys, got []"),
        ({"routes": {"home": 4}}, "cart.routes.home must be within [0, 3], got 4"),
        ({"routes": {"home": 1.0}}, "file: routes.home must be a whole number, got 1.0"),
        ({"routes": {"far": 1}}, "cart.routes must be given for home, away, got 'far'"),
        ({"front": {"radius": 0.05}}, "cart.front.radius must be within [0.1, 0.5], got 0.05"),
        ({"spare": [{}, {"spokes": 99}]}, "cart.spare[1].spokes must be within [0, 9], got 99"),
        ({"name": ["x" * 10**6] * 1000}, "file: name must be text, got ['xxx"),
    ],
)
def test_what_does_not_fit_is_refused_by_key_rule_and_value(given, words):
    with pytest.raises(ConfigError) as error:
        made(given)
    assert str(error.value).startswith(words) and len(str(error.value)) < 400


# ---------------------------------------------------------------- the scenario's own keys


def numeric(kind) -> bool:
    kinds = typing.get_args(kind)[-1:] if typing.get_origin(kind) in (list, dict) else [kind]
    return kinds[0] in (float, int, Number)


def test_every_number_of_a_scenario_has_finite_bounds_and_a_default_within():
    leaves = [*config.leaves(Scenario()), *config.leaves(FaultConfig(), "faults[0]")]
    assert len(leaves) > 200
    for leaf in leaves:
        if numeric(leaf.kind):
            assert leaf.rule.low is not None and leaf.rule.high is not None, leaf.key
            values = leaf.value if isinstance(leaf.value, dict) else dict(enumerate(np.atleast_1d(leaf.value)))
            for place in [*values, *leaf.rule.names]:
                low, high = leaf.rule.bounds(place)
                assert math.isfinite(low) and math.isfinite(high) and low < high, leaf.key
        elif leaf.kind is not bool:
            assert leaf.rule.about, leaf.key
    Scenario().check()


def test_every_key_says_what_it_is():
    for leaf in config.leaves(Scenario()):
        assert leaf.rule.about, leaf.key


# Highest value of a key, and the words in docs/hardware.md that promise it. A scenario may be stricter, never laxer.
PROMISES = {
    "command_selector.trip_force": (90.0, "raw force above 90 N at a wrist for 3 ticks"),
    "command_selector.trip_ticks": (3, "raw force above 90 N at a wrist for 3 ticks"),
    "hybrid_rotation.force_trip": (55.0, "hand force above 55 N while turning"),
    "command_selector.max_age": (0.1, "a command that is not finite or older than 0.1 s"),
    "hardware.report_age": (0.1, "a wrist sensor silent or frozen for 0.1 s"),
    "hardware.command_age": (0.1, "robot's side: commands older than 0.1 s"),
    "supervisor.other_age": (0.25, "a device silent for 0.25 s, a camera that is looked at for 1 s"),
    "supervisor.report_age": (0.25, "a device silent for 0.25 s, a camera that is looked at for 1 s"),
    "command_selector.follow_error": (
        0.15,
        "arm or torso 0.15 rad, or base 0.25 m/s or rad/s, off its command for 0.25 s",
    ),
    "command_selector.follow_speed": (
        0.25,
        "arm or torso 0.15 rad, or base 0.25 m/s or rad/s, off its command for 0.25 s",
    ),
    "command_selector.follow_time": (
        0.25,
        "arm or torso 0.15 rad, or base 0.25 m/s or rad/s, off its command for 0.25 s",
    ),
}


@pytest.mark.parametrize("key", PROMISES)
def test_no_scenario_is_laxer_than_what_is_promised(key):
    highest, words = PROMISES[key]
    assert LEAVES[key].rule.high == highest
    assert words in (Path(__file__).parents[1] / "docs" / "hardware.md").read_text()


def test_ages_are_bounded_for_every_device_and_known_devices_only():
    rule = LEAVES["supervisor.max_age"].rule
    assert set(rule.names) == set(DEVICES)
    for device in DEVICES:
        camera = device.startswith("head_") or device.endswith("_wrist")
        assert rule.bounds(device)[1] == (1.0 if camera else 0.25)


def test_grippers_are_bounded_by_the_robots_own_limits():
    joints = {}
    for joint in ElementTree.parse(resources.models() / "robot" / "robot.sdf").iter("joint"):
        limit = joint.find("axis/limit")
        if limit is not None:
            joints[joint.get("name")] = {child.tag: float(child.text) for child in limit}
    high = {key: leaf.rule.high for key, leaf in LEAVES.items() if key.startswith("command_selector.")}
    assert high["command_selector.gripper_force"] == joints["left_finger_1"]["effort"]
    assert high["command_selector.gripper_speed"] == joints["left_finger_1"]["velocity"]
    assert high["command_selector.gripper_high"] == 2 * joints["left_finger_1"]["upper"]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["angle=6.28", "supervisor.angle_limit=6.0"], "angle must be at most supervisor.angle_limit, 6, got 6.28"),
        (["image_servo.opening=0.07"], "unknown key image_servo.opening"),
        (["command_selector.gripper_force=60"], "hybrid_rotation.grip_force must be at most command_selector"),
        (["hybrid_rotation.tug_speed=0.02"], "hybrid_rotation.tug_speed must be at most force_trip / damping"),
        (["hybrid_rotation.slow=0.1", "hybrid_rotation.rate=0.05"], "hybrid_rotation.slow must be at most rate, 0.05"),
        (["stance.arc_step=1e-9"], "stance.arc_step must be within [0.1, 1], got 1e-09"),
        (["stance.distance_max=1e300"], "stance.distance_max must be within"),
        (["kinematic_approach.joint_speed=1e300"], "kinematic_approach.joint_speed must be within"),
        (["supervisor.max_age={nonsense: 1}"], "supervisor.max_age must be given for base, torso"),
        (["hardware.channels={5: a}"], "hardware.channels must be given for base.command"),
        (["command_selector.arm_limit=[1,1,1,1,1,1]"], "unknown key command_selector.arm_limit"),
        (["'seed'=4"], "unknown key 'seed'"),
        (["seed\n=4"], "--set seed"),
        (["seed=4\nstation: hardware"], "--set seed"),
        (["seed=[&a [x,x],*a]"], "seed must be a whole number"),
    ],
)
def test_what_would_fail_later_is_refused_at_once(overrides, words):
    if overrides == ["seed\n=4"]:  # blanks round a key mean nothing
        assert scenarios.load(None, overrides).seed == 4
        return
    with pytest.raises(ConfigError) as error:
        scenarios.load(None, overrides)
    assert words in str(error.value)


def test_the_longest_search_for_a_stance_that_a_scenario_allows_ends_soon():
    longest = StanceConfig(distance_min=0.5, distance_max=0.5 + 39 * 0.01, distance_step=0.01, arc_step=0.1)
    longest.margin_enough = 1.0
    longest.check()
    X_OV = make(rot_y(math.pi / 2) @ rot_x(-math.pi / 2) @ np.eye(3), np.array([2.0, 0, 1.0]))
    straight = {side: np.array([0.0, 0, 1.0]) for side in SIDES}
    begin = time.process_time()
    Stances(ROBOT, Valve(), longest, straight, lambda *_: True).find(X_OV, 6.29)
    assert time.process_time() - begin < 5.0  # 40 distances x 2 x 64 poses x 2 arms at worst


# ---------------------------------------------------------------- mutations

VALUES = (
    *(
        "",
        "~",
        "[]",
        "{}",
        "''",
        "x",
        "yes",
        "2001-99-99",
        "1:30",
        "0",
        "-1",
        "1",
        "010",
        "0.5",
        "1e-9",
        "-1e-9",
        "1e300",
    ),
    *(
        "-1e300",
        "1e999",
        ".nan",
        ".inf",
        "9" * 400,
        "9" * 5000,
        "!!int x",
        "!!float x",
        "!!bool maybe",
        "!!timestamp x",
    ),
    *("!Uniform {min: 0, max: 1}", "!Uniform {min: 1, max: 0}", "!Uniform 3", "!Uniform {}", "!Other {}", "[1, 2]"),
    *(
        "[1, 2, 3, 4, 5, 6]",
        "[" * 2000,
        "{a: 1, a: 2}",
        "{x: {y: 1}}",
        "*a",
        "&a [*a]",
        "[&a [x,x], *a]",
        "\x00",
        "\x1b[0m",
    ),
)


def mutations(count: int, seed: int):
    rng = np.random.default_rng(seed)
    keys = sorted(key for leaf in config.leaves(Scenario()) for key in ancestors(leaf.key)) + [
        "",
        "x",
        "seed.x",
        "a..b",
    ]
    for _ in range(count):
        leaf = LEAVES.get(key := keys[rng.integers(len(keys))])
        value = VALUES[rng.integers(len(VALUES))]
        if leaf is not None and numeric(leaf.kind) and rng.random() < 0.4:  # at and just beyond the bounds
            place = next(iter(leaf.value)) if isinstance(leaf.value, dict) else 0
            low, high = leaf.rule.bounds(place)
            end = [low, high, low - 1e-6 * max(1, abs(low)), high * 1.001 + 1e-6][rng.integers(4)]
            value = repr(round(end) if leaf.kind is int else float(end))
        yield f"{key}={value}"


def ancestors(key: str) -> list[str]:
    parts = key.split(".")
    return [".".join(parts[: k + 1]) for k in range(len(parts))]


def test_whatever_is_put_into_a_scenario_is_taken_or_refused_in_one_line():
    taken, shipped = 0, scenarios.load()
    for override in mutations(300, seed=1):
        try:
            again = scenarios.parse(scenarios.dump(loaded := scenarios.with_overrides(shipped, [override])), "dump")
            assert again == loaded, override
            taken += 1
        except ConfigError as error:
            text = str(error)
            assert len(text) < 2000, override[:100]
            assert "got" in text or re.search(r"unknown|YAML|line \d|--set", text), text
    assert 15 < taken < 285


# ---------------------------------------------------------------- valve-drake scenario


def test_the_command_prints_every_key_as_a_scenario_that_loads(capsys, tmp_path):
    override = "faults=[{kind: loss, share: 0.1}]"
    assert cli.main(["scenario", "--set", override, "--set", "seed=5"]) == 0
    text = capsys.readouterr().out
    (tmp_path / "all.yaml").write_text(text)
    assert scenarios.load(str(tmp_path / "all.yaml")) == scenarios.load(None, [override, "seed=5"])
    for leaf in config.leaves(Scenario()):
        assert re.search(rf"^ *{leaf.key.split('.')[-1]}:", text, re.M), leaf.key
    assert re.search(r"^  trip_force: 90.0 +# raw force .* \[N\], within \[10, 90\]$", text, re.M)
    assert re.search(
        r"height: !Uniform \{min: 0.81, max: 1.22\} +# of the axis over the floor \[m\], within \[0.5, 1.6\]", text
    )
    assert cli.main(["scenario", "nowhere.yaml"]) == 2


def test_a_distribution_is_checked_at_both_ends():
    cart = Cart(load=Uniform(2.0, 11.0))
    with pytest.raises(ConfigError, match=r"cart.load must be within \[0, 10\], got 11.0"):
        cart.check()


# ---------------------------------------------------------------- every key is read


def config_classes(kind: type[Config] = Scenario) -> set[type[Config]]:
    """All that a scenario is made of."""
    inner = [arg for field in dc.fields(kind) for arg in (field.type, *typing.get_args(field.type))]
    inner += [type(field.default_factory()) for field in dc.fields(kind) if field.default_factory is not dc.MISSING]
    return {kind}.union(*(config_classes(one) for one in inner if isinstance(one, type) and issubclass(one, Config)))


def reads(tree: ast.Module) -> set[str]:
    """Names of all attributes that a module reads, but for those in the rules of Config classes themselves."""
    skipped = {id(n) for cls in ast.walk(tree) if isinstance(cls, ast.ClassDef) for f in cls.body
               if isinstance(f, ast.FunctionDef) and f.name == "relations" for n in ast.walk(f)}  # fmt: skip
    attributes = (n for n in ast.walk(tree) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Load))
    return {n.attr for n in attributes if id(n) not in skipped}


def unread(classes: set[type[Config]]) -> list[str]:
    """Keys that are read by no module that defines their class or imports from where it, or its group's, is defined."""
    out = []
    for cls in classes:
        owners = [one for one in classes if any(field.type is cls for field in dc.fields(one))]
        homes = {base.__module__ for one in (cls, *owners) for base in one.__mro__} - {config.__name__, "builtins"}
        knowing = [read for name, (text, read) in package().items() if name in homes or any(h in text for h in homes)]
        known = set().union(*knowing)
        out += [f"{cls.__name__}.{field.name}" for field in dc.fields(cls) if field.name not in known]
    return sorted(out)


@functools.cache
def package() -> dict[str, tuple[str, set[str]]]:
    """Module name -> its text, and the attributes that it reads."""
    out, root = {}, Path(config.__file__).parent
    for path in root.rglob("*.py"):
        text = path.read_text()
        out[".".join(("valve_drake", *path.relative_to(root).with_suffix("").parts))] = text, reads(ast.parse(text))
    return out


def test_every_key_of_a_scenario_is_read_by_a_module_that_knows_its_group():
    classes = config_classes()
    assert len(classes) > 20 and FaultConfig in classes
    assert unread(classes) == []


def test_a_key_that_nobody_reads_would_be_found():
    @dc.dataclass
    class Dead(Config):
        brake_pads: float = number(1.0, 0.0, 2.0, "read by nobody")

        def relations(self, key: str) -> None:
            assert self.brake_pads >= 0

    assert unread({Dead}) == ["Dead.brake_pads"]
