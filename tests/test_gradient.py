"""Gradients that are worked out by hand, against autograd's."""

import pytest
import torch
from torch import Tensor

from torch_vdm import VDM, Display, Effects, VDMLoss
from torch_vdm.model.display import linear_values
from torch_vdm.run import schedule, whole
from torch_vdm.run.gradients.light import linear_by_hand

# Images here are numbers that need be no pictures.
pytestmark = pytest.mark.filterwarnings("ignore:expected sRGB-coded values:UserWarning")


@pytest.fixture(autouse=True)
def level_by_level(monkeypatch: pytest.MonkeyPatch) -> None:
    # As a large image is: small levels are autograd's.
    monkeypatch.setattr(schedule, "FEW_NODES", 1)
    monkeypatch.setattr(schedule, "LARGEST_AT_ONCE", 500)


def leave_to_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (whole, schedule):
        monkeypatch.setattr(module, "by_hand", lambda: False)


def gradients(
    metric: VDM, images: tuple[Tensor, Tensor], wanted: tuple[bool, bool]
) -> list[Tensor | None]:
    leaves = [
        image.clone().requires_grad_(want) for image, want in zip(images, wanted, strict=True)
    ]
    power = metric.power(leaves[0], leaves[1])
    weights = torch.linspace(0.5, 2.0, power.numel(), dtype=power.dtype).view_as(power)
    (power * weights).sum().backward()
    return [leaf.grad for leaf in leaves]


def noise(size: tuple[int, int], scale: float = 1.0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(sum(size))
    test, reference = scale * torch.rand(
        2, 2, 3, *size, dtype=torch.float64, generator=generator
    ) - 0.1 * (scale - 1.0)
    return test, reference


@pytest.mark.parametrize("wanted", [(True, False), (False, True), (True, True)])
@pytest.mark.parametrize("size", [(2, 2), (7, 12), (33, 20)], ids=str)
def test_is_autograds(
    size: tuple[int, int], wanted: tuple[bool, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = gradients(VDM(), noise(size), wanted)
    leave_to_autograd(monkeypatch)
    for mine, theirs in zip(ours, gradients(VDM(), noise(size), wanted), strict=True):
        # Of the largest: a slope may be what two that are millions of times as large leave.
        largest = 0.0 if theirs is None else float(theirs.abs().max())
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-15 * largest)


@pytest.mark.parametrize(
    "metric",
    [
        VDM(effects=Effects(chromatic=False)),
        VDM(effects=Effects(aberration=False)),
        VDM(30.0, Display.linear(200.0)),
        VDM(30.0, Display.xyz()),
    ],
    ids=str,
)
def test_is_autograds_for_every_option(metric: VDM, monkeypatch: pytest.MonkeyPatch) -> None:
    # HDR, with values below 0.
    ours = gradients(metric, noise((12, 9), 30.0), (True, True))
    leave_to_autograd(monkeypatch)
    for mine, theirs in zip(
        ours, gradients(metric, noise((12, 9), 30.0), (True, True)), strict=True
    ):
        assert mine is not None
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9 * float(mine.abs().max()))


def test_is_autograds_for_one_plane_of_grey(monkeypatch: pytest.MonkeyPatch) -> None:
    metric = VDM(60.0, Display.linear(100.0))
    images = [image[:1, :1].expand(-1, 3, -1, -1) for image in noise((33, 20))]

    def slopes(grey: bool) -> list[Tensor]:
        leaves = [image[:, :1].clone().requires_grad_(True) for image in images]
        first, second = (metric.represent(leaf.expand(-1, 3, -1, -1), grey=grey) for leaf in leaves)
        power = metric.compare(first, second)
        (power * torch.linspace(0.5, 2.0, power.numel()).view_as(power)).sum().backward()
        return [leaf.grad for leaf in leaves if leaf.grad is not None]

    ours, of_three = slopes(True), slopes(False)
    leave_to_autograd(monkeypatch)
    theirs = slopes(True)
    assert len(ours) == len(theirs) == len(of_three) == 2
    for mine, other, three in zip(ours, theirs, of_three, strict=True):
        scale = float(three.abs().max())
        torch.testing.assert_close(mine, other, rtol=1e-10, atol=1e-14 * scale)
        torch.testing.assert_close(mine, three, rtol=1e-9, atol=1e-11 * scale)


def test_is_of_use_on_the_default_route() -> None:
    # Else the others would compare autograd with itself.
    test, reference = noise((64, 64))
    graph = VDM().power(test.requires_grad_(), reference).grad_fn
    seen, left = set(), [graph]
    while left:
        if (node := left.pop()) is not None and node not in seen:
            seen.add(node)
            left += [each for each, _ in node.next_functions]
    names = {node.name() for node in seen}
    steps = ("_LocalDifference", "_Analysis", "_AnalysisAtBorder", "_LinearValues", "_Mixed")
    assert {f"{step}Backward" for step in (*steps, "_PassedDown")} <= names


@pytest.mark.parametrize(
    "display",
    [Display.srgb(), Display.srgb(1e5), Display.linear(), Display.linear(1e11), Display.xyz()],
    ids=str,
)
def test_slope_of_linear_values_is_autograds_within_limits_and_0_beyond(display: Display) -> None:
    values = [-2e13, -2e4, -1.0, 0.0, 0.04, 0.041, 0.5, 1.0, 3.0, 9e3, 2e4, 2e13]
    image = torch.tensor(values, dtype=torch.float64).view(1, 3, 2, 2)
    weights = torch.linspace(0.5, 2.0, len(values), dtype=torch.float64).view_as(image)
    around = display.encoding, display.limit(image)
    slopes: list[Tensor] = []
    for function in (linear_values, linear_by_hand):
        leaf = image.clone().requires_grad_()
        slopes += torch.autograd.grad((function(leaf, *around) * weights).sum(), leaf)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-12, atol=0.0)
    assert slopes[0].flatten()[0] == slopes[0].flatten()[-1] == 0.0
    assert torch.count_nonzero(slopes[0]) >= 3


@pytest.mark.parametrize("name", ["transducer_exponent", "summation_exponent", "opponents"])
def test_a_constant_that_is_fitted_has_its_gradient(name: str) -> None:
    metric = VDM()
    test, reference = noise((12, 9))
    constant = metric.get_buffer(name).requires_grad_()
    (slope,) = torch.autograd.grad(metric.power(test, reference).sum(), constant)
    with torch.no_grad():
        step = 1e-6 * torch.ones_like(constant)
        ends = []
        for way in (1.0, -1.0):
            constant += way * step
            ends.append(metric.power(test, reference).sum())
            constant -= way * step
    torch.testing.assert_close(slope.sum(), (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_is_0_at_equality(value: float) -> None:
    image = torch.full((1, 3, 16, 16), value)
    for slope in gradients(VDM(), (image, image), (True, True)):
        assert slope is not None
        assert torch.count_nonzero(slope) == 0


def test_can_be_differentiated_again() -> None:
    test, reference = (image[:1, :, :4, :3] + 0.1 for image in noise((4, 3)))
    loss = VDMLoss(20.0)
    both = test.requires_grad_(), reference.requires_grad_()
    assert torch.autograd.gradcheck(loss, both)
    assert torch.autograd.gradgradcheck(loss, both)


# Torch's own, from the first use of a forward derivative.
@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:FutureWarning")
def test_functional_transforms_take_autograds_way() -> None:
    metric = VDM()
    test, reference = noise((12, 9))

    def total(image: Tensor) -> Tensor:
        return metric.power(image, reference).sum()

    image = test.clone().requires_grad_()
    (plain,) = torch.autograd.grad(total(image), image)
    torch.testing.assert_close(torch.func.grad(total)(test), plain)
    tangent = torch.ones_like(test)
    change = torch.func.jvp(total, (test,), (tangent,))[1]
    torch.testing.assert_close(change, (plain * tangent).sum())


def test_vmap_gives_every_item_its_own_map_and_gradient() -> None:
    test, reference = noise((12, 9))
    loss = VDMLoss(nonfinite="mask")

    def of_one(one: Tensor, other: Tensor) -> Tensor:
        value: Tensor = loss(one[None], other[None])
        return value

    gradients = torch.vmap(torch.func.grad(of_one))(test, reference)
    for one, other, gradient in zip(test, reference, gradients, strict=True):
        torch.testing.assert_close(torch.func.grad(of_one)(one, other), gradient)
    metric = VDM(nonfinite="mask")
    maps = torch.vmap(lambda one, other: metric(one[None], other[None])[0])(test, reference)
    torch.testing.assert_close(maps, metric(test, reference))
