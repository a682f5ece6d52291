"""PNG and JPEG: sRGB-coded pixels.

Pillow and kornia_rs are imported where they are used: importing the package stays fast.
"""

import io
import struct

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.refusal import Floats, ImageError, check_size, first_pixel


def load_png(data: bytes, notes: list[str]) -> Floats:
    """Return the pixels of a PNG, (3, H, W) in [0, 1]; what was assumed goes to ``notes``."""
    from kornia_rs.io import decode_image_png_u16
    from PIL.PngImagePlugin import PngImageFile

    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ImageError("damaged: the PNG header is missing; export it again")
    width, height, depth, kind = struct.unpack_from(">IIBB", data, 16)
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(kind, 4)  # by colour type; bit 2 is alpha
    check_size(width, height, width * height * samples * depth // 8, len(data))
    try:
        with PngImageFile(io.BytesIO(data)) as image:
            image.verify()  # the check sums, which load() leaves out for the pixels
        with PngImageFile(io.BytesIO(data)) as image:
            image.load()
            _note_profile(image.info, notes)
            alpha = bool(kind & 4) or "transparency" in image.info
            image.info.pop("transparency", None)  # else convert() below warns about palettes
            mode = {0: "mono", 2: "rgb", 6: "rgba"}.get(kind)
            if depth == 16 and mode:
                # Pillow keeps 8 of the 16 bits of a colour image; kornia_rs has no grey with alpha.
                values = decode_image_png_u16(data, (height, width), mode)[..., :3]
            else:
                values = np.asarray(image.convert("RGB"))
    except Exception as error:
        # The decoders raise about every class there is when a file is damaged.
        raise ImageError(f"damaged PNG ({error}); export it again") from error
    if kind in (0, 4):
        notes.append("The image is grey: R = G = B.")
    if depth == 16:
        lost = "" if values.dtype == np.uint16 else ", of which 8 are kept"
        notes.append(f"The channels have 16 bits{lost}.")
    if alpha:
        notes.append("The transparency is left out: colours are taken as they stand in the file.")
    return _unit_planes(values)


def load_jpeg(data: bytes, notes: list[str]) -> Floats:
    """Return the pixels of a JPEG, (3, H, W) in [0, 1]; what was assumed goes to ``notes``."""
    from PIL.JpegImagePlugin import JpegImageFile

    try:
        with JpegImageFile(io.BytesIO(data)) as image:
            width, height = image.size
            check_size(width, height, width * height * 3, len(data))
            _check_jpeg_mode(image.mode)
            if image.mode == "L":
                notes.append("The image is grey: R = G = B.")
            values = np.asarray(image.convert("RGB"))
            _note_profile(image.info, notes)
            turn = _orientation(image)
    except ImageError:
        raise
    except Exception as error:
        raise ImageError(f"damaged JPEG ({error}); export it again") from error
    if turn != 1:
        notes.append(f"The image is turned as its EXIF orientation {turn} says.")
    # EXIF 2.3, 4.6.4 A: where row 0 and column 0 of the stored image are in the upright one.
    if turn >= 5:
        values = values.swapaxes(0, 1)
    if turn in (3, 4, 7, 8):
        values = values[::-1]
    if turn in (2, 3, 6, 7):
        values = values[:, ::-1]
    return _unit_planes(values)


def _check_jpeg_mode(mode: str) -> None:
    if mode not in ("L", "RGB"):
        raise ImageError(
            f"expected a grey or RGB image, got a JPEG with {mode} colours, which mean nothing "
            "without the printer's profile; convert it to RGB first"
        )


def _orientation(image: object) -> int:
    """The EXIF orientation, 1 to 8; 1 where there is none, or none that can be read."""
    try:
        turn = image.getexif().get(0x0112, 1)  # type: ignore[attr-defined]
    except Exception:  # EXIF data is an afterthought: damaged, it does not make the pixels unusable
        return 1
    return turn if isinstance(turn, int) and 1 <= turn <= 8 else 1


def _note_profile(info: dict[str | tuple[int, int], object], notes: list[str]) -> None:
    """Say so where a file asks for other colours or another curve than sRGB."""
    profile = info.get("icc_profile")
    # The description is ASCII or UTF-16 inside; both read "sRGB..." once the zeros are gone.
    if isinstance(profile, bytes) and b"sRGB" not in profile.replace(b"\0", b""):
        notes.append("The file has a colour profile that is not sRGB; it is ignored.")
    gamma = info.get("gamma")
    governs = "srgb" not in info and profile is None
    if governs and isinstance(gamma, float) and abs(gamma - 1 / 2.2) > 0.01:
        notes.append(f"The file states a gamma of {gamma:g}; it is ignored for the sRGB curve.")


def _unit_planes(values: NDArray[np.uint8] | NDArray[np.uint16]) -> Floats:
    """(H, W, 1 or 3) whole numbers as (3, H, W) in [0, 1]."""
    white = np.float32(np.iinfo(values.dtype).max)
    planes = np.moveaxis(values, -1, 0).astype(np.float32) / white
    return np.broadcast_to(planes, (3, *planes.shape[1:]))


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
