"""Skipped tiles against all computed again, bit for bit, and against the metric in one piece."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from sampling.boundary import detail_variances
from sampling.prediction import Model
from sampling.renderers.synthetic import Synthetic
from sampling.statistics import Statistics
from sampling.tiles import PAYS, TILE, local_errors
from torch_vdm import VDM, Display, Observer

# Of one and two fine levels; odd and even sides, more of one than of the other, wider than a strip.
SIZES = [(130, 130), (131, 157), (300, 97), (259, 261), (34, 1301)]
OBSERVERS = [Observer.calibrated(), Observer.paper()]
each_observer = pytest.mark.parametrize("observer", OBSERVERS, ids=lambda o: o.name)
each_size = pytest.mark.parametrize("size", SIZES, ids=str)

COMPUTE_ALL, SKIP_ALWAYS = -1.0, 1.0


@pytest.fixture(params=[1, 2], ids="{} threads".format)
def _threads(request: pytest.FixtureRequest) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield
    torch.set_num_threads(before)


def modelled(size: tuple[int, int], observer: Observer) -> Model:
    """Return the model of a rough image after 4 samples of every pixel."""
    rng = np.random.default_rng(5)
    event = rng.uniform(0.02, 0.6, (*size, 3))
    renderer = Synthetic(rng.uniform(0.0, 0.5, (*size, 3)), event, np.full(size, 0.5))
    pixels = np.arange(size[0] * size[1])
    statistics = Statistics(len(pixels))
    statistics.add(renderer.sample(pixels, 0 * pixels, 0 * pixels + 4))
    return Model(VDM(60.0, Display.linear(), observer), statistics, size)


def touches(size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield which pixels get more samples: none, one, corners, clusters, scattered, all."""
    rng = np.random.default_rng(6)
    touched = np.zeros(size, np.bool_)
    yield touched.copy()
    for pixel in ((0, 0), (-1, -1), (size[0] // 2, size[1] // 2), (0, -1)):
        touched[:] = False
        touched[pixel] = True
        yield touched.copy()
    for _ in range(4):
        touched[:] = False
        top, left = (int(rng.integers(side)) for side in size)
        touched[top : top + 2 * TILE, left : left + TILE] = True
        yield touched.copy()
    for share in (0.001, 0.01, 1.0):
        yield rng.random(size) < share


@pytest.mark.usefixtures("_threads")
@each_size
@each_observer
def test_skipping_changes_no_bit(observer: Observer, size: tuple[int, int]) -> None:
    model = modelled(size, observer)
    for touched in touches(size):
        leaves = model.leaves(model.count * np.where(touched, 1.7, 1.0))
        every = model.errors.at(leaves, COMPUTE_ALL)
        for pays in (SKIP_ALWAYS, PAYS):
            found = model.errors.at(leaves, pays)
            assert all(torch.equal(one, other) for one, other in zip(found, every, strict=True))


@pytest.mark.usefixtures("_threads")
@each_size
@each_observer
def test_the_errors_so_far_are_those_of_its_own_variances(
    observer: Observer, size: tuple[int, int]
) -> None:
    model = modelled(size, observer)
    for pays in (SKIP_ALWAYS, COMPUTE_ALL):
        found = model.errors.at(model.leaves(), pays)
        assert all(torch.equal(one, own) for one, own in zip(found, model.errors.own, strict=True))


@each_size
@each_observer
def test_pieces_are_the_metric_in_one_piece(observer: Observer, size: tuple[int, int]) -> None:
    """In double precision without pieces: apart by what single precision leaves."""
    model = modelled(size, observer)
    count = model.count * np.where(np.random.default_rng(7).random(size) < 0.3, 3.0, 1.0)
    with torch.no_grad():
        variance = model.single_variance / torch.from_numpy(count)
        variances = detail_variances(variance, model.true_means)
        expected = local_errors(model.metric, model.truth, variances, variance)
        found = model.errors.at(model.leaves(count))
    for one, other in zip(found, expected, strict=True):
        scale = float(other.max())
        np.testing.assert_allclose(one / scale, other / scale, atol=2e-5)


@each_size
def test_the_share_touched_counts_tiles(size: tuple[int, int]) -> None:
    model = modelled(size, OBSERVERS[0])
    none, one, *_, every = [
        model.errors.touched(model.leaves(model.count * np.where(touched, 2.0, 1.0)))
        for touched in touches(size)
    ]
    assert none == 0.0
    # A corner lies in one tile of each level.
    shapes = [detail.shape[-2:] for detail in model.cortex.details[-1:-3:-1]]
    levels = [
        [side + more for side, more in zip(shape, before, strict=True)]
        for shape, before in zip(shapes, model.cortex.before[-1:-3:-1], strict=True)
    ]
    cut = [
        -(-y // TILE) * -(-x // TILE)
        for (y, x), (h, w) in zip(levels, shapes, strict=True)
        if h * w > 64 * 64
    ]
    assert one == pytest.approx(len(cut) / sum(cut))
    assert every == 1.0
