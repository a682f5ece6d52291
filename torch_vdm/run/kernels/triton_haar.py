"""A step of `Haar` and its gradient, as kernels of Triton: what `analyse` and its like compute.

`torch_vdm.run.kernels.haar` launches them; only it imports this, since Triton may not be installed.

A program has a block of nodes of one plane. The planes (N, 2 height, 2 width) have even sides, as
`analyse` takes them. With ``border``, ``down`` (3, height), ``half`` (height) and ``across``
(3, width) are the weights of `Down` and `Across`; without, they and ``window`` are not used.
"""

import triton
from triton import language as tl

SIZES = ("height", "width")
PLANES = ("even", "lowpass", "details", "window", "down", "half", "across")


@triton.jit
def _of_node(height, width, block: tl.constexpr):
    """Return a program's nodes, row, column and plane, and how many nodes a plane has."""
    node = tl.program_id(0) * block + tl.arange(0, block)
    return node, node // width, node % width, tl.program_id(1).to(tl.int64), height * width


@triton.jit
def _children(y, x, width):
    """Return where the four children of a node are: two on its left and right, and those below."""
    first = 4 * y * width + 2 * x
    return first, first + 1, first + 2 * width, first + 2 * width + 1


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def analysis(
    even,
    lowpass,
    details,
    window,
    down,
    half,
    across,
    height,
    width,
    border: tl.constexpr,
    block: tl.constexpr,
):
    """Write lowpass (N, height, width), details (N, 3, ...) and, with ``border``, the window."""
    node, y, x, item, plane = _of_node(height, width, block)
    inside = node < plane
    even += 4 * item * plane
    one, two, three, four = _children(y, x, width)
    left, right = tl.load(even + one, inside, 0.0), tl.load(even + two, inside, 0.0)
    left_below, right_below = tl.load(even + three, inside, 0.0), tl.load(even + four, inside, 0.0)
    if border:
        upper, lower = left - right, left_below - right_below
        weight = tl.load(across + x, inside, 0.0)
        top, bottom = right + weight * upper, right_below + weight * lower
        mean = bottom + tl.load(down + y, inside, 0.0) * (top - bottom)
        completed = tl.load(down + height + y, inside, 0.0)
        weight = tl.load(across + width + x, inside, 0.0)
        top, bottom = right + weight * upper, right_below + weight * lower
        tl.store(window + item * plane + node, bottom + completed * (top - bottom), inside)
        shorter = tl.load(half + y, inside, 0.0)
        vertical = shorter * (top - bottom)
        weight = tl.load(across + 2 * width + x, inside, 0.0)
        top, bottom = weight * upper, weight * lower
        horizontal, diagonal = bottom + completed * (top - bottom), shorter * (top - bottom)
    else:
        upper, lower = 0.25 * (left + left_below), 0.25 * (right + right_below)
        mean, horizontal = upper + lower, upper - lower
        upper, lower = 0.25 * (left - left_below), 0.25 * (right - right_below)
        vertical, diagonal = upper + lower, upper - lower
    tl.store(lowpass + item * plane + node, mean, inside)
    details += 3 * item * plane + node
    tl.store(details, horizontal, inside)
    tl.store(details + plane, vertical, inside)
    tl.store(details + 2 * plane, diagonal, inside)


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def synthesis(
    even,
    lowpass,
    details,
    window,
    down,
    half,
    across,
    height,
    width,
    border: tl.constexpr,
    block: tl.constexpr,
):
    """Write to ``even`` the gradient of `analysis`, from those by what it writes."""
    node, y, x, item, plane = _of_node(height, width, block)
    inside = node < plane
    mean = tl.load(lowpass + item * plane + node, inside, 0.0)
    details += 3 * item * plane + node
    horizontal = tl.load(details, inside, 0.0)
    vertical = tl.load(details + plane, inside, 0.0)
    diagonal = tl.load(details + 2 * plane, inside, 0.0)
    even += 4 * item * plane
    one, two, three, four = _children(y, x, width)
    if border:
        seen = tl.load(window + item * plane + node, inside, 0.0)
        completed, shorter = tl.load(down + height + y, inside, 0.0), tl.load(half + y, inside, 0.0)
        top = tl.load(down + y, inside, 0.0) * mean
        top_completed = completed * seen + shorter * vertical
        top_detail = completed * horizontal + shorter * diagonal
        own, half_way = tl.load(across + x, inside, 0.0), tl.load(across + width + x, inside, 0.0)
        detail = tl.load(across + 2 * width + x, inside, 0.0)
        left = own * top + half_way * top_completed + detail * top_detail
        tl.store(even + one, left, inside)
        tl.store(even + two, top + top_completed - left, inside)
        bottom, bottom_completed = mean - top, seen - top_completed
        left = own * bottom + half_way * bottom_completed + detail * (horizontal - top_detail)
        tl.store(even + three, left, inside)
        tl.store(even + four, bottom + bottom_completed - left, inside)
    else:
        upper, lower = 0.25 * (mean + horizontal), 0.25 * (mean - horizontal)
        plus, minus = 0.25 * (vertical + diagonal), 0.25 * (vertical - diagonal)
        tl.store(even + one, upper + plus, inside)
        tl.store(even + two, lower + minus, inside)
        tl.store(even + three, upper - plus, inside)
        tl.store(even + four, lower - minus, inside)


# Whether Triton's interpreter runs them, on a processor.
INTERPRETED = not isinstance(analysis, triton.JITFunction)
