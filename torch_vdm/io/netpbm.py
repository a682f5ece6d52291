"""Netpbm's plain formats: PPM and PGM of whole numbers, PFM of light."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.colour import Colour
from torch_vdm.io.decoded import Decoded
from torch_vdm.io.pictures import decoded
from torch_vdm.io.refusal import ImageError, Repair, check_size, require_finite, without_negatives

# The kind, and width, height and the largest value or the scale, with comments between.
_SPACE = rb"(?:\s|#[^\n]*\n)+"
_BITS = re.compile(rb"P([14])" + 2 * (_SPACE + rb"(\d{1,9})") + rb"\s")
_WHOLE = re.compile(rb"P([2356])" + 3 * (_SPACE + rb"(\d{1,9})") + rb"\s")
_FLOAT = re.compile(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,30})\s")


def load_pnm(data: bytes, notes: list[str]) -> Decoded:
    """Return the image of a PPM, PGM or PBM, of 8 or 16 bits; notes go to ``notes``."""
    bits = data[1:2] in (b"1", b"4")
    found = (_BITS if bits else _WHOLE).match(data)
    if found is None:
        raise ImageError("damaged PNM: its header cannot be read; export it again")
    kind, width, height, *last = (int(number) for number in found.groups())
    white = last[0] if last else 1
    if not 0 < white < 65536:
        raise ImageError(f"damaged PNM: its white is {white}; export it again")
    shape = height, width, 3 if kind in (3, 6) else 1
    if kind == 4:
        values = _packed(data, found.end(), height, width)
    elif kind < 4:
        values = _written(data, found.end(), shape, white)
    else:
        values = _pixels(data, found.end(), shape, np.dtype(">u2" if white > 255 else "u1"))
    if bits:
        values = 1 - values  # 1 is ink
    depth = 16 if white > 255 else 8
    full = 2**depth - 1
    scaled = (np.minimum(values.astype(np.uint32), white) * full + white // 2) // white
    if depth == 16:
        notes.append("The channels have 16 bits.")
    return decoded(scaled.astype(np.uint16 if depth == 16 else np.uint8), Colour(), 1, notes)


def _packed(data: bytes, at: int, height: int, width: int) -> NDArray[Any]:
    """Bits; every row begins with a new byte."""
    check_size(width, height, height * width, len(data))
    stored = _pixels(data, at, (height, -(-width // 8), 1), np.dtype("u1"))
    return np.unpackbits(stored, axis=1)[:, :width]


def _written(data: bytes, at: int, shape: tuple[int, int, int], white: int) -> NDArray[Any]:
    """Numbers as text; the digits of a PBM need no space between them."""
    height, width, samples = shape
    count = height * width * samples
    check_size(width, height, 8 * count, len(data))
    text = re.sub(rb"#[^\n]*", b"", data[at:])
    values: NDArray[Any]
    if re.search(rb"[^\d\s]", text):
        raise ImageError("damaged PNM: its pixels are no numbers; export it again")
    if data[1:2] == b"1":
        values = np.frombuffer(text.translate(None, b" \t\n\v\f\r"), np.uint8) - ord("0")
    else:
        values = np.fromstring(text, np.int64, sep=" ") if text.strip() else np.empty(0, np.int64)
    if len(values) < count:
        raise ImageError(f"incomplete: {len(values)} of {count} numbers are there; copy it again")
    if len(values) > count:
        raise _too_much(f"{count} numbers", f"{len(values)}")
    if values.max() > white:
        raise ImageError(
            f"damaged PNM: expected numbers up to {white}, got {values.max()}; export it again"
        )
    return values.reshape(shape)


def load_pfm(data: bytes, repair: Repair, notes: list[str]) -> Decoded:
    """Return the image of a PFM: linear BT.709, rows from the bottom up."""
    found = _FLOAT.match(data)
    if found is None:
        raise ImageError("damaged PFM: its header cannot be read; export it again")
    kind, width, height, scale = found[1], int(found[2]), int(found[3]), _scale(found[4])
    stored = np.dtype("<f4" if scale < 0 else ">f4")
    samples = 3 if kind == b"F" else 1
    values = _pixels(data, found.end(), (height, width, samples), stored)
    planes = np.moveaxis(values[::-1], -1, 0).astype(np.float32)
    if abs(scale) != 1:
        notes.append(f"Values are multiplied by the scale that the file states, {abs(scale):g}.")
        with np.errstate(over="ignore"):
            planes = planes * np.float32(abs(scale))
    planes = require_finite(planes, repair.nonfinite, notes)
    planes = without_negatives(planes, repair.negative, notes)
    if samples == 1:
        notes.append("The image is grey: R = G = B.")
    return Decoded(np.broadcast_to(planes, (3, height, width)), "scene")


def _scale(text: bytes) -> float:
    """The scale, whose sign is the order of bytes."""
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if scale == 0 or not np.isfinite(scale):
        raise ImageError(f"damaged PFM: its scale is {text.decode()}; export it again")
    return scale


def _pixels(
    data: bytes, at: int, shape: tuple[int, int, int], stored: np.dtype[Any]
) -> NDArray[Any]:
    height, width, samples = shape
    size = height * width * samples * stored.itemsize
    check_size(width, height, size, len(data))
    if len(data) == at + size + 1 and data[at - 1 : at + 1] == b"\r\n":
        at += 1  # the line ending of a header that was written on Windows
    if at + size > len(data):
        raise ImageError(
            f"incomplete: {len(data) - at} of {size} bytes of pixels are there; copy it again"
        )
    if at + size < len(data):
        raise _too_much(f"{size} bytes of pixels", f"{len(data) - at}")
    return np.frombuffer(data, stored, height * width * samples, at).reshape(shape)


def _too_much(expected: str, came: str) -> ImageError:
    return ImageError(
        f"expected {expected}, got {came}; write each picture to a file of its own, or export it "
        "again"
    )
