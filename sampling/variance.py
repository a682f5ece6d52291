"""The variance of every pixel, shrunk towards that of its neighbourhood.

Where a pixel's first samples all miss a small light, their variance is 0, but the true one is not.
The variance of its neighbours is then the better estimate. Every node of the quadtree has a pooled
variance; from the root down, each is mixed with its parent's (empirical Bayes), weighted by how
well each is known. Where a node's own samples refute the parent's, the node keeps its own.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from sampling.statistics import FIRST, SECOND, Statistics, scalar_second

Plane = NDArray[np.float64]

# Least prior strength of the parent's variance, in degrees of freedom. A variance from n samples
# of kurtosis k has 2 n / (k - 1) of them: n for normal noise, and twice the number of events where
# the noise is rare events. Status: choice, measured.
PRIOR = 4.0

# Largest prior strength. Status: choice.
LARGEST_PRIOR = 1000.0

# Upper limit of a squared relative distance between variances. Status: choice; rare events would
# otherwise dominate all their neighbours.
FARTHEST = 4.0

# A node is at most so many times as bright as its parent, the mean of four. A larger ratio is due
# to rounding in a channel that should be 0, as in a saturated colour.
LARGEST_SCALE = 4.0

# A prior is dropped where chance would put any node of its level so far below it in at most this
# share of images. Status: choice.
SIGNIFICANCE = 0.05

# A prior of at most so many times the node's own variance is not tested. Status: choice.
CLOSE = 2.0

# For a node that has shown no light at all, the test assumes so many times fewer events: a part of
# it may be lit. Status: choice, measured.
BLACK = 8.0

# Radius of the window over which prior strengths are averaged, in nodes. Status: choice.
REACH = 2

# Nodes of a level that are computed at once. Status: choice, measured.
AT_ONCE = 2**15

# Kurtosis of normal noise, used where none has been observed.
NORMAL = 3.0


def pooled_covariance(statistics: Statistics, size: tuple[int, int]) -> Plane:
    """Return the shrunk covariance of a single sample of every pixel, (6, H, W).

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
        estimate, mean = _refined(levels.pop(), estimate, mean)
    return estimate[:6]


def _refined(nodes: Plane, estimate: Plane, mean: Plane) -> tuple[Plane, Plane]:
    """Return estimate and mean of the ``nodes`` of a level from those of their parents.

    It works on a few rows at a time, which stay in the processor's cache: every page of a large
    plane would be requested from the system anew.
    """
    height, width = nodes.shape[1:]
    rows = max(AT_ONCE // width, 1)
    squares = np.concatenate((mean * mean, scalar_second(estimate[:6])[None] ** 2))
    parents = np.concatenate((estimate, mean, squares))
    finer, finer_mean = np.empty((7, height, width)), np.empty((3, height, width))
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        low, high = max(top - REACH, 0), min(bottom + REACH, height)
        found = _mixed(nodes[:, low:high], _between(parents, (low, high), width), height * width)
        inside = slice(top - low, bottom - low)
        finer[:, top:bottom], finer_mean[:, top:bottom] = (part[:, inside] for part in found)
    return finer, finer_mean


def _mixed(nodes: Plane, between: Plane, count: int) -> tuple[Plane, Plane]:
    """Return estimate and mean of nodes, their own mixed with those of their parents.

    ``between`` is the result of `_between`; ``count`` is the number of nodes of the level.
    """
    own, own_mean = _own(nodes)
    parent, parent_mean = between[:7], between[7:10]
    # Divide by means of squares, not by squares of means: otherwise a node near a lamp would have
    # the lamp's noise but neither its light nor its kurtosis.
    kurtosis = _ratio(parent[6], between[13], NORMAL)
    freedom = 2.0 * nodes[11] / np.maximum(kurtosis - 1.0, 1e-3)
    # An event of probability p has a kurtosis of 1 / (p (1 - p)) - 3.
    events = nodes[11] / (kurtosis + 3.0)
    seen = scalar_second(own[:6])
    # Black nodes have a rule of their own, below; their mean is believed late.
    lit = (own[:6] != 0.0).any(0) | (own_mean != 0.0).any(0)
    # The mean, which scales the parents' variance, is shrunk with the least prior strength.
    weight = PRIOR / (PRIOR + freedom)
    doubtful = np.where(lit, events, events / BLACK)
    weight *= _unrefuted(seen, scalar_second(parent[:6]), doubtful, count)
    mean = weight * parent_mean + (1.0 - weight) * own_mean
    chance = (1.0 - weight) ** 2 * parent[:6][FIRST == SECOND] / np.maximum(nodes[11], 1.0)
    known = np.sqrt(between[10:13] + chance)
    scale = np.minimum(_ratio(np.abs(mean), known, 1.0), LARGEST_SCALE)
    covariance = parent[:6] * scale[FIRST] * scale[SECOND]
    fourth = kurtosis * scalar_second(covariance) ** 2
    prior = np.concatenate((covariance, fourth[None]))
    known_second = scalar_second(prior[:6])
    worth = _worth(seen, known_second, freedom)
    refuted = _unrefuted(seen, known_second, events, count)
    believed = np.where(lit, refuted, _chance_of_light(freedom))
    weight = believed * worth / (worth + freedom)
    return weight * prior + (1.0 - weight) * own, mean


def _worth(own: Plane, prior: Plane, freedom: Plane) -> Plane:
    """Return the prior strength, in degrees of freedom, at every node.

    The distance of the nodes' own variances from the prior, beyond what their few samples explain,
    estimates that of the true ones, averaged over neighbours. The strength is 2 over its square.
    """
    apart = _ratio(own, prior, 1.0) - 1.0
    chance = 2.0 / np.maximum(freedom, 1e-3)
    spread = _smooth(np.minimum(apart * apart, FARTHEST)) - _smooth(np.minimum(chance, FARTHEST))
    return np.clip(2.0 / np.maximum(spread, 1e-9), PRIOR, LARGEST_PRIOR)


def _unrefuted(own: Plane, prior: Plane, events: Plane, count: int) -> Plane:
    """Return how much of a prior the nodes' own variances leave, 1 to 0.

    If a node had the prior's noise, at least ``events`` events would be expected in it. That no
    more occur than its own variance shows, taken `CLOSE` times, has a probability of at most
    exp(-D), where D is the deviance of a Poisson count (Chernoff). Times ``count``, the nodes of
    the level, this bounds the probability that any of them falls so low. The whole prior is left
    where the bound is 1, none where it is `SIGNIFICANCE`.
    Without this test a lamp in one pixel was believed of the whole image. The weight of the nodes'
    own samples left a tiny share of a prior with many thousand times their noise, and this share
    came down to the pixels with a kurtosis that none of them could refute.
    """
    share = np.minimum(CLOSE * _ratio(own, prior, 1.0), 1.0)
    entropy = share * np.log(np.where(share > 0.0, share, 1.0))
    chance = count * np.exp(-events * (1.0 - share + entropy))
    left: Plane = np.clip((chance - SIGNIFICANCE) / (1.0 - SIGNIFICANCE), 0.0, 1.0)
    return left


def _chance_of_light(freedom: Plane) -> Plane:
    """Return the probability that a node that has shown no light has any.

    Black is usually the background or a black surface, and no sample will change it. If a share of
    the node, all shares equally likely, had its parent's light, it would show none in
    ``freedom`` / 2 expected events with probability 2 / freedom; against this stands an even chance
    that it is black. Without this rule a black background next to a light that is rarely hit took
    most samples, because nothing in it masks noise.
    """
    chance: Plane = 1.0 / np.maximum(1.0, 0.5 * freedom)
    return chance


def _smooth(plane: Plane) -> Plane:
    """Return the mean over 5x5 nodes, fewer at the border."""
    tensor = torch.from_numpy(plane)[None, None]
    mean = functional.avg_pool2d(tensor, 2 * REACH + 1, 1, REACH, count_include_pad=False)
    return mean[0, 0].numpy()


def _own(sums: Plane) -> tuple[Plane, Plane]:
    """Return covariance and fourth moment of the samples of each node, and its mean.

    They are about the means of the pixels, not of the node: a texture is not noise.
    """
    count = np.maximum(sums[11], 1.0)
    covariance = sums[:6] / np.maximum(sums[10], 1.0)
    return np.concatenate((covariance, sums[6:7] / count)), sums[7:10] / count


def _ratio(over: Plane, under: Plane, otherwise: float) -> Plane:
    """Return a quotient, ``otherwise`` where its divisor is 0."""
    return np.where(under > 0.0, over / np.where(under > 0.0, under, 1.0), otherwise)


def _four(plane: Plane) -> Plane:
    """Return the sums of 2x2 nodes; on an odd side the last sums are of fewer."""
    height, width = plane.shape[1:]
    even = plane
    if height % 2 or width % 2:
        even = np.pad(plane, ((0, 0), (0, height % 2), (0, width % 2)))
    rows = even[:, 0::2] + even[:, 1::2]
    total: Plane = rows[..., 0::2] + rows[..., 1::2]
    return total


def _between(parents: Plane, rows: tuple[int, int], width: int) -> Plane:
    """Return, for a range of rows of nodes, the bilinear mean of their four nearest parents.

    A node's own parent alone knows nothing of what lies across the border of a large node: where
    rare light ended there, pixels next to that border stayed at zero variance.
    """
    first, last = rows
    # One more row of parents on each side, because the ends of the enlarged rows lie beyond theirs.
    low, high = max(first // 2 - 1, 0), (last + 1) // 2 + 1
    tensor = torch.from_numpy(parents[:, low:high])[None]
    between = functional.interpolate(tensor, scale_factor=2.0, mode="bilinear")
    return between[0, :, first - 2 * low : last - 2 * low, :width].numpy()
