"""What files say of their colours: cICP, ICC profiles, gAMA and cHRM, by independent formulas."""

import contextlib
import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import ImageCms

from tests.test_io import XYZ_TO_BT709, png16, refusal
from torch_vdm.io import ImageError, load, read_image

# Linear RGB to linear BT.709. ITU-R BT.2087-0, and the P3 matrix of the CSS Color module, level 4
# (through XYZ of D65).
TO_BT709 = {
    1: np.eye(3),
    9: np.array(
        [(1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)]
    ),
    12: np.array(
        [
            (1.2249401763, -0.2249401763, 0.0),
            (-0.0420569547, 1.0420569547, 0.0),
            (-0.0196375546, -0.0786360456, 1.0982736001),
        ]
    ),
}
PRIMARIES = {
    "BT.709": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06)),
    "P3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    "BT.2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
}
BY_NAME = {"BT.709": TO_BT709[1], "P3": TO_BT709[12], "BT.2020": TO_BT709[9]}
D65 = (0.3127, 0.3290)

Values = NDArray[Any]


def srgb_light(code: Values) -> Values:
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0) + 0.055) / 1.055) ** 2.4)


def srgb_code(light: Values) -> Values:
    high = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, high)


def pq_light(code: Values) -> Values:
    """ITU-R BT.2100-2, table 4, with its constants in decimals."""
    power = code ** (1 / 78.84375)
    return 10000 * (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (
        1 / 0.1593017578125
    )


def hlg_light(code: Values) -> Values:
    """ITU-R BT.2100-2, table 5: the scene's light, then the display's of 1000 cd/m2."""
    scene = np.where(
        code <= 0.5, code**2 / 3, (np.exp((code - 0.55991073) / 0.17883277) + 0.28466892) / 12
    )
    luminance = 0.2627 * scene[0] + 0.6780 * scene[1] + 0.0593 * scene[2]
    shown: Values = 1000 * luminance**0.2 * scene
    return shown


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def with_chunks(data: bytes, *chunks: bytes) -> bytes:
    """Return a PNG with chunks behind its header."""
    return data[:33] + b"".join(chunks) + data[33:]


def codes(bits: int = 16, seed: int = 1) -> Values:
    return np.random.default_rng(seed).integers(0, 2**bits, (7, 9, 3), np.uint16)


def planes(values: Values, bits: int = 16) -> Values:
    scaled: Values = np.moveaxis(values, -1, 0) / (2**bits - 1)
    return scaled


def write(path: Path, *chunks: bytes, values: Values | None = None) -> Path:
    values = codes() if values is None else values
    path.write_bytes(with_chunks(png16(values, 2, interlaced=False), *chunks))
    return path


def cicp(*numbers: int) -> bytes:
    return chunk(b"cICP", bytes(numbers))


# --- cICP -----------------------------------------------------------------------------------------

CURVES: dict[int, Callable[[Values], Values]] = {
    1: lambda code: code**2.4,
    4: lambda code: code**2.2,
    8: lambda code: code,
    13: srgb_light,
}


@pytest.mark.parametrize("space", [1, 9, 12])
@pytest.mark.parametrize("transfer", CURVES)
def test_cicp_of_a_screen(tmp_path: Path, space: int, transfer: int) -> None:
    image = load(write(tmp_path / "image.png", cicp(space, transfer, 0, 1)))
    light = np.tensordot(TO_BT709[space], CURVES[transfer](planes(codes())), 1)
    assert image.kind == "coded"
    np.testing.assert_allclose(image.pixels, srgb_code(light), atol=2e-3)
    if (space, transfer) == (1, 13):
        np.testing.assert_array_equal(image.pixels, planes(codes()).astype(np.float32))
        assert image.notes == ("The channels have 16 bits.",)


@pytest.mark.parametrize("space", [1, 9, 12])
def test_pq_is_absolute(tmp_path: Path, space: int) -> None:
    path = write(tmp_path / "image.png", cicp(space, 16, 0, 1))
    image = load(path)
    light = np.tensordot(TO_BT709[space], pq_light(planes(codes())), 1)
    assert image.kind == "absolute"
    np.testing.assert_allclose(image.pixels, light, rtol=2e-3, atol=2)
    with pytest.raises(ImageError, match=r"got PNG of absolute values; read it with torch_vdm\.io"):
        read_image(path)


def test_hlg_is_absolute(tmp_path: Path) -> None:
    image = load(write(tmp_path / "image.png", cicp(9, 18, 0, 1)))
    assert image.kind == "absolute"
    light = np.tensordot(TO_BT709[9], hlg_light(planes(codes())), 1)
    np.testing.assert_allclose(image.pixels, light, rtol=2e-3, atol=0.2)


def test_narrow_range(tmp_path: Path) -> None:
    values = (np.array([16, 126, 235]) * 257 // 257 * 256).astype(np.uint16)
    values = np.broadcast_to(values[None, :, None], (2, 3, 3)).copy()
    image = load(write(tmp_path / "image.png", cicp(1, 13, 0, 0), values=values))
    expected = [0, 110 / 219, 1]
    np.testing.assert_allclose(image.pixels[0, 0], expected, atol=1e-4)


@pytest.mark.parametrize("numbers", [(1, 17, 0, 1), (5, 13, 0, 1), (9, 16, 9, 1), (2, 2, 0, 1)])
def test_cicp_that_is_not_known_is_refused(tmp_path: Path, numbers: tuple[int, ...]) -> None:
    path = write(tmp_path / "image.png", cicp(*numbers))
    assert "convert the image to sRGB first" in refusal(path)


# --- ICC profiles ---------------------------------------------------------------------------------


def parametric(kind: int, *numbers: float) -> bytes:
    fixed = [round(number * 65536) for number in numbers]
    return struct.pack(f">4s4xHxx{len(fixed)}i", b"para", kind, *fixed)


def power(exponent: float) -> bytes:
    return struct.pack(">4s4xIH", b"curv", 1, round(256 * exponent))


def table(curve: Callable[[Values], Values], count: int) -> bytes:
    values = np.rint(65535 * curve(np.linspace(0, 1, count))).astype(">u2")
    return struct.pack(">4s4xI", b"curv", count) + bytes(values.tobytes())


SRGB_CURVE = parametric(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
STRAIGHT = struct.pack(">4s4xI", b"curv", 0)


def colorants(primaries: Any) -> NDArray[np.float64]:
    """Columns: the primaries in XYZ relative to D50, by Bradford, as profiles have them."""
    bradford = np.array(
        [(0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296)]
    )
    xyz = np.array([(x / y, 1, (1 - x - y) / y) for x, y in (*primaries, D65)]).T
    scaled = xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
    gains = (bradford @ (0.9642, 1, 0.8249)) / (bradford @ xyz[:, 3])
    adapted: NDArray[np.float64] = np.linalg.inv(bradford) @ np.diag(gains) @ bradford @ scaled
    return adapted


def profile(
    curve: bytes,
    primaries: Any = PRIMARIES["BT.709"],
    name: str = "sRGB",
    more: dict[bytes, bytes] | None = None,
) -> bytes:
    """Return an ICC profile of version 4, of a matrix and curves."""
    text = name.encode("utf-16-be")
    words = struct.pack(">4s4xII2s2sII", b"mluc", 1, 12, b"en", b"US", len(text), 28) + text
    columns = np.rint(65536 * colorants(primaries).T).astype(int)
    tags = {
        b"desc": words,
        b"cprt": words,
        b"wtpt": struct.pack(">4s4x3i", b"XYZ ", 63190, 65536, 54061),
    }
    for letter, column in zip(b"rgb", columns, strict=True):
        tags[bytes([letter]) + b"XYZ"] = struct.pack(">4s4x3i", b"XYZ ", *column)
        tags[bytes([letter]) + b"TRC"] = curve
    tags |= more or {}
    at, index, body = 132 + 12 * len(tags), b"", b""
    for key, value in tags.items():
        padded = value + bytes(-len(value) % 4)
        index += struct.pack(">4sII", key, at + len(body), len(value))
        body += padded
    head = struct.pack(
        ">I4xI4s4s4s12x4s", at + len(body), 0x04300000, b"mntr", b"RGB ", b"XYZ ", b"acsp"
    )
    head = (head + bytes(28) + struct.pack(">3i", 63190, 65536, 54061)).ljust(128, b"\0")
    return head + struct.pack(">I", len(tags)) + index + body


def iccp(data: bytes) -> bytes:
    return chunk(b"iCCP", b"icc\0\0" + zlib.compress(data))


PROFILE_CURVES: dict[str, tuple[bytes, Callable[[Values], Values]]] = {
    "linear": (STRAIGHT, lambda code: code),
    "linear power": (power(1), lambda code: code),
    "2.2": (power(2.19921875), lambda code: code**2.19921875),
    "sRGB": (SRGB_CURVE, srgb_light),
    "sRGB table": (table(srgb_light, 1024), srgb_light),
    "power": (parametric(0, 1.8), lambda code: code**1.8),
    "offset": (
        parametric(4, 2.0, 0.9, 0.1, 0.2, 0.25, 0.01, 0.02),
        lambda code: np.where(code >= 0.25, (0.9 * code + 0.1) ** 2 + 0.01, 0.2 * code + 0.02),
    ),
    "from a point": (
        parametric(2, 2.0, 1.0, -0.25, 0.1),
        lambda code: np.where(code >= 0.25, np.maximum(code - 0.25, 0) ** 2 + 0.1, 0.1),
    ),
}


@given(
    curve=st.sampled_from(sorted(PROFILE_CURVES)),
    space=st.sampled_from(sorted(PRIMARIES)),
    name=st.sampled_from(["sRGB", "linear", "Display P3", "x"]),
)
def test_profiles_are_what_their_numbers_say(
    curve: str, space: str, name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    tag, decode = PROFILE_CURVES[curve]
    data = profile(tag, PRIMARIES[space], name)
    path = write(tmp_path_factory.getbasetemp() / "profile.png", iccp(data))
    image = load(path)
    light = np.tensordot(BY_NAME[space], decode(planes(codes())), 1)
    np.testing.assert_allclose(image.pixels, srgb_code(light), atol=2e-3)
    assert image.kind == "coded"
    if curve.startswith("sRGB") and space == "BT.709":  # nothing is done, whatever it is called
        np.testing.assert_array_equal(image.pixels, planes(codes()).astype(np.float32))


@given(curve=st.sampled_from(sorted(PROFILE_CURVES)), space=st.sampled_from(["BT.709", "P3"]))
def test_profiles_are_read_as_lcms_reads_them(
    curve: str, space: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    # Colours of sRGB, for lcms has no others; and 8 bits.
    values = np.random.default_rng(1).integers(100, 140, (7, 9, 3), np.uint8)
    data = profile(PROFILE_CURVES[curve][0], PRIMARIES[space])
    picture = PIL.Image.fromarray(values)
    path = tmp_path_factory.getbasetemp() / "lcms.png"
    picture.save(path, icc_profile=data)
    shown = ImageCms.profileToProfile(
        picture,
        ImageCms.ImageCmsProfile(io.BytesIO(data)),
        ImageCms.createProfile("sRGB"),
        ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )
    assert shown is not None
    np.testing.assert_allclose(load(path).pixels, planes(np.asarray(shown), 8), atol=1.5 / 255)


@pytest.mark.parametrize("suffix", ["jpg", "webp", "tiff"])
def test_profiles_of_other_formats(tmp_path: Path, suffix: str) -> None:
    data = profile(SRGB_CURVE, PRIMARIES["P3"], "Display P3")
    values = np.full((16, 16, 3), (30, 200, 60), np.uint8)
    path = tmp_path / f"image.{suffix}"
    options: dict[str, Any] = {"lossless": True} if suffix == "webp" else {}
    PIL.Image.fromarray(values).save(path, icc_profile=data, **options)
    with PIL.Image.open(path) as picture:
        stored = planes(np.asarray(picture.convert("RGB")), 8)
    expected = srgb_code(np.tensordot(TO_BT709[12], srgb_light(stored), 1))
    assert expected.min() < -0.01  # a colour that sRGB lacks, kept
    np.testing.assert_allclose(load(path).pixels, expected, atol=2e-3)


def test_grey_profiles(tmp_path: Path) -> None:
    curve = {b"kTRC": power(1)}
    data = bytearray(profile(STRAIGHT, more=curve))
    data[16:20] = b"GRAY"
    path = tmp_path / "image.png"
    values = np.arange(64, dtype=np.uint8).reshape(8, 8)
    PIL.Image.fromarray(values).save(path, icc_profile=bytes(data))
    np.testing.assert_allclose(load(path).pixels[1], srgb_code(values / 255), atol=1e-5)


def test_a_profile_of_tables_goes_through_lcms_or_is_refused(tmp_path: Path) -> None:
    # ICC.1:2022, 10.12: a table of 2 x 2 x 2 colours with straight curves, from RGB to Lab.
    corners = np.zeros((2, 2, 2, 3))
    corners[..., 0] = np.mgrid[:2, :2, :2].mean(0) * 65280  # of L* alone: grey
    corners[..., 1:] = 32768
    matrix = struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 65536)
    ramp = np.array([0, 65535], ">u2").tobytes()
    tables = struct.pack(">4s4xBBBx", b"mft2", 3, 3, 2) + matrix + struct.pack(">HH", 2, 2)
    tables += 3 * ramp + corners.astype(">u2").tobytes() + 3 * ramp
    data = bytearray(profile(STRAIGHT, more={b"A2B0": tables}))
    data[20:24] = b"Lab "
    values = np.full((4, 4, 3), (255, 0, 0), np.uint8)
    path = tmp_path / "image.png"
    PIL.Image.fromarray(values).save(path, icc_profile=bytes(data))
    image = load(path)
    lightness = (1 / 3 * 100 + 16) / 116
    np.testing.assert_allclose(image.pixels, srgb_code(np.full((3, 4, 4), lightness**3)), atol=0.01)
    assert "by its ICC profile's tables, with 8 bits" in image.notes[0]
    assert "those that sRGB lacks are clipped" in image.notes[0]
    deep = write(tmp_path / "deep.png", iccp(bytes(data)))
    assert "expected an ICC profile of a matrix and curves" in refusal(deep)


def test_a_profile_may_state_cicp(tmp_path: Path) -> None:
    data = profile(SRGB_CURVE, more={b"cicp": b"cicp\0\0\0\0" + bytes((9, 16, 0, 1))})
    image = load(write(tmp_path / "image.png", iccp(data)))
    assert image.kind == "absolute"


@given(at=st.integers(0, 600), byte=st.integers(0, 255), cut=st.booleans())
def test_damaged_profiles_are_refused_or_used(
    at: int, byte: int, cut: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data = bytearray(profile(table(srgb_light, 16), PRIMARIES["P3"]))
    at %= len(data)
    data = data[:at] if cut else data[:at] + bytes([byte]) + data[at + 1 :]
    path = write(tmp_path_factory.getbasetemp() / "damaged.png", iccp(bytes(data)))
    with contextlib.suppress(ImageError):
        assert load(path).pixels.shape == (3, 7, 9)


@pytest.mark.parametrize("data", [b"Display P3", b"s\0R\0G\0B\0 IEC"])
def test_what_is_no_profile_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "image.png"
    PIL.Image.new("RGB", (4, 4)).save(path, icc_profile=data)
    assert "its colour profile cannot be used" in refusal(path)


def test_a_profile_that_cannot_be_unpacked_is_refused(tmp_path: Path) -> None:
    whole = iccp(profile(table(srgb_light, 16), PRIMARIES["P3"]))
    body = whole[8:-4]
    for place in (20, 40):
        damaged = chunk(b"iCCP", body[:place] + bytes(20) + body[place + 20 :])
        path = write(tmp_path / "image.png", damaged)
        assert "its colour profile cannot be used" in refusal(path)
    # cICP comes before it.
    assert load(write(tmp_path / "image.png", cicp(1, 13, 0, 1), damaged)).kind == "coded"


@pytest.mark.parametrize("number", [0, 2])
def test_a_jpeg_that_lacks_pieces_of_its_profile_is_refused(tmp_path: Path, number: int) -> None:
    path = tmp_path / "image.jpg"
    data = profile(table(srgb_light, 16), PRIMARIES["P3"])
    PIL.Image.new("RGB", (4, 4)).save(path, icc_profile=data)
    stored = bytearray(path.read_bytes())
    stored[stored.index(b"ICC_PROFILE\0") + 13] = number  # of how many pieces
    path.write_bytes(stored)
    assert "its colour profile cannot be used" in refusal(path)


# --- gAMA and cHRM, and what wins -----------------------------------------------------------------


def gama(gamma: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(gamma * 100000)))


def chrm(name: str) -> bytes:
    pairs = (D65, *PRIMARIES[name])
    return chunk(b"cHRM", struct.pack(">8I", *(round(100000 * c) for pair in pairs for c in pair)))


@pytest.mark.parametrize("gamma", [None, 1.0, 0.45455, 0.55])
@pytest.mark.parametrize("space", [None, *PRIMARIES])
def test_gamma_and_primaries(tmp_path: Path, gamma: float | None, space: str | None) -> None:
    chunks = [gama(gamma)] if gamma else []
    chunks += [chrm(space)] if space else []
    image = load(write(tmp_path / "image.png", *chunks))
    values = planes(codes())
    near = gamma in (None, 0.45455)
    if near and space in (None, "BT.709"):  # sRGB, as its writers state it
        np.testing.assert_array_equal(image.pixels, values.astype(np.float32))
        return
    light = srgb_light(values) if gamma is None else values ** (1 / gamma)
    expected = srgb_code(np.tensordot(BY_NAME[space or "BT.709"], light, 1))
    np.testing.assert_allclose(image.pixels, expected, atol=2e-3)
    assert "converted to sRGB from the primaries that it states" in image.notes[-1]


def test_adobe_rgb_of_cameras(tmp_path: Path) -> None:
    exif = PIL.Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    path = tmp_path / "image.jpg"
    PIL.Image.new("RGB", (16, 16), (60, 200, 100)).save(path, exif=exif, quality=100)
    image = load(path)
    with PIL.Image.open(path) as picture:
        stored = planes(np.asarray(picture), 8)
    # Adobe RGB (1998), 4.3.6: to XYZ of D65; and IEC 61966-2-1 from there.
    to_xyz = [(0.57667, 0.18556, 0.18823), (0.29734, 0.62736, 0.07529), (0.02703, 0.07069, 0.99134)]
    light = np.tensordot(XYZ_TO_BT709 @ to_xyz, stored ** (563 / 256), 1)
    np.testing.assert_allclose(image.pixels, srgb_code(light), atol=3e-3)
    assert image.pixels.min() < 0
    PIL.Image.new("RGB", (16, 16), (60, 200, 100)).save(
        path, exif=exif, icc_profile=profile(SRGB_CURVE)
    )
    assert load(path).pixels.min() > 0


def test_what_wins(tmp_path: Path) -> None:
    linear = iccp(profile(STRAIGHT))
    chunks = [gama(0.55), chrm("BT.2020"), chunk(b"sRGB", b"\0"), linear, cicp(12, 13, 0, 1)]
    values = planes(codes())
    wide = srgb_code(np.tensordot(TO_BT709[12], srgb_light(values), 1))
    for count, expected in ((3, values), (5, wide)):
        image = load(write(tmp_path / "image.png", *chunks[:count]))
        np.testing.assert_allclose(image.pixels, expected, atol=2e-3)
    image = load(write(tmp_path / "image.png", *chunks[:2], linear))
    np.testing.assert_allclose(image.pixels, srgb_code(values), atol=1e-5)


def test_impossible_primaries_are_refused(tmp_path: Path) -> None:
    path = write(
        tmp_path / "image.png", gama(0.5), chunk(b"cHRM", struct.pack(">8I", *[31270] * 8))
    )
    assert "are no colour space" in refusal(path)
