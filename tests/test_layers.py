"""Which channels of an OpenEXR file are the picture: layers, parts, views, names of channels."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.test_io import hand_made_exr, planes, refusal, rgb, write_exr, write_parts
from torch_vdm.io import load, read_image

Planes = NDArray[Any]

AOVS = ("AO", "DiffCol", "Normal", "albedo", "diffuse_direct", "N", "crypto00")
BEAUTIES = ("Combined", "beauty", "COMBINED", "Beauty")
WHOLE_NAMES = ("rgba", "color", "colour", "RGB")


def named(letters: tuple[str, ...], values: Planes, prefix: str = "") -> dict[str, Planes]:
    """Return channels of a layer by their whole names."""
    dot = f"{prefix}." if prefix else ""
    return {f"{dot}{name}": plane for name, plane in zip(letters, values, strict=True)}


@given(
    called=st.one_of(
        st.tuples(st.sampled_from((*BEAUTIES, "")), st.sampled_from(("", "ViewLayer", "a.b"))),
        st.tuples(st.sampled_from(WHOLE_NAMES), st.just("")),
    ),
    aovs=st.lists(st.sampled_from(AOVS), max_size=4, unique=True),
    letters=st.sampled_from([("R", "G", "B"), ("r", "g", "b"), ("red", "green", "blue")]),
)
def test_the_picture_comes_before_what_goes_into_it(
    called: tuple[str, str],
    aovs: list[str],
    letters: tuple[str, ...],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    values = planes()
    beauty, owner = called
    prefix = f"{owner}.{beauty}" if owner and beauty else beauty
    channels = named(letters, values, prefix)
    for number, aov in enumerate(aovs):
        name = f"{owner}.{aov}" if owner else aov
        channels |= named(letters, values / (2 + number), name)
    path = write_exr(tmp_path_factory.getbasetemp() / "layers.exr", channels)
    np.testing.assert_array_equal(read_image(path), values)
    # By its whole name, and by the last word of it.
    for aov in aovs:
        wanted = values / (2 + aovs.index(aov))
        for name in {aov, f"{owner}.{aov}".lstrip(".")}:
            np.testing.assert_array_equal(read_image(path, part=name), wanted)


def test_several_layers_are_refused_and_listed(tmp_path: Path) -> None:
    values = planes()
    layers = named(("R", "G", "B"), values, "AO") | named(("R", "G", "B"), values / 2, "DiffCol")
    path = write_exr(tmp_path / "image.exr", layers)
    assert "got the layers 'AO', 'DiffCol'; choose one with --part NAME" in refusal(path)
    np.testing.assert_array_equal(read_image(path, part="DiffCol"), values / 2)
    np.testing.assert_array_equal(read_image(path, part="diffcol"), values / 2)
    layers = named(("R", "G", "B"), values, "Front.Combined")
    layers |= named(("R", "G", "B"), values / 2, "Back.Combined")
    path = write_exr(tmp_path / "image.exr", layers)
    assert "'Back.Combined', 'Front.Combined'" in refusal(path)
    assert "'Back.Combined', 'Front.Combined'" in refusal(path, part="Combined")
    np.testing.assert_array_equal(read_image(path, part="Back.Combined"), values / 2)
    assert "no named parts and layers 'Back.Combined', 'Front.Combined'" in refusal(path, part="x")


@pytest.mark.parametrize("data", ["XYZ", "Y"])
@pytest.mark.parametrize("name", ["beauty", "ViewLayer.Combined", "rgba"])
def test_data_of_no_layer_are_not_the_picture(tmp_path: Path, data: str, name: str) -> None:
    values = planes()
    positions = dict(zip(data, planes(6)[3:], strict=False))
    path = write_exr(tmp_path / "image.exr", positions | named(("R", "G", "B"), values, name))
    image = load(path)
    np.testing.assert_array_equal(image.pixels, values)
    assert f"Channels that are not used: {', '.join(data)}." in image.notes


def test_data_or_grey_beside_a_layer_is_refused(tmp_path: Path) -> None:
    values = planes()
    channels = {"Y": values[0]} | named(("R", "G", "B"), values, "albedo")
    path = write_exr(tmp_path / "image.exr", channels)
    assert "got the layers '' (no layer), 'albedo'; choose one with --part NAME" in refusal(path)
    np.testing.assert_array_equal(read_image(path, part="albedo"), values)
    grey = np.broadcast_to(values[:1], values.shape)
    np.testing.assert_array_equal(read_image(path, part=""), grey)


@pytest.mark.parametrize("name", ["albedo.color", "albedo.rgb", "Diffuse.rgba"])
def test_the_colour_of_another_layer_is_not_the_picture(tmp_path: Path, name: str) -> None:
    values = planes()
    channels = named(("R", "G", "B"), values, "main") | named(("R", "G", "B"), values / 2, name)
    told = refusal(write_exr(tmp_path / "image.exr", channels))
    assert "expected one image, got the layers" in told
    assert repr(name) in told
    assert "'main'" in told


def test_the_only_layer_is_the_picture(tmp_path: Path) -> None:
    values = planes()
    image = load(write_exr(tmp_path / "image.exr", named(("r", "g", "b"), values, "Layer")))
    np.testing.assert_array_equal(image.pixels, values)
    assert image.notes == ("The image is read from the channels Layer.r, Layer.g, Layer.b.",)


@pytest.mark.parametrize(
    "letters",
    [(".R", ".G", ".B"), ("r", "g", "b"), ("red", "green", "blue"), ("Red", "GREEN", "blue")],
)
def test_names_of_channels(tmp_path: Path, letters: tuple[str, ...]) -> None:
    values = planes()
    channels = named(letters, values) | {"Z": values[0], "id": values[1]}
    image = load(write_exr(tmp_path / "image.exr", channels))
    np.testing.assert_array_equal(image.pixels, values)
    assert image.notes[0] == f"The image is read from the channels {', '.join(letters)}."


def test_capital_letters_come_first(tmp_path: Path) -> None:
    values = planes(6)
    channels = named(("r", "g", "b"), values[3:]) | rgb(values[:3])
    np.testing.assert_array_equal(
        read_image(write_exr(tmp_path / "image.exr", channels)), values[:3]
    )


def test_parts_are_layers_too(tmp_path: Path) -> None:
    values = planes()
    path = write_parts(
        tmp_path / "image.exr",
        diffuse=rgb(values / 2),
        rgba=rgb(values),
        normals=rgb(values / 3),
    )
    image = load(path)
    np.testing.assert_array_equal(image.pixels, values)
    assert image.notes[0] == "Of 3 parts, part 1 ('rgba') is read."
    np.testing.assert_array_equal(read_image(path, part="diffuse"), values / 2)


def test_channels_can_be_named(tmp_path: Path) -> None:
    values = planes(4)
    path = write_exr(tmp_path / "image.exr", dict(zip(("u", "v.x", "w", "t"), values, strict=True)))
    assert "--channels R=...,G=...,B=..." in refusal(path)
    image = load(path, channels={"R": "v.x", "G": "u", "B": "w"})
    np.testing.assert_array_equal(image.pixels, values[[1, 0, 2]])
    assert image.alpha is None
    image = load(path, channels={"R": "v.x", "G": "u", "B": "w", "A": "t"})
    np.testing.assert_array_equal(image.alpha, values[3].clip(0, 1))
    assert "expected channels v, u, w, got t, u, v.x, w" in refusal(
        path, channels={"R": "v", "G": "u", "B": "w"}
    )
    assert "expected channels for R, G, B" in refusal(path, channels={"R": "u"})


def with_views(path: Path, views: tuple[str, ...], channels: dict[str, Planes]) -> Path:
    """Write a file of several views in one part."""
    value = b"".join(struct.pack("<i", len(view)) + view.encode() for view in views)
    return hand_made_exr(
        path,
        {name: (plane, 1) for name, plane in channels.items()},
        attributes={"multiView": ("stringvector", value)},
    )


def test_views(tmp_path: Path) -> None:
    values = planes(6)
    left, right = rgb(values[:3]), named(("R", "G", "B"), values[3:], "right")
    aov = named(("R", "G", "B"), values[:3] / 2, "albedo.right")
    path = with_views(tmp_path / "image.exr", ("left", "right"), left | right | aov)
    image = load(path)
    np.testing.assert_array_equal(image.pixels, values[:3])
    assert image.views == ("left", "right")
    assert "Of the views left, right, left is read." in image.notes
    np.testing.assert_array_equal(load(path, view="right").pixels, values[3:])
    np.testing.assert_array_equal(load(path, part="right").pixels, values[3:])
    assert "expected a view named 'centre', got left, right" in refusal(path, view="centre")


def test_views_in_parts(tmp_path: Path) -> None:
    values = planes(6)
    parts = []
    for view, colours in (("left", values[:3]), ("right", values[3:])):
        header: dict[str, Any] = {"type": OpenEXR.scanlineimage, "view": view}
        copies = {name: plane.copy() for name, plane in rgb(colours).items()}
        parts.append(OpenEXR.Part(header, copies, f"rgba.{view}"))
    OpenEXR.File(parts).write(str(tmp_path / "image.exr"))
    image = load(tmp_path / "image.exr")
    assert image.views == ("left", "right")
    np.testing.assert_array_equal(image.pixels, values[:3])
    right = load(tmp_path / "image.exr", view="right")
    np.testing.assert_array_equal(right.pixels, values[3:])


@given(cut=st.integers(0, 40), byte=st.integers(0, 255))
def test_damaged_lists_of_views_do_no_harm(
    cut: int, byte: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = with_views(
        tmp_path_factory.getbasetemp() / "views.exr", ("left", "right"), rgb(planes())
    )
    data = bytearray(path.read_bytes())
    at = data.index(b"multiView") + len(b"multiView\0stringvector\0") + 4
    data[at + cut % 17] = byte
    path.write_bytes(data)
    np.testing.assert_array_equal(load(path).pixels, planes())
