"""Images read from files, and written to files whole or not at all."""

import contextlib
import ctypes
import hashlib
import os
import re
import secrets
import stat
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import torch
from torch import Tensor

from torch_vdm.io.alpha import colour, over
from torch_vdm.io.arrays import MAGIC as ARRAY_MAGIC
from torch_vdm.io.decoded import Decoded, Kind
from torch_vdm.io.exr import Choice, encode_exr, load_exr
from torch_vdm.io.netpbm import load_pfm, load_pnm
from torch_vdm.io.pictures import encode_coded, load_picture
from torch_vdm.io.png import load_png
from torch_vdm.io.radiance import load_hdr
from torch_vdm.io.refusal import Floats, ImageError, Negative, Nonfinite, Repair, printable
from torch_vdm.io.tiff import load_tiff

PathLike: TypeAlias = str | os.PathLike[str]

# Suffixes that can be written.
FORMATS = {".exr": "OpenEXR", ".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}

# The format that a suffix promises.
SUFFIXES = FORMATS | {
    ".hdr": "HDR",
    ".pic": "HDR",
    ".pfm": "PFM",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".webp": "WebP",
    ".bmp": "BMP",
    ".ppm": "PNM",
    ".pgm": "PNM",
    ".pbm": "PNM",
    ".pnm": "PNM",
    ".tga": "TGA",
    ".gif": "GIF",
    ".avif": "AVIF",
    ".jxl": "JPEG XL",
}

# The first bytes of each format; TGA has none.
MAGIC = (
    ("OpenEXR", rb"\x76\x2f\x31\x01"),
    ("PNG", rb"\x89PNG\r\n\x1a\n"),
    ("JPEG", rb"\xff\xd8\xff"),
    ("HDR", rb"#\?"),
    ("PFM", rb"P[Ff]\s"),
    ("PNM", rb"P[1-6][\s#]"),
    ("TIFF", rb"II[*+]\0|MM\0[*+]"),
    ("WebP", rb"RIFF....WEBP"),
    ("GIF", rb"GIF8[79]a"),
    ("BMP", rb"BM"),
    ("AVIF", rb"....ftypavi[fs]|....ftypmif1.{4,16}avif"),
    ("JPEG XL", rb"\xff\x0a|\0\0\0\x0cJXL "),
)

# Formats whose pixels are light; those of a TIFF may be, in floating point.
SCENE = ("OpenEXR", "HDR", "PFM")

# The largest file that is read whole, in bytes; of OpenEXR only what is wanted is read. It is twice
# what the largest image takes with 64 bits per channel. Status: choice.
LARGEST_FILE = 2**32

# The first bytes that identify a file's format.
HEAD = 64


@dataclass(frozen=True, eq=False)
class Image:
    """An image and what was assumed in reading it.

    Attributes
    ----------
    pixels
        float32, shape (3, H, W), over the background where the file is transparent.
    kind
        What the pixels are. "coded": sRGB-coded, 0 to 1; colours that sRGB lacks lie outside.
        "scene": linear BT.709, where 1.0 is what the scene calls white. "absolute": linear BT.709
        in cd/m2 (PQ, HLG).
    notes
        One sentence for every assumption and every repair, in the order in which they were made.
    content
        The format: "OpenEXR", "PNG" and so on.
    alpha
        float32, (H, W) in [0, 1]; None where the file has none.
    associated
        Whether the file's colours are multiplied by alpha.
    views
        The names of the views of a multi-view OpenEXR file, that of `pixels` among them.
    """

    pixels: Tensor
    kind: Kind
    notes: tuple[str, ...]
    content: str
    alpha: Tensor | None = None
    associated: bool = False
    views: tuple[str, ...] = ()

    @property
    def linear(self) -> bool:
        """Whether the pixels are light, not code."""
        return self.kind != "coded"


def read_image(
    path: PathLike,
    *,
    part: int | str | None = None,
    nonfinite: Nonfinite = "raise",
    negative: Negative = "keep",
    background: str = "black",
) -> Tensor:
    """Read an image file: the pixels of `load`.

    Negative linear values (colours out of gamut, lobes of filters) are kept unless asked otherwise;
    everything else is as in `load`.

    Returns
    -------
    float32, shape (3, H, W): scene-linear BT.709 from OpenEXR, Radiance .hdr, PFM and TIFF of
    floating point; sRGB-coded from all else, in [0, 1] except for colours that sRGB lacks, in files
    that declare them.

    Raises
    ------
    ImageError
        As `load` does; and where the pixels are neither, or not what the file's name promises:
        absolute light (PQ, HLG), an OpenEXR file called .png. `load` reads these.
    """
    image = load(path, part=part, nonfinite=nonfinite, negative=negative, background=background)
    named = SUFFIXES.get(Path(path).suffix.lower(), image.content)
    promised = image.content == "TIFF" or image.linear == (named in SCENE)
    if image.kind == "absolute" or not promised:
        raise ImageError(
            f"{os.fspath(path)}: expected {'light' if named in SCENE else 'sRGB-coded values'} in "
            f"a file of this name, got {image.content} of {image.kind} values; read it with "
            "torch_vdm.io.load, which says what they are"
        )
    return image.pixels


def load(
    path: PathLike,
    *,
    part: int | str | None = None,
    view: str | None = None,
    channels: Mapping[str, str] | None = None,
    nonfinite: Nonfinite = "raise",
    negative: Negative = "raise",
    background: str = "black",
    coded: bool = False,
    quiet: bool = False,
) -> Image:
    """Read an image file, and report what was assumed.

    The content decides the format; the name is used in messages, and to recognize TGA. What is read
    of which format, and what is refused, is in docs/files.md.

    OpenEXR: channels R, G, B (r, red, .R), else Y, RY, BY (luminance and chroma), are read from no
    layer, else from a layer called Combined, beauty, rgba, color or colour, else from the only
    layer there is; X, Y, Z (CIE) or Y (grey) of no layer if there is nothing else. Primaries other
    than BT.709's are converted. The image has the size of the display window. Of a tiled file with
    several levels the full resolution is read. Deep files are refused.

    Other formats: grey, palette and 16-bit files are read too. What a file states about its colours
    (cICP, ICC profile, gAMA and cHRM) and its orientation is applied. CMYK, animations and several
    pictures in a file are refused.

    Parameters
    ----------
    path
        The file.
    part
        Which part of an OpenEXR file: its index from 0, its name, or the name of a layer, whole
        (``ViewLayer.Combined``) or its last word, or "" for the channels of no layer. None: what
        looks most like the picture.
    view
        Which view of a multi-view OpenEXR file. None: the first.
    channels
        The names of the OpenEXR channels to take for "R", "G", "B" and perhaps "A".
    nonfinite
        What to do about NaN and infinity: refuse the file, put 0 in their place, or clamp infinity
        to the largest finite value of the channel's type (65504 for half) and set NaN to the mean
        of its finite neighbours, or 0.
    negative
        What to do about negative linear values that the file has: keep them, refuse the file, or
        put 0 in their place. Those that result from a conversion to BT.709 are kept.
    background
        What is seen through a transparent image: black, white, grey or #rrggbb, sRGB-coded; white
        is 1.0 in linear values and 203 cd/m2 in absolute ones. sRGB-coded values are composited as
        they are, light as light; colours that are associated with alpha (OpenEXR, some TIFF) are
        not multiplied by it again.
    coded
        Take values of light (OpenEXR, .hdr, PFM, TIFF of floating point) as sRGB-coded ones.
    quiet
        Keep the libraries from printing. The OpenEXR library writes to standard output and standard
        error by itself when the data inside a block is damaged. To suppress that, file descriptors
        1 and 2 and ``sys.stdout`` lead nowhere while the file is decoded, in every thread, and
        child processes started meanwhile inherit that: use it in command lines, not in libraries.

    Returns
    -------
    The pixels, float32 of shape (3, H, W), what they are, and the notes.

    Raises
    ------
    ImageError
        If the file is missing, damaged, incomplete, of another kind, too large (over
        89 million pixels) or without colour channels, or if its values are refused. The message
        is one line that names the file.
    MemoryError
        If it does not fit into memory; the message names the file too.
    """
    for name, value, known in (
        ("nonfinite", nonfinite, ("raise", "zero", "clamp")),
        ("negative", negative, ("keep", "raise", "clip")),
    ):
        if value not in known:
            raise ValueError(f"expected {name} to be one of {known}, got {value!r}")
    colour(background)  # refuses an unknown one
    try:
        notes: list[str] = []
        with _hushed() if quiet else contextlib.nullcontext():
            choice = Choice(part, view, channels)
            content, decoded = _decoded(path, choice, Repair(nonfinite, negative), coded, notes)
        pixels = over(decoded, background, notes)
    except ImageError as error:
        raise ImageError(f"{os.fspath(path)}: {error}") from error.__cause__
    except MemoryError as error:
        raise MemoryError(f"{printable(os.fspath(path))}: not enough memory to read it") from error
    alpha = None if decoded.alpha is None else torch.from_numpy(np.array(decoded.alpha, np.float32))
    return Image(
        torch.from_numpy(np.array(pixels, np.float32, order="C")),
        decoded.kind,
        tuple(printable(note) for note in notes),
        content,
        alpha,
        decoded.associated,
        decoded.views,
    )


def write_image(path: PathLike, image: Tensor) -> None:
    """Write an OpenEXR, PNG or JPEG file, as the suffix of its name says, whole or not at all.

    ``.exr`` keeps every value: 32-bit float channels R, G, B, or Y for a grey image, marked as
    linear BT.709. ``.png`` (8 bits) and ``.jpg`` (quality 95, colour at full resolution) take
    sRGB-coded values and clip them to [0, 1].

    Parameters
    ----------
    path
        The file; an existing one is replaced once the new one is complete.
    image
        Shape (3, H, W), or (1, H, W) or (H, W) for grey; any float type, any device.

    Raises
    ------
    ImageError
        If the suffix is not known, the shape or type does not fit, a value for PNG or JPEG is not
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


def write_channels(
    path: PathLike, channels: Mapping[str, Tensor], header: Mapping[str, str] | None = None
) -> None:
    """Write an OpenEXR file of 32-bit float channels of any names, whole or not at all.

    Parameters
    ----------
    path
        The file, whose name ends in ``.exr``; an existing one is replaced once the new one is
        complete.
    channels
        Planes (H, W) of one size by channel name. R, G, B are linear BT.709; others are what their
        names say.
    header
        Further entries of the file's header.

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
    planes = {n: plane.detach().to("cpu", torch.float32).numpy() for n, plane in channels.items()}
    encoded = encode_exr(planes, header)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)


@contextlib.contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """Write a file whole or not at all.

    ``with atomic_path("out.json") as temporary: temporary.write_text(...)``. The temporary file
    lies in the folder of `path` and has the same suffix. It replaces `path` when the block ends; if
    the block raises, it is removed and `path` is left as it was.

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
    # Not tempfile.mkstemp: only their owner could read its files, and so the result.
    temporary = target.with_name(f".{_mark(target)}{secrets.token_hex(4)}{target.suffix}")
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


def remove_abandoned(paths: Iterable[Path], folders: Iterable[Path] = ()) -> None:
    """Remove the temporary files of `atomic_path` that killed processes left next to some files.

    In ``folders`` they are removed whatever file they were of. Nobody may be writing these files.
    """
    marks: dict[Path, set[tuple[str, str]]] = {}
    for path in paths:
        target = Path(os.path.realpath(path))
        marks.setdefault(target.parent, set()).add((_mark(target), target.suffix))
    whole = set(folders)
    for folder in {*marks, *whole}:
        for path in folder.glob(".*"):
            found = _TEMPORARY.fullmatch(path.name)
            if found and (folder in whole or found.groups() in marks[folder]):
                path.unlink(missing_ok=True)


# What `_mark` gives, what is drawn, and the suffix.
_TEMPORARY = re.compile(r"\.([0-9a-f]{8})[0-9a-f]{8}(\.[^.]*)?")


def _mark(target: Path) -> str:
    """Return what the temporary files of a target begin with; its name may be too long for that."""
    return hashlib.sha256(os.fsencode(target.name)).hexdigest()[:8]


def check_target(target: Path) -> None:
    """Refuse what `atomic_path` could not replace with a file."""
    if not target.parent.is_dir():
        raise ImageError(f"{target}: expected the folder to exist; create it first")
    # Renaming over a folder fails, and over a device such as /dev/null replaces the device.
    if target.exists() and not target.is_file():
        raise ImageError(f"{target}: expected a file to write to, got a folder or a device")


class _Slices:
    """A file whose slices are read on demand."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice, /) -> bytes:
        begin, end, _ = part.indices(self._size)
        self._file.seek(begin)
        data = self._file.read(max(0, end - begin))
        if len(data) < end - begin:
            raise ImageError("incomplete: the file became shorter while it was read; wait for it")
        return data


def _decoded(
    path: PathLike, choice: Choice, repair: Repair, coded: bool, notes: list[str]
) -> tuple[str, Decoded]:
    """The format, and the image. No more of a file is read than is needed."""
    try:
        with _opened(path) as file:
            size = os.fstat(file.fileno()).st_size
            content = _content(file.read(HEAD), path, notes)
            if content == "OpenEXR":
                return content, load_exr(_Slices(file, size), choice, repair, coded, notes)
            if choice.part not in (None, 0) or choice.view or choice.channels:
                wanted = f"part {choice.part!r}" if choice.part else "views and channels"
                raise ImageError(f"expected an OpenEXR file for {wanted}, got {content}")
            if size > LARGEST_FILE:
                raise ImageError(
                    f"expected a file of at most {LARGEST_FILE} bytes, got {size}; make it smaller"
                )
            file.seek(0)
            data = file.read()
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror or error}") from error
    return content, _decoded_whole(data, content, repair, coded, notes)


def _decoded_whole(
    data: bytes, content: str, repair: Repair, coded: bool, notes: list[str]
) -> Decoded:
    if content == "PNG":
        return load_png(data, notes)
    if content == "TIFF":
        return load_tiff(data, repair, coded, notes)
    if content == "PNM":
        return load_pnm(data, notes)
    if content == "PFM":
        image = load_pfm(data, repair, notes)
        return image._replace(kind="coded") if coded else image
    if content == "HDR":
        image = load_hdr(data, repair.nonfinite, notes)
        return image._replace(kind="coded") if coded else image
    if content == "JPEG XL":
        # The libraries for Python report neither how many pictures there are nor their colours.
        raise ImageError(
            "expected another format, got JPEG XL; convert it to PNG with libjxl's djxl"
        )
    return load_picture(data, content, notes)


@contextlib.contextmanager
def _opened(path: PathLike) -> Iterator[BinaryIO]:
    file = Path(path)
    try:
        # Checked first, since opening a pipe that nobody writes to would wait for ever.
        status = file.stat()
    except FileNotFoundError as error:
        raise ImageError("no such file; check the name") from error
    except ValueError as error:  # a zero byte in the name
        raise ImageError(f"cannot be read: {error}") from error
    if not stat.S_ISREG(status.st_mode):
        folder = stat.S_ISDIR(status.st_mode)
        what = "a folder" if folder else "a device or a pipe; copy it to a file first"
        raise ImageError(f"expected an image file, got {what}")
    if not status.st_size:
        raise ImageError("expected an image, got an empty file; write it again")
    with file.open("rb") as stream:
        yield stream


def _content(head: bytes, path: PathLike, notes: list[str]) -> str:
    """The format by the first bytes: one of SUFFIXES' values."""
    named = SUFFIXES.get(Path(path).suffix.lower())
    for content, magic in MAGIC:
        if re.match(magic, head, re.DOTALL):
            if named not in (None, content):
                notes.append(f"The name says {named}, but the content is {content} and is read so.")
            return content
    if named == "TGA":
        return named
    if head.startswith(ARRAY_MAGIC):
        raise ImageError(
            "expected an image, got a NumPy array; use numpy.load or torch_vdm.io.ArrayFile"
        )
    known = ", ".join(dict.fromkeys(SUFFIXES.values()))
    raise ImageError(
        f"expected an image ({known}), got other content (it begins with bytes "
        f"{head[:4].hex(' ')}); {'export it again' if named else 'convert it to one of them'}"
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
    # buffered: its output would appear after the descriptor is restored. Where the C library cannot
    # be reached this way (Windows), it does.
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).fflush(None)
