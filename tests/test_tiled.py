"""Images in tiles against the whole image, and what is refused."""

import pytest
import torch
from torch import Tensor

from torch_vdm import VDM, Haar, Observer, StationaryHaar, Steerable
from torch_vdm.cortex import Transform

TRANSFORMS = [Haar(), StationaryHaar(), Steerable()]
OBSERVERS = [Observer.calibrated(), Observer.paper()]
each_transform = pytest.mark.parametrize("transform", TRANSFORMS, ids=lambda t: type(t).__name__)
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
