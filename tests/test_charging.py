"""What is charged to whom: equal places stay at 0, and what fills an image stays as it is."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from tests.conftest import make_xyz, reference_numbers
from tests.ladder import TRANSFORMS
from tests.reference import calibrated
from torch_vdm import VDM, Display, Haar, Observer, StationaryHaar, Steerable, VDMLoss
from torch_vdm.model.charging import charge
from torch_vdm.model.cortex import Transform, bands
from torch_vdm.run import schedule

PPD = 60.0
UNCHARGED = dataclasses.replace(Observer.calibrated(), charging=False)

# So many pixels off what differs, to each side, the map is exactly 0, whatever the image's size.
# Of a level's nodes the finest reach furthest: behind a filter by those near by alone, else by
# what their own details, pooled, and their parents' lowpass are made of.
REACH = {
    Haar(): 5,
    StationaryHaar(): 6,
    Steerable(): 13,
    Haar("filter"): 3,
    StationaryHaar("filter"): 2,
}

each = pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
each_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


def metric_of(transform: Transform, observer: Observer | None = None) -> VDM:
    return VDM(PPD, Display.linear(100.0), observer, transform)


@dataclasses.dataclass(frozen=True)
class Change:
    """A rectangle of an image that is brighter by a contrast, and on what."""

    size: tuple[int, int]
    corner: tuple[int, int]
    sides: tuple[int, int]
    contrast: float
    textured: bool
    dtype: torch.dtype

    def images(self) -> tuple[Tensor, Tensor]:
        """Return test and reference, (1, 3, H, W), linear."""
        reference = torch.full((1, 3, *self.size), 0.5, dtype=self.dtype)
        if self.textured:
            generator = torch.Generator().manual_seed(sum(self.size))
            reference *= 0.02 + 2.0 * torch.rand(reference.shape, generator=generator)
        test = reference.clone()
        (y, x), (height, width) = self.corner, self.sides
        test[..., y : y + height, x : x + width] *= 1.0 + self.contrast
        return test, reference

    def beyond(self, reach: int) -> Tensor:
        """Return where (H, W) a pixel is more than so many off the rectangle."""
        near = torch.zeros(self.size, dtype=torch.bool)
        rows, columns = (
            slice(max(begin - reach, 0), begin + side + reach)
            for begin, side in zip(self.corner, self.sides, strict=True)
        )
        near[rows, columns] = True
        return ~near


@st.composite
def changes(draw: st.DrawFn, longest: int = 90) -> Change:
    """Draw a change: from hardly visible ones to lamps, in images of any size."""
    size = draw(st.tuples(st.integers(1, longest), st.integers(1, longest)))
    height, width = size
    corner = draw(st.tuples(st.integers(0, height - 1), st.integers(0, width - 1)))
    sides = tuple(
        draw(st.integers(1, min(whole - begin, 16)))
        for whole, begin in zip(size, corner, strict=True)
    )
    contrast = 10.0 ** draw(st.floats(-4.0, 6.0))
    textured, double = draw(st.booleans()), draw(st.booleans())
    dtype = torch.float64 if double else torch.float32
    return Change(size, corner, (sides[0], sides[1]), contrast, textured, dtype)


def check(seen: Tensor, change: Change, transform: Transform) -> None:
    """Check a map: the change is seen, and nothing beyond its reach."""
    assert seen.isfinite().all()
    assert seen.max() > 0.0
    assert torch.count_nonzero(seen[0, 0][change.beyond(REACH[transform])]) == 0


@each
@settings(max_examples=30)
@given(change=changes())
def test_nothing_is_seen_where_images_are_equal(transform: Transform, change: Change) -> None:
    check(metric_of(transform)(*change.images()), change, transform)


# At corners and borders of the image, of nodes and of tiles, and across them.
PLACES = [(0, 0), (0, 70), (155, 79), (64, 31), (97, 40)]
CHANGES = [
    Change((161, 83), place, (6, 4), contrast, textured, dtype)
    for place, (contrast, textured), dtype in zip(
        PLACES,
        itertools.cycle([(1e6, True), (0.01, False), (3e3, False)]),
        itertools.cycle([torch.float32, torch.float64]),
        strict=False,
    )
]


@each
def test_nor_in_strips(transform: Transform, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "STRIP", 1024)
    monkeypatch.setattr(schedule, "BAND_STRIP", 512)
    monkeypatch.setattr(bands, "LARGEST_AT_ONCE", 500)
    for change in CHANGES:
        with torch.no_grad():
            check(metric_of(transform)(*change.images()), change, transform)


@each
@pytest.mark.parametrize("tile", [64])
def test_nor_in_tiles(transform: Transform, tile: int) -> None:
    for change in CHANGES:
        test, reference = change.images()
        check(metric_of(transform).tiled(test, reference, tile), change, transform)


@pytest.mark.filterwarnings("ignore:expected sRGB-coded values:UserWarning")
@pytest.mark.parametrize("transform", [Haar(), StationaryHaar("filter")], ids=repr)
def test_nor_by_the_compiled_route(transform: Transform) -> None:
    # Of one dtype and with the options of other tests: each function is compiled once for all.
    fast = VDM(64.0, transform=transform).compile()
    for change in CHANGES[::2]:
        test, reference = change.images()
        seen = fast(test, reference)
        check(seen, change, transform)
        assert torch.equal(seen, fast(reference, test))
        eager = VDM(64.0, transform=transform)(test, reference)
        torch.testing.assert_close(seen, eager, rtol=1e-4, atol=1e-4)


@each
@each_dtype
@pytest.mark.parametrize("contrast", [1e-3, 0.1, 3.0])
def test_a_uniform_change_is_seen_everywhere_the_same(
    transform: Transform, dtype: torch.dtype, contrast: float
) -> None:
    flat = torch.full((1, 3, 61, 90), 0.5, dtype=dtype)
    pair = (1.0 + contrast) * flat, flat
    metric = metric_of(transform)
    alone = VDM(PPD, Display.linear(100.0))(*(image[..., :1, :1] for image in pair)).item()
    for seen in (metric(*pair), metric.tiled(*pair, 16)):
        assert seen.max() - seen.min() <= 1e-6 * seen.max()
        # Of a thousandth, float32 holds no more than the difference of two means does.
        assert seen.mean().item() == pytest.approx(alone, rel=1e-3)


@each
def test_a_brighter_texture_is_seen_everywhere_as_before(transform: Transform) -> None:
    generator = torch.Generator().manual_seed(1)
    texture = 0.5 * (1.0 + 0.1 * torch.randn(1, 3, 96, 96, generator=generator)).double()
    pair = 1.1 * texture, texture
    share = metric_of(transform)(*pair) / metric_of(transform, UNCHARGED)(*pair)
    assert share.min() > 0.99


def noise(channels: int) -> Tensor:
    generator = torch.Generator().manual_seed(channels)
    values = torch.randn(1, channels, 128, 128, generator=generator, dtype=torch.float64)
    return values.expand(1, 3, 128, 128)


def grating(cpd: float, degrees: float) -> Tensor:
    y, x = torch.meshgrid(*2 * (torch.arange(128, dtype=torch.float64) / PPD,), indexing="ij")
    along = x * math.cos(math.radians(degrees)) + y * math.sin(math.radians(degrees))
    return torch.sin(2.0 * math.pi * cpd * along + 0.3).expand(1, 3, 128, 128)


PATTERNS = {
    "white noise": noise(3),
    "grey noise": noise(1),
    "gradient": torch.linspace(-1.0, 1.0, 128, dtype=torch.float64).expand(1, 3, 128, 128),
    "edges": grating(1.8, 0.0).sign(),
    "one edge": (torch.arange(128.0, dtype=torch.float64) - 69.5).sign().expand(1, 3, 128, 128),
} | {
    f"{cpd} cpd, {degrees:.0f} degrees": grating(cpd, degrees)
    for cpd in (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
    for degrees in (0.0, 30.0)
}


@each
@pytest.mark.parametrize("pattern", PATTERNS)
def test_what_fills_the_image_is_seen_as_without_charging(
    transform: Transform, pattern: str
) -> None:
    flat = torch.full((1, 3, 128, 128), 0.5, dtype=torch.float64)
    pair = flat * (1.0 + 0.1 * PATTERNS[pattern]), flat
    charged, all_of_it = (
        metric_of(transform, observer)(*pair) for observer in (Observer.calibrated(), UNCHARGED)
    )
    assert (charged <= all_of_it * (1.0 + 1e-12)).all()
    assert charged.max() >= 0.97 * all_of_it.max()
    if isinstance(transform, Steerable) and pattern == "12.0 cpd, 0 degrees":
        # Of a grating so fine its lowpass has next to nothing, in beats with the samples.
        assert charged.mean() >= 0.9 * all_of_it.mean()
        pytest.xfail("9 % of the mean, for 8 %")
    assert charged.mean() >= 0.92 * all_of_it.mean()


@each
@pytest.mark.parametrize("contrast", [0.05, 1.0])
@pytest.mark.parametrize("column", [25, 45, 70])
def test_the_edge_of_a_half_that_is_equal_loses_little(
    transform: Transform, column: int, contrast: float
) -> None:
    # The half that differs is charged for; at its edge some of what is coarse is lost, up to 13 %.
    flat = torch.full((1, 3, 128, 128), 0.5, dtype=torch.float64)
    test = flat.clone()
    test[..., column:] *= 1.0 + contrast
    charged, all_of_it = (
        metric_of(transform, observer)(test, flat) for observer in (None, UNCHARGED)
    )
    assert charged.max() >= 0.85 * all_of_it.max()
    assert torch.count_nonzero(charged[..., : column - REACH[transform]]) == 0


@each
@each_dtype
@settings(max_examples=8)
@given(change=changes(40))
def test_both_orders_give_the_same_map(
    transform: Transform, dtype: torch.dtype, change: Change
) -> None:
    test, reference = (image.to(dtype) for image in change.images())
    metric = metric_of(transform)
    assert torch.equal(metric(test, reference), metric(reference, test))


@each
@each_dtype
def test_the_batch_does_not_matter(transform: Transform, dtype: torch.dtype) -> None:
    # A lamp in one item takes nothing from the next.
    pairs = [
        Change((45, 37), corner, (3, 5), contrast, True, dtype).images()
        for corner, contrast in (((4, 9), 1e5), ((30, 20), 1e-3), ((0, 0), 1.0))
    ]
    metric = metric_of(transform)
    together = metric(*(torch.cat(images) for images in zip(*pairs, strict=True)))
    for seen, pair in zip(together.split(1), pairs, strict=True):
        alone = metric(*pair)
        torch.testing.assert_close(seen, alone, rtol=1e-5, atol=1e-7)
        assert torch.equal(seen == 0.0, alone == 0.0)


@each
@each_dtype
@settings(max_examples=8)
@given(change=changes(30))
def test_gradients_are_finite(transform: Transform, dtype: torch.dtype, change: Change) -> None:
    test, reference = (image.to(dtype) for image in change.images())
    test.requires_grad_()
    metric, loss = metric_of(transform), VDMLoss(PPD, Display.linear(100.0), transform=transform)
    for value in (metric(test, reference), metric.power(test, reference), loss(test, reference)):
        (gradient,) = torch.autograd.grad(value.sum(), test)
        assert gradient.isfinite().all()
        assert gradient.any()


@each
def test_the_gradient_of_the_power_is_that_of_the_formula(transform: Transform) -> None:
    # Images that are equal in a half, where nothing has a kink: shares are smooth at 0.
    generator = torch.Generator().manual_seed(2)
    test, reference = torch.rand(2, 1, 3, 5, 6, dtype=torch.float64, generator=generator) + 0.1
    test[..., 4:] = reference[..., 4:]
    metric = metric_of(transform)
    # In units in which the map is about 1.
    scale = metric.power(test, reference).max()
    assert torch.autograd.gradcheck(
        lambda image: metric.power(image, reference) / scale, test.requires_grad_()
    )


def of_differences(size: tuple[int, int], share: float) -> NDArray[np.float64]:
    """Return changes of nodes: so many are 0, the others of all sizes."""
    rng = np.random.default_rng(sum(size))
    change = np.exp(rng.normal(0.0, 4.0, size))
    return np.asarray(change * (rng.uniform(size=size) < share))


@pytest.mark.parametrize("shifts", [1, 2])
@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 2), (12, 17)], ids=str)
def test_what_is_charged_is_the_references(
    size: tuple[int, int], share: float, filtered: bool, shifts: int
) -> None:
    change = of_differences(size, share)
    ratios = calibrated.change_ratios(change, shifts)
    for dtype, within in ((torch.float64, 1e-12), (torch.float32, 1e-4)):
        given_plane = torch.from_numpy(change).to(dtype)[None, None]
        charged = charge(given_plane, shifts, filtered)
        expected = np.vectorize(calibrated.inherited_share, [float])(ratios)
        np.testing.assert_allclose(charged.inherited[0, 0].numpy(), expected, rtol=within)
        if not filtered:
            assert charged.own is None
            continue
        assert charged.own is not None
        expected = np.vectorize(calibrated.own_share, [float])(ratios)
        np.testing.assert_allclose(charged.own[0, 0].numpy(), expected, rtol=within)


@settings(max_examples=12)
@given(change=changes(24), seed=st.integers(0, 99))
def test_haars_map_of_images_that_are_equal_in_part_is_the_references(
    change: Change, seed: int
) -> None:
    reference = make_xyz("random", *change.size, seed)
    test = reference.copy()
    (y, x), (height, width) = change.corner, change.sides
    test[:, y : y + height, x : x + width] *= 1.0 + change.contrast
    expected = calibrated.jnd_map(test, reference, PPD, reference_numbers())
    actual = VDM(PPD, Display.xyz())(*(torch.from_numpy(i)[None] for i in (test, reference)))
    np.testing.assert_allclose(actual[0, 0].numpy(), expected, rtol=1e-9, atol=1e-9)


@each
def test_the_papers_observer_charges_nothing(transform: Transform) -> None:
    assert not Observer.paper().charging
    charged = dataclasses.replace(Observer.paper(), charging=True)
    pair = Change((64, 64), (3, 3), (4, 4), 1e4, False, torch.float64).images()
    printed, ours = (metric_of(transform, o)(*pair) for o in (Observer.paper(), charged))
    # At the other corner of the image, as the printed sum has it.
    assert printed[..., -1, -1] > 0.0
    assert ours[..., -1, -1] == 0.0
