"""Nodes at the border of an image count for the pixels that they have.

Where nodes do not begin or end with the image, the first and the last node of a side hold fewer
pixels than the others, and may lack their sibling. A pair of siblings l and r along a side has a
mean r + w (l - r) and a detail h (l - r), with w = h = 1/2 as in Eq. 2 between the borders. At a
border:

- the *lowpass* is the mean of the pixels that the pair has. The eye is adapted to that of its
  *window*, the nodes as the details take them: relative to the lowpass alone, a bright wall above a
  black last row had unbounded contrast;
- in the *details*, a node that holds the fraction s of its pixels is weakened to n + s (m - n),
  where m is its mean and n that of its neighbour, as if the missing pixels were like the
  neighbour's. A node without a sibling uses its neighbour as one, so that its details are those of
  a window across the border. If a side has only two nodes, they keep the mean of their pixels, and
  their difference is weighted by the smaller fraction.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.grid import Side


class Pair(NamedTuple):
    """The weights of two siblings."""

    own: float
    """w of the mean of their own pixels."""
    completed: float
    """w of the mean that enters the details along the other axis."""
    half: float
    """h of the details."""


INSIDE = Pair(0.5, 0.5, 0.5)


class Across(NamedTuple):
    """The weights of all n pairs along w."""

    weights: Tensor
    """(1, 3, 1, 1, n): w of the mean of their own pixels, w of that for the details, and h."""
    on_right: Tensor
    """(1, 3, 1, 1, 1): how often the right one counts beside their difference, 1, 1 and 0."""


class Down(NamedTuple):
    """The weights of all n pairs along h."""

    weights: Tensor
    """(1, 3, 1, n, 1): w of the mean of their own pixels, and twice that for the details."""
    half: Tensor
    """(1, 1, 1, n, 1): h of the details."""


def is_inside(side: Side, nodes: int) -> bool:
    """Return whether all nodes of a side are whole, and all have siblings."""
    return side.before == 0 and nodes % 2 == 0 and side.first == side.last == 1.0


def ends(side: Side, nodes: int) -> tuple[Pair, Pair]:
    """Return the weights of the first and of the last pair of a side."""
    first, last = side.first, side.last
    if nodes == 1:  # its own sibling
        return INSIDE, INSIDE
    if nodes == 2:
        half = 0.5 * min(first, last)
        if side.before == 0:
            mean = first / (first + last)
            return (Pair(mean, mean, half),) * 2
        # Each is paired with the other: (last, first) and (last, first).
        mean = last / (first + last)
        return Pair(0.0, mean, half), Pair(1.0, mean, half)
    if side.before == 0:
        begin = Pair(first / (1.0 + first), 0.5 * first, 0.5 * first)
    else:
        begin = Pair(0.0, 1.0 - 0.5 * first, 0.5 * first)
    if (nodes + side.before) % 2 == 0:
        end = Pair(1.0 / (1.0 + last), 1.0 - 0.5 * last, 0.5 * last)
    else:
        end = Pair(1.0, 0.5 * last, 0.5 * last)
    return begin, end


def weights(sides: tuple[Side, Side], nodes: tuple[int, int], like: Tensor) -> tuple[Down, Across]:
    """Return the weights of every pair along h and along w, for so many nodes each.

    They have the precision and the device of ``like``.
    """
    # Cached: making them takes longer than using them on small planes, and makes a device wait.
    if type(like) is Tensor and not torch.compiler.is_compiling():
        return _kept(sides, nodes, like.dtype, like.device)
    return _made(sides, nodes, like.dtype, like.device)


@lru_cache(maxsize=512)
def _kept(*of: Any) -> tuple[Down, Across]:
    # Nothing of the call in which they are made, which may be transformed, is kept.
    with torch.inference_mode(False), torch._C._DisableFuncTorch():
        return _made(*of)


def _made(
    sides: tuple[Side, Side], nodes: tuple[int, int], dtype: torch.dtype, device: torch.device
) -> tuple[Down, Across]:
    # Never one tensor for two, nor views: compiled code is specialised on that.
    def tensor(of: Any) -> Tensor:
        return torch.tensor(of, dtype=dtype, device=device)

    (own, completed, half), across = (_rows(side, n) for side, n in zip(sides, nodes, strict=True))
    down = [[[[weight] for weight in row]] for row in (own, completed, completed)]
    on_right = [[[[1.0]]], [[[1.0]]], [[[0.0]]]]
    return (
        Down(tensor([down]), tensor([[[[[weight] for weight in half]]]])),
        Across(tensor([[[[row]] for row in across]]), tensor([on_right])),
    )


def _rows(side: Side, nodes: int) -> list[tuple[float, ...]]:
    begin, end = ends(side, nodes)
    count = (nodes + side.before + 1) // 2
    pairs = [begin, *[INSIDE] * (count - 2), end][:count]
    return list(zip(*pairs, strict=True))


def with_siblings(plane: Tensor, sides: tuple[Side, Side]) -> Tensor:
    """Return planes (..., C, h, w) in which nodes without a sibling have their neighbour as one."""
    (top, bottom), (left, right) = (
        (side.before, (nodes + side.before) % 2)
        for side, nodes in zip(sides, plane.shape[-2:], strict=True)
    )
    if plane.shape[-1] == 1 and left + right > 0:
        plane, left, right = functional.pad(plane, (left, right, 0, 0), mode="replicate"), 0, 0
    if plane.shape[-2] == 1 and top + bottom > 0:
        plane, top, bottom = functional.pad(plane, (0, 0, top, bottom), mode="replicate"), 0, 0
    if top + bottom + left + right == 0:
        return plane
    return functional.pad(plane, (left, right, top, bottom), mode="reflect")


def analyse_at_border(even: Tensor, down: Down, across: Across) -> tuple[Tensor, Tensor, Tensor]:
    """Return the lowpass, the details and the means of the windows of planes `with_siblings`.

    They are (B, C, h, w), (B, C, 3, h, w) and (B, C, h, w). ``down`` and ``across`` are the weights
    of the pairs along h and w.
    """
    if torch.compiler.is_compiling():
        return _one_by_one(even, down, across)
    left, right = even[:, None, ..., 0::2], even[:, None, ..., 1::2]
    # Across: the mean of their own pixels, that for d2 and the window, the detail for d1 and d3.
    both = torch.addcmul(right * across.on_right, across.weights, left - right)
    top, bottom = both[..., 0::2, :], both[..., 1::2, :]
    between = top - bottom
    lowpass, window, horizontal = torch.addcmul(bottom, down.weights, between).unbind(1)
    vertical, diagonal = (down.half * between[:, 1:]).unbind(1)
    return lowpass, torch.stack((horizontal, vertical, diagonal), 2), window


def _one_by_one(even: Tensor, down: Down, across: Across) -> tuple[Tensor, Tensor, Tensor]:
    """Return the same in more operations, of which a compiler makes a kernel four times as fast."""
    (own, completed, half), (own_down, completed_down, _) = (
        of.weights[0].unbind() for of in (across, down)
    )
    half_down = down.half[0, 0]
    left, right = even[..., 0::2], even[..., 1::2]
    between = left - right
    means, seen = torch.addcmul(right, own, between), torch.addcmul(right, completed, between)
    detail = half * between
    top, bottom = means[..., 0::2, :], means[..., 1::2, :]
    lowpass = torch.addcmul(bottom, own_down, top - bottom)
    top, bottom = detail[..., 0::2, :], detail[..., 1::2, :]
    between = top - bottom
    horizontal, diagonal = torch.addcmul(bottom, completed_down, between), half_down * between
    top, bottom = seen[..., 0::2, :], seen[..., 1::2, :]
    between = top - bottom
    window = torch.addcmul(bottom, completed_down, between)
    return lowpass, torch.stack((horizontal, half_down * between, diagonal), 2), window


def means_at_border(even: Tensor, down: Down, across: Across) -> tuple[Tensor]:
    """Return the lowpass of `analyse_at_border` alone."""
    left, right = even[..., 0::2], even[..., 1::2]
    own = torch.addcmul(right, across.weights[:, 0], left - right)
    top, bottom = own[..., 0::2, :], own[..., 1::2, :]
    return (torch.addcmul(bottom, down.weights[:, 0], top - bottom),)
