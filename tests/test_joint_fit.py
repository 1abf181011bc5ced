"""Four sides fitted together, on drawn images whose true sides are known."""

import numpy as np
import pytest

from valve_drake import frames
from valve_drake.analysis import experiments
from valve_drake.analysis.drawn_images import PLATE, RED, Canvas, draw_board
from valve_drake.perception import edges, line_fitting
from valve_drake.perception import joint_fit as mut
from valve_drake.perception.line_fitting import LineFittingConfig, fit_quads
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.quadrilateral import side_lines

EYE, MARKER = experiments.head().left, Marker()


def pose(z, tilt=0.5, roll=0.3):
    return experiments.tilted(np.array([0.02, 0.01, z]), tilt, 0.7, roll)


def canvas(X):
    out = Canvas(EYE)
    draw_board(out, X, MARKER)
    return out


def true_corners(X):
    P = frames.apply(X, MARKER.corners())
    return P[:, :2] / P[:, 2:]


def fit(image, X):
    return fit_quads([image], [EYE.project(true_corners(X))], LineFittingConfig())[0]


def distances(quad, X):
    """By how much the fitted sides lie further in than the true ones, at NODES (8,) [px]."""
    q = true_corners(X)
    n = quad.together.shape[1]
    lines = side_lines(EYE.normalize(quad.together.reshape(-1, 2)), np.repeat(np.arange(4), n))[0]
    middle = q.mean(0)
    lines *= np.sign(lines[:, :2] @ middle + lines[:, 2])[:, None]
    nodes = q[:, None] + np.multiply.outer(q[NEXT] - q, mut.NODES).transpose(0, 2, 1)
    stretch = np.linalg.norm((lines[:, None, :2] @ EYE.normalize_jacobian(EYE.project(nodes.mean(1))))[:, 0], axis=1)
    return -((nodes @ lines[:, :2, None])[..., 0] + lines[:, 2:]).ravel() / np.repeat(stretch, 2)


@pytest.mark.parametrize("z", [0.5, 1.2, 2.5])
@pytest.mark.parametrize("tilt", [0.0, 0.8])
def test_sides_without_noise_are_true_to_two_thousandths(z, tilt):
    X = pose(z, tilt)
    rng = np.random.default_rng(0)
    # Rounding alone is no noise of its own: two tenths of a grey level stand for it.
    quad = fit(canvas(X).finish(rng, 0.2), X)
    assert quad.together is not None
    assert np.abs(distances(quad, X)).max() < 2e-3


@pytest.mark.system
@pytest.mark.parametrize("z", [0.8, 2.5])
def test_covariance_is_honest_and_less_than_that_of_sides_alone(z):
    X, rng, values, gain = pose(z, 0.6), np.random.default_rng(1), [], []
    clean = canvas(X)
    for _ in range(60):
        quad = fit(clean.finish(rng, 2.0), X)
        if quad.information is None:  # one in a hundred, by chance
            continue
        e = distances(quad, X)
        values.append(e @ quad.information @ e / 8)
        alone = 2 * quad.sigma**2 / np.bincount(quad.side, minlength=4)  # of a node, from the points
        gain.append(np.repeat(alone, 2) / np.diag(np.linalg.inv(quad.information)))
    assert len(values) >= 55
    assert abs(np.mean(values) - 1) < 4 * np.sqrt(2 / (8 * len(values)))
    assert np.mean(gain) > 1.1


def test_covariance_does_not_depend_on_the_blur_that_was_looked_for_first(monkeypatch):
    X, found = pose(1.2, 0.6), []
    image = canvas(X).finish(np.random.default_rng(3), 2.0)
    for blur in (0.65, 0.78, 0.95):
        monkeypatch.setattr(edges, "START_BLUR", blur)
        found.append(np.linalg.inv(fit(image, X).information).diagonal())
    np.testing.assert_allclose(found, [found[1]] * 3, rtol=0.01)


def test_light_that_differs_from_side_to_side_keeps_the_sides_apart():
    X = pose(1.2)
    drawn = canvas(X)
    strip = frames.compose(X, frames.make(np.eye(3), np.array([0.0, 0.075, 0.0])))
    drawn.rectangle(strip, tuple(0.9 * np.array(PLATE)), (0.2, 0.0249))  # the board is darker beyond one side
    quad = fit(drawn.finish(np.random.default_rng(0), 1.0), X)
    assert quad.reason == "" and quad.information is None


@pytest.mark.parametrize("wear", [1.0, 0.04])  # pixels that are not the marker's; or each a little off
def test_a_corner_that_is_worn_off_is_not_used(wear):
    X, rng = pose(1.0), np.random.default_rng(2)
    whole, worn = canvas(X), canvas(X)
    chip = frames.make(frames.rot_z(np.pi / 4), np.array([0.049, 0.05, 0.0]))
    color = tuple(np.array(RED) + wear * np.subtract(PLATE, RED))
    worn.rectangle(frames.compose(X, chip), color, (0.0025, 0.0025))
    good, bad = (fit(drawn.finish(rng, 2.0), X) for drawn in (whole, worn))
    grown = np.diag(np.linalg.inv(bad.information)) / np.diag(np.linalg.inv(good.information))
    beside, others = grown[[3, 4]], grown[[0, 1, 2, 5, 6, 7]]  # the two of the eight points next to that corner
    assert beside.min() > 1.06 * others.max()  # the side's ends are known by the side's own pixels only
    e = distances(bad, X)
    assert e @ bad.information @ e / 8 < 2.5


def test_a_wedge_is_the_integral_of_the_blurred_corner():
    a, b = np.random.default_rng(0).uniform(-2.5, 2.5, (2, 40))
    node, share = np.polynomial.legendre.leggauss(40)

    def exact(a, b, rho):
        """P(X < a, Y < b): it grows with rho by the density at (a, b)."""
        r = (node + 1) / 2 * rho
        square = (a * a + b * b)[:, None] - 2 * r * (a * b)[:, None]
        density = np.exp(-square / (2 * (1 - r * r))) / (2 * np.pi * np.sqrt(1 - r * r))
        return mut.normal_cdf(a) * mut.normal_cdf(b) + density @ share * rho / 2

    h = 1e-3
    for rho in (0.0, 0.3, -0.49):
        cover, by_a, by_b = mut._wedge(a, b, np.full(40, rho))
        np.testing.assert_allclose(cover, exact(a, b, rho), atol=1e-3)
        np.testing.assert_allclose(by_a, (exact(a + h, b, rho) - exact(a - h, b, rho)) / (2 * h), atol=1e-4)
        np.testing.assert_allclose(by_b, (exact(a, b + h, rho) - exact(a, b - h, rho)) / (2 * h), atol=1e-4)


def test_jacobian_of_the_corner_pixels_equals_finite_differences():
    flat = np.array([True, False, True, False])
    curves = mut.Curves(
        flat=flat,
        inward=np.array([1.0, -1.0, -1.0, 1.0]),
        first=np.array([24, 24, 24, 24]),
        count=np.array([33, 33, 33, 33]),
        start=np.array([20.2, 60.4, 60.1, 19.7]),
        slope=np.array([0.1, -0.1, 0.1, -0.1]) * 0.3,
        coefficient=np.array([[0.1, 0.05, 0.02]] * 4),
        cosine=np.full(4, 1 / np.hypot(1, 0.03)),
    )
    sheet = mut.Sheet.of([np.random.default_rng(0).random((81, 81)).astype(np.float32)])
    planes = np.array([[0.02, 0.01, -0.01, 0.97, 0.02, 0.01]])
    frame, variance, quads = (np.array([[40.0, 40.0]]), np.array([20.0])), np.array([1e4]), np.array([0])
    ends = np.rint(mut._corners(curves))

    def pixels(d):
        shift = d[6:18].reshape(4, 3) * (curves.inward / curves.cosine)[:, None]
        moved = mut.dc.replace(curves, coefficient=curves.coefficient + shift)
        light, blur = planes + d[:6], np.array([0.8 + d[18]])
        return mut._corner_pixels(sheet, moved, ends, light, blur, frame, variance, quads)

    J, *_ = pixels(np.zeros(19))
    assert len(J) > 60
    e = 1e-5
    numeric = np.stack([(pixels(-e * d)[1] - pixels(e * d)[1]) / (2 * e) for d in np.eye(19)], -1)
    np.testing.assert_allclose(J, numeric, atol=6e-3 * np.abs(numeric).max())


@pytest.mark.parametrize("beside", [False, True])  # one that is found out only when the sides are fitted
def test_two_quadrilaterals_in_one_pass_are_fitted_as_each_alone(beside, monkeypatch):
    # Coarse lines are looked for at the resolution that suits the smallest: the same start, then, for both.
    monkeypatch.setattr(line_fitting, "hough_corners", lambda sheet, corners: corners)
    rng, near, far = np.random.default_rng(4), pose(0.7), pose(1.6)
    images = [canvas(X).finish(rng, 2.0) for X in (near, far)]
    corners = [EYE.project(true_corners(X)) for X in (near, far)]
    endless = canvas(near)  # red goes on beyond one side
    endless.rectangle(frames.compose(near, frames.make(np.eye(3), np.array([0.0, 0.075, 0.0]))), RED, (0.06, 0.03))
    other = ([endless.finish(rng, 2.0)], [corners[0]]) if beside else ([], [])

    def passed(images, corners):
        """In one pass with the other in their middle, since a pass takes as many steps as its slowest needs."""
        out = fit_quads([images[0], *other[0], *images[1:]], [corners[0], *other[1], *corners[1:]], LineFittingConfig())
        if beside:
            assert "no step" in out.pop(1).reason
        return out

    for k, one in enumerate(passed(images, corners)):
        (alone,) = passed(images[k : k + 1], corners[k : k + 1])
        np.testing.assert_allclose(one.together, alone.together, atol=1e-3)
        np.testing.assert_allclose(one.information, alone.information, rtol=1e-3, atol=1e-3 * alone.information.max())
