"""The header of an OpenEXR file, read and checked here instead of by the OpenEXR library."""

import struct
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from torch_vdm.io.refusal import ImageError

Window: TypeAlias = tuple[int, int, int, int]  # x min, y min, x max, y max; all inclusive


class Bytes(Protocol):
    """Bytes, or a file whose slices are read on demand."""

    def __len__(self) -> int:
        """Return how many bytes there are."""

    def __getitem__(self, part: slice, /) -> bytes:
        """Return a part of them."""


TILED, LONG_NAMES, _DEEP, _MULTIPART = 0x200, 0x400, 0x800, 0x1000


@dataclass(frozen=True)
class Channel:
    """A channel of a part."""

    kind: int  # 0 unsigned integer, 1 half, 2 float
    step: tuple[int, int]  # one sample every so many pixels in x and in y

    @property
    def bytes(self) -> int:
        """The size of a sample."""
        return 2 if self.kind == 1 else 4


@dataclass(frozen=True)
class Part:
    """What the header says of a part."""

    attributes: dict[str, bytes]
    name: str
    deep: bool
    tiled: bool
    channels: dict[str, Channel]
    window: Window  # where there are data
    display: Window  # what is to be shown

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the data window."""
        return self.window[2] - self.window[0] + 1, self.window[3] - self.window[1] + 1


def read_headers(data: Bytes) -> tuple[list[Part], int, bool]:
    """The parts, where the first table of offsets begins, and whether names may be long."""
    if len(data) < 8:
        raise damaged("the file ends in its header")
    (field,) = struct.unpack("<I", data[4:8])
    flags = field & ~0xFF
    if field & 0xFF != 2 or flags & ~(TILED | LONG_NAMES | _DEEP | _MULTIPART):
        raise ImageError(
            f"expected OpenEXR version 2, got version {field & 0xFF} with flags {flags:#x}; "
            "export it again"
        )
    at = 8
    parts: list[Part] = []
    while not parts or flags & _MULTIPART:
        attributes, at = _attributes(data, at)
        if not attributes:  # an empty header closes a list of parts
            break
        parts.append(_part(attributes, flags))
    if not parts:
        raise damaged("it has no header")
    return parts, at, bool(flags & LONG_NAMES)


def _attributes(data: Bytes, at: int) -> tuple[dict[str, bytes], int]:
    attributes: dict[str, bytes] = {}
    while True:
        name, at = _text(data, at)
        if not name:
            return attributes, at
        _, at = _text(data, at)
        if at + 4 > len(data):
            raise damaged("the file ends in its header")
        (size,) = struct.unpack("<i", data[at : at + 4])
        at += 4
        if not 0 <= size <= len(data) - at:
            raise damaged(f"the header's attribute {short(name)!r} goes beyond the end of the file")
        attributes[name] = data[at : at + size]
        at += size


def _text(data: Bytes, at: int) -> tuple[str, int]:
    """The string that begins at `at`, and where the next field begins."""
    name, zero, _ = data[at : at + 256].partition(b"\0")
    if not zero:
        raise damaged("a name in the header does not end")
    return name.decode("utf-8", "backslashreplace"), at + len(name) + 1


def value_of(attributes: dict[str, bytes], name: str, form: str) -> tuple[int, ...]:
    """Return an attribute that must be there, unpacked."""
    value = attributes.get(name, b"")
    if len(value) != struct.calcsize(form):
        raise damaged(f"the header has no usable {name!r}")
    return struct.unpack(form, value)


def _part(attributes: dict[str, bytes], flags: int) -> Part:
    kind = attributes.get("type", b"").rstrip(b"\0")
    if flags & _MULTIPART:
        deep, tiled = kind.startswith(b"deep"), kind in (b"tiledimage", b"deeptile")
    else:
        # The flags take precedence: files exist whose type contradicts them.
        deep, tiled = bool(flags & _DEEP), bool(flags & TILED)
    data = attributes.get("channels", b"")
    channels: dict[str, Channel] = {}
    at = 0
    last = b""
    while data[at : at + 1] != b"\0":
        name, end = _text(data, at)
        if end + 16 > len(data):
            raise damaged("its list of channels does not end")
        pixel_type, _, x_step, y_step = struct.unpack_from("<iIii", data, end)
        # Samples are stored in the order of the names, so any other order mixes up the channels.
        if data[at : end - 1] <= last:
            raise damaged("its channels are not in alphabetical order")
        if pixel_type not in (0, 1, 2) or x_step < 1 or y_step < 1:
            raise damaged(f"channel {short(name)!r} has an unknown type or sampling")
        channels[name] = Channel(pixel_type, (x_step, y_step))
        last, at = data[at : end - 1], end + 16
    windows = [value_of(attributes, name, "<iiii") for name in ("dataWindow", "displayWindow")]
    for x0, y0, x1, y1 in windows:
        if x1 < x0 or y1 < y0:
            raise damaged(f"a window from ({x0}, {y0}) to ({x1}, {y1}) has no pixels")
    return Part(
        attributes,
        attributes.get("name", b"").decode("utf-8", "backslashreplace"),
        deep,
        tiled,
        channels,
        (windows[0][0], windows[0][1], windows[0][2], windows[0][3]),
        (windows[1][0], windows[1][1], windows[1][2], windows[1][3]),
    )


def damaged(what: str) -> ImageError:
    """Return the error of a file that breaks the format."""
    return ImageError(f"damaged OpenEXR file: {what}; export it again")


def short(name: str) -> str:
    """Return a name, cut where it is too long for a message."""
    return name if len(name) <= 40 else f"{name[:40]}..."


def listed(names: list[str]) -> str:
    """At most eight names, since a file may have hundreds."""
    shown = ", ".join(short(name) for name in names[:8])
    return f"{shown} and {len(names) - 8} more" if len(names) > 8 else shown
