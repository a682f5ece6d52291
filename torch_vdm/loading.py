"""Two files as pairs of images on one display, and what was assumed to read them."""

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.io import ArrayFile, Image, ImageError, load
from torch_vdm.io.arrays import MAGIC
from torch_vdm.io.exr_header import listed
from torch_vdm.model.display import BT709_TO_XYZ, Display, decode_srgb, encode_srgb
from torch_vdm.report import BAND, shrunk
from torch_vdm.run.tiling import Source, read


@dataclass(frozen=True)
class Pair:
    """Two images prepared for one display."""

    reference: Source
    test: Source
    display: Display

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.reference.shape[-2:]
        return height, width

    def luminances(self) -> tuple[float, float]:
        """Return the mean luminance of reference and test, in cd/m2."""
        matrix = torch.tensor(BT709_TO_XYZ, dtype=torch.float64)
        height, width = self.size
        rows = max(1, BAND // width)
        sums = [0.0, 0.0]
        for top in range(0, height, rows):
            band = slice(top, min(top + rows, height)), slice(0, width)
            for number, image in enumerate((self.reference, self.test)):
                xyz = self.display.to_xyz(read(image, 0, band).double(), matrix)
                sums[number] += xyz[0, 1].sum().item()
        return sums[0] / (height * width), sums[1] / (height * width)

    def coded(self) -> tuple[Tensor, Tensor]:
        """Return reference and test as sRGB-coded images, reduced to fit a panel."""
        reference, test = shrunk(self.reference), shrunk(self.test)
        if self.display.encoding == "srgb" and self.display.exposure == 0.0:
            return reference, test
        scale = 2.0**self.display.exposure
        linear = (
            decode_srgb(image) if self.display.encoding == "srgb" else image
            for image in (reference, test)
        )
        reference, test = (encode_srgb(image * scale) for image in linear)
        return reference, test


@dataclass(frozen=True)
class _Linear:
    """An sRGB-coded source as linear values, where the code 1.0 becomes ``white``."""

    source: Source
    white: float

    @property
    def shape(self) -> Sequence[int]:
        """(3, H, W)."""
        return self.source.shape

    def __getitem__(self, index: tuple[slice, slice, slice], /) -> Tensor:
        """Return a part."""
        return decode_srgb(read(self.source, 0, index[1:])[0]) * self.white


class _Opened(NamedTuple):
    """An image in memory, or an array on a disk, and what was assumed to read it."""

    pixels: Source
    kind: str
    content: str
    notes: tuple[str, ...]
    image: Image | None


def _open(
    path: Path, options: argparse.Namespace, view: str | None = None, background: str = "black"
) -> _Opened:
    if _is_array(path):
        array = ArrayFile(path, options.nonfinite, options.negative, options.coded)
        return _Opened(array, "scene" if array.linear else "coded", "NPY", array.notes, None)
    image = load(
        path,
        part=_part(options.part),
        view=view,
        channels=options.channels,
        nonfinite=options.nonfinite,
        negative=options.negative,
        background=options.background or background,
        coded=options.coded,
        quiet=True,
    )
    content = image.content.replace("OpenEXR", "EXR")
    return _Opened(image.pixels, image.kind, content, image.notes, image)


def _is_array(path: Path) -> bool:
    # `load` reports what cannot be opened; opening a pipe would wait for ever.
    with contextlib.suppress(OSError, ValueError):
        if path.is_file():
            with path.open("rb") as file:
                return file.read(len(MAGIC)) == MAGIC
    return False


def displays_of(options: argparse.Namespace) -> tuple[Display, Display]:
    """Return the displays of sRGB-coded images and of light."""
    return (
        Display.srgb(options.peak, options.exposure),
        Display.linear(options.white, options.exposure),
    )


def load_pairs(
    reference: Path, test: Path, displays: tuple[Display, Display], options: argparse.Namespace
) -> tuple[list[Pair], list[str]]:
    """Read both images, and say what was assumed; an array is read later, part by part.

    There are several pairs if the files have several views, or if their transparency differs: then
    no single background shows all of the difference.
    """
    paths = reference, test
    opened = [_open(path, options) for path in paths]
    views, told = _common_views(opened, paths)
    shown: list[str | None] = [*views] or [None]
    groups = [
        [_in_view(image, path, options, view) for image, path in zip(opened, paths, strict=True)]
        for view in shown
    ]
    for group in groups:
        _require_one_size(group, groups[0][0], paths)
    assumptions = [*_scales(groups[0], options), *told]
    differ = [view for view, group in zip(shown, groups, strict=True) if _differ(group)]
    if differ:
        assumptions.append(f"the transparency of the two differs: {_over(options)}")
    if differ and options.background is None:
        groups += [[_open(path, options, view, "white") for path in paths] for view in differ]
    for number, name in enumerate(_names(paths)):
        notes = dict.fromkeys(note for group in groups for note in group[number].notes)
        assumptions += [f"{name}: {note}" for note in notes]
    return [_pair(group, displays, options) for group in groups], assumptions


def _require_one_size(images: Sequence[_Opened], first: _Opened, paths: Sequence[Path]) -> None:
    """Refuse images if one of them has another size than the first that was read."""
    for path, image in zip(paths, images, strict=True):
        sizes = ["{2} x {1}".format(*x.pixels.shape) for x in (first, image)]
        if sizes[0] != sizes[1]:
            raise ImageError(
                f"{path}: expected the size of {paths[0]}, {sizes[0]}, got {sizes[1]}; "
                "crop or scale one of them"
            )


def _pair(
    images: Sequence[_Opened], displays: tuple[Display, Display], options: argparse.Namespace
) -> Pair:
    """Bring two images to one display."""
    if all(image.kind == "coded" for image in images):
        return Pair(images[0].pixels, images[1].pixels, displays[0])
    one, other = (_light(image, options) for image in images)
    return Pair(one, other, displays[1])


def _light(image: _Opened, options: argparse.Namespace) -> Source:
    """Return linear values in which 1.0 is ``--white``."""
    if image.kind == "coded":
        return _Linear(image.pixels, options.peak / options.white)
    if image.kind == "absolute":
        assert image.image is not None
        scaled: Tensor = image.image.pixels / options.white
        return scaled
    return image.pixels


def _scales(images: Sequence[_Opened], options: argparse.Namespace) -> Iterator[str]:
    """Yield what the values of the images are taken for."""
    told = {
        "scene": f"linear BT.709, and 1.0 is {options.white:g} cd/m2 (--white)",
        "coded": f"sRGB, and white is {options.peak:g} cd/m2 (--peak)",
        "absolute": "absolute light in cd/m2",
    }
    for kind, what in told.items():
        contents = list(dict.fromkeys(image.content for image in images if image.kind == kind))
        if contents:
            yield f"{' and '.join(contents)} {'are' if len(contents) > 1 else 'is'} {what}"
    yield f"exposure {options.exposure:+g} stops (--exposure)"


def _names(paths: Sequence[Path]) -> list[str]:
    """Return names of the files that tell them apart."""
    return (
        [str(path) for path in paths]
        if paths[0].name == paths[1].name
        else [path.name for path in paths]
    )


def _common_views(images: Sequence[_Opened], paths: Sequence[Path]) -> tuple[list[str], list[str]]:
    """Return the views to compare, by their names, and what is to be reported about them.

    There are none if a file has no views: then what each shows first is compared.
    """
    one, other = (image.image.views if image.image else () for image in images)
    if not one or not other:
        return [], []
    common = [view for view in one if view in other]
    if not common:
        raise ImageError(
            f"{paths[1]}: expected a view that {paths[0]} has ({listed([*one])}), got "
            f"{listed([*other])}; render the same views, or name the channels with --channels"
        )
    told = []
    if len(common) > 1:
        told.append(
            f"the views {' and '.join(common)} are compared: each pixel has the larger difference"
        )
    for name, views in zip(_names(paths), (one, other), strict=True):
        alone = [view for view in views if view not in common]
        if alone:
            told.append(
                f"{name}: views that the other file lacks are not compared: {listed(alone)}"
            )
    return common, told


def _in_view(opened: _Opened, path: Path, options: argparse.Namespace, view: str | None) -> _Opened:
    """Return what was opened, the first view of its file, or open another view of it."""
    first = opened.image.views[:1] if opened.image else ()
    return opened if view is None or view in first else _open(path, options, view)


def _differ(images: Sequence[_Opened]) -> bool:
    """Return whether the transparency of two images differs."""
    one, other = (image.image for image in images)
    if one is None or other is None:
        return False
    if one.alpha is not None and other.alpha is not None:
        return not torch.equal(one.alpha, other.alpha)
    for image in (one, other):
        # An EXR without alpha, as a denoiser leaves it, still has the picture over black.
        if image.alpha is not None and not image.associated:
            return bool((image.alpha < 1.0).any())
    return False


def _over(options: argparse.Namespace) -> str:
    if options.background is not None:
        return f"compared over {options.background} alone, as asked for (--background)"
    return (
        "compared over black and over white, and each pixel has the larger difference "
        "(--background chooses one)"
    )


def _part(text: str | None) -> int | str | None:
    return int(text) if text is not None and text.isdecimal() else text
