"""Arbitrary finite images: map, score, loss and gradients are finite, whatever is chosen."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torch_vdm import VDM, Display, Effects, Haar, Observer, StationaryHaar, Steerable, VDMLoss
from torch_vdm.model.cortex import Transform

EFFECTS = [Effects(*switches) for switches in itertools.product((True, False), repeat=4)]
DISPLAYS = [Display.srgb(), Display.linear(1e4, exposure=-3.0), Display.xyz()]

# Images here are numbers that need be no pictures.
pytestmark = pytest.mark.filterwarnings("ignore:expected sRGB-coded values:UserWarning")

values = st.floats(allow_nan=False, allow_infinity=False, width=32)


@pytest.mark.parametrize(
    "transform", [Haar(), StationaryHaar(), Steerable()], ids=lambda t: type(t).__name__
)
@pytest.mark.parametrize(
    "observer", [Observer.calibrated(), Observer.paper()], ids=lambda o: o.name
)
@given(
    size=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    drawn=st.lists(values, min_size=1, max_size=12),
    seed=st.integers(0, 999),
    effects=st.sampled_from(EFFECTS),
    display=st.sampled_from(DISPLAYS),
)
def test_finite_images_stay_finite(
    transform: Transform,
    observer: Observer,
    size: tuple[int, int],
    drawn: list[float],
    seed: int,
    effects: Effects,
    display: Display,
) -> None:
    # Pixels are drawn from the few values, so that equal and extreme ones meet.
    places = torch.randint(
        len(drawn), (2, 1, 3, *size), generator=torch.Generator().manual_seed(seed)
    )
    test, reference = torch.tensor(drawn, dtype=torch.float32)[places]
    test.requires_grad_()
    options = {"observer": observer, "transform": transform, "effects": effects}
    metric, loss = VDM(60.0, display, **options), VDMLoss(60.0, display, **options)  # type: ignore[arg-type]  # a dictionary for brevity
    for value in (metric(test, reference), metric.score(test, reference), loss(test, reference)):
        assert value.isfinite().all()
        (gradient,) = torch.autograd.grad(value.sum(), test)
        assert gradient.isfinite().all()
