"""Netpbm's plain formats: PPM and PGM of whole numbers, PFM of light."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.colour import Colour
from torch_vdm.io.decoded import Decoded
from torch_vdm.io.pictures import decoded, load_picture
from torch_vdm.io.refusal import ImageError, Repair, check_size, require_finite, without_negatives

# The kind, and width, height and the largest value or the scale, with comments between.
_SPACE = rb"(?:\s|#[^\n]*\n)+"
_WHOLE = re.compile(rb"P([56])" + _SPACE + _SPACE.join([rb"(\d{1,9})"] * 3) + rb"\s")
_FLOAT = re.compile(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,30})\s")


def load_pnm(data: bytes, notes: list[str]) -> Decoded:
    """Return the image of a PPM, PGM or PBM, of 8 or 16 bits; notes go to ``notes``."""
    if data[1:2] not in (b"5", b"6"):
        return load_picture(data, "PNM", notes)  # letters, and bits
    found = _WHOLE.match(data)
    if found is None:
        raise ImageError("damaged PNM: its header cannot be read; export it again")
    width, height, white = (int(number) for number in found.groups()[1:])
    if not 0 < white < 65536:
        raise ImageError(f"damaged PNM: its white is {white}; export it again")
    samples = 3 if found[1] == b"6" else 1
    stored = np.dtype(">u2" if white > 255 else "u1")
    values = _pixels(data, found.end(), (height, width, samples), stored).astype(np.uint32)
    bits = 16 if white > 255 else 8
    full = 2**bits - 1
    scaled = (np.minimum(values, white) * full + white // 2) // white
    if bits == 16:
        notes.append("The channels have 16 bits.")
    return decoded(scaled.astype(np.uint16 if bits == 16 else np.uint8), Colour(), 1, notes)


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
    """The number whose sign is the order of bytes."""
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
    if at + size > len(data):
        raise ImageError(
            f"incomplete: {len(data) - at} of {size} bytes of pixels are there; copy it again"
        )
    return np.frombuffer(data, stored, height * width * samples, at).reshape(shape)
