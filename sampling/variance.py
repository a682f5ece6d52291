"""The variance of every pixel, shrunk towards its neighbourhood's: no variance seen is not none.

Where a pixel's first samples all miss a small light, their variance is 0. What its neighbours saw
is then the better estimate. Every node of the quad-tree has a pooled variance; from the root down,
each is mixed with its parent's (empirical Bayes), by how much each of them knows.
"""

import numpy as np
from numpy.typing import NDArray

from sampling.statistics import FIRST, SECOND, Statistics, scalar_second

Plane = NDArray[np.float64]

# What the parent's variance is worth, in degrees of freedom of the node's own. A variance from n
# samples with a kurtosis of k has 2 n / (k - 1): n for normal noise, and twice the number of
# events where noise is rare events. Status: fitted to the honest stop, see docs/sampling.md.
PRIOR = 4.0

# Kurtosis of normal noise, where none has been seen.
NORMAL = 3.0


def pooled_covariance(statistics: Statistics, size: tuple[int, int]) -> Plane:
    """Return the covariance of a single sample of every pixel, shrunk, (6, H, W).

    ``size`` is height and width; the order is that of `Statistics.comoments`.
    """
    counts = statistics.count.astype(np.float64)
    sums = np.concatenate(
        (
            statistics.comoments,
            statistics.higher[1:],
            statistics.mean * counts,
            np.maximum(counts - 1.0, 0.0)[None],
            counts[None],
        )
    ).reshape(12, *size)
    levels = [sums]
    while max(levels[-1].shape[1:]) > 1:
        levels.append(_four(levels[-1]))
    estimate, mean = _own(levels.pop())
    while levels:
        nodes = levels.pop()
        own, own_mean = _own(nodes)
        parent, parent_mean = _push(estimate, nodes.shape[1:]), _push(mean, nodes.shape[1:])
        second, fourth = scalar_second(parent[:6]), parent[6]
        kurtosis = _ratio(fourth, second * second, NORMAL)
        freedom = 2.0 * nodes[11] / np.maximum(kurtosis - 1.0, 1e-3)
        weight = PRIOR / (PRIOR + freedom)
        mean = weight * parent_mean + (1.0 - weight) * own_mean
        scale = _ratio(np.abs(mean), np.abs(parent_mean), 1.0)
        scalar = scale.mean(0)
        prior = parent * np.concatenate((scale[FIRST] * scale[SECOND], scalar[None] ** 4))
        estimate = weight * prior + (1.0 - weight) * own
    return estimate[:6]


def _own(sums: Plane) -> tuple[Plane, Plane]:
    """Return covariance and fourth moment of the samples of each node, and its mean.

    About the means of the pixels, not of the node: a texture is no noise.
    """
    count = np.maximum(sums[11], 1.0)
    return np.concatenate((sums[:6] / np.maximum(sums[10], 1.0), sums[6:7] / count)), sums[7:10] / count


def _ratio(over: Plane, under: Plane, otherwise: float) -> Plane:
    """Return a quotient, ``otherwise`` where its divisor is 0."""
    return np.where(under > 0.0, over / np.where(under > 0.0, under, 1.0), otherwise)


def _four(plane: Plane) -> Plane:
    """Return the sums of 2x2 nodes; an odd side ends in nodes of fewer."""
    height, width = plane.shape[1:]
    even = np.pad(plane, ((0, 0), (0, height % 2), (0, width % 2)))
    rows = even[:, 0::2] + even[:, 1::2]
    total: Plane = rows[..., 0::2] + rows[..., 1::2]
    return total


def _push(plane: Plane, size: tuple[int, ...]) -> Plane:
    """Give every child on a plane of ``size`` the value of its parent."""
    return plane.repeat(2, 1).repeat(2, 2)[:, : size[0], : size[1]]
