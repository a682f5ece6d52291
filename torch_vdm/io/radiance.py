"""Radiance's .hdr files: light in four bytes per pixel, three of them with a common exponent."""

import re

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.decoded import Decoded
from torch_vdm.io.primaries import BT709, XYZ, converted, is_identity, rgb_to_xyz, to_bt709
from torch_vdm.io.refusal import Floats, ImageError, check_size, require_finite

# "Radiance File Formats" (Ward): the line with the picture's size. The first axis is that of lines.
_SIZE = re.compile(rb"([-+][XY]) (\d{1,9}) ([-+][XY]) (\d{1,9})")

# The longest header that is read, in bytes. Status: choice.
LONGEST_HEADER = 2**16


def load_hdr(data: bytes, nonfinite: str, notes: list[str]) -> Decoded:
    """Return the image of a Radiance file: linear BT.709, 1.0 is what the scene calls white."""
    variables, (axes, lines, length), at = _header(data)
    check_size(length, lines, 4 * length * lines, len(data))
    pixels = _pixels(data, at, lines, length)
    # With an exponent of 128 the only factor is the 1 / 256 of the bytes.
    factor = np.ldexp(np.float32(1), pixels[..., 3].astype(np.int32) - 136)
    factor[pixels[..., 3] == 0] = 0
    image = np.moveaxis(pixels[..., :3], -1, 0).astype(np.float32) * factor
    image = _upright(image, axes)
    image = require_finite(_colours(image, variables, notes), nonfinite, notes)
    return Decoded(np.ascontiguousarray(image), "scene")


def _header(data: bytes) -> tuple[list[tuple[str, str]], tuple[bytes, int, int], int]:
    """The variables, the axes and sizes (lines, pixels of a line), and where pixels begin."""
    head, _, rest = data[:LONGEST_HEADER].partition(b"\n\n")
    line = rest.partition(b"\n")[0]
    size = _SIZE.fullmatch(line)
    if size is None or size[1][1:] == size[3][1:] or not (int(size[2]) and int(size[4])):
        raise ImageError("damaged Radiance file: its size cannot be read; export it again")
    variables = []
    for text in head.decode("latin-1").split("\n")[1:]:
        name, equals, value = text.partition("=")
        if equals and not name.startswith("#"):
            variables.append((name.strip(), value.strip()))
    return variables, (size[1] + size[3], int(size[2]), int(size[4])), len(head) + len(line) + 3


def _pixels(data: bytes, at: int, lines: int, length: int) -> NDArray[np.uint8]:
    """Red, green, blue and exponent, (lines, length, 4)."""
    image = np.empty((lines, length, 4), np.uint8)
    for line in image:
        new = (
            8 <= length < 2**15 and data[at : at + 2] == b"\2\2" and data[at + 2 : at + 3] < b"\x80"
        )
        if new and int.from_bytes(data[at + 2 : at + 4], "big") == length:
            at = _read_planes(data, at + 4, line)
        else:
            at = _read_old(data, at, line)
    if at < len(data):
        raise ImageError(
            f"expected the file to end with its pixels, got {len(data) - at} bytes more; write "
            "each picture to a file of its own, or export it again"
        )
    return image


def _read_planes(data: bytes, at: int, line: NDArray[np.uint8]) -> int:
    """Read a line of channels one after another, each of runs of one byte and literal bytes."""
    length = len(line)
    for channel in range(4):
        filled = bytearray()
        while len(filled) < length:
            count = data[at] if at < len(data) else 0
            if count > 128:
                count -= 128
                filled += data[at + 1 : at + 2] * count
                at += 2
            else:
                filled += data[at + 1 : at + 1 + count]
                at += 1 + count
            if count == 0 or at > len(data):
                raise _incomplete()
        if len(filled) != length:
            raise ImageError("damaged Radiance file: a line is too long; export it again")
        line[:, channel] = np.frombuffer(filled, np.uint8)
    return at


def _read_old(data: bytes, at: int, line: NDArray[np.uint8]) -> int:
    """Read a line of whole pixels, in which 1, 1, 1, n repeats the pixel before it n times."""
    place, shift = 0, 0
    length = len(line)
    plain = np.frombuffer(data, np.uint8, min(4 * length, (len(data) - at) // 4 * 4), at)
    plain = plain.reshape(-1, 4)
    if len(plain) == length and not (plain[:, :3] == 1).all(1).any():
        line[:] = plain
        return at + 4 * length
    while place < length:
        pixel = data[at : at + 4]
        if len(pixel) < 4:
            raise _incomplete()
        at += 4
        if pixel[:3] != b"\1\1\1":
            line[place] = np.frombuffer(pixel, np.uint8)
            place, shift = place + 1, 0
            continue
        count = pixel[3] << shift
        if place == 0 or shift > 16 or place + count > length:
            raise ImageError("damaged Radiance file: a run is too long; export it again")
        line[place : place + count] = line[place - 1]
        place, shift = place + count, shift + 8
    return at


def _upright(image: Floats, axes: bytes) -> Floats:
    """The image with rows from the top and columns from the left; `axes` is written as in -Y+X."""
    if axes[1:2] == b"X":  # lines are columns
        image = image.swapaxes(1, 2)
    if b"+Y" in axes:
        image = image[:, ::-1]
    if b"-X" in axes:
        image = image[:, :, ::-1]
    return image


def _colours(image: Floats, variables: list[tuple[str, str]], notes: list[str]) -> Floats:
    """Linear BT.709 by the exposure and primaries that the header states."""
    named = dict(variables)
    known = {"32-bit_rle_rgbe": False, "32-bit_rle_xyze": True}
    if named.get("FORMAT", "32-bit_rle_rgbe") not in known:
        raise ImageError(
            f"expected the format 32-bit_rle_rgbe or 32-bit_rle_xyze, got {named['FORMAT'][:40]!r}"
        )
    exposure = np.ones(3)
    for name, value in variables:
        if name == "EXPOSURE":
            exposure *= _numbers(value, 1)
        elif name == "COLORCORR":
            exposure *= _numbers(value, 3)
    if (exposure != 1).any():
        told = ", ".join(f"{factor:g}" for factor in dict.fromkeys(exposure))
        if not ((exposure > 1e-20) & (exposure < 1e20)).all():
            raise ImageError(f"damaged Radiance file: an exposure of {told}; export it again")
        notes.append(f"Values are divided by the exposure that the file states, {told}.")
        with np.errstate(over="ignore"):
            image = image / exposure.astype(np.float32)[:, None, None]
    if known[named.get("FORMAT", "32-bit_rle_rgbe")]:
        notes.append("Colours are converted from CIE XYZ to BT.709.")
        return converted(image, to_bt709(rgb_to_xyz(XYZ), BT709[6:]))
    if "PRIMARIES" not in named:
        notes.append("No primaries are given: BT.709 is assumed.")
        return image
    given = _numbers(named["PRIMARIES"], 8)
    matrix = to_bt709(rgb_to_xyz(given), given[6:])
    if is_identity(matrix):
        return image
    notes.append("Colours are converted from the primaries that the file states to BT.709.")
    return converted(image, matrix)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise ImageError(
            f"damaged Radiance file: expected {count} numbers, got {text[:40]!r}; export it again"
        )
    return numbers


def _incomplete() -> ImageError:
    return ImageError("incomplete: the file ends in its pixels; render or copy it again")
