"""Kernels, run by Triton's interpreter, against the model's own steps."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from benchmarks.places import ROOT
from torch_vdm import VDM, Effects, Haar, Observer, Steerable, VDMLoss
from torch_vdm.images import finite_in_both
from torch_vdm.model.charging import Charge
from torch_vdm.model.cortex import Cortex
from torch_vdm.model.distance import Paths, accumulate
from torch_vdm.model.grid import Grid
from torch_vdm.model.steps import Steps
from torch_vdm.run import kernels
from torch_vdm.run import schedule as limits
from torch_vdm.run.column import joined
from torch_vdm.run.kernels import level as of_a_level
from torch_vdm.run.kernels.descent import accumulated
from torch_vdm.run.kernels.mask import finite_in_both as finite_in_both_by_kernel
from torch_vdm.run.schedule import Schedule

pytest.importorskip("triton", reason="Triton is not installed")

PLAIN, KERNEL = Schedule(), Schedule(kernel=True)

# What the interpreter takes long for is a program, however many nodes it has.
BLOCK, LARGE_BLOCK = 64, 4096

# Of float32 and float64, relative: log2 and the order of sums are others.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}


@pytest.fixture(scope="module", autouse=True)
def interpreted() -> Iterator[None]:
    # Set while the kernels are made, and only then: other tests compile by Triton.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_INTERPRET", "1")
        from torch_vdm.run.kernels import triton_descent, triton_haar, triton_level, triton_mask
    for module in (triton_descent, triton_haar, triton_level, triton_mask):
        assert module.INTERPRETED
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "BLOCK", BLOCK)
        yield


def level_of(
    kind: str, size: tuple[int, int], before: tuple[int, int], batch: int, dtype: torch.dtype
) -> tuple[Cortex, Cortex]:
    """Return two images of two levels, of which the second has nodes of ``size``."""
    generator = torch.Generator().manual_seed(sum(size))
    parents = [(side + first + 1) // 2 for side, first in zip(size, before, strict=True)]

    def image() -> Cortex:
        details = torch.randn(batch, 3, 3, *size, generator=generator, dtype=torch.float64)
        light = torch.rand(batch, 3, *parents, generator=generator, dtype=torch.float64)
        match kind:
            case "pictures" | "a picture and black":
                details, light = 10.0 * details, 100.0 * light
            case "faint":
                details, light = 1e-3 * details, 100.0 * light
            case "in the dark":
                details, light = 1e-6 * details, 1e-5 * light
            case "out of gamut":  # and far beyond the largest difference
                details, light = 1e9 * details, light - 0.5
        planes = details.to(dtype), light.to(dtype)
        root = planes[0].new_zeros(batch, 3, 3, *parents)
        grid = Grid(*((0, first) for first in before))
        mean = planes[1].mean((-2, -1), keepdim=True)
        return Cortex((root, planes[0]), (planes[1], planes[0][:, :, 0]), mean, grid=grid)

    first, second = image(), image()
    return first, second.each(torch.zeros_like) if kind == "a picture and black" else second


def of_level(
    schedule: Schedule, first: Cortex, second: Cortex, wanted: tuple[bool, bool] | None = None
) -> list[Tensor]:
    """Return the local visual difference of the second level, and what gradients are wanted."""
    model = VDM(30.0).model(first.mean.dtype)
    if wanted is not None:
        first, second = (
            cortex.each(lambda plane, want=want: plane.clone().requires_grad_(want))
            for cortex, want in zip((first, second), wanted, strict=True)
        )
    level = model.levels(0, 2).only(1)
    if schedule.kernel:
        local = of_a_level.local_difference(model, first, second, 1, level)
    else:
        local = model.local_difference(first, second, 1, level)
    if wanted is None:
        return [local]
    weights = torch.linspace(0.5, 2.0, local.numel(), dtype=local.dtype).view_as(local)
    planes = [
        plane
        for cortex, want in zip((first, second), wanted, strict=True)
        if want
        for plane in (cortex.details[1], cortex.lowpass[0])
    ]
    return [local.detach(), *torch.autograd.grad((local * weights).sum(), planes)]


def assert_close(actual: list[Tensor], expected: list[Tensor]) -> None:
    assert len(actual) == len(expected)
    for mine, plain in zip(actual, expected, strict=True):
        assert mine.dtype == plain.dtype
        assert mine.isfinite().all()
        tolerance, largest = TOLERANCE[plain.dtype], float(plain.abs().max())
        torch.testing.assert_close(mine, plain, rtol=tolerance, atol=tolerance * largest)


KINDS = ("pictures", "a picture and black", "faint", "in the dark", "out of gamut")


@pytest.mark.parametrize(
    ("size", "before", "batch", "dtype"),
    [
        ((1, 1), (0, 0), 3, torch.float32),
        ((1, 7), (0, 1), 1, torch.float32),
        ((2, 4097), (1, 1), 1, torch.float32),
        ((33, 65), (1, 0), 3, torch.float32),
        ((7, 5), (0, 1), 1, torch.float64),
    ],
    ids=str,
)
def test_a_level_is_the_models(
    size: tuple[int, int],
    before: tuple[int, int],
    batch: int,
    dtype: torch.dtype,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kernels, "BLOCK", LARGE_BLOCK)
    images = level_of("pictures", size, before, batch, dtype)
    (plain,) = of_level(PLAIN, *images)
    (mine,) = of_level(KERNEL, *images)
    torch.testing.assert_close(mine, plain, rtol=TOLERANCE[dtype], atol=0.0)
    assert torch.count_nonzero(of_level(KERNEL, images[0], images[0])[0]) == 0


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [*((kind, torch.float32) for kind in KINDS), ("pictures", torch.float64)],
    ids=str,
)
def test_gradients_are_autograds(kind: str, dtype: torch.dtype) -> None:
    images = level_of(kind, (5, 11), (1, 0), 1, dtype)
    wanted = (True, True)
    assert_close(of_level(KERNEL, *images, wanted), of_level(PLAIN, *images, wanted))


@pytest.mark.parametrize(
    ("size", "before", "batch"), [((1, 1), (0, 0), 2), ((2, 33), (0, 1), 1)], ids=str
)
def test_gradients_of_several_programs(
    size: tuple[int, int], before: tuple[int, int], batch: int
) -> None:
    images = level_of("pictures", size, before, batch, torch.float64)
    wanted = (True, True)
    assert_close(of_level(KERNEL, *images, wanted), of_level(PLAIN, *images, wanted))


def test_gradients_of_equal_images_are_0() -> None:
    image, _ = level_of("pictures", (3, 2), (0, 0), 1, torch.float32)
    local, *gradients = of_level(KERNEL, image, image, (True, True))
    assert not any(plane.any() for plane in (local, *gradients))


@pytest.mark.parametrize("wanted", [(True, False), (False, True)], ids=str)
def test_only_what_is_wanted(wanted: tuple[bool, bool]) -> None:
    images = level_of("pictures", (5, 4), (0, 1), 1, torch.float64)
    assert_close(of_level(KERNEL, *images, wanted), of_level(PLAIN, *images, wanted))


def steps_of(
    steps: Steps, size: tuple[int, int], true_means: bool, dtype: torch.dtype
) -> list[Tensor]:
    """Return the planes of a decomposition, and the gradient of their weighted sum."""
    generator = torch.Generator().manual_seed(sum(size))
    image = torch.rand(2, 3, *size, generator=generator, dtype=torch.float64).to(dtype)
    cortex = Haar().decompose(image.requires_grad_(), steps, true_means)
    planes = [*cortex.details, *cortex.lowpass, *(cortex.windows or ())]
    weights = (torch.rand(plane.shape, generator=generator) for plane in planes)
    total = torch.stack([(p * w).sum() for p, w in zip(planes, weights, strict=True)]).sum()
    (slope,) = torch.autograd.grad(total, image)
    return [*(plane.detach() for plane in planes), slope]


def decomposed(size: tuple[int, int]) -> Cortex:
    return Haar().decompose(torch.zeros(1, 3, *size), true_means=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("true_means", [True, False])
@pytest.mark.parametrize("size", [(2, 1), (1, 9), (3, 3), (16, 16), (33, 20), (6, 64)], ids=str)
def test_a_decomposition_is_the_models(
    size: tuple[int, int], true_means: bool, dtype: torch.dtype
) -> None:
    actual, expected = (steps_of(steps, size, true_means, dtype) for steps in (KERNEL, Steps()))
    assert_close(actual, expected)


def test_a_uniform_image_has_no_details() -> None:
    image = torch.full((1, 3, 13, 6), 0.7)
    for details in Haar().decompose(image, KERNEL, True).details:
        assert torch.count_nonzero(details) == 0


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("size", [(1, 2), (9, 5), (33, 70)], ids=str)
def test_the_way_down_is_the_models(size: tuple[int, int], batch: int) -> None:
    grid = Haar().grid(size, true_means=True)
    sizes = [(plane.shape[-2], plane.shape[-1]) for plane in decomposed(size).lowpass]
    before = grid.down(len(sizes))
    generator = torch.Generator().manual_seed(sum(size))

    def planes(*sides: tuple[int, int]) -> list[Tensor]:
        return [
            torch.rand(batch, 1, *each, dtype=torch.float64, generator=generator) for each in sides
        ]

    local, shares, (root, weights) = planes(*sizes), planes(*sizes), planes((1, 1), sizes[-1])
    found = []
    for by_kernel in (True, False):
        leaves = [plane.clone().requires_grad_() for plane in (*local, *shares, root)]
        of = tuple(leaves[: len(sizes)])
        charges = [Charge(share, None) for share in leaves[len(sizes) : -1]]
        if by_kernel:
            column = Charge(joined([charge.inherited for charge in charges]), None)
            total = accumulated(Paths(of, (), leaves[-1]), column, before)
        else:
            total = accumulate(of, leaves[-1], before, charges)
        slopes = torch.autograd.grad((total * weights).sum(), leaves)
        found.append([total.detach(), *slopes])
    assert_close(*found)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("size", [(1, 1), (5, 7), (64, 64), (70, 66)], ids=str)
def test_what_is_not_finite_is_replaced_as_ever(size: tuple[int, int], dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(sum(size))
    test, reference = torch.rand(2, 2, 3, *size, generator=generator, dtype=dtype)
    lost = torch.rand(2, 2, 3, *size, generator=generator) < 0.2
    test[lost[0]], reference[lost[1]] = torch.nan, -torch.inf
    # Of one item no square up to the largest has a finite pixel.
    test[1, 0, :64, :64], reference[1, 2, :64, :64] = torch.inf, torch.nan
    expected, actual = (of(test, reference) for of in (finite_in_both, finite_in_both_by_kernel))
    assert torch.equal(actual[2], expected[2])
    assert actual[2].dtype == torch.bool
    assert_close(list(actual[:2]), list(expected[:2]))
    assert torch.equal(actual[0][1, :, :64, :64], torch.zeros_like(test[1, :, :64, :64]))


def test_gradients_pass_where_both_images_are_finite() -> None:
    test, reference = torch.rand(2, 1, 3, 6, 5)
    test[..., 2, 3] = torch.nan
    for wanted in ((True, True), (True, False), (False, True)):
        leaves = [
            image.clone().requires_grad_(want)
            for image, want in zip((test, reference), wanted, strict=True)
        ]
        *images, seen = finite_in_both_by_kernel(*leaves)
        assert tuple(image.requires_grad for image in images) == wanted
        for image, leaf in zip(images, leaves, strict=True):
            if leaf.requires_grad:
                (slope,) = torch.autograd.grad((image * image).sum(), leaf, retain_graph=True)
                assert torch.equal(slope, torch.where(seen, 2.0 * leaf.detach(), 0.0))


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    test, reference = torch.rand(2, 1, 3, height, width, dtype=torch.float64, generator=generator)
    return test, reference


def map_and_gradients(schedule: Schedule, images: tuple[Tensor, Tensor]) -> list[Tensor]:
    metric, loss = VDM(30.0, schedule=schedule), VDMLoss(30.0, schedule=schedule)
    leaves = [image.clone().requires_grad_() for image in images]
    with torch.no_grad():
        jnd = metric(*images)
    return [jnd, *torch.autograd.grad(loss(*leaves), leaves)]


def test_maps_and_losses() -> None:
    images = pair(5, 6)
    schedule = Schedule(kernel=True, together=True, cached=False, few=limits.EVERY_LEVEL)
    actual, expected = (map_and_gradients(each, images) for each in (schedule, PLAIN))
    assert_close(actual, expected)


def test_masked_maps_and_losses() -> None:
    images = pair(9, 6)
    images[0][..., 3, 2], images[1][..., 3, 2] = torch.nan, torch.inf
    found = []
    for schedule in (KERNEL, PLAIN):
        test = images[0].clone().requires_grad_()
        loss = VDMLoss(30.0, schedule=schedule, nonfinite="mask")
        with torch.no_grad():
            jnd = loss.metric(*images)
        found.append([jnd, *torch.autograd.grad(loss(test, images[1]), test)])
    assert_close(*found)


def test_grey_images_too() -> None:
    image, other = (plane[:, :1].expand(-1, 3, -1, -1) for plane in pair(4, 3))
    assert not VDM(schedule=KERNEL).plan(image, other).grey
    torch.testing.assert_close(VDM(schedule=KERNEL)(image, other), VDM()(image, other))


@pytest.mark.parametrize("batches", [(1, 2), (2, 1)], ids=str)
def test_one_image_is_compared_with_many(batches: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(3)
    images = [
        torch.rand(batch, 3, 3, 4, dtype=torch.float64, generator=generator) for batch in batches
    ]
    found = []
    for schedule in (KERNEL, PLAIN):
        metric = VDM(30.0, schedule=schedule)
        leaves = [image.clone().requires_grad_() for image in images]
        power = metric.compare(*map(metric.represent, leaves))
        assert len(power) == 2
        found.append([power.detach(), *torch.autograd.grad(power.sum(), leaves)])
    assert_close(*found)


def test_images_without_values_are_refused() -> None:
    with FakeTensorMode():
        image = torch.rand(1, 3, 4, 4)
        with pytest.raises(ValueError, match=r"expected images on a GPU .* without values"):
            VDM(schedule=KERNEL)(image, image)


def test_strips_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "STRIP", 512)
    monkeypatch.setattr(kernels, "BLOCK", LARGE_BLOCK)
    images = pair(66, 17)
    strips = VDM(schedule=Schedule("strips", kernel=True))
    torch.testing.assert_close(strips(*images), VDM()(*images))


def test_the_gradient_of_the_gradient_is_autograds() -> None:
    images = pair(3, 2)
    found = []
    for schedule in (KERNEL, PLAIN):
        leaves = [image.clone().requires_grad_() for image in images]
        loss = VDMLoss(schedule=schedule)(*leaves)
        slopes = torch.autograd.grad(loss, leaves, create_graph=True)
        total = torch.stack([slope.square().sum() for slope in slopes]).sum()
        found.append([loss.detach(), *torch.autograd.grad(total, leaves)])
    assert_close(*found)


def test_what_it_cannot_do_is_done_by_the_models_steps() -> None:
    images = pair(6, 5)
    found = []
    for schedule in (KERNEL, PLAIN):
        metric = VDM(schedule=schedule, nonfinite="mask")
        (slope,) = torch.func.grad(lambda *pair: metric.power(*pair).sum(), (0,))(*images)  # noqa: B023
        constant = metric.get_buffer("opponents").requires_grad_()
        power = metric.power(*images)
        found.append([slope, *torch.autograd.grad(power.sum(), constant)])
    assert_close(*found)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"observer": Observer.paper()}, 'with the observer "paper"'),
        (
            {"observer": dataclasses.replace(Observer.calibrated(), summation_exponent=4.0)},
            "with the observer",
        ),
        ({"transform": Steerable()}, "with Steerable"),
        ({"transform": Haar("filter")}, "with Haar"),
        ({"effects": Effects(pooling=False)}, "with effects left out"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_has_no_kernel_is_refused(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match="expected a schedule without the kernel") as refused:
        VDM(**{"schedule": KERNEL, **options})
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_triton_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "find_spec", lambda _: None)
    with pytest.raises(ValueError, match=r"expected Triton .*: pip install triton"):
        VDM(schedule=KERNEL)


def test_without_a_gpu_it_is_refused_and_still_compiled_for_one(tmp_path: Path) -> None:
    # In a process without the interpreter.
    code = """
import torch, triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from torch_vdm import VDM
from torch_vdm.run.kernels import triton_descent, triton_haar, triton_level, triton_mask
from torch_vdm.run.schedule import Schedule
image = torch.rand(1, 3, 8, 8)
try:
    VDM(schedule=Schedule(kernel=True))(image, image)
except ValueError as error:
    print(error)
names = {
    triton_level: ("local_difference", "slopes", "gradients"),
    triton_haar: ("analysis", "synthesis"),
    triton_descent: ("descent", "ascent"),
    triton_mask: ("finite_in_both",),
}
for module, kernel in ((m, getattr(m, name)) for m in names for name in names[m]):
    constants = {name: True for name in kernel.arg_names if name in ("first", "second", "border")}
    constants["block"] = 64 if module is triton_mask else 128
    types = {name: "*fp32" for name in module.PLANES}
    types |= {name: "*i32" for name in getattr(module, "TABLES", ())}
    types |= {name: "*u8" for name in getattr(module, "BYTES", ())}
    types |= {name: "i32" for name in module.SIZES}
    types |= {name: "constexpr" for name in constants}
    source = ASTSource(kernel, {name: types[name] for name in kernel.arg_names}, constants)
    compiled = triton.compile(source, GPUTarget("cuda", 80, 32), {"enable_fp_fusion": False})
    print(len(compiled.asm["cubin"]) > 0)
"""
    environment = os.environ | {"TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment
    )
    assert done.returncode == 0, done.stderr
    refusal, *compiled = done.stdout.splitlines()
    assert refusal.startswith(
        "expected images on a GPU for a schedule with the kernel, got them on"
    )
    assert compiled == ["True"] * 8
