"""Profiles across the sides of quadrilaterals: short columns or rows of untouched pixels, each with a blurred step.

A step of height a at distance d = 0, blurred by s, is b + a Phi(z), z = d / s. All that the fits ask of a profile's
pixels are their weighted products with 1, Phi, its slopes phi (by the step's place) and z phi (by its blur), and with
themselves: fifteen numbers, from which each of them follows without another look at a pixel.

Arrays: S sides, M pixels across, N profiles along. tau goes from -1 at a side's first profile to 1 at its last.
"""

import dataclasses as dc
import math
from collections.abc import Sequence

import cv2
import numpy as np

_GAP = 8  # between a cut-out and the next one, beyond what is looked at beside a side [px]
# Where the product of functions i and j is among the fifteen of `gram`.
ROW = [[4 * min(i, j) - min(i, j) * (min(i, j) - 1) // 2 + max(i, j) for j in range(5)] for i in range(5)]


@dc.dataclass(frozen=True)
class Sheet:
    """Q cut-outs side by side in one image, so that a step is made once for all of them; pixels as (u, v) in it."""

    pixels: np.ndarray  # (H, W) float32
    low: np.ndarray  # (Q, 2) of each cut-out: its first pixel ...
    high: np.ndarray  # (Q, 2) ... and its last

    @classmethod
    def of(cls, channels: Sequence[np.ndarray]) -> "Sheet":
        """channels: (H, W) float32 each. Their borders are drawn out, so that none shows an edge there."""
        tall = max(len(channel) for channel in channels)
        framed = [
            cv2.copyMakeBorder(channel, _GAP, _GAP + tall - len(channel), _GAP, _GAP, cv2.BORDER_REPLICATE)
            for channel in channels
        ]
        low, high, wide = [], [], 0
        for channel, one in zip(channels, framed):
            low.append((wide + _GAP, _GAP))
            high.append((wide + _GAP + channel.shape[1] - 1, _GAP + len(channel) - 1))
            wide += one.shape[1]
        return cls(pixels=cv2.hconcat(framed), low=np.array(low), high=np.array(high))

    def __getitem__(self, own: np.ndarray | slice) -> "Sheet":
        return Sheet(self.pixels, self.low[own], self.high[own])


def gram(weight: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """The weighted products of five functions of each profile's pixels, (S, 15, N): all that least squares needs of
    them. Those of functions i and j are at ROW[i][j].

    weight (S, M, N); functions (S, 5, M, N): 1, rise Phi(z), bell phi(z), z phi(z), and the grey value.
    """
    S, _, _, N = functions.shape
    out = np.empty((S, 15, N), np.float32)
    for i in range(5):
        weighted = weight if i == 0 else weight * functions[:, i]
        np.einsum("smn,sjmn->sjn", weighted, functions[:, i:], out=out[:, ROW[i][i] : ROW[i][4] + 1])
    return out.astype(float)


class Terms:
    """A list of terms, each one of the five functions times a power of tau."""

    def __init__(self, *terms: tuple[int, int]):
        function, power = np.array(terms).T
        self.row = np.array(ROW)[function[:, None], function]  # of the products of any two of them, (n, n)
        self.power = power[:, None] + power
        self.highest = int(self.power.max())


def moments(products: np.ndarray, good: np.ndarray, tau: np.ndarray, terms: Terms) -> np.ndarray:
    """Products (S, n, n) of n terms over all profiles: from (S, 15, N) by `gram`.

    good, tau (S, N): weight and place of the profiles.
    """
    powers = np.empty((*tau.shape, terms.highest + 1))
    powers[:, :, 0] = good
    for k in range(terms.highest):
        np.multiply(powers[:, :, k], tau, out=powers[:, :, k + 1])
    return (products @ powers)[:, terms.row, terms.power]


def normal_density(z: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """phi(z) of an array of any shape."""
    out = np.multiply(z, z, out=out)
    out *= -0.5
    np.exp(out, out=out)
    out *= 1 / math.sqrt(2 * math.pi)
    return out


def normal_cdf(z: np.ndarray, density: np.ndarray | None = None, out: np.ndarray | None = None) -> np.ndarray:
    """Phi(z), its density given or not (Abramowitz and Stegun 26.2.17, error < 8e-8)."""
    density = normal_density(z) if density is None else density
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
    np.copysign(tail, z, out=tail)
    return np.add(tail, 0.5, out=out)
