"""The way down the quad-tree and its gradient, as kernels of Triton: what `accumulate` computes.

`torch_vdm.run.kernels.descent` launches them; only it imports this, since Triton may not be
installed.

All levels lie in one column, as ``table`` says, see `triton_table`: local differences, the shares
that nodes inherit, and what has accumulated at them, (B, 1, ``nodes``) each. The parent of the root
is what every path starts from, ``root`` (B).
"""

import triton
from triton import language as tl

from torch_vdm.run.kernels.triton_table import FIRST, START, entry, level_of, sizes_of

SIZES = ("levels", "nodes", "number")
PLANES = ("local", "inherited", "root", "total", "leaves", "by_local", "by_inherited", "by_root")
TABLES = ("table",)


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def descent(local, inherited, root, table, total, leaves, levels, nodes, block: tl.constexpr):
    """Write what has accumulated at the nodes of all levels to ``total``.

    That of the finest level goes to a plane of its own instead, ``leaves`` (B, 1, h, w).
    """
    level, node = level_of(table, levels, FIRST, block)
    item = tl.program_id(1).to(tl.int64)
    local += item * nodes
    inherited += item * nodes
    height, width, _, _, _, _ = sizes_of(table, level)
    inside, at = node < height * width, entry(table, level, START) + node
    y, x = node // width, node % width
    if level == levels - 1:
        target = leaves + item * height * width + node
    else:
        target = total + item * nodes + at
    # From the node up to the root: what it has itself, and the share of what is above it.
    found = tl.full(node.shape, 0.0, local.dtype.element_ty)
    share = tl.full(node.shape, 1.0, local.dtype.element_ty)
    for up in range(level + 1):
        _, across, _, _, top, left = sizes_of(table, level - up)
        at = entry(table, level - up, START) + y * across + x
        found += share * tl.load(local + at, inside, 0.0)
        share *= tl.load(inherited + at, inside, 0.0)
        y, x = (y + top) // 2, (x + left) // 2
    tl.store(target, found + share * tl.load(root + item), inside)


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def ascent(
    by_local,
    total,
    inherited,
    root,
    table,
    by_inherited,
    by_root,
    nodes,
    number,
    block: tl.constexpr,
):
    """Write the gradients of `descent` by the shares of level ``number``, and by its parents.

    ``by_local`` holds the gradients by what has accumulated at the level, and gets those of the
    level above, or else ``by_root`` does: they are those by local differences, too.
    """
    node = tl.program_id(0) * block + tl.arange(0, block)
    item = tl.program_id(1).to(tl.int64)
    height, width, above, across, top, left = sizes_of(table, number)
    start = item * nodes + entry(table, number, START)
    if number > 0:
        parents = item * nodes + entry(table, number - 1, START)
        seen, found = total + parents, by_local + parents
    else:
        above, across = 1, 1
        seen, found = root + item, by_root + item
    known = node < above * across
    accumulated = tl.load(seen + node, known, 0.0)
    summed = tl.full(node.shape, 0.0, total.dtype.element_ty)
    for child in tl.static_range(4):
        y = 2 * (node // across) - top + child // 2
        x = 2 * (node % across) - left + child % 2
        inside = known & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        at = start + y * width + x
        slope = tl.load(by_local + at, inside, 0.0)
        summed += slope * tl.load(inherited + at, inside, 0.0)
        tl.store(by_inherited + at, slope * accumulated, inside)
    tl.store(found + node, summed, known)


# Whether Triton's interpreter runs them, on a processor.
INTERPRETED = not isinstance(descent, triton.JITFunction)
