"""The Haar tree of variances, and the two boundary images.

"Refine error estimate" and "construct boundary images" of Fig. 8.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.cortex import Cortex
from torch_vdm.quadtree import share

# Distance of the quartiles of a normal distribution from its mean, in standard deviations.
QUARTILE = 0.6744897501960817

# A variance of nothing, and the largest, in cone responses squared: in single precision both are
# numbers, and so are sums of a few of the second. Status: choice.
NONE, LARGEST = 1e-37, 1e36


class _Axis(NamedTuple):
    """What the nodes along one axis add to each of their parents: two nodes a parent."""

    nodes: Tensor
    """(2, n), the numbers of the nodes."""
    low: Tensor
    """(2, n), their squared weights in the sum of a detail that does not run along this axis."""
    high: Tensor
    """(2, n), in its difference."""
    own: Tensor
    """(2, n), in the mean of the parent's own pixels."""


def detail_variances(leaves: Tensor, true_means: bool) -> tuple[Tensor, ...]:
    """Return the variances of the detail coefficients of independent leaves (Section 3).

    Inside the image those of a node, and that of its lowpass, are the sum of its four children's
    over 16. At the border of an odd side they follow what `Haar.decompose` makes of it.

    Parameters
    ----------
    leaves
        (B, C, H, W), not negative.
    true_means
        As for `Haar.decompose`.

    Returns
    -------
    tuple of Tensor
        One (B, C, 3, h, w) a level, level 0 first: d1 (horizontal), d2 (vertical), d3 (diagonal);
        (B, C, 1, h, w) where all three have the same.
    """
    size = (leaves.shape[-2], leaves.shape[-1])
    levels: list[Tensor] = []
    nodes = leaves
    while max(nodes.shape[-2:]) > 1:
        if _complete(size, 2 ** len(levels), nodes, true_means):
            nodes = functional.avg_pool2d(nodes, 2) * 0.25
            levels.append(nodes.unsqueeze(2))
            continue
        y, x = (
            _axis(side, 2 ** len(levels), nodes.shape[axis], true_means, leaves.dtype)
            for side, axis in zip(size, (-2, -1), strict=True)
        )
        upper, lower = nodes[..., y.nodes[0], :], nodes[..., y.nodes[1], :]

        def across(
            weights: Tensor, upper: Tensor = upper, lower: Tensor = lower, x: _Axis = x
        ) -> tuple[Tensor, Tensor]:
            rows = weights[0, :, None] * upper + weights[1, :, None] * lower
            return rows[..., x.nodes[0]], rows[..., x.nodes[1]]

        (left, right), (left_high, right_high) = across(y.low), across(y.high)
        details = (
            x.high[0] * left + x.high[1] * right,
            x.low[0] * left_high + x.low[1] * right_high,
            x.high[0] * left_high + x.high[1] * right_high,
        )
        levels.append(torch.stack(details, 2))
        left, right = across(y.own)
        nodes = x.own[0] * left + x.own[1] * right
    return tuple(reversed(levels))


def _complete(size: tuple[int, int], node: int, nodes: Tensor, true_means: bool) -> bool:
    """Return whether all parents of nodes of ``node`` pixels have four, of all their pixels."""
    return all(
        nodes.shape[axis] % 2 == 0 and not (true_means and share(side, node) < 1.0)
        for side, axis in zip(size, (-2, -1), strict=True)
    )


def _axis(side: int, node: int, count: int, true_means: bool, dtype: torch.dtype) -> _Axis:
    """Return the weights along a side of ``side`` pixels in ``count`` nodes of ``node`` pixels."""
    parents = (count + 1) // 2
    nodes = torch.arange(2 * parents).view(parents, 2).T.contiguous()
    low = torch.full((2, parents), 0.25, dtype=torch.float64)
    high, own = low.clone(), low.clone()
    real = share(side, node)

    def squares(first: float, second: float) -> Tensor:
        return torch.tensor([first**2, second**2], dtype=torch.float64)

    # The pixels that the last node lacks are like the node before it; without a sibling its window
    # reaches back over that one, or it stands beside itself.
    half = 0.5 * real
    if count % 2 == 1:
        nodes[:, -1] = torch.tensor([count - 1, max(count - 2, 0)])
        own[:, -1] = squares(1.0, 0.0)
        reaches = true_means and count > 1
        low[:, -1] = squares(half, 1.0 - half) if reaches else squares(1.0, 0.0)
        high[:, -1] = squares(half, half) if reaches else 0.0
    elif true_means:
        low[:, -1], high[:, -1] = squares(1.0 - half, half), squares(half, half)
        own[:, -1] = squares(1.0, real) / (1.0 + real) ** 2
    return _Axis(nodes, low.to(dtype), high.to(dtype), own.to(dtype))


def boundaries(
    cortex: Cortex,
    variances: tuple[Tensor, ...],
    mean_variance: Tensor,
    spread: float,
    signed: bool,
) -> tuple[Cortex, Cortex]:
    """Return the lower and the upper boundary image of a representation.

    Details ``spread`` standard deviations below and above: the paper's 25 % and 75 % points with
    `QUARTILE`. Their lowpass is that of ``cortex``; the mean, which the calibrated observer
    compares, spreads as the details do.

    Parameters
    ----------
    cortex
        The current means, in cone space.
    variances
        Of its details, as `detail_variances` gives them.
    mean_variance
        (B, C, 1, 1), of the mean of the image.
    spread
        In standard deviations.
    signed
        False, for an observer of magnitudes: abs(d) - spread sigma, not below 0, with the sign of
        d. True: the boundary crosses zero, so that a small detail spreads as far as a large one.
    """
    lower: list[Tensor] = []
    upper: list[Tensor] = []
    for detail, variance in zip(cortex.details, variances, strict=True):
        # Not 0, for the slope of its root there is infinite.
        margin = spread * variance.clamp_min(NONE).sqrt()
        if signed:
            lower.append(detail - margin)
            upper.append(detail + margin)
        else:
            # Not torch.sign, for a detail of 0 spreads too.
            sign = torch.where(detail < 0.0, -1.0, 1.0)
            size = detail.abs()
            lower.append(sign * (size - margin).clamp_min(0.0))
            upper.append(sign * (size + margin))
    margin = spread * mean_variance.clamp_min(NONE).sqrt()
    return (
        cortex._replace(details=tuple(lower), mean=cortex.mean - margin),
        cortex._replace(details=tuple(upper), mean=cortex.mean + margin),
    )
