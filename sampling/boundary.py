"""The Haar tree of variances, and the two boundary images.

"Refine error estimate" and "construct boundary images" of Fig. 8.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.cortex import Cortex, Haar
from torch_vdm.model.grid import Side

# Distance of the quartiles of a normal distribution from its mean, in standard deviations.
QUARTILE = 0.6744897501960817

# Stand-in for a variance of 0, and the largest variance, in squared cone responses: both are
# representable in single precision, and so are sums of a few of the second. Status: choice.
NONE, LARGEST = 1e-37, 1e36


class _Axis(NamedTuple):
    """How the nodes along one axis contribute to their parents, two nodes per parent."""

    nodes: Tensor
    """(2, n), the indices of the nodes."""
    low: Tensor
    """(2, n), their squared weights in a detail that is a sum along this axis."""
    high: Tensor
    """(2, n), the same in a detail that is a difference along it."""
    own: Tensor
    """(2, n), the same in the mean of the parent's own pixels."""

    @property
    def ends(self) -> "_Axis":
        """The entries of the first and the last parent."""
        return _Axis(*(part[:, [0, -1]] for part in self))

    @property
    def within(self) -> "_Axis":
        """The entries of all other parents."""
        return _Axis(*(part[:, 1:-1] for part in self))

    @property
    def inner(self) -> slice:
        """The nodes of those other parents."""
        return slice(int(self.nodes[0, 1]), int(self.nodes[1, -2]) + 1)


def detail_variances(leaves: Tensor, true_means: bool) -> tuple[Tensor, ...]:
    """Return the variances of the detail coefficients of independent pixels (Section 3).

    Inside the image, the variances of a node's details and of its lowpass are the sum of its four
    children's over 16. At the border of an odd side they follow `Haar.decompose`.

    Parameters
    ----------
    leaves
        (B, C, H, W), not negative.
    true_means
        As in `Haar.decompose`.

    Returns
    -------
    tuple of Tensor
        One (B, C, 3, h, w) per level, level 0 first: d1 (horizontal), d2 (vertical), d3 (diagonal);
        (B, C, 1, h, w) where all three are equal.
    """
    size = (leaves.shape[-2], leaves.shape[-1])
    grid = Haar().grid(size, true_means)
    levels: list[Tensor] = []
    nodes = leaves
    while max(nodes.shape[-2:]) > 1:
        counts = nodes.shape[-2], nodes.shape[-1]
        # As printed, a node with fewer pixels has the same weight as its siblings.
        sides = grid.sides(size, len(levels)) if true_means else (Side(0, 1.0, 1.0),) * 2
        if all(map(_complete, sides, counts)):
            nodes = _quarter(nodes)
            levels.append(nodes.unsqueeze(2))
            continue
        y, x = (
            _axis(side, count, true_means, leaves.dtype)
            for side, count in zip(sides, counts, strict=True)
        )
        parents = y.nodes.shape[1], x.nodes.shape[1]
        # `_bordered` where only the border differs, as it always does on the grid of thirds.
        weighed = _bordered if true_means and min(parents) > 2 else _weighed
        details, nodes = weighed(nodes, y, x)
        levels.append(details)
    return tuple(reversed(levels))


def _quarter(nodes: Tensor) -> Tensor:
    """Return a quarter of the mean of each 2x2 nodes, of planes with even sides.

    The additions are those of `avg_pool2d`, bit for bit, in a third of its time; its derivative is
    the faster one.
    """
    if nodes.requires_grad:
        return functional.avg_pool2d(nodes, 2) * 0.25
    upper, lower = nodes[..., 0::2, :], nodes[..., 1::2, :]
    total = upper[..., 0::2] + upper[..., 1::2]
    return total.add_(lower[..., 0::2]).add_(lower[..., 1::2]).mul_(0.25).mul_(0.25)


def _weighed(nodes: Tensor, y: _Axis, x: _Axis) -> tuple[Tensor, Tensor]:
    """Return the variances of the details (B, C, 3, h, w) and of the means (B, C, h, w)."""
    upper, lower = nodes[..., y.nodes[0], :], nodes[..., y.nodes[1], :]

    def across(weights: Tensor) -> tuple[Tensor, Tensor]:
        rows = weights[0, :, None] * upper + weights[1, :, None] * lower
        return rows[..., x.nodes[0]], rows[..., x.nodes[1]]

    (left, right), (left_high, right_high) = across(y.low), across(y.high)
    details = (
        x.high[0] * left + x.high[1] * right,
        x.low[0] * left_high + x.low[1] * right_high,
        x.high[0] * left_high + x.high[1] * right_high,
    )
    left, right = across(y.own)
    return torch.stack(details, 2), x.own[0] * left + x.own[1] * right


def _bordered(nodes: Tensor, y: _Axis, x: _Axis) -> tuple[Tensor, Tensor]:
    """Return the same where all but the first and last parents have four whole nodes."""
    inner = _quarter(nodes[..., y.inner, x.inner])
    rows = _weighed(nodes, y.ends, x)
    # Only the columns that are needed.
    sides = x.ends._replace(nodes=torch.arange(4).view(2, 2))
    columns = _weighed(nodes[..., x.ends.nodes.flatten()], y.within, sides)

    def framed(inner: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
        middle = torch.cat((columns[..., :1], inner, columns[..., 1:]), -1)
        return torch.cat((rows[..., :1, :], middle, rows[..., 1:, :]), -2)

    of_details = inner.unsqueeze(2).expand(-1, -1, 3, -1, -1)
    return framed(of_details, columns[0], rows[0]), framed(inner, columns[1], rows[1])


def _complete(side: Side, count: int) -> bool:
    """Return whether, along a side of ``count`` nodes, all parents have two whole nodes."""
    return side == Side(0, 1.0, 1.0) and count % 2 == 0


@lru_cache(maxsize=128)
def _axis(side: Side, count: int, true_means: bool, dtype: torch.dtype) -> _Axis:
    """Return the weights along a side of ``count`` nodes."""
    parents = (count + side.before + 1) // 2
    nodes = (torch.arange(2 * parents).view(parents, 2) - side.before).T.contiguous()
    low = torch.full((2, parents), 0.25, dtype=torch.float64)
    high, own = low.clone(), low.clone()

    def squares(first: float, second: float) -> Tensor:
        return torch.tensor([first**2, second**2], dtype=torch.float64)

    # Parent, its border node and that node's neighbour, its share of pixels, whether it is alone.
    first = 0, (0, 1), side.first, side.before == 1
    last = parents - 1, (count - 1, count - 2), side.last, (count + side.before) % 2 == 1
    for parent, pair, real, alone in (first, last):
        if real == 1.0 and not alone:
            continue
        nodes[:, parent] = torch.tensor(pair).clamp_min(0)
        if alone and (count == 1 or not true_means):
            # It is its own neighbour.
            low[:, parent] = own[:, parent] = squares(1.0, 0.0)
            high[:, parent] = 0.0
            continue
        # The pixels that it lacks are those of its neighbour, into which its window extends.
        half = 0.5 * real
        low[:, parent], high[:, parent] = squares(half, 1.0 - half), squares(half, half)
        own[:, parent] = squares(1.0, 0.0) if alone else squares(real, 1.0) / (1.0 + real) ** 2
    if count == 2 and side.before == 0:
        both, half = side.first + side.last, 0.5 * min(side.first, side.last)
        nodes = torch.tensor([[0], [1]])
        low[:, 0] = own[:, 0] = squares(side.first, side.last) / both**2
        high[:, 0] = squares(half, half)
    return _Axis(nodes, low.to(dtype), high.to(dtype), own.to(dtype))


def boundaries(
    cortex: Cortex,
    variances: tuple[Tensor, ...],
    mean_variance: Tensor,
    spread: float,
    signed: bool,
) -> tuple[Cortex, Cortex]:
    """Return the lower and the upper boundary image of a representation.

    Their details lie ``spread`` standard deviations below and above: the paper's 25 % and 75 %
    points with `QUARTILE`. Their lowpass is that of ``cortex``; the mean, which the calibrated
    observer compares, is spread like the details.

    Parameters
    ----------
    cortex
        The current means, in cone space.
    variances
        Variances of its details, as `detail_variances` returns them.
    mean_variance
        (B, C, 1, 1), the variance of the mean of the image.
    spread
        In standard deviations.
    signed
        False, for an observer of magnitudes: abs(d) - spread sigma, clamped at 0, with the sign of
        d. True: the boundary may cross zero, so that a small detail spreads as far as a large one.
    """
    lower: list[Tensor] = []
    upper: list[Tensor] = []
    for detail, variance in zip(cortex.details, variances, strict=True):
        # Not 0: the slope of the square root is infinite there.
        margin = spread * variance.clamp_min(NONE).sqrt()
        if signed:
            lower.append(detail - margin)
            upper.append(detail + margin)
        else:
            # Not torch.sign: a detail of 0 spreads too.
            sign = torch.where(detail < 0.0, -1.0, 1.0)
            size = detail.abs()
            lower.append(sign * (size - margin).clamp_min(0.0))
            upper.append(sign * (size + margin))
    margin = spread * mean_variance.clamp_min(NONE).sqrt()
    return (
        cortex._replace(details=tuple(lower), mean=cortex.mean - margin),
        cortex._replace(details=tuple(upper), mean=cortex.mean + margin),
    )
