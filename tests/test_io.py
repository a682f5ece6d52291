"""Image files against OpenEXR and Pillow themselves, and against damage of every kind."""

import io
import json
import os
import re
import stat
import struct
import subprocess
import sys
import textwrap
import zlib
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import PIL.Image
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from torch_vdm.io import (
    ImageError,
    atomic_path,
    load,
    read_image,
    write_channels,
    write_image,
)

ROOT = Path(__file__).resolve().parent.parent

COMPRESSIONS = sorted(name for name in vars(OpenEXR) if name.endswith("_COMPRESSION"))
HEIGHT, WIDTH = 45, 70

# x, y of red, green, blue, white; and the matrix to linear BT.709 that goes with them.
BT709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
# IEC 61966-2-1, amendment 1, equation F.8.
XYZ_TO_BT709 = np.array(
    [
        (3.2406255, -1.537208, -0.4986286),
        (-0.9689307, 1.8757561, 0.0415175),
        (0.0557101, -0.2040211, 1.0569959),
    ]
)
# The ACES project's matrix from AP0 to BT.709, D60 to D65 by Bradford.
ACES_TO_BT709 = np.array(
    [
        (2.52168619, -1.13413099, -0.38755520),
        (-0.27647991, 1.37271909, -0.09623917),
        (-0.01537806, -0.15297534, 1.16835340),
    ]
)


def planes(count: int = 3, height: int = HEIGHT, width: int = WIDTH) -> NDArray[np.float32]:
    """Return smooth planes with a little noise, so that every compression has something to do."""
    rng = np.random.default_rng(count)
    y, x = np.mgrid[:height, :width]
    waves = [0.6 + 0.4 * np.sin(x / 7 + y / (9 + i) + i) for i in range(count)]
    return (np.stack(waves) + rng.uniform(0, 0.02, (count, height, width))).astype(np.float32)


def write_exr(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    """Write a file with the OpenEXR library."""
    header = {"type": OpenEXR.scanlineimage, "chromaticities": BT709, **header}
    OpenEXR.File(header, {n: np.ascontiguousarray(c) for n, c in channels.items()}).write(str(path))
    return path


def write_parts(path: Path, **parts: dict[str, NDArray[np.float32]]) -> Path:
    """Write a file of several parts with the OpenEXR library."""
    made = []
    for name, channels in parts.items():
        header = {"type": OpenEXR.scanlineimage, "chromaticities": BT709}
        copies = {channel: values.copy() for channel, values in channels.items()}
        made.append(OpenEXR.Part(header, copies, name))
    OpenEXR.File(made).write(str(path))
    return path


def box(x: int, y: int, width: int, height: int) -> tuple[Any, Any]:
    """Return a window as the OpenEXR library takes it."""
    return (np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32))


def rgb(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    return dict(zip("RGB", values, strict=True))


def hand_made_exr(
    path: Path,
    channels: dict[str, tuple[NDArray[np.float32], int]],
    *,
    origin: tuple[int, int] = (0, 0),
    flags: int = 0,
    attributes: dict[str, tuple[str, bytes]] | None = None,
) -> Path:
    """Write what the library's Python module cannot: subsampled channels, and lies.

    Uncompressed rows of 32-bit floats; `channels` holds for each name the samples and the step.
    """
    names = sorted(channels)
    height, width = (size * channels[names[0]][1] for size in channels[names[0]][0].shape)
    x0, y0 = origin
    listed = b"".join(
        name.encode() + struct.pack("<xiIii", 2, 0, channels[name][1], channels[name][1])
        for name in names
    )
    window = struct.pack("<iiii", x0, y0, x0 + width - 1, y0 + height - 1)
    header = {
        "channels": ("chlist", listed + b"\0"),
        "compression": ("compression", b"\0"),
        "dataWindow": ("box2i", window),
        "displayWindow": ("box2i", window),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)),
        "screenWindowCenter": ("v2f", bytes(8)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
        "chromaticities": ("chromaticities", struct.pack("<8f", *BT709)),
        **(attributes or {}),
    }
    head = struct.pack("<II", 20000630, 2 | flags)
    for name, (kind, value) in header.items():
        head += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    head += b"\0"
    rows = []
    for y in range(height):
        row = b"".join(
            samples[y // step].astype("<f4").tobytes()
            for samples, step in (channels[name] for name in names)
            if y % step == 0
        )
        rows.append(struct.pack("<ii", y0 + y, len(row)) + row)
    offsets = np.cumsum([len(head) + 8 * height, *(len(row) for row in rows[:-1])])
    path.write_bytes(head + offsets.astype("<u8").tobytes() + b"".join(rows))
    return path


def refusal(path: Path, **options: Any) -> str:
    """Return the message with which `load` refuses the file, after checking its form."""
    with pytest.raises(ImageError) as caught:
        load(path, **options)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    return message[len(f"{path}: ") :]


# --- OpenEXR --------------------------------------------------------------------------------------


@pytest.mark.parametrize("tiled", [False, True])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_openexr_is_read_as_the_library_reads_it(
    tmp_path: Path, compression: str, dtype: type[np.generic], tiled: bool
) -> None:
    header: dict[str, Any] = {"compression": getattr(OpenEXR, compression)}
    if tiled:
        header |= {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
        header["tiles"].xSize, header["tiles"].ySize = 32, 16
    scale = 1000 if dtype is np.uint32 else 1
    channels = rgb((planes() * scale).astype(dtype))
    path = write_exr(tmp_path / "image.exr", channels, **header)
    expected = OpenEXR.File(str(path), separate_channels=True).channels()
    image = load(path)
    assert image.pixels.dtype == torch.float32
    assert image.linear
    whole = "The channels hold whole numbers, which are taken as they are."
    assert image.notes == ((whole,) if dtype is np.uint32 else ())
    np.testing.assert_array_equal(
        image.pixels, np.stack([expected[name].pixels for name in "RGB"]).astype(np.float32)
    )


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (257, 3)])
def test_openexr_of_every_size(tmp_path: Path, size: tuple[int, int]) -> None:
    values = planes(3, *size)
    path = write_exr(tmp_path / "image.exr", rgb(values), compression=OpenEXR.DWAB_COMPRESSION)
    assert read_image(path).shape == (3, *size)


def test_other_channels_are_left_out_and_named(tmp_path: Path) -> None:
    values = planes(3)
    more = {name: planes(1)[0] for name in ("A", "Z", "albedo.R", "albedo.G", "albedo.B")}
    image = load(write_exr(tmp_path / "image.exr", rgb(values) | more))
    np.testing.assert_array_equal(image.pixels, values)
    assert image.notes[0] == "Channels that are not used: Z, albedo.B, albedo.G, albedo.R."


def test_one_channel_is_grey(tmp_path: Path) -> None:
    (values,) = planes(1)
    image = load(write_exr(tmp_path / "image.exr", {"Y": values, "Z": values}))
    np.testing.assert_array_equal(image.pixels, np.stack([values] * 3))
    assert image.notes[-1] == "The image is grey (channel Y): R = G = B."


def test_layers(tmp_path: Path) -> None:
    values = planes(6)
    names = [f"{layer}.{name}" for layer in ("view.combined", "view.direct") for name in "RGB"]
    path = write_exr(tmp_path / "image.exr", dict(zip(names, values, strict=True)))
    image = load(path)
    np.testing.assert_array_equal(image.pixels, values[:3])
    assert "view.combined.R, view.combined.G, view.combined.B" in image.notes[0]
    assert "view.direct.R" in image.notes[1]
    np.testing.assert_array_equal(read_image(path, part="view.direct"), values[3:])
    assert "expected a part or a layer named 'view'" in refusal(path, part="view")


def test_parts(tmp_path: Path) -> None:
    values = planes(6)
    path = write_parts(
        tmp_path / "image.exr",
        depth={"Z": values[0]},
        mask={"Y": values[1]},
        left=rgb(values[:3]),
        right=rgb(values[3:]),
    )
    assert "got the layers 'left', 'right'; choose one with --part NAME" in refusal(path)
    image = load(path, part="left")
    np.testing.assert_array_equal(image.pixels, values[:3])
    assert image.notes == ("Of 4 parts, part 2 ('left') is read.",)
    for part in (3, "right"):
        np.testing.assert_array_equal(read_image(path, part=part), values[3:])
    np.testing.assert_array_equal(read_image(path, part="mask")[0], values[1])
    assert refusal(path, part=0).startswith("expected channels R, G, B, or Y, RY, BY, or Y, got Z;")
    assert refusal(path, part=4) == "expected a part from 0 to 3, got 4"
    assert "got parts 'depth', 'mask', 'left', 'right'" in refusal(path, part="centre")


def test_files_without_an_image_are_refused(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "image.exr", {"R": planes(1)[0], "Z": planes(1)[0]})
    assert "got R, Z; export it with colour channels" in refusal(path)
    deep = hand_made_exr(tmp_path / "deep.exr", {n: (planes(1)[0], 1) for n in "RGB"}, flags=0x800)
    assert refusal(deep).startswith("expected one sample a pixel, got a deep image;")


@given(
    data=st.tuples(*[st.integers(-9, 9)] * 2, *[st.integers(1, 9)] * 2),
    display=st.tuples(*[st.integers(-9, 9)] * 2, *[st.integers(1, 9)] * 2),
)
def test_windows(
    data: tuple[int, int, int, int],
    display: tuple[int, int, int, int],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    x, y, width, height = data
    values = planes(3, height, width)
    path = write_exr(
        tmp_path_factory.getbasetemp() / "windows.exr",
        rgb(values),
        dataWindow=box(*data),
        displayWindow=box(*display),
    )
    image = load(path)
    canvas = np.zeros((3, 40, 40), np.float32)  # pixel space from (-10, -10)
    canvas[:, y + 10 : y + 10 + height, x + 10 : x + 10 + width] = values
    left, top = display[0] + 10, display[1] + 10
    expected = canvas[:, top : top + display[3], left : left + display[2]]
    np.testing.assert_array_equal(image.pixels, expected)
    assert len(image.notes) == int(data != display)


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("chromaticities", [BT709, ACES])
def test_luminance_and_chroma(tmp_path: Path, step: int, chromaticities: tuple[float, ...]) -> None:
    # Hues that vary slowly, under a luminance with noise: what chroma at half resolution keeps.
    y, x = np.mgrid[:48, :64]
    hue = np.stack([1 + 0.5 * np.sin(x / 16 + i) * np.cos(y / 16) for i in range(3)])
    wanted = hue * np.random.default_rng(1).uniform(0.1, 2, (48, 64))
    aces = (0.3439664498, 0.7281660966, -0.0721325464)  # S-2008-001, annex B: the row of Y
    weights = np.array((0.2126, 0.7152, 0.0722) if chromaticities is BT709 else aces)
    luminance = np.tensordot(weights, wanted, 1)
    chroma = (wanted[[0, 2]] / luminance - 1)[:, ::step, ::step].astype(np.float32)
    path = hand_made_exr(
        tmp_path / "image.exr",
        {"Y": (luminance.astype(np.float32), 1), "RY": (chroma[0], step), "BY": (chroma[1], step)},
        origin=(-6, 4),
        attributes={
            "chromaticities": ("chromaticities", struct.pack("<8f", *chromaticities)),
        },
    )
    image = load(path, negative="keep")
    if chromaticities is ACES:
        wanted = np.tensordot(ACES_TO_BT709, wanted, 1)
    # The edge has no neighbours for the filter to use.
    inside = (slice(None), slice(14, -14), slice(14, -14)) if step == 2 else (slice(None),)
    np.testing.assert_allclose(image.pixels[inside], wanted[inside], rtol=2e-3, atol=2e-4)
    assert image.notes[0].startswith("R, G, B are reconstructed from luminance and chroma")


def test_chroma_adds_no_saturation_that_its_neighbours_lack(tmp_path: Path) -> None:
    luminance = np.full((32, 32), 0.5, np.float32)
    luminance[12:20, 12:20] = 10
    red = np.zeros((16, 16), np.float32)
    red[6:10, 6:10] = 3.5  # so strong that the filter's overshoot makes green negative
    blue = (-red / 9).astype(np.float32)
    path = hand_made_exr(
        tmp_path / "image.exr", {"Y": (luminance, 1), "RY": (red, 2), "BY": (blue, 2)}
    )
    image = load(path)  # negative="raise": there are none
    weights = torch.tensor([0.2126, 0.7152, 0.0722])
    actual = torch.tensordot(weights, image.pixels, 1)
    np.testing.assert_allclose(actual, luminance, rtol=1e-3)


@pytest.mark.parametrize(
    ("chromaticities", "matrix", "white"),
    [(XYZ, XYZ_TO_BT709, (0.9505, 1, 1.089)), (ACES, ACES_TO_BT709, (1, 1, 1))],
)
def test_other_primaries_are_converted(
    tmp_path: Path, chromaticities: tuple[float, ...], matrix: Any, white: tuple[float, ...]
) -> None:
    values = planes()
    values[:, 0, 0] = white
    path = write_exr(tmp_path / "image.exr", rgb(values), chromaticities=chromaticities)
    image = load(path, negative="keep")
    np.testing.assert_allclose(image.pixels, np.tensordot(matrix, values, 1), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(image.pixels[:, 0, 0], 1, rtol=1e-3)
    assert "to BT.709, white from" in image.notes[0]


def test_channels_xyz_are_cie(tmp_path: Path) -> None:
    values = planes()
    path = write_exr(tmp_path / "image.exr", dict(zip("XYZ", values, strict=True)))
    expected = np.tensordot(XYZ_TO_BT709, values, 1)
    np.testing.assert_allclose(read_image(path), expected, rtol=1e-3, atol=1e-3)


def test_adopted_neutral_looks_white(tmp_path: Path) -> None:
    x, y = 0.4476, 0.4074  # illuminant A
    white = np.array([x / y, 1, (1 - x - y) / y], np.float32)
    path = write_exr(
        tmp_path / "image.exr",
        rgb(np.broadcast_to(white[:, None, None], (3, 4, 4))),
        chromaticities=XYZ,
        adoptedNeutral=np.array([x, y], np.float32),
    )
    np.testing.assert_allclose(read_image(path), 1, rtol=1e-4)


def test_bt709_on_another_white_is_left_alone(tmp_path: Path) -> None:
    # The primaries of sRGB as ICC profiles state them, adapted to D50: the same colours.
    adapted = (0.64845, 0.33088, 0.32119, 0.59789, 0.15590, 0.06606, 0.34571, 0.35854)
    path = write_exr(tmp_path / "image.exr", rgb(planes()), chromaticities=adapted)
    np.testing.assert_array_equal(read_image(path), planes())


@pytest.mark.parametrize("chromaticities", [(0.0,) * 8, (0.3, 0.3) * 4, (np.nan,) * 8])
def test_impossible_chromaticities_are_refused(
    tmp_path: Path, chromaticities: tuple[float, ...]
) -> None:
    path = write_exr(tmp_path / "image.exr", rgb(planes()), chromaticities=chromaticities)
    assert "are no colour space" in refusal(path)


def test_what_a_file_states_and_pixels_do_not_carry_is_noted(tmp_path: Path) -> None:
    path = hand_made_exr(
        tmp_path / "image.exr",
        {name: (planes(1)[0], 1) for name in "RGB"},
        attributes={
            "whiteLuminance": ("float", struct.pack("<f", 203)),
            "pixelAspectRatio": ("float", struct.pack("<f", 2)),
            "somethingNew": ("typeNobodyKnows", b"1234"),
        },
    )
    assert load(path).notes == (
        "The file states that 1.0 is 203 cd/m2; pass it with --white.",
        "Pixels are taken as square; the file states a ratio of 2.",
    )


# --- Values ---------------------------------------------------------------------------------------


def test_nonfinite_values(tmp_path: Path) -> None:
    values = planes()
    values[1, 20, 30] = np.nan
    values[2, 20, 30] = np.inf
    values[0, 20, 31] = -np.inf
    path = write_exr(tmp_path / "image.exr", rgb(values), displayWindow=box(10, 5, 50, 40))
    message = refusal(path)
    assert "got 3 NaN or infinite values (the first at x=20, y=15);" in message
    assert "--nonfinite zero" in message
    with pytest.raises(ImageError, match="3 NaN or infinite values"):
        read_image(path)
    image = load(path, nonfinite="zero")
    expected = np.nan_to_num(values, nan=0, posinf=0, neginf=0)[:, 5:, 10:60]
    np.testing.assert_array_equal(image.pixels[:, :40], expected)
    assert (
        "0 was put in the place of 3 NaN or infinite values (the first at x=20, y=15)."
        in image.notes
    )


def clamped(values: NDArray[Any], largest: float) -> NDArray[np.float32]:
    """Return a plane with infinity held and NaN filled, one value after another."""
    out = values.astype(np.float32)
    for y, x in np.ndindex(values.shape):
        if np.isnan(values[y, x]):
            near = values[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].astype(np.float64)
            near = near[np.isfinite(near)]
            out[y, x] = near.mean() if near.size else 0
        elif np.isinf(values[y, x]):
            out[y, x] = np.sign(values[y, x]) * largest
    return out


@given(
    half=st.booleans(),
    bad=st.lists(
        st.tuples(
            st.integers(0, 2),
            st.integers(0, 4),
            st.integers(0, 5),
            st.sampled_from([np.nan, np.inf, -np.inf]),
        ),
        min_size=1,
        max_size=60,
    ),
)
def test_infinity_is_held_and_nan_filled(
    half: bool,
    bad: list[tuple[int, int, int, float]],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    values = planes(3, 5, 6).astype(np.float16 if half else np.float32)
    for channel, y, x, value in bad:
        values[channel, y, x] = value
    path = write_exr(tmp_path_factory.getbasetemp() / "clamp.exr", rgb(values))
    image = load(path, nonfinite="clamp", negative="keep")
    largest = 65504 if half else float(np.finfo(np.float32).max)
    expected = [clamped(plane, largest) for plane in values]
    np.testing.assert_allclose(image.pixels, expected, rtol=1e-6)
    assert image.notes[0].startswith(f"Infinity was held to {largest:g} and NaN to its neighbours'")


def test_an_overflow_of_conversion_is_held_too(tmp_path: Path) -> None:
    values = np.full((3, 4, 4), np.inf, np.float32)
    path = write_exr(tmp_path / "image.exr", rgb(values), chromaticities=XYZ)
    assert load(path, nonfinite="clamp").pixels.isfinite().all()


def test_nonfinite_values_that_are_not_shown_do_not_matter(tmp_path: Path) -> None:
    values = planes()
    values[:, 0, 0] = np.nan
    path = write_exr(tmp_path / "image.exr", rgb(values), displayWindow=box(1, 1, 9, 9))
    np.testing.assert_array_equal(load(path).pixels, values[:, 1:10, 1:10])


def test_nonfinite_chroma_does_not_spread(tmp_path: Path) -> None:
    chroma = np.zeros((8, 8), np.float32)
    chroma[3, 2] = np.nan
    path = hand_made_exr(
        tmp_path / "image.exr",
        {"Y": (np.ones((16, 16), np.float32), 1), "RY": (chroma, 2), "BY": (chroma, 2)},
    )
    assert "got 2 NaN or infinite values (the first at x=4, y=6)" in refusal(path)
    assert torch.equal(load(path, nonfinite="zero").pixels, torch.ones(3, 16, 16))


def test_overflow_is_not_finite_either(tmp_path: Path) -> None:
    values = np.full((3, 4, 4), 3e38, np.float32)
    path = write_exr(tmp_path / "image.exr", rgb(values), chromaticities=XYZ)
    assert "NaN or infinite values" in refusal(path)
    assert read_image(path, nonfinite="zero").isfinite().all()


def test_negative_values(tmp_path: Path) -> None:
    values = planes()
    values[2, 7, 3] = -0.25
    values[0, 7, 4] = -1e-6
    path = write_exr(tmp_path / "image.exr", rgb(values))
    message = refusal(path)
    assert "got 2 negative values (the first at x=3, y=7; the lowest is -0.25);" in message
    assert "--negative clip" in message
    np.testing.assert_array_equal(read_image(path), values)
    image = load(path, negative="keep")
    np.testing.assert_array_equal(image.pixels, values)
    assert image.notes == ()
    image = load(path, negative="clip")
    np.testing.assert_array_equal(image.pixels, values.clip(0))
    assert "2 negative values" in image.notes[0]


def test_negatives_that_conversion_makes_are_colours(tmp_path: Path) -> None:
    values = planes()
    values[:, 3, 4] = 0, 1, 0  # green of ACES, which BT.709 lacks
    path = write_exr(tmp_path / "image.exr", rgb(values), chromaticities=ACES)
    for negative in ("raise", "clip", "keep"):
        image = load(path, negative=negative)
        np.testing.assert_allclose(image.pixels[:, 3, 4], ACES_TO_BT709[:, 1], atol=1e-3)
    values[0, 7, 3] = -0.25  # the file's own is refused, before it is converted
    path = write_exr(tmp_path / "image.exr", rgb(values), chromaticities=ACES)
    assert "got 1 negative value (the first at x=3, y=7; the lowest is -0.25)" in refusal(path)


@pytest.mark.parametrize("options", [{"nonfinite": "mask"}, {"negative": "zero"}])
def test_unknown_policies_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="to be one of"):
        load(tmp_path / "image.exr", **options)


def test_an_image_does_not_change(tmp_path: Path) -> None:
    image = load(write_exr(tmp_path / "image.exr", rgb(planes())))
    with pytest.raises(FrozenInstanceError):
        image.linear = False  # type: ignore[misc]  # wrong on purpose


# --- PNG and JPEG ---------------------------------------------------------------------------------


def png16(values: NDArray[np.uint16], kind: int, *, interlaced: bool) -> bytes:
    """Return a 16-bit PNG of colour type `kind`; Pillow writes none but grey ones."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    height, width = values.shape[:2]
    # PNG, third edition, 8.1: the seven passes, each a grid of x, y, step in x, step in y.
    adam7 = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2)]
    passes = [*adam7, (0, 1, 1, 2)] if interlaced else [(0, 0, 1, 1)]
    rows = [row for x, y, dx, dy in passes for row in values[y::dy, x::dx]]
    data = b"".join(b"\0" + row.astype(">u2").tobytes() for row in rows if row.size)
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, int(interlaced))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        chunk(*each) for each in ((b"IHDR", header), (b"IDAT", zlib.compress(data)), (b"IEND", b""))
    )


@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize(("kind", "count"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_png_of_16_bits_keeps_them(tmp_path: Path, kind: int, count: int, interlaced: bool) -> None:
    values = np.random.default_rng(1).integers(0, 2**16, (9, 13, count), np.uint16)
    path = tmp_path / "image.png"
    path.write_bytes(png16(values, kind, interlaced=interlaced))
    image = load(path)
    expected = np.moveaxis(values, -1, 0).astype(np.float32) / np.float32(65535)
    if kind in (4, 6):  # over black
        np.testing.assert_array_equal(image.alpha, expected[-1])
        expected = expected[:-1] * expected[-1]
    np.testing.assert_array_equal(image.pixels, np.broadcast_to(expected, (3, 9, 13)))
    assert not image.linear
    assert "The channels have 16 bits." in image.notes


@pytest.mark.parametrize(
    ("mode", "options", "note"),
    [
        ("RGB", {}, None),
        ("RGBA", {}, None),
        ("L", {}, "The image is grey: R = G = B."),
        ("LA", {}, "The image is grey: R = G = B."),
        ("1", {}, "The image is grey: R = G = B."),
        ("P", {}, None),
    ],
)
def test_png_is_read_as_pillow_reads_it(
    tmp_path: Path, mode: str, options: dict[str, Any], note: str | None
) -> None:
    values = (255 * planes().clip(0, 1)).astype(np.uint8)
    picture = PIL.Image.fromarray(np.moveaxis(values, 0, -1)).convert(mode)
    path = tmp_path / "image.png"
    picture.save(path, **options)
    image = load(path)
    expected = np.moveaxis(np.asarray(picture.convert("RGB")), -1, 0) / np.float32(255)
    np.testing.assert_array_equal(image.pixels, expected)
    if note is None:
        assert image.notes == ()
    else:
        assert any(each.startswith(note) for each in image.notes)


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_jpeg_is_read_as_pillow_reads_it(tmp_path: Path, mode: str) -> None:
    values = (255 * planes().clip(0, 1)).astype(np.uint8)
    path = tmp_path / "image.jpg"
    PIL.Image.fromarray(np.moveaxis(values, 0, -1)).convert(mode).save(path)
    with PIL.Image.open(path) as picture:
        expected = np.moveaxis(np.asarray(picture.convert("RGB")), -1, 0) / np.float32(255)
    image = load(path)
    np.testing.assert_array_equal(image.pixels, expected)
    assert not image.linear
    assert image.notes == (("The image is grey: R = G = B.",) if mode == "L" else ())


@pytest.mark.parametrize("turn", range(1, 9))
def test_jpeg_is_turned_upright(tmp_path: Path, turn: int) -> None:
    from PIL.ImageOps import exif_transpose

    values = (255 * planes().clip(0, 1)).astype(np.uint8)
    exif = PIL.Image.Exif()
    exif[0x0112] = turn
    path = tmp_path / "image.jpg"
    PIL.Image.fromarray(np.moveaxis(values, 0, -1)).save(path, exif=exif)
    with PIL.Image.open(path) as picture:
        upright = np.asarray(exif_transpose(picture))
    image = load(path)
    np.testing.assert_array_equal(image.pixels, np.moveaxis(upright, -1, 0) / np.float32(255))
    assert len(image.notes) == int(turn > 1)


def test_jpeg_of_four_inks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.jpg"
    PIL.Image.new("CMYK", (8, 8)).save(path)
    assert "got a JPEG with CMYK colours" in refusal(path)


# --- Files that are none --------------------------------------------------------------------------


def test_paths_without_an_image_are_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "missing.exr") == "no such file; check the name"
    assert refusal(tmp_path) == "expected an image file, got a folder"
    os.mkfifo(tmp_path / "pipe.exr")
    assert "got a device or a pipe" in refusal(tmp_path / "pipe.exr")
    (tmp_path / "empty.png").touch()
    assert refusal(tmp_path / "empty.png") == "expected an image, got an empty file; write it again"
    (tmp_path / "text.exr").write_text("not an image")
    assert refusal(tmp_path / "text.exr").endswith(
        "(it begins with bytes 6e 6f 74 20); export it again"
    )
    (tmp_path / "image.psd").write_text("8BPS")
    assert refusal(tmp_path / "image.psd").endswith("convert it to one of them")
    with pytest.raises(ImageError, match="null byte"):
        load("a\0b.exr")


def test_messages_are_one_line_whatever_the_name(tmp_path: Path) -> None:
    with pytest.raises(ImageError) as caught:
        load(tmp_path / "a\nb\x1b[31m\udcff.exr")
    assert (
        str(caught.value) == f"{tmp_path}/a\\nb\\x1b[31m\\udcff.exr: no such file; check the name"
    )


def test_the_content_decides_the_format(tmp_path: Path) -> None:
    path = tmp_path / "image.exr"
    PIL.Image.new("RGB", (4, 3), (255, 0, 51)).save(path, "PNG")
    image = load(path)
    assert image.notes == ("The name says OpenEXR, but the content is PNG and is read so.",)
    assert image.pixels[:, 0, 0].tolist() == pytest.approx([1, 0, 0.2])
    assert "expected an OpenEXR file for part 1, got PNG" in refusal(path, part=1)


@pytest.mark.parametrize(
    ("x1", "y1"), [(2**31 - 1, 15), (15, 2**31 - 1), (60000, 60000), (8000, 8000), (-5, 15)]
)
@pytest.mark.parametrize("window", ["dataWindow", "displayWindow"])
def test_absurd_sizes_are_refused_before_memory_is_set_aside(
    tmp_path: Path, window: str, x1: int, y1: int
) -> None:
    path = hand_made_exr(
        tmp_path / "image.exr",
        {name: (np.ones((16, 16), np.float32), 1) for name in "RGB"},
        attributes={window: ("box2i", struct.pack("<iiii", 0, 0, x1, y1))},
    )
    message = refusal(path)
    assert "expected at most" in message or message.startswith("damaged")


def test_absurd_png_and_jpeg_are_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    PIL.Image.new("RGB", (16, 16)).save(stream, "PNG")
    data = bytearray(stream.getvalue())
    data[16:24] = struct.pack(">II", 30000, 30000)
    (tmp_path / "image.png").write_bytes(data)
    assert "expected at most 89478485 pixels" in refusal(tmp_path / "image.png")
    PIL.Image.new("RGB", (16, 16)).save(tmp_path / "image.jpg")
    data = bytearray((tmp_path / "image.jpg").read_bytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", 60000, 60000)
    (tmp_path / "image.jpg").write_bytes(data)
    assert "expected at most 89478485 pixels" in refusal(tmp_path / "image.jpg")


def test_incomplete_openexr_is_refused_with_the_count(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "image.exr", rgb(planes()), compression=OpenEXR.ZIP_COMPRESSION)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert refusal(path).startswith("incomplete: 2 of 3 blocks of pixels are missing or cut off;")


def damaged_block(path: Path) -> Path:
    """Write a file of which only the inside of a compressed block is damaged."""
    write_exr(path, rgb(planes()), compression=OpenEXR.ZIP_COMPRESSION)
    data = bytearray(path.read_bytes())
    data[-400:-300] = bytes(100)
    path.write_bytes(data)
    return path


def test_quiet_keeps_the_library_from_printing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = damaged_block(tmp_path / "image.exr")
    assert "its blocks of pixels cannot be decompressed" in refusal(path)
    assert any(capfd.readouterr())  # else the option is no longer needed
    refusal(path, quiet=True)
    print("out")
    print("err", file=sys.stderr)
    assert capfd.readouterr() == ("out\n", "err\n")


# Run in a process of its own, which a fault in a decoder would end. Damages good files in all the
# ways that disks, networks and attackers know, reads each, and prints the outcomes as JSON.
FUZZ = """
    import json, random, resource, sys, time
    from pathlib import Path
    import torch_vdm.io as images

    imported = [name for name in ("OpenEXR", "PIL", "kornia_rs", "tifffile") if name in sys.modules]
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rng = random.Random(1)
    scratch, cases, *files = sys.argv[1:]

    def damaged(data):
        data = bytearray(data)
        kind = rng.choice(("cut", "flip", "header", "ones", "copy"))
        if kind == "cut":
            return data[: rng.randrange(1, len(data))]
        for _ in range(rng.choice((1, 1, 2, 8))):
            at = rng.randrange(min(len(data), 400) if kind == "header" else len(data))
            if kind == "copy":
                there = rng.randrange(len(data))
                piece = data[at : at + rng.randrange(1, 64)]
                data[there : there + len(piece)] = piece
            else:
                data[at] = 255 if kind == "ones" else rng.randrange(256)
        return data

    def outcome(path):
        begin = time.perf_counter()
        try:
            pixels = images.load(path, nonfinite="zero", negative="clip", quiet=True).pixels
            assert pixels.ndim == 3 and pixels.isfinite().all()
            message = ""
        except images.ImageError as error:
            message = str(error)
        return message, time.perf_counter() - begin

    results = {name: outcome(name) for name in files}
    for i in range(int(cases)):
        name = files[i % len(files)]
        Path(scratch).write_bytes(damaged(Path(name).read_bytes()))
        results[f"{i} {name}"] = outcome(scratch)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base
    print(json.dumps({"results": results, "grown": grown, "imported": imported}))
"""


def fuzz(scratch: Path, files: list[Path], cases: int) -> dict[str, str]:
    """Read `files`, then damaged copies of them; return the message for each, "" where read."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(FUZZ), scratch, str(cases), *files],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    answer = json.loads(done.stdout)  # and nothing else was printed
    assert answer["imported"] == []
    assert answer["grown"] < 500_000  # kilobytes; on macOS bytes, where this says little
    messages = {}
    for name, (message, seconds) in answer["results"].items():
        assert seconds < 5, name
        assert message.isprintable(), name
        assert len(message) < 1000, name
        messages[name] = message
    return messages


def test_damaged_files_do_no_harm(tmp_path: Path) -> None:
    files = []
    for compression in COMPRESSIONS:
        for dtype in (np.float16, np.float32):
            path = tmp_path / f"{compression}-{dtype.__name__}.exr"
            header: dict[str, Any] = {"compression": getattr(OpenEXR, compression)}
            if dtype is np.float32:
                header |= {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
                header["tiles"].xSize = header["tiles"].ySize = 32
            files.append(write_exr(path, rgb(planes().astype(dtype)), **header))
    half = np.ones((8, 8), np.float32)
    files.append(
        hand_made_exr(
            tmp_path / "chroma.exr",
            {"Y": (np.ones((16, 16), np.float32), 1), "RY": (half, 2), "BY": (half, 2)},
        )
    )
    depth = {"Z": planes(1)[0]}
    files.append(write_parts(tmp_path / "parts.exr", depth=depth, beauty=rgb(planes())))
    values = np.random.default_rng(1).integers(0, 2**16, (16, 16, 3), np.uint16)
    files.append(tmp_path / "16.png")
    files[-1].write_bytes(png16(values, 2, interlaced=True))
    for name in ("image.png", "image.jpg"):
        files.append(tmp_path / name)
        PIL.Image.fromarray((values >> 8).astype(np.uint8)).save(files[-1])
    messages = fuzz(tmp_path / "scratch", files, cases=900)
    assert not any(messages[str(path)] for path in files)
    refused = sum(bool(message) for message in messages.values())
    assert refused > 300


# --- Writing --------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("shape", [(3, 5, 7), (1, 5, 7), (5, 7)])
def test_openexr_round_trip(tmp_path: Path, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    image = torch.linspace(-3, 900, 105)[: int(np.prod(shape))].reshape(shape).to(dtype)
    path = tmp_path / "image.EXR"
    write_image(path, image.requires_grad_())
    expected = image.detach().float().reshape(-1, 5, 7).expand(3, 5, 7)
    assert torch.equal(read_image(path), expected)
    stored = OpenEXR.File(str(path), separate_channels=True)
    assert sorted(stored.channels()) == (["B", "G", "R"] if shape[0] == 3 else ["Y"])
    np.testing.assert_allclose(stored.header()["chromaticities"], BT709, rtol=1e-6)


def test_openexr_keeps_what_is_not_finite(tmp_path: Path) -> None:
    image = torch.tensor([[float("nan"), float("inf")], [0, 1]])
    write_image(tmp_path / "image.exr", image)
    stored = (
        OpenEXR.File(str(tmp_path / "image.exr"), separate_channels=True).channels()["Y"].pixels
    )
    np.testing.assert_array_equal(stored, image)


@pytest.mark.parametrize("shape", [(3, 5, 7), (1, 5, 7), (5, 7)])
def test_png_round_trip(tmp_path: Path, shape: tuple[int, ...]) -> None:
    image = torch.linspace(-0.5, 1.5, 105)[: int(np.prod(shape))].reshape(shape)
    path = tmp_path / "image.png"
    write_image(path, image)
    expected = image.clamp(0, 1).reshape(-1, 5, 7).expand(3, 5, 7)
    torch.testing.assert_close(read_image(path), expected, rtol=0, atol=0.5001 / 255)
    with PIL.Image.open(path) as picture:
        assert picture.mode == ("RGB" if shape[0] == 3 else "L")


@pytest.mark.parametrize("suffix", ["jpg", "jpeg", "JPG"])
def test_jpeg_round_trip(tmp_path: Path, suffix: str) -> None:
    image = torch.from_numpy(planes(3, 40, 40) / 1.1)
    write_image(tmp_path / f"image.{suffix}", image)
    actual = read_image(tmp_path / f"image.{suffix}")
    torch.testing.assert_close(actual, image.clamp(0, 1), rtol=0, atol=0.05)


@pytest.mark.parametrize(
    ("name", "image", "message"),
    [
        ("image.tiff", torch.ones(3, 2, 2), "ends in .exr, .png, .jpg, .jpeg, got '.tiff'"),
        ("image", torch.ones(3, 2, 2), "got ''"),
        ("image.png", torch.ones(2, 2, 2), r"shape \(3, H, W\), .*, got \(2, 2, 2\)"),
        ("image.png", torch.ones(1, 3, 2, 2), r"got \(1, 3, 2, 2\)"),
        ("image.exr", torch.ones(3, 0, 2), r"at least one pixel, got \(3, 0, 2\)"),
        ("image.exr", torch.ones(3, 2, 2, dtype=torch.uint8), "float type, got torch.uint8"),
        ("image.png", torch.tensor([[0.0, float("nan")]]), r"the first at x=1, y=0"),
        ("image.jpg", torch.zeros(1, 65501), "at most 65500 pixels a side"),
        ("folder/image.png", torch.ones(2, 2), "expected the folder to exist"),
    ],
)
def test_what_cannot_be_written_is_refused(
    tmp_path: Path, name: str, image: torch.Tensor, message: str
) -> None:
    with pytest.raises(ImageError, match=message) as caught:
        write_image(tmp_path / name, image)
    assert str(caught.value).isprintable()
    assert str(caught.value).startswith(str(tmp_path / name))
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    with atomic_path(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == path.suffix
        temporary.write_text("old")
        assert not path.exists()
    with atomic_path(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "out.json"
    path.write_text("old")

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_an_image_error_and_other_failures_are_not(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    with (
        pytest.raises(ImageError, match=r"out\.json: cannot be written: No space left on device"),
        atomic_path(path),
    ):
        raise OSError(28, "No space left on device")
    with pytest.raises(ImageError, match=r"out\.json: cannot be written"), atomic_path(path):
        pass  # nothing was written
    with pytest.raises(FileNotFoundError), atomic_path(path):
        (tmp_path / "other").read_text()
    assert list(tmp_path.iterdir()) == []


def test_links_are_followed_and_devices_spared(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    link = tmp_path / "link.png"
    link.symlink_to(tmp_path / "folder" / "image.png")
    write_image(link, torch.ones(2, 2))
    assert link.is_symlink()
    assert read_image(link).shape == (3, 2, 2)
    with pytest.raises(ImageError, match="got a folder or a device"), atomic_path(tmp_path):
        pass
    with pytest.raises(ImageError, match="got a folder or a device"), atomic_path("/dev/null"):
        pass
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_permissions_are_those_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "any").touch()
    write_image(tmp_path / "image.png", torch.ones(2, 2))
    assert (tmp_path / "image.png").stat().st_mode == (tmp_path / "any").stat().st_mode


# --- The files of the OpenEXR project -------------------------------------------------------------

# What each file gives: the size, or a piece of the refusal.
SHARED: dict[str, tuple[int, int] | str] = {
    "channels/AllHalfValues.exr": "6144 NaN or infinite values (the first at x=0, y=124)",
    "channels/BrightRings.exr": (800, 800),
    "channels/BrightRingsNanInf.exr": "18 NaN or infinite values (the first at x=320, y=320)",
    "channels/Garden.exr": (874, 493),
    "channels/GrayRampsHorizontal.exr": (800, 800),
    "channels/Rec709.exr": (610, 406),
    "channels/Rec709_YC.exr": (610, 406),
    "channels/WideColorGamut.exr": (800, 800),
    "channels/WideFloatRange.exr": "got G;",
    "channels/XYZ_YC.exr": (610, 406),
    "channels/manifest_id.exr": (100, 100),
    "channels/sample.exr": "got G, Z;",
    "channels/stripes.exr": (100, 50),
    "channels/test.exr": (10, 20),
    "channels/unfinished_multipart.exr": "got Z;",
    "compression/comp_b44.exr": (586, 674),
    "compression/comp_dwaa_v2.exr": (587, 675),
    "compression/comp_dwab_v1.exr": (587, 675),
    "compression/lineOrder_decreasing.exr": (237, 119),
    "compression/lineOrder_increasing.exr": (237, 119),
    "deep/11.deep.exr": "got a deep image",
    "deep/Trunks.exr": "got a deep image",
    "hdr/Cannon.exr": (780, 566),
    "hdr/Carrots.exr": (600, 400),
    "hdr/city.exr": (1024, 512),
    "hdr/studio.exr": (1024, 512),
    "hdr/sunset.exr": (1024, 512),
    "tiled/ColorCodedLevels.exr": (512, 512),
    "tiled/WavyLinesLatLong.exr": (1024, 512),
    "tiled/scanline_with_deepscanline_type.exr": (40, 40),
    "tiled/scanline_with_tiledimage_type.exr": (40, 40),
    "tiled/tiled_with_deeptile_type.exr": (40, 40),
    "tiled/tiled_with_scanlineimage_type.exr": (40, 40),
}

# Their display windows, as the project's page "Display Window" states them.
WINDOWS = {
    "t01": (0, 0, 399, 299),
    "t02": (1, 1, 400, 300),
    "t05": (30, 20, 369, 279),
    "t06": (-1, -1, 400, 300),
    "t07": (-40, -40, 440, 330),
    "t08": (0, 0, 500, 400),
    "t09": (400, 0, 599, 299),
    "t10": (-100, 0, -1, 299),
    "t12": (0, -100, 399, -1),
    "t14": (-100, -100, 0, 0),
    "t15": (-40, -40, 440, 330),
}


@pytest.mark.parametrize("name", SHARED)
def test_openexr_project_files(shared_data: Path, name: str) -> None:
    path = shared_data / "exr" / name
    expected = SHARED[name]
    if isinstance(expected, str):
        assert expected in refusal(path, negative="keep")
        return
    image = load(path, negative="keep")
    assert image.pixels.shape == (3, *expected[::-1])
    stored = OpenEXR.File(str(path), separate_channels=True)
    chromaticities = stored.header().get("chromaticities", BT709)
    if {"R", "G", "B"} <= set(stored.channels()) and chromaticities[6] == pytest.approx(0.3127):
        channels = [stored.channels()[name].pixels.astype(np.float32) for name in "RGB"]
        np.testing.assert_array_equal(image.pixels, np.stack(channels))


@pytest.mark.parametrize("name", WINDOWS)
def test_openexr_project_windows(shared_data: Path, name: str) -> None:
    path = shared_data / "exr" / "windows" / f"{name}.exr"
    x0, y0, x1, y1 = WINDOWS[name]
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    data_x, data_y = (30, 40) if name == "t08" else (0, 0)
    canvas = np.zeros((3, 900, 1200), np.float32)  # pixel space from (-400, -400)
    canvas[:, 400 + data_y : 700 + data_y, 400 + data_x : 800 + data_x] = [
        channels[each].pixels for each in "RGB"
    ]
    expected = canvas[:, y0 + 400 : y1 + 401, x0 + 400 : x1 + 401]
    np.testing.assert_array_equal(read_image(path), expected)


@pytest.mark.parametrize("name", ["Rec709_YC", "XYZ_YC"])
def test_one_picture_in_three_encodings(shared_data: Path, name: str) -> None:
    folder = shared_data / "exr" / "channels"
    wanted = read_image(folder / "Rec709.exr")
    actual = read_image(folder / f"{name}.exr")
    weights = torch.tensor([0.2126, 0.7152, 0.0722])
    luminance = torch.tensordot(weights, wanted, 1)
    # Luminance is whole, but for halves; chroma has a quarter of the samples.
    torch.testing.assert_close(torch.tensordot(weights, actual, 1), luminance, rtol=0.01, atol=0.01)
    error = (actual - wanted).abs() / (luminance + 0.01)
    assert error.mean() < 0.02
    smooth = torch.nn.functional.avg_pool2d
    torch.testing.assert_close(
        smooth(actual[None], 32), smooth(wanted[None], 32), rtol=0.02, atol=0.02
    )


def test_named_channels_are_kept_and_the_picture_is_read_from_them(tmp_path: Path) -> None:
    path = tmp_path / "render.exr"
    names = "R", "G", "B", "samples", "variance.R", "normal.X"
    wanted = dict(zip(names, planes(len(names)), strict=True))
    write_channels(path, {name: torch.from_numpy(plane) for name, plane in wanted.items()})
    written = OpenEXR.File(str(path), separate_channels=True).channels()
    assert set(written) == set(names)
    for name, plane in wanted.items():
        np.testing.assert_array_equal(written[name].pixels, plane)
    picture = load(path)
    np.testing.assert_array_equal(picture.pixels, np.stack([wanted[name] for name in "RGB"]))
    assert picture.notes == ("Channels that are not used: normal.X, samples, variance.R.",)


@pytest.mark.parametrize(
    ("name", "shapes", "words"),
    [
        ("render.png", [(2, 3)], "ends in .exr"),
        ("render.exr", [(2, 3), (3, 2)], "one shape"),
        ("render.exr", [(0, 3)], "at least one pixel"),
        ("render.exr", [], "one shape"),
        ("nowhere/render.exr", [(2, 3)], "expected the folder to exist"),
    ],
)
def test_named_channels_that_are_refused(
    tmp_path: Path, name: str, shapes: list[tuple[int, int]], words: str
) -> None:
    channels = {str(i): torch.zeros(shape) for i, shape in enumerate(shapes)}
    with pytest.raises(ImageError, match=re.escape(words)):
        write_channels(tmp_path / name, channels)
    assert list(tmp_path.iterdir()) == []


def test_openexr_project_damaged_files(shared_data: Path, tmp_path: Path) -> None:
    files = sorted((shared_data / "exr" / "damaged").iterdir())
    files = [path for path in files if path.suffix != ".rst"]
    assert len(files) == 37
    messages = fuzz(tmp_path / "scratch", files, cases=0)
    # None of them holds a whole image.
    assert all(messages[str(path)].startswith(f"{path}: ") for path in files)
    good = [shared_data / "exr" / name for name in SHARED if not isinstance(SHARED[name], str)]
    good = [path for path in good if path.stat().st_size < 120_000]
    messages = fuzz(tmp_path / "scratch", good, cases=200)
    assert not any(messages[str(path)] for path in good)
