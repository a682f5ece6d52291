"""TIFF: whole numbers of 8 and 16 bits, sRGB-coded, and floating point, which is light.

tifffile and Pillow are imported where they are used: importing the package stays fast.
"""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io import alpha, icc
from torch_vdm.io.colour import Colour
from torch_vdm.io.decoded import Decoded
from torch_vdm.io.pictures import ORIENTATION, decoded, load_picture, turned
from torch_vdm.io.primaries import BT709, Chromaticities, converted, rgb_to_xyz, to_bt709
from torch_vdm.io.refusal import (
    Floats,
    ImageError,
    Repair,
    check_size,
    require_finite,
    without_negatives,
)

if TYPE_CHECKING:
    from tifffile import TiffPage

# TIFF 6.0: tags, and what their values mean.
PROFILE, TRANSFER_FUNCTION, WHITE, CHROMATICITIES = 34675, 301, 318, 319
UNCOMPRESSED, GREY_WHITE_IS_0, GREY, RGB = 1, 0, 1, 2
UNSIGNED, FLOAT = 1, 3
DEFLATE = 8, 32946
ASSOCIATED, UNASSOCIATED = 1, 2


def load_tiff(data: bytes, repair: Repair, coded: bool, notes: list[str]) -> Decoded:
    """Return the image of a TIFF; what was assumed goes to ``notes``.

    With ``coded`` floating-point values are sRGB-coded, not light.
    """
    from tifffile import TiffFile, TiffPage

    try:
        with TiffFile(io.BytesIO(data)) as file:
            page = _only_page([p for p in file.pages[:1000] if isinstance(p, TiffPage)])
            samples = page.samplesperpixel
            size = page.imagewidth * page.imagelength * samples * page.bitspersample // 8
            check_size(page.imagewidth, page.imagelength, size, len(data))
            chromaticities = _chromaticities(page)
            _tell_left_out(page, notes)
            if _is_for_pillow(page):
                return load_picture(data, "TIFF", notes, chromaticities)
            _check(page)
            values = _values(page)
            profile = _profile(page)
            turn = _tag(page, ORIENTATION)
            associated = [page.extrasamples[i] for i in _opacity(page)[:1]] == [ASSOCIATED]
    except (ImageError, MemoryError):
        raise
    except Exception as error:
        # The decoder raises almost any class of error when a file is damaged.
        raise ImageError(f"damaged TIFF ({error}); export it again") from error
    turn = turn if isinstance(turn, int) and 1 <= turn <= 8 else 1
    if values.dtype.kind == "f":
        colour = Colour(profile=profile, chromaticities=chromaticities)
        return _floats(turned(values, turn, notes), colour, associated, repair, coded, notes)
    if values.dtype.itemsize == 2:
        notes.append("The channels have 16 bits.")
    colour = Colour(profile=profile, chromaticities=chromaticities)
    return decoded(values, colour, turn, notes, associated)


def _only_page(pages: list["TiffPage"]) -> "TiffPage":
    """The page of full resolution."""
    whole = [page for page in pages if not page.is_reduced and not page.is_mask]
    if len(whole) != 1:
        raise ImageError(
            f"expected one picture, got {len(whole)} in a file; write each to a file of its own"
        )
    if _is_for_pillow(whole[0]) and whole[0] is not pages[0]:
        raise ImageError("expected the picture before its thumbnails; save it again without them")
    return whole[0]


def _tell_left_out(page: "TiffPage", notes: list[str]) -> None:
    """Note samples that are neither colour nor alpha: an old alpha without its mark, or data."""
    named = page.samplesperpixel - len(page.extrasamples)
    colours = min(named, 3) if page.photometric == RGB else named
    left = page.samplesperpixel - colours - len(_opacity(page)[:1])
    if left:
        notes.append(
            f"{left} channel{'s' * (left > 1)} of unspecified meaning beside the colours "
            f"{'are' if left > 1 else 'is'} left out."
        )


def _opacity(page: "TiffPage") -> list[int]:
    """Which of the extra samples are alpha."""
    return [i for i, kind in enumerate(page.extrasamples) if kind in (ASSOCIATED, UNASSOCIATED)]


def _is_for_pillow(page: "TiffPage") -> bool:
    """Whether it has what tifffile alone cannot read: palettes, bits, most compressions."""
    if page.bitspersample > 8 or ASSOCIATED in page.extrasamples:
        return False
    plain = page.bitspersample == 8 and page.photometric in (GREY_WHITE_IS_0, GREY, RGB)
    return not plain or page.compression not in (UNCOMPRESSED, *DEFLATE)


def _check(page: "TiffPage") -> None:
    """Refuse what would not be read as intended."""
    kinds = (FLOAT,) if page.bitspersample > 16 else (UNSIGNED, FLOAT)
    if page.sampleformat not in kinds or page.bitspersample not in (8, 16, 32, 64):
        raise ImageError(
            f"expected 8 or 16 bits without sign, or floating point, got {page.bitspersample} bits "
            f"of format {page.sampleformat}; export it again"
        )
    colours = page.samplesperpixel - len(page.extrasamples)
    if (page.photometric, colours) not in ((GREY_WHITE_IS_0, 1), (GREY, 1), (RGB, 3)):
        raise ImageError(
            f"expected grey or RGB, got {colours} channels of {page.photometric!s}; "
            "convert it to RGB first"
        )


def _values(page: "TiffPage") -> NDArray[Any]:
    """(H, W, 1 to 4): grey or colour, and alpha where there is any."""
    try:
        stored = page.asarray()
    except (ValueError, KeyError, NotImplementedError) as error:
        if "imagecodecs" not in str(error):
            raise
        raise ImageError(
            f"expected the package imagecodecs for this TIFF's compression ({error}); install it, "
            "or save the image with Deflate or without compression"
        ) from error
    samples = page.samplesperpixel
    if page.planarconfig == 2 and samples > 1:
        stored = np.moveaxis(stored, 0, -1)
    values: NDArray[Any] = stored.reshape(page.imagelength, page.imagewidth, samples)
    values = values.astype(values.dtype.newbyteorder("="))
    if page.photometric == GREY_WHITE_IS_0 and values.dtype.kind == "u":
        values = np.invert(values)
    colours = samples - len(page.extrasamples)
    kept = [*range(colours), *(colours + i for i in _opacity(page)[:1])]
    return values[..., kept]


def _floats(
    values: NDArray[Any],
    colour: Colour,
    associated: bool,
    repair: Repair,
    coded: bool,
    notes: list[str],
) -> Decoded:
    """Light, unless ``coded`` or a profile says that it is code."""
    largest = np.finfo(values.dtype).max if values.dtype.itemsize < 8 else np.finfo("f4").max
    with np.errstate(over="ignore"):
        planes: Floats = np.moveaxis(values, -1, 0).astype(np.float32)
    clear = None
    if len(planes) in (2, 4):
        clear = alpha.plane(planes[-1], notes)
        planes = planes[:-1]
    held = np.full(len(planes), largest, np.float32)
    planes = require_finite(planes, repair.nonfinite, notes, largest=held)
    planes = without_negatives(planes, repair.negative, notes)
    if len(planes) == 1:
        notes.append("The image is grey: R = G = B.")
        planes = np.broadcast_to(planes, (3, *planes.shape[1:]))
    if colour == Colour():
        return Decoded(planes, "coded" if coded else "scene", clear, associated)
    if coded:
        raise ImageError("expected sRGB with --coded, got a TIFF of other colours; leave it out")
    notes.append("Colours are converted to BT.709 as the file says.")
    return Decoded(_linear_bt709(planes, colour), "scene", clear, associated)


def _linear_bt709(planes: Floats, colour: Colour) -> Floats:
    if colour.profile is None:
        assert colour.chromaticities is not None
        matrix = to_bt709(rgb_to_xyz(colour.chromaticities), colour.chromaticities[6:])
        return converted(planes, matrix)
    profile = icc.read_profile(colour.profile)
    if not profile.is_linear:
        raise ImageError(
            "expected a linear ICC profile for floating-point values, got another; save linear "
            "values, or remove the profile and pass --coded if they are sRGB-coded"
        )
    return profile.light(planes)


def _chromaticities(page: "TiffPage") -> Chromaticities | None:
    """x, y of red, green, blue and white, which the file states as fractions."""
    if TRANSFER_FUNCTION in page.tags and PROFILE not in page.tags:
        raise ImageError("expected a curve as an ICC profile, got a TIFF's own; save it as PNG")
    stated = [_tag(page, CHROMATICITIES), _tag(page, WHITE)]
    if not isinstance(stated[0], tuple) or len(stated[0]) != 12:
        return None
    white = stated[1] if isinstance(stated[1], tuple) and len(stated[1]) == 4 else None
    numbers = np.array([*stated[0], *(white or ())], np.float64).reshape(-1, 2)
    with np.errstate(all="ignore"):
        fractions = numbers[:, 0] / numbers[:, 1]
    return (*map(float, fractions), *(() if white else BT709[6:]))


def _profile(page: "TiffPage") -> bytes | None:
    return icc.stated({"icc_profile": _tag(page, PROFILE)} if PROFILE in page.tags else {})


def _tag(page: "TiffPage", number: int) -> object:
    tag = page.tags.get(number)
    return None if tag is None else tag.value
