"""What an image is refused for: its size, and values that are no light."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]

# Limits (choices). Pillow warns above this many pixels, and a metric would need tens of gigabytes.
MAX_PIXELS = 2**28 // 3
MAX_SIDE = 2**16 - 1
# A file may always declare this much; above it, no more than RATIO times its own size, which is
# twice what deflate can reach (1032).
FREE_BYTES = 2**28
RATIO = 2000


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
    """x, y of the first pixel, row by row, of which a channel of `bad` (C, H, W) is true."""
    y, x = np.unravel_index(int(np.argmax(bad.any(0))), bad.shape[1:])
    return int(x), int(y)


def require_finite(
    planes: Floats, policy: str, notes: list[str], origin: tuple[int, int] = (0, 0), step: int = 1
) -> Floats:
    """Refuse or repair NaN and infinity; pixel i, j of `planes` is at origin + step * (i, j)."""
    bad = ~np.isfinite(planes)
    count = int(bad.sum())
    if not count:
        return planes
    x, y = first_pixel(bad)
    what = (
        f"{count} NaN or infinite value{'s' * (count > 1)} "
        f"(the first at x={origin[0] + step * x}, y={origin[1] + step * y})"
    )
    if policy == "raise":
        raise ImageError(
            f"expected finite values, got {what}; render it again, or put 0 in their place with "
            "--nonfinite zero"
        )
    notes.append(f"0 was put in the place of {what}.")
    return np.where(bad, np.float32(0), planes)


def without_negatives(
    planes: Floats, policy: str, notes: list[str], origin: tuple[int, int] = (0, 0)
) -> Floats:
    """Return ``planes`` with negative values kept, refused or replaced by 0.

    Their first pixel is ``origin``, x and y, of the image.
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
