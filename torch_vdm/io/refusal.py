"""What an image is refused for: its size, and values that are not light."""

from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]

# Limits (choices). Pillow warns above this many pixels, and a metric would need tens of gigabytes.
MAX_PIXELS = 2**28 // 3
MAX_SIDE = 2**16 - 1
# A file may always declare this many bytes; above that, at most RATIO times its own size, which is
# twice what deflate can reach (1032).
FREE_BYTES = 2**28
RATIO = 2000


Nonfinite: TypeAlias = Literal["raise", "zero", "clamp"]
Negative: TypeAlias = Literal["keep", "raise", "clip"]


class Repair(NamedTuple):
    """What to do about values that are not light; see `torch_vdm.io.load`."""

    nonfinite: Nonfinite
    negative: Negative


class ImageError(ValueError):
    """An image file that cannot be read or written as asked; the message is one line."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def printable(text: str) -> str:
    """Return ``text`` with whatever a terminal would not print escaped."""
    # Names of files, parts and channels are foreign text: a line feed, an escape sequence or half a
    # surrogate pair among them must not reach a terminal.
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def check_size(width: int, height: int, decoded: int, size: int) -> None:
    """Refuse what would exhaust memory, and what the file is too small to hold."""
    if width < 1 or height < 1:
        raise ImageError(f"damaged: {width} x {height} pixels; export it again")
    if width > MAX_SIDE or height > MAX_SIDE or width * height > MAX_PIXELS:
        raise ImageError(
            f"expected at most {MAX_PIXELS} pixels and {MAX_SIDE} a side, got {width} x {height}; "
            "crop it or make it smaller"
        )
    if decoded > max(FREE_BYTES, RATIO * size):
        raise ImageError(
            f"damaged: {width} x {height} pixels would take {decoded} bytes, too many for a file "
            f"of {size} bytes; export it again"
        )


def first_pixel(bad: NDArray[np.bool_]) -> tuple[int, int]:
    """x, y of the first pixel, row by row, where a channel of `bad` (C, H, W) is true."""
    y, x = np.unravel_index(int(np.argmax(bad.any(0))), bad.shape[1:])
    return int(x), int(y)


def require_finite(
    planes: Floats,
    policy: str,
    notes: list[str],
    origin: tuple[int, int] = (0, 0),
    step: int = 1,
    largest: Floats | None = None,
) -> Floats:
    """Refuse or repair NaN and infinity; pixel i, j of `planes` is at origin + step * (i, j).

    ``largest`` holds the largest finite value of each channel's type in the file; None: that of
    `planes`.
    """
    bad = ~np.isfinite(planes)
    count = int(bad.sum())
    if not count:
        return planes
    x, y = first_pixel(bad)
    told = (
        f"{count} NaN or infinite value{'s' * (count > 1)} "
        f"(the first at x={origin[0] + step * x}, y={origin[1] + step * y})"
    )
    if policy == "raise":
        raise ImageError(
            f"expected finite values, got {told}; render it again, or put 0 in their place with "
            "--nonfinite zero, or hold infinity to the largest value with --nonfinite clamp"
        )
    if policy == "zero":
        notes.append(f"0 was put in the place of {told}.")
        return np.where(bad, planes.dtype.type(0), planes)
    if largest is None:
        largest = np.full(len(planes), np.finfo(planes.dtype).max, planes.dtype)
    notes.append(f"Infinity was held to {largest.max():g} and NaN to its neighbours' mean: {told}.")
    return _clamped(planes, bad, largest[:, None, None])


def _clamped(planes: Floats, bad: NDArray[np.bool_], largest: Floats) -> Floats:
    """Infinity as +-largest, NaN as the mean of its finite neighbours in the plane, or 0."""
    held = np.where(bad, np.copysign(largest, planes), planes)
    where = np.nonzero(np.isnan(planes))
    total, count = np.zeros(len(where[0])), np.zeros(len(where[0]))
    height, width = planes.shape[1:]
    for down, right in ((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b):
        y, x = where[1] + down, where[2] + right
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        near = where[0], y.clip(0, height - 1), x.clip(0, width - 1)
        good = inside & ~bad[near]
        total += np.where(good, held[near], 0)
        count += good
    held[where] = total / np.maximum(count, 1)
    return held


def without_negatives(
    planes: Floats, policy: str, notes: list[str], origin: tuple[int, int] = (0, 0)
) -> Floats:
    """Return ``planes`` with negative values kept, refused or replaced by 0.

    Their first pixel is at ``origin``, x and y, in the image.
    """
    if policy == "keep" or planes.min() >= 0:
        return planes
    bad = planes < 0
    count = int(bad.sum())
    x, y = (begin + place for begin, place in zip(origin, first_pixel(bad), strict=True))
    what = (
        f"{count} negative value{'s' * (count > 1)} (the first at x={x}, y={y}; the lowest is "
        f"{planes.min():.3g})"
    )
    if policy == "raise":
        raise ImageError(
            f"expected no negative values, got {what}; put 0 in their place with --negative clip, "
            "or let them pass with --negative keep"
        )
    notes.append(f"0 was put in the place of {what}.")
    return np.maximum(planes, np.float32(0))
