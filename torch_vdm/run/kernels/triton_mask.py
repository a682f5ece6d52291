"""Two images with pixels replaced that are not finite, as a kernel of Triton: `finite_in_both`.

`torch_vdm.run.kernels.mask` launches it; only it imports this, since Triton may not be installed.

A program has one of the largest squares of one item. Images are contiguous, (B, 3, height, width).
"""

import triton
from triton import language as tl

from torch_vdm.images import SQUARE

SIZES = ("height", "width")
PLANES = ("test", "reference", "finite_test", "finite_reference")
BYTES = ("seen",)

# How often a square can be halved.
HALVINGS = tl.constexpr(SQUARE.bit_length() - 1)

# Below the smallest share of finite pixels that there can be.
TINY = tl.constexpr(1e-6)


@triton.jit
def _added(one, other):
    return one + other


@triton.jit
def _halved(plane, side: tl.constexpr):
    """Return the means of 2x2 of a square plane."""
    left, right = tl.split(tl.reshape(plane, (side, side // 2, 2)))
    rows = tl.reshape(left + right, (side // 2, 2, side // 2))
    top, bottom = tl.split(tl.permute(rows, (0, 2, 1)))
    return 0.25 * (top + bottom)


@triton.jit
def _doubled(plane, side: tl.constexpr):
    """Return a plane in which 2x2 have the value of one, ``side`` elements a side."""
    squares = tl.broadcast_to(plane[:, None, :, None], (side // 2, 2, side // 2, 2))
    return tl.reshape(squares, (side, side))


@triton.jit
def _smaller(plane, block: tl.constexpr):
    """Return the plane and its means over squares of 2, 4 ... ``block`` elements a side."""
    planes = (plane,)
    for halving in tl.static_range(HALVINGS):
        planes = planes + (_halved(planes[halving], block // 2**halving),)
    return planes


@triton.jit
def _around(total, share, block: tl.constexpr):
    """Return at every pixel the mean of the smallest square with a finite pixel; 0 if none has one.

    ``total``: the sum of both images where they are finite, half of it; ``share``: how much of them
    is.
    """
    totals, shares = _smaller(total, block), _smaller(share, block)
    found = totals[HALVINGS] / tl.maximum(shares[HALVINGS], TINY)
    for up in tl.static_range(1, HALVINGS + 1):
        mean = totals[HALVINGS - up] / tl.maximum(shares[HALVINGS - up], TINY)
        wider = _doubled(found, block // 2 ** (HALVINGS - up))
        found = tl.where(shares[HALVINGS - up] > 0.0, mean, wider)
    return found


@triton.jit
def _is_finite(image, plane, at, inside):
    """Return whether all channels of a pixel are finite."""
    finite = inside
    for channel in tl.static_range(3):
        value = tl.load(image + channel * plane + at, inside, 0.0)
        finite = finite & (tl.abs(value) < float("inf"))
    return finite


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=(*PLANES, *BYTES))
def finite_in_both(
    test, reference, finite_test, finite_reference, seen, height, width, block: tl.constexpr
):
    """Write both images, and where all is finite in both of them: (B, 1, height, width), bytes."""
    across = (width + block - 1) // block
    y = tl.program_id(0) // across * block + tl.arange(0, block)[:, None]
    x = tl.program_id(0) % across * block + tl.arange(0, block)[None, :]
    inside, at = (y < height) & (x < width), y * width + x
    item, plane = tl.program_id(1).to(tl.int64), height.to(tl.int64) * width
    test += 3 * item * plane
    reference += 3 * item * plane
    in_test = _is_finite(test, plane, at, inside)
    in_reference = _is_finite(reference, plane, at, inside)
    both, either = in_test & in_reference, in_test | in_reference
    tl.store(seen + item * plane + at, both.to(tl.uint8), inside)
    share = 0.5 * (in_test.to(test.dtype.element_ty) + in_reference.to(test.dtype.element_ty))
    lost = _smaller((inside & ~either).to(test.dtype.element_ty), block)[HALVINGS]
    lost = tl.reduce(tl.reduce(lost, 1, _added), 0, _added)
    finite_test += 3 * item * plane + at
    finite_reference += 3 * item * plane + at
    for channel in tl.static_range(3):
        one = tl.load(test + channel * plane + at, inside, 0.0)
        two = tl.load(reference + channel * plane + at, inside, 0.0)
        filled = tl.where(in_test, one, two)
        if lost > 0:
            total = 0.5 * (tl.where(in_test, one, 0.0) + tl.where(in_reference, two, 0.0))
            filled = tl.where(either, filled, _around(total, share, block))
        tl.store(finite_test + channel * plane, tl.where(both, one, filled), inside)
        tl.store(finite_reference + channel * plane, tl.where(both, two, filled), inside)


# Whether Triton's interpreter runs it, on a processor.
INTERPRETED = not isinstance(finite_in_both, triton.JITFunction)
