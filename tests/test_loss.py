"""The loss: its conventions, and that it moves an image from where the printed metric does not."""

import pytest
import torch

from torch_vdm import VDM, Display, VDMLoss


def images(batch: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    test, reference = torch.rand(2, batch, 3, 13, 18, generator=generator)
    return test, reference


def test_reductions_agree_with_the_map() -> None:
    test, reference = images()
    power = VDM(40.0)(test, reference).pow(2.4).mean((1, 2, 3))
    items = VDMLoss(40.0, reduction="none")(test, reference)
    torch.testing.assert_close(items, power, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(VDMLoss(40.0)(test, reference), items.mean())
    torch.testing.assert_close(VDMLoss(40.0, reduction="sum")(test, reference), items.sum())


def test_options_are_the_metrics() -> None:
    loss = VDMLoss(30.0, Display.linear(200.0))
    assert loss.metric.ppd == 30.0
    assert loss.metric.display.white == 200.0
    with pytest.raises(ValueError, match='reduction "mean", "sum" or "none", got \'max\''):
        VDMLoss(reduction="max")  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_has_a_gradient_from_flat_starts(level: float) -> None:
    # From grey and black the printed metric has none: its transducer's slope at 0 is 0.
    _, reference = images(1)
    test = torch.full_like(reference, level).requires_grad_()
    (gradient,) = torch.autograd.grad(VDMLoss()(test, reference), test)
    assert torch.isfinite(gradient).all()
    assert (gradient.abs() > 0.0).float().mean() > 0.99
    (step,) = torch.autograd.grad(VDMLoss()(test, reference), test)
    smaller = VDMLoss()(test - 1e-3 * step / step.abs().max(), reference)
    assert smaller < VDMLoss()(test, reference)


def test_gradient_is_that_of_the_formula() -> None:
    # Away from kinks: two images that differ everywhere.
    generator = torch.Generator().manual_seed(2)
    test, reference = torch.rand(2, 1, 3, 4, 5, dtype=torch.float64, generator=generator)
    loss = VDMLoss(20.0)
    assert torch.autograd.gradcheck(lambda image: loss(image, reference), test.requires_grad_())
