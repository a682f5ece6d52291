"""Values that are no sRGB codes are told once; what may be a picture is not."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torch_vdm import VDM, Display, VDMLoss
from torch_vdm.metrics import VisualDifference


def picture(low: float = 0.0, high: float = 1.0, size: int = 32) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return low + (high - low) * torch.rand(1, 3, size, size, generator=generator)


WRONG = {
    "bytes": (picture() * 255.0, "from .* to 25.*; divide 8-bit values by 255"),
    "dark bytes": (picture() * 20.0, "from .*divide 8-bit values by 255"),
    "16 bits": (picture() * 65535.0, "from .*divide 8-bit values by 255"),
    "signed": (2.0 * picture() - 1.0, r"from -.*; take \(image \+ 1\) / 2"),
    "signed without black": (2.0 * picture(0.3, 0.9) - 1.0, r"from .*take \(image \+ 1\) / 2"),
    "normalised": ((picture() - 0.45) / 0.22, "from .*undo its normalisation"),
}

RIGHT = {
    "codes": picture(),
    "lobes": picture(-0.09, 1.15),
    "noise": picture() + 0.05 * torch.randn(1, 3, 32, 32, generator=torch.Generator()),
    "overshoot": picture(0.0, 1.9),
}

CALLS: dict[str, Callable[[Tensor, Tensor], object]] = {
    "map": lambda test, reference: VDM()(test, reference),
    "mask": lambda test, reference: VDM(nonfinite="mask")(test, reference),
    "score": lambda test, reference: VDM().score(test, reference),
    "loss": lambda test, reference: VDMLoss()(test, reference),
    "tiles": lambda test, reference: VDM().tiled(test, reference, 16),
    "torchmetrics": lambda test, reference: VisualDifference().update(test, reference),
    "sarnoff": lambda test, reference: VDM.sarnoff()(test, reference),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
@pytest.mark.parametrize(("image", "message"), WRONG.values(), ids=WRONG)
def test_values_that_are_no_codes_are_told(
    call: Callable[[Tensor, Tensor], object], image: Tensor, message: str
) -> None:
    with pytest.warns(UserWarning, match=f"got a test {message}"):
        call(image, image.flip(-1))


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
@pytest.mark.parametrize("image", RIGHT.values(), ids=RIGHT)
def test_what_may_be_a_picture_is_not(
    call: Callable[[Tensor, Tensor], object], image: Tensor
) -> None:
    call(image, image.flip(-1))


def test_light_may_have_any_value() -> None:
    for display in (Display.linear(), Display.xyz()):
        VDM(display=display)(500.0 * picture() - 1.0, 500.0 * picture())


def test_one_image_is_enough_but_for_a_loss() -> None:
    # One that is not trained yet may have any values.
    with pytest.warns(UserWarning, match="got a reference from"):
        VDM()(picture(), 255.0 * picture())
    VDMLoss()(3.0 * torch.randn(1, 3, 32, 32), picture())
    VDMLoss()(picture(), 3.0 * torch.randn(1, 3, 32, 32))


def test_it_is_told_once_and_only_the_first_call_is_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    metric, image = VDM(nonfinite="mask"), 255.0 * picture()
    with pytest.warns(UserWarning, match="only the first call"):
        metric(image, image)
    monkeypatch.setattr("torch_vdm.pair.range_of", lambda _: pytest.fail("values were read again"))
    metric(image, image)


def test_a_transform_of_the_call_reads_nothing() -> None:
    metric, image = VDM(nonfinite="mask"), picture(size=8)
    mapped = torch.vmap(lambda one: metric(one[None], image)[0])(image)
    torch.testing.assert_close(mapped, metric(image, image))
