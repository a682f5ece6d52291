"""The OpenEXR container.

A file is parsed here, before the OpenEXR library sees any of it: only the blocks of pixels of the
part that is wanted reach the library, behind a new header of nine attributes. So a damaged,
truncated or hostile file is refused before memory is allocated for it, attributes that the library
does not know do no harm, and a part that is not wanted costs nothing.

OpenEXR is imported where it is used: importing the package stays fast.
"""

import io
import struct
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from torch_vdm.io.decoded import Decoded
from torch_vdm.io.exr_colour import colours, transparency
from torch_vdm.io.exr_header import (
    LONG_NAMES,
    TILED,
    Bytes,
    Part,
    damaged,
    read_headers,
    short,
    value_of,
)
from torch_vdm.io.exr_layers import choose
from torch_vdm.io.primaries import BT709
from torch_vdm.io.refusal import Floats, ImageError, Repair, check_size

# Rows in a block of a scanline part, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ,
# PXR24, B44, B44A, DWAA, DWAB, HTJ2K256, HTJ2K32, LJ2K, ZSTD.
_BLOCK_ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32, 256, 1)


class Choice(NamedTuple):
    """Which of a file's images is asked for; None: the one most like the picture."""

    part: int | str | None = None
    view: str | None = None
    channels: Mapping[str, str] | None = None


def load_exr(data: Bytes, choice: Choice, repair: Repair, coded: bool, notes: list[str]) -> Decoded:
    """Return the linear BT.709 pixels; what was assumed goes to ``notes``.

    With ``coded`` the values are sRGB-coded, and stay so.
    """
    parts, table, long_names = read_headers(data)
    layer, views = choose(parts, *choice, notes)
    part = parts[layer.part]
    _check(part, len(data))
    for other in parts[: layer.part]:
        table += 8 * value_of(other.attributes, "chunkCount", "<i")[0]
    blocks = _blocks(data, part, table, layer.part if len(parts) > 1 else None)
    decoded = _decoded(_one_part(part, blocks, long_names))
    image = colours(part, layer, decoded, repair, coded, notes)
    alpha = None if layer.alpha is None else transparency(part, layer.alpha, decoded, notes)
    return Decoded(image, "coded" if coded else "scene", alpha, True, views)


def _check(part: Part, size: int) -> None:
    """Refuse a header with anything that the library would have to trust."""
    width, height = part.size
    samples = 0
    for name, channel in part.channels.items():
        x_step, y_step = channel.step
        if (x_step, y_step) != (1, 1) and part.tiled:
            raise damaged(f"channel {short(name)!r} is subsampled in a tiled file")
        if any(edge % x_step for edge in (part.window[0], width)) or any(
            edge % y_step for edge in (part.window[1], height)
        ):
            raise damaged(f"the sampling of channel {short(name)!r} does not fit the data window")
        samples += channel.bytes * (width // x_step) * (height // y_step)
    check_size(width, height, samples, size)
    shown = part.display[2] - part.display[0] + 1, part.display[3] - part.display[1] + 1
    check_size(*shown, 12 * shown[0] * shown[1], size)
    (compression,) = value_of(part.attributes, "compression", "<B")
    if compression >= len(_BLOCK_ROWS):
        raise damaged(f"compression {compression} is not known")
    if part.tiled:
        columns, rows, _ = value_of(part.attributes, "tiles", "<IIB")
        if columns == 0 or rows == 0:
            raise damaged(f"its tiles are {columns} x {rows} pixels")
        # The library allocates memory for a whole tile even where the image is smaller.
        check_size(columns, rows, columns * rows * 4 * len(part.channels), size)


def _blocks(data: Bytes, part: Part, table: int, index: int | None) -> list[tuple[bytes, bytes]]:
    """Every block of the full-resolution image: its place in it, and its compressed data.

    `table` is where the part's table of offsets begins, `index` the number of the part in a file
    that has several. The first entries of a table are those of the full resolution.
    """
    width, height = part.size
    if part.tiled:
        columns, rows, _ = value_of(part.attributes, "tiles", "<IIB")
    else:
        columns, rows = width, _BLOCK_ROWS[value_of(part.attributes, "compression", "<B")[0]]
    across, down = -(-width // columns), -(-height // rows)
    # Checked before a list is built: a file of a few bytes may declare millions.
    if table < 0 or table + 8 * across * down > len(data):
        raise ImageError(
            f"incomplete: the file ends in the table of its {across * down} blocks of pixels; "
            "render or copy it again"
        )
    if part.tiled:
        places = [struct.pack("<iiii", x, y, 0, 0) for y in range(down) for x in range(across)]
        moved = places
    else:
        top = part.window[1]
        places = [struct.pack("<i", y) for y in range(top, top + height, rows)]
        moved = [struct.pack("<i", y) for y in range(0, height, rows)]
    offsets = struct.unpack(f"<{len(places)}Q", data[table : table + 8 * len(places)])
    largest = _largest_block(part)
    blocks = []
    missing = 0
    for offset, place, new_place in zip(offsets, places, moved, strict=True):
        leader = place if index is None else struct.pack("<i", index) + place
        begin = offset + len(leader) + 4
        if offset == 0 or begin > len(data):
            missing += 1
            continue
        if data[offset : begin - 4] != leader:
            raise damaged("its table of blocks of pixels does not lead to them")
        (size,) = struct.unpack("<i", data[begin - 4 : begin])
        if not 0 < size <= largest:
            raise damaged(f"a block of pixels has {size} bytes")
        if begin + size > len(data):
            missing += 1
            continue
        blocks.append((new_place, data[begin : begin + size]))
    if missing:
        raise ImageError(
            f"incomplete: {missing} of {len(places)} blocks of pixels are missing or cut off; "
            "render or copy it again"
        )
    return blocks


def _largest_block(part: Part) -> int:
    """The most bytes that a block may have: data that does not shrink is stored as it is.

    The limit is twice that and a bit, for compressions that keep tables of their own.
    """
    if part.tiled:
        columns, rows, _ = value_of(part.attributes, "tiles", "<IIB")
    else:
        rows = _BLOCK_ROWS[value_of(part.attributes, "compression", "<B")[0]]
        columns = part.size[0]
    return 2 * columns * rows * sum(channel.bytes for channel in part.channels.values()) + 2**16


def _one_part(part: Part, blocks: list[tuple[bytes, bytes]], long_names: bool) -> bytes:
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
    flags = 2 | (TILED if part.tiled else 0) | (LONG_NAMES if long_names else 0)
    head = struct.pack("<II", 20000630, flags)
    for name, kind, value in attributes:
        head += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    head += b"\0"
    at = len(head) + 8 * len(blocks)
    offsets: list[int] = []
    body: list[bytes] = []
    for place, block in blocks:
        offsets.append(at)
        body += [place, struct.pack("<i", len(block)), block]
        at += len(place) + 4 + len(block)
    return b"".join([head, struct.pack(f"<{len(offsets)}Q", *offsets), *body])


def _decoded(data: bytes) -> dict[str, Floats]:
    import OpenEXR

    try:
        parts = OpenEXR.File(io.BytesIO(data), separate_channels=True).parts
    except MemoryError:
        raise
    except Exception as error:
        raise damaged(f"the OpenEXR library refuses it ({error})") from error
    if not parts:  # it prints a warning and leaves out a part that it cannot read
        raise damaged("its blocks of pixels cannot be decompressed")
    return {name: channel.pixels for name, channel in parts[0].channels.items()}


def encode_exr(channels: Mapping[str, Floats], entries: Mapping[str, str] | None = None) -> bytes:
    """Return planes (H, W) as a file of float channels of these names, with header entries."""
    import OpenEXR

    header = {
        **(entries or {}),
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": BT709,
    }
    stream = io.BytesIO()
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    OpenEXR.File(header, planes).write(stream)
    return stream.getvalue()
