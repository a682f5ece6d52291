"""Where levels lie in a column, for kernels of Triton: a table of ten numbers for each level.

`torch_vdm.run.kernels.table` makes it. The parent of node (y, x) of a level is
((y + top) // 2, (x + left) // 2).
"""

import triton
from triton import language as tl

# Where numbers lie in a level's row: the first of the programs that have its nodes, and where these
# begin; the same of its nodes' parents; and from SIZES on what `sizes_of` returns.
FIRST = tl.constexpr(0)
START = tl.constexpr(1)
FIRST_OF_PARENTS = tl.constexpr(2)
PARENTS_START = tl.constexpr(3)
SIZES = tl.constexpr(4)
NUMBERS = tl.constexpr(10)


@triton.jit
def entry(table, level, number):
    """Return a number of a level."""
    return tl.load(table + level * NUMBERS + number)


@triton.jit
def sizes_of(table, level):
    """Return height and width of a level, those of its parents, and how many come before it."""
    sizes = ()
    for number in tl.static_range(NUMBERS - SIZES):
        sizes = sizes + (entry(table, level, SIZES + number),)
    return sizes


@triton.jit
def level_of(table, levels, first: tl.constexpr, block: tl.constexpr):
    """Return the level that a program has nodes of, and which nodes, some beyond the last.

    ``first``: `FIRST` or `FIRST_OF_PARENTS`.
    """
    level, program = 0, tl.program_id(0)
    for number in range(1, levels):
        level += (entry(table, number, first) <= program).to(tl.int32)
    return level, (program - entry(table, level, first)) * block + tl.arange(0, block)
