"""ICC profiles: what the codes of a file mean.

Profiles of a matrix and curves, as nearly all RGB profiles are, are parsed here: Pillow's lcms has
8 bits per channel and no colours outside sRGB. Those made of tables go through lcms.
"""

import io
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from torch_vdm.io.curves import Values, decode_gamma, encode_srgb
from torch_vdm.io.primaries import D50, Matrix, converted, is_identity, to_bt709
from torch_vdm.io.refusal import Floats, ImageError

Curve: TypeAlias = Callable[[Values], Values]

# Codes that differ by less count as equal: half a step of 8 bits. Status: choice.
SAME_CODE = 0.5 / 255


class Profile(NamedTuple):
    """A profile: of a matrix and curves, unless it has tables."""

    curves: tuple[Curve, ...]
    """From code to light; one for grey, three for R, G, B, none where there are tables."""
    matrix: Matrix
    """From light to linear BT.709."""
    cicp: tuple[int, int, int, int] | None
    """Primaries, transfer, matrix and range of ITU-T H.273, where it states them."""

    @property
    def is_srgb(self) -> bool:
        """Whether it is sRGB by its numbers; its name says nothing."""
        return is_identity(self.matrix) and self._deviation(encode_srgb) < SAME_CODE

    @property
    def is_linear(self) -> bool:
        """Whether its codes are light."""
        return self._deviation(lambda light: light) < SAME_CODE

    def _deviation(self, encode: Curve) -> float:
        codes = np.linspace(0, 1, 256)
        return max(
            (float(np.abs(encode(curve(codes)) - codes).max()) for curve in self.curves),
            default=1.0,
        )

    def light(self, codes: Floats) -> Floats:
        """Return the linear BT.709 of codes (3, H, W)."""
        curves = self.curves * (3 // len(self.curves))
        pairs = zip(curves, codes.astype(np.float64), strict=True)
        light = np.stack([curve(plane) for curve, plane in pairs]).astype(np.float32)
        return light if is_identity(self.matrix) else converted(light, self.matrix)


def read_profile(data: bytes) -> Profile:
    """Parse an ICC profile.

    Raises
    ------
    ImageError
        If it is damaged, or of anything but grey or R, G, B.
    """
    try:
        return _read_profile(data)
    except (struct.error, IndexError, ZeroDivisionError) as error:
        raise _damaged(str(error)) from error


def stated(info: Mapping[Any, object]) -> bytes | None:
    """The profile in Pillow's info of a file; None where the file has none.

    Raises
    ------
    ImageError
        If the file has one that Pillow could not put together.
    """
    profile = info.get("icc_profile")
    if isinstance(profile, bytes) and profile:
        return profile
    if "icc_profile" in info:
        raise _damaged("it is empty, cut off, or cannot be unpacked")
    return None


def through_lcms(codes: Floats, data: bytes) -> Floats:
    """Return 8-bit codes (3, H, W) as sRGB codes, by a profile with tables."""
    import PIL.Image
    from PIL import ImageCms

    image = PIL.Image.fromarray(np.moveaxis(np.rint(codes * 255).astype(np.uint8), 0, -1))
    try:
        shown = ImageCms.profileToProfile(
            image,
            ImageCms.ImageCmsProfile(io.BytesIO(data)),
            ImageCms.createProfile("sRGB"),
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
        )
    except (ImageCms.PyCMSError, OSError) as error:
        raise _damaged(str(error)) from error
    assert shown is not None
    return np.moveaxis(np.asarray(shown), -1, 0).astype(np.float32) / np.float32(255)


def _read_profile(data: bytes) -> Profile:
    # ICC.1:2022, 7.2: the header; 7.3: the table of tags.
    if data[36:40] != b"acsp":
        raise _damaged("it has no ICC header")
    space, connection = data[16:20], data[20:24]
    (count,) = struct.unpack_from(">I", data, 128)
    tags: dict[bytes, bytes] = {}
    for number in range(min(count, 1000)):
        name, at, size = struct.unpack_from(">4sII", data, 132 + 12 * number)
        if at + size > len(data):
            raise _damaged("a tag goes beyond its end")
        tags[name] = data[at : at + size]
    cicp = None
    if b"cicp" in tags:
        cicp = struct.unpack_from(">4B", tags[b"cicp"], 8)
    if space not in (b"RGB ", b"GRAY"):
        raise ImageError(
            f"expected a profile of grey or RGB colours, got {space.decode('latin-1').strip()}; "
            "convert the image to sRGB first"
        )
    names = (b"rTRC", b"gTRC", b"bTRC") if space == b"RGB " else (b"kTRC",)
    colorants = (b"rXYZ", b"gXYZ", b"bXYZ") if space == b"RGB " else ()
    whole = connection == b"XYZ " and all(name in tags for name in (*names, *colorants))
    if b"A2B0" in tags or not whole:
        return Profile((), np.full((3, 3), np.nan), cicp)
    curves = tuple(_curve(tags[name]) for name in names)
    if space == b"GRAY":
        return Profile(curves, np.eye(3), cicp)
    columns = [np.array(struct.unpack_from(">3i", tags[name], 8)) / 65536 for name in colorants]
    white = D50[0] / sum(D50), D50[1] / sum(D50)
    return Profile(curves, to_bt709(np.column_stack(columns), white), cicp)


def _curve(tag: bytes) -> Curve:
    """The function of a tag: ICC.1:2022, 10.6 (a table or a power) and 10.18 (formulas)."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return lambda code: code
        if count == 1:
            exponent = struct.unpack_from(">H", tag, 12)[0] / 256
            return lambda code: decode_gamma(code, exponent)
        if 12 + 2 * count > len(tag):
            raise _damaged("a curve goes beyond its end")
        table = np.frombuffer(tag, ">u2", count, 12) / 65535
        return lambda code: np.interp(code, np.linspace(0, 1, count), table)
    if tag[:4] != b"para":
        raise _damaged("it has a curve of an unknown type")
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind > 4:
        raise _damaged("it has a formula of an unknown type")
    numbers = [
        number / 65536 for number in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", tag, 12)
    ]
    return _formula(kind, *numbers)


def _formula(
    kind: int,
    g: float,
    a: float = 1.0,
    b: float = 0.0,
    c: float = 0.0,
    d: float = 0.0,
    e: float = 0.0,
    f: float = 0.0,
) -> Curve:
    """(a X + b)^g + e from a code X = d on, c X + f below: ICC.1:2022, table 68."""
    if kind in (1, 2):  # there c is added everywhere, and d is where the base is 0
        c, d, e, f = 0.0, -b / a, c, c
    elif kind == 0:
        d = -np.inf

    def light(code: Values) -> Values:
        if kind == 0:
            return decode_gamma(code, g)
        power = np.maximum(a * code + b, 0) ** g + e
        return np.where(code >= d, power, c * code + f)

    return light


def _damaged(what: str) -> ImageError:
    return ImageError(
        f"damaged: its colour profile cannot be used ({what}); remove it, or export the image again"
    )
