"""Where levels lie in a column, for kernels: one launch then computes all of them."""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.grid import Before
from torch_vdm.run import kernels
from torch_vdm.run.column import Sizes, kept_for


class Table(NamedTuple):
    """Where the nodes of levels, and the parents of each level's nodes, lie in two columns."""

    rows: Tensor
    """(levels, 10), integers: as `triton_table` reads it."""
    sizes: Sizes
    """(h, w) of each level."""
    nodes: int
    parents: int
    programs: int
    """How many programs have the nodes."""
    programs_of_parents: int


def table_of(sizes: Sizes, above: Sizes, before: Sequence[Before], like: Tensor) -> Table:
    """Return the table of levels on the device of a plane, the coarsest level first.

    ``above``: the sizes of the planes that hold the parents of each level. ``before``: how many
    nodes are put before the first of each to find these.
    """
    # The number of nodes of a program is part of what it depends on.
    made = kept_for(like)
    table: Table = made(_table, sizes, above, tuple(before), like.device, kernels.BLOCK)
    return table


def _table(
    sizes: Sizes, above: Sizes, before: tuple[Before, ...], device: torch.device, block: int
) -> Table:
    firsts: list[list[int]] = []
    for planes in (sizes, above):
        counts = list(map(math.prod, planes))
        firsts += [kernels.programs(count, block) for count in counts], counts
    begins = [list(accumulate(each, initial=0)) for each in firsts]
    rows = [
        [*begin, *size, *parents, *first]
        for *begin, size, parents, first in zip(
            *(each[:-1] for each in begins), sizes, above, before, strict=True
        )
    ]
    programs, nodes, programs_of_parents, parents = (each[-1] for each in begins)
    places = torch.tensor(rows, dtype=torch.int32).to(device)
    return Table(places, sizes, nodes, parents, programs, programs_of_parents)
