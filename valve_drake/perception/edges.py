"""Following the edge of each side, from coarse lines to one edge point a profile.

Every image column (or row, for an upright side) that crosses a side is one short profile of untouched pixels
(perception/edge_profiles.py). A blurred step, b + A Phi(d / s) of the distance d from the side, is fitted to all of
them together: levels (with a linear trend along the side), blur s, and the side as a smooth curve. One Gauss-Newton
step per profile from there gives that profile's own edge point. No pixel is interpolated or used twice, so the points'
errors are independent, but for the side's levels, whose share `kept_share` tells.

Arrays: Q quadrilaterals, S = 4 Q sides, M pixels across, N profiles along.
"""

import dataclasses as dc

import numpy as np

from valve_drake.config import Config, number, plain
from valve_drake.perception.edge_profiles import ROW, Sheet, Terms, gram, moments, normal_cdf, normal_density
from valve_drake.perception.joint_fit import Curves, basis
from valve_drake.perception.marker import NEXT

# 1, tau, rise, tau rise, bell, tau bell, and the grey value.
_LEVEL_TERMS = Terms((0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1), (4, 0))
# Of the levels' unknowns, in their order: a short side shows no trend, which is held near zero there.
_LEVEL_PRIOR = np.diag([1e-9, 0.1, 1e-9, 0.1, 1e-6, 1e-6])
# Of a curve's offset, turn and bend; the bend's is set for each side.
_CURVE_PRIOR, _BEND = np.diag([1e-9, 1e-9, 0.0]), np.diag([0.0, 0.0, 1.0])
_MIN_HALF_WINDOW = 2  # of a profile at a side's ends, where the light plate is narrowest [px]
_PIXELS_PER_STEP = 2.5  # the half window grows by one pixel every 2.5 px away from a corner
_COARSE_PROFILES = 30  # long sides are subsampled to this many until the last iteration; raise it for noisy images
START_BLUR = 0.8  # of the fit: a lens in focus, and the pixel itself [px]


@dc.dataclass
class SidesConfig(Config):
    """How the sides of one quadrilateral are fitted."""

    KEY = "handle_marker.lines"
    half_window: int = number(8, 3, 20, "of a profile; shorter on small quadrilaterals and towards the corners [px]")
    reach: float = number(
        0.15, 0.02, 0.5, "of half a profile over the quadrilateral's width, at most; the surroundings are plain there"
    )
    trim: float = number(2.5, 0.0, 20.0, "of a side at each corner, beyond the profile's reach [px]")
    gamma: float = number(
        1.0, 0.3, 4.0, "light = value^gamma; 1 if pixel values are linear in light, 2.2 for ordinary cameras"
    )
    iterations: int = number(5, 2, 20, "of the fit of each side")
    together: bool = plain(True, "all sides and their corners are fitted once more with what they share")
    max_sigma: float = number(0.4, 0.01, 5.0, "scatter of the edge points about the side [px]")
    min_contrast: float = number(10.0, 1.0, 255.0, "between inside and outside [grey levels, over all channels]")
    min_share: float = number(0.5, 0.1, 1.0, "of a side's profiles that must fit")
    color_only: bool = plain(
        False, "compare colours and not brightness: for a mark whose surroundings are bright and dark"
    )


@dc.dataclass(frozen=True)
class Sides:
    """The profiles of the four sides of Q quadrilaterals before the fit: everything (Q, 4), half (Q,)."""

    flat: np.ndarray  # profiles are columns of the image (t is u), else rows (t is v)
    first: np.ndarray  # t of the first profile
    count: np.ndarray  # profiles
    start: np.ndarray  # position across the side at t = 0 ...
    slope: np.ndarray  # ... and its change with t
    inward: np.ndarray  # +-1: the way across the side that leads inside
    half: np.ndarray  # of a profile [px]

    def __getitem__(self, own: np.ndarray | slice) -> "Sides":
        return Sides(*(values[own] for values in vars(self).values()))


def place(sheet: Sheet, corners: np.ndarray, config: SidesConfig, least: float = 0.0) -> tuple[Sides, list[str]]:
    """Lays the profiles across the sides of coarse quadrilaterals (Q, 4, 2); and why it cannot, or "", for each.

    least: half a profile's length that blur calls for, if the opposite side is far enough [px].
    """
    ends = corners[:, NEXT]
    along = ends - corners
    lengths = np.sqrt((along * along).sum(2))
    flat = np.abs(along[:, :, 0]) >= np.abs(along[:, :, 1])

    def by_side(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Along and across each side."""
        u, v = points[:, :, 0], points[:, :, 1]
        return np.where(flat, u, v), np.where(flat, v, u)

    (begin_t, begin_y), (end_t, end_y), (middle_t, middle_y) = map(by_side, (corners, ends, corners.mean(1)[:, None]))
    slope = (end_y - begin_y) / np.where(lengths > 0, end_t - begin_t, 1)
    cosine = 1 / np.sqrt(1 + slope**2)
    # A profile must reach neither the opposite side nor the rim of the light plate round the marker.
    one, other = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    width = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2 / np.maximum(lengths.max(1), 1e-9)
    half = np.minimum(np.maximum(np.rint(config.reach * width), 3), config.half_window)
    half = np.maximum(half, np.minimum(least, 0.3 * width)).astype(int)
    reach = np.maximum(config.trim, np.minimum(0.15 * lengths, 3.0)) + _MIN_HALF_WINDOW * np.abs(slope) * cosine
    reach *= cosine
    (low_t, _), (high_t, _) = by_side(sheet.low[:, None]), by_side(sheet.high[:, None])
    first = np.maximum(np.ceil(np.minimum(begin_t, end_t) + reach), low_t).astype(int)
    count = np.minimum(np.floor(np.maximum(begin_t, end_t) - reach), high_t).astype(int) - first + 1
    reasons = []
    for shortest, counts in zip(lengths.min(1), count):
        short = f"side {int(np.argmin(counts))} short" if counts.min() < 3 else ""
        reasons.append("small" if shortest < 4 else short)
    start = begin_y - slope * begin_t
    inward = np.sign(middle_y - (begin_y + end_y) / 2)
    return Sides(flat, first, count, start, slope, inward, half), reasons


@dc.dataclass(frozen=True)
class Followed:
    """Where the sides' edges were found to be, (S,) or (S, N) for every profile."""

    curves: Curves
    bend: np.ndarray  # prior on each side's bend
    has_step: np.ndarray  # there was one of enough height at every iteration
    t: np.ndarray  # of the profiles
    edge: np.ndarray  # position across of each profile's own edge
    good: np.ndarray  # 1 where a profile belongs to its side
    off: np.ndarray  # of its edge from the side's curve, along the normal [px]
    expected: np.ndarray  # variance of that, by the noise of the grey values [px^2]
    strength: np.ndarray  # what its pixels know of its edge's place, times the grey values' variance [1/px^2]
    tau: np.ndarray
    products: np.ndarray  # (S, 15, N), see `gram`
    level: np.ndarray  # (S, 4)
    normal: np.ndarray  # (S, 6, 6), see `_levels`
    width: np.ndarray  # blur that the last step was linear about [px] ...
    blur: np.ndarray  # ... and the one found


@dc.dataclass(frozen=True)
class _Layout:
    """Where all profiles of all sides are, (S,), (S, 1) or (S, N)."""

    pixels: np.ndarray  # of the sheet, row after row
    curves: Curves  # with the first straight lines
    by_t: np.ndarray  # pixel (t, y) of a side is at t by_t + y by_y
    by_y: np.ndarray
    low: np.ndarray  # first and last pixel across that belong to the cut-out
    high: np.ndarray
    across: np.ndarray  # (M, 1) float32 of a profile's pixels, from its middle [px]
    offset: np.ndarray  # (S, M, 1) of them in `pixels`
    t: np.ndarray
    tau: np.ndarray  # -1..1
    powers: np.ndarray  # (S, 3, N), see `basis`
    used: np.ndarray  # 1 for a profile, 0 for what fills up a shorter side's row
    room: np.ndarray  # half a profile's length, of which the last pixel counts by the fraction [px]
    line: np.ndarray  # position across of the first straight line

    @classmethod
    def of(cls, sheet: Sheet, sides: Sides) -> "_Layout":
        Q = len(sides.half)
        flat, first, count, start, slope, inward = (
            getattr(sides, name).ravel() for name in ("flat", "first", "count", "start", "slope", "inward")
        )
        wide = sheet.pixels.shape[1]
        low, high = (
            np.repeat(ends, 4, axis=0)[np.arange(4 * Q), flat.astype(int), None] for ends in (sheet.low, sheet.high)
        )
        half = np.repeat(sides.half, 4)[:, None]
        reach = int(half.max()) + 1
        across = np.arange(-reach, reach + 1)[:, None]
        by_y = np.where(flat, wide, 1)[:, None]
        k = np.arange(count.max())
        t = first[:, None] + k
        from_end = np.minimum(k, count[:, None] - 1 - k)
        used = (from_end >= 0).astype(float)
        tau = 2 * k / (count[:, None] - 1.0) - 1
        return cls(
            pixels=sheet.pixels.ravel(),
            curves=Curves(
                flat, inward, first, count, start, slope, np.zeros((len(count), 3)), 1 / np.sqrt(1 + slope**2)
            ),
            by_t=np.where(flat, 1, wide)[:, None],
            by_y=by_y,
            low=low,
            high=high,
            across=across.astype(np.float32),
            offset=by_y[:, None] * across,
            t=t,
            tau=tau,
            powers=basis(tau),
            used=used,
            room=used * (half + 1 - np.maximum(half - _MIN_HALF_WINDOW - from_end / _PIXELS_PER_STEP, 0)),
            line=start[:, None] + slope[:, None] * t,
        )

    def every(self, stride: int, coefficient: np.ndarray) -> "_Profiles":
        """Every stride-th profile of each side, about the curve that is known so far."""
        some = np.s_[:, ::stride]
        line, powers = self.line[some], self.powers[:, :, ::stride]
        middle = np.rint(line + (coefficient[:, None] @ powers)[:, 0])
        at = self.t[some] * self.by_t + middle.astype(int) * self.by_y
        functions = np.empty((len(line), 5, len(self.across), at.shape[1]), np.float32)
        functions[:, 0] = 1
        functions[:, 4] = self.pixels.take(at[:, None] + self.offset, mode="clip")
        return _Profiles(self.used[some], self.tau[some], self.room[some], line, middle, functions, powers)


@dc.dataclass
class _Profiles:
    """The profiles that a step of the fit looks at, (S, N)."""

    used: np.ndarray
    tau: np.ndarray
    room: np.ndarray  # shrinks where a step comes near the cut-out's border
    line: np.ndarray
    middle: np.ndarray  # pixel across that each is centred on
    functions: np.ndarray  # (S, 5, M, N) float32, see `gram`
    powers: np.ndarray  # (S, 3, N)


def follow(sheet: Sheet, sides: Sides, config: SidesConfig) -> Followed:
    """The edge of each side, followed from its first straight line until a step would move it by no more than noise.

    Raises LinAlgError if the light beside a side does not determine its levels.
    """
    layout = _Layout.of(sheet, sides)
    curves = layout.curves
    # On long sides the way there is found with some of the profiles, and the last step is made with all of them.
    stride = max(int(curves.count.min()) // _COARSE_PROFILES, 1)
    profiles = layout.every(stride, curves.coefficient)
    bend = np.where(curves.count >= 24, 1e-9, 1e9)  # short sides show no curvature of the lens
    good, blur, last = profiles.used, np.full(len(bend), START_BLUR), False
    has_step = np.full(len(bend), True)
    for iteration in range(config.iterations):
        if last and stride > 1:
            profiles = layout.every(1, curves.coefficient)
            good = profiles.used * good[:, np.arange(curves.count.max()) // stride]
        curve, products = _products(layout, profiles, curves, blur)
        level, normal = _levels(moments(products, good, profiles.tau, _LEVEL_TERMS))
        has_step &= level[:, 2] >= 0.3
        own = _own_steps(products, level, profiles.tau, blur)
        width = blur  # that this step is linear about
        blur, change = _next_blur(own, products, good, blur)
        typical = _median(own.square, profiles.used)[:, None]
        good = profiles.used * (own.square < 6 * typical + 4e-4)
        good *= own.strength > 0.2 * own.strength.max(1, keepdims=True)
        moved = (curves.inward / curves.cosine)[:, None] * within(own.shift, -1.5, 1.5)
        expected = typical / own.strength
        rounds = 2 if last else 1  # outliers are looked for once the model is near
        step, smooth, good = _smooth(profiles.powers, moved, good, bend, np.sqrt(expected), rounds)
        if last:
            break
        curves = dc.replace(curves, coefficient=curves.coefficient + step)
        # The next step is about a tenth of this one, and what it leaves a thousandth: the model is odd about the edge.
        settled = np.abs(profiles.used * smooth).max() < 0.5 and np.abs(change).max() < 0.25
        last = settled or iteration == config.iterations - 2
    return Followed(
        curves=curves,
        bend=bend,
        has_step=has_step,
        t=layout.t,
        edge=curve + moved,
        good=good,
        off=(moved - smooth) * curves.cosine[:, None],
        expected=expected,
        strength=own.strength,
        tau=profiles.tau,
        products=products,
        level=level,
        normal=normal,
        width=width,
        blur=blur,
    )


def _products(layout: _Layout, profiles: _Profiles, curves: Curves, blur: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position across of each profile's curve (S, N), and the products (S, 15, N) of its pixels about it, see `gram`.

    float32, and written into the profiles' own arrays: here an iteration passes over every pixel, and this is most of
    the time of a fit.
    """
    curve = profiles.line + (curves.coefficient[:, None] @ profiles.powers)[:, 0]
    z = (profiles.middle - curve).astype(np.float32)[:, None] + layout.across
    # Nothing counts beyond the cut-out's border; and no pixel enters or leaves at once.
    profiles.room = np.minimum(profiles.room, np.minimum(curve - layout.low, layout.high - curve) + 1)
    weight = profiles.room.astype(np.float32)[:, None] - np.abs(z)
    within(weight, 0, 1, out=weight)
    z *= (curves.inward * curves.cosine / blur).astype(np.float32)[:, None, None]
    _, rise, bell, z_bell, _ = profiles.functions.swapaxes(0, 1)
    normal_density(z, out=bell)
    normal_cdf(z, bell, out=rise)
    np.multiply(z, bell, out=z_bell)
    return curve, gram(weight, profiles.functions)


@dc.dataclass(frozen=True)
class _OwnSteps:
    """One Gauss-Newton step of each profile's own edge, the side's levels being given; (S, N)."""

    left: np.ndarray  # (S, 5, N) what is left of the grey values, by each function
    gain: np.ndarray  # height of the step over the blur
    shift: np.ndarray  # of the edge, along the inward normal [px]
    strength: np.ndarray  # information on that, times the variance of the grey values [1/px^2]
    square: np.ndarray  # mean square of the grey values after the step


def _own_steps(products: np.ndarray, level: np.ndarray, tau: np.ndarray, blur: np.ndarray) -> _OwnSteps:
    base, height = level[:, 0:1] + level[:, 1:2] * tau, level[:, 2:3] + level[:, 3:4] * tau
    height = np.maximum(height, 0.05)
    left = products[:, ROW[4]] - base[:, None] * products[:, ROW[0]] - height[:, None] * products[:, ROW[1]]
    gain = height / blur[:, None]
    strength = gain * gain * products[:, ROW[2][2]] + 1e-12
    shift = -gain * left[:, 2] / strength  # what is left by the bell is what a shift of the edge would take
    square = left[:, 4] - base * left[:, 0] - height * left[:, 1] - strength * shift * shift
    square /= np.maximum(products[:, ROW[0][0]], 1)
    return _OwnSteps(left, gain, shift, strength, square)


def _next_blur(
    own: _OwnSteps, products: np.ndarray, good: np.ndarray, blur: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The blur (S,) after its Gauss-Newton step, the same for the four sides of a quadrilateral, and that step [px]."""

    def by_quad(values: np.ndarray) -> np.ndarray:
        return np.repeat(values.reshape(len(blur) // 4, -1).sum(1), 4)

    by_z = good * own.gain  # -d model / d blur is this times z bell
    wrong = by_z * (own.left[:, 3] + own.gain * own.shift * products[:, ROW[2][3]])
    scale = by_z * own.gain * products[:, ROW[3][3]]
    change = by_quad(wrong) / np.maximum(by_quad(scale), 1e-12)
    return within(blur - within(change, -0.5, 0.5), 0.35, 3.0), change


def within(x: np.ndarray, low: float, high: float, out: np.ndarray | None = None) -> np.ndarray:
    """np.clip, which takes three times as long on small arrays."""
    return np.minimum(np.maximum(x, low, out=out), high, out=out)


def _levels(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of f = (b0 + b1 tau) + (a0 + a1 tau) rise + (c0 + c1 tau) bell -> (S, 4): b0, b1, a0, a1.

    products (S, 7, 7): of the functions and f by each other. The bell's share is what a shift and a turn of the side
    would change. Without it the levels would take part of a wrong start for themselves, and the fit would creep.
    And the normal matrix (S, 6, 6) of all six.
    """
    normal = products[:, :6, :6] + _LEVEL_PRIOR
    return np.linalg.solve(normal, products[:, :6, 6:])[:, :4, 0], normal


def kept_share(normal: np.ndarray) -> np.ndarray:
    """(S,): the share of what the pixels know of a side's shift that is left, since they must tell its levels as well.

    All points of a side share the levels' error, so their scatter does not show it. normal: see `_levels`.
    """
    levels, bells = normal[:, :4, :4], normal[:, :4, 4:]
    taken = (bells * np.linalg.solve(levels, bells)).sum(1)
    whole = normal[:, 4:, 4:].diagonal(axis1=1, axis2=2)
    return within(1 - (taken / whole).sum(1) / 2, 0.1, 1.0)


def _median(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Upper median of the used entries in each row: (S, N), (S, N) -> (S,)."""
    S, N = values.shape
    known = used > 0
    ordered = np.where(known, values, np.inf)
    ordered.sort(axis=1)
    return ordered.take(np.arange(0, S * N, N) + np.minimum(known.sum(1) // 2, N - 1))


def _smooth(
    basis: np.ndarray, moved: np.ndarray, good: np.ndarray, bend: np.ndarray, noise: np.ndarray, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robust curve through the profiles' shifts (S, N): its coefficients, its values, and which profiles belong to it.

    basis (S, 3, N).
    """
    prior = _CURVE_PRIOR + bend[:, None, None] * _BEND
    both = np.concatenate([basis, moved[:, None]], 1).transpose(0, 2, 1)
    for _ in range(rounds):
        products = (basis * good[:, None]) @ both
        c = np.linalg.solve(products[:, :, :3] + prior, products[:, :, 3:])
        value = (c.transpose(0, 2, 1) @ basis)[:, 0]
        off = np.abs(moved - value)
        spread = 1.48 * _median(off, good)[:, None]
        good = good * (off < 4 * np.maximum(noise, spread) + 0.02)
    return c[:, :, 0], value, good
