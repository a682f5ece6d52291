"""How many operations a map and a training step are: what a GPU waits for Python.

Counted on the processor, with the schedule that a GPU gets: every operation that PyTorch
dispatches, but for views, which start no kernel; every launch of a kernel of Triton, which is not
run; and, of compiled code, every kernel that is left after fusion, by the rules for a processor. No
time is measured.
"""

import warnings
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
from torch_vdm.run import kernels
from torch_vdm.run.schedule import Job, Schedule, chosen

# What is wanted of the default metric: a map, and a loss with its gradient.
WANTED = {"map": 250, "loss": 400}
WANTED_COMPILED = {"map": 60, "loss": 120}

# Without a kernel, beside what PyTorch marks as a view.
NO_KERNEL = (
    *("empty", "empty_like", "new_empty", "empty_strided", "detach", "lift_fresh", "_unsafe_view"),
)

Contender = Callable[[Tensor, Tensor], Any]


class Counter(TorchDispatchMode):
    """Counts the operations that start a kernel."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch's own
        self.count = 0

    @classmethod
    def ignore_compile_internals(cls) -> bool:
        """Return that compiled code runs compiled, and is counted by `compiled_kernels`."""
        return True

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
        if name == "fast":
            for more, how in _others().items():
                maps[f"fast, {more}"] = VDM(**options, schedule=of_a_gpu(False, **how))
                if not (quick and "compiled" in how):  # a smoke test has no time for it
                    losses[f"fast, {more}"] = VDMLoss(**options, schedule=of_a_gpu(True, **how))
    # Kernels that are not run leave anything as images.
    warnings.filterwarnings("ignore", "expected sRGB-coded values")
    with _launched() if find_spec("triton") else nullcontext(), compiled_kernels() as kernels_run:
        with torch.no_grad():
            result["map"] = {name: count(each, kernels_run, *pair) for name, each in maps.items()}
        result["loss"] = {
            name: count(step(loss), kernels_run, *batch) for name, loss in losses.items()
        }
    result["wanted"], result["wanted_compiled"] = WANTED, WANTED_COMPILED
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "launches", result, table)


def _others() -> dict[str, dict[str, bool]]:
    """Return by name how the default metric is computed besides."""
    found = {"compiled": {"compiled": True}}
    if find_spec("triton"):
        found["kernel"] = {"kernel": True}
        found["compiled, kernel"] = {"compiled": True, "kernel": True}
    return found


def count(function: Contender, kernels_run: list[int], test: Tensor, reference: Tensor) -> int:
    """Return how many operations a function of two images is, once what it keeps is there.

    ``kernels_run``: of `compiled_kernels`.
    """
    function(test, reference)
    function(test, reference)
    kernels_run.clear()
    with Counter() as counter:
        function(test, reference)
    return int(counter.count) + sum(kernels_run)


@contextmanager
def compiled_kernels() -> Iterator[list[int]]:
    """Yield a list to which every call of a compiled graph adds how many kernels it has.

    The graph must have been compiled within. torch has no public way to tell.
    """
    from torch._functorch import config as autograd
    from torch._inductor import config as inductor
    from torch._inductor.output_code import CompiledFxGraph
    from torch._inductor.scheduler import NopKernelSchedulerNode
    from torch._inductor.virtualized import V

    found: list[int] = []
    made, called = CompiledFxGraph.__init__, CompiledFxGraph.__call__

    def fused(nodes: list[Any]) -> list[Any]:
        graph: Any = V.graph
        graph.kernels = sum(not isinstance(node, NopKernelSchedulerNode) for node in nodes)
        return nodes

    def init(self: Any, code: Any, graph: Any, *others: Any, **options: Any) -> None:
        made(self, code, graph, *others, **options)
        self.kernels = graph.kernels

    def call(self: Any, inputs: Any) -> Any:
        found.append(self.kernels)
        return called(self, inputs)

    with (
        # What was compiled before would be without its number.
        inductor.patch({"_post_fusion_custom_pass": fused, "fx_graph_cache": False}),
        autograd.patch({"enable_autograd_cache": False}),
        patch.object(CompiledFxGraph, "__init__", init),
        patch.object(CompiledFxGraph, "__call__", call),
    ):
        yield found


def of_a_gpu(gradients: bool, kernel: bool = False, compiled: bool = False) -> Schedule:
    """Return the schedule that a GPU gets, and with the kernels if asked for."""
    job = Job(
        items=1,
        size=FULL_HD,
        stackable=True,
        gradients=gradients,
        one_sided=gradients,  # of a loss, by its test alone
        compiles=compiled,
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
    from torch_vdm.run.kernels import triton_level

    names = (
        "local_difference",
        "slopes",
        "gradients",
        "analysis",
        "synthesis",
        "descent",
        "ascent",
        "finite_in_both",
    )
    fake = SimpleNamespace(numbers_of=triton_level.numbers_of)
    vars(fake).update((name, _OneOperation()) for name in names)
    with patch.object(kernels, "of", lambda *_: fake):
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
    for name, of_map in result["map"].items():
        of_loss = f"{result['loss'][name]:,}" if name in result["loss"] else ""
        lines.append(f"| {name} | {of_map:,} | {of_loss} |")
    for name, wanted in (("eager", result["wanted"]), ("compiled", result["wanted_compiled"])):
        lines += [f"| wanted of fast, {name} | {wanted['map']} | {wanted['loss']} |"]
    lines += ["", caption(result), ""]
    return "\n".join(lines)
