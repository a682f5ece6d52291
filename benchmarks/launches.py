"""How many operations a map and a training step are: what a GPU waits for Python.

Counted on the processor, with the schedule that a GPU gets: every operation that PyTorch
dispatches, but for views, which start no kernel; and every launch of a kernel of Triton, which is
not run. No time is measured.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.record import caption, circumstances, save
from benchmarks.rungs import RUNGS
from benchmarks.speed import BATCH, FULL_HD, PATCH, ssim, ssim_loss
from torch_vdm import VDM, VDMLoss
from torch_vdm.run import kernel
from torch_vdm.run.schedule import Job, Schedule, chosen

# What is wanted of the default metric: a map, and a loss with its gradient.
WANTED = {"map": 250, "loss": 400}

# Without a kernel, beside what PyTorch marks as a view.
NO_KERNEL = ("empty", "empty_like", "new_empty", "empty_strided", "detach", "lift_fresh")

Contender = Callable[[Tensor, Tensor], Any]


class Counter(TorchDispatchMode):
    """Counts the operations that start a kernel."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch's own
        self.count = 0

    def __torch_dispatch__(  # noqa: D105  # torch's own
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        del types
        name = func.overloadpacket.__name__
        self.count += not (func.is_view or name in NO_KERNEL)
        return func(*args, **(kwargs or {}))


def run(quick: bool, output: Path | None) -> None:
    """Count, print the table, and write launches.json and launches.md to ``output``."""
    rungs = {name: transform for name, transform in RUNGS.items() if not quick or name == "fast"}
    size, patch = ((64, 96), (32, 32)) if quick else (FULL_HD, PATCH)
    pair, batch = torch.rand(2, 1, 3, *size), torch.rand(2, BATCH, 3, *patch)
    result: dict[str, Any] = {**circumstances(), "size": size, "batch": [BATCH, *patch]}
    maps: dict[str, Contender] = {"kornia SSIM": ssim()}
    losses: dict[str, Contender] = {"kornia SSIM": ssim_loss()}
    for name, transform in rungs.items():
        # Read back once an image, where asked for, and no kernel of the map's.
        options: dict[str, Any] = {"transform": transform, "nonfinite": "mask", "effects": "full"}
        maps[name] = VDM(**options, schedule=of_a_gpu(False))
        maps[f"{name}, a processor's"] = VDM(**options)
        losses[name] = VDMLoss(**options, schedule=of_a_gpu(True))
        losses[f"{name}, a processor's"] = VDMLoss(**options)
        if name == "fast" and find_spec("triton"):
            maps["fast, kernel"] = VDM(**options, schedule=of_a_gpu(False, kernel=True))
            losses["fast, kernel"] = VDMLoss(**options, schedule=of_a_gpu(True, kernel=True))
    with _launched() if find_spec("triton") else nullcontext():
        with torch.no_grad():
            result["map"] = {name: count(function, *pair) for name, function in maps.items()}
        result["loss"] = {name: count(step(loss), *batch) for name, loss in losses.items()}
    result["wanted"] = WANTED
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "launches", result, table)


def count(function: Contender, test: Tensor, reference: Tensor) -> int:
    """Return how many operations a function of two images is, once what it keeps is there."""
    function(test, reference)
    with Counter() as counter:
        function(test, reference)
    return int(counter.count)


def of_a_gpu(gradients: bool, kernel: bool = False) -> Schedule:
    """Return the schedule that a GPU gets, and with the kernel if asked for."""
    job = Job(
        items=1,
        size=FULL_HD,
        stackable=True,
        gradients=gradients,
        one_sided=gradients,  # of a loss, by its test alone
        compiles=False,
        checkpoints=False,
        accelerated=True,
        traced=False,
    )
    return replace(chosen(job), kernel=kernel)


class _OneOperation:
    """Stands for a kernel of Triton: a launch is one operation, and computes nothing."""

    def __getitem__(self, grid: tuple[int, int]) -> Callable[..., Tensor]:
        return lambda *planes, **_: planes[0].clone()


@contextmanager
def _launched() -> Iterator[None]:
    """Let the kernel be launched where there is no GPU."""
    from torch_vdm.run import triton_level

    names = ("local_difference", "slopes", "gradients")
    kernels = SimpleNamespace(numbers_of=triton_level.numbers_of)
    vars(kernels).update((name, _OneOperation()) for name in names)
    with patch.object(kernel, "kernels_on", lambda _: kernels):
        yield


def step(loss: Contender) -> Contender:
    """Return what computes a loss and its gradient."""

    def forward_and_backward(test: Tensor, reference: Tensor) -> None:
        loss(test.detach().requires_grad_(), reference).backward()

    return forward_and_backward


def _table(result: dict[str, Any]) -> str:
    height, width = result["size"]
    items, *patch = result["batch"]
    lines = [
        f"| operations | a map, {width}x{height} | "
        f"loss and gradient, {items}x{patch[0]}x{patch[1]} |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {result['map'][name]:,} | {result['loss'][name]:,} |" for name in result["map"]
    ]
    wanted = result["wanted"]
    lines += [f"| wanted of fast | {wanted['map']} | {wanted['loss']} |", "", caption(result), ""]
    return "\n".join(lines)
