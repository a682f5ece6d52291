"""Images from files and to files, whole or not at all."""

import contextlib
import ctypes
import os
import secrets
import stat
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from torch_vdm.io.coded import encode_coded, load_jpeg, load_png
from torch_vdm.io.exr import encode_exr, load_exr
from torch_vdm.io.refusal import Floats, ImageError, printable, without_negatives

PathLike: TypeAlias = str | os.PathLike[str]

# Which suffixes are written, and what a file of that name is expected to hold.
FORMATS = {".exr": "OpenEXR", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


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
        if suffix == ".exr":
            encoded = encode_exr(dict(zip("Y" if len(planes) == 1 else "RGB", planes, strict=True)))
        else:
            encoded = encode_coded(planes, FORMATS[suffix])
    except ImageError as error:
        raise ImageError(f"{os.fspath(path)}: {error}") from error.__cause__
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)


def write_channels(path: PathLike, channels: Mapping[str, Tensor]) -> None:
    """Write an OpenEXR file of 32-bit float channels of any names, whole or not at all.

    Parameters
    ----------
    path
        The file, whose name ends in ``.exr``; one that exists is replaced once the new one is
        complete.
    channels
        Planes (H, W) of one size by the names of their channels. R, G, B are linear BT.709; others
        are what their names say.

    Raises
    ------
    ImageError
        If the suffix is another one, the planes differ in size, or the file cannot be written.
    """
    if Path(path).suffix.lower() != ".exr":
        raise ImageError(f"{os.fspath(path)}: expected a name that ends in .exr")
    shapes = {tuple(plane.shape) for plane in channels.values()}
    if len(shapes) != 1 or any(len(shape) != 2 or 0 in shape for shape in shapes):
        raise ImageError(
            f"{os.fspath(path)}: expected channels of one shape (H, W) with at least one pixel, "
            f"got {sorted(shapes)}"
        )
    encoded = encode_exr(
        {name: plane.detach().to("cpu", torch.float32).numpy() for name, plane in channels.items()}
    )
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
        check_target(target)
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


def check_target(target: Path) -> None:
    """Refuse what `atomic_path` could not put a file in the place of."""
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
            pixels = load_exr(data, part, nonfinite, notes)
            pixels = without_negatives(pixels, negative, notes)
        else:
            pixels = load_png(data, notes) if content == "PNG" else load_jpeg(data, notes)
    sentences = tuple(printable(note) for note in notes)
    return Image(
        torch.from_numpy(np.array(pixels, np.float32, order="C")), content == "OpenEXR", sentences
    )


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
