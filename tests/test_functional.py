"""The functions against the modules behind them."""

from typing import Any

import pytest
import torch
from torch import Tensor

from torch_vdm import VDM, Display, Observer, VDMLoss
from torch_vdm.functional import visual_difference, visual_difference_loss


def images() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    test, reference = torch.rand(2, 2, 3, 14, 17, generator=generator)
    return test, reference


def test_the_map_is_the_modules() -> None:
    assert torch.equal(visual_difference(*images()), VDM()(*images()))
    options: dict[str, Any] = {"display": Display.linear(200.0), "observer": Observer.paper()}
    expected = VDM(30.0, **options)(*images())
    for _ in range(2):
        assert torch.equal(visual_difference(*images(), 30.0, **options), expected)


def test_the_loss_is_the_modules_with_its_gradient() -> None:
    test, reference = images()
    mask = torch.ones(2, 1, 14, 17)
    mask[..., :5] = 0.0
    ours = visual_difference_loss(test.requires_grad_(), reference, 40.0, mask, l1=3.0)
    modules = VDMLoss(40.0, l1=3.0)(test, reference, mask)
    slope, expected = (torch.autograd.grad(loss, test)[0] for loss in (ours, modules))
    assert torch.equal(slope, expected)
    assert visual_difference_loss(test, reference, reduction="none").shape == (2,)


def test_what_is_wrong_is_told_as_the_modules_tell_it() -> None:
    test, reference = images()
    with pytest.raises(ValueError, match="pixels per degree between"):
        visual_difference(test, reference, 0.0)
    with pytest.raises(ValueError, match="two images of one shape"):
        visual_difference(test, reference[..., 1:])
