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

from valve_drake.perception.edge_profiles import Sheet, Terms, moments, normal_cdf, normal_density
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import BEFORE, meet

_FOUR = np.arange(4)
NODES = (1 - 1 / np.sqrt(3)) / 2, (1 + 1 / np.sqrt(3)) / 2  # of a side's length, from its first corner
# A side's own unknowns: two levels outside, two of the step, its shift, turn and bend, the blur. Common unknowns:
# plane outside (3), plane of the step (3), four shifts (3 each), the blur; _COMMON (4, 8, 19) makes a side's of them.
_COMMON = np.zeros((4, 8, 19))
_COMMON[:, [0, 2], [0, 3]] = _COMMON[:, 7, 18] = 1
for _k in range(4):
    _COMMON[_k, [4, 5, 6], [6 + 3 * _k, 7 + 3 * _k, 8 + 3 * _k]] = 1
# Of the five functions of `gram`, by powers of tau: what the eight unknowns of a side and the residual are made of.
_TERMS = Terms((0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2), (2, 3), (3, 0), (3, 1), (4, 0))
_LEVELS, _BEND, _BLUR = slice(0, 4), 6, 7
_RIDGE = 1e-9 * np.eye(7)
_MAX_LEVEL_CHI2 = 2.5  # per degree of freedom, by which the sides' levels may contradict common planes of light
_NODES, _ROWS = np.array(NODES), np.arange(8)  # of the nodes
_WINDOW = 7  # half the square of pixels looked at round a corner [px]
_WINDOW_PIXELS = np.mgrid[-_WINDOW : _WINDOW + 1, -_WINDOW : _WINDOW + 1][::-1].reshape(2, -1)  # its pixels (2, n)
_CORNER_MARGIN = 2.0  # of a side: pixels used at a corner [px]
_MIN_CORNER_SIDE = 2 * _WINDOW + 2  # sides below have no corner pixels of their own [px]
_MAX_PIXEL_SIGMAS = 4.5  # a pixel further from the model is not the marker's [sigma]
_MAX_CORNER_CHI2 = 2.5  # mean square of a corner's pixels above which it is covered or worn [sigma^2]
_MIN_BLUR_RATIO = 0.5  # least share of the blur that one step may leave: further off the model is not linear
_EVEN_TAU = (np.arange(16) + 0.5) / 8 - 1  # tau of the points on each side that stand for it
_ENDS, _ENDS_AND_MIDDLE = np.array([-1.0, 1.0]), np.array([-1.0, 0.0, 1.0])
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
    cosine: np.ndarray  # (S,) between the image's axis across and the side's normal

    def __getitem__(self, own: np.ndarray | slice) -> "Curves":
        return Curves(*(values[own] for values in vars(self).values()))

    def tau(self, t: np.ndarray) -> np.ndarray:
        """(S, n) -> (S, n): -1..1 from the first to the last profile."""
        return 2 * (t - self.first[:, None]) / (self.count[:, None] - 1.0) - 1

    def across(self, t: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """(S, n), and the same as `tau` -> (S, n) [px]"""
        c = self.coefficient.T[:, :, None]
        return (self.start[:, None] + c[0] - c[2] / 3) + self.slope[:, None] * t + tau * (c[1] + tau * c[2])

    def points(self, tau: np.ndarray) -> np.ndarray:
        """(n,) -> (S, n, 2) [px]"""
        t = self.first[:, None] + (self.count[:, None] - 1) * ((tau + 1) / 2)
        y, flat = self.across(t, tau), self.flat[:, None]
        out = np.empty((*y.shape, 2))
        out[..., 0], out[..., 1] = np.where(flat, t, y), np.where(flat, y, t)
        return out

    def normals(self) -> np.ndarray:
        """(S, 2) unit, inward, at the middle."""
        both = np.stack([-self.slope, np.ones_like(self.slope)], -1) * (self.inward * self.cosine)[:, None]
        return np.where(self.flat[:, None], both, both[:, ::-1])


def basis(tau: np.ndarray) -> np.ndarray:
    """1, tau, and a bend that is nil at Gauss's nodes of -1..1: (..., n) -> (..., 3, n)."""
    out = np.empty((*tau.shape[:-1], 3, tau.shape[-1]))
    out[..., 0, :], out[..., 1, :], out[..., 2, :] = 1, tau, tau * tau - 1 / 3
    return out


@dc.dataclass(frozen=True)
class Sums:
    """What least squares needs of the profiles of S sides, about the fit so far."""

    normal: np.ndarray  # (S, 8, 8)
    right: np.ndarray  # (S, 8)
    square: np.ndarray  # (S,) of the residuals
    pixels: np.ndarray  # (S,)

    def __getitem__(self, own: np.ndarray | slice) -> "Sums":
        return Sums(*(values[own] for values in vars(self).values()))


def sums(products: np.ndarray, good: np.ndarray, tau: np.ndarray, level: np.ndarray, blur: np.ndarray) -> Sums:
    """products (S, 15, N): see `gram`; good, tau (S, N) of each profile; level (S, 4), blur (S,) it is linear about."""
    g0, g1 = level[:, 2] / blur, level[:, 3] / blur  # of the step's height, over the blur
    # The eight functions of a side, and the residual, in terms of _TERMS.
    F = np.zeros((len(tau), 9, len(_TERMS.row)))
    F[:, _FOUR, _FOUR] = F[:, 8, 10] = 1
    F[:, 4, 4] = F[:, 5, 5] = F[:, 6, 6] = -g0
    F[:, 4, 5] = F[:, 5, 6] = F[:, 6, 7] = -g1
    F[:, 6, 4], F[:, 6, 5] = g0 / 3, g1 / 3
    F[:, 7, 8], F[:, 7, 9] = -g0, -g1
    F[:, 8, :4] = -level
    both = F @ moments(products, good, tau, _TERMS) @ F.transpose(0, 2, 1)
    pixels = (products[:, 0] * good).sum(1)
    return Sums(normal=both[:, :8, :8], right=both[:, :8, 8], square=both[:, 8, 8], pixels=pixels)


def joint_fit(
    sheet: Sheet,
    curves: Curves,
    level: np.ndarray,
    blur: np.ndarray,
    seen: Sums,
    bend: np.ndarray,
    scatter: np.ndarray,
) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """For each of Q quadrilaterals, all in one pass: points (4, n, 2) [px] spread evenly on the sides, through which
    straight lines go once they are undistorted; and the information (8, 8) [1/px^2] of the distances inward of the
    sides at NODES.

    sheet of the Q channels; curves of their 4 Q sides, level (4 Q, 4) the sides' own levels; blur (Q,); seen,
    bend (4 Q,): prior on each bend; scatter (Q, 2): chi^2 of the edge points about their sides times sigma^2, and its
    degrees of freedom. None where the light is not that of two planes, there are too few pixels to tell, the sides do
    not meet, or the blur was far off.
    """
    Q = len(blur)
    T, frame = _to_common(curves, Q)
    planes, off = _planes(T, level)
    normal = seen.normal.copy()
    normal[:, _BEND, _BEND] += bend
    H, step, lost = _common_step(T, normal, seen, off)
    apart = _apart(normal, seen.right)
    freedom = seen.pixels.reshape(Q, 4).sum(1) - 29
    variance = (seen.square.reshape(Q, 4).sum(1) + apart) / np.maximum(freedom, 1)
    fits = (freedom >= 30) & (lost > apart) & (lost - apart < 10 * _MAX_LEVEL_CHI2 * variance)
    fits &= 1 + step[:, 18] / blur > _MIN_BLUR_RATIO

    final = _moved(curves, step)
    ends = _corners(final)
    fits &= np.isfinite(ends).all((1, 2))
    long = np.flatnonzero(fits & (((ends[:, NEXT] - ends) ** 2).sum(2).min(1) > _MIN_CORNER_SIDE**2))
    if len(long):
        light = planes + step[:, :6]
        J, r, owner = _corner_pixels(sheet, final, ends, light, blur + step[:, 18], frame, variance, long)
        _add_corners(H, step, J, r, owner, long)
        final = _moved(curves, step)
    # What pixels know of an edge's place goes with the inverse of its blur, and H is of the blur before the step.
    wider = 1 + step[:, 18] / blur
    fits &= wider > _MIN_BLUR_RATIO
    chi2, n = scatter.T
    noise = wider * (chi2 + PRIOR_POINTS * variance) / (n + PRIOR_POINTS)
    even = final.points(_EVEN_TAU)
    out: list[tuple[np.ndarray, np.ndarray] | None] = [None] * Q
    if fits.any():
        information = _of_nodes(_node_rows(final, ends)[fits], H[fits], noise[fits])
        for q, one in zip(np.flatnonzero(fits), information):
            out[q] = even[4 * q : 4 * q + 4], one
    return out


def _to_common(curves: Curves, Q: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """T (Q, 4, 8, 19) that makes a side's own unknowns of the common ones; and the centre (Q, 2) and size (Q,) [px] of
    the quadrilaterals, about and by which the planes of light are counted."""
    middle = curves.points(_ENDS_AND_MIDDLE)
    halves = middle[:, 1].reshape(Q, 4, 2)
    centre, size = halves.sum(1) / 4, (halves.max(1) - halves.min(1)).max(1)
    place = (middle.reshape(Q, 4, 3, 2) - centre[:, None, None]) / size[:, None, None, None]
    T = np.empty((Q, *_COMMON.shape))
    T[:] = _COMMON
    T[:, :, 0, 1:3] = T[:, :, 2, 4:6] = place[:, :, 1]
    T[:, :, 1, 1:3] = T[:, :, 3, 4:6] = (place[:, :, 2] - place[:, :, 0]) / 2
    return T, (centre, size)


def _planes(T: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The planes of light (Q, 6) that fit the sides' own levels best, and what those are off them (4 Q, 8, 1)."""
    Q = len(T)
    to_levels = T[:, :, _LEVELS, :6].reshape(Q, 16, 6)
    back = to_levels.transpose(0, 2, 1)
    planes = np.linalg.solve(back @ to_levels, back @ level.reshape(Q, 16, 1))
    off = np.zeros((4 * Q, 8, 1))
    off[:, _LEVELS] = level[:, :, None] - (to_levels @ planes).reshape(4 * Q, 4, 1)
    return planes[:, :, 0], off


def _common_step(
    T: np.ndarray, normal: np.ndarray, seen: Sums, off: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrix (Q, 19, 19) of the common unknowns, their Gauss-Newton step (Q, 19), and by how much the sum of
    squares then differs from that of the sides' own levels (Q,)."""
    Q = len(T)
    right = seen.right + (seen.normal @ off)[:, :, 0]
    flat_T = T.reshape(Q, 32, 19)
    back = flat_T.transpose(0, 2, 1)
    H = back @ (normal.reshape(Q, 4, 8, 8) @ T).reshape(Q, 32, 19)
    b = back @ right.reshape(Q, 32, 1)
    step = np.linalg.solve(H, b)
    lost = (off[:, :, 0] * (seen.right + right)).reshape(Q, 32).sum(1) - (b * step).sum((1, 2))
    return H, step[:, :, 0], lost


def _moved(curves: Curves, step: np.ndarray) -> Curves:
    """The sides after a step (Q, 19) of the common unknowns."""
    per_shift = (curves.inward / curves.cosine)[:, None]
    return dc.replace(curves, coefficient=curves.coefficient + step[:, 6:18].reshape(-1, 3) * per_shift)


def _add_corners(
    H: np.ndarray, step: np.ndarray, J: np.ndarray, r: np.ndarray, owner: np.ndarray, quads: np.ndarray
) -> None:
    """The corners' pixels added to H, and the step that they ask for to `step`, in place."""
    g = np.zeros((len(H), 19, 1))
    for q in quads:
        own = slice(*np.searchsorted(owner, [q, q + 1]))
        H[q] += J[own].T @ J[own]
        g[q, :, 0] = J[own].T @ r[own]
    step[quads] += np.linalg.solve(H[quads], g[quads])[:, :, 0]


def _node_rows(curves: Curves, ends: np.ndarray) -> np.ndarray:
    """(Q, 8, 19): the distances inward of the sides at NODES by the common unknowns. No bend: they are undistorted."""
    Q = len(ends)
    begin, stop = ends.reshape(-1, 2), ends[:, NEXT].reshape(-1, 2)
    begin, stop = (np.where(curves.flat, p[:, 0], p[:, 1]) for p in (begin, stop))
    t = begin[:, None] + (stop - begin)[:, None] * _NODES
    K = np.zeros((Q, 8, 19))
    K[:, _ROWS, _ROWS // 2 * 3 + 6], K[:, _ROWS, _ROWS // 2 * 3 + 7] = 1, curves.tau(t).reshape(Q, 8)
    return K


def _of_nodes(K: np.ndarray, H: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Information (Q, 8, 8) of the distances K x of unknowns x with the normal matrix H, by the variance `noise`."""
    return np.linalg.inv(noise[:, None, None] * (K @ np.linalg.solve(H, K.transpose(0, 2, 1))))


def _apart(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """By how much each quadrilateral's sum of squares falls if every side has its own levels (Q,), negative.

    normal (S, 8, 8) with the prior on the bend, right (S, 8).
    """
    both = np.empty((len(right), 7, 2))
    both[:, :, 0], both[:, :, 1] = right[:, :7], normal[:, :7, _BLUR]
    products = both.transpose(0, 2, 1) @ np.linalg.solve(normal[:, :7, :7] + _RIDGE, both)
    fall = products[:, 0, 0].reshape(-1, 4).sum(1)
    g = (right[:, _BLUR] - products[:, 1, 0]).reshape(-1, 4).sum(1)
    h = (normal[:, _BLUR, _BLUR] - products[:, 1, 1]).reshape(-1, 4).sum(1)
    return -(fall + g * g / h)


def _corners(curves: Curves) -> np.ndarray:
    """Where the sides of Q quadrilaterals meet, (Q, 4, 2) [px]."""
    ends = curves.points(_ENDS)
    d = ends[:, 1] - ends[:, 0]
    lines = np.empty((len(d), 3))
    lines[:, 0], lines[:, 1] = -d[:, 1], d[:, 0]
    lines[:, 2] = -(lines[:, :2] * ends[:, 0]).sum(1)
    return meet(lines.reshape(-1, 4, 3))


def _corner_pixels(
    sheet: Sheet,
    curves: Curves,
    ends: np.ndarray,
    planes: np.ndarray,
    blur: np.ndarray,
    frame: tuple[np.ndarray, np.ndarray],
    variance: np.ndarray,
    quads: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Jacobian (n, 19) and residual (n,) of the pixels at the corners that no profile holds, and whose they are (n,).

    quads: the numbers of those looked at, in order.
    """
    corners = (4 * quads[:, None] + _FOUR).ravel()  # numbers among all 4 Q
    before = (4 * quads[:, None] + np.array(BEFORE)).ravel()
    u, v, row, tau, gap = _near_corners(sheet, curves, ends, corners, before)
    corner, behind = corners[row], before[row]
    q = corner // 4
    b, a = gap / blur[q]
    along = basis(tau).transpose(0, 2, 1)
    normals = curves.normals()
    rho = (normals[before] * normals[corners]).sum(1)[row]
    cover, by_a, by_b = _wedge(a, b, rho)

    n = len(row)
    place = np.ones((n, 3))
    (middle_u, middle_v), size = frame[0][q].T, frame[1][q]
    place[:, 1], place[:, 2] = (u - middle_u) / size, (v - middle_v) / size
    light = planes[q]
    height = (place * light[:, 3:]).sum(1)
    J = np.zeros((n, 19))
    J[:, :3] = place
    np.multiply(place, cover[:, None], out=J[:, 3:6])
    scaled = height / -blur[q]
    shifts = np.zeros((n, 4, 3))
    rows = np.arange(n)
    for values, slope, side in ((along[0], by_b, corner % 4), (along[1], by_a, behind % 4)):
        shifts[rows, side] = (scaled * slope)[:, None] * values
    J[:, 6:18] = shifts.reshape(n, 12)
    J[:, 18] = scaled * (a * by_a + b * by_b)
    r = sheet.pixels[v, u] - (place * light[:, :3]).sum(1) - height * cover
    chi2 = r * r / variance[q]
    good = chi2 < _MAX_PIXEL_SIGMAS**2
    C = len(corners)
    used = np.bincount(row, good, C)
    mean = np.bincount(row, good * chi2, C) / np.maximum(used, 1)
    good &= ((mean < _MAX_CORNER_CHI2) & (used > 0.9 * np.bincount(row, minlength=C)))[row]
    return J[good], r[good], q[good]


def _near_corners(
    sheet: Sheet, curves: Curves, ends: np.ndarray, corners: np.ndarray, before: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The pixels near C corners that no profile holds: u, v (n,), which corner each is at (n,), and tau (2, n) and the
    distance inward (2, n) [px] by the side that begins there, and by the one that ends there."""
    C = len(corners)
    u, v = np.rint(ends.reshape(-1, 2)[corners]).astype(int).T[:, :, None] + _WINDOW_PIXELS[:, None]  # (C, n)
    sides = curves[np.concatenate([corners, before])]
    flat, first = sides.flat.reshape(2, C, 1), sides.first[:, None]
    t, y = (np.where(flat, *both).reshape(2 * C, -1) for both in ((u, v), (v, u)))
    tau = sides.tau(t)
    gap = (y - sides.across(t, tau)) * (sides.inward * sides.cosine)[:, None]
    beyond = (t < first) | (t >= first + sides.count[:, None])
    near, far = np.minimum(gap[:C], gap[C:]), np.maximum(gap[:C], gap[C:])
    (low_u, low_v), (high_u, high_v) = sheet.low[corners // 4].T[:, :, None], sheet.high[corners // 4].T[:, :, None]
    keep = (u >= low_u) & (v >= low_v) & (u <= high_u) & (v <= high_v)
    keep &= beyond[:C] & beyond[C:] & (near > -_CORNER_MARGIN) & (far > -1) & (near < 4)
    kept = np.flatnonzero(keep)
    both = (values.reshape(2, -1)[:, kept] for values in (tau, gap))
    return u.ravel()[kept], v.ravel()[kept], kept // u.shape[1], *both


def _wedge(a: np.ndarray, b: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P(x < a, y < b) of the bivariate normal distribution, to 1e-3 for |rho| < 0.5, and its exact derivatives."""
    root = np.sqrt(1 - rho**2)
    at = np.stack([a, b, (b - rho * a) / root, (a - rho * b) / root])
    density = normal_density(at)
    cdf = normal_cdf(at, density)
    series = 1 + rho / 2 * a * b + rho**2 / 6 * (a * a - 1) * (b * b - 1)
    cover = cdf[0] * cdf[1] + rho * density[0] * density[1] * series
    return cover, density[0] * cdf[2], density[1] * cdf[3]
