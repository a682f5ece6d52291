"""Functions of planes, compiled once for every size."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from threading import Lock
from typing import Any, NamedTuple

import torch

# Planes with fewer elements stay uncompiled: a compiled call costs more than they do.
# Status: choice.
SMALLEST = 4096

# How many compiled forms of one function are kept, by dtype, gradients and options. Status: choice.
MOST_FORMS = 256

# The share of intermediate results that may be kept for the backward pass; the rest is recomputed
# there. Left alone, the compiler keeps masks, which are written element by element. Status:
# choice, measured.
KEPT = 0.3

# Whether `for_any_size` is in force: asking the compiler's settings takes longer.
_is_set: ContextVar[bool] = ContextVar("_is_set", default=False)


class _Settings(NamedTuple):
    """The settings of the compiler that are changed."""

    use_duck_shape: bool
    recompile_limit: int
    activation_memory_budget: float

    def for_any_size(self) -> "_Settings":
        return _Settings(
            # Otherwise two sides that are equal in the first image would be assumed equal for ever,
            # and the first image that is not square would compile everything again.
            use_duck_shape=False,
            # For every mix of precision, gradients, display, observer and effects in one process.
            recompile_limit=max(MOST_FORMS, self.recompile_limit),
            activation_memory_budget=min(KEPT, self.activation_memory_budget),
        )


@dataclass(eq=False)
class _Change:
    """A change of settings that is in force, and for how many calls."""

    before: _Settings
    to: _Settings
    calls: int = 0


_lock = Lock()
_changes: list[_Change] = []


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the compiled form of a pure function of tensors.

    It serves every height and width. A batch of one is compiled separately from larger ones, so
    pass one item at a time, or several stacked vertically. Do not pass views: it is specialised on
    offsets too.
    """
    # Imported where it is used: this takes longer than the rest of the package.
    from torch._inductor import config as inductor

    specialised = torch.compile(
        function,
        dynamic=True,
        fullgraph=True,
        options={
            # The functions and numbers that it refers to do not change; checking that in every
            # call takes longer than the rest of its checks.
            "guard_filter_fn": torch.compiler.skip_guard_on_globals_unsafe,
            # The vector instructions that the processor reports are trusted, unless the user set
            # otherwise: trying them out compiles, and starts another process, for every kind. A
            # compiler that knows torch's headers knows them.
            "cpp.vec_isa_ok": inductor.cpp.vec_isa_ok is not False,
        },
    )

    def call(*arguments: object) -> Any:
        if torch.compiler.is_compiling():
            return function(*arguments)
        if _is_set.get():
            return specialised(*arguments)
        with for_any_size():
            return specialised(*arguments)

    return call


@contextmanager
def for_any_size() -> Iterator[None]:
    """Compile forms for any size, keep many of them, and keep few of their intermediate results.

    Every call does so by itself; around many calls it costs less than around each.
    """
    from torch._dynamo import config as dynamo
    from torch._functorch import config as gradients
    from torch.fx.experimental import _config as shapes

    def now() -> _Settings:
        return _Settings(
            shapes.use_duck_shape, dynamo.recompile_limit, gradients.activation_memory_budget
        )

    def set_to(settings: _Settings) -> None:
        shapes.use_duck_shape, dynamo.recompile_limit, gradients.activation_memory_budget = settings

    with _lock:
        before = now()
        # Where settings belong to the process, and not to each thread, another thread may have
        # changed them already: then the last to finish restores them.
        change = next((change for change in _changes if change.to == before), None)
        if change is None:
            change = _Change(before, before.for_any_size())
            _changes.append(change)
            set_to(change.to)
        change.calls += 1
    token = _is_set.set(True)
    try:
        yield
    finally:
        _is_set.reset(token)
        with _lock:
            change.calls -= 1
            if change.calls == 0:
                _changes.remove(change)
                set_to(change.before)
