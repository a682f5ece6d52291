"""PNG: its colours, its 16 bits, its orientation.

Pillow and kornia_rs are imported where they are used: importing the package stays fast.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io import icc
from torch_vdm.io.colour import Colour, check_cicp
from torch_vdm.io.decoded import Decoded
from torch_vdm.io.pictures import decoded, orientation
from torch_vdm.io.refusal import ImageError, check_size

if TYPE_CHECKING:
    from PIL.PngImagePlugin import PngImageFile

GREY, RGB, PALETTE, GREY_ALPHA, RGBA = 0, 2, 3, 4, 6  # colour types
RAW_EXIF = "Raw profile type APP1", "Raw profile type exif"


def load_png(data: bytes, notes: list[str]) -> Decoded:
    """Return the image of a PNG; what was assumed goes to ``notes``."""
    from PIL.PngImagePlugin import PngImageFile

    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ImageError("damaged: the PNG header is missing; export it again")
    width, height, depth, kind = struct.unpack_from(">IIBB", data, 16)
    samples = {GREY: 1, RGB: 3, PALETTE: 1, GREY_ALPHA: 2, RGBA: 4}.get(kind, 4)
    check_size(width, height, width * height * samples * depth // 8, len(data))
    _require_one_picture(data)
    try:
        with PngImageFile(io.BytesIO(data)) as image:
            image.verify()  # the checksums, which load() skips for the pixels
        with PngImageFile(io.BytesIO(data)) as image:
            image.load()
            colour = _colour(data, image)
            turn = orientation(image, _raw_exif(image))
            values = _values(data, image, depth, kind)
    except (ImageError, MemoryError):
        raise
    except Exception as error:
        # The decoders raise almost any class of error when a file is damaged.
        raise ImageError(f"damaged PNG ({error}); export it again") from error
    if depth == 16:
        notes.append("The channels have 16 bits.")
    return decoded(values, colour, turn, notes)


def _values(
    data: bytes, image: "PngImageFile", depth: int, kind: int
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Whole numbers (H, W, 1 to 4): grey or colour, and alpha where there is any."""
    from kornia_rs.io import decode_image_png_u16

    if depth == 16 and kind in (GREY, RGB, RGBA):
        # Pillow keeps 8 of the 16 bits of a colour image.
        mode = {GREY: "mono", RGB: "rgb", RGBA: "rgba"}[kind]
        stored = decode_image_png_u16(data, image.size[::-1], mode)
        deep: NDArray[np.uint16] = stored.reshape(*stored.shape[:2], -1)
        key = image.info.get("transparency")
        if key is None:
            return deep
        clear = (deep == np.array(key)).all(-1, keepdims=True)
        return np.concatenate((deep, np.where(clear, 0, 65535).astype(np.uint16)), -1)
    if depth == 16:
        return _grey_with_alpha(data)
    grey = kind in (GREY, GREY_ALPHA)
    if kind not in (GREY_ALPHA, RGBA) and "transparency" not in image.info:
        return np.atleast_3d(np.asarray(image.convert("L" if grey else "RGB")))
    key = image.info.get("transparency")
    if kind == GREY and depth in (2, 4) and isinstance(key, int):
        # Pillow scales the pixels to 8 bits, but not the grey that is transparent.
        image.info["transparency"] = key * 255 // (2**depth - 1)
    values = np.asarray(image.convert("RGBA"))
    return values[..., 2:] if grey else values


def _grey_with_alpha(data: bytes) -> NDArray[np.uint16]:
    """16 bits of grey and alpha, where Pillow keeps 8 and kornia_rs does not read them.

    A pixel has four bytes, like one of 8-bit RGBA: read as such, with the header changed to say so,
    all of them are kept.
    """
    from PIL.PngImagePlugin import PngImageFile

    header = b"IHDR" + data[16:24] + bytes((8, RGBA)) + data[26:29]
    changed = data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]
    with PngImageFile(io.BytesIO(changed)) as image:
        pixels = np.asarray(image)
    return pixels.view(">u2").astype(np.uint16)


def _colour(data: bytes, image: "PngImageFile") -> Colour:
    """What the file states about its colours."""
    stored = next((body for name, body in _chunks(data) if name == b"cICP"), None)
    cicp = None if stored is None else struct.unpack(">4B", stored)
    if cicp is not None:
        check_cicp(cicp)
    # A profile that cICP overrules may be damaged.
    profile = icc.stated(image.info) if cicp is None else None
    gamma = image.info.get("gamma")
    stated = image.info.get("chromaticity")  # white first
    return Colour(
        cicp,
        profile,
        "srgb" in image.info,
        float(gamma) if isinstance(gamma, float) else None,
        (*stated[2:], *stated[:2]) if isinstance(stated, tuple) and len(stated) == 8 else None,
    )


def _require_one_picture(data: bytes) -> None:
    """Refuse an animation (APNG), but not one of a single picture."""
    before = [(name, body) for name, body in _chunks(data)]
    names = [name for name, _ in before]
    animation = next((body for name, body in before if name == b"acTL"), None)
    if animation is None or len(animation) < 4:
        return
    (count,) = struct.unpack_from(">I", animation)
    # A picture without a frame control before it is not part of the animation.
    count += b"fcTL" not in names
    if count > 1:
        raise ImageError(
            f"expected one picture, got an animation of {count}; write each to a file of its own"
        )


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The names and contents of the chunks before the pixels."""
    at = 8
    while at + 8 <= len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        if name in (b"IDAT", b"IEND"):
            return
        yield name, data[at + 8 : at + 8 + size]
        at += 12 + size


def _raw_exif(image: "PngImageFile") -> bytes | None:
    """EXIF data that ImageMagick and exiftool store as text, in hexadecimal digits."""
    for name in RAW_EXIF:
        text = image.info.get(name)
        if isinstance(text, str):
            # A line feed, the profile's name, its length, and lines of digits.
            digits = text.split("\n", 3)[-1]
            try:
                return bytes.fromhex("".join(digits.split()))
            except ValueError:  # it is secondary: if damaged, the pixels are still usable
                return None
    return None
