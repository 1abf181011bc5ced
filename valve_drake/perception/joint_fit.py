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

_BEFORE = [3, 0, 1, 2]
NODES = (1 - 1 / np.sqrt(3)) / 2, (1 + 1 / np.sqrt(3)) / 2  # of a side's length, from its first corner
# A side's own unknowns: two levels outside, two of the step, its shift, turn and bend, the blur.
_FUNCTION = np.array([0, 0, 1, 1, 2, 2, 2, 3])  # 1, rise, d/d shift, d/d blur ...
_POWER = np.array([0, 1, 0, 1, 0, 1, 2, 0])  # ... times this function of the place along the side
_LEVELS, _BLUR = slice(0, 4), 7
_BENDS = [8, 11, 14, 17]  # of the four sides among the common unknowns
_UNEVEN = 2.5  # chi^2 per degree of freedom by which the sides' levels may contradict common planes
_WINDOW = 7  # half the square of pixels looked at round a corner [px]
_OUTSIDE = 2.0  # of a side: pixels used at a corner [px]
_SHORT = 2 * _WINDOW + 2  # sides below have no corner pixels of their own [px]
_CUT = 4.5  # a pixel further from the model is not the marker's [sigma]
_POOR = 2.5  # mean square of a corner's pixels above which it is covered or worn [sigma^2]
_SAMPLES = 16  # points on each side that stand for it
_PRIOR_POINTS = 20  # how many points the pixels' noise counts for against the points' scatter


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

    def basis(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n, 3) of tau, -1..1 from the first to the last profile."""
        return basis(2 * (t - self.first[:, None]) / (self.count[:, None] - 1.0) - 1)

    def across(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n) [px]"""
        return self.start[:, None] + self.slope[:, None] * t + (self.basis(t) @ self.coefficient[:, :, None])[..., 0]

    def points(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n, 2) [px]"""
        both = np.stack([t, self.across(t)], -1)
        return np.where(self.flat[:, None, None], both, both[..., ::-1])

    def normals(self) -> np.ndarray:
        """(S, 2) unit, inward, at the middle."""
        both = np.stack([-self.slope, np.ones_like(self.slope)], -1) * (self.inward * self.cosine())[:, None]
        return np.where(self.flat[:, None], both, both[:, ::-1])


def basis(tau: np.ndarray) -> np.ndarray:
    """1, tau, and a bend that is nil at Gauss's nodes of -1..1."""
    return np.stack([np.ones_like(tau), tau, tau**2 - 1 / 3], -1)


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
    functions = (None, rise, -gain, -gain * z)

    def dot(a: np.ndarray, b: np.ndarray | None) -> np.ndarray:
        return good * (a.sum(-1) if b is None else np.einsum("snm,snm->sn", a, b))

    gram = np.empty((4, 4, *good.shape))
    right = np.empty((4, *good.shape))
    for i, f in enumerate(functions):
        weighted = weight if f is None else weight * f
        right[i] = dot(weighted, residual)
        for j in range(i + 1):
            gram[i, j] = gram[j, i] = dot(weighted, functions[j])
    powers = basis(tau)[:, :, _POWER]
    return Sums(
        normal=np.einsum("ijsn,sni,snj->sij", gram[np.ix_(_FUNCTION, _FUNCTION)], powers, powers),
        right=np.einsum("isn,sni->si", right[_FUNCTION], powers),
        square=dot(weight * residual, residual).sum(-1),
        pixels=dot(weight, None).sum(-1),
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
    light is not that of two planes.
    """
    middle = curves.points(curves.first[:, None] + (curves.count[:, None] - 1) * np.array([0.0, 0.5, 1.0]))
    centre, size = middle[:, 1].mean(0), np.ptp(middle[:, 1], axis=0).max()
    place = (middle - centre) / size
    # Common unknowns: plane outside (3), plane of the step (3), four shifts (3 each), the blur.
    T = np.zeros((4, 8, 19))
    T[:, [0, 2], [0, 3]] = 1
    T[:, 0, 1:3] = T[:, 2, 4:6] = place[:, 1]
    T[:, 1, 1:3] = T[:, 3, 4:6] = (place[:, 2] - place[:, 0]) / 2
    for k in range(4):
        T[k, [4, 5, 6], [6 + 3 * k, 7 + 3 * k, 8 + 3 * k]] = 1
    T[:, 7, 18] = 1
    planes = np.linalg.lstsq(T[:, _LEVELS, :6].reshape(16, 6), level.ravel(), rcond=None)[0]
    off = np.zeros((4, 8))
    off[:, _LEVELS] = level - T[:, _LEVELS, :6] @ planes
    right = seen.right + (seen.normal @ off[:, :, None])[..., 0]
    H = (T.transpose(0, 2, 1) @ seen.normal @ T).sum(0)
    H[_BENDS, _BENDS] += bend
    b = (T.transpose(0, 2, 1) @ right[:, :, None]).sum((0, 2))
    step = np.linalg.solve(H, b)
    lost = float((off * (seen.right + right)).sum() - b @ step)

    apart = _apart(seen, bend)
    freedom = float(seen.pixels.sum()) - 29
    if freedom < 30:
        return None
    variance = (float(seen.square.sum()) + apart) / freedom
    if not 0 < lost - apart < 10 * _UNEVEN * variance:
        return None

    def moved(step: np.ndarray) -> Curves:
        shift = step[6:18].reshape(4, 3) * (curves.inward / curves.cosine())[:, None]
        return dc.replace(curves, coefficient=curves.coefficient + shift)

    ends = _corners(moved(step))
    if not np.isfinite(ends).all():
        return None
    lengths = np.linalg.norm(ends[NEXT] - ends, axis=1)
    if lengths.min() > _SHORT:
        J, r = _corner_pixels(channel, moved(step), ends, planes + step[:6], blur + step[18], (centre, size), variance)
        H = H + J.T @ J
        step = step + np.linalg.solve(H, J.T @ r)
    final = moved(step)
    ends = _corners(final)
    starts, stops = (np.where(final.flat, p[:, 0], p[:, 1]) for p in (ends, ends[NEXT]))
    t = starts[:, None] + (stops - starts)[:, None] * np.array(NODES)
    K = np.zeros((8, 19))
    for k, values in enumerate(final.basis(t)):  # undistorted, a side has no bend
        K[2 * k : 2 * k + 2, 6 + 3 * k : 8 + 3 * k] = values[:, :2]
    chi2, n = scatter
    spread = (chi2 / variance + _PRIOR_POINTS) / (n + _PRIOR_POINTS)
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
    normal = np.stack([-d[:, 1], d[:, 0]], -1)
    return meet(np.column_stack([normal, -(normal * ends[:, 0]).sum(1)]))


def meet(lines: np.ndarray) -> np.ndarray:
    """Corners (4, 2) of four sides (4, 3): corner k is where sides k - 1 and k meet."""
    a, b = lines[_BEFORE], lines
    w = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([x, y], -1) / w[:, None]


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
    grid = np.arange(-_WINDOW, _WINDOW + 1)
    offsets = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    px = np.rint(ends).astype(int)[:, None] + offsets  # (4, n, 2)
    keep = ((px >= 0) & (px < [channel.shape[1], channel.shape[0]])).all(-1)
    both = (curves[np.array(_BEFORE)], curves)
    d, where = [], []
    for side in both:
        t = np.where(side.flat[:, None], px[..., 0], px[..., 1])
        y = np.where(side.flat[:, None], px[..., 1], px[..., 0])
        keep &= (t < side.first[:, None]) | (t >= (side.first + side.count)[:, None])
        d.append((y - side.across(t)) * (side.inward * side.cosine())[:, None])
        where.append(side.basis(t))
    near, far = np.minimum(*d), np.maximum(*d)
    keep &= (near > -_OUTSIDE) & (far > -1) & (near < 4)
    corner, pixel = np.nonzero(keep)
    px = px[corner, pixel]
    a, b = d[0][corner, pixel] / blur, d[1][corner, pixel] / blur
    normals = curves.normals()
    rho = (normals[_BEFORE] * normals).sum(1)[corner]
    cover, by_a, by_b = _wedge(a, b, rho)

    place = np.column_stack([np.ones(len(px)), (px - frame[0]) / frame[1]])
    height = place @ planes[3:]
    J = np.zeros((len(px), 19))
    J[:, :3], J[:, 3:6] = place, place * cover[:, None]
    rows = np.arange(len(px))[:, None]
    for k, (slope, at) in enumerate(((by_a, where[0]), (by_b, where[1]))):
        side = (corner + 3 + k) % 4
        J[rows, 6 + 3 * side[:, None] + np.arange(3)] = (-height * slope / blur)[:, None] * at[corner, pixel]
    J[:, 18] = -height * (a * by_a + b * by_b) / blur
    r = channel[px[:, 1], px[:, 0]] - place @ planes[:3] - height * cover
    chi2 = r * r / variance
    good = chi2 < _CUT**2
    n = np.bincount(corner, good, 4)
    mean = np.bincount(corner, good * chi2, 4) / np.maximum(n, 1)
    good &= ((mean < _POOR) & (n > 0.9 * np.bincount(corner, minlength=4)))[corner]
    return J[good], r[good]


def _wedge(a: np.ndarray, b: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P(x < a, y < b) of the bivariate normal distribution, to 1e-3 for |rho| < 0.5, and its exact derivatives."""
    A, B = normal_cdf(a), normal_cdf(b)
    bell = _density(a) * _density(b)
    cover = A * B + rho * bell * (1 + rho / 2 * a * b + rho**2 / 6 * (a * a - 1) * (b * b - 1))
    root = np.sqrt(1 - rho**2)
    return cover, _density(a) * normal_cdf((b - rho * a) / root), _density(b) * normal_cdf((a - rho * b) / root)


def _density(z: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)


def normal_cdf(z: np.ndarray, density: np.ndarray | None = None) -> np.ndarray:
    """Phi(z), its density given or not (Abramowitz and Stegun 26.2.17, error < 8e-8)."""
    density = _density(z) if density is None else density
    a = np.abs(z)
    u = 1 / (1 + 0.2316419 * a)
    poly = u * (0.319381530 + u * (-0.356563782 + u * (1.781477937 + u * (-1.821255978 + u * 1.330274429))))
    tail = density * poly
    return np.where(z >= 0, 1 - tail, tail)
