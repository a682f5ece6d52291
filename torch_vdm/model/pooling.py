"""Spatial pooling, the eighth box of Fig. 2: neighbouring detectors add up."""

from torch import Tensor

# How many nodes `pool_sums` adds up.
POOLED = 9.0


def pool_sums(surrounded: Tensor) -> Tensor:
    """Return `POOLED` times what `pool` does, to be divided later, where that costs less."""
    rows = surrounded[..., :-2, :] + surrounded[..., 1:-1, :]
    rows = rows.add_(surrounded[..., 2:, :])
    return (rows[..., :-2] + rows[..., 1:-1]).add_(rows[..., 2:])


def pool(surrounded: Tensor) -> Tensor:
    """Return the mean of every node's 3x3 neighbourhood.

    It is (..., h, w) from (B, channels, orientations, h + 2, w + 2), which `surround` makes. The
    paper prints the size of the filter (against Sarnoff's 5x5) but not its weights: equal ones are
    a choice; a box of 3 nodes spans 2.2 cycles of its level, near the 2.5 of Wilson 1991.
    """
    return pool_sums(surrounded) / POOLED


def phase_energy(responses: Tensor, phases: int) -> Tensor:
    """Return the mean square of every ``phases`` successive orientations.

    For overlapping nodes and quadrature pairs the energy is pooled: it hardly depends on the phase
    of a grating, whereas the mean of absolute values does.
    """
    energy = responses * responses
    return energy.unflatten(2, (-1, phases)).mean(3) if phases > 1 else energy


def pool_halves(surrounded: Tensor, nodes: int, dim: int) -> Tensor:
    """Return along ``dim``, for every half of a node, the sum over the nodes that cover it.

    The border has to be repeated ``nodes`` times before and ``nodes`` - 1 times after the halves.

    Each half is covered by two overlapping nodes, and by ``nodes`` times as many when their
    neighbours are included. With 3 this is the 3x3 pooling of `pool` at each shift, averaged over
    the shifts, once the sum along both axes is divided by `covering`.
    """
    length = surrounded.shape[dim] - 1
    total = surrounded.narrow(dim, 0, length) + surrounded.narrow(dim, 1, length)
    pairs = [total.narrow(dim, 2 * node, length - 2 * (nodes - 1)) for node in range(nodes)]
    total = pairs[0]
    for pair in pairs[1:]:
        total = total + pair
    return total


def covering(nodes: int) -> float:
    """Return how many nodes `pool_halves` adds up for the half of a node, over x and y."""
    return float((2 * nodes) ** 2)
