"""The four sides of one image fitted together, up to the corners, with the covariance of what they tell.

`line_fitting` fits every side alone: its levels of light cost it a sixth to a quarter of what its pixels know of its
place, and the pixels at the corners, which know most of a short side's direction, go unused. Here one Gauss-Newton
step from there moves all sides at once, with what they share: one blur, and, where the sides' own levels do not
contradict it, one plane of light inside and one outside. Then the corners' pixels are added, in which two sides meet:

    I = base + height C(d_a / s, d_b / s; rho),

C the bivariate normal distribution: a wedge blurred by a Gaussian, rho the cosine between the sides' inward normals.

The result is what the pose needs of the image, and no more: the distances of eight points, two on each side at the
nodes of Gauss's rule, from where the sides are, with their joint information matrix.
"""

import dataclasses as dc

import numpy as np

from valve_drake.perception.marker import NEXT

_BEFORE = np.array([3, 0, 1, 2])
_MEETING = np.array([0, 1, 2, 3, 3, 0, 1, 2])
NODES = (1 - 1 / np.sqrt(3)) / 2, (1 + 1 / np.sqrt(3)) / 2  # of a side's length, from its first corner
# A side's own unknowns: two levels outside, two of the step, its shift, turn and bend, the blur. Common unknowns:
# plane outside (3), plane of the step (3), four shifts (3 each), the blur; _COMMON (4, 8, 19) makes a side's of them.
_COMMON = np.zeros((4, 8, 19))
_COMMON[:, [0, 2], [0, 3]] = _COMMON[:, 7, 18] = 1
for _k in range(4):
    _COMMON[_k, [4, 5, 6], [6 + 3 * _k, 7 + 3 * _k, 8 + 3 * _k]] = 1
_LEVELS, _BLUR = slice(0, 4), 7
_BENDS = [8, 11, 14, 17]  # of the four sides among the common unknowns
_UNEVEN = 2.5  # chi^2 per degree of freedom by which the sides' levels may contradict common planes
_ROWS = np.arange(8)  # of the nodes
_WINDOW = 7  # half the square of pixels looked at round a corner [px]
_SQUARE = np.mgrid[-_WINDOW : _WINDOW + 1, -_WINDOW : _WINDOW + 1][::-1].reshape(2, -1).T  # its pixels (n, 2)
_OUTSIDE = 2.0  # of a side: pixels used at a corner [px]
_SHORT = 2 * _WINDOW + 2  # sides below have no corner pixels of their own [px]
_CUT = 4.5  # a pixel further from the model is not the marker's [sigma]
_POOR = 2.5  # mean square of a corner's pixels above which it is covered or worn [sigma^2]
_SAMPLES = 16  # points on each side that stand for it
PRIOR_POINTS = 20  # how many points the noise of the grey values counts for, against the points' scatter


@dc.dataclass(frozen=True)
class Curves:
    """Sides as curves in one image: position across = start + slope t + basis(tau) . coefficient."""

    flat: np.ndarray  # (S,) t is the column u, else the row v
    inward: np.ndarray  # (S,) +-1: the way across that leads inside
    first: np.ndarray  # (S,) t of the first profile
    count: np.ndarray  # (S,) profiles
    start: np.ndarray  # (S,)
    slope: np.ndarray  # (S,)
    coefficient: np.ndarray  # (S, 3)

    def __getitem__(self, own: slice | np.ndarray) -> "Curves":
        return Curves(*(getattr(self, field.name)[own] for field in dc.fields(self)))

    def cosine(self) -> np.ndarray:
        return 1 / np.sqrt(1 + self.slope**2)

    def tau(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n): -1..1 from the first to the last profile."""
        return 2 * (t - self.first[:, None]) / (self.count[:, None] - 1.0) - 1

    def across(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n) [px]"""
        tau = self.tau(t)
        c = self.coefficient.T[:, :, None]
        return (self.start[:, None] + c[0] - c[2] / 3) + self.slope[:, None] * t + tau * (c[1] + tau * c[2])

    def points(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n, 2) [px]"""
        y, flat = self.across(t), self.flat[:, None]
        out = np.empty((*y.shape, 2))
        out[..., 0], out[..., 1] = np.where(flat, t, y), np.where(flat, y, t)
        return out

    def normals(self) -> np.ndarray:
        """(S, 2) unit, inward, at the middle."""
        both = np.stack([-self.slope, np.ones_like(self.slope)], -1) * (self.inward * self.cosine())[:, None]
        return np.where(self.flat[:, None], both, both[:, ::-1])


def basis(tau: np.ndarray) -> np.ndarray:
    """1, tau, and a bend that is nil at Gauss's nodes of -1..1."""
    out = np.empty((*tau.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = 1, tau, tau * tau - 1 / 3
    return out


@dc.dataclass(frozen=True)
class Sums:
    """What least squares needs of the profiles of S sides, about the fit so far."""

    normal: np.ndarray  # (S, 8, 8)
    right: np.ndarray  # (S, 8)
    square: np.ndarray  # (S,) of the residuals
    pixels: np.ndarray  # (S,)

    def __getitem__(self, own: slice) -> "Sums":
        return Sums(*(getattr(self, field.name)[own] for field in dc.fields(self)))


def sums(
    weight: np.ndarray,
    good: np.ndarray,
    rise: np.ndarray,
    gain: np.ndarray,
    z: np.ndarray,
    residual: np.ndarray,
    tau: np.ndarray,
) -> Sums:
    """weight, rise, gain, z, residual: (S, N, M) of each pixel; good, tau (S, N) of each profile."""
    S, N, M = weight.shape
    values = np.empty((S, 9, N, M), np.float32)  # the eight functions of a side, and the residual
    values[:, 0], values[:, 2], values[:, 8] = 1, rise, residual
    values[:, 1] = by_tau = np.broadcast_to(tau.astype(np.float32)[:, :, None], weight.shape).copy()
    np.negative(gain, out=values[:, 4])
    np.multiply(values[:, 2], by_tau, out=values[:, 3])
    np.multiply(values[:, 4], by_tau, out=values[:, 5])
    np.multiply(values[:, 4], by_tau * by_tau - np.float32(1 / 3), out=values[:, 6])
    np.multiply(values[:, 4], z, out=values[:, 7])
    weighted = values * (weight * good.astype(np.float32)[:, :, None])[:, None]
    products = (weighted.reshape(S, 9, -1) @ values.reshape(S, 9, -1).transpose(0, 2, 1)).astype(float)
    return Sums(
        normal=products[:, :8, :8],
        right=products[:, :8, 8],
        square=products[:, 8, 8],
        pixels=weighted[:, 0].sum((1, 2), dtype=float),
    )


def joint_fit(
    channel: np.ndarray,
    curves: Curves,
    level: np.ndarray,
    blur: float,
    seen: Sums,
    bend: np.ndarray,
    scatter: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Points (4, n, 2) [px] spread evenly on the sides, through which straight lines go once they are undistorted; and
    the information (8, 8) [1/px^2] of the distances inward of the sides at NODES.

    channel (H, W); curves of the four sides, level (4, 4) their own levels; seen, bend (4,): prior on each bend;
    scatter: chi^2 of the edge points about their sides times sigma^2, and its degrees of freedom. None where the
    light is not that of two planes, there are too few pixels to tell, or the sides do not meet.
    """
    middle = curves.points(curves.first[:, None] + (curves.count[:, None] - 1) * np.array([0.0, 0.5, 1.0]))
    halves = middle[:, 1]
    centre, size = halves.sum(0) / 4, (halves.max(0) - halves.min(0)).max()
    place = (middle - centre) / size
    T = _COMMON.copy()
    T[:, 0, 1:3] = T[:, 2, 4:6] = place[:, 1]
    T[:, 1, 1:3] = T[:, 3, 4:6] = (place[:, 2] - place[:, 0]) / 2
    to_levels = T[:, _LEVELS, :6].reshape(16, 6)
    planes = np.linalg.solve(to_levels.T @ to_levels, to_levels.T @ level.ravel())
    off = np.zeros((4, 8))
    off[:, _LEVELS] = level - (to_levels @ planes).reshape(4, 4)
    right = seen.right + (seen.normal @ off[:, :, None])[..., 0]
    flat_T = T.reshape(32, 19)
    H = flat_T.T @ (seen.normal @ T).reshape(32, 19)
    H[_BENDS, _BENDS] += bend
    b = flat_T.T @ right.ravel()
    step = np.linalg.solve(H, b)
    lost = float((off * (seen.right + right)).sum() - b @ step)

    apart = _apart(seen, bend)
    freedom = float(seen.pixels.sum()) - 29
    if freedom < 30:
        return None
    variance = (float(seen.square.sum()) + apart) / freedom
    if not 0 < lost - apart < 10 * _UNEVEN * variance:
        return None

    per_shift = (curves.inward / curves.cosine())[:, None]

    def moved(step: np.ndarray) -> Curves:
        shift = step[6:18].reshape(4, 3) * per_shift
        return dc.replace(curves, coefficient=curves.coefficient + shift)

    ends = _corners(moved(step))
    if not np.isfinite(ends).all():
        return None
    if ((ends[NEXT] - ends) ** 2).sum(1).min() > _SHORT**2:
        J, r = _corner_pixels(channel, moved(step), ends, planes + step[:6], blur + step[18], (centre, size), variance)
        H = H + J.T @ J
        step = step + np.linalg.solve(H, J.T @ r)
    final = moved(step)
    ends = _corners(final)
    starts, stops = (np.where(final.flat, p[:, 0], p[:, 1]) for p in (ends, ends[NEXT]))
    t = starts[:, None] + (stops - starts)[:, None] * np.array(NODES)
    K = np.zeros((8, 19))
    K[_ROWS, _ROWS // 2 * 3 + 6], K[_ROWS, _ROWS // 2 * 3 + 7] = 1, final.tau(t).ravel()  # undistorted, none has a bend
    chi2, n = scatter
    spread = (chi2 / variance + PRIOR_POINTS) / (n + PRIOR_POINTS)
    covariance = variance * spread * (K @ np.linalg.solve(H, K.T))
    even = curves.first[:, None] + (curves.count[:, None] - 1) * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return final.points(even), np.linalg.inv(covariance)


def _apart(seen: Sums, bend: np.ndarray) -> float:
    """By how much the sum of squares falls if every side has its own levels (negative)."""
    own = np.arange(7)
    N = seen.normal[:, :7, :7].copy()
    N[:, own, own] += 1e-9
    N[:, 6, 6] += bend
    both = np.stack([seen.right[:, :7], seen.normal[:, :7, _BLUR]], -1)
    reduced = np.linalg.solve(N, both)
    fall = (both[..., 0] * reduced[..., 0]).sum()
    g = (seen.right[:, _BLUR] - (both[..., 1] * reduced[..., 0]).sum(-1)).sum()
    h = (seen.normal[:, _BLUR, _BLUR] - (both[..., 1] * reduced[..., 1]).sum(-1)).sum()
    return -float(fall + g * g / h)


def _corners(curves: Curves) -> np.ndarray:
    """Where the sides meet, (4, 2) [px]."""
    ends = curves.points(curves.first[:, None] + (curves.count[:, None] - 1) * np.array([0.0, 1.0]))
    d = ends[:, 1] - ends[:, 0]
    lines = np.empty((4, 3))
    lines[:, 0], lines[:, 1] = -d[:, 1], d[:, 0]
    lines[:, 2] = -(lines[:, :2] * ends[:, 0]).sum(1)
    return meet(lines)


def meet(lines: np.ndarray) -> np.ndarray:
    """Corners (4, 2) of four sides (4, 3): corner k is where sides k - 1 and k meet."""
    a, b = lines[_BEFORE], lines
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    out = np.empty((4, 2))
    out[:, 0], out[:, 1] = ay * bz - az * by, az * bx - ax * bz
    with np.errstate(divide="ignore", invalid="ignore"):
        out /= (ax * by - ay * bx)[:, None]
    return out


def _corner_pixels(
    channel: np.ndarray,
    curves: Curves,
    ends: np.ndarray,
    planes: np.ndarray,
    blur: float,
    frame: tuple[np.ndarray, float],
    variance: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (n, 19) and residual (n,) of the pixels at the corners that no profile holds."""
    px = np.rint(ends).astype(int)[:, None] + _SQUARE  # (4, n, 2)
    sides = curves[_MEETING]  # those that begin at the corners, then those that end there
    flat, first = sides.flat[:, None], sides.first[:, None]
    u, v = np.concatenate([px, px]).transpose(2, 0, 1)
    t, y = np.where(flat, u, v), np.where(flat, v, u)  # (8, n)
    gap = (y - sides.across(t)) * (sides.inward * sides.cosine())[:, None]
    beyond = (t < first) | (t >= first + sides.count[:, None])
    near, far = np.minimum(gap[:4], gap[4:]), np.maximum(gap[:4], gap[4:])
    u, v = u[:4], v[:4]
    keep = (u >= 0) & (v >= 0) & (u < channel.shape[1]) & (v < channel.shape[0])
    keep &= beyond[:4] & beyond[4:] & (near > -_OUTSIDE) & (far > -1) & (near < 4)
    kept = np.flatnonzero(keep)
    corner = kept // len(_SQUARE)
    px = px.reshape(-1, 2)[kept]
    b, a = gap.reshape(2, -1)[:, kept] / blur
    along = basis(sides.tau(t).reshape(2, -1)[:, kept])
    normals = curves.normals()
    rho = (normals[_BEFORE] * normals).sum(1)[corner]
    cover, by_a, by_b = _wedge(a, b, rho)

    n = len(px)
    place = np.empty((n, 3))
    place[:, 0] = 1
    place[:, 1:] = (px - frame[0]) / frame[1]
    height = place @ planes[3:]
    J = np.zeros((n, 19))
    J[:, :3] = place
    np.multiply(place, cover[:, None], out=J[:, 3:6])
    scaled = height / -blur
    shifts = np.zeros((n, 4, 3))
    rows = np.arange(n)
    for values, slope, side in ((along[0], by_b, corner), (along[1], by_a, _BEFORE[corner])):
        shifts[rows, side] = (scaled * slope)[:, None] * values
    J[:, 6:18] = shifts.reshape(n, 12)
    J[:, 18] = scaled * (a * by_a + b * by_b)
    r = channel[px[:, 1], px[:, 0]] - place @ planes[:3] - height * cover
    chi2 = r * r / variance
    good = chi2 < _CUT**2
    n = np.bincount(corner, good, 4)
    mean = np.bincount(corner, good * chi2, 4) / np.maximum(n, 1)
    good &= ((mean < _POOR) & (n > 0.9 * np.bincount(corner, minlength=4)))[corner]
    return J[good], r[good]


def _wedge(a: np.ndarray, b: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P(x < a, y < b) of the bivariate normal distribution, to 1e-3 for |rho| < 0.5, and its exact derivatives."""
    root = np.sqrt(1 - rho**2)
    at = np.stack([a, b, (b - rho * a) / root, (a - rho * b) / root])
    density = _density(at)
    cdf = normal_cdf(at, density)
    series = 1 + rho / 2 * a * b + rho**2 / 6 * (a * a - 1) * (b * b - 1)
    cover = cdf[0] * cdf[1] + rho * density[0] * density[1] * series
    return cover, density[0] * cdf[2], density[1] * cdf[3]


def _density(z: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)


def normal_cdf(z: np.ndarray, density: np.ndarray | None = None) -> np.ndarray:
    """Phi(z), its density given or not (Abramowitz and Stegun 26.2.17, error < 8e-8)."""
    density = _density(z) if density is None else density
    u = np.abs(z)
    u *= 0.2316419
    u += 1
    np.reciprocal(u, out=u)
    tail = u * 1.330274429
    for c in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        tail += c
        tail *= u
    tail *= density
    np.subtract(0.5, tail, out=tail)
    return np.copysign(tail, z, out=tail) + z.dtype.type(0.5)
