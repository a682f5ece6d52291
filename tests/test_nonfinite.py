"""Pixels that are not finite: masked, they hide nothing around them."""

import pytest
import torch
from torch import Tensor

from torch_vdm import VDM, Display, Haar, StationaryHaar, VDMLoss
from torch_vdm.images import finite_in_both
from torch_vdm.model.cortex import Transform


def images(size: int = 96) -> tuple[Tensor, Tensor]:
    """Return grey with faint stripes, and grey."""
    reference = torch.full((1, 3, size, size), 0.6)
    return reference + 0.04 * ((torch.arange(size) // 4) % 2 - 0.5), reference


@pytest.mark.parametrize("transform", [Haar(), StationaryHaar("filter")], ids=repr)
@pytest.mark.parametrize("where", ["test", "reference", "both"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_lies_beside_masked_pixels_is_seen_as_ever(
    transform: Transform, where: str, value: float
) -> None:
    test, reference = images()
    metric = VDM(transform=transform, nonfinite="mask")
    clean = metric(test, reference)
    middle = slice(44, 52)
    for name, image in (("test", test), ("reference", reference)):
        if where in (name, "both"):
            image[..., middle, middle] = value
    jnd = metric(test, reference)
    assert not jnd[..., middle, middle].any()
    around = torch.zeros(96, 96, dtype=torch.bool)
    around[36:60, 36:60] = True
    around[middle, middle] = False
    # Black in both, they took 65 % of it behind a filter. What the reference lacks it has from the
    # test: stripes, which hide the same beside them, in both images.
    found, expected = (plane[0, 0][around].mean().item() for plane in (jnd, clean))
    assert found == pytest.approx(expected, rel=0.1 if where == "reference" else 0.06)


def test_the_value_that_one_image_has_is_taken_for_both() -> None:
    test, reference = torch.rand(2, 1, 3, 9, 7)
    one, other = test.clone(), reference.clone()
    one[0, 1, 2, 3] = torch.nan
    other[0, :, 5, 6] = torch.inf
    first, second, seen = finite_in_both(one, other)
    assert int((~seen).sum()) == 2
    for image in (first, second):
        assert torch.equal(image[0, :, 2, 3], reference[0, :, 2, 3])
        assert torch.equal(image[0, :, 5, 6], test[0, :, 5, 6])
    assert torch.equal(torch.where(seen, first, 0.0), torch.where(seen, test, 0.0))


def test_what_no_image_has_is_the_mean_around_it() -> None:
    image = torch.rand(1, 3, 16, 16)
    lost = image.clone()
    lost[..., 4, 4] = torch.nan
    lost[..., 8:12, 8:12] = torch.nan
    filled, again, _ = finite_in_both(lost, lost.clone())
    assert torch.equal(filled, again)
    corner = image[..., 4:6, 4:6].sum((-2, -1)) - image[..., 4, 4]
    torch.testing.assert_close(filled[..., 4, 4], corner / 3.0)
    block = image[..., 8:16, 8:16].sum((-2, -1)) - image[..., 8:12, 8:12].sum((-2, -1))
    torch.testing.assert_close(filled[..., 9, 10], block / 48.0)
    # Squares at the border are smaller, and no pixel counts for more than another.
    image = torch.rand(1, 3, 5, 7, dtype=torch.float64)
    lost = image.clone()
    lost[..., 4, :5] = lost[..., :4, 4] = torch.nan
    filled, *_ = finite_in_both(lost, lost)
    mean = (image[..., :4, :4].sum((-2, -1)) + image[..., :, 5:].sum((-2, -1))) / 26.0
    torch.testing.assert_close(filled[..., 4, 0], mean)
    nothing = torch.full((1, 3, 5, 5), torch.nan)
    assert not VDM(nonfinite="mask")(nothing, nothing).any()


@pytest.mark.parametrize("transform", [Haar(), StationaryHaar("filter")], ids=repr)
def test_tiles_give_what_the_whole_image_gives(transform: Transform) -> None:
    generator = torch.Generator().manual_seed(4)
    test, reference = torch.rand(2, 1, 3, 150, 133, generator=generator)
    for image in (test, reference):
        image[..., 30:75, 20:90] = torch.nan
        image[..., 100, 64] = torch.inf
    metric = VDM(display=Display.linear(), transform=transform, nonfinite="mask")
    expected = metric(test, reference)
    torch.testing.assert_close(metric.tiled(test, reference, 32), expected, rtol=1e-3, atol=1e-3)


def test_gradients_are_finite_and_none_reaches_masked_pixels() -> None:
    test, reference = torch.rand(2, 1, 3, 20, 20)
    test[..., 3:9, 3:9] = torch.nan
    reference[..., 5:12, 5:12] = torch.inf
    VDMLoss(nonfinite="mask")(test.requires_grad_(), reference).backward()
    assert test.grad is not None
    assert test.grad.isfinite().all()
    assert not test.grad[..., 3:12, 3:12][..., 2:7, 2:7].any()
