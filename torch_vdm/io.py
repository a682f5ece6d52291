"""Images from files and to files: OpenEXR, PNG and JPEG.

An OpenEXR file is taken apart here, before the OpenEXR library sees any of it: only the blocks of
pixels of the part that is wanted reach the library, behind a new header of nine attributes. So a
damaged, truncated or hostile file is refused before memory is set aside for it, attributes that
the library does not know do no harm, and a part that is not wanted costs nothing.

Pillow, kornia_rs and OpenEXR are imported where they are used: together they would double the time
that importing the package takes.
"""

import contextlib
import ctypes
import io
import os
import secrets
import stat
import struct
import sys
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

PathLike: TypeAlias = str | os.PathLike[str]
Floats: TypeAlias = NDArray[np.float32]
Matrix: TypeAlias = NDArray[np.float64]
Window: TypeAlias = tuple[int, int, int, int]  # x min, y min, x max, y max; all inclusive

# Which suffixes are written, and what a file of that name is expected to hold.
FORMATS = {".exr": "OpenEXR", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}

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
        super().__init__(_printable(message))


def _printable(text: str) -> str:
    # Names of files, parts and channels are foreign text: a line feed, an escape sequence or half a
    # surrogate pair among them must not reach a terminal.
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


@dataclass(frozen=True, eq=False)
class Image:
    """An image and what was assumed to read it.

    Parameters
    ----------
    pixels
        float32, shape (3, H, W).
    linear
        True: scene-linear BT.709, where 1.0 is what the scene calls white (OpenEXR).
        False: sRGB-coded in [0, 1] (PNG, JPEG).
    notes
        One sentence for every assumption and every repair, in the order in which they were made.
    """

    pixels: Tensor
    linear: bool
    notes: tuple[str, ...]


def read_image(
    path: PathLike,
    *,
    part: int | str | None = None,
    nonfinite: Literal["raise", "zero"] = "raise",
    negative: Literal["keep", "raise", "clip"] = "keep",
) -> Tensor:
    """Read an OpenEXR, PNG or JPEG file: the pixels of `load`.

    Negative linear values (colours out of gamut, lobes of filters) are kept unless asked otherwise;
    everything else is as in `load`.

    Returns
    -------
    float32, shape (3, H, W): scene-linear BT.709 from OpenEXR, sRGB-coded in [0, 1] from PNG and
    JPEG.

    Raises
    ------
    ImageError
        As `load` does.
    """
    return load(path, part=part, nonfinite=nonfinite, negative=negative).pixels


def load(
    path: PathLike,
    *,
    part: int | str | None = None,
    nonfinite: Literal["raise", "zero"] = "raise",
    negative: Literal["keep", "raise", "clip"] = "raise",
    quiet: bool = False,
) -> Image:
    """Read an OpenEXR, PNG or JPEG file, and say what was assumed.

    The content decides the format; the name is used in messages only.

    OpenEXR: channels R, G, B, else Y, RY, BY (luminance and chroma), else X, Y, Z (CIE), else Y
    (grey), else the first layer that has R, G, B; other channels, alpha among them, are left out.
    Primaries other than BT.709's are converted. The image has the size of the display window. Of a
    tiled file with several levels the full resolution is read. Deep files are refused.

    PNG and JPEG: grey, palette and 16-bit files too; alpha is left out; a JPEG is turned the way
    its EXIF data says; CMYK is refused.

    Parameters
    ----------
    path
        The file.
    part
        Which part of an OpenEXR file: its index from 0, its name, or the name of a layer (the
        channels ``name.R``, ``name.G``, ``name.B``). None: the first part that has R, G, B.
    nonfinite
        What to do about NaN and infinity: refuse the file, or put 0 in their place.
    negative
        What to do about negative linear values: keep them, refuse the file, or put 0 in their
        place.
    quiet
        Keep the libraries from printing. The OpenEXR library writes to standard output and standard
        error by itself when the data inside a block is damaged. To hold that back, file descriptors
        1 and 2 and ``sys.stdout`` lead nowhere while the file is decoded, in every thread, and
        child processes started meanwhile inherit that: for command lines, not for libraries.

    Returns
    -------
    The pixels, float32 of shape (3, H, W), whether they are linear, and the notes.

    Raises
    ------
    ImageError
        If the file is missing, damaged, incomplete, of another kind, too large (over
        89 million pixels) or without colour channels, or if its values are refused. The message
        is one line that names the file.
    """
    for name, value, known in (
        ("nonfinite", nonfinite, ("raise", "zero")),
        ("negative", negative, ("keep", "raise", "clip")),
    ):
        if value not in known:
            raise ValueError(f"expected {name} to be one of {known}, got {value!r}")
    try:
        return _load(path, part, nonfinite, negative, quiet)
    except ImageError as error:
        raise ImageError(f"{os.fspath(path)}: {error}") from error.__cause__
    except MemoryError as error:
        raise ImageError(f"{os.fspath(path)}: not enough memory to read it") from error


def write_image(path: PathLike, image: Tensor) -> None:
    """Write an OpenEXR, PNG or JPEG file, as the suffix of its name says, whole or not at all.

    ``.exr`` keeps every value: 32-bit float channels R, G, B, or Y for a grey image, marked as
    linear BT.709. ``.png`` (8 bits) and ``.jpg`` (quality 95, colour at full resolution) take
    sRGB-coded values and clip them to [0, 1].

    Parameters
    ----------
    path
        The file; one that exists is replaced once the new one is complete.
    image
        Shape (3, H, W), or (1, H, W) or (H, W) for grey; any float type, any device.

    Raises
    ------
    ImageError
        If the suffix is not known, the shape or type is another one, a value for PNG or JPEG is not
        finite, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise ImageError(
            f"{os.fspath(path)}: expected a name that ends in {', '.join(FORMATS)}, got {suffix!r}"
        )
    if not image.is_floating_point():
        raise ImageError(
            f"{os.fspath(path)}: expected an image of a float type, got {image.dtype}; "
            "divide whole numbers by their white first"
        )
    shape = tuple(image.shape)
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[0] not in (1, 3)) or 0 in shape:
        raise ImageError(
            f"{os.fspath(path)}: expected an image of shape (3, H, W), (1, H, W) or (H, W) with at "
            f"least one pixel, got {shape}"
        )
    planes: Floats = image.detach().to("cpu", torch.float32).reshape(-1, *shape[-2:]).numpy()
    try:
        encoded = _exr_bytes(planes) if suffix == ".exr" else _coded_bytes(planes, FORMATS[suffix])
    except ImageError as error:
        raise ImageError(f"{os.fspath(path)}: {error}") from error.__cause__
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)


@contextlib.contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Write a file whole or not at all.

    ``with atomic_path("out.json") as temporary: temporary.write_text(...)``. The temporary file
    lies in the folder of `path` and has the same suffix. It takes the place of `path` when the
    block ends; if the block raises, it is removed and `path` is left as it was.

    Parameters
    ----------
    path
        The file to write. A symbolic link is followed.

    Raises
    ------
    ImageError
        If the folder does not exist, `path` is something other than a file, or the operating system
        refuses to write.
    """
    target = Path(os.path.realpath(path))
    # Not tempfile.mkstemp: its files can be read by their owner only, and so would the result.
    temporary = target.with_name(f".{secrets.token_hex(8)}{target.suffix}")
    ours = {str(name) for name in (None, temporary, target, target.parent)}
    try:
        _check_target(target)
        yield temporary
        temporary.replace(target)
    except OSError as error:
        if str(error.filename) not in ours:
            raise
        raise ImageError(
            f"{os.fspath(path)}: cannot be written: {error.strerror or error}"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _check_target(target: Path) -> None:
    if not target.parent.is_dir():
        raise ImageError(f"{target}: expected the folder to exist; create it first")
    # Renaming over a folder fails, and over a device such as /dev/null replaces the device.
    if target.exists() and not target.is_file():
        raise ImageError(f"{target}: expected a file to write to, got a folder or a device")


def _load(
    path: PathLike, part: int | str | None, nonfinite: str, negative: str, quiet: bool
) -> Image:
    notes: list[str] = []
    data = _read(path)
    content = _content(data, path, notes)
    if content != "OpenEXR" and part not in (None, 0):
        raise ImageError(f"expected an OpenEXR file for part {part!r}, got {content}")
    with _hushed() if quiet else contextlib.nullcontext():
        if content == "OpenEXR":
            pixels = _load_exr(data, part, nonfinite, notes)
            pixels = _without_negatives(pixels, negative, notes)
        else:
            pixels = _load_png(data, notes) if content == "PNG" else _load_jpeg(data, notes)
    sentences = tuple(_printable(note) for note in notes)
    return Image(torch.from_numpy(np.ascontiguousarray(pixels)), content == "OpenEXR", sentences)


# --- The file -------------------------------------------------------------------------------------


def _read(path: PathLike) -> bytes:
    file = Path(path)
    try:
        # Asked first, since opening a pipe that nobody writes to would wait for ever.
        kind = file.stat().st_mode
        data = file.read_bytes() if stat.S_ISREG(kind) else None
    except FileNotFoundError as error:
        raise ImageError("no such file; check the name") from error
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a zero byte in the name
        raise ImageError(f"cannot be read: {error}") from error
    if data is None:
        what = "a folder" if stat.S_ISDIR(kind) else "a device or a pipe; copy it to a file first"
        raise ImageError(f"expected an image file, got {what}")
    if not data:
        raise ImageError("expected an image, got an empty file; write it again")
    return data


def _content(data: bytes, path: PathLike, notes: list[str]) -> str:
    """The format by the first bytes: "OpenEXR", "PNG" or "JPEG"."""
    named = FORMATS.get(Path(path).suffix.lower())
    for content, magic in (
        ("OpenEXR", b"\x76\x2f\x31\x01"),
        ("PNG", b"\x89PNG\r\n\x1a\n"),
        ("JPEG", b"\xff\xd8\xff"),
    ):
        if data.startswith(magic):
            if named not in (None, content):
                notes.append(f"The name says {named}, but the content is {content} and is read so.")
            return content
    raise ImageError(
        f"expected an OpenEXR, PNG or JPEG image, got other content (it begins with bytes "
        f"{data[:4].hex(' ')}); {'export it again' if named else 'convert it to one of them'}"
    )


def _check_size(width: int, height: int, decoded: int, size: int) -> None:
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


_HUSH = threading.Lock()


@contextlib.contextmanager
def _hushed() -> Iterator[None]:
    # The lock keeps two threads from saving each other's descriptors, which would leave standard
    # error closed for good.
    with (
        _HUSH,
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        _flush_c()
        # A stream that was closed when Python started is None, and its descriptor may be any file.
        streams = ((1, sys.__stdout__), (2, sys.__stderr__))
        kept = {number: os.dup(number) for number, stream in streams if stream is not None}
        for number in kept:
            os.dup2(nowhere.fileno(), number)
        try:
            yield
        finally:
            _flush_c()
            for number, copy in kept.items():
                os.dup2(copy, number)
                os.close(copy)


def _flush_c() -> None:
    # OpenJPH, inside the OpenEXR library, prints to the C library's standard output, which is
    # buffered: what it has to say would come out after the descriptor is back. Where the C library
    # cannot be reached this way (Windows), that is so.
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).fflush(None)


# --- Values ---------------------------------------------------------------------------------------


def _first(bad: NDArray[np.bool_]) -> tuple[int, int]:
    """x, y of the first pixel, row by row, of which a channel of `bad` (C, H, W) is true."""
    y, x = np.unravel_index(int(np.argmax(bad.any(0))), bad.shape[1:])
    return int(x), int(y)


def _finite(
    planes: Floats, policy: str, notes: list[str], origin: tuple[int, int] = (0, 0), step: int = 1
) -> Floats:
    """Refuse or repair NaN and infinity; pixel i, j of `planes` is at origin + step * (i, j)."""
    bad = ~np.isfinite(planes)
    count = int(bad.sum())
    if not count:
        return planes
    x, y = _first(bad)
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


def _without_negatives(planes: Floats, policy: str, notes: list[str]) -> Floats:
    if policy == "keep" or planes.min() >= 0:
        return planes
    bad = planes < 0
    count = int(bad.sum())
    x, y = _first(bad)
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


# --- PNG and JPEG ---------------------------------------------------------------------------------


def _load_png(data: bytes, notes: list[str]) -> Floats:
    from kornia_rs.io import decode_image_png_u16
    from PIL.PngImagePlugin import PngImageFile

    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ImageError("damaged: the PNG header is missing; export it again")
    width, height, depth, kind = struct.unpack_from(">IIBB", data, 16)
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(kind, 4)  # by colour type; bit 2 is alpha
    _check_size(width, height, width * height * samples * depth // 8, len(data))
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


def _load_jpeg(data: bytes, notes: list[str]) -> Floats:
    from PIL.JpegImagePlugin import JpegImageFile

    try:
        with JpegImageFile(io.BytesIO(data)) as image:
            width, height = image.size
            _check_size(width, height, width * height * 3, len(data))
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


def _coded_bytes(planes: Floats, content: str) -> bytes:
    import PIL.Image

    if not np.isfinite(planes).all():
        x, y = _first(~np.isfinite(planes))
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


# --- OpenEXR: the container -----------------------------------------------------------------------
# File layout: "OpenEXR File Layout", https://openexr.com/en/latest/OpenEXRFileLayout.html

_TILED, _LONG_NAMES, _DEEP, _MULTIPART = 0x200, 0x400, 0x800, 0x1000

# Rows in a block of a scanline part, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ,
# PXR24, B44, B44A, DWAA, DWAB, HTJ2K256, HTJ2K32, LJ2K, ZSTD.
_BLOCK_ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32, 256, 1)

# Channels that make an image, in the order in which they are looked for.
_MODELS = (("R", "G", "B"), ("Y", "RY", "BY"), ("X", "Y", "Z"), ("Y",))


@dataclass(frozen=True)
class _Channel:
    kind: int  # 0 unsigned integer, 1 half, 2 float
    step: tuple[int, int]  # one sample every so many pixels in x, in y

    @property
    def bytes(self) -> int:
        """The size of a sample."""
        return 2 if self.kind == 1 else 4


@dataclass(frozen=True)
class _Part:
    attributes: dict[str, bytes]
    name: str
    deep: bool
    tiled: bool
    channels: dict[str, _Channel]
    window: Window  # where there are data
    display: Window  # what is to be seen

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the data window."""
        return self.window[2] - self.window[0] + 1, self.window[3] - self.window[1] + 1


def _load_exr(data: bytes, wanted: int | str | None, nonfinite: str, notes: list[str]) -> Floats:
    parts, table, long_names = _headers(data)
    index, names = _choose(parts, wanted, notes)
    part = parts[index]
    _check(part, len(data))
    for other in parts[:index]:
        table += 8 * _value(other.attributes, "chunkCount", "<i")[0]
    blocks = _blocks(data, part, table, index if len(parts) > 1 else None)
    planes = _decoded(_one_part(part, blocks, long_names), names)
    return _colours(part, names, planes, nonfinite, notes)


def _headers(data: bytes) -> tuple[list[_Part], int, bool]:
    """The parts, where the first table of offsets begins, and whether names may be long."""
    if len(data) < 8:
        raise _damaged("the file ends in its header")
    (field,) = struct.unpack_from("<I", data, 4)
    flags = field & ~0xFF
    if field & 0xFF != 2 or flags & ~(_TILED | _LONG_NAMES | _DEEP | _MULTIPART):
        raise ImageError(
            f"expected OpenEXR version 2, got version {field & 0xFF} with flags {flags:#x}; "
            "export it again"
        )
    at = 8
    parts: list[_Part] = []
    while not parts or flags & _MULTIPART:
        attributes, at = _attributes(data, at)
        if not attributes:  # an empty header closes a list of parts
            break
        parts.append(_part(attributes, flags))
    if not parts:
        raise _damaged("it has no header")
    return parts, at, bool(flags & _LONG_NAMES)


def _attributes(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    attributes: dict[str, bytes] = {}
    while True:
        name, at = _text(data, at)
        if not name:
            return attributes, at
        _, at = _text(data, at)
        if at + 4 > len(data):
            raise _damaged("the file ends in its header")
        (size,) = struct.unpack_from("<i", data, at)
        at += 4
        if not 0 <= size <= len(data) - at:
            raise _damaged(
                f"the header's attribute {_short(name)!r} goes beyond the end of the file"
            )
        attributes[name] = data[at : at + size]
        at += size


def _text(data: bytes, at: int) -> tuple[str, int]:
    """The string that begins at `at`, and where the next thing begins."""
    end = data.find(b"\0", at, at + 256)
    if end < 0:
        raise _damaged("a name in the header does not end")
    return data[at:end].decode("utf-8", "backslashreplace"), end + 1


def _value(attributes: dict[str, bytes], name: str, form: str) -> tuple[int, ...]:
    value = attributes.get(name, b"")
    if len(value) != struct.calcsize(form):
        raise _damaged(f"the header has no usable {name!r}")
    return struct.unpack(form, value)


def _part(attributes: dict[str, bytes], flags: int) -> _Part:
    kind = attributes.get("type", b"").rstrip(b"\0")
    if flags & _MULTIPART:
        deep, tiled = kind.startswith(b"deep"), kind in (b"tiledimage", b"deeptile")
    else:
        # The flags rule: files exist whose type contradicts them.
        deep, tiled = bool(flags & _DEEP), bool(flags & _TILED)
    data = attributes.get("channels", b"")
    channels: dict[str, _Channel] = {}
    at = 0
    last = b""
    while data[at : at + 1] != b"\0":
        name, end = _text(data, at)
        if end + 16 > len(data):
            raise _damaged("its list of channels does not end")
        pixel_type, _, x_step, y_step = struct.unpack_from("<iIii", data, end)
        # Samples are stored in the order of the names, so any other order mixes up the channels.
        if data[at : end - 1] <= last:
            raise _damaged("its channels are not in alphabetical order")
        if pixel_type not in (0, 1, 2) or x_step < 1 or y_step < 1:
            raise _damaged(f"channel {_short(name)!r} has an unknown type or sampling")
        channels[name] = _Channel(pixel_type, (x_step, y_step))
        last, at = data[at : end - 1], end + 16
    windows = [_value(attributes, name, "<iiii") for name in ("dataWindow", "displayWindow")]
    for x0, y0, x1, y1 in windows:
        if x1 < x0 or y1 < y0:
            raise _damaged(f"a window from ({x0}, {y0}) to ({x1}, {y1}) has no pixels")
    return _Part(
        attributes,
        attributes.get("name", b"").decode("utf-8", "backslashreplace"),
        deep,
        tiled,
        channels,
        (windows[0][0], windows[0][1], windows[0][2], windows[0][3]),
        (windows[1][0], windows[1][1], windows[1][2], windows[1][3]),
    )


def _damaged(what: str) -> ImageError:
    return ImageError(f"damaged OpenEXR file: {what}; export it again")


def _short(name: str) -> str:
    return name if len(name) <= 40 else f"{name[:40]}..."


def _listed(names: list[str]) -> str:
    """At most eight names, since a file may have hundreds."""
    shown = ", ".join(_short(name) for name in names[:8])
    return f"{shown} and {len(names) - 8} more" if len(names) > 8 else shown


def _choose(
    parts: list[_Part], wanted: int | str | None, notes: list[str]
) -> tuple[int, tuple[str, ...]]:
    """The index of the part to read, and the names of the channels to read from it."""
    everything = range(len(parts))
    found = [_channel_names(part) for part in parts]
    if isinstance(wanted, int):
        if wanted not in everything:
            raise ImageError(f"expected a part from 0 to {len(parts) - 1}, got {wanted}")
        candidates = [wanted]
    elif wanted is None:
        candidates = [i for i in everything if found[i]]
        # A stable sort: parts that have plain R, G, B come first, deep ones last.
        candidates.sort(key=lambda i: (parts[i].deep, found[i] != _MODELS[0]))
    else:
        candidates = [i for i in everything if parts[i].name == wanted]
        if not candidates:
            found = [_channel_names(part, wanted) for part in parts]
            candidates = [i for i in everything if found[i]]
        if not candidates:
            raise ImageError(
                f"expected a part or a layer named {_short(wanted)!r}, got parts "
                f"{_listed([repr(part.name) for part in parts])}"
            )
    index = candidates[0] if candidates else 0
    part, names = parts[index], found[index]
    if part.deep:
        raise ImageError(
            "expected one sample a pixel, got a deep image; flatten it where it is rendered"
        )
    if not names:
        raise ImageError(
            f"expected channels R, G, B, or Y, RY, BY, or Y, got {_listed(list(part.channels))}; "
            "export it with colour channels"
        )
    if len(parts) > 1:
        notes.append(f"Of {len(parts)} parts, part {index} ({_short(part.name)!r}) is read.")
    if "." in names[0]:
        notes.append(f"The image is read from the channels {_listed(list(names))}.")
    if any(part.channels[name].kind == 0 for name in names):
        notes.append("The channels hold whole numbers, which are taken as they are.")
    others = [name for name in part.channels if name not in names]
    if others:
        notes.append(f"Channels that are not used: {_listed(others)}.")
    return index, names


def _channel_names(part: _Part, layer: str | None = None) -> tuple[str, ...]:
    """The channels that make the image, or the given layer; empty if there are none."""
    layers = [layer] if layer is not None else [""]
    if layer is None:
        layers += [name[:-2] for name in part.channels if name.endswith(".R")]
    for prefix in layers:
        for model in _MODELS if prefix in ("", layer) else _MODELS[:1]:
            names = tuple(f"{prefix}.{name}" if prefix else name for name in model)
            if all(name in part.channels for name in names):
                return names
    return ()


def _check(part: _Part, size: int) -> None:
    """Refuse a header of which the library would have to trust something."""
    width, height = part.size
    samples = 0
    for name, channel in part.channels.items():
        x_step, y_step = channel.step
        if (x_step, y_step) != (1, 1) and part.tiled:
            raise _damaged(f"channel {_short(name)!r} is subsampled in a tiled file")
        if any(edge % x_step for edge in (part.window[0], width)) or any(
            edge % y_step for edge in (part.window[1], height)
        ):
            raise _damaged(f"the sampling of channel {_short(name)!r} does not fit the data window")
        samples += channel.bytes * (width // x_step) * (height // y_step)
    _check_size(width, height, samples, size)
    shown = part.display[2] - part.display[0] + 1, part.display[3] - part.display[1] + 1
    _check_size(*shown, 12 * shown[0] * shown[1], size)
    (compression,) = _value(part.attributes, "compression", "<B")
    if compression >= len(_BLOCK_ROWS):
        raise _damaged(f"compression {compression} is not known")
    if part.tiled:
        columns, rows, _ = _value(part.attributes, "tiles", "<IIB")
        if columns == 0 or rows == 0:
            raise _damaged(f"its tiles are {columns} x {rows} pixels")
        # The library sets memory aside for a whole tile even where the image is smaller.
        _check_size(columns, rows, columns * rows * 4 * len(part.channels), size)


def _blocks(
    data: bytes, part: _Part, table: int, index: int | None
) -> list[tuple[bytes, memoryview]]:
    """Every block of the full-resolution image: where it stands in it, and its compressed data.

    `table` is where the part's table of offsets begins, `index` the number of the part in a file
    that has several. The first entries of a table are those of the full resolution.
    """
    width, height = part.size
    if part.tiled:
        columns, rows, _ = _value(part.attributes, "tiles", "<IIB")
        across = -(-width // columns)
        places = [
            struct.pack("<iiii", x, y, 0, 0)
            for y in range(-(-height // rows))
            for x in range(across)
        ]
        moved = places
    else:
        rows = _BLOCK_ROWS[_value(part.attributes, "compression", "<B")[0]]
        top = part.window[1]
        places = [struct.pack("<i", y) for y in range(top, top + height, rows)]
        moved = [struct.pack("<i", y) for y in range(0, height, rows)]
    if table < 0 or table + 8 * len(places) > len(data):
        raise ImageError(
            f"incomplete: the file ends in the table of its {len(places)} blocks of pixels; "
            "render or copy it again"
        )
    offsets = struct.unpack_from(f"<{len(places)}Q", data, table)
    blocks = []
    view = memoryview(data)  # a slice of it is no copy
    missing = 0
    for offset, place, new_place in zip(offsets, places, moved, strict=True):
        leader = place if index is None else struct.pack("<i", index) + place
        begin = offset + len(leader) + 4
        if offset == 0 or begin > len(data):
            missing += 1
            continue
        if data[offset : begin - 4] != leader:
            raise _damaged("its table of blocks of pixels does not lead to them")
        (size,) = struct.unpack_from("<i", data, begin - 4)
        if size <= 0:
            raise _damaged(f"a block of pixels has {size} bytes")
        if begin + size > len(data):
            missing += 1
            continue
        blocks.append((new_place, view[begin : begin + size]))
    if missing:
        raise ImageError(
            f"incomplete: {missing} of {len(places)} blocks of pixels are missing or cut off; "
            "render or copy it again"
        )
    return blocks


def _one_part(part: _Part, blocks: list[tuple[bytes, memoryview]], long_names: bool) -> bytes:
    """An OpenEXR file of this part alone, its data window moved to the origin."""
    width, height = part.size
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    attributes = [
        ("channels", "chlist", part.attributes["channels"]),
        ("compression", "compression", part.attributes["compression"]),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<ff", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    ]
    if part.tiled:
        tile = part.attributes["tiles"][:8] + b"\0"  # one level
        attributes.append(("tiles", "tiledesc", tile))
    flags = 2 | (_TILED if part.tiled else 0) | (_LONG_NAMES if long_names else 0)
    head = struct.pack("<II", 20000630, flags)
    for name, kind, value in attributes:
        head += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    head += b"\0"
    at = len(head) + 8 * len(blocks)
    offsets: list[int] = []
    body: list[bytes | memoryview] = []
    for place, block in blocks:
        offsets.append(at)
        body += [place, struct.pack("<i", len(block)), block]
        at += len(place) + 4 + len(block)
    return b"".join([head, struct.pack(f"<{len(offsets)}Q", *offsets), *body])


def _decoded(data: bytes, names: tuple[str, ...]) -> list[Floats]:
    import OpenEXR

    try:
        parts = OpenEXR.File(io.BytesIO(data), separate_channels=True).parts
    except Exception as error:
        raise _damaged(f"the OpenEXR library refuses it ({error})") from error
    if not parts:  # it prints a warning and leaves out a part that it cannot read
        raise _damaged("its blocks of pixels cannot be decompressed")
    return [parts[0].channels[name].pixels.astype(np.float32) for name in names]


# --- OpenEXR: colours -----------------------------------------------------------------------------

# x, y of red, green, blue and white. ITU-R BT.709-6, table 1.
BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# The "primaries" of a file whose R, G, B are CIE X, Y, Z; its white is a formality.
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
# Chromaticities, or coefficients of a conversion, that differ by less are the same but for rounding
# in the file (choice).
SAME_COLOUR = 1e-3

# Cone-like responses for chromatic adaptation, from CIE XYZ (Bradford). ICC.1:2010, annex E.3.
BRADFORD = np.array(
    [(0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296)]
)

# Half of the symmetric filter that makes the chroma between two samples; the first tap is for the
# nearest. A windowed sinc, 27 pixels wide: OpenEXR, ImfRgbaYca.cpp, reconstructChromaHoriz.
CHROMA_TAPS = (0.627123, -0.186077, 0.087929, -0.043159, 0.019597, -0.007540, 0.002128)


def _colours(
    part: _Part, names: tuple[str, ...], planes: list[Floats], nonfinite: str, notes: list[str]
) -> Floats:
    """The channels `names` as linear BT.709 of the display window's size, shape (3, H, W)."""
    model = tuple(name.rpartition(".")[2] for name in names)
    steps = [part.channels[name].step for name in names]
    x0, y0 = part.window[0] - part.display[0], part.window[1] - part.display[1]
    if model == ("Y", "RY", "BY"):
        if steps[0] != (1, 1) or steps[1] != steps[2] or steps[1] not in ((1, 1), (2, 2)):
            raise ImageError(f"expected chroma at half the resolution of Y, got sampling {steps}")
        # Before anything else, since a NaN would spread over the filter's width.
        luminance = _finite(planes[0][None], nonfinite, notes, (x0, y0))[0]
        chroma = _finite(np.stack(planes[1:]), nonfinite, notes, (x0, y0), steps[1][0])
        weights = _rgb_to_xyz(_chromaticities(part))[1]
        image = _from_luminance_chroma(luminance, chroma, weights)
        notes.append("R, G, B are reconstructed from luminance and chroma (Y, RY, BY).")
        image = _placed(image, part, notes)
    else:
        if any(step != (1, 1) for step in steps):
            raise ImageError(
                f"expected a value of {_listed(list(names))} in every pixel, got {steps}"
            )
        image = _finite(_placed(np.stack(planes), part, notes), nonfinite, notes)
    if model == ("Y",):
        notes.append("The image is grey (channel Y): R = G = B.")
        image = np.broadcast_to(image, (3, *image.shape[1:]))
    else:
        image = _to_bt709(image, part, model == ("X", "Y", "Z"), notes)
    _note_scale(part, notes)
    # Once more: what was finite in the file may overflow on the way.
    return _finite(image, nonfinite, notes)


def _from_luminance_chroma(luminance: Floats, chroma: Floats, weights: Matrix) -> Floats:
    """(H, W) and (2, H or H/2, W or W/2) to (3, H, W): RY = (R - Y) / Y, BY = (B - Y) / Y."""
    chroma_is_whole = chroma.shape[1:] == luminance.shape
    if not chroma_is_whole:
        chroma = _doubled(_doubled(chroma).swapaxes(1, 2)).swapaxes(1, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        red, blue = (chroma + 1) * luminance
        green = (luminance - weights[0] * red - weights[2] * blue) / weights[1]
    image = np.stack((red, green.astype(np.float32), blue))
    return image if chroma_is_whole else _less_saturated(image, weights)


def _less_saturated(image: Floats, weights: Matrix) -> Floats:
    """Take back colour that the filter made up: where a pixel is saturated and its neighbours not.

    Saturation is 1 - min / max of R, G, B. It may exceed the mean m of the four neighbours only up
    to 1 - (1 - m) / 4; beyond, the colour is pulled towards grey at the same luminance. So negative
    values, of saturation over 1, vanish. The rule is OpenEXR's (ImfRgbaYca.cpp, fixSaturation).
    """
    high = image.max(0)
    with np.errstate(all="ignore"):  # infinite values are dealt with by the caller
        saturation = np.where(high > 0, 1 - image.min(0) / high, np.float32(0))
        wide = np.pad(saturation, 1, mode="edge")
        mean = (wide[1:-1, :-2] + wide[1:-1, 2:] + wide[:-2, 1:-1] + wide[2:, 1:-1]) / 4
        limit = 1 - (1 - np.minimum(mean, 1)) / 4
        greyer = np.maximum(high - (high - image) * (limit / saturation), 0)
        before, after = (np.tensordot(weights.astype(np.float32), x, 1) for x in (image, greyer))
        greyer *= np.where(after > 0, before / after, np.float32(1))
    limited: Floats = np.where(saturation > limit, greyer, image)
    return limited


def _doubled(samples: Floats) -> Floats:
    """Twice the columns: the samples, and between two what the filter makes of those around."""
    count, reach = samples.shape[-1], len(CHROMA_TAPS)
    wide = np.pad(samples, ((0, 0), (0, 0), (reach - 1, reach)), mode="edge")
    between = np.zeros_like(samples)
    for i, tap in enumerate(CHROMA_TAPS):
        left, right = reach - 1 - i, reach + i
        between += np.float32(tap) * (
            wide[..., left : left + count] + wide[..., right : right + count]
        )
    return np.stack((samples, between), -1).reshape(*samples.shape[:-1], 2 * count)


def _placed(planes: Floats, part: _Part, notes: list[str]) -> Floats:
    """The display window: the data where there are any, 0 elsewhere."""
    if part.window == part.display:
        return planes
    x0, y0, x1, y1 = part.display
    shown = np.zeros((len(planes), y1 - y0 + 1, x1 - x0 + 1), np.float32)
    left, top = max(x0, part.window[0]), max(y0, part.window[1])
    right, bottom = min(x1, part.window[2]), min(y1, part.window[3])
    windows = (
        f"the data window ({part.window[0]}, {part.window[1]}) to ({part.window[2]}, "
        f"{part.window[3]}) and the display window ({x0}, {y0}) to ({x1}, {y1})"
    )
    if left > right or top > bottom:
        notes.append(f"The image is all 0: {windows} have no pixel in common.")
        return shown
    source = planes[
        :,
        top - part.window[1] : bottom + 1 - part.window[1],
        left - part.window[0] : right + 1 - part.window[0],
    ]
    shown[:, top - y0 : bottom + 1 - y0, left - x0 : right + 1 - x0] = source
    notes.append(
        f"The image has the size of the display window, and 0 where there are no data: {windows} "
        "differ."
    )
    return shown


def _chromaticities(part: _Part) -> tuple[float, ...]:
    if "chromaticities" not in part.attributes:
        return BT709
    return _value(part.attributes, "chromaticities", "<8f")


def _rgb_to_xyz(chromaticities: tuple[float, ...]) -> Matrix:
    """The matrix that gives CIE XYZ, with Y = 1 for R = G = B = 1."""
    xy = np.array(chromaticities, np.float64).reshape(4, 2)
    xyz = np.column_stack((xy, 1 - xy.sum(1)))
    primaries = xyz[:3].T
    with np.errstate(all="ignore"):
        # The determinant is twice the area of the triangle that the primaries make.
        if np.isfinite(xy).all() and abs(np.linalg.det(primaries)) > 1e-6 and xy[3, 1] > 0:
            matrix = primaries * np.linalg.solve(primaries, xyz[3] / xyz[3, 1])
            if np.isfinite(matrix).all() and matrix[1, 1] > 0:
                return matrix
    raise _damaged(f"its chromaticities {chromaticities} are no colour space")


def _to_bt709(image: Floats, part: _Part, is_xyz: bool, notes: list[str]) -> Floats:
    """Convert primaries, and the white by the Bradford transform.

    Grey stays grey: the file's white becomes BT.709's. XYZ has no white of its own, so X, Y, Z are
    converted as they are, unless an adoptedNeutral says what is to look white.
    """
    if "chromaticities" not in part.attributes and not is_xyz:
        notes.append("No chromaticities are given: BT.709 is assumed, as the format prescribes.")
        return image
    given = XYZ if is_xyz else _chromaticities(part)
    matrix = _rgb_to_xyz(given)
    absolute = np.allclose(given, XYZ, rtol=0, atol=SAME_COLOUR)
    neutral = BT709[6:] if absolute else given[6:]
    if "adoptedNeutral" in part.attributes:
        neutral = _value(part.attributes, "adoptedNeutral", "<ff")
    to_bt709 = np.linalg.inv(_rgb_to_xyz(BT709)) @ _adaptation(neutral) @ matrix
    if np.allclose(to_bt709, np.eye(3), rtol=0, atol=SAME_COLOUR):
        return image
    space = "CIE XYZ" if absolute else f"primaries {', '.join(f'{c:.4g}' for c in given[:6])}"
    notes.append(
        f"Colours are converted from {space} to BT.709, white from ({neutral[0]:.4g}, "
        f"{neutral[1]:.4g}) to D65."
    )
    with np.errstate(over="ignore", invalid="ignore"):
        converted: Floats = np.tensordot(to_bt709.astype(np.float32), image, 1)
    return converted


def _adaptation(neutral: tuple[float, ...]) -> Matrix:
    """The matrix, XYZ to XYZ, that takes the colour x, y = `neutral` to D65 (Bradford)."""
    x, y = neutral
    if not (0 < x < 1 and 0 < y < 1):
        raise _damaged(f"its white ({x:g}, {y:g}) is no colour")
    responses = [BRADFORD @ (u / v, 1, (1 - u - v) / v) for u, v in ((x, y), (BT709[6], BT709[7]))]
    if responses[0].min() <= 0:
        raise _damaged(f"its white ({x:g}, {y:g}) is no colour")
    matrix: Matrix = np.linalg.inv(BRADFORD) @ np.diag(responses[1] / responses[0]) @ BRADFORD
    return matrix


def _note_scale(part: _Part, notes: list[str]) -> None:
    """Say what the file states and the pixels do not carry."""
    if "whiteLuminance" in part.attributes:
        (white,) = _value(part.attributes, "whiteLuminance", "<f")
        notes.append(f"The file states that 1.0 is {white:g} cd/m2; pass it with --white.")
    if "pixelAspectRatio" in part.attributes:
        (aspect,) = _value(part.attributes, "pixelAspectRatio", "<f")
        if abs(aspect - 1) > 1e-3:
            notes.append(f"Pixels are taken as square; the file states a ratio of {aspect:g}.")


def _exr_bytes(planes: Floats) -> bytes:
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": BT709,
    }
    names = "Y" if len(planes) == 1 else "RGB"
    channels = {
        name: np.ascontiguousarray(plane) for name, plane in zip(names, planes, strict=True)
    }
    stream = io.BytesIO()
    OpenEXR.File(header, channels).write(stream)
    return stream.getvalue()
