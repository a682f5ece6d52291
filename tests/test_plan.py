"""What is left out of a pair: nothing that shows."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torch_vdm import VDM, Display, Effects, Haar, Observer, StationaryHaar, Steerable
from torch_vdm import plan as plans
from torch_vdm.model.cortex import Transform
from torch_vdm.plan import Plan
from torch_vdm.run import regions

TRANSFORMS = [Haar(), Haar("filter"), StationaryHaar(), StationaryHaar("filter"), Steerable()]
each = pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)

# The law: auto differs from full by no more anywhere, JND. By rounding alone, it is far less.
MOST = 1e-4


@pytest.fixture(autouse=True)
def small_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    # Tiles and squares of large images, on small ones.
    for module, name, value in (
        (plans, "SMALLEST", 1),
        (plans, "ROWS", 2),
        (regions, "SMALLEST", 2),
    ):
        monkeypatch.setattr(module, name, value)


def picture(*size: int, seed: int = 1) -> Tensor:
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed))


def both(transform: Transform, test: Tensor, reference: Tensor, **options: object) -> Plan:
    """Hold auto to full, and return the plan."""
    auto, full = (
        VDM(30.0, transform=transform, effects=effects, **options)  # type: ignore[arg-type]  # any
        for effects in ("auto", "full")
    )
    for pair in ((test, reference), (reference, test)):
        torch.testing.assert_close(auto(*pair), full(*pair), rtol=0.0, atol=MOST)
    # Where nothing differs around, exactly nothing.
    assert full.plan(test, reference).whole
    return auto.plan(test, reference)


@each
def test_local_edits(transform: Transform) -> None:
    reference = picture(1, 3, 117, 150)
    test = reference.clone()
    # In a corner, at two borders, across tiles; an HDR lamp, a single pixel.
    test[..., :5, :3] += 0.2
    test[..., 60:75, 140:] *= 0.9
    test[..., 116:, 40:43] = 0.0
    test[..., 30, 70] += 0.01
    plan = both(transform, test, reference)
    levels = transform.csf == "levels"
    assert (plan.differing[0] is not None) == levels
    assert ("the fine levels are computed in" in str(plan.reasons())) == levels
    # The coarse levels go on from the whole image: nothing is left out twice.
    test[..., :5, :3] = 1e6
    both(transform, test, reference, display=Display.linear(100.0))


@each
@settings(max_examples=12)
@given(
    seed=st.integers(0, 99),
    height=st.integers(1, 60),
    width=st.integers(1, 60),
    y=st.integers(0, 59),
    x=st.integers(0, 59),
    side=st.integers(1, 9),
    by=st.sampled_from([1e-3, 0.1, -0.3, 5.0]),
)
def test_edits_anywhere(
    transform: Transform,
    seed: int,
    height: int,
    width: int,
    y: int,
    x: int,
    side: int,
    by: float,
) -> None:
    reference = picture(2, 3, height, width, seed=seed)
    test = reference.clone()
    test[1, :, y : y + side, x : x + side] += by
    plan = both(transform, test, reference, display=Display.linear(100.0))
    assert plan.equal[0]


@each
@pytest.mark.parametrize(
    "display", [Display.srgb(), Display.linear(5000.0), Display.xyz()], ids=lambda d: d.encoding
)
@pytest.mark.parametrize("size", [(1, 1), (5, 2), (64, 47)])
@pytest.mark.parametrize(
    "observer", [Observer.calibrated(), Observer.paper()], ids=lambda observer: observer.name
)
def test_grey_pairs(
    observer: Observer, size: tuple[int, int], display: Display, transform: Transform
) -> None:
    test, reference = (picture(2, 1, *size, seed=s).expand(-1, 3, -1, -1) for s in (1, 2))
    # Light and dark, and black.
    test, reference = ((image**4 * (image > 0.3)).contiguous() for image in (test, reference))
    plan = both(transform, test, reference, display=display, observer=observer)
    assert plan.grey
    assert "grey" in str(plan.reasons())


@each
def test_a_trace_of_colour_is_kept(transform: Transform) -> None:
    grey = picture(1, 1, 64, 64).expand(-1, 3, -1, -1)
    for trace in ("one blue pixel", "a faint cast of low frequency", "colour in the reference"):
        test, reference = grey.clone(), (0.9 * grey).clone()
        if trace == "one blue pixel":
            test[:, 2, 33, 17] += 1e-6
        elif trace == "colour in the reference":
            reference[:, 0, 0, 0] += 0.1
        else:
            test[:, 2] += 1e-4 * torch.linspace(0.0, 1.0, 64)
        assert not both(transform, test, reference).grey, trace


@each
def test_below_0_is_no_grey(transform: Transform) -> None:
    image = picture(1, 1, 20, 20).expand(-1, 3, -1, -1).contiguous()
    test = image.clone()
    test[..., 3, 4] = -0.1
    assert not both(transform, test, image, display=Display.linear(100.0)).grey


def test_one_item_differs_in_a_corner() -> None:
    reference = picture(3, 3, 70, 70)
    test = reference.clone()
    test[1, :, -1, -1] += 0.5
    plan = both(Haar(), test, reference)
    assert plan.equal == (True, False, True)
    assert plan.reasons() == [
        "nothing is computed of batch items 0, 2: its two images are equal",
        "the fine levels of batch item 1 are computed in 1% of the image: elsewhere the two are "
        "equal",
    ]
    assert plan.data()["computed_fraction"] == [0.0, pytest.approx(1 / 81), 0.0]


def test_what_is_asked_for_is_done() -> None:
    grey = picture(1, 1, 20, 20).expand(-1, 3, -1, -1).contiguous()
    pair = grey, (0.5 * grey).contiguous()
    assert VDM().plan(*pair).grey
    assert VDM(effects="auto").plan(*pair).grey
    for effects in ("full", Effects(), Effects(masking=False)):
        assert VDM(effects=effects).plan(*pair).whole
    # Where a gradient is wanted, numbers are not read back, or somebody else makes the graph.
    assert VDM(nonfinite="mask").plan(*pair).whole
    assert VDM().plan(pair[0].clone().requires_grad_(), pair[1]).whole
    assert VDM().compile().plan(*pair).whole
    # What the paper's observer sees of a coarse difference it sees in all pixels below.
    local = grey.clone()
    local[..., 3, 3] += 0.1
    assert VDM.paper().plan(local, grey).differing == (None,)
    with pytest.raises(ValueError, match='expected effects "auto" or "full", got'):
        VDM(effects="some")  # type: ignore[arg-type]  # wrong on purpose


@each
@pytest.mark.parametrize("way", ["eager", "compiled", "mask"])
def test_a_plan_of_grey_pairs_that_is_passed_in(transform: Transform, way: str) -> None:
    if way == "compiled" and transform != Haar():
        pytest.skip("one transform is enough of the compiler's time")
    test, reference = (picture(2, 1, 45, 70, seed=seed) for seed in (1, 2))
    pair = [image.expand(-1, 3, -1, -1).contiguous() for image in (test, reference)]
    auto = VDM(30.0, transform=transform)
    plan = auto.plan(*pair)
    assert plan.grey
    full, given = (
        VDM(
            30.0,
            transform=transform,
            effects=effects,
            nonfinite="mask" if way == "mask" else "raise",
        )
        for effects in ("full", plan)
    )
    assert "grey" in repr(given)
    if way == "compiled":
        given.compile()
    assert given.plan(*pair).grey
    torch.testing.assert_close(given(*pair), full(*pair), rtol=0.0, atol=MOST)
    # Of the one plane that all three channels come from, the gradient is that of everything.
    gradients = []
    for metric in (given, full):
        plane = test.clone().requires_grad_()
        metric.power(plane.expand(-1, 3, -1, -1), pair[1]).sum().backward()
        gradients.append(plane.grad)
    largest = float(gradients[1].abs().max())  # type: ignore[union-attr]  # it is there
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-4 * largest)


def test_a_plan_of_grey_pairs_is_for_grey_pairs() -> None:
    grey = picture(1, 1, 20, 30).expand(-1, 3, -1, -1)
    metric = VDM(effects=VDM(effects=Effects(pooling=False)).plan(grey, 0.5 * grey))
    # An `Effects` leaves nothing out, and so does its plan; a grey one keeps its effects.
    assert not metric.plan(grey, 0.5 * grey).grey
    assert not metric.effects.pooling
    metric = VDM(effects=VDM().plan(grey, 0.5 * grey))
    coloured = grey.clone()
    coloured[:, 2, 7, 9] += 0.01
    with pytest.raises(
        ValueError, match=r'expected grey images, .* got colours; take effects="auto"'
    ):
        metric(coloured, grey)
