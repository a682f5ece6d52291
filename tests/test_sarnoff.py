"""The Sarnoff VDM against its NumPy reference, and what must hold of it."""

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.conftest import KINDS, make_xyz
from tests.reference import paper, sarnoff
from torch_vdm import VDM, Display

each_grid = pytest.mark.parametrize("resample", [False, True], ids=["own_grid", "mosaic"])


def random_images(seed: int, batch: int = 1, height: int = 24, width: int = 31) -> Tensor:
    return torch.rand(batch, 3, height, width, generator=torch.Generator().manual_seed(seed))


def grating(cycles: float, contrast: float, angle: float = 0.0, size: int = 128) -> Tensor:
    """Return a grating (1, 3, size, size) of absolute XYZ, of mean 100 cd/m2, cycles/pixel."""
    y, x = torch.meshgrid(*2 * (torch.arange(size, dtype=torch.float64),), indexing="ij")
    along = x * math.cos(math.radians(angle)) + y * math.sin(math.radians(angle))
    wave = torch.sin(2.0 * math.pi * cycles * along + 0.3)
    return (100.0 * (1.0 + contrast * wave)).expand(1, 3, size, size).contiguous()


@each_grid
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (13, 21)])
def test_is_the_reference(resample: bool, kind: str, size: tuple[int, int]) -> None:
    first, second = make_xyz(kind, *size, 1), make_xyz("random", *size, 2)
    expected = sarnoff.jnd_map(first[1], second[1], 48.0, resample)
    metric = VDM.sarnoff(48.0, Display.xyz(), resample=resample)
    images = [torch.from_numpy(image)[None] for image in (first, second)]
    actual = metric(*images)[0, 0]
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-9, atol=1e-9)
    single = metric(*(image.float() for image in images))[0, 0]
    np.testing.assert_allclose(single.numpy(), expected, rtol=1e-3, atol=1e-4)


def test_is_the_reference_where_samples_become_fewer() -> None:
    first, second = make_xyz("random", 30, 25, 1), make_xyz("random", 30, 25, 2)
    metric = VDM.sarnoff(300.0, Display.xyz())
    actual = metric(*(torch.from_numpy(image)[None] for image in (first, second)))[0, 0]
    expected = sarnoff.jnd_map(first[1], second[1], 300.0, resample=True)
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-9, atol=1e-9)


def test_only_luminance_counts() -> None:
    # A pair whose X and Z differ and whose Y does not.
    image = torch.from_numpy(make_xyz("random", 20, 20, 5))[None]
    other = image.clone()
    other[:, 0::2] *= 1.7
    assert not VDM.sarnoff(60.0, Display.xyz())(image, other).any()


@pytest.mark.parametrize("octave", range(4))
@pytest.mark.parametrize("angle", [0.0, 90.0])
def test_a_grating_at_threshold_is_about_one_jnd(octave: int, angle: float) -> None:
    # What each weight is made for; neighbouring bands and the pyramid's aliases add a little.
    metric = VDM.sarnoff(60.0, Display.xyz(), resample=False)
    frequency = metric.frequencies[octave]
    contrast = 1.0 / paper.barten(frequency, 100.0, 12.0)
    seen = metric(grating(frequency / 60.0, contrast, angle), grating(0.0, 0.0))
    assert seen[..., 40:88, 40:88].mean().item() == pytest.approx(1.1, abs=0.15)


def test_the_phase_of_a_grating_is_not_seen() -> None:
    # Quadrature pairs: a fine grating's map is even, where one phase alone would swing by 100 %.
    metric = VDM.sarnoff(60.0, Display.xyz(), resample=False)
    seen = metric(grating(8.0 / 60.0, 0.05), grating(0.0, 0.0))[..., 40:88, 40:88]
    assert seen.std() < 0.05 * seen.mean()


@each_grid
@settings(max_examples=12)
@given(
    seed=st.integers(0, 99),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    dtype=st.sampled_from([torch.float64, torch.float32, torch.float16, torch.bfloat16]),
)
def test_equal_images_give_exactly_zero(
    resample: bool, seed: int, height: int, width: int, dtype: torch.dtype
) -> None:
    image = random_images(seed, 2, height, width).to(dtype)
    assert not VDM.sarnoff(resample=resample)(image, image.clone()).any()


@each_grid
def test_both_orders_and_any_batch_give_the_same_map(resample: bool) -> None:
    metric = VDM.sarnoff(resample=resample)
    test, reference = random_images(1, 3), random_images(2, 3)
    seen = metric(test, reference)
    assert seen.shape == (3, 1, 24, 31)
    assert torch.equal(seen, metric(reference, test))
    pairs = zip(test.split(1), reference.split(1), strict=True)
    torch.testing.assert_close(
        seen, torch.cat([metric(*pair) for pair in pairs]), rtol=1e-5, atol=1e-5
    )


@each_grid
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_extreme_light_gives_finite_maps_and_gradients(resample: bool, dtype: torch.dtype) -> None:
    metric = VDM.sarnoff(60.0, Display.linear(1e6), resample=resample)
    image = 100.0 * random_images(1).to(dtype) ** 8 - 0.01
    image.requires_grad_()
    for other in (torch.zeros_like(image), image.detach().clone(), -image.detach()):
        seen = metric(image, other)
        assert torch.isfinite(seen).all()
        (gradient,) = torch.autograd.grad(seen.sum(), image)
        assert torch.isfinite(gradient).all()


def test_the_compiled_route_is_the_same() -> None:
    metric = VDM.sarnoff(30.0)
    test, reference = random_images(1, 2, 40, 50), random_images(2, 2, 40, 50)
    expected = metric(test, reference)
    torch.testing.assert_close(metric.compile()(test, reference), expected, rtol=1e-4, atol=1e-4)


def test_is_one_graph() -> None:
    metric = VDM.sarnoff(60.0)
    test, reference = random_images(1, 1, 5, 6), random_images(2, 1, 5, 6)
    graph = torch.compile(metric, fullgraph=True, backend="eager")
    torch.testing.assert_close(graph(test, reference), metric(test, reference))


def test_large_images_in_bands_of_rows_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    metric = VDM.sarnoff(60.0, resample=False)
    test, reference = random_images(1).double(), random_images(2).double()
    expected = metric(test, reference)
    monkeypatch.setattr("torch_vdm.sarnoff.LARGEST_AT_ONCE", 100)
    torch.testing.assert_close(metric(test, reference), expected, rtol=1e-12, atol=1e-12)


def test_behaves_as_a_module() -> None:
    metric = VDM.sarnoff(60.0, Display.linear(200.0), nonfinite="mask")
    test, reference = random_images(1), random_images(2)
    again = pickle.loads(pickle.dumps(metric))
    assert torch.equal(again(test, reference), metric(test, reference))
    assert metric.half().sensitivities.dtype == torch.float64
    test[0, 1, 3, 4] = math.nan
    assert torch.isfinite(metric(test, reference)).all()
    assert metric(test, reference)[0, 0, 3, 4] == 0.0
    with pytest.raises(ValueError, match="batch item 0"):
        VDM.sarnoff()(test, reference)
    with pytest.raises(ValueError, match="between 1 and 1200"):
        VDM.sarnoff(0.5)
