"""edge_profiles: the weighted products of profiles that the fits use, against the pixels themselves."""

import math

import numpy as np
import pytest

from valve_drake.perception import edge_profiles as mut
from valve_drake.perception.joint_fit import basis, sums

RNG = np.random.default_rng(0)
S, M, N = 3, 15, 40


def scene():
    """Weights (S, M, N), distances from the step [px], grey values, and the places of the profiles."""
    weight, grey = RNG.random((2, S, M, N)).astype(np.float32)
    distance = (RNG.uniform(-1, 1, (S, 1, N)) + np.arange(M)[:, None] - M // 2).astype(np.float32)
    tau = np.broadcast_to(np.linspace(-1, 1, N), (S, N))
    return weight, distance, grey, tau, (RNG.random((S, N)) > 0.2).astype(float)


def functions_of(distance, blur, grey):
    z = distance / np.float32(blur)
    bell = mut.normal_density(z)
    return np.stack([np.ones_like(z), mut.normal_cdf(z), bell, z * bell, grey], 1)


def test_normal_distribution():
    z = np.linspace(-6, 6, 101)
    exact = [0.5 * math.erfc(-x / math.sqrt(2)) for x in z]
    np.testing.assert_allclose(mut.normal_cdf(z), exact, atol=8e-8)
    np.testing.assert_allclose(np.gradient(exact, z)[1:-1], mut.normal_density(z)[1:-1], atol=1e-3)
    out = np.empty(101)
    assert mut.normal_cdf(z, mut.normal_density(z), out=out) is out and np.array_equal(out, mut.normal_cdf(z))


def test_products_are_sums_over_the_pixels():
    weight, distance, grey, tau, good = scene()
    functions = functions_of(distance, 0.8, grey)
    products = mut.gram(weight, functions)
    for i in range(5):
        for j in range(5):
            direct = (weight * functions[:, i] * functions[:, j]).astype(float).sum(1)
            np.testing.assert_allclose(products[:, mut.ROW[i][j]], direct, atol=1e-5)
    terms = [(0, 0), (2, 3), (4, 1)]
    both = mut.moments(products, good, tau, mut.Terms(*terms))
    for a, (i, k) in enumerate(terms):
        for b, (j, m) in enumerate(terms):
            direct = (products[:, mut.ROW[i][j]] * good * tau ** (k + m)).sum(1)
            np.testing.assert_allclose(both[:, a, b], direct, rtol=1e-9, atol=1e-9)


def test_sums_of_a_side_are_those_of_its_models_own_derivatives():
    weight, distance, grey, tau, good = scene()
    level, blur = np.array([[0.1, 0.02, 0.9, -0.05]] * S), 0.8

    def model(x):
        """Levels, shift inward by `basis`, blur -> (S, M, N)."""
        moved = distance.astype(float) - (x[4:7] @ basis(tau))[:, None]
        by_tau = tau[:, None]
        return x[0] + x[1] * by_tau + (x[2] + x[3] * by_tau) * mut.normal_cdf(moved / x[7])

    x, e = np.array([*level[0], 0, 0, 0, blur]), 1e-4
    J = np.stack([(model(x + e * d) - model(x - e * d)) / (2 * e) for d in np.eye(8)], -1).reshape(S, -1, 8)
    w = (weight * good[:, None]).reshape(S, -1, 1)
    r = (grey - model(x)).reshape(S, -1, 1)
    seen = sums(mut.gram(weight, functions_of(distance, blur, grey)), good, tau, level, np.full(S, blur))
    np.testing.assert_allclose(seen.normal, J.transpose(0, 2, 1) @ (w * J), atol=2e-3)
    np.testing.assert_allclose(seen.right, (J.transpose(0, 2, 1) @ (w * r))[..., 0], atol=2e-3)
    np.testing.assert_allclose(seen.square, (w * r * r).sum((1, 2)), rtol=1e-5)
    np.testing.assert_allclose(seen.pixels, w.sum((1, 2)), rtol=1e-6)


@pytest.mark.parametrize("shapes", [[(20, 30)], [(20, 30), (41, 17)]])
def test_sheet_holds_every_cut_out_with_its_border_drawn_out(shapes):
    channels = [RNG.random(shape).astype(np.float32) for shape in shapes]
    sheet = mut.Sheet.of(channels)
    for channel, (u, v), (u_last, v_last) in zip(channels, sheet.low, sheet.high):
        np.testing.assert_array_equal(sheet.pixels[v : v_last + 1, u : u_last + 1], channel)
        assert (sheet.pixels[v - 5, u : u_last + 1] == channel[0]).all()
        assert (sheet.pixels[v : v_last + 1, u_last + 5] == channel[:, -1]).all()
    assert np.array_equal(sheet[:1].low, sheet.low[:1])
