"""Constants are not weights: what checkpoints, casts, wrappers and devices make of them."""

import copy
import io
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils._python_dispatch import TorchDispatchMode

from torch_vdm import VDM, Display, Haar, Observer, StationaryHaar, Steerable, VDMLoss, precision
from torch_vdm.pair import PairMetric

METRICS: dict[str, Callable[[], PairMetric]] = {
    "calibrated": VDM,
    "paper": lambda: VDM.paper(30.0),
    "filter": lambda: VDM(transform=StationaryHaar("filter")),
    "steerable": lambda: VDM(transform=Steerable()),
    "sarnoff": lambda: VDM.sarnoff(40.0),
}

each_metric = pytest.mark.parametrize("make", METRICS.values(), ids=METRICS)


def images(dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    test, reference = torch.rand(2, 2, 3, 21, 34, generator=generator).to(dtype)
    return test, reference


def saved(metric: nn.Module) -> Any:
    buffer = io.BytesIO()
    torch.save(metric, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


def former(metric: nn.Module, prefix: str = "") -> dict[str, Tensor]:
    """Return the state dict that a metric had when its constants were part of it."""
    return {prefix + name: value for name, value in metric.named_buffers()}


@each_metric
def test_a_state_dict_has_no_constants(make: Callable[[], PairMetric]) -> None:
    assert not make().state_dict()
    assert not nn.ModuleDict({"loss": VDMLoss(), "metric": make()}).state_dict()


def test_a_checkpoint_from_before_the_loss_was_added_loads() -> None:
    class Model(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = nn.Linear(2, 3)

    before, after = Model(), Model()
    after.add_module("loss", VDMLoss())
    after.load_state_dict(before.state_dict(), strict=True)


@each_metric
def test_former_checkpoints_load_and_leave_the_options_in_force(
    make: Callable[[], PairMetric],
) -> None:
    # Of a metric with other options.
    others = VDM(20.0, observer=Observer.paper())
    metric = make()
    expected = metric(*images())
    with pytest.warns(UserWarning, match="constants of .* left out, and this module's options"):
        metric.load_state_dict(former(others), strict=True)
    assert torch.equal(metric(*images()), expected)
    model = nn.Sequential(nn.Conv2d(3, 3, 1), metric)
    state = {**nn.Sequential(nn.Conv2d(3, 3, 1)).state_dict(), **former(make(), "1.")}
    with pytest.warns(UserWarning, match="left out"):
        model.load_state_dict(state, strict=True)
    with pytest.raises(RuntimeError, match=r"Unexpected key.*weight"):
        metric.load_state_dict({"weight": torch.zeros(1)}, strict=True)


@each_metric
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)), saved])
def test_copies_answer_the_same(make: Callable[[], PairMetric], copied: Any) -> None:
    metric = make()
    twin = copied(metric)
    for dtype in (torch.float32, torch.float64):
        assert torch.equal(twin(*images(dtype)), metric(*images(dtype)))


@each_metric
def test_constants_keep_their_precision(make: Callable[[], PairMetric]) -> None:
    metric = make()
    expected = [metric(*images(dtype)) for dtype in (torch.float32, torch.float64)]
    metric.half().to(torch.bfloat16).float()
    assert torch.equal(metric(*images()), expected[0])
    assert torch.equal(metric(*images(torch.float64)), expected[1])
    assert {value.dtype for value in metric.buffers()} == {torch.float64}


@each_metric
def test_a_wrapper_that_casts_buffers_changes_no_answer(make: Callable[[], PairMetric]) -> None:
    # As fully sharded training does, there and back.
    metric = make()
    expected = [metric(*images(dtype)) for dtype in (torch.float32, torch.float64)]
    for dtype in (torch.bfloat16, torch.float64):
        for buffer in metric.buffers():
            buffer.data = buffer.data.to(dtype)
        for found in expected:
            assert torch.equal(metric(*images(found.dtype)), found)
    compiled = torch.compile(metric, backend="eager")
    assert torch.equal(compiled(*images()), expected[0])
    # Or with other tensors in their place.
    for name, buffer in metric.named_buffers():
        setattr(metric, name, buffer.bfloat16())
    assert torch.equal(metric(*images()), expected[0])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_wrapper_that_moves_buffers_moves_the_metric() -> None:
    metric = VDM()
    expected = metric(*images(torch.float64))
    for buffer in metric.buffers():
        buffer.data = buffer.data.cuda()
    actual = metric(*(image.cuda() for image in images(torch.float64)))
    torch.testing.assert_close(actual.cpu(), expected, rtol=1e-9, atol=1e-9)


def test_a_constant_can_be_replaced_in_a_call() -> None:
    metric = VDM()
    expected = VDM(observer=Observer.calibrated())(*images())
    gain = torch.tensor(310.0, dtype=torch.float64, requires_grad=True)
    jnd = functional_call(metric, {"achromatic_gain": gain}, images())
    (slope,) = torch.autograd.grad(jnd.sum(), gain)
    assert slope != 0.0
    assert not torch.equal(jnd, expected)
    assert torch.equal(metric(*images()), expected)


def test_buffers_are_broadcast(tmp_path: Path) -> None:
    class Model(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network, self.loss = nn.Conv2d(3, 3, 1), VDMLoss()

        def forward(self, test: Tensor, reference: Tensor) -> Tensor:
            value: Tensor = self.loss(self.network(test), reference)
            return value

    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{tmp_path / 'store'}", rank=0, world_size=1
    )
    try:
        model = Model()
        expected = model(*images())
        both = nn.parallel.DistributedDataParallel(model)
        value = both(*images())
        value.backward()
        assert torch.equal(value, expected)
    finally:
        torch.distributed.destroy_process_group()


@pytest.mark.parametrize("strict", [False, True])
def test_an_exported_graph_answers_the_same(strict: bool) -> None:
    for dtype in (torch.float32, torch.float64):
        test, reference = (image[..., :8, :8] for image in images(dtype))
        exported = torch.export.export(VDM(), (test, reference), strict=strict)
        assert not exported.state_dict
        jnd = exported.module()(test, reference)
        torch.testing.assert_close(jnd, VDM()(test, reference), rtol=1e-5, atol=1e-5)


@each_metric
def test_a_metric_made_without_values_gets_them_with_its_device(
    make: Callable[[], PairMetric],
) -> None:
    with torch.device("meta"):
        metric = make()
    assert all(value.is_meta for value in metric.buffers())
    assert torch.equal(metric.to_empty(device="cpu")(*images()), make()(*images()))


class Refusing(TorchDispatchMode):
    """A device that has no float64: whatever would make such a tensor raises."""

    def __torch_dispatch__(  # noqa: D105  # see the class
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        found = func(*args, **(kwargs or {}))
        for value in (*args, *(found if isinstance(found, tuple | list) else (found,))):
            if isinstance(value, Tensor) and value.dtype == torch.float64:
                raise TypeError("this device has no float64")
        return found


@pytest.fixture
def without_float64(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(precision, "_without_float64", set())
    with Refusing():  # type: ignore[no-untyped-call]  # torch's own
        yield


def refused(value: Tensor) -> Tensor:
    """Move a tensor as a device does that has no float64."""
    if value.dtype == torch.float64:
        raise TypeError("this device has no float64")
    return value.clone()


@each_metric
def test_moves_where_there_is_no_float64(make: Callable[[], PairMetric]) -> None:
    metric = make()
    expected = metric(*images())
    loss = nn.Sequential(metric, VDMLoss())
    loss._apply(refused)
    assert torch.equal(metric(*images()), expected)


@pytest.mark.usefixtures("without_float64")
@pytest.mark.parametrize("transform", [Haar(), StationaryHaar("filter"), Steerable()])
def test_computes_where_there_is_no_float64(transform: Any) -> None:
    with torch.utils._python_dispatch._disable_current_modes():
        metric, loss = VDM(transform=transform), VDMLoss(transform=transform)
        expected = metric(*images())
    metric.to("cpu"), loss.to("cpu")
    assert {value.dtype for value in metric.buffers()} == {torch.float32}
    test, reference = images()
    torch.testing.assert_close(metric(test, reference), expected, rtol=1e-4, atol=1e-4)
    loss(test.requires_grad_(), reference).backward()
    assert test.grad is not None
    tiled = metric.tiled(test.detach(), reference, 8)
    torch.testing.assert_close(tiled, expected, rtol=1e-3, atol=1e-3)


def test_a_metric_first_used_in_inference_mode_trains_later() -> None:
    for dtype in (torch.float32, torch.float64):
        test, reference = images(dtype)
        with torch.inference_mode():
            loss = VDMLoss(display=Display.linear())
            loss(test, reference)
        loss(test.requires_grad_(), reference).backward()
        assert test.grad is not None


def test_a_gradient_that_overflows_in_half_precision_reaches_the_scaler() -> None:
    # Clamped, it would never lower its scale.
    test, reference = images()
    picture = test.requires_grad_()
    before = picture.detach().clone()
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**24)
    optimizer = torch.optim.SGD([picture], lr=0.1)
    scaler.scale(VDMLoss()(picture.half(), reference)).backward()
    scaler.step(optimizer)
    scaler.update()
    assert scaler.get_scale() < 2.0**24
    assert torch.equal(picture, before)
