"""Spatial pooling, the eighth box of Fig. 2: neighbouring detectors add up."""

from torch import Tensor
from torch.nn import functional

from torch_vdm.model.quadtree import apart, together


def surround(responses: Tensor, items: int = 1) -> Tensor:
    """Repeat the border of (B, channels, orientations, h, w) once on every side.

    Of each of ``items`` that lie below one another: `within` takes it off again.
    """
    planes = responses if items == 1 else apart(responses[0], items)
    surrounded = functional.pad(planes, (1, 1, 1, 1, 0, 0), mode="replicate")
    return surrounded if items == 1 else together(surrounded).unsqueeze(0)


def within(pooled: Tensor, rows: int, items: int) -> Tensor:
    """Return the ``rows`` of items that `surround` has made larger and `pool` has pooled as one.

    From (1, 1, items (h + 2) - 2, w) to (1, 1, items h, w).
    """
    if items == 1 or pooled.shape[-2] == rows:
        return pooled
    # What lies between two items is of both of them.
    return together(apart(functional.pad(pooled, (0, 0, 0, 2)), items)[..., :-2, :].contiguous())


# How many nodes `pool_sums` adds up.
POOLED = 9.0


def pool_sums(surrounded: Tensor) -> Tensor:
    """Return `POOLED` times what `pool` does, where that is divided by later, for less."""
    rows = surrounded[..., :-2, :] + surrounded[..., 1:-1, :]
    rows = rows.add_(surrounded[..., 2:, :])
    return (rows[..., :-2] + rows[..., 1:-1]).add_(rows[..., 2:])


def pool(surrounded: Tensor) -> Tensor:
    """Return the mean of every node's 3x3 neighbourhood.

    From (B, channels, orientations, h + 2, w + 2), made by `surround`, to (..., h, w). The paper
    prints the size of the filter (against Sarnoff's 5x5) but not its weights: equal ones are a
    choice; a box of 3 nodes spans 2.2 cycles of its level, near the 2.5 of Wilson 1991.
    """
    return pool_sums(surrounded) / POOLED


def phase_energy(responses: Tensor, phases: int) -> Tensor:
    """Return the mean square of every ``phases`` successive orientations.

    Of overlapping nodes and of quadrature pairs the energy is pooled: it hardly depends on the
    phase of a grating, where the mean of absolute values does.
    """
    energy = responses * responses
    return energy.unflatten(2, (-1, phases)).mean(3) if phases > 1 else energy


def surround_halves(energy: Tensor, nodes: int) -> Tensor:
    """Repeat the border as `pool_halves` needs, over ``nodes`` nodes."""
    sides = (nodes, nodes - 1, nodes, nodes - 1, 0, 0)
    return functional.pad(energy, sides, mode="replicate")


def pool_halves(surrounded: Tensor, nodes: int, dim: int) -> Tensor:
    """Return along ``dim``, for every half of a node, the sum over those who cover it.

    The halves of a node are covered by two overlapping nodes, ``nodes`` times as many with the
    nodes beside these: 3 of them is the 3x3 pooling of `pool` at each shift, and the mean of the
    shifts, once the sum along both sides is divided by `covering`.
    """
    length = surrounded.shape[dim] - 1
    total = surrounded.narrow(dim, 0, length) + surrounded.narrow(dim, 1, length)
    pairs = [total.narrow(dim, 2 * node, length - 2 * (nodes - 1)) for node in range(nodes)]
    total = pairs[0]
    for pair in pairs[1:]:
        total = total + pair
    return total


def covering(nodes: int) -> float:
    """Return how many nodes `pool_halves` adds up for the half of a node, in x and in y."""
    return float((2 * nodes) ** 2)
