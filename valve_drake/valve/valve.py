"""The valve as one value: its axis, its marker, where hands can hold it, what is fixed around it.

All places are in the axis frame A: origin on the axis at the grip plane (the middle of what is gripped), z along the
axis into the panel. A turns with the valve. Where A's x axis is level, the simulated stem stands at zero; positive
turns are counter-clockwise as seen from the robot, about -z of A.

A scenario's key `valve` brings another valve; its simulated scene, the collision model, the grasps, the estimator's
marker and the turning law take everything from here.
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, about, choice, number, numbers, plain
from valve_drake.frames import compose, inverse, make, rot_x, rot_y, rot_z
from valve_drake.messages import RectangleEstimate
from valve_drake.perception.marker import Marker

OPENING = {"counter_clockwise": 1.0, "clockwise": -1.0}  # sense that opens -> its sign about -z of A
# At a stance the head's cameras see about 0.35 m from top to bottom, and the handles lower than they are, from above: a
# marker on the panel is whole in view, and so are marks about an axis as far from it as FARTHEST.
FARTHEST = 0.235  # of such a marker from the axis [m]
LOOK = 0.12  # from such a marker's middle towards the axis, where the head looks [m]
ALIKE = 0.02  # handles that differ by less look the same to the head's cameras [m]
SAME_RIM = 0.005  # by which places on one rim may differ; a hand's fingers make up for as much [m]
LOWEST_MARK = 0.003  # of a green mark over the middle of a handle that is made of the keys [m]
PLATE = "plate"  # the shape of a made panel: across the axis, so it is the same however the valve is turned
SPOKE = 0.016  # width and thickness of a made rim's spokes [m]
_UPRIGHT = 0.35  # horizontal part of an axis' direction below which it has no heading of its own


@dc.dataclass
class HandleConfig(Config):
    """A place where a hand can hold the valve, with a green mark on its front."""

    KEY = "valve.handles"
    kind: str = choice(
        "bar", ("bar", "lever", "rim"), "bar, lever: reaches out from the axis; rim: runs round the axis"
    )
    xyz: list[float] = numbers([0.15, 0.0, 0.0], -1.0, 1.0, "the middle of what is gripped, in A [m]")
    along: list[float] = numbers(
        [], -1.0, 1.0, "direction of the handle there, in A; none: outwards, of a rim round the axis", (0, 3)
    )
    width: float = number(0.025, 0.005, 0.08, "between the pads when grasped [m]")
    length: float = number(0.06, 0.03, 1.0, "that is free for a hand, along the handle [m]")

    def relations(self, key: str) -> None:
        radius = math.hypot(*self.xyz[:2])
        require(radius >= 0.05, f"{key}.xyz", "at least 0.05 m off the axis", self.xyz)
        if self.along:
            across = len(self.along) == 3 and math.hypot(*self.along[:2]) > 0.9 * math.hypot(*self.along) > 0
            require(across, f"{key}.along", "a direction across the axis, three numbers", self.along)

        x, y, _ = self.direction()
        if abs(self.xyz[0] * y - self.xyz[1] * x) < 0.02 * radius:  # it points at the axis
            words = f"at most {2 * radius:g}: it reaches beyond the axis"
            require(self.length <= 2 * radius + 1e-9, f"{key}.length", words, self.length)

    def direction(self) -> np.ndarray:
        """Unit vector along the handle, across the axis, in A -> (3,)."""
        x, y, _ = self.along or ((-self.xyz[1], self.xyz[0], 0.0) if self.kind == "rim" else (*self.xyz[:2], 0.0))
        return np.array([x, y, 0.0]) / math.hypot(x, y)


@dc.dataclass
class MarkerConfig(Config):
    """The red rectangle."""

    KEY = "valve.marker"
    size: list[float] = numbers([0.098, 0.100], 0.005, 2.0, "2 X_w, 2 Y_w, along x and y of V [m]")
    xyz: list[float] = numbers([0.0, 0.0, -0.041], -1.0, 1.0, "of its centre, in A [m]")
    rpy: list[float] = numbers([0.0, 0.0, 0.0], -math.pi, math.pi, "roll, pitch, yaw of V in A [rad]")
    carrier: str = choice(
        "wheel",
        ("wheel", "panel"),
        "wheel: it turns with the valve; panel: it does not, and green marks tell the angle",
    )
    face: float = number(0.15, 0.01, 2.0, "the valve's face that carries it, square [m]")
    mark_height: float = number(0.013, 0.0, 0.2, "of the green marks over the middle of their handles [m]")

    def relations(self, key: str) -> None:
        for length in self.size:
            words = f"not larger than the face on the valve, {key}.face, {self.face:g} m"
            require(length <= self.face, f"{key}.size", words, self.size)
        require(max(self.size) <= 3 * min(self.size), f"{key}.size", "of an aspect up to 3:1", self.size)
        lean = math.acos(min(max(math.cos(self.rpy[0]) * math.cos(self.rpy[1]), -1.0), 1.0))
        require(lean < 0.8, f"{key}.rpy", "facing the robot: leaning by at most 0.8 rad", self.rpy)


@dc.dataclass
class PanelConfig(Config):
    """What carries the valve: a plate across the axis."""

    KEY = "valve.panel"
    depth: float = number(0.09, 0.02, 1.0, "of its front surface behind the grip plane [m]")
    width: float = number(0.8, 0.05, 5.0, "[m]")
    height: float = number(0.8, 0.05, 5.0, "[m]")


@dc.dataclass
class ObstacleConfig(Config):
    """A box beside the valve that hands and arms keep clear of; it does not turn."""

    KEY = "valve.obstacles"
    xyz: list[float] = numbers([0.0, 0.0, 0.0], -5.0, 5.0, "of its centre, in A with the stem at zero [m]")
    size: list[float] = numbers([0.1, 0.1, 0.1], 0.001, 10.0, "along x, y and z of A [m]")


def _alike(key: str, words: str, values: list[float]) -> None:
    """Of the handles on a rim, which is one ring [m]. Raises ConfigError."""
    same = not values or max(values) - min(values) < SAME_RIM
    require(same, key, f"{words} all others on the rim", [round(value, 4) for value in values])


def _ends_of_the_bar() -> list[HandleConfig]:
    return [HandleConfig(xyz=[x, 0.0, 0.0]) for x in (0.15, -0.15)]


@dc.dataclass
class Valve(Config):
    """Scenario key `valve`."""

    KEY = "valve"
    model: str = plain(
        "valve/valve.sdf",
        'its shape: a path, one below models/, or a package:// URL; "": made of these keys',
    )
    opens: str = choice("counter_clockwise", tuple(OPENING), "the sense that opens it, as seen from the robot")
    marker: MarkerConfig = dc.field(default_factory=MarkerConfig)
    handles: list[HandleConfig] = dc.field(
        default_factory=_ends_of_the_bar,
        metadata=about("places where hands can hold it: kind, xyz, along, width, length"),
    )
    spokes: int = number(5, 0, 12, "of a rim that is made of these keys; none lies at a handle if handles lie between")
    panel: PanelConfig = dc.field(default_factory=PanelConfig)
    obstacles: list[ObstacleConfig] = dc.field(
        default_factory=list, metadata=about("boxes that hands and arms keep clear of: xyz, size")
    )

    def relations(self, key: str) -> None:
        handles = self.handles
        require(2 <= len(handles) <= 12, f"{key}.handles", "2 to 12 places, one for each hand", len(handles))
        require(len(self.obstacles) <= 20, f"{key}.obstacles", "at most 20 boxes", len(self.obstacles))
        for k, handle in enumerate(handles):
            for i, other in enumerate(handles[:k]):
                words = f"a place of its own, {ALIKE:g} m or more from {key}.handles[{i}]"
                require(math.dist(handle.xyz, other.xyz) >= ALIKE - 1e-9, f"{key}.handles[{k}].xyz", words, handle.xyz)
        apart = max(math.dist(a.xyz[:2], b.xyz[:2]) for a in handles for b in handles)
        words = "two of them at least 0.12 m apart across the axis, for two hands"
        require(apart >= 0.12, f"{key}.handles", words, f"{apart:.3g} m")
        for k, handle in enumerate(handles):
            before = handle.xyz[2] < self.panel.depth
            require(before, f"{key}.handles[{k}].xyz", f"before the panel, z below {self.panel.depth:g}", handle.xyz)
        rims = [handle for handle in handles if handle.kind == "rim"]
        _alike(f"{key}.handles", "as far from the axis as", [math.hypot(*handle.xyz[:2]) for handle in rims])
        if not self.model:
            _alike(f"{key}.handles", "as high over the panel (z) as", [handle.xyz[2] for handle in rims])
            _alike(f"{key}.handles", "as wide as", [handle.width for handle in rims])
        before = self.marker.xyz[2] < self.panel.depth
        require(before, f"{key}.marker.xyz", f"before the panel, z below {self.panel.depth:g}", self.marker.xyz)
        if not self.model:
            words = f"at least {LOWEST_MARK:g} on handles that are made of these keys: the marks lie on them"
            high = self.marker.mark_height
            require(high >= LOWEST_MARK, f"{key}.marker.mark_height", words, high)
            front = self._front()
            words = f"before the valve's bars and spokes, z at most {front:.4g}: they hide it"
            require(self.fixed or self.marker.xyz[2] <= front + 1e-9, f"{key}.marker.xyz", words, self.marker.xyz)
        if self.fixed:
            off = math.hypot(*self.marker.xyz[:2])
            inner = math.ceil(1e3 * (self._outermost() + math.hypot(*self.marker.size) / 2)) / 1e3
            words = f"wheel: a panel's marker beside these handles, {inner:g} m off the axis, is not seen with them"
            require(inner <= FARTHEST, f"{key}.marker.carrier", words, self.marker.carrier)
            words = f"at least {inner:.3g} m off the axis on a panel: nearer to it the handles pass before it"
            require(off >= inner, f"{key}.marker.xyz", words, self.marker.xyz)
            words = f"at most {FARTHEST:g} m off the axis on a panel: the head sees marks and marker in one image"
            require(off <= FARTHEST, f"{key}.marker.xyz", words, self.marker.xyz)

    def _outermost(self) -> float:
        """How far from the axis the handles reach [m]."""
        return max(math.hypot(*h.xyz[:2]) + (h.width if h.kind == "rim" else h.length) / 2 for h in self.handles)

    def _front(self) -> float:
        """The front of what a valve made of these keys has before its marker, z of A; infinite: nothing [m]."""
        centre, half = np.array(self.marker.xyz[:2]), np.array(self.marker.size) / 2
        R = rot_z(self.marker.rpy[2])[:2, :2]
        fronts = [math.inf]
        for handle in self.handles:
            if handle.kind == "rim":
                inside = math.hypot(*centre) < math.hypot(*handle.xyz[:2])
                fronts += [handle.xyz[2] - SPOKE / 2] if self.spokes and inside else []
                continue
            way = np.linspace(0.0, 1.0, 50)[:, None] * np.array(handle.xyz[:2])
            off = np.abs((way - centre) @ R)
            if np.any(np.all(off < half + handle.width / 2, axis=1)):
                fronts.append(handle.xyz[2] - handle.width / 2)
        return min(fronts)

    @property
    def fixed(self) -> bool:
        """Whether the marker is on the panel: then it does not turn with the valve."""
        return self.marker.carrier == "panel"

    def look(self) -> np.ndarray | None:
        """Where the head looks, off the marker's middle, to see it and the marks, in V (3,) [m]; None: at it."""
        if not self.fixed:
            return None
        axis = self.X_VA()[:, 3]
        return axis * min(0.5, LOOK / float(np.linalg.norm(axis)))

    def seen_by(self, estimate: RectangleEstimate) -> bool:
        """Whether an estimate tells how the valve is turned: of a marker on the panel, if a green mark was seen."""
        return estimate.found and (estimate.angle_seen or not self.fixed)

    def place(self, X_V: np.ndarray, angle: float) -> np.ndarray:
        """The axis frame by the marker's pose X_V in any frame (3, 4), and the valve's angle by the green marks [rad].

        The angle counts only for a marker on the panel.
        """
        X_A = compose(X_V, self.X_VA())
        return turned(X_A, angle) if self.fixed else X_A

    def repeats(self, axis_known: bool) -> float:
        """The turn after which the valve looks the same to the cameras [rad].

        The rectangle repeats every quarter turn, with green marks that tell its axis every half. Of a marker on the
        panel the marks alone count.
        """
        if self.fixed:
            return 2 * math.pi / self._folds()
        return math.pi if axis_known else math.pi / 2

    def _folds(self) -> int:
        """How many turns about the axis bring handles to handles; 1: a whole one alone."""
        places = np.array([handle.xyz for handle in self.handles])
        for count in range(len(places), 1, -1):
            there = places @ rot_z(2 * math.pi / count).T
            if np.linalg.norm(there[:, None] - places[None], axis=2).min(1).max() < ALIKE:
                return count
        return 1

    @property
    def sense(self) -> float:
        """1 if counter-clockwise opens, else -1."""
        return OPENING[self.opens]

    def X_AV(self) -> np.ndarray:
        """The marker's frame in A -> (3, 4); of a marker on the panel, with the stem at zero."""
        roll, pitch, yaw = self.marker.rpy
        level = not any(self.marker.rpy)
        R = np.eye(3) if level else rot_z(yaw) @ rot_y(pitch) @ rot_x(roll)
        return make(R, np.array(self.marker.xyz))

    def X_VA(self) -> np.ndarray:
        return inverse(self.X_AV())

    def X_AP(self) -> np.ndarray:
        """The axis at the panel's surface, in A -> (3, 4)."""
        return make(np.eye(3), np.array([0.0, 0.0, self.panel.depth]))

    def target(self) -> Marker:
        """What the head's cameras look for: the rectangle and the green marks, in V, with the stem at zero."""
        X_VA, up = self.X_VA(), np.array([0.0, 0.0, -self.marker.mark_height])
        marks = [X_VA[:, :3] @ (np.array(handle.xyz) + up) + X_VA[:, 3] for handle in self.handles]
        along = [X_VA[:, :3] @ handle.direction() for handle in self.handles]
        places = np.round(np.array(marks), 12)
        return Marker(list(self.marker.size), places, X_VA if self.fixed else None, np.array(along))

    def grasp(self, handle: int, sign: float) -> np.ndarray:
        """X_AG of a hand at a handle -> (3, 4): z_G into the panel, x_G along the handle, its direction times `sign`.

        A parallel gripper holds the handle either way.
        """
        along, z = sign * self.handles[handle].direction(), np.array([0.0, 0.0, 1.0])
        R = np.column_stack([along, [-along[1], along[0], 0.0], z])
        return make(R + 0.0, np.array(self.handles[handle].xyz))

    def radius(self, handle: int) -> np.ndarray:
        """From the axis to a handle, across the axis, in A -> (2,) [m]."""
        return np.array(self.handles[handle].xyz[:2])


def heading(X_OA: np.ndarray, viewer: np.ndarray) -> float:
    """The direction on the floor in which a robot faces the valve: that of the axis, into the panel.

    An axis that is nearly upright has none: then it is the direction from the viewer's place (x, y) to the valve.
    """
    z = X_OA[:2, 2] if has_heading(X_OA) else X_OA[:2, 3] - viewer[:2]
    return math.atan2(z[1], z[0])


def has_heading(X_OA: np.ndarray) -> bool:
    """Whether the axis is not nearly upright."""
    return math.hypot(*X_OA[:2, 2]) >= _UPRIGHT


def turned(X_BA: np.ndarray, angle: float) -> np.ndarray:
    """The axis frame after the valve turned by `angle` (positive: counter-clockwise as seen from the robot)."""
    return compose(X_BA, make(rot_z(-angle), np.zeros(3)))


def angle_turned(X_BA0: np.ndarray, X_BA1: np.ndarray) -> float:
    """The angle turned from pose 0 to pose 1 about the common axis, in (-pi, pi]."""
    R = X_BA0[:, :3].T @ X_BA1[:, :3]
    return float(-np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
