"""The whole metric, end to end, against the NumPy reference; and as a module."""

import dataclasses
import itertools
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import torch_vdm
from tests.conftest import KINDS, make_xyz, reference_numbers
from tests.ladder import TRANSFORMS
from tests.reference import calibrated, paper
from torch_vdm import (
    VDM,
    Display,
    Effects,
    Observer,
    VDMLoss,
)
from torch_vdm.functional import visual_difference
from torch_vdm.model.cortex import Transform
from torch_vdm.run import schedule

PPD = 48.0
EFFECTS = [Effects(*switches) for switches in itertools.product((True, False), repeat=4)]

sizes = st.one_of(
    st.tuples(st.integers(1, 20), st.integers(1, 20)),
    st.sampled_from([(1, 1), (1, 33), (33, 1), (2, 2), (16, 16), (31, 17)]),
)


def reference_map(
    test: NDArray[np.float64],
    reference: NDArray[np.float64],
    observer: Observer,
    effects: Effects,
) -> NDArray[np.float64]:
    """Return the reference's map (H, W) for an observer and a choice of effects."""
    switches = paper.Effects(**dataclasses.asdict(effects))
    if not observer.signed:
        return paper.jnd_map(test, reference, PPD, switches)
    return calibrated.jnd_map(test, reference, PPD, reference_numbers(), switches)


def torch_map(
    test: NDArray[np.float64],
    reference: NDArray[np.float64],
    observer: Observer,
    effects: Effects,
    dtype: torch.dtype,
) -> NDArray[np.float64]:
    """Return the module's map (H, W)."""
    metric = VDM(PPD, Display.xyz(), observer, effects=effects)
    images = (torch.as_tensor(image, dtype=dtype)[None] for image in (test, reference))
    jnd: NDArray[np.float64] = metric(*images)[0, 0].double().numpy()
    return jnd


@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
@given(size=sizes, kinds=st.tuples(*[st.sampled_from(KINDS)] * 2), seed=st.integers(0, 2**16))
def test_float64_is_the_reference(
    observer: Observer, size: tuple[int, int], kinds: tuple[str, str], seed: int
) -> None:
    test, reference = (make_xyz(kind, *size, seed + n) for n, kind in enumerate(kinds))
    expected = reference_map(test, reference, observer, Effects())
    actual = torch_map(test, reference, observer, Effects(), torch.float64)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
@given(size=sizes, kinds=st.tuples(*[st.sampled_from(KINDS)] * 2), seed=st.integers(0, 2**16))
def test_float32_is_the_reference(
    observer: Observer, size: tuple[int, int], kinds: tuple[str, str], seed: int
) -> None:
    # The reference sees the light that float32 holds: only the arithmetic is judged.
    test, reference = (
        make_xyz(kind, *size, seed + n).astype(np.float32).astype(np.float64)
        for n, kind in enumerate(kinds)
    )
    expected = reference_map(test, reference, observer, Effects())
    actual = torch_map(test, reference, observer, Effects(), torch.float32)
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
@pytest.mark.parametrize("effects", EFFECTS, ids=lambda e: "+".join(e.names()) or "none")
def test_every_choice_of_effects_is_the_reference(observer: Observer, effects: Effects) -> None:
    test, reference = make_xyz("random", 9, 13, 5), make_xyz("random", 9, 13, 6)
    expected = reference_map(test, reference, observer, effects)
    actual = torch_map(test, reference, observer, effects, torch.float64)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
def test_the_score_is_the_largest_value_of_the_map(
    observer: Observer, transform: Transform
) -> None:
    pair = images()
    metric = VDM(PPD, observer=observer, transform=transform)
    assert torch.equal(metric.score(*pair), metric(*pair).amax((1, 2, 3)))


def images(batch: int = 2, height: int = 21, width: int = 34) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a random test and reference, sRGB-coded."""
    generator = torch.Generator().manual_seed(3)
    reference = torch.rand(batch, 3, height, width, generator=generator)
    noise = 0.05 * torch.randn(reference.shape, generator=generator)
    return (reference + noise).clamp(0.0, 1.0), reference


def test_full_graph_compiles() -> None:
    metric, pair = VDM(), images(1, 8, 8)
    compiled = torch.compile(metric, fullgraph=True)
    torch.testing.assert_close(compiled(*pair), metric(*pair), rtol=1e-4, atol=1e-4)


def test_fast_route_answers_the_same() -> None:
    metric, fast = VDM(), VDM()
    assert fast.compile() is fast
    for shape in ((1, 40, 56), (3, 33, 80)):
        pair = images(*shape)
        torch.testing.assert_close(fast(*pair), metric(*pair), rtol=1e-4, atol=1e-4)
        assert not fast(pair[0], pair[0]).any()
        # In float64: in float32 the gradient's own rounding is larger than any fault of ours.
        gradients = []
        for module in (metric, fast):
            test = pair[0].double().requires_grad_()
            module.power(test, pair[1]).sum().backward()
            assert test.grad is not None
            gradients.append(test.grad)
        torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-9, atol=1e-9)
    assert torch.equal(pickle.loads(pickle.dumps(fast))(*pair), fast(*pair))


@pytest.mark.parametrize("transform", TRANSFORMS, ids=str)
@pytest.mark.parametrize(
    "observer", [Observer.calibrated(), Observer.paper()], ids=lambda o: o.name
)
@pytest.mark.parametrize("size", [(1, 1), (7, 5), (33, 34)])
def test_many_beside_one_are_compared_as_each_with_it(
    size: tuple[int, int], observer: Observer, transform: Transform
) -> None:
    # Nothing is charged beside one that stays.
    uncharged = dataclasses.replace(observer, charging=False)
    charged = VDM(PPD, observer=observer, transform=transform)
    metric = VDM(PPD, observer=uncharged, transform=transform)
    first, others = (
        metric.represent(image.double()) for image in (images(1, *size)[0], images(3, *size)[1])
    )
    same = first.each(lambda plane: plane.expand(3, *plane.shape[1:]))
    torch.testing.assert_close(charged.beside(first)(others), metric.compare(same, others))
    assert (charged.beside(first)(first) == 0.0).all()


def test_the_fast_route_is_never_compiled_again() -> None:
    # The list: any height, width and batch, after one call for each of the two ways that gradients
    # are asked for. Not slivers of over 400 to 1, of which a large level has a side of one node:
    # these are compiled once more.
    from torch._dynamo.utils import counters

    fast = VDM().compile()

    def call(*shape: int) -> None:
        pair = images(*shape)
        with torch.no_grad():
            fast(*pair)
        fast.power(pair[0].requires_grad_(), pair[1]).sum().backward()

    call(1, 40, 56)
    graphs = counters["stats"]["unique_graphs"]
    assert graphs > 0
    batches = (3, 33, 80), (2, 80, 33), (5, 40, 56), (300, 3, 5)
    for shape in ((1, 64, 64), (1, 101, 47), (1, 16, 700), *batches):
        call(*shape)
        assert counters["stats"]["unique_graphs"] == graphs, shape


def test_large_images_compile_nothing_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    # Levels one by one, strips and items below one another, of sides that are even at every level,
    # and that are not.
    from torch._dynamo.utils import counters

    monkeypatch.setattr(schedule, "FEW_NODES", 1500)
    monkeypatch.setattr(schedule, "STRIP", 2048)
    fast = VDM().compile()
    with torch.no_grad():
        # Large enough for every function to be compiled.
        fast(*images(1, 128, 160))
        graphs = counters["stats"]["unique_graphs"]
        shapes = (1, 61, 67), (1, 192, 64), (1, 203, 67), (2, 160, 80), (3, 140, 70), (5, 20, 30)
        for shape in shapes:
            fast(*images(*shape))
            assert counters["stats"]["unique_graphs"] == graphs, shape


def test_a_gpus_fast_route_compiles_nothing_twice() -> None:
    # On a GPU reductions and what needs a few numbers are compiled too.
    from torch._dynamo.utils import counters

    route = schedule.Schedule(together=True, compiled=True, cached=False, few=schedule.EVERY_LEVEL)
    fast, metric = VDM(schedule=route), VDM()
    graphs = None
    with torch.no_grad():
        for shape in ((2, 40, 56), (2, 64, 64), (5, 47, 101), (3, 16, 300)):
            pair = images(*shape)
            torch.testing.assert_close(fast(*pair), metric(*pair), rtol=1e-4, atol=1e-6)
            graphs = graphs or counters["stats"]["unique_graphs"]
            assert counters["stats"]["unique_graphs"] == graphs, shape


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_input_is_computed_in_float32(dtype: torch.dtype) -> None:
    metric = VDM()
    test, reference = (image.to(dtype) for image in images())
    expected = metric(test.float(), reference.float())
    assert torch.equal(metric(test, reference), expected)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(metric(test, reference), expected)
        half, single = metric.represent(test), metric.represent(test.float())
        assert half.mean.dtype == torch.float32
        for one, other in zip(half.details, single.details, strict=True):
            assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("test", "reference", "message"),
    [
        (
            torch.zeros(3, 4, 4),
            torch.zeros(3, 4, 4),
            r"test of shape \(B, 3, H, W\) with no side of 0, got \(3, 4, 4",
        ),
        (torch.zeros(1, 1, 4, 4), torch.zeros(1, 3, 4, 4), r"test of shape"),
        (torch.zeros(1, 3, 4, 4), torch.zeros(1, 3, 4, 0), r"reference of shape"),
        (torch.zeros(1, 3, 4, 4), torch.zeros(1, 3, 4, 5), r"one shape, got .*4, 4.* and .*4, 5"),
        (torch.zeros(1, 3, 2, 2).byte(), torch.zeros(1, 3, 2, 2), r"uint8; divide 8-bit values"),
    ],
)
def test_wrong_images_are_refused(
    test: torch.Tensor, reference: torch.Tensor, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        VDM()(test, reference)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ppd": 0.0}, "pixels per degree between 0.01 and 1e6, got 0"),
        ({"ppd": float("nan")}, "pixels per degree"),
        ({"observer": "paper"}, "observer: Observer, got 'paper'"),
        ({"effects": "some"}, 'effects "auto" or "full"'),
        ({"nonfinite": "zero"}, '"raise" or "mask"'),
    ],
)
def test_wrong_options_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VDM(**arguments)  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dark_light": 0.0}, "dark_light: a finite number over 0, got 0"),
        ({"band_width": float("nan")}, "band_width: a finite number over 0, got nan"),
        ({"red_green_gain": -1.0}, "red_green_gain: a finite number from 0, got -1"),
        ({"lowpass_gains": (1.0, 2.0)}, "lowpass_gains: three or None"),
        ({"summation_exponent": 0.0}, "summation_exponent: a finite number over 0, got 0"),
    ],
)
def test_wrong_observers_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(Observer.calibrated(), **changes)  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_nonfinite_pixels_are_named_or_masked(value: float) -> None:
    test, reference = images(3)
    clean = VDM()(test, reference)
    test[1, 2, 5, 7] = value
    with pytest.raises(ValueError, match="test's batch item 1, the first in channel 2 at x 7, y 5"):
        VDM()(test, reference)
    masked = VDM(nonfinite="mask")(test, reference)
    assert torch.equal(masked[[0, 2]], clean[[0, 2]])
    assert masked.isfinite().all()
    assert masked[1, 0, 5, 7] == 0.0


def test_effects_that_are_off_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        pytest.fail("an effect that is off was computed")

    for name in (
        "model.model.attenuation",
        "model.model.butterworth",
        "model.level.surround",
        "model.level.unmasked",
        "model.level.masking_energy",
        "run.gradients.level.surround",
    ):
        monkeypatch.setattr(f"torch_vdm.{name}", forbidden)
    VDM(effects=Effects(False, False, False, False))(*images())


def test_gradients_are_finite_where_images_are_equal_or_black() -> None:
    for metric in (VDM(), VDM.paper()):
        for level in (0.0, 0.5, 1.0):
            test = torch.full((1, 3, 9, 12), level, requires_grad=True)
            reference = torch.full((1, 3, 9, 12), level)
            metric(test, reference).sum().backward()
            assert test.grad is not None
            assert not test.grad.any()
            metric(test, images(1, 9, 12)[0]).sum().backward()
            assert torch.isfinite(test.grad).all()


# The package without its types.
untyped: Any = torch_vdm


class Named:
    """An image of another library."""

    shape = (1, 3, 4, 4)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((1, 3, 4, 4), np.float32), "that is a tensor .*got ndarray; torch.from_numpy"),
        ([[0.0]], "that is a tensor .*got list"),
        (Named(), "that is a tensor .*got Named"),
        (torch.zeros(3, 4, 5), r"got \(3, 4, 5\); give it a batch of one, image\[None\]"),
        (torch.zeros(2, 1, 4, 5), r"grey image, image.expand\(-1, 3, -1, -1\)"),
        (torch.zeros(4, 5), r"grey image .*image.expand\(1, 3, -1, -1\)"),
        (torch.zeros(1, 4, 5), r"grey image .*image.expand\(1, 3, -1, -1\)"),
        (torch.zeros(2, 4, 4, 5), r"leave out alpha, image\[:, :3\]"),
        (torch.zeros(2, 4, 5, 3), r"channels first, image.movedim\(-1, -3\)"),
        (torch.zeros(4, 5, 3), r"channels first, image.movedim\(-1, -3\)"),
        (torch.zeros(1, 3, 4, 5, dtype=torch.uint8), "uint8; divide 8-bit values by 255"),
        (torch.zeros(1, 3, 4, 5, dtype=torch.int32), "int32; divide"),
        (torch.zeros(1, 3, 4, 5, dtype=torch.complex64), "floating point, got torch.complex64"),
        (torch.zeros(1, 3, 4, 5, device="meta"), "where the metric is, on cpu, got one on meta"),
    ],
)
def test_what_is_no_image_is_told_what_to_do(image: object, message: str) -> None:
    metric, loss = VDM(), VDMLoss()
    calls: list[Callable[[Any], object]] = [
        lambda image: metric(image, image),
        lambda image: metric.power(image, image),
        lambda image: metric.score(image, image),
        lambda image: loss(image, image),
        metric.represent,
        lambda image: VDM.sarnoff()(image, image),
        lambda image: visual_difference(image, image),
    ]
    for call in calls[: 6 if getattr(image, "is_meta", False) else 7]:
        with pytest.raises(ValueError, match=message) as told:
            call(image)
        assert "\n" not in str(told.value)


def test_images_of_two_devices_are_refused() -> None:
    test, reference = images()
    with pytest.raises(ValueError, match="expected a reference where the metric is"):
        VDM()(test, reference.to("meta"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: untyped.VDM(ppd="60"), "pixels per degree: a number, got '60'"),
        (lambda: untyped.VDM(ppd=None), "pixels per degree: a number, got None"),
        (lambda: untyped.VDM(ppd=True), "pixels per degree: a number, got True"),
        (lambda: untyped.VDM(display="srgb"), "display: Display, got 'srgb'"),
        (
            lambda: untyped.VDM(transform=untyped.Haar),
            r"transform: Haar\(\), StationaryHaar\(\) or Steerable\(\)",
        ),
        (lambda: untyped.VDM(transform="haar"), r"transform: Haar\(\).*, got 'haar'"),
        (lambda: untyped.VDM(transform=untyped.Observer.paper()), r"transform: Haar\(\)"),
        (lambda: untyped.VDM(observer=untyped.Observer.paper), "observer: Observer"),
        (lambda: untyped.VDM(effects={"masking": False}), '"full", Effects or Plan'),
        (lambda: untyped.VDM(nonfinite=["mask"]), 'nonfinite "raise" or "mask"'),
        (lambda: untyped.VDM.sarnoff("60"), "pixels per degree: a number"),
        (lambda: untyped.VDM.sarnoff(resample="no"), "resample: True or False, got 'no'"),
        (lambda: untyped.VDMLoss(transform=untyped.Haar), r"transform: Haar\(\)"),
        (lambda: untyped.VDMLoss(l1="1"), "l1: a number, got '1'"),
        (lambda: untyped.VDMLoss(l1=None), "l1: a number"),
        (lambda: untyped.VDMLoss(reduction=["mean"]), "reduction .*got"),
        (lambda: untyped.VDMLoss(checkpoint="no"), "checkpoint: True or False, got 'no'"),
        (lambda: untyped.Display("PQ", 100), 'encoding "srgb", "linear" or "xyz", got \'PQ\''),
        (lambda: untyped.Display(None, 100), "encoding"),
        (lambda: untyped.Display("srgb", "100"), "white: a number, got '100'"),
        (lambda: untyped.Display.srgb(None), "white: a number"),
        (lambda: untyped.Display.linear(100.0, "1"), "exposure: a number"),
        (lambda: untyped.Display("xyz", 100.0), "white of 1.0 and no exposure for XYZ"),
        (lambda: untyped.Display("xyz", 1.0, 2.0), "white of 1.0 and no exposure for XYZ"),
        (lambda: untyped.Effects(masking="off"), "masking: True or False, got 'off'"),
        (lambda: untyped.Effects(1), "aberration: True or False, got 1"),
        (lambda: untyped.Haar(csf="filters"), 'csf "levels" or "filter"'),
        (lambda: untyped.StationaryHaar(csf=1), 'csf "levels" or "filter"'),
        (
            lambda: untyped.pixels_per_degree(3840, 27, 0.6),
            r"resolution \(width, height\), got 3840",
        ),
        (lambda: untyped.pixels_per_degree((3840,), 27, 0.6), r"resolution \(width, height\)"),
        (lambda: untyped.pixels_per_degree(("a", 1), 27, 0.6), "a number, got 'a'"),
        (lambda: untyped.pixels_per_degree((3840, 2160), "27", 0.6), "a number, got '27'"),
        (
            lambda: untyped.functional.visual_difference(*images(), ppd="60"),
            "pixels per degree: a number",
        ),
        (
            lambda: untyped.functional.visual_difference(*images(), transform=[]),
            r"transform: Haar\(\)",
        ),
    ],
)
def test_every_wrong_option_is_a_value_error(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as told:
        make()
    assert "\n" not in str(told.value)


def test_an_observer_takes_numbers_of_numpy_and_torch() -> None:
    plain = Observer.calibrated()
    changed = {"achromatic_gain": 300.0, "dim_luminance": 20.0, "band_width": 1.5}
    expected = dataclasses.replace(plain, **changed)  # type: ignore[arg-type]  # numbers all
    for kind in (np.float64, np.float32, np.int64, torch.tensor):
        if kind is np.int64:
            changed["band_width"] = 1.0
            expected = dataclasses.replace(expected, band_width=1.0)
        others = {name: kind(value) for name, value in changed.items()}
        observer = dataclasses.replace(plain, **others)  # type: ignore[arg-type]  # numbers all
        assert observer == expected
        assert observer.numbers() == expected.numbers()
        assert torch.equal(VDM(observer=observer)(*images()), VDM(observer=expected)(*images()))
    gains = dataclasses.replace(plain, lowpass_gains=np.float32(plain.lowpass_gains).tolist())  # type: ignore[arg-type]  # a list
    assert gains == plain


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(Observer)])
def test_every_field_of_an_observer_is_checked(name: str) -> None:
    wrong = 1.0 if name == "name" else "wrong"
    with pytest.raises(ValueError, match=f"expected {name}: "):
        dataclasses.replace(Observer.calibrated(), **{name: wrong})  # type: ignore[arg-type]  # wrong on purpose


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_onnx_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    message = "expected no export to ONNX, .*use torch.export.export"
    with pytest.raises(ValueError, match=message):
        torch.onnx.export(VDM(), images(), dynamo=False)
    # As the newer exporter says it, which needs packages of its own.
    monkeypatch.setattr("torch.onnx.is_in_onnx_export", lambda: True)
    with pytest.raises(ValueError, match=message):
        torch.export.export(VDM(), images(), strict=False)
