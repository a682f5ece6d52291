"""StationaryHaar and Steerable against the NumPy reference, and what holds of every transform."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from tests.conftest import KINDS, make_xyz, reference_numbers
from tests.ladder import FILTERED, TRANSFORMS
from tests.reference import calibrated, transforms
from tests.reference.paper import cone_fundamentals
from torch_vdm import VDM, Display, Haar, Observer, StationaryHaar, Steerable, VDMLoss
from torch_vdm.model.cortex import Transform, bands
from torch_vdm.run import schedule

PPD = 64.0
OVERLAPPING: list[Transform] = [StationaryHaar(), Steerable(), StationaryHaar("filter")]
SIZES = [(1, 1), (1, 9), (6, 1), (8, 8), (13, 21)]


def name(transform: Transform) -> str:
    return type(transform).__name__ + ("-filter" if transform.csf == "filter" else "")


each = pytest.mark.parametrize("transform", TRANSFORMS, ids=name)
each_observer = pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
each_filtered = pytest.mark.parametrize("transform", FILTERED, ids=name)
each_overlapping = pytest.mark.parametrize("transform", OVERLAPPING, ids=name)


@each
@each_observer
@pytest.mark.parametrize("size", [(37, 5), (5, 37), (33, 32)], ids=str)
def test_levels_at_once_are_levels_one_by_one(
    size: tuple[int, int],
    observer: Observer,
    transform: Transform,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    metric = VDM(PPD, observer=observer, transform=transform)
    test, reference = (random_images(seed, 2, *size).double() for seed in (1, 2))
    at_once = metric(test, reference)
    monkeypatch.setattr(schedule, "FEW_NODES", 0)
    torch.testing.assert_close(at_once, metric(test, reference), rtol=1e-12, atol=1e-12)


def random_images(seed: int, batch: int = 1, height: int = 24, width: int = 31) -> Tensor:
    return torch.rand(batch, 3, height, width, generator=torch.Generator().manual_seed(seed))


def grating(
    cycles: float, contrast: float, phase: float = 0.0, angle: float = 0.0, size: int = 128
) -> Tensor:
    """Return a grating (1, 3, size, size), linear, mean 0.5, ``cycles`` a pixel."""
    y, x = torch.meshgrid(*2 * (torch.arange(size, dtype=torch.float64),), indexing="ij")
    along = x * math.cos(math.radians(angle)) + y * math.sin(math.radians(angle))
    wave = torch.sin(2.0 * math.pi * cycles * along + phase)
    return (0.5 * (1.0 + contrast * wave)).expand(1, 3, size, size).contiguous()


def metric_of(transform: Transform, observer: Observer | None = None) -> VDM:
    return VDM(PPD, Display.linear(200.0), observer, transform)


def reference_levels(
    transform: Transform, plane: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    if isinstance(transform, StationaryHaar):
        return transforms.stationary_haar(plane)
    return transforms.steerable(plane, [transform.peaks(level)[0][0] for level in range(8)])


def reference_map(
    transform: Transform, test: NDArray[np.float64], reference: NDArray[np.float64]
) -> NDArray[np.float64]:
    numbers = reference_numbers(transform)
    if transform == Haar("filter"):
        return transforms.filtered_haar_map(test, reference, PPD, numbers)
    kind = "stationary" if isinstance(transform, StationaryHaar) else "steerable"
    kind = "filtered" if transform.csf == "filter" else kind
    peaks = [transform.peaks(level)[0] for level in range(8)]
    return transforms.jnd_map(test, reference, PPD, kind, peaks, numbers)


@pytest.mark.parametrize("transform", [StationaryHaar(), Steerable()], ids=name)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES)
def test_is_the_reference(transform: Transform, kind: str, size: tuple[int, int]) -> None:
    planes = make_xyz(kind, *size, 3)[:2]
    actual = transform.decompose(torch.from_numpy(planes)[None], true_means=True)
    levels = len(actual.details)
    atol = 1e-13 * float(np.abs(planes).max())
    for cone, plane in enumerate(planes):
        expected = reference_levels(transform, plane)
        assert len(expected) == levels
        for level, (details, lowpass) in enumerate(expected):
            at = levels - 1 - level
            ours = actual.details[at][0, cone].numpy()
            np.testing.assert_allclose(ours, details, rtol=1e-9, atol=atol)
            if not actual.lowpass:  # of overlapping nodes on a filtered image, which need none
                continue
            ours = actual.lowpass[at][0, cone].numpy()
            np.testing.assert_allclose(ours, lowpass, rtol=1e-9, atol=atol)


@pytest.mark.parametrize("transform", [*OVERLAPPING, Haar("filter")], ids=name)
@pytest.mark.parametrize("kind", ["random", "hdr", "dark", "negative"])
@pytest.mark.parametrize("size", [(1, 1), (7, 10)])
def test_the_map_is_the_references(transform: Transform, kind: str, size: tuple[int, int]) -> None:
    first, second = make_xyz(kind, *size, 1), make_xyz("random", *size, 2)
    # In a part they are equal: there a node is charged little of what its parent has.
    second[:, : size[0] // 2, 3:] = first[:, : size[0] // 2, 3:]
    metric = VDM(PPD, Display.xyz(), transform=transform)
    images = [torch.from_numpy(image)[None] for image in (first, second)]
    expected = reference_map(transform, first, second)
    np.testing.assert_allclose(metric(*images)[0, 0].numpy(), expected, rtol=1e-9, atol=1e-9)
    single = metric(*(image.float() for image in images))[0, 0].double().numpy()
    np.testing.assert_allclose(single, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("level", range(6))
def test_the_diagonal_wavelet_has_the_peak_of_the_reference(level: int) -> None:
    straight, _, diagonal = StationaryHaar().peaks(level)
    assert straight == Haar().peak(level)
    np.testing.assert_allclose(diagonal, transforms.diagonal_peak(level), rtol=1e-9)
    for transform in FILTERED:
        gain = transforms.diagonal_share() * straight[1]
        np.testing.assert_allclose(transform.peaks(level)[2], (straight[0], gain), rtol=1e-9)


@each_filtered
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (13, 21)])
def test_the_filter_is_the_reference(
    transform: Transform, kind: str, size: tuple[int, int]
) -> None:
    image = make_xyz(kind, *size, 1)
    seen = VDM(PPD, Display.xyz(), transform=transform).represent(torch.from_numpy(image)[None])
    weighted = transforms.weighted_contrast(image, PPD, reference_numbers(transform))
    largest = float(np.abs(weighted).max())
    if isinstance(transform, Haar):
        details = calibrated.cortex_filtering(weighted).details
        expected = [np.moveaxis(level, 0, 1) for level in details]
    else:
        planes = [transforms.stationary_haar(channel) for channel in weighted]
        expected = [np.stack([p[0] for p in level]) for level in zip(*planes, strict=True)][::-1]
    assert len(seen.details) == len(expected)
    for ours, theirs in zip(seen.details, expected, strict=True):
        np.testing.assert_allclose(ours[0].numpy(), theirs, rtol=1e-9, atol=1e-12 * largest + 1e-11)
    mean = cone_fundamentals(image).mean((1, 2))
    np.testing.assert_allclose(seen.mean[0, :, 0, 0].numpy(), mean, rtol=1e-9)


def test_bands_add_up_to_the_image() -> None:
    # The pyramid telescopes; what is left is one number, its coarsest lowpass.
    image = random_images(4, 2, 21, 40).double()
    planes, here = [], image
    for scale in range(6):
        some, _, here = bands.parted(here, scale == 0)
        planes.append(torch.stack(some).sum(0))
    left = image - bands.gathered(planes)
    torch.testing.assert_close(left, here.expand_as(left))


@pytest.mark.parametrize("frequency", bands.frequencies()[:5])
def test_the_weights_of_bands_pass_a_grating_with_its_sensitivity(frequency: float) -> None:
    # A curve as steep as the eye's, at the bands' own frequencies.
    def curve(cycles: float) -> float:
        return float(np.exp(-((np.log2(cycles / 0.06) / 2.0) ** 2)))

    wanted = np.array([curve(cycles) for cycles in bands.frequencies()])
    weights = np.array(bands.weights()) @ wanted
    passed = sum(float(w) * bands.share(k, frequency) for k, w in enumerate(weights))
    assert passed == pytest.approx(curve(frequency), rel=1e-9)


@pytest.mark.parametrize(("luminance", "within"), [(200.0, 1.2), (1.0, 2.5)])
@pytest.mark.parametrize("cpd", [1.3, 3.0, 5.0, 9.0])
def test_a_filtered_grating_has_its_contrast_sensitivity(
    cpd: float, luminance: float, within: float
) -> None:
    # The whole filter on an image: what the observer's formula gives. In the dark the sensitivity
    # falls faster than bands an octave apart can follow.
    metric = VDM(PPD, Display.linear(luminance), transform=Haar("filter"))
    light = grating(cpd / PPD, 0.01, 0.4, size=256)
    to_cones = metric.get_buffer("cones") @ metric.get_buffer("primaries")
    planes = torch.einsum("ij,bjhw->bihw", to_cones, luminance * light)
    seen = metric.model(planes.dtype).filtered(planes)[0, 0, 96:160, 96:160]
    amplitude = float(seen.square().mean().sqrt()) * math.sqrt(2.0)
    mean = 0.5 * luminance
    numbers = reference_numbers(Haar("filter"))
    expected = 1.0147 * 0.01 * calibrated.sensitivity(cpd, mean, numbers)[0]
    assert abs(20.0 * math.log10(amplitude / expected)) < within


def test_no_other_place_for_the_contrast_sensitivity() -> None:
    for transform in (Haar, StationaryHaar):
        with pytest.raises(ValueError, match="expected csf"):
            transform("before")  # type: ignore[arg-type]


@pytest.mark.parametrize("level", range(5))
def test_the_peak_of_steerable_is_that_of_its_response(level: int) -> None:
    # The mean energy of gratings around it, decomposed: greatest at the stated one, and 1 there.
    best, gain = Steerable().peaks(level)[0]
    assert gain == 1.0
    size = 64 * 2**level

    def energy(cycles: float) -> float:
        x = torch.arange(size, dtype=torch.float64)
        wave = torch.cos(2.0 * math.pi * cycles * x + 0.4).expand(1, 1, 8 * 2**level, size)
        details = Steerable().decompose(wave.contiguous()).details[-1 - level][0, 0, :2]
        inner = details[..., 16:-16]
        return inner.square().sum(0).mean().item()

    assert energy(best) == pytest.approx(1.0, rel=0.03)
    assert energy(best) > max(energy(0.93 * best), energy(1.07 * best))


@each
def test_flat_images_have_no_details(transform: Transform) -> None:
    cortex = transform.decompose(torch.full((1, 3, 21, 10), 0.3))
    assert max(details.abs().max() for details in cortex.details) < 1e-6
    for lowpass in cortex.lowpass:
        torch.testing.assert_close(lowpass, torch.full_like(lowpass, 0.3))


@each
def test_is_linear(transform: Transform) -> None:
    one, other = random_images(1).double(), random_images(2).double()
    mixed = transform.decompose(2.0 * one - 3.0 * other, true_means=True)
    parts = [transform.decompose(image, true_means=True) for image in (one, other)]
    for whole, first, second in zip(mixed.details, *(p.details for p in parts), strict=True):
        torch.testing.assert_close(whole, 2.0 * first - 3.0 * second)


@each
@pytest.mark.parametrize("level", range(5))
@pytest.mark.parametrize("angle", [0.0, 90.0])
def test_a_grating_lands_in_its_level(transform: Transform, level: int, angle: float) -> None:
    best, _ = transform.peaks(level)[0]
    details = transform.decompose(grating(best, 1.0, 0.4, angle)).details[::-1]
    energies = []
    for finer, planes in enumerate(details):
        gain = transform.peaks(finer)[0][1]
        pairs = planes[0, 0].square().mean((1, 2)).unflatten(0, (-1, transform.phases)).sum(1)
        energies.append(pairs / gain**2)
    strongest = torch.stack(energies).sum(1)
    assert strongest.argmax() == level
    # And in its orientation: d1 or 0 degrees, d2 or 90.
    upright = 0 if angle == 0.0 else 1 if isinstance(transform, Haar | StationaryHaar) else 2
    assert energies[level].argmax() == upright


def test_every_shift_of_a_node_is_a_haar_decomposition() -> None:
    # Each of the four sets of nodes, side by side, is that of Haar on a shifted image.
    image = torch.randn(
        1, 1, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    shifted = StationaryHaar().decompose(image).details
    for level in (1, 2, 3):
        quarter = 2 ** (level - 1)
        for y, x, down, right in ((0, 0, 0, 0), (0, 1, 1, 3), (1, 0, 2, 1), (1, 1, 3, 2)):
            rolled = image[..., down * quarter :, right * quarter :]
            expected = Haar().decompose(rolled).details
            ours = shifted[-1 - level][..., y::2, x::2]
            inner = ours[..., : ours.shape[-2] - 1, : ours.shape[-1] - 1]
            other = expected[-1 - level][..., : inner.shape[-2], : inner.shape[-1]]
            torch.testing.assert_close(inner, other)


@each_overlapping
@pytest.mark.parametrize("level", range(3))
def test_a_shift_of_the_image_shifts_a_level(transform: Transform, level: int) -> None:
    # By one node of a level every finer one is shifted too, away from the border.
    step = 2 * 2**level
    generator = torch.Generator().manual_seed(3)
    image = torch.randn(1, 1, 96, 96, dtype=torch.float64, generator=generator)
    moved = torch.roll(image, (step, step), (2, 3))
    for finer in range(level + 1):
        one, other = (transform.decompose(i).details[-1 - finer] for i in (image, moved))
        by, edge = step // 2**finer, 48 // 2**finer // 2
        one = torch.roll(one, (by, by), (3, 4))[..., edge:-edge, edge:-edge]
        torch.testing.assert_close(one, other[..., edge:-edge, edge:-edge])


@each_overlapping
def test_an_even_shift_shifts_the_map(transform: Transform) -> None:
    # A fine texture: what is seen lies in levels whose nodes the shift of 8 moves by whole ones.
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(1, 1, 128, 128, generator=generator)
    fine = (noise - torch.nn.functional.avg_pool2d(noise, 5, 1, 2)).expand(1, 3, 128, 128)
    flat = torch.full((1, 3, 128, 128), 0.5)
    window = torch.zeros(128, 128)
    window[48:80, 48:80] = 0.02

    def moved_by(transform: Transform, shift: int) -> float:
        """Return how much the map of a shifted texture differs from the shifted map, relative."""
        metric = VDM(16.0, Display.linear(200.0), transform=transform)
        seen = metric(flat + window * fine, flat)
        shifted = torch.roll(flat + window * fine, (shift, shift), (2, 3))
        difference = torch.roll(seen, (shift, shift), (2, 3)) - metric(shifted, flat)
        inner = slice(32, 96), slice(32, 96)
        return float(difference[0, 0][inner].abs().mean() / seen[0, 0][inner].mean())

    assert moved_by(transform, 8) < 0.02
    assert moved_by(transform, 2) < min(0.04, 0.6 * moved_by(Haar(), 2))


@each
def test_the_batch_does_not_matter(transform: Transform) -> None:
    metric = metric_of(transform)
    test, reference = random_images(1, 3), random_images(2, 3)
    pairs = list(zip(test.split(1), reference.split(1), strict=True))
    together = metric(test, reference)
    alone = torch.cat([metric(*pair) for pair in pairs])
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=1e-5)
    scores = torch.cat([metric.score(*pair) for pair in pairs])
    torch.testing.assert_close(metric.score(test, reference), scores)


@each_overlapping
@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
@settings(max_examples=6)
@given(
    seed=st.integers(0, 99),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    dtype=st.sampled_from([torch.float64, torch.float32, torch.float16, torch.bfloat16]),
)
def test_equal_images_give_exactly_zero(
    observer: Observer, transform: Transform, seed: int, height: int, width: int, dtype: torch.dtype
) -> None:
    image = random_images(seed, 2, height, width).to(dtype)
    metric = VDM(PPD, observer=observer, transform=transform)
    assert not metric(image, image.clone()).any()
    assert not metric.score(image, image.clone()).any()


@each_overlapping
def test_both_orders_give_the_same_map(transform: Transform) -> None:
    metric = metric_of(transform)
    one, other = random_images(1), random_images(2)
    assert torch.equal(metric(one, other), metric(other, one))


@each_overlapping
@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
def test_extreme_light_gives_finite_maps_and_gradients(
    observer: Observer, transform: Transform
) -> None:
    metric = VDM(PPD, Display.linear(1e6), observer, transform)
    image = (100.0 * random_images(1) ** 8 - 0.01).requires_grad_()
    for other in (torch.zeros_like(image), image.detach().clone(), -image.detach()):
        seen = metric(image, other)
        assert torch.isfinite(seen).all()
        for result in (
            seen.sum(),
            metric.score(image, other).sum(),
            metric.power(image, other).sum(),
        ):
            (gradient,) = torch.autograd.grad(result, image, retain_graph=True)
            assert torch.isfinite(gradient).all()


@each_overlapping
def test_the_loss_has_a_gradient(transform: Transform) -> None:
    image = random_images(1).requires_grad_()
    loss = VDMLoss(PPD, transform=transform)(image, random_images(2))
    (gradient,) = torch.autograd.grad(loss, image)
    assert torch.isfinite(gradient).all()
    assert gradient.any()


@each_overlapping
def test_the_compiled_route_is_the_same(transform: Transform) -> None:
    metric = VDM(PPD, transform=transform)
    test, reference = random_images(1, 2, 40, 50), random_images(2, 2, 40, 50)
    expected = metric(test, reference)
    torch.testing.assert_close(metric.compile()(test, reference), expected, rtol=1e-4, atol=1e-4)


@each_overlapping
def test_is_one_graph(transform: Transform) -> None:
    metric = VDM(PPD, transform=transform)
    test, reference = random_images(1, 1, 5, 6), random_images(2, 1, 5, 6)
    graph = torch.compile(metric, fullgraph=True, backend="eager")
    torch.testing.assert_close(graph(test, reference), metric(test, reference))


@each_overlapping
def test_large_planes_in_parts_are_the_same(
    transform: Transform, monkeypatch: pytest.MonkeyPatch
) -> None:
    metric = metric_of(transform)
    test, reference = random_images(1).double(), random_images(2).double()
    expected = metric(test, reference)
    monkeypatch.setattr("torch_vdm.run.schedule.LARGEST_AT_ONCE", 100)
    monkeypatch.setattr("torch_vdm.model.cortex.steerable.LARGEST_AT_ONCE", 100)
    torch.testing.assert_close(metric(test, reference), expected, rtol=1e-12, atol=1e-12)


def thresholds(metric: VDM, cpd: float, angles: list[float]) -> Tensor:
    """Return the contrasts, dB, at which gratings of angles and of four phases are seen with 1 JND.

    Away from the border, where a grating ends in another phase each time.
    """
    contrast = torch.full((len(angles), 4), 0.002, dtype=torch.float64)
    flat = grating(cpd / PPD, 0.0).expand(contrast.numel(), -1, -1, -1)
    phases = [step * math.pi / 4.0 for step in range(4)]
    unit = torch.cat([grating(cpd / PPD, 1.0, p, a) for a in angles for p in phases])
    for _ in range(3):
        test = flat + contrast.view(-1, 1, 1, 1) * (unit - flat)
        largest = metric(test, flat)[..., 32:96, 32:96].amax((1, 2, 3))
        contrast = contrast / largest.view_as(contrast)
    return 20.0 * torch.log10(contrast)


@each_overlapping
@pytest.mark.parametrize("cpd", [2.0, 4.0, 8.0])
def test_the_threshold_hardly_depends_on_phase(transform: Transform, cpd: float) -> None:
    # Frequencies that the grid of nodes divides, the worst: Haar's spread is 3 dB and more.
    (found,) = thresholds(metric_of(transform), cpd, [0.0])
    assert found.max() - found.min() < 1.0


@pytest.mark.parametrize("cpd", [2.0, 5.0, 8.0])
@pytest.mark.parametrize("transform", [*OVERLAPPING, Haar("filter")], ids=name)
def test_the_threshold_hardly_depends_on_orientation(
    transform: Transform, cpd: float, request: pytest.FixtureRequest
) -> None:
    if transform == StationaryHaar() and cpd != 5.0:
        # A coarse level, more sensitive, sees vertical gratings of finer ones, diagonal ones less.
        short = pytest.mark.xfail(reason="2.2 dB at 2 and 8 cycles/degree", strict=True)
        request.applymarker(short)
    straight, turned = thresholds(metric_of(transform), cpd, [0.0, 45.0]).mean(1)
    # Where phase matters, as with Haar, or contrast sensitivity acts on levels, up to 1.8 dB.
    within = 2.0 if transform in (StationaryHaar(), Haar("filter")) else 1.0
    assert abs(straight - turned) < within


@each_overlapping
@pytest.mark.parametrize("cpd", [3.0, 6.0, 11.3])
def test_the_map_of_a_grating_is_even(
    transform: Transform, cpd: float, request: pytest.FixtureRequest
) -> None:
    if transform == Steerable() and cpd == 6.0:
        request.applymarker(pytest.mark.xfail(reason="0.9 dB", strict=True))
    flat = grating(cpd / PPD, 0.0)
    inner = metric_of(transform)(grating(cpd / PPD, 0.02), flat)[..., 32:96, 32:96]
    low, high = inner.quantile(0.05), inner.quantile(0.95)
    assert 20.0 * torch.log10(high / low) < 0.85


def brighter(side: int, y: int, x: int, contrast: float) -> Tensor:
    image = torch.full((1, 3, 256, 256), 0.5)
    image[..., y : y + side, x : x + side] *= 1.0 + contrast
    return image


@pytest.mark.parametrize("contrast", [0.01, 0.04])
@pytest.mark.parametrize("side", [16, 32, 64, 128])
@pytest.mark.parametrize("transform", [*FILTERED, Haar()], ids=name)
def test_a_tile_is_seen_as_well_at_multiples_of_its_side(
    transform: Transform, side: int, contrast: float
) -> None:
    # Its edges lie on node borders of the paper's grid, where a tile of 16 pixels is seen 12 dB
    # less than elsewhere. Of ten other places, the median: at some it is seen less than at most.
    metric = metric_of(transform)
    places = torch.randint(1, 256 - side, (10, 2), generator=torch.Generator().manual_seed(side))
    flat = brighter(side, 0, 0, 0.0)

    def seen(y: int, x: int) -> float:
        largest = metric(brighter(side, y, x, contrast), flat).max().item()
        return 20.0 * math.log10(largest)

    elsewhere = float(np.median([seen(*place) for place in places.tolist()]))
    assert abs(seen(side, side) - elsewhere) < 3.0


@each_overlapping
def test_sees_about_what_haar_sees(transform: Transform) -> None:
    # Whatever the number of shifts and phases. Not the same responses: Haar's leave traces in more
    # levels.
    test, reference = random_images(1, 1, 128, 128), random_images(2, 1, 128, 128)
    plain = metric_of(Haar())(0.3 + 0.02 * test, 0.3 + 0.02 * reference)
    ours = metric_of(transform)(0.3 + 0.02 * test, 0.3 + 0.02 * reference)
    assert 0.5 < (ours.max() / plain.max()).item() < 1.4
    assert 0.5 < (ours.mean() / plain.mean()).item() < 1.4
