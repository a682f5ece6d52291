"""A user's own compiled step: the metric is one node of it, and gives what it gives outside."""

import copy
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._dynamo.backends.debugging import aot_eager
from torch._dynamo.utils import counters

from torch_vdm import VDM, Display, Haar, Observer, StationaryHaar, VDMLoss
from torch_vdm.model.cortex import Transform

SIZES = ((2, 3, 24, 24), (2, 3, 40, 31), (5, 3, 17, 50), (1, 3, 9, 64))


def images(size: tuple[int, ...], dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(sum(size))
    one, other = torch.rand(2, *size, generator=generator)
    return one.to(dtype).requires_grad_(), other.to(dtype)


def slope(value: Tensor, image: Tensor) -> Tensor:
    (gradient,) = torch.autograd.grad((value * torch.arange(1.0, 1 + value.numel())).sum(), image)
    return gradient


@pytest.fixture(autouse=True)
def _fresh() -> None:
    torch.compiler.reset()
    counters.clear()


def test_a_training_step_of_any_size_is_compiled_twice() -> None:
    torch.manual_seed(0)
    net, loss = nn.Conv2d(3, 3, 3, padding=1), VDMLoss()

    def training_step(batch: Tensor, target: Tensor) -> Tensor:
        value: Tensor = loss(net(batch).sigmoid(), target)
        return value

    nodes: list[int] = []

    def counting(graph: torch.fx.GraphModule, inputs: list[Tensor]) -> Any:
        nodes.append(len(graph.graph.nodes))
        return aot_eager(graph, inputs)

    graph = torch.compile(training_step, fullgraph=True, backend=counting)
    for size in ((2, 3, 24, 24), (2, 3, 40, 31), (2, 3, 17, 50)):
        batch, target = images(size)
        value, expected = graph(batch, target), training_step(batch, target)
        assert torch.equal(value, expected)
        found, wanted = (torch.autograd.grad(v, net.weight)[0] for v in (value, expected))
        torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)
    # For the first size, and for every other.
    assert counters["stats"]["unique_graphs"] == 2
    assert max(nodes) < 30


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
@pytest.mark.parametrize("is_masked", [False, True])
def test_the_loss_and_its_gradient_are_those_outside(reduction: Any, is_masked: bool) -> None:
    loss = VDMLoss(30.0, Display.linear(200.0), reduction=reduction)
    graph = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for size in SIZES:
        test, reference = images(size, torch.float64)
        mask = torch.rand(len(test), 1, *size[2:]).double() if is_masked else None
        found, expected = (of(test, reference, mask) for of in (graph, loss))
        assert torch.equal(found, expected)
        gradient = slope(found.view(-1), test)
        torch.testing.assert_close(gradient, slope(expected.view(-1), test), rtol=1e-9, atol=1e-12)


def test_gradients_by_both_images_or_none() -> None:
    loss, (test, reference) = VDMLoss(), images(SIZES[1])
    graph = torch.compile(loss, fullgraph=True, backend="aot_eager")
    reference.requires_grad_()
    found, expected = (
        torch.autograd.grad(of(test, reference), (test, reference)) for of in (graph, loss)
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)
    with torch.no_grad():
        assert torch.equal(graph(test, reference), loss(test, reference))


@pytest.mark.parametrize("transform", [Haar(), StationaryHaar("filter")], ids=repr)
@pytest.mark.parametrize("observer", [Observer.calibrated(), Observer.paper()], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_the_map_and_its_gradient_are_those_outside(
    transform: Transform, observer: Observer, dtype: torch.dtype
) -> None:
    metric = VDM(observer=observer, transform=transform)
    test, reference = images(SIZES[1], dtype)
    for verb in (metric, metric.power):
        graph = torch.compile(verb, fullgraph=True, backend="aot_eager")
        found, expected = (of(test, reference) for of in (graph, verb))
        assert found.dtype == expected.dtype
        assert torch.equal(found, expected)
        gradient, wanted = (torch.autograd.grad(seen.sum(), test)[0] for seen in (found, expected))
        assert torch.equal(gradient, wanted)


def test_what_is_no_light_is_refused_there_too() -> None:
    test, reference = images(SIZES[0])
    graph = torch.compile(VDM(), fullgraph=True, backend="aot_eager")
    with torch.no_grad():
        test[1, 0, 3, 4] = torch.nan
    with pytest.raises(ValueError, match="batch item 1"):
        graph(test, reference)


def test_copies_are_compiled_as_themselves() -> None:
    loss, (test, reference) = VDMLoss(), images(SIZES[0])
    for other in (copy.deepcopy(loss), pickle.loads(pickle.dumps(loss))):
        other.l1 = 0.0
        graph = torch.compile(other, fullgraph=True, backend="aot_eager")
        assert torch.equal(graph(test, reference), other(test, reference))
        assert graph(test, reference) < loss(test, reference)


def test_an_exported_graph_has_all_that_it_computes() -> None:
    test, reference = images(SIZES[0])
    with torch.no_grad():
        program = torch.export.export(VDM(), (test.detach(), reference))
        seen = program.module()(test.detach(), reference)
    assert "torch_vdm" not in str(program.graph)
    torch.testing.assert_close(seen, VDM()(test.detach(), reference), rtol=1e-5, atol=1e-5)


def test_a_constant_that_is_replaced_or_trained_counts() -> None:
    metric, (test, reference) = VDM(), images(SIZES[0])

    def seen(gain: Tensor) -> Tensor:
        replaced = {"achromatic_gain": gain}
        found: Tensor = torch.func.functional_call(metric, replaced, (test, reference))
        return found.mean()

    graph = torch.compile(seen, fullgraph=True, backend="eager")
    gain = 3.0 * metric.get_buffer("achromatic_gain")
    gain = gain.detach()
    with torch.no_grad():
        torch.testing.assert_close(graph(gain), seen(gain), rtol=1e-6, atol=1e-6)
        assert graph(gain) > 1.2 * metric(test, reference).mean()


@pytest.mark.parametrize("scale", [2.0**10, 2.0**16, 2.0**24])
def test_half_precision_gradients_are_scaled_before_they_are_rounded(scale: float) -> None:
    loss, (test, reference) = VDMLoss(l1=0.0), images((1, 3, 64, 64), torch.float16)
    graph = torch.compile(loss, fullgraph=True, backend="aot_eager")
    found, expected = (
        torch.autograd.grad(scale * of(test, reference), test)[0] for of in (graph, loss)
    )
    # Infinity where it overflows, by which a scaler lowers its scale.
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=1e-7)
