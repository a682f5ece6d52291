"""Large images, whose finest levels are computed in strips, against the same image whole."""

import pytest
import torch
from torch import Tensor

from tests.ladder import TRANSFORMS
from torch_vdm import VDM, Observer, VDMLoss
from torch_vdm.model.cortex import Transform, bands
from torch_vdm.run import schedule

OBSERVERS = [Observer.calibrated(), Observer.paper()]

# Strips that divide and that do not, odd sides, an image of one strip, lines.
SIZES = [(160, 64), (161, 83), (299, 20), (70, 131), (5, 700), (2100, 1), (1, 2100)]


@pytest.fixture(autouse=True)
def thin_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "STRIP", 1024)
    monkeypatch.setattr(schedule, "BAND_STRIP", 512)
    monkeypatch.setattr(bands, "LARGEST_AT_ONCE", 500)


def whole_images(monkeypatch: pytest.MonkeyPatch) -> None:
    for place, name in ((schedule, "STRIP"), (schedule, "BAND_STRIP"), (bands, "LARGEST_AT_ONCE")):
        monkeypatch.setattr(place, name, 2**40)


def images(size: tuple[int, int], batch: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(sum(size))
    reference = torch.rand(batch, 3, *size, generator=generator, dtype=torch.float64)
    noise = 0.05 * torch.randn(reference.shape, generator=generator, dtype=torch.float64)
    return reference + noise, reference


@pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
@pytest.mark.parametrize("observer", OBSERVERS, ids=lambda o: o.name)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_strips_give_the_map_of_the_whole(
    size: tuple[int, int],
    observer: Observer,
    transform: Transform,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    metric = VDM(observer=observer, transform=transform)
    test, reference = images(size, batch=2)
    in_strips = metric(test, reference)
    whole_images(monkeypatch)
    torch.testing.assert_close(in_strips, metric(test, reference), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_equal_images_give_0_and_the_order_makes_no_difference(size: tuple[int, int]) -> None:
    metric = VDM()
    test, reference = (image.float() for image in images(size))
    assert torch.count_nonzero(metric(reference, reference)) == 0
    assert torch.equal(metric(test, reference), metric(reference, test))


def test_gradients_are_those_of_the_whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    metric = VDM()
    test, reference = images((160, 64))
    test.requires_grad_()
    (gradient,) = torch.autograd.grad(metric.power(test, reference).sum(), test)
    whole_images(monkeypatch)
    (whole,) = torch.autograd.grad(metric.power(test, reference).sum(), test)
    assert torch.equal(gradient, whole)
    assert torch.count_nonzero(gradient) > 0


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_gradients_of_checkpoints_in_strips_are_those_of_the_whole_image(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    test, reference = images(size)
    test.requires_grad_()
    loss = VDMLoss(checkpoint=True)
    (gradient,) = torch.autograd.grad(loss(test, reference), test)
    whole_images(monkeypatch)
    (whole,) = torch.autograd.grad(loss(test, reference), test)
    torch.testing.assert_close(gradient, whole, rtol=1e-9, atol=1e-12)
    assert torch.count_nonzero(gradient) > 0


def test_a_pixel_that_is_not_finite_is_masked_in_its_strip() -> None:
    test, reference = images((160, 64))
    reference[0, 1, 100, 7] = torch.nan
    jnd = VDM(nonfinite="mask")(test, reference)
    assert bool(jnd.isfinite().all())
    assert jnd[0, 0, 100, 7] == 0.0
    assert torch.count_nonzero(jnd) == jnd.numel() - 1
