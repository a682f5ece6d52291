"""Images in tiles against the whole image, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.ladder import TRANSFORMS
from torch_vdm import VDM, Display, Effects, ImageError, Observer
from torch_vdm.io import ArrayFile
from torch_vdm.model.cortex import Transform

OBSERVERS = [Observer.calibrated(), Observer.paper()]
NAMES = ("test", "reference")
each_transform = pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
each_observer = pytest.mark.parametrize("observer", OBSERVERS, ids=lambda o: o.name)


def images(
    height: int, width: int, dtype: torch.dtype = torch.float64, batch: int = 1
) -> tuple[Tensor, Tensor]:
    """Return a test and a reference, sRGB-coded, that differ at every scale."""
    generator = torch.Generator().manual_seed(height * width)
    reference = torch.rand(batch, 3, height, width, generator=generator, dtype=torch.float64)
    slope = 0.05 * torch.linspace(-1.0, 1.0, width, dtype=torch.float64)
    noise = 0.02 * torch.randn(reference.shape, generator=generator, dtype=torch.float64)
    test = (reference + noise + slope).clamp(0.0, 1.0)
    return test.to(dtype), reference.to(dtype)


# Odd sides, last tiles of one pixel, slivers, tiles that do not divide, and levels far coarser
# than a tile of 4 or 16 pixels.
CUTS = [
    ((97, 131), 32),
    ((129, 65), 64),
    ((33, 17), 4),
    ((33, 90), 17),
    ((3, 200), 16),
    ((90, 1), 8),
    ((100, 140), 100),
    ((20, 30), 64),
]


@each_transform
@each_observer
@pytest.mark.parametrize(("size", "tile"), CUTS)
def test_the_map_in_tiles_is_that_of_the_whole(
    transform: Transform, observer: Observer, size: tuple[int, int], tile: int
) -> None:
    metric, pair = VDM(50.0, observer=observer, transform=transform), images(*size)
    torch.testing.assert_close(metric.tiled(*pair, tile), metric(*pair), rtol=0.0, atol=1e-10)


@each_transform
@each_observer
@pytest.mark.parametrize(("size", "tile"), CUTS[:2])
def test_the_score_in_tiles_is_that_of_the_whole(
    transform: Transform, observer: Observer, size: tuple[int, int], tile: int
) -> None:
    metric, pair = VDM(50.0, observer=observer, transform=transform), images(*size)
    expected = metric.score(*pair)
    torch.testing.assert_close(metric.tiled_score(*pair, tile), expected, rtol=0.0, atol=1e-10)


def test_float32_is_within_1e_5_jnd() -> None:
    # The promise; on differences of all sizes, a uniform one among them.
    test, reference = images(150, 220, torch.float32)
    pairs = [(test, reference), (reference, 0.98 * reference), (0.5 * test, 0.5 * reference)]
    for transform in TRANSFORMS:
        metric = VDM(transform=transform)
        for pair in pairs:
            difference = (metric.tiled(*pair, 64) - metric(*pair)).abs()
            assert difference.max() < 1e-5


def test_a_batch_an_array_and_whole_numbers(tmp_path: Path) -> None:
    test, reference = images(40, 70, torch.float32, batch=2)
    metric = VDM()
    expected = metric(test, reference)
    torch.testing.assert_close(metric.tiled(test, reference, 16), expected, rtol=0.0, atol=1e-5)
    score = metric.tiled_score(test, reference, 16)
    torch.testing.assert_close(score, metric.score(test, reference), rtol=1e-5, atol=0.0)
    codes = [(255.0 * image[0]).round().to(torch.uint8) for image in (test, reference)]
    pair = [code.float()[None] / 255.0 for code in codes]
    for name, code in zip(("test", "reference"), codes, strict=True):
        np.save(tmp_path / f"{name}.npy", code.permute(1, 2, 0).numpy())
    for arrays in (
        codes,
        [np.load(tmp_path / f"{n}.npy", mmap_mode="r").transpose(2, 0, 1) for n in NAMES],
        [ArrayFile(tmp_path / f"{n}.npy") for n in NAMES],
    ):
        jnd = metric.tiled(arrays[0], arrays[1], 16)
        torch.testing.assert_close(jnd, metric(*pair)[0], rtol=0.0, atol=1e-5)


def test_options_go_with_the_tiles() -> None:
    test, reference = images(40, 70)
    for metric in (
        VDM(effects=Effects(False, False, False, False)),
        VDM(display=Display.linear(300.0), effects=Effects(pooling=False)),
    ):
        torch.testing.assert_close(
            metric.tiled(test, reference, 16), metric(test, reference), rtol=0.0, atol=1e-10
        )


def test_only_what_is_needed_is_read_and_steps_are_told() -> None:
    test, reference = images(64, 400, torch.float32)
    largest = 0

    class Watched:
        """A source of one's own."""

        shape = reference[0].shape

        def __getitem__(self, index: Any) -> Tensor:
            nonlocal largest
            part = reference[0][index]
            largest = max(largest, part.shape[-2] * part.shape[-1])
            return part

    steps: list[tuple[int, int]] = []
    out = torch.zeros(1, 64, 400)
    given = VDM().tiled(test[0], Watched(), 32, out, lambda done, of: steps.append((done, of)))
    assert given is out
    torch.testing.assert_close(out, VDM()(test, reference)[0], rtol=0.0, atol=1e-5)
    assert largest <= 64 * (32 + 2 * 96)
    # 3 x 14 tiles, for the first begin before the image; each is read twice.
    assert steps == [(done, 84) for done in range(1, 85)]


def test_nonfinite_pixels_are_named_or_masked() -> None:
    test, reference = images(64, 100, torch.float32)
    test[0, 1, 50, 77] = float("nan")
    with pytest.raises(ValueError, match="item 0, the first in channel 1 at x 77, y 50"):
        VDM().tiled(test, reference, 32)
    metric = VDM(nonfinite="mask")
    jnd = metric.tiled(test, reference, 32)
    assert jnd[0, 0, 50, 77] == 0.0
    torch.testing.assert_close(jnd, metric(test, reference), rtol=0.0, atol=1e-5)


def test_wrong_calls_are_refused() -> None:
    test, reference = images(8, 9)
    metric = VDM()
    with pytest.raises(ValueError, match="tile of 4 or more pixels a side, got 3"):
        metric.tiled(test, reference, 3)
    with pytest.raises(ValueError, match=r"test of shape \(3, H, W\) or .* got \(8, 9\)"):
        metric.tiled(test[0, 0], reference)
    with pytest.raises(ValueError, match="two images of one shape"):
        metric.tiled(test, reference[..., :5])
    with pytest.raises(ValueError, match=r"out of shape \(1, 1, 8, 9\) of floating point, got"):
        metric.tiled(test, reference, out=torch.zeros(1, 8, 9))
    with pytest.raises(ValueError, match="Sarnoff's model, whose resampling"):
        VDM.sarnoff().tiled(test, reference)


def test_array_files_that_are_no_image_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.npy"
    for array, message in (
        (np.zeros((4, 4), np.float32), r"shape \(3, H, W\) or \(H, W, 3\), got \(4, 4\)"),
        (np.zeros((3, 4, 4), np.int64), "got int64"),
    ):
        np.save(path, array)
        with pytest.raises(ImageError, match=message):
            ArrayFile(path)
    path.write_bytes(b"\x93NUMPY")
    with pytest.raises(ImageError, match=r"image\.npy: damaged or no array"):
        ArrayFile(path)
    image = np.zeros((3, 6, 8), np.float32)
    image[1, 4, 5] = -1.0
    np.save(path, image)
    part = slice(0, 3), slice(2, 6), slice(3, 8)
    with pytest.raises(ImageError, match="the first at x=5, y=4"):
        ArrayFile(path, negative="raise")[part]
    assert ArrayFile(path, negative="clip")[part].min() == 0.0
