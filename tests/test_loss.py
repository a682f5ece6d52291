"""The loss: its conventions, its gradient, and that it brings an image back."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_vdm import VDM, Display, Haar, Observer, StationaryHaar, Steerable, VDMLoss
from torch_vdm.loss import DARK_LIGHT
from torch_vdm.model.cortex import Transform
from torch_vdm.run.gradients import by_hand


def images(batch: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    test, reference = torch.rand(2, batch, 3, 13, 18, generator=generator)
    return test, reference


def picture(size: int = 48) -> Tensor:
    """Return a picture of our own, sRGB-coded: a gradient, edges, discs and texture in colour."""
    y, x = torch.meshgrid(*[torch.linspace(0.0, 1.0, size)] * 2, indexing="ij")
    disc = ((x - 0.6) ** 2 + (y - 0.4) ** 2 < 0.06).float()
    texture = 0.5 + 0.5 * torch.sin(50.0 * x) * torch.sin(37.0 * y)
    red = 0.2 + 0.6 * x
    green = 0.3 + 0.4 * disc
    blue = 0.1 + 0.5 * texture * (y > 0.5)
    return torch.stack((red, green, blue)).unsqueeze(0)


def test_is_the_mean_of_the_maps_logarithm_and_l1() -> None:
    test, reference = images()
    observer = dataclasses.replace(Observer.calibrated(), dark_light=DARK_LIGHT)
    power = VDM(40.0, observer=observer)(test, reference).double() ** 2.4
    items = torch.log1p(power).mean((1, 2, 3))
    metric_alone = VDMLoss(40.0, l1=0.0, reduction="none")(test, reference)
    torch.testing.assert_close(metric_alone.double(), items, rtol=1e-4, atol=1e-5)
    l1 = (test - reference).abs().mean((1, 2, 3))
    both = VDMLoss(40.0, l1=7.0, reduction="none")(test, reference)
    torch.testing.assert_close(both, metric_alone + 7.0 * l1)
    torch.testing.assert_close(VDMLoss(40.0, l1=7.0)(test, reference), both.mean())
    torch.testing.assert_close(VDMLoss(40.0, l1=7.0, reduction="sum")(test, reference), both.sum())


def test_mask_weights_pixels() -> None:
    test, reference = images()
    loss = VDMLoss(40.0, reduction="none")
    ones = torch.ones(3, 1, 13, 18)
    torch.testing.assert_close(loss(test, reference, ones), loss(test, reference))
    torch.testing.assert_close(loss(test, reference, 1e-4 * ones), loss(test, reference))
    none = loss(test.requires_grad_(), reference, 0.0 * ones)
    assert not none.any()
    none.sum().backward()
    assert test.grad is not None
    assert not test.grad.any()
    with pytest.raises(ValueError, match=r"mask of shape \(3, 1, 13, 18\), got \(3, 13, 18\)"):
        loss(test, reference, ones[:, 0])


def test_options_are_the_metrics() -> None:
    loss = VDMLoss(30.0, Display.linear(200.0))
    assert loss.metric.ppd == 30.0
    assert loss.metric.display.white == 200.0
    with pytest.raises(ValueError, match='reduction "mean", "sum" or "none", got \'max\''):
        VDMLoss(reduction="max")  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(ValueError, match="l1 of 0 or more, got -1"):
        VDMLoss(l1=-1.0)


def test_is_zero_with_zero_gradient_at_equality() -> None:
    for display in (Display.srgb(), Display.linear(), Display.xyz()):
        test = images()[0].requires_grad_()
        loss = VDMLoss(display=display)(test, test.detach().clone())
        (gradient,) = torch.autograd.grad(loss, test)
        assert loss == 0.0
        assert not gradient.any()


@pytest.mark.parametrize("l1", [0.0, 120.0])
@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_has_a_gradient_from_flat_starts(level: float, l1: float) -> None:
    # From grey and black the printed metric has none: its transducer's slope at 0 is 0.
    reference = picture()
    test = torch.full_like(reference, level).requires_grad_()
    loss = VDMLoss(l1=l1)
    (gradient,) = torch.autograd.grad(loss(test, reference), test)
    assert torch.isfinite(gradient).all()
    assert (gradient.abs() > 0.0).float().mean() > 0.99
    step = 1e-3 * gradient / gradient.abs().max()
    assert loss(test - step, reference) < loss(test, reference)


@pytest.mark.parametrize("l1", [0.0, 3.0])
@pytest.mark.parametrize("display", [Display.srgb(), Display.linear(), Display.xyz()])
def test_gradient_is_that_of_the_formula(display: Display, l1: float) -> None:
    # Away from kinks: two images that differ everywhere.
    generator = torch.Generator().manual_seed(2)
    test, reference = torch.rand(2, 1, 3, 4, 5, dtype=torch.float64, generator=generator) + 0.1
    loss = VDMLoss(20.0, display, l1=l1)
    assert torch.autograd.gradcheck(lambda image: loss(image, reference), test.requires_grad_())
    assert torch.autograd.gradgradcheck(lambda image: loss(image, reference), test)


def starts(reference: Tensor) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    return {
        "noise": torch.rand(reference.shape, generator=generator),
        "grey": torch.full_like(reference, 0.5),
        "black": torch.zeros_like(reference),
        "white": torch.ones_like(reference),
        "shift": reference.roll(8, -1),
    }


@pytest.mark.parametrize("start", ["noise", "grey", "black", "white", "shift"])
@pytest.mark.parametrize("l1", [None, 0.0], ids=["default", "metric alone"])
def test_brings_an_image_back(start: str, l1: float | None) -> None:
    # 300 steps of Adam on the pixels themselves, the rate falling from 0.02 to 0 by a cosine.
    reference = picture()
    image = starts(reference)[start].requires_grad_()
    metric, loss = VDM(), VDMLoss() if l1 is None else VDMLoss(l1=l1)
    before = metric(image.detach(), reference).mean()
    optimizer = torch.optim.Adam([image], lr=0.02)
    for step in range(300):
        for group in optimizer.param_groups:
            group["lr"] = 0.01 * (1.0 + math.cos(math.pi * step / 300))
        optimizer.zero_grad()
        loss(image, reference).backward()
        optimizer.step()
    after = metric(image.detach(), reference)
    assert after.mean() < 0.5 * before
    if l1 is None:
        assert after.max() < 1.0


def test_orders_images_as_the_map_does_near_threshold() -> None:
    # The family: the picture with a grating or noise of seven amplitudes, up to a few JND.
    reference = picture()
    x = torch.arange(48.0)
    noise = torch.randn(reference.shape, generator=torch.Generator().manual_seed(4))
    patterns = [torch.sin(x / n).expand_as(reference) for n in (1.0, 2.0, 5.0)] + [noise]
    tests = [reference + a * p for p in patterns for a in np.geomspace(0.001, 0.03, 7).tolist()]
    jnd = [VDM()(test, reference).mean().item() for test in tests]
    assert 0.02 < min(jnd) < 1.0 < max(jnd) < 5.0
    for weight, least in ((0.0, 0.98), (120.0, 0.9)):
        losses = [VDMLoss(l1=weight)(test, reference).item() for test in tests]
        ranks = np.argsort(np.argsort(jnd)), np.argsort(np.argsort(losses))
        assert np.corrcoef(*ranks)[0, 1] > least, weight


@pytest.mark.parametrize("transform", [Haar(), StationaryHaar(), Steerable()])
def test_a_checkpoint_changes_no_gradient(
    transform: Transform, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In parts and level by level, as a large image is.
    monkeypatch.setattr("torch_vdm.run.schedule.LARGEST_AT_ONCE", 1000)
    monkeypatch.setattr("torch_vdm.run.schedule.FEW_NODES", 16)
    generator = torch.Generator().manual_seed(5)
    test, reference = torch.rand(2, 2, 3, 37, 50, dtype=torch.float64, generator=generator)
    test.requires_grad_()
    gradients: list[Tensor] = []
    kept: list[dict[int, int]] = []

    def keep(tensor: Tensor) -> Tensor:
        kept[-1][tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    for checkpoint in (False, True):
        loss = VDMLoss(transform=transform, checkpoint=checkpoint)
        # Against what autograd keeps: where the gradient is worked out by hand, that is less.
        for module in ("whole", "schedule"):
            now = by_hand if checkpoint else lambda: False
            monkeypatch.setattr(f"torch_vdm.run.{module}.by_hand", now)
        kept.append({})
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            value = loss(test, reference)
        gradients.append(torch.autograd.grad(value, test)[0])
    torch.testing.assert_close(gradients[1], gradients[0], rtol=0.0, atol=1e-12)
    # Not counted: the checkpoints' own arguments, which are details and their scale.
    assert sum(kept[1].values()) < 0.5 * sum(kept[0].values())


def test_a_checkpoint_can_be_differentiated_twice() -> None:
    generator = torch.Generator().manual_seed(2)
    test, reference = torch.rand(2, 1, 3, 3, 4, dtype=torch.float64, generator=generator) + 0.1
    loss = VDMLoss(20.0, checkpoint=True)
    assert torch.autograd.gradcheck(lambda image: loss(image, reference), test.requires_grad_())
    assert torch.autograd.gradgradcheck(lambda image: loss(image, reference), test)


@pytest.mark.parametrize("observer", [Observer.calibrated(), Observer.paper()])
@pytest.mark.parametrize("transform", [Haar(), StationaryHaar(), Steerable()])
def test_derivatives_of_every_transform_are_those_of_the_formula(
    observer: Observer, transform: Transform
) -> None:
    generator = torch.Generator().manual_seed(7)
    test, reference = torch.rand(2, 1, 3, 2, 3, dtype=torch.float64, generator=generator) + 0.1
    loss = VDMLoss(20.0, observer=observer, transform=transform)
    assert torch.autograd.gradcheck(lambda image: loss(image, reference), test.requires_grad_())
    assert torch.autograd.gradgradcheck(lambda image: loss(image, reference), test)


@pytest.mark.parametrize("transform", [Haar(), StationaryHaar("filter")], ids=repr)
def test_the_observer_has_a_name_of_its_own(transform: Transform) -> None:
    observer = VDMLoss(transform=transform).metric.observer
    fitted = Observer.calibrated().fitted_to(transform)
    assert observer.name == "lit room"
    assert observer == dataclasses.replace(fitted, name="lit room", dark_light=DARK_LIGHT)


def test_a_wrong_mask_gives_nan_where_nothing_is_read_back() -> None:
    test, reference = images()
    mask = torch.ones(3, 1, 13, 18)
    mask[1, 0, 2, 3] = -1.0
    loss = VDMLoss(nonfinite="mask", reduction="none")
    assert loss(test, reference, mask).isnan().tolist() == [False, True, False]
    for wrong in (np.ones((3, 1, 13, 18)), 1.0):
        with pytest.raises(ValueError, match=r"mask of shape \(3, 1, 13, 18\), got"):
            loss(test, reference, wrong)


def test_mask_values_are_checked() -> None:
    test, reference = images()
    mask = torch.ones(3, 1, 13, 18)
    for value in (-1.0, float("nan"), float("inf")):
        mask[1, 0, 2, 3] = value
        with pytest.raises(ValueError, match="finite mask values of 0 or more"):
            VDMLoss()(test, reference, mask)
