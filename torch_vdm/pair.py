"""What every metric of two images shares: its options, its checks, its precision."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import is_fake
from torch.utils.checkpoint import checkpoint

from torch_vdm import operators
from torch_vdm.display import Display
from torch_vdm.distance import just_noticeable
from torch_vdm.fast import for_any_size
from torch_vdm.grid import Grid
from torch_vdm.memory import keep_freed_memory

Nonfinite = Literal["raise", "mask"]


class PairMetric(nn.Module):
    """A metric that maps the visible differences of two images.

    Subclasses give the accumulated differences of two checked batches, and how a plane of them
    becomes one of pixels; their constants are float64 buffers, ``summation_exponent`` among them.

    Parameters
    ----------
    ppd, display, nonfinite
        As in `VDM`.

    Raises
    ------
    ValueError
        Where a parameter or an image is not as stated.
    """

    def __init__(
        self, ppd: float, display: Display | None = None, nonfinite: Nonfinite = "raise"
    ) -> None:
        super().__init__()
        if not 0.01 <= ppd <= 1e6:
            raise ValueError(f"expected pixels per degree between 0.01 and 1e6, got {ppd}")
        if not isinstance(display, Display | None):
            raise ValueError(f"expected display: Display, got {display!r}")
        if nonfinite not in ("raise", "mask"):
            raise ValueError(f'expected nonfinite "raise" or "mask", got {nonfinite!r}')
        self.ppd = float(ppd)
        self.display = display or Display.srgb()
        self.nonfinite = nonfinite
        self._fast = False
        self._checkpointed = False
        self._number = operators.enrol(self)
        keep_freed_memory()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of another, of which this is a copy."""
        super().__setstate__(state)  # type: ignore[no-untyped-call]  # torch's own, without types
        self._number = operators.enrol(self)

    def _kept(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a part of the forward pass, of which a checkpoint keeps the arguments alone.

        What was computed on the way is then computed again in the backward pass. Compiled graphs
        choose by themselves what they keep.
        """
        if not self._checkpointed or torch.compiler.is_compiling() or not torch.is_grad_enabled():
            return function(*arguments)
        return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)

    def _accumulated(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the accumulated differences of two checked batches, (B, 1, h, w)."""
        raise NotImplementedError

    def _at_once(self, size: tuple[int, int]) -> int:
        """Return how many items of a size `_accumulated` takes at once on the fast route."""
        del size
        return 1

    def _to_pixels(self, plane: Tensor, size: tuple[int, int], grid: Grid | None = None) -> Tensor:
        """Return a plane of `_accumulated`, or of its root, at the pixels of the images.

        ``grid``: that of a part of an image.
        """
        raise NotImplementedError

    def _apply(self, fn: Any, recurse: bool = True) -> Self:
        """Move the constants with the module, but never to a lower precision."""
        exact = dict(self._buffers)
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]  # torch's own, without types
        for name, moved in self._buffers.items():
            constant = exact[name]
            if moved is not None and constant is not None and moved.dtype != constant.dtype:
                self._buffers[name] = constant.to(moved.device)
        return self

    def compile(self, *args: Any, **kwargs: Any) -> Self:  # type: ignore[override]
        """Switch to the fast route: one compiled function a level, for any size and batch.

        ``torch.compile(metric)``, or of a step that calls it, does not: there the metric is one
        operator, which takes the route that it takes elsewhere. Takes no arguments; returns the
        module itself, where `nn.Module.compile` returns nothing. Needs a C++ compiler.
        """
        if args or kwargs:
            raise ValueError("expected no arguments: the fast route has no options")
        self._fast = True
        return self

    def forward(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the map of visible differences.

        Parameters
        ----------
        test, reference
            (B, 3, H, W), floating point, as the display expects them.

        Returns
        -------
        Tensor
            (B, 1, H, W), JND.
        """
        if operators.is_wanted():
            return operators.difference_map(test, reference, self._number, power=False)
        test, reference, seen = self._checked(test, reference)
        total = self._total(test, reference)
        constants = self._constants(total.dtype, "summation_exponent")
        jnd = just_noticeable(total, constants["summation_exponent"])
        return masked(self._to_pixels(jnd, (test.shape[-2], test.shape[-1])), seen)

    def power(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the accumulated differences before the root, the map to a power.

        That of the summation: 2.4 for the paper's observer, 6 for the calibrated one.

        (B, 1, H, W), from (B, 3, H, W) twice. Smooth where the images are equal, so that a loss
        is taken from here; see `VDMLoss`.
        """
        if operators.is_wanted():
            return operators.difference_map(test, reference, self._number, power=True)
        return self._power(*self._checked(test, reference))

    def _power(self, test: Tensor, reference: Tensor, seen: Tensor | None) -> Tensor:
        """Return `power` of two checked batches."""
        total = self._total(test, reference)
        return masked(self._to_pixels(total, (test.shape[-2], test.shape[-1])), seen)

    def _constants(self, dtype: torch.dtype, *names: str) -> dict[str, Tensor]:
        """Return constants in the precision of the computation: those named, or all."""
        buffers = {name: getattr(self, name) for name in names} or dict(self.named_buffers())
        return {name: value.to(dtype) for name, value in buffers.items()}

    def _total(self, test: Tensor, reference: Tensor) -> Tensor:
        fast = self._fast and not torch.compiler.is_compiling()
        with for_any_size() if fast else nullcontext():
            at_once = self._at_once((test.shape[-2], test.shape[-1]))
            parts = self._parts(test, reference, at_once)
            totals = [self._accumulated(one, other) for one, other in parts]
        return torch.cat(totals)

    def _parts(
        self, test: Tensor, reference: Tensor, at_once: int = 1
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield both batches, whole or, on the fast route, ``at_once`` items at a time."""
        if not self._fast or len(test) == 1:
            return iter([(test, reference)])
        parts = zip(test.split(at_once), reference.split(at_once), strict=True)
        # Compiled code gets one item as it is, and is specialised on the offset of a view; several
        # are put below one another, which copies them.
        return (
            (one, other) if len(one) > 1 else (one.clone(), other.clone()) for one, other in parts
        )

    def _checked(
        self, test: Tensor, reference: Tensor, origin: tuple[int, int, int] = (0, 0, 0)
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return both images in the computing precision, and where they are finite (masked).

        ``origin`` is where a part lies in a larger batch, for messages: item, y, x.
        """
        for name, image in (("test", test), ("reference", reference)):
            if image.ndim != 4 or image.shape[1] != 3 or 0 in image.shape:
                raise ValueError(
                    f"expected a {name} of shape (B, 3, H, W) with no side of 0, "
                    f"got {tuple(image.shape)}"
                )
            if not image.is_floating_point():
                raise ValueError(
                    f"expected a {name} of floating point, got {image.dtype}; "
                    "divide 8-bit values by 255"
                )
        if test.shape != reference.shape:
            raise ValueError(
                "expected two images of one shape, "
                f"got {tuple(test.shape)} and {tuple(reference.shape)}"
            )
        double = torch.float64 in (test.dtype, reference.dtype)
        dtype = torch.float64 if double else torch.float32
        # In one layout: a tensor in another takes other paths through the vectorised loops, and
        # equal images would differ in their last bits.
        test, reference = (
            _widened(test, dtype).contiguous(),
            _widened(reference, dtype).contiguous(),
        )
        if self.nonfinite == "mask":
            return finite_in_both(test, reference)
        if not torch.compiler.is_compiling() and has_values(test):
            _require_finite("test", test, origin)
            _require_finite("reference", reference, origin)
        return test, reference, None


def finite_in_both(test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both images with 0 where a channel of either is not finite, and where all are.

    (B, 3, H, W) twice, and (B, 1, H, W), boolean.
    """
    seen = (torch.isfinite(test) & torch.isfinite(reference)).all(1, keepdim=True)
    return torch.where(seen, test, 0.0), torch.where(seen, reference, 0.0), seen


class _Widen(torch.autograd.Function):
    """A cast to more bits whose gradient saturates on the way back instead of overflowing."""

    generate_vmap_rule = True

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        return tangent.to(ctx.wide)

    @staticmethod
    def forward(image: Tensor, dtype: torch.dtype) -> Tensor:
        return image.to(dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, torch.dtype], _: Tensor) -> None:
        ctx.dtype, ctx.wide = inputs[0].dtype, inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        largest = torch.finfo(ctx.dtype).max
        return gradient.clamp(-largest, largest).to(ctx.dtype), None


def _widened(image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an image in ``dtype``, which holds at least as much as its own."""
    if image.dtype not in (torch.float16, torch.bfloat16):
        return image.to(dtype)
    widened: Tensor = _Widen.apply(image, dtype)
    return widened


def masked(plane: Tensor, seen: Tensor | None) -> Tensor:
    """Return a plane with 0 where a mask (B, 1, H, W) is not set."""
    return plane if seen is None else torch.where(seen, plane, 0.0)


def has_values(image: Tensor) -> bool:
    """Return whether there is anything to read: not in a meta or a fake tensor."""
    return not (image.is_meta or is_fake(image))


def _require_finite(name: str, image: Tensor, origin: tuple[int, int, int]) -> None:
    """Raise where ``image`` has NaN or infinity, naming the first such item and pixel."""
    # One cheap pass: the sum of an image that is not finite is not.
    if bool(torch.isfinite(image.detach().sum())):
        return
    bad = ~torch.isfinite(image.detach())
    if not bool(bad.any()):
        return
    item = int(bad.flatten(1).any(1).nonzero()[0])
    channel, y, x = bad[item].nonzero()[0].tolist()
    raise ValueError(
        f"expected finite pixel values, got {int(bad[item].sum())} NaN or infinite ones in the "
        f"{name}'s batch item {item + origin[0]}, the first in channel {channel} "
        f"at x {x + origin[2]}, y {y + origin[1]}; "
        'repair them or pass nonfinite="mask"'
    )
