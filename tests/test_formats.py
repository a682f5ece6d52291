"""Formats other than OpenEXR, PNG and JPEG: against writers of their own and other libraries."""

import io
import struct
import sys
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import tifffile
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.test_colour import (
    BY_NAME,
    PRIMARIES,
    STRAIGHT,
    TO_BT709,
    chunk,
    profile,
    srgb_code,
    srgb_light,
    with_chunks,
)
from tests.test_io import XYZ_TO_BT709, fuzz, hand_made_exr, png16, refusal, rgb, write_exr
from torch_vdm.io import ImageError, load, read_image

Bytes = NDArray[np.uint8]

LETTER = np.zeros((7, 5, 3), np.uint8)  # an F: no two of its eight positions are alike
LETTER[1:6, 1] = LETTER[1, 1:4] = LETTER[3, 1:3] = (255, 128, 64)


def unit(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return whole numbers (H, W, C) as (C, H, W) from 0 to 1."""
    return np.moveaxis(values, -1, 0).astype(np.float32) / np.float32(np.iinfo(values.dtype).max)


# --- Radiance -------------------------------------------------------------------------------------


def rgbe(image: NDArray[np.float32]) -> Bytes:
    """Return (3, H, W) as red, green, blue and exponent, (H, W, 4): Ward's setcolr()."""
    high = image.max(0)
    _, exponent = np.frexp(high)
    scale = np.where(high > 1e-32, np.ldexp(256.0, -exponent), 0)
    colours = np.moveaxis(image * scale, 0, -1)
    return np.concatenate(
        (colours, np.where(high > 1e-32, exponent + 128, 0)[..., None]), -1
    ).astype(np.uint8)


def new_runs(pixels: Bytes, rng: np.random.Generator) -> bytes:
    """Return lines whose four planes are coded by runs; where a run is possible chance decides."""
    out = bytearray()
    for line in pixels:
        out += bytes((2, 2)) + struct.pack(">H", len(line))
        for plane in line.T:
            at = 0
            while at < len(plane):
                run = 1
                while at + run < len(plane) and run < 127 and plane[at + run] == plane[at]:
                    run += 1
                if run > 1 or rng.integers(2):
                    out += bytes((128 + run, plane[at]))
                else:
                    run = min(int(rng.integers(1, 129)), len(plane) - at)
                    out += bytes((run,)) + plane[at : at + run].tobytes()
                at += run
    return bytes(out)


def old_runs(pixels: Bytes) -> bytes:
    """Return lines in which a pixel that comes again is counted."""
    out = bytearray()
    for line in pixels:
        at = 0
        while at < len(line):
            run = 1
            while at + run < len(line) and (line[at + run] == line[at]).all():
                run += 1
            out += line[at].tobytes()
            count = run - 1
            while count:
                out += bytes((1, 1, 1, count & 255))
                count >>= 8
            at += run
    return bytes(out)


def light(height: int, width: int, seed: int = 1) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    values = np.exp(rng.normal(0, 4, (3, height, width))).astype(np.float32)
    values[:, :, width // 2 :] = values[:, :, -1:]  # something to count
    values[:, 0, 0] = 0
    return values


def write_hdr(
    path: Path, pixels: bytes, size: str, header: str = "FORMAT=32-bit_rle_rgbe\n"
) -> Path:
    path.write_bytes(f"#?RADIANCE\n# made by hand\n{header}\n{size}\n".encode() + pixels)
    return path


def of_rgbe(pixels: Bytes) -> NDArray[np.float64]:
    """Return the light of red, green, blue and exponent, (3, H, W)."""
    factor: NDArray[np.float64] = np.where(
        pixels[..., 3:] > 0, 2.0 ** (pixels[..., 3:].astype(float) - 136), 0
    )
    return np.moveaxis(pixels[..., :3] * factor, -1, 0)


@given(
    width=st.sampled_from([1, 5, 8, 31, 300]),
    coding=st.sampled_from(["flat", "old", "new"]),
    seed=st.integers(0, 9),
)
def test_radiance_of_every_coding(
    width: int, coding: str, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    image = light(6, width, seed)
    pixels = rgbe(image)
    encoded = {
        "flat": pixels.tobytes(),
        "old": old_runs(pixels),
        "new": new_runs(pixels, np.random.default_rng(seed)) if width >= 8 else pixels.tobytes(),
    }
    path = write_hdr(
        tmp_path_factory.getbasetemp() / "image.hdr", encoded[coding], f"-Y 6 +X {width}"
    )
    read = load(path)
    assert read.kind == "scene"
    np.testing.assert_allclose(read.pixels, of_rgbe(pixels), rtol=1e-6)
    # A step is a 256th of the brightest channel, or less; the writer cuts it off.
    assert ((image - read.pixels.numpy()) <= image.max(0) / 127).all()


@pytest.mark.parametrize("axes", [a + b for a in ("-Y", "+Y") for b in ("+X", "-X")] + ["+X-Y"])
def test_radiance_is_turned_upright(tmp_path: Path, axes: str) -> None:
    image = light(4, 3)
    stored = rgbe(image)
    wanted = of_rgbe(stored)
    if axes[1] == "X":
        stored = stored.swapaxes(0, 1)
    if "+Y" in axes:
        stored = stored[::-1]
    if "-X" in axes:
        stored = stored[:, ::-1]
    size = f"{axes[:2]} {stored.shape[0]} {axes[2:]} {stored.shape[1]}"
    path = write_hdr(tmp_path / "image.hdr", stored.tobytes(), size)
    np.testing.assert_allclose(read_image(path), wanted, rtol=1e-6)


def test_radiance_says_its_exposure_and_colours(tmp_path: Path) -> None:
    pixels = rgbe(light(4, 3))
    path = tmp_path / "image.hdr"
    write_hdr(path, pixels.tobytes(), "-Y 4 +X 3", "EXPOSURE=2\nEXPOSURE= 4.0\n")
    image = load(path)
    np.testing.assert_allclose(image.pixels, of_rgbe(pixels) / 8, rtol=1e-6)
    assert image.notes[0] == "Values are divided by the exposure that the file states, 8."
    write_hdr(path, pixels.tobytes(), "-Y 4 +X 3", "COLORCORR=1 2 4\n")
    corrected = of_rgbe(pixels) / np.array([1, 2, 4])[:, None, None]
    np.testing.assert_allclose(load(path).pixels, corrected, rtol=1e-6)
    write_hdr(path, pixels.tobytes(), "-Y 4 +X 3", "FORMAT=32-bit_rle_xyze\n")
    expected = np.tensordot(XYZ_TO_BT709, of_rgbe(pixels), 1)
    np.testing.assert_allclose(load(path).pixels, expected, rtol=1e-3, atol=1e-2)
    numbers = " ".join(str(c) for pair in (*PRIMARIES["P3"], (0.3127, 0.329)) for c in pair)
    write_hdr(path, pixels.tobytes(), "-Y 4 +X 3", f"PRIMARIES={numbers}\n")
    expected = np.tensordot(TO_BT709[12], of_rgbe(pixels), 1)
    np.testing.assert_allclose(load(path).pixels, expected, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("size", "header", "words"),
    [
        ("-Y 4 +Y 3", "", "its size cannot be read"),
        ("-Y 0 +X 3", "", "its size cannot be read"),
        ("-Y 70000 +X 3", "", "expected at most 89478485 pixels"),
        ("-Y 60000 +X 1400", "", "damaged: 1400 x 60000 pixels"),
        ("-Y 5 +X 3", "", "incomplete: the file ends in its pixels"),
        ("-Y 4 +X 3", "FORMAT=other\n", "expected the format 32-bit_rle_rgbe"),
        ("-Y 4 +X 3", "EXPOSURE=0\n", "an exposure of 0"),
        ("-Y 4 +X 3", "PRIMARIES=1 2\n", "expected 8 numbers"),
    ],
)
def test_radiance_that_is_refused(tmp_path: Path, size: str, header: str, words: str) -> None:
    path = write_hdr(tmp_path / "image.hdr", rgbe(light(4, 3)).tobytes(), size, header)
    assert words in refusal(path)


# --- PFM and PNM ----------------------------------------------------------------------------------


@pytest.mark.parametrize("more", [b"\n", b"#?RADIANCE\n"])
def test_radiance_that_goes_on_is_refused(tmp_path: Path, more: bytes) -> None:
    path = tmp_path / "image.hdr"
    write_hdr(path, rgbe(light(2, 9)).tobytes() + more, "-Y 2 +X 9")
    assert f"got {len(more)} bytes more; write each picture" in refusal(path)


@given(
    order=st.sampled_from("<>"),
    grey=st.booleans(),
    scale=st.sampled_from([1.0, 2.5]),
    height=st.integers(1, 5),
)
def test_pfm(
    order: str, grey: bool, scale: float, height: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    values = np.random.default_rng(1).uniform(0, 9, (height, 4, 1 if grey else 3)).astype("f4")
    sign = "-" if order == "<" else ""
    header = f"P{'f' if grey else 'F'}\n4 {height}\n{sign}{scale}\n"
    path = tmp_path_factory.getbasetemp() / "image.pfm"
    path.write_bytes(header.encode() + values[::-1].astype(f"{order}f4").tobytes())
    image = load(path)
    assert image.kind == "scene"
    expected = np.broadcast_to(np.moveaxis(values, -1, 0) * np.float32(scale), (3, height, 4))
    np.testing.assert_array_equal(image.pixels, expected)
    assert load(path, coded=True).kind == "coded"


def test_pfm_values_are_judged(tmp_path: Path) -> None:
    values = np.ones((2, 2, 3), "<f4")
    values[0, 0, 0], values[1, 1, 1] = np.inf, -1
    path = tmp_path / "image.pfm"
    path.write_bytes(b"PF\n2 2\n-1\n" + values.tobytes())
    assert "expected finite values" in refusal(path)
    assert "expected no negative values" in refusal(path, nonfinite="clamp")
    image = load(path, nonfinite="clamp", negative="keep")
    assert image.pixels.max() == np.finfo(np.float32).max


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"PF\n2 2\n0\n" + bytes(48), "its scale is 0"),
        (b"PF\n2 2\n-e\n" + bytes(48), "its scale is -e"),
        (b"PF\n2 x\n1\n" + bytes(48), "its header cannot be read"),
        (b"PF\n2 0\n1\n" + bytes(48), "2 x 0 pixels"),
        (b"PF\n2 2\n1\n" + bytes(47), "incomplete: 47 of 48 bytes"),
        (b"PF\n60000 1000\n1\n" + bytes(48), "damaged: 60000 x 1000 pixels"),
        (b"P6\n2 2\n99999\n" + bytes(48), "its white is 99999"),
        (b"P6\n2 2\n255\n" + bytes(11), "incomplete: 11 of 12 bytes"),
        (b"P6\n2\n", "its header cannot be read"),
        # What goes on after its pixels: more pictures, or a header that was misread.
        (2 * (b"PF\n2 2\n-1\n" + bytes(48)), "expected 48 bytes of pixels, got 106"),
        (b"PF\n2 2\n-1\n" + bytes(49), "expected 48 bytes of pixels, got 49"),
        (2 * (b"P6\n2 2\n255\n" + bytes(12)), "write each picture to a file of its own"),
        (b"P5\n2 2\n255\n" + bytes(5), "expected 4 bytes of pixels, got 5"),
        (b"P4\n9 2\n" + bytes(5), "expected 4 bytes of pixels, got 5"),
        (b"P4\n9 2\n" + bytes(3), "incomplete: 3 of 4 bytes"),
        (b"P1\n2 1\n1 0 1\n", "expected 2 numbers, got 3"),
        (b"P2\n2 1\n255\n1 2 P2", "its pixels are no numbers"),
        (b"P2\n2 1\n255\n1", "incomplete: 1 of 2 numbers"),
        (b"P2\n2 1\n255\n", "incomplete: 0 of 2 numbers"),
        (b"P2\n2 1\n255\n1 256", "expected numbers up to 255, got 256"),
        (b"P2\n2 1\n255\n1 " + 30 * b"9", "expected numbers up to 255, got"),
        (b"P3\n60000 1000\n255\n1", "damaged: 60000 x 1000 pixels"),
    ],
)
def test_netpbm_that_is_refused(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "image.ppm").write_bytes(data)
    assert words in refusal(tmp_path / "image.ppm")


@given(white=st.sampled_from([1, 7, 255, 256, 1023, 65535]), grey=st.booleans())
def test_pnm(white: int, grey: bool, tmp_path_factory: pytest.TempPathFactory) -> None:
    values = np.random.default_rng(1).integers(0, white + 1, (5, 4, 1 if grey else 3))
    stored = values.astype(">u2" if white > 255 else "u1").tobytes()
    path = tmp_path_factory.getbasetemp() / "image.pnm"
    path.write_bytes(
        f"P{5 if grey else 6} # a comment\n4 5\n# one more\n{white}\n".encode() + stored
    )
    image = load(path)
    expected = np.broadcast_to(np.moveaxis(values, -1, 0) / white, (3, 5, 4))
    step = 0.5 / (65535 if white > 255 else 255)
    np.testing.assert_allclose(image.pixels, expected, atol=step + 1e-7)
    assert image.kind == "coded"


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("text", ["P3\n2 1\n255\n255 0 51  0 255 0\n", "P2\n2 1\n255\n255 51"])
def test_pnm_in_letters(tmp_path: Path, text: str, end: str) -> None:
    (tmp_path / "image.ppm").write_bytes(text.replace("\n", end).encode())
    expected = [[[1, 0]], [[0, 1]], [[0.2, 0]]] if "3" in text[:2] else [[[1, 0.2]]] * 3
    torch.testing.assert_close(read_image(tmp_path / "image.ppm"), torch.tensor(expected))


@pytest.mark.parametrize("samples", [1, 3])
def test_pnm_in_letters_keeps_16_bits(tmp_path: Path, samples: int) -> None:
    values = np.random.default_rng(1).integers(0, 65536, (5, 4, samples))
    path = tmp_path / "image.pnm"
    numbers = "\n".join(map(str, values.ravel()))
    path.write_text(f"P{3 if samples == 3 else 2}\n4 5 # width, height\n65535\n{numbers}\n")
    image = load(path)
    expected = np.broadcast_to(np.moveaxis(values, -1, 0) / 65535, (3, 5, 4))
    np.testing.assert_allclose(image.pixels, expected, atol=1e-7)
    assert image.notes[0] == "The channels have 16 bits."


@pytest.mark.parametrize("width", [1, 8, 13])
@pytest.mark.parametrize("spaces", ["", " "])
def test_pbm(tmp_path: Path, width: int, spaces: str) -> None:
    ink = np.random.default_rng(1).integers(0, 2, (5, width))
    packed = np.packbits(ink.astype(np.uint8), axis=1).tobytes()
    (tmp_path / "bits.pbm").write_bytes(b"P4\n%d 5\n" % width + packed)
    digits = "\n".join(spaces.join(map(str, row)) for row in ink)
    (tmp_path / "letters.pbm").write_text(f"P1\n# ink\n{width} 5\n{digits}\n")
    for name in ("bits.pbm", "letters.pbm"):
        expected = np.broadcast_to(1 - ink, (3, 5, width))
        np.testing.assert_array_equal(read_image(tmp_path / name), expected)


@pytest.mark.parametrize(
    ("header", "size"),
    [("PF\n4 5\n-1\n", 240), ("P6\n4 5\n255\n", 60), ("P4\n13 5\n", 10)],
)
def test_netpbm_with_the_lines_of_windows(tmp_path: Path, header: str, size: int) -> None:
    # Bytes of every value, and no NaN among the floats.
    pixels = (np.arange(size) % 100 + 1).astype(np.uint8).tobytes()
    images = []
    for end in ("\n", "\r\n"):
        path = tmp_path / "image.ppm"
        path.write_bytes(header.replace("\n", end).encode() + pixels)
        images.append(read_image(path) if header[:2] != "PF" else load(path).pixels)
    torch.testing.assert_close(*images, rtol=0, atol=0)


# --- TIFF -----------------------------------------------------------------------------------------

DTYPES = ("uint8", "uint16", "float16", "float32", "float64")


@given(
    dtype=st.sampled_from(DTYPES),
    compression=st.sampled_from([None, "zlib"]),
    predictor=st.booleans(),
    order=st.sampled_from("<>"),
    planar=st.booleans(),
    tile=st.booleans(),
    grey=st.booleans(),
    big=st.booleans(),
)
def test_tiff(
    dtype: str,
    compression: str | None,
    predictor: bool,
    order: str,
    planar: bool,
    tile: bool,
    grey: bool,
    big: bool,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    rng = np.random.default_rng(1)
    whole = dtype.startswith("u")
    shape = (20, 40) if grey else (20, 40, 3)
    values = rng.integers(0, 200, shape) if whole else rng.uniform(0, 9, shape)
    stored = values.astype(dtype)
    options: dict[str, Any] = {"photometric": "minisblack" if grey else "rgb", "bigtiff": big}
    options |= {"compression": compression, "byteorder": order}
    if compression == "zlib" and predictor and dtype.startswith("u"):
        options["predictor"] = True
    if tile:
        options["tile"] = (16, 16)
    if planar and not grey:
        options["planarconfig"] = "separate"
    path = tmp_path_factory.getbasetemp() / "image.tif"
    written = np.moveaxis(stored, -1, 0) if "planarconfig" in options else stored
    tifffile.imwrite(path, written, **options)
    image = load(path)
    assert image.kind == ("coded" if whole else "scene")
    planes = np.moveaxis(np.atleast_3d(stored), -1, 0).astype(np.float32)
    expected = planes / np.float32(np.iinfo(dtype).max) if whole else planes
    np.testing.assert_array_equal(image.pixels, np.broadcast_to(expected, (3, 20, 40)))
    if not whole:
        assert load(path, coded=True).kind == "coded"


@pytest.mark.parametrize("compression", ["tiff_lzw", "jpeg", "tiff_adobe_deflate", "raw"])
@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1"])
def test_tiff_of_8_bits_is_read_as_pillow_reads_it(
    tmp_path: Path, compression: str, mode: str
) -> None:
    if compression == "jpeg" and mode in ("P", "1"):
        return
    rng = np.random.default_rng(1)
    picture = PIL.Image.fromarray(rng.integers(0, 256, (16, 24, 3), np.uint8)).convert(mode)
    path = tmp_path / "image.tiff"
    picture.save(path, compression=compression)
    with PIL.Image.open(path) as again:
        expected = unit(np.asarray(again.convert("RGB")))
    np.testing.assert_array_equal(load(path).pixels, expected)


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_tiff_is_turned_upright(tmp_path: Path, turn: int, dtype: str) -> None:
    stored = LETTER.astype(dtype)
    path = tmp_path / "image.tiff"
    tifffile.imwrite(path, stored, photometric="rgb", extratags=[(274, 3, 1, turn, True)])
    image = load(path)
    scale = 1 if dtype == "float32" else np.iinfo(dtype).max
    expected = np.moveaxis(turned(stored, turn), -1, 0).astype(np.float32) / np.float32(scale)
    np.testing.assert_array_equal(image.pixels, expected)
    assert ("is turned as its EXIF" in str(image.notes)) == (turn != 1)


def test_tiff_of_floats_with_a_profile(tmp_path: Path) -> None:
    values = np.random.default_rng(1).uniform(0, 9, (4, 5, 3)).astype(np.float32)
    path = tmp_path / "image.tiff"
    for curve, refused in ((STRAIGHT, False), (struct.pack(">4s4xIH", b"curv", 1, 512), True)):
        data = profile(curve, PRIMARIES["P3"])
        tifffile.imwrite(path, values, photometric="rgb", iccprofile=data)
        if refused:
            assert "expected a linear ICC profile for floating-point values" in refusal(path)
        else:
            expected = np.tensordot(TO_BT709[12], np.moveaxis(values, -1, 0), 1)
            np.testing.assert_allclose(load(path).pixels, expected, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("name", ["BT.709", "P3"])
def test_tiff_states_its_primaries(tmp_path: Path, dtype: str, name: str) -> None:
    values = np.random.default_rng(1).uniform(0, 1, (4, 5, 3))
    scale = 1 if dtype == "float32" else np.iinfo(dtype).max
    stored = (values * scale).astype(dtype)
    numbers = [n for pair in PRIMARIES[name] for c in pair for n in (round(1000 * c), 1000)]
    tags = [(319, 5, 6, tuple(numbers), True), (318, 5, 2, (3127, 10000, 3290, 10000), True)]
    path = tmp_path / "image.tiff"
    tifffile.imwrite(path, stored, photometric="rgb", extratags=tags)
    unit_values = np.moveaxis(stored, -1, 0) / scale
    light = unit_values if dtype == "float32" else srgb_light(unit_values)
    expected = np.tensordot(BY_NAME[name], light, 1)
    if dtype != "float32":
        expected = srgb_code(expected)
    np.testing.assert_allclose(load(path).pixels, expected, atol=2e-3)


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("first", [False, True])
def test_a_tiff_with_a_thumbnail_is_one_picture(tmp_path: Path, dtype: str, first: bool) -> None:
    values = np.random.default_rng(1).integers(0, 200, (8, 6, 3)).astype(dtype)
    path = tmp_path / "image.tiff"
    with tifffile.TiffWriter(path) as writer:
        if first:
            writer.write(values[::2, ::2], photometric="rgb", subfiletype=1)
        writer.write(values, photometric="rgb")
        if not first:
            writer.write(values[::2, ::2], photometric="rgb", subfiletype=1)
    np.testing.assert_array_equal(load(path).pixels, unit(values))


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_tiff_tells_of_channels_that_it_leaves_out(tmp_path: Path, dtype: str) -> None:
    values = np.random.default_rng(1).integers(0, 2, (5, 4, 5)).astype(dtype)
    path = tmp_path / "image.tiff"
    left = "1 channel of unspecified meaning beside the colours is left out."
    for extra in (["unspecified"], ["unassalpha", "unspecified"]):
        stored = values[..., : 3 + len(extra)]
        tifffile.imwrite(path, stored, photometric="rgb", planarconfig="contig", extrasamples=extra)
        image = load(path)
        assert left in image.notes
        assert (image.alpha is None) == (extra == ["unspecified"])
    tifffile.imwrite(
        path, values[..., :4], photometric="rgb", planarconfig="contig", extrasamples=[2]
    )
    assert left not in load(path).notes
    PIL.Image.new("RGBX", (4, 5)).save(path, compression="tiff_lzw")
    assert left in load(path).notes


def test_tiff_that_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.tiff"
    image = np.zeros((4, 5, 3), np.uint8)
    tifffile.imwrite(path, np.stack([image] * 2), photometric="rgb")
    assert "expected one picture, got 2 in a file" in refusal(path)
    tifffile.imwrite(path, image.astype(np.int16), photometric="rgb")
    assert "16 bits of format" in refusal(path)
    tifffile.imwrite(path, np.zeros((4, 5), np.uint32), photometric="minisblack")
    assert "expected 8 or 16 bits without sign" in refusal(path)
    tifffile.imwrite(path, np.zeros((4, 5, 4), np.uint8), photometric="separated")
    assert "CMYK" in refusal(path)
    tifffile.imwrite(path, np.full((4, 5, 3), np.nan, np.float32), photometric="rgb")
    assert "expected finite values" in refusal(path)
    assert load(path, nonfinite="clamp").pixels.sum() == 0
    path.write_bytes(path.read_bytes()[:-30])
    assert refusal(path).startswith("damaged TIFF (")


def test_a_compression_that_only_imagecodecs_has_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "image.tiff"
    tifffile.imwrite(path, np.zeros((4, 5, 3), np.uint16), photometric="rgb")
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<HHIH", 259, 3, 1, 1))
    data[at + 8 : at + 10] = struct.pack("<H", 5)  # LZW
    path.write_bytes(data)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    assert "expected the package imagecodecs for this TIFF's compression" in refusal(path)


# --- Pillow's -------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("suffix", ["webp", "bmp", "tga", "gif", "avif"])
def test_other_formats_are_read_as_pillow_reads_them(
    tmp_path: Path, suffix: str, mode: str
) -> None:
    rng = np.random.default_rng(1)
    picture = PIL.Image.fromarray(rng.integers(0, 256, (16, 24, 3), np.uint8)).convert(mode)
    path = tmp_path / f"image.{suffix}"
    picture.save(path)
    with PIL.Image.open(path) as again:
        expected = unit(np.asarray(again.convert("RGB")))
    image = load(path)
    np.testing.assert_array_equal(image.pixels, expected)
    assert image.kind == "coded"
    assert torch.equal(read_image(path), image.pixels)


@pytest.mark.parametrize("suffix", ["gif", "webp", "png", "tiff", "avif"])
def test_several_pictures_are_refused(tmp_path: Path, suffix: str) -> None:
    pictures = [PIL.Image.new("RGB", (8, 8), (60 * i, 0, 0)) for i in range(3)]
    path = tmp_path / f"image.{suffix}"
    pictures[0].save(path, save_all=True, append_images=pictures[1:])
    message = refusal(path)
    assert message.startswith("expected one picture, got ")
    assert message.endswith("; write each to a file of its own")


@pytest.mark.parametrize("suffix", ["mpo", "jpg"])
def test_a_jpeg_of_several_pictures_is_refused(tmp_path: Path, suffix: str) -> None:
    pictures = [PIL.Image.new("RGB", (8, 8), (60 * i, 0, 0)) for i in range(2)]
    stream = io.BytesIO()
    pictures[0].save(stream, "MPO", save_all=True, append_images=pictures[1:])
    (tmp_path / f"image.{suffix}").write_bytes(stream.getvalue())
    assert refusal(tmp_path / f"image.{suffix}").startswith("expected one picture, got 2 in a file")


def test_a_jpeg_with_a_thumbnail_is_one_picture(tmp_path: Path) -> None:
    picture = PIL.Image.new("RGB", (8, 8), (60, 0, 0))
    stream = io.BytesIO()
    picture.save(stream, "MPO", save_all=True, append_images=[picture])
    data = bytearray(stream.getvalue())
    # CIPA DC-007, 5.2.3.3: the entries of the pictures, each beginning with its kind.
    at = data.index(b"MPF\0") + 4
    entries = data.index(struct.pack("<HHI", 0xB002, 7, 32), at)
    (where,) = struct.unpack_from("<I", data, entries + 8)
    struct.pack_into("<I", data, at + where + 16, 0x010001)
    (tmp_path / "image.jpg").write_bytes(data)
    image = load(tmp_path / "image.jpg")
    assert image.notes == ("What is beside the picture (a thumbnail, a gain map) is left out.",)


def test_an_animation_of_one_picture_is_one(tmp_path: Path) -> None:
    values = np.zeros((4, 5, 3), np.uint16)
    data = png16(values, 2, interlaced=False)
    control = struct.pack(">IIIIIHHBB", 0, 5, 4, 0, 0, 1, 1, 0, 0)
    one = chunk(b"acTL", struct.pack(">II", 1, 0))
    path = tmp_path / "image.png"
    path.write_bytes(with_chunks(data, one, chunk(b"fcTL", control)))
    assert load(path).pixels.shape == (3, 4, 5)
    path.write_bytes(with_chunks(data, one))  # what is shown without the animation is another
    assert "got an animation of 2" in refusal(path)


def test_jpeg_xl_is_refused(tmp_path: Path) -> None:
    (tmp_path / "image.jxl").write_bytes(b"\xff\x0a" + bytes(40))
    assert refusal(tmp_path / "image.jxl").endswith("convert it to PNG with libjxl's djxl")


def test_avif_of_pq_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.avif"
    PIL.Image.new("RGB", (16, 16), (200, 100, 0)).save(path)
    data = bytearray(path.read_bytes())
    at = data.index(b"colrnclx") + 8
    data[at : at + 4] = struct.pack(">HH", 9, 16)
    path.write_bytes(data)
    assert "expected an AVIF of sRGB colours, got 9/16 (CICP)" in refusal(path)


# --- Orientation ----------------------------------------------------------------------------------


def turned(values: NDArray[Any], turn: int) -> NDArray[Any]:
    """Return the image upright, by Pillow's table of operations written out."""
    steps = {
        1: values,
        2: np.fliplr(values),
        3: np.rot90(values, 2),
        4: np.flipud(values),
        5: values.swapaxes(0, 1),
        6: np.rot90(values, -1),
        7: np.rot90(values.swapaxes(0, 1), 2),
        8: np.rot90(values),
    }
    return steps[turn]


def exif(turn: int) -> bytes:
    data = PIL.Image.Exif()
    data[0x0112] = turn
    return data.tobytes()


def raw_profile(kind: str, data: bytes) -> bytes:
    digits = data.hex()
    lines = "\n".join(digits[i : i + 72] for i in range(0, len(digits), 72))
    text = f"\n{kind}\n{len(data):8}\n{lines}\n"
    keyword = f"Raw profile type {kind}".encode()
    return chunk(b"zTXt", keyword + b"\0\0" + zlib.compress(text.encode()))


@pytest.mark.parametrize("turn", range(1, 9))
@pytest.mark.parametrize("where", ["eXIf", "late eXIf", "exif", "APP1", "xmp", "webp", "avif"])
def test_pictures_are_turned_upright(tmp_path: Path, where: str, turn: int) -> None:
    stream = io.BytesIO()
    picture = PIL.Image.fromarray(LETTER)
    if where == "webp":
        picture.save(stream, "WEBP", lossless=True, exif=exif(turn))
    elif where == "avif":
        picture.save(stream, "AVIF", quality=100, subsampling="4:4:4", exif=exif(turn))
    else:
        picture.save(stream, "PNG")
    data = stream.getvalue()
    body = exif(turn).removeprefix(b"Exif\0\0")
    if where == "eXIf":
        data = with_chunks(data, chunk(b"eXIf", body))
    elif where == "late eXIf":
        data = data[:-12] + chunk(b"eXIf", body) + data[-12:]
    elif where in ("exif", "APP1"):
        data = with_chunks(data, raw_profile(where, exif(turn)))
    elif where == "xmp":
        words = f'<x:xmpmeta><rdf:Description tiff:Orientation="{turn}"/></x:xmpmeta>'
        text = b"XML:com.adobe.xmp\0\0\0\0\0" + words.encode()
        data = with_chunks(data, chunk(b"iTXt", text))
    path = tmp_path / f"image.{where if where in ('webp', 'avif') else 'png'}"
    path.write_bytes(data)
    image = load(path)
    expected = unit(np.ascontiguousarray(turned(LETTER, turn)))
    np.testing.assert_allclose(image.pixels, expected, atol=0.05 if where == "avif" else 0)
    assert ("is turned as its EXIF" in str(image.notes)) == (turn != 1)


# --- Names, sizes, damage -------------------------------------------------------------------------


def test_a_name_that_promises_something_else(tmp_path: Path) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(b"PF\n1 1\n-1\n" + bytes(12))
    assert load(path).notes[0] == "The name says PNG, but the content is PFM and is read so."
    with pytest.raises(ImageError, match="expected sRGB-coded values in a file of this name"):
        read_image(path)
    path = tmp_path / "image.exr"
    PIL.Image.new("RGB", (2, 2)).save(path, "BMP")
    with pytest.raises(ImageError, match="expected light in a file of this name"):
        read_image(path)


def test_files_are_not_read_whole_before_their_head(tmp_path: Path) -> None:
    for name, head in (("a.exr", b""), ("b.png", b"\x89PNG\r\n\x1a\n"), ("c.pfm", b"PF\n")):
        path = tmp_path / name
        with path.open("wb") as file:
            file.write(head)
            try:
                file.truncate(200 * 2**30)
            except OSError:
                pytest.skip("the file system has no sparse files")
        words = "it begins with bytes" if name == "a.exr" else "expected a file of at most"
        assert words in refusal(path)


def test_of_a_large_openexr_file_only_the_wanted_part_is_read(tmp_path: Path) -> None:
    values = np.random.default_rng(1).uniform(0, 1, (3, 8, 9)).astype(np.float32)
    path = write_exr(tmp_path / "image.exr", rgb(values))
    with path.open("r+b") as file:
        try:
            file.truncate(200 * 2**30)
        except OSError:
            pytest.skip("the file system has no sparse files")
    np.testing.assert_array_equal(load(path).pixels, values)


def test_tiles_are_counted_before_they_are_listed(tmp_path: Path) -> None:
    path = hand_made_exr(
        tmp_path / "image.exr",
        {name: (np.zeros((1, 1), np.float32), 1) for name in "RGB"},
        flags=0x200,
        attributes={
            "tiles": ("tiledesc", struct.pack("<IIB", 1, 1, 0)),
            "dataWindow": ("box2i", struct.pack("<iiii", 0, 0, 1999, 1999)),
        },
    )
    tracemalloc.start()
    try:
        assert "the table of its 4000000 blocks of pixels" in refusal(path)
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def test_a_block_that_is_larger_than_its_pixels_is_not_read(tmp_path: Path) -> None:
    plane = np.ones((4, 6), np.float32)
    path = hand_made_exr(tmp_path / "image.exr", dict.fromkeys("RGB", (plane, 1)))
    row = struct.pack("<ii", 0, 72)  # the first row, and the size of its block
    path.write_bytes(path.read_bytes().replace(row, struct.pack("<ii", 0, 2**31 - 1), 1))
    with path.open("r+b") as file:
        try:
            file.truncate(4 * 2**30)
        except OSError:
            pytest.skip("the file system has no sparse files")
    assert "a block of pixels has 2147483647 bytes" in refusal(path)


def test_damaged_files_of_other_formats_do_no_harm(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    values = rng.integers(0, 256, (16, 24, 4), np.uint8)
    values[4:8] = 7
    files = []
    for suffix in ("webp", "bmp", "tga", "gif", "avif", "ppm", "tif"):
        files.append(tmp_path / f"image.{suffix}")
        picture = PIL.Image.fromarray(values)
        picture = picture if suffix in ("webp", "tga", "tif", "avif") else picture.convert("RGB")
        picture.save(files[-1])
    files.append(tmp_path / "letters.ppm")
    files[-1].write_text("P3\n4 4\n255\n" + "1 2 3\n" * 16)
    files.append(tmp_path / "lzw.tif")
    PIL.Image.fromarray(values[..., :3]).save(files[-1], compression="tiff_lzw")
    for dtype, compression in (("f4", None), ("f2", "zlib"), ("u2", "zlib"), ("u1", None)):
        files.append(tmp_path / f"{dtype}.tiff")
        stored = values.astype(dtype)
        tifffile.imwrite(
            files[-1],
            stored,
            photometric="rgb",
            extrasamples=["assocalpha"],
            compression=compression,
        )
    image = light(16, 40)
    files.append(write_hdr(tmp_path / "new.hdr", new_runs(rgbe(image), rng), "-Y 16 +X 40"))
    files.append(write_hdr(tmp_path / "old.hdr", old_runs(rgbe(image)), "-Y 16 +X 40"))
    files.append(tmp_path / "image.pfm")
    files[-1].write_bytes(b"PF\n4 4\n-1\n" + rng.uniform(0, 1, 48).astype("<f4").tobytes())
    messages = fuzz(tmp_path / "scratch.tga", files, cases=900)
    assert [messages[str(path)] for path in files] == [""] * len(files)
    assert sum(bool(message) for message in messages.values()) > 300
