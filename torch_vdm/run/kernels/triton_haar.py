"""A step of `Haar` and its gradient, as kernels of Triton: what `analyse` and its like compute.

`torch_vdm.run.kernels.haar` launches them; only it imports this, since Triton may not be installed.

A program has a block of nodes of one plane, (N, height, width), or of their children, (N, rows,
columns). ``top`` and ``left``, 0 or 1, are how many children are put before the first: node (y, x)
has the children 2 y - top and 2 y - top + 1, and so along x, where one beyond the border is its
neighbour, as in `with_siblings`. With ``border``, ``down`` (3, height), ``half`` (height) and
``across`` (3, width) are the weights of `Down` and `Across`; without, they and ``window`` are not
used.
"""

import triton
from triton import language as tl

# How many elements one plane begins after the last, of gradients that are parts of others.
STRIDES = ("of_lowpass", "of_details", "of_window")
SIZES = ("rows", "columns", "top", "left", "height", "width", *STRIDES)
PLANES = ("children", "lowpass", "details", "window", "down", "half", "across")


@triton.jit
def _reflected(at, side):
    """Return which child is at a place, one of the neighbours where that is beyond the border."""
    last = side - 1
    return tl.maximum(last - tl.abs(last - tl.abs(at)), 0)


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def analysis(
    children,
    lowpass,
    details,
    window,
    down,
    half,
    across,
    rows,
    columns,
    top,
    left,
    height,
    width,
    border: tl.constexpr,
    block: tl.constexpr,
):
    """Write lowpass (N, height, width), details (N, 3, ...) and, with ``border``, the window."""
    node = tl.program_id(0) * block + tl.arange(0, block)
    y, x, plane = node // width, node % width, height * width
    item, inside = tl.program_id(1).to(tl.int64), node < plane
    children += item * rows * columns
    above = _reflected(2 * y - top, rows) * columns
    below = _reflected(2 * y - top + 1, rows) * columns
    before, after = _reflected(2 * x - left, columns), _reflected(2 * x - left + 1, columns)
    one = tl.load(children + above + before, inside, 0.0)
    two = tl.load(children + above + after, inside, 0.0)
    three = tl.load(children + below + before, inside, 0.0)
    four = tl.load(children + below + after, inside, 0.0)
    if border:
        upper, lower = one - two, three - four
        weight = tl.load(across + x, inside, 0.0)
        first, second = two + weight * upper, four + weight * lower
        mean = second + tl.load(down + y, inside, 0.0) * (first - second)
        completed = tl.load(down + height + y, inside, 0.0)
        weight = tl.load(across + width + x, inside, 0.0)
        first, second = two + weight * upper, four + weight * lower
        tl.store(window + item * plane + node, second + completed * (first - second), inside)
        shorter = tl.load(half + y, inside, 0.0)
        vertical = shorter * (first - second)
        weight = tl.load(across + 2 * width + x, inside, 0.0)
        first, second = weight * upper, weight * lower
        horizontal, diagonal = second + completed * (first - second), shorter * (first - second)
    else:
        upper, lower = 0.25 * (one + three), 0.25 * (two + four)
        mean, horizontal = upper + lower, upper - lower
        upper, lower = 0.25 * (one - three), 0.25 * (two - four)
        vertical, diagonal = upper + lower, upper - lower
    tl.store(lowpass + item * plane + node, mean, inside)
    details += 3 * item * plane + node
    tl.store(details, horizontal, inside)
    tl.store(details + plane, vertical, inside)
    tl.store(details + 2 * plane, diagonal, inside)


@triton.jit
def _gradient(y, x, inside, gradients, weights, height, width, of_details, border: tl.constexpr):
    """Return the gradient by the child at a place that may lie beyond the border; 0 if outside.

    ``gradients`` are those by what `analysis` writes, ``weights`` are ``down``, ``half``,
    ``across``.
    """
    lowpass, details, window = gradients
    down, half, across = weights
    node, on_bottom, on_right = (y // 2) * width + x // 2, y % 2 == 1, x % 2 == 1
    mean = tl.load(lowpass + node, inside, 0.0)
    horizontal = tl.load(details + node, inside, 0.0)
    vertical = tl.load(details + of_details + node, inside, 0.0)
    diagonal = tl.load(details + 2 * of_details + node, inside, 0.0)
    if border:
        seen = tl.load(window + node, inside, 0.0)
        y, x = y // 2, x // 2
        own, completed = tl.load(down + y, inside, 0.0), tl.load(down + height + y, inside, 0.0)
        shorter = tl.load(half + y, inside, 0.0)
        # Along y first: the gradients by the mean, by that for the details, and by the details.
        first = own * mean
        first_completed = completed * seen + shorter * vertical
        first_detail = completed * horizontal + shorter * diagonal
        of_mean = tl.where(on_bottom, mean - first, first)
        of_completed = tl.where(on_bottom, seen - first_completed, first_completed)
        of_detail = tl.where(on_bottom, horizontal - first_detail, first_detail)
        found = tl.load(across + x, inside, 0.0) * of_mean
        found += tl.load(across + width + x, inside, 0.0) * of_completed
        found += tl.load(across + 2 * width + x, inside, 0.0) * of_detail
        found = tl.where(on_right, of_mean + of_completed - found, found)
    else:
        means = tl.where(on_right, mean - horizontal, mean + horizontal)
        differences = tl.where(on_right, vertical - diagonal, vertical + diagonal)
        found = 0.25 * tl.where(on_bottom, means - differences, means + differences)
    return found


@triton.jit
def _places(at, side, before, number: tl.constexpr):
    """Return a place of a child beside its siblings, and whether it is there.

    A child is at its own place, 0, and perhaps once more before the first one, 1, or after the
    last, 2.
    """
    last = side - 1
    if number == 0:
        place, there = at + before, at >= 0
    elif number == 1:
        place, there = at * 0, at == tl.where(before == 1, tl.minimum(last, 1), -1)
    else:
        place, odd = at * 0 + side + before, (side + before) % 2 == 1
        there = at == tl.where(odd, tl.maximum(last - 1, 0), -1)
    return place, there


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def synthesis(
    children,
    lowpass,
    details,
    window,
    down,
    half,
    across,
    rows,
    columns,
    top,
    left,
    height,
    width,
    of_lowpass,
    of_details,
    of_window,
    border: tl.constexpr,
    block: tl.constexpr,
):
    """Write the gradient by ``children`` of `analysis`, from those by what it writes.

    These are planes of whole rows that begin ``of_lowpass``, ``of_details`` and ``of_window``
    elements after one another.
    """
    child = tl.program_id(0) * block + tl.arange(0, block)
    y, x, item = child // columns, child % columns, tl.program_id(1).to(tl.int64)
    inside = child < rows * columns
    details += 3 * item * of_details
    gradients = (lowpass + item * of_lowpass, details, window + item * of_window)
    weights = (down, half, across)
    total = tl.full(child.shape, 0.0, children.dtype.element_ty)
    for vertical in tl.static_range(3):
        row, of_row = _places(y, rows, top, vertical)
        for horizontal in tl.static_range(3):
            column, of_column = _places(x, columns, left, horizontal)
            there = inside & of_row & of_column
            total += _gradient(
                row, column, there, gradients, weights, height, width, of_details, border
            )
    tl.store(children + item * rows * columns + child, total, inside)


# Whether Triton's interpreter runs them, on a processor.
INTERPRETED = not isinstance(analysis, triton.JITFunction)
