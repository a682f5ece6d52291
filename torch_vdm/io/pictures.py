"""Pictures of whole numbers that Pillow reads: JPEG, WebP, GIF, BMP, TGA, AVIF.

Pillow is imported where it is used: importing the package stays fast.
"""

import io
import struct
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io import alpha, icc
from torch_vdm.io.colour import SRGB, VIDEO, Colour, shown
from torch_vdm.io.decoded import Decoded
from torch_vdm.io.primaries import Chromaticities
from torch_vdm.io.refusal import Floats, ImageError, check_size, first_pixel

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFile import ImageFile

# Tags of EXIF, the first one TIFF's too. EXIF 2.3, 4.6; DCF 2.0, 3.
ORIENTATION, EXIF, INTEROP, COLOUR_SPACE, UNCALIBRATED = 0x0112, 0x8769, 0xA005, 0xA001, 0xFFFF

# Adobe RGB (1998), 4.3.1: primaries, white, and the exponent by which light becomes code.
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
ADOBE_GAMMA = 256 / 563

# Pillow's reader of a format: module, class, and what to install where the module is missing.
READERS = {
    "JPEG": ("PIL.JpegImagePlugin", "jpeg_factory", "Pillow"),
    "WebP": ("PIL.WebPImagePlugin", "WebPImageFile", "Pillow with WebP"),
    "GIF": ("PIL.GifImagePlugin", "GifImageFile", "Pillow"),
    "BMP": ("PIL.BmpImagePlugin", "BmpImageFile", "Pillow"),
    "TGA": ("PIL.TgaImagePlugin", "TgaImageFile", "Pillow"),
    "TIFF": ("PIL.TiffImagePlugin", "TiffImageFile", "Pillow"),
    "AVIF": ("PIL.AvifImagePlugin", "AvifImageFile", "Pillow 11.3 or newer"),
}

# Pillow's modes for pixels of 8 bits that have colours to be shown.
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX")


def load_picture(
    data: bytes, content: str, notes: list[str], chromaticities: Chromaticities | None = None
) -> Decoded:
    """Return the image of a file; what was assumed goes to ``notes``.

    ``chromaticities`` are those that the file states, where Pillow does not report them.
    """
    try:
        with _opened(data, content) as image:
            check_size(*image.size, 4 * image.size[0] * image.size[1], len(data))
            if content != "TIFF":  # whose reader has counted the pages
                _require_one_picture(image, notes)
            _require_shown(image, data, content, notes)
            turn = orientation(image)  # loading a TIFF drops it and turns the image
            image.load()
            values = _values(image, content == "TGA" and not _tga_has_alpha(data))
            profile = icc.stated(image.info)
    except (ImageError, MemoryError):
        raise
    except Exception as error:
        # The decoders raise almost any class of error when a file is damaged.
        raise ImageError(f"damaged {content} ({error}); export it again") from error
    colour = Colour(profile=profile, chromaticities=chromaticities)
    if content == "JPEG" and profile is None and _is_adobe_rgb(image):
        colour = Colour(gamma=ADOBE_GAMMA, chromaticities=ADOBE_RGB)
    if content == "TIFF" and turn != 1:
        notes.append(f"The image is turned as its EXIF orientation {turn} says.")
        turn = 1
    return decoded(values, colour, turn, notes)


def decoded(
    values: NDArray[np.uint8] | NDArray[np.uint16],
    colour: Colour,
    turn: int,
    notes: list[str],
    associated: bool = False,
) -> Decoded:
    """Return whole numbers (H, W, 1 to 4), grey or colour and perhaps alpha, as an image."""
    values = turned(values, turn, notes)
    bits = 8 * values.dtype.itemsize
    planes = np.moveaxis(values, -1, 0).astype(np.float32) / np.float32(2**bits - 1)
    clear = alpha.plane(planes[-1], notes) if len(planes) in (2, 4) else None
    colours = planes[:3] if len(planes) > 2 else planes[:1]
    if len(colours) == 1:
        notes.append("The image is grey: R = G = B.")
        colours = np.broadcast_to(colours, (3, *colours.shape[1:]))
    if clear is not None and associated and colour != Colour():
        colours, associated = alpha.straight(colours, clear), False
    pixels, kind = shown(colours, colour, bits, notes)
    return Decoded(pixels, kind, clear, associated)


def orientation(image: "Image", raw: bytes | None = None) -> int:
    """Return the EXIF orientation, 1 to 8; 1 where there is none, or none that can be read.

    ``raw`` is EXIF data that the file has elsewhere.
    """
    try:
        if raw is not None and "exif" not in image.info:
            image.info["exif"] = raw
        turn = image.getexif().get(ORIENTATION, 1)
    except Exception:  # EXIF data is secondary: if damaged, the pixels are still usable
        return 1
    return turn if isinstance(turn, int) and 1 <= turn <= 8 else 1


def _is_adobe_rgb(image: "Image") -> bool:
    """Whether EXIF names DCF's optional colour space, as cameras that add no profile do."""
    try:
        details = image.getexif().get_ifd(EXIF)
        return (
            details.get(COLOUR_SPACE) == UNCALIBRATED
            and image.getexif().get_ifd(INTEROP)[1] == "R03"
        )
    except Exception:  # as above
        return False


def turned(values: NDArray[Any], turn: int, notes: list[str]) -> NDArray[Any]:
    """Return (H, W, C) turned by its EXIF orientation, which is TIFF's."""
    if turn != 1:
        notes.append(f"The image is turned as its EXIF orientation {turn} says.")
    # EXIF 2.3, 4.6.4 A: where row 0 and column 0 of the stored image are in the upright one.
    if turn >= 5:
        values = values.swapaxes(0, 1)
    if turn in (3, 4, 7, 8):
        values = values[::-1]
    if turn in (2, 3, 6, 7):
        values = values[:, ::-1]
    return values


def _opened(data: bytes, content: str) -> "ImageFile":
    module, name, package = READERS[content]
    try:
        reader = getattr(import_module(module), name)
        image: ImageFile = reader(io.BytesIO(data))
    except ImportError as error:
        raise ImageError(
            f"expected the package {package} for {content}, which is missing; install it, or "
            "convert the image"
        ) from error
    return image


def _require_one_picture(image: "ImageFile", notes: list[str]) -> None:
    """Refuse several pictures, but not one with thumbnails or a gain map."""
    count = getattr(image, "n_frames", 1)
    multi = getattr(image, "mpinfo", None)  # a JPEG's list of pictures (CIPA DC-007)
    if multi is not None:
        kinds = [str(entry["Attribute"]["MPType"]) for entry in multi[0xB002]]
        count = sum("Thumbnail" not in kind for kind in kinds)
    if count > 1:
        raise ImageError(
            f"expected one picture, got {count} in a file; write each to a file of its own"
        )
    if multi is not None or "mp" in image.info:
        notes.append("What is beside the picture (a thumbnail, a gain map) is left out.")


def _require_shown(image: "ImageFile", data: bytes, content: str, notes: list[str]) -> None:
    """Refuse colours that Pillow would not return as they are meant."""
    if image.mode not in MODES:
        raise ImageError(
            f"expected a grey or RGB image of 8 bits, got a {content} with {image.mode} colours, "
            "which mean nothing without the printer's profile, or lose bits; convert it to RGB, or "
            "to a PNG of 16 bits, first"
        )
    if content == "BMP" and data[14 + 56 : 14 + 60] in (b"DEBM", b"KNIL") and data[14] >= 124:
        raise ImageError("expected sRGB, got a BMP with a colour profile; save it as PNG")
    if content != "AVIF":
        return
    # ISO/IEC 23000-22: the colours are in a box of the header, which Pillow ignores.
    at = data.find(b"colrnclx")
    if at >= 0 and len(data) >= at + 12:
        primaries, transfer = struct.unpack_from(">HH", data, at + 8)
        # Unspecified is sRGB (MIAF), and so is what cameras call the curve of video.
        if primaries not in (1, 2) or transfer not in (SRGB, 2, *VIDEO):
            raise ImageError(
                f"expected an AVIF of sRGB colours, got {primaries}/{transfer} (CICP), of which "
                "Pillow keeps 8 bits; convert it to a PNG of 16 bits with cICP"
            )
    at = data.find(b"pixi")
    if at >= 0 and len(data) > at + 9 and data[at + 9] > 8:
        notes.append(f"Of {data[at + 9]} bits, 8 are kept.")


def _values(image: "ImageFile", opaque: bool) -> NDArray[np.uint8]:
    clear = "A" in image.mode or "transparency" in image.info
    grey = image.mode in ("1", "L", "LA")
    if opaque or not clear:
        image.info.pop("transparency", None)  # else convert() warns about palettes
        return np.atleast_3d(np.asarray(image.convert("L" if grey else "RGB")))
    values = np.asarray(image.convert("RGBA"))
    return values[..., 2:] if grey else values


def _tga_has_alpha(data: bytes) -> bool:
    """Whether the header says that bits of a pixel are alpha; many writers leave them unset."""
    return len(data) > 17 and bool(data[17] & 15)


def encode_coded(planes: Floats, content: str) -> bytes:
    """Return (3, H, W) or (1, H, W), clipped to [0, 1], as a PNG or JPEG."""
    import PIL.Image

    if not np.isfinite(planes).all():
        x, y = first_pixel(~np.isfinite(planes))
        raise ImageError(
            f"expected finite values for {content}, got NaN or infinity (the first at x={x}, "
            f"y={y}); mask them, or write .exr, which keeps them"
        )
    coded = np.rint(np.clip(planes, 0, 1) * 255).astype(np.uint8)
    image = PIL.Image.fromarray(coded[0] if len(coded) == 1 else np.moveaxis(coded, 0, -1))
    stream = io.BytesIO()
    if content == "PNG":
        image.save(stream, "PNG")
    elif max(image.size) > 65500:
        raise ImageError(f"expected at most 65500 pixels a side for JPEG, got {image.size}")
    else:
        image.save(stream, "JPEG", quality=95, subsampling=0)
    return stream.getvalue()
