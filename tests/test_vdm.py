"""The whole metric, end to end, against the NumPy reference; and as a module."""

import copy
import dataclasses
import io
import itertools
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.conftest import KINDS, make_xyz, reference_numbers
from tests.ladder import TRANSFORMS
from tests.reference import calibrated, paper
from torch_vdm import VDM, Display, Effects, Observer, vdm
from torch_vdm.cortex import Haar, Transform
from torch_vdm.quadtree import apart, stacked

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


@pytest.mark.parametrize("name", ["deepcopy", "pickle", "state_dict"])
def test_copies_answer_the_same(name: str) -> None:
    metric, pair = VDM.paper(30.0), images()
    match name:
        case "deepcopy":
            twin = copy.deepcopy(metric)
        case "pickle":
            twin = pickle.loads(pickle.dumps(metric))
        case _:
            twin = VDM(60.0, observer=dataclasses.replace(Observer.paper(), red_green_gain=1.0))
            buffer = io.BytesIO()
            torch.save(metric.state_dict(), buffer)
            buffer.seek(0)
            twin.load_state_dict(torch.load(buffer))
    assert torch.equal(twin(*pair), metric(*pair))


def test_constants_keep_their_precision() -> None:
    metric, pair = VDM(), images()
    expected = metric(*pair)
    assert torch.equal(metric.half().to(torch.bfloat16)(*pair), expected)
    assert {value.dtype for value in metric.buffers()} == {torch.float64}


def test_moves_to_another_device() -> None:
    assert {value.device.type for value in VDM().to("meta").buffers()} == {"meta"}


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


@pytest.mark.parametrize("few", [0, 40, vdm.FEW_NODES])
@pytest.mark.parametrize("effects", [Effects(), Effects(pooling=False), Effects(chromatic=False)])
@pytest.mark.parametrize("size", [(1, 1), (1, 6), (16, 16), (21, 34), (33, 12)])
def test_items_below_one_another_are_seen_each_by_itself(
    size: tuple[int, int], effects: Effects, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vdm, "FEW_NODES", few)
    metric = VDM(effects=effects)
    batch = [image.double().requires_grad_() for image in images(3, *size)]
    expected = metric.compare(*(metric.represent(image) for image in batch))
    below = (
        Haar().decompose(metric._cone_planes(stacked(image)), true_means=True, items=3)
        for image in batch
    )
    actual = apart(metric.compare(*below)[0], 3).transpose(0, 1)
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)
    gradients = (torch.autograd.grad(total.sum(), batch) for total in (actual, expected))
    torch.testing.assert_close(*gradients, rtol=1e-8, atol=1e-8)


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
    same = first._replace(
        details=tuple(plane.expand(3, *plane.shape[1:]) for plane in first.details),
        lowpass=tuple(plane.expand(3, *plane.shape[1:]) for plane in first.lowpass),
        mean=first.mean.expand(3, -1, -1, -1),
    )
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

    monkeypatch.setattr(vdm, "FEW_NODES", 300)
    monkeypatch.setattr(vdm, "STRIP", 2048)
    fast = VDM().compile()
    with torch.no_grad():
        fast(*images(1, 64, 64))
        graphs = counters["stats"]["unique_graphs"]
        shapes = (1, 61, 67), (1, 192, 64), (1, 203, 67), (2, 160, 80), (3, 40, 40), (5, 20, 30)
        for shape in shapes:
            fast(*images(*shape))
            assert counters["stats"]["unique_graphs"] == graphs, shape


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_input_is_computed_in_float32(dtype: torch.dtype) -> None:
    metric = VDM()
    test, reference = (image.to(dtype) for image in images())
    expected = metric(test.float(), reference.float())
    assert torch.equal(metric(test, reference), expected)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(metric(test, reference), expected)


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
        ({"effects": "auto"}, "effects: Effects"),
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
        "vdm.attenuation",
        "vdm.butterworth",
        "vdm.surround",
        "response.signed_transducer",
        "gradient.surround",
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
