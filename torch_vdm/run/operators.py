"""The metric and the loss as operators, one node each in a graph that `torch.compile` makes.

If they were traced through, all levels of a pyramid would become one graph, which takes the
compiler half a minute for one size and far longer for a symbolic size. As an operator the module
runs as it does outside a graph, by the same route.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor, nn

from torch_vdm.precision import computed_in

# An operator takes tensors and numbers: modules are known to it by number.
_modules: WeakValueDictionary[int, nn.Module] = WeakValueDictionary()
_numbers = count(1)


class Enrolled(nn.Module):
    """A module that the operators know; each of its copies is registered separately."""

    def __init__(self) -> None:
        super().__init__()
        self._enrol()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of the module that this is a copy of."""
        super().__setstate__(state)  # type: ignore[no-untyped-call]  # torch's own, without types
        self._enrol()

    def _enrol(self) -> None:
        self._number = next(_numbers)
        _modules[self._number] = self


def is_wanted() -> bool:
    """Return whether a graph is being made that should have an operator in it.

    An exported graph should not: it has to contain all that it computes.
    """
    return torch.compiler.is_dynamo_compiling() and not torch.compiler.is_exporting()


def difference_map(test: Tensor, reference: Tensor, number: int, power: bool) -> Tensor:
    """Return the map of an enrolled `PairMetric`, or its power, as an operator.

    It is (B, 1, H, W) from (B, 3, H, W) twice. The backward pass recomputes the forward pass.
    """
    seen: Tensor = _map(test, reference, number, power)
    return seen


def loss_of_items(test: Tensor, reference: Tensor, mask: Tensor | None, number: int) -> Tensor:
    """Return the loss (B,) of an enrolled `VDMLoss` as an operator.

    It takes (B, 3, H, W) twice and weights (B, 1, H, W). The gradient is computed in the forward
    pass and kept; the backward pass multiplies that of each item by a number.
    """
    wanted = torch.is_grad_enabled()
    first, second = wanted and test.requires_grad, wanted and reference.requires_grad
    items: Tensor = _loss(test, reference, mask, number, first, second)[0]
    return items


@contextmanager
def _as_outside() -> Iterator[None]:
    """Compute with autograd, which is switched off inside an operator."""
    keys = torch._C.DispatchKey
    excluded = torch._C._dispatch_tls_local_exclude_set()
    for key in (keys.AutogradFunctionality, keys.AutogradOther, keys.ADInplaceOrView):
        excluded = excluded.remove(key)
    included = torch._C._dispatch_tls_local_include_set()
    with torch._C._ForceDispatchKeyGuard(included, excluded), torch.enable_grad():
        yield


@torch.library.custom_op("torch_vdm::map", mutates_args=())
def _map(test: Tensor, reference: Tensor, number: int, power: bool) -> Tensor:
    with torch.no_grad():
        seen: Tensor = _function(number, power)(test, reference)
    return seen


@_map.register_fake
def _(test: Tensor, reference: Tensor, number: int, power: bool) -> Tensor:
    del number, power
    batch, _, height, width = test.shape
    return test.new_empty((batch, 1, height, width), dtype=computed_in(test, reference))


@torch.library.custom_op("torch_vdm::map_gradient", mutates_args=())
def _map_gradient(
    test: Tensor,
    reference: Tensor,
    slope: Tensor,
    number: int,
    power: bool,
    first: bool,
    second: bool,
) -> tuple[Tensor, Tensor]:
    function = _function(number, power)
    return _gradients(
        lambda *images: function(*images) * slope, *(test, reference), *(first, second)
    )[1]


@_map_gradient.register_fake
def _(
    test: Tensor,
    reference: Tensor,
    slope: Tensor,
    number: int,
    power: bool,
    first: bool,
    second: bool,
) -> tuple[Tensor, Tensor]:
    del slope, number, power
    return _like(test, first), _like(reference, second)


def _keep_map(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    del output
    test, reference, *ctx.options = inputs
    ctx.save_for_backward(test, reference)


def _of_map(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
    wanted = ctx.needs_input_grad[:2]
    found = _map_gradient(*ctx.saved_tensors, slope, *ctx.options, *wanted)
    return *(part if want else None for part, want in zip(found, wanted, strict=True)), None, None


_map.register_autograd(_of_map, setup_context=_keep_map)


@torch.library.custom_op("torch_vdm::loss", mutates_args=())
def _loss(
    test: Tensor,
    reference: Tensor,
    mask: Tensor | None,
    number: int,
    first: bool,
    second: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    module: Any = _modules[number]
    if not (first or second):
        with torch.no_grad():
            items: Tensor = module.of_items(test, reference, mask)
        return items, _like(test, False, items.dtype), _like(reference, False, items.dtype)
    # In the computing precision: gradients are cast once the scale of the loss is included.
    dtype = computed_in(test, reference)
    items, found = _gradients(
        lambda *images: module.of_items(*images, mask),
        *(test.to(dtype), reference.to(dtype)),
        *(first, second),
    )
    return items, *found


@_loss.register_fake
def _(
    test: Tensor,
    reference: Tensor,
    mask: Tensor | None,
    number: int,
    first: bool,
    second: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    del mask, number
    dtype = computed_in(test, reference)
    items = test.new_empty(len(test), dtype=dtype)
    return items, _like(test, first, dtype), _like(reference, second, dtype)


def _keep_loss(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.dtypes = [image.dtype for image in inputs[:2]]
    ctx.save_for_backward(*output[1:])
    ctx.mark_non_differentiable(*output[1:])


def _of_loss(ctx: Any, slope: Tensor, *_: Tensor | None) -> tuple[Tensor | None, ...]:
    found = [
        (slope.view(-1, 1, 1, 1) * part).to(dtype) if want else None
        for part, dtype, want in zip(
            ctx.saved_tensors, ctx.dtypes, ctx.needs_input_grad[:2], strict=True
        )
    ]
    return *found, None, None, None, None


_loss.register_autograd(_of_loss, setup_context=_keep_loss)


def _gradients(
    function: Callable[[Tensor, Tensor], Tensor],
    test: Tensor,
    reference: Tensor,
    first: bool,
    second: bool,
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Return a function of two images, and the gradients of its sum by the images wanted."""
    with _as_outside():
        images = [
            image.detach().requires_grad_(want)
            for image, want in ((test, first), (reference, second))
        ]
        value = function(*images)
        inputs = [image for image in images if image.requires_grad]
        found = iter(torch.autograd.grad(value.sum(), inputs))
        slopes = [
            next(found).contiguous() if image.requires_grad else _like(image, False)
            for image in images
        ]
    return value.detach(), (slopes[0], slopes[1])


def _like(image: Tensor, wanted: bool, dtype: torch.dtype | None = None) -> Tensor:
    """Return a contiguous tensor like the gradient of an image, or without elements."""
    return image.new_empty(image.shape if wanted else (0,), dtype=dtype or image.dtype)


def _function(number: int, power: bool) -> Callable[..., Tensor]:
    """Return an enrolled metric, or its power."""
    module: Any = _modules[number]
    function: Callable[..., Tensor] = module.power if power else module
    return function
