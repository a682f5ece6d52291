"""The items of a batch below one another: code that is compiled for one image serves a batch.

Every tensor of four or more dimensions has a batch axis first: as many items as the batch, or one
that is the same for all. Planes (B, ..., h, w) become (1, ..., B h, w). Planes whose batch axis is
in memory just before their rows, as those that come back, are not copied.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional


def below(of: Any, items: int) -> Any:
    """Return arguments of a step with all items of their planes below one another."""
    if not isinstance(of, Tensor):
        return _each(lambda part: below(part, items), of)
    if of.ndim < 4 or of.shape[-2:] == (1, 1):
        return of
    if of.shape[0] == items:
        planes = of.movedim(0, -3)
        return unviewed(planes, (1, *planes.shape[:-3], items * planes.shape[-2], planes.shape[-1]))
    # The same for all items.
    return of.repeat(*[1] * (of.ndim - 2), items, 1) if of.shape[-2] > 1 else of


def unviewed(plane: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return a plane in another shape, with the same memory but not as a view.

    Compiled code is specialised on views.
    """
    found: Tensor = torch.ops.aten._unsafe_view(plane.contiguous(), shape)
    return found


def apart(of: Any, items: int, lost: int = 0) -> Any:
    """Return the results (1, ..., B h, w) of a step, (B, ..., h, w).

    ``lost``: how many rows each item, and so the plane of all, has fewer than what was passed.
    """
    if not isinstance(of, Tensor):
        return _each(lambda part: apart(part, items, lost), of)
    if of.shape[-2] < items:  # the same for all items
        return of
    # What lies between two items mixes both of them.
    whole = functional.pad(of, (0, 0, 0, lost)) if lost else of
    planes = whole.unflatten(-2, (items, -1)).movedim(-3, 0).squeeze(1)
    return planes[..., : planes.shape[-2] - lost, :] if lost else planes


def rows_lost(around: Tensor, valid: Any, items: int) -> int:
    """Return how many rows fewer than ``around``, of one item, the results of a step have."""
    plane: Tensor = valid if isinstance(valid, Tensor) else valid[0]
    return items * around.shape[-2] - plane.shape[-2]


def _each(function: Callable[[Any], Any], of: Any) -> Any:
    if isinstance(of, dict):
        return {name: function(part) for name, part in of.items()}
    if isinstance(of, tuple) and hasattr(of, "_fields"):
        return type(of)(*map(function, of))
    return type(of)(map(function, of)) if isinstance(of, tuple | list) else of
