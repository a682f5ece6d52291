"""Transparency, straight and associated, over backgrounds: against the formula, pixel by pixel."""

import struct
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
    PRIMARIES,
    SRGB_CURVE,
    TO_BT709,
    chunk,
    profile,
    srgb_code,
    srgb_light,
    with_chunks,
)
from tests.test_io import planes, png16, rgb, write_exr
from torch_vdm.io import load, read_image

BACKGROUNDS = {"black": 0.0, "white": 1.0, "grey": 128 / 255, "#804020": None}
BROWN = np.array([0x80, 0x40, 0x20])[:, None, None] / 255

backgrounds = st.sampled_from(sorted(BACKGROUNDS))


def coded(background: str) -> Any:
    """Return a background's sRGB-coded values."""
    value = BACKGROUNDS[background]
    return BROWN if value is None else np.full((3, 1, 1), value)


def straight(colours: Any, alpha: Any, behind: Any) -> Any:
    return alpha * colours + (1 - alpha) * behind


@given(
    mode=st.sampled_from(["RGBA", "LA", "P", "L key", "RGB key"]),
    suffix=st.sampled_from(["png", "webp", "tga", "tiff"]),
    background=backgrounds,
    seed=st.integers(0, 5),
)
def test_straight_alpha_is_composited_in_coded_values(
    mode: str, suffix: str, background: str, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 256, (5, 6, 4), np.uint8)
    options: dict[str, Any] = {"lossless": True, "exact": True} if suffix == "webp" else {}
    picture = PIL.Image.fromarray(values)
    if suffix != "png":
        mode = "RGBA"
    if mode == "LA":
        picture = picture.convert("LA")
    elif mode == "P":
        picture = picture.convert("RGB").convert("P")
        options["transparency"] = bytes(rng.integers(0, 256, 256, np.uint8))
    elif mode.endswith("key"):
        picture = picture.convert(mode.split()[0])
        options["transparency"] = picture.getpixel((2, 3))
    path = tmp_path_factory.getbasetemp() / f"image.{suffix}"
    picture.save(path, **options)
    with PIL.Image.open(path) as again:
        stored = np.moveaxis(np.asarray(again.convert("RGBA")), -1, 0) / 255
    image = load(path, background=background)
    assert image.alpha is not None
    np.testing.assert_allclose(image.alpha, stored[3], atol=1e-6)
    expected = straight(stored[:3], stored[3], coded(background))
    np.testing.assert_allclose(image.pixels, expected, atol=1e-6)
    told = f"It is transparent, and shown over {background} (--background): straight alpha, sRGB"
    assert any(note.startswith(told) for note in image.notes) == bool((stored[3] < 1).any())


@pytest.mark.parametrize("kind", [0, 2])
def test_a_colour_of_16_bits_may_be_clear(tmp_path: Path, kind: int) -> None:
    values = np.random.default_rng(1).integers(0, 3, (6, 7, 3 if kind else 1), np.uint16) * 30000
    key = values[2, 3]
    data = png16(values, kind, interlaced=False)
    path = tmp_path / "image.png"
    path.write_bytes(with_chunks(data, chunk(b"tRNS", struct.pack(f">{len(key)}H", *key))))
    image = load(path)
    clear = (values == key).all(-1)
    assert image.alpha is not None
    np.testing.assert_array_equal(image.alpha, ~clear)
    assert (image.pixels[:, clear] == 0).all()


@pytest.mark.parametrize("depth", [1, 2, 4, 8])
@pytest.mark.parametrize("key", [0, 1])
def test_a_grey_of_few_bits_may_be_clear(tmp_path: Path, depth: int, key: int) -> None:
    values = np.arange(8) % 2**depth
    bits = "".join(format(value, f"0{depth}b") for value in values)
    row = int(bits, 2).to_bytes(depth, "big")
    header = struct.pack(">IIBBBBB", 8, 1, depth, 0, 0, 0, 0)
    parts = (
        (b"IHDR", header),
        (b"tRNS", struct.pack(">H", key)),
        (b"IDAT", zlib.compress(b"\0" + row)),
    )
    data = b"".join(chunk(name, body) for name, body in (*parts, (b"IEND", b"")))
    (tmp_path / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    image = load(tmp_path / "image.png", background="white")
    expected = np.where(values == key, 1, values / (2**depth - 1))
    np.testing.assert_allclose(image.pixels[0, 0], expected, atol=1e-6)


@given(background=backgrounds, seed=st.integers(0, 5))
def test_associated_alpha_is_composited_in_light(
    background: str, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(0, 1, (45, 70)).astype(np.float32)
    colours = planes() * alpha
    channels = rgb(colours) | {"A": alpha}
    path = write_exr(tmp_path_factory.getbasetemp() / "image.exr", channels)
    image = load(path, background=background)
    expected = colours + (1 - alpha) * srgb_light(coded(background))
    np.testing.assert_allclose(image.pixels, expected, rtol=1e-5, atol=1e-6)
    if background == "black":
        np.testing.assert_array_equal(image.pixels, colours)


@pytest.mark.parametrize("name", ["A", "a", "alpha"])
def test_alpha_of_a_layer(tmp_path: Path, name: str) -> None:
    values = planes(4)
    channels = {f"beauty.{n}": plane for n, plane in zip("RGB", values, strict=False)}
    channels |= {f"beauty.{name}": values[3] / 2, "A": values[3] / 4}
    image = load(write_exr(tmp_path / "image.exr", channels), background="white")
    np.testing.assert_array_equal(image.alpha, values[3] / 2)
    np.testing.assert_allclose(image.pixels, values[:3] + 1 - values[3] / 2, rtol=1e-6)


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_opaque_alpha_changes_no_bit(tmp_path: Path, background: str) -> None:
    values = planes()
    path = write_exr(tmp_path / "image.exr", rgb(values) | {"A": np.ones_like(values[0])})
    image = load(path, background=background)
    np.testing.assert_array_equal(image.pixels, values)
    assert image.notes == ()
    bytes_ = np.random.default_rng(1).integers(0, 256, (5, 6, 4), np.uint8)
    bytes_[..., 3] = 255
    PIL.Image.fromarray(bytes_).save(tmp_path / "image.png")
    image = load(tmp_path / "image.png", background=background)
    expected = np.moveaxis(bytes_[..., :3], -1, 0) / np.float32(255)
    np.testing.assert_array_equal(image.pixels, expected)
    assert image.notes == ()


def test_alpha_that_is_no_number_is_opaque(tmp_path: Path) -> None:
    values = planes()
    alpha = np.full_like(values[0], 0.5)
    alpha[0, :3] = np.nan, np.inf, -1
    path = write_exr(tmp_path / "image.exr", rgb(values) | {"A": alpha})
    image = load(path)
    assert image.alpha is not None
    assert image.alpha[0, :4].tolist() == [1, 1, 0, 0.5]
    assert "1 values of alpha are NaN, and taken as opaque." in image.notes


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("rule", ["assocalpha", "unassalpha"])
def test_tiff_states_its_rule(tmp_path: Path, rule: str, dtype: type[np.generic]) -> None:
    values = np.random.default_rng(1).uniform(0, 1, (5, 6, 4))
    if dtype is not np.float32:
        values = np.rint(values * np.iinfo(dtype).max)  # type: ignore[type-var]
    stored = values.astype(dtype)
    path = tmp_path / "image.tiff"
    tifffile.imwrite(path, stored, photometric="rgb", extrasamples=[rule])
    light = dtype is np.float32
    unit = stored.astype(np.float64) / (1 if light else np.iinfo(dtype).max)  # type: ignore[type-var]
    colours, alpha = np.moveaxis(unit, -1, 0)[:3], unit[..., 3]
    image = load(path, background="grey")
    behind = srgb_light(coded("grey")) if light else coded("grey")
    expected = colours + (1 - alpha) * behind
    if rule == "unassalpha":
        expected = straight(colours, alpha, behind)
    np.testing.assert_allclose(image.pixels, expected, atol=1e-5)
    assert image.kind == ("scene" if light else "coded")


def test_associated_colours_are_divided_before_a_profile_converts_them(tmp_path: Path) -> None:
    alpha = np.random.default_rng(1).integers(1, 65536, (5, 6)) / 65535
    colours = np.broadcast_to(np.array([0.2, 0.8, 0.4])[:, None, None], (3, 5, 6))
    stored = np.rint(65535 * np.stack((*(colours * alpha), alpha), -1)).astype(np.uint16)
    path = tmp_path / "image.tiff"
    data = profile(SRGB_CURVE, PRIMARIES["P3"])
    tifffile.imwrite(path, stored, photometric="rgb", extrasamples=["assocalpha"], iccprofile=data)
    shown = srgb_code(np.tensordot(TO_BT709[12], srgb_light(colours), 1))
    np.testing.assert_allclose(
        load(path, background="white").pixels, straight(shown, alpha, 1.0), atol=2e-3
    )


def test_backgrounds_that_are_none(tmp_path: Path) -> None:
    for text in ("red", "#12345", "#12345g", "", "0.5"):
        with pytest.raises(ValueError, match="expected black, white, grey or #rrggbb"):
            load(tmp_path / "image.png", background=text)


def test_read_image_composites_too(tmp_path: Path) -> None:
    values: NDArray[np.uint8] = np.full((2, 2, 4), 128, np.uint8)
    PIL.Image.fromarray(values).save(tmp_path / "image.png")
    grey = read_image(tmp_path / "image.png", background="white")
    torch.testing.assert_close(grey, torch.full((3, 2, 2), (128 / 255) ** 2 + 127 / 255))
