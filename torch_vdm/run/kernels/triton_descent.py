"""A step down the quad-tree and its gradient, as kernels of Triton: what `passed_down` computes.

`torch_vdm.run.kernels.descent` launches them; only it imports this, since Triton may not be
installed.

Planes are contiguous: (B, 1, height, width) of nodes, and (B, 1, above, across) of their parents.
The parent of node (y, x) is ((y + top) // 2, (x + left) // 2).
"""

import triton
from triton import language as tl

SIZES = ("height", "width", "above", "across", "top", "left")
PLANES = ("nodes", "total", "inherited", "passed", "gradient", "by_total", "by_inherited")


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def descent(
    nodes,
    total,
    inherited,
    passed,
    height,
    width,
    above,
    across,
    top,
    left,
    block: tl.constexpr,
):
    """Write what has accumulated at nodes to ``passed``."""
    node = tl.program_id(0) * block + tl.arange(0, block)
    item, plane = tl.program_id(1).to(tl.int64), height * width
    inside, at = node < plane, item * plane + node
    parent = (node // width + top) // 2 * across + (node % width + left) // 2
    above_it = tl.load(total + item * above * across + parent, inside, 0.0)
    share = tl.load(inherited + at, inside, 0.0)
    tl.store(passed + at, tl.load(nodes + at, inside, 0.0) + above_it * share, inside)


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def ascent(
    gradient,
    total,
    inherited,
    by_total,
    by_inherited,
    height,
    width,
    above,
    across,
    top,
    left,
    block: tl.constexpr,
):
    """Write the gradients by what has accumulated at parents, and by shares, of `descent`."""
    node = tl.program_id(0) * block + tl.arange(0, block)
    item, plane = tl.program_id(1).to(tl.int64), height * width
    known, parent = node < above * across, item * above * across + node
    accumulated = tl.load(total + parent, known, 0.0)
    summed = tl.full(node.shape, 0.0, total.dtype.element_ty)
    for child in tl.static_range(4):
        y = 2 * (node // across) - top + child // 2
        x = 2 * (node % across) - left + child % 2
        inside = known & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        at = item * plane + y * width + x
        slope = tl.load(gradient + at, inside, 0.0)
        summed += slope * tl.load(inherited + at, inside, 0.0)
        tl.store(by_inherited + at, slope * accumulated, inside)
    tl.store(by_total + parent, summed, known)


# Whether Triton's interpreter runs them, on a processor.
INTERPRETED = not isinstance(descent, triton.JITFunction)
