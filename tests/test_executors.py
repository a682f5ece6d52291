"""The law of executors: each gives what the model gives, step by step."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad

from torch_vdm import VDM, Effects, Haar, Observer, StationaryHaar, Steerable, VDMLoss
from torch_vdm.model.cortex import Transform
from torch_vdm.model.model import Model
from torch_vdm.model.steps import PLAIN
from torch_vdm.run import schedule as limits
from torch_vdm.run import strips, whole
from torch_vdm.run.schedule import EVERY_LEVEL, Job, Schedule, chosen

TRANSFORMS = [Haar(), Haar("filter"), StationaryHaar(), StationaryHaar("filter"), Steerable()]

# The default, and others that a pair may get; each with the route that is to be taken.
ACCELERATED = Schedule(together=True, cached=False, few=EVERY_LEVEL)
SCHEDULES = {
    "coarse levels at once": Schedule(few=64),
    "levels one by one": Schedule(few=0),
    "both images together": Schedule(together=True, few=64),
    "a GPU's": ACCELERATED,
    "a GPU's, compiled": dataclasses.replace(ACCELERATED, compiled=True),
    "a GPU's, computed again": dataclasses.replace(ACCELERATED, again=True, few=16),
    "strips": Schedule("strips", few=64),
    "computed again": Schedule("strips", again=True, few=16),
    "stacked": Schedule(stacked=True, compiled=True, few=64),
}


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    # What large images are cut into.
    for name, value in (("STRIP", 1024), ("BAND_STRIP", 512), ("LARGEST_AT_ONCE", 500)):
        monkeypatch.setattr(limits, name, value)
    # Stacked as for the compiler, however small the planes are, but not compiled.
    monkeypatch.setattr(limits, "SMALLEST", 1)
    monkeypatch.setattr(limits, "compiled", lambda function: function)


def pair(size: tuple[int, int], batch: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    first, second = torch.rand(2, batch, 3, *size, generator=generator, dtype=torch.float64)
    # Equal in a part of it.
    second[..., : size[1] // 3] = first[..., : size[1] // 3]
    return first, second


def power_and_gradients(
    power: Callable[[Tensor, Tensor], Tensor], images: tuple[Tensor, Tensor]
) -> list[Tensor]:
    leaves = [image.clone().requires_grad_() for image in images]
    total = power(*leaves)
    weights = torch.linspace(0.5, 2.0, total.numel(), dtype=total.dtype).view_as(total)
    return [total.detach(), *torch.autograd.grad((total * weights).sum(), leaves)]


# Items lie below one another with `Haar` alone, and strips are of images with four levels or more.
CASES = [
    pytest.param(size, name, transform, id=f"{size}, {name}, {transform}")
    for size in ((1, 1), (2, 7), (130, 33))
    for name, schedule in SCHEDULES.items()
    for transform in TRANSFORMS
    if (transform == Haar() or not schedule.stacked)
    and (min(size) > 30 or schedule.pieces == "whole")
]


@pytest.mark.parametrize(
    "observer", [Observer.calibrated(), Observer.paper()], ids=lambda observer: observer.name
)
@pytest.mark.parametrize(("size", "name", "transform"), CASES)
def test_every_executor_gives_what_the_model_gives(
    size: tuple[int, int],
    name: str,
    transform: Transform,
    observer: Observer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    schedule, images = SCHEDULES[name], pair(size)
    metric = VDM(30.0, observer=observer, transform=transform, schedule=schedule)
    model = metric.model(torch.float64, PLAIN)
    expected = power_and_gradients(
        lambda one, other: model.to_pixels(model.difference(one, other), size), images
    )
    # The route is the one that was asked for, and not the model's own.
    route = strips if schedule.pieces == "strips" else whole
    taken: list[Schedule] = []
    accumulated = route.accumulated

    def taking(model: Model, schedule: Schedule, *images: Tensor) -> Tensor:
        taken.append(schedule)
        total: Tensor = accumulated(model, schedule, *images)
        return total

    monkeypatch.setattr(route, "accumulated", taking)
    actual = power_and_gradients(metric.power, images)
    assert taken == [schedule]
    for mine, plain in zip(actual, expected, strict=True):
        largest = float(plain.abs().max())
        torch.testing.assert_close(mine, plain, rtol=1e-9, atol=1e-12 * largest)


def test_the_gradient_of_equal_images_is_0_on_every_route() -> None:
    image = pair((45, 38))[0]
    for schedule in SCHEDULES.values():
        _, *gradients = power_and_gradients(VDM(schedule=schedule).power, (image, image))
        assert not any(gradient.any() for gradient in gradients), schedule


@pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
@pytest.mark.parametrize("effects", [Effects(masking=False), Effects(pooling=False)], ids=repr)
def test_with_every_effect(effects: Effects, transform: Transform) -> None:
    images = pair((70, 41))
    for name, schedule in SCHEDULES.items():
        if schedule.stacked and transform != Haar():
            continue
        metric = VDM(30.0, transform=transform, effects=effects, schedule=schedule)
        expected = metric.model(torch.float64, PLAIN).difference(*images)
        actual = metric.power(*images)
        model = metric.model(torch.float64)
        torch.testing.assert_close(
            actual, model.to_pixels(expected, (70, 41)), rtol=1e-9, atol=1e-20, msg=name
        )


# torch's own, of what forward-mode gradients need.
@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:FutureWarning")
def test_nothing_is_compiled_of_what_is_transformed_or_has_no_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(function: object) -> None:
        raise AssertionError(f"{function} is compiled")

    monkeypatch.setattr(limits, "compiled", refuse)
    fast = VDM(schedule=SCHEDULES["a GPU's, compiled"], nonfinite="mask")
    metric, (test, reference) = VDM(nonfinite="mask"), pair((40, 33))
    with pytest.raises(AssertionError, match="is compiled"):
        fast(test, reference)
    slopes, tangents = [], []
    for one in (fast, metric):
        slopes.append(torch.func.grad(lambda a: one.power(a, reference).sum())(test))  # noqa: B023
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(test, torch.ones_like(test))
            tangents.append(forward_ad.unpack_dual(one.power(dual, reference)).tangent)
    assert tangents[0] is not None
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(tangents[0], tangents[1], rtol=1e-9, atol=1e-12)
    with FakeTensorMode():
        fake = torch.rand(2, 3, 40, 33)
        metric = VDM(schedule=SCHEDULES["a GPU's, compiled"])
        assert metric(fake, fake).shape == (2, 1, 40, 33)


@pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
def test_tiles_too(transform: Transform) -> None:
    images = pair((150, 90), 1)
    metric = VDM(30.0, transform=transform)
    model = metric.model(torch.float64, PLAIN)
    plain = model.to_pixels(model.difference(*images), (150, 90)) ** (1.0 / 6.0)
    torch.testing.assert_close(metric.tiled(*images, tile=48), plain, rtol=1e-7, atol=1e-9)


JOB = Job(1, (400, 400), True, False, False, False, False, False, False)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {}),
        ({"size": (1080, 1920)}, {"pieces": "strips"}),
        # Of small images an operation costs more than its numbers.
        ({"size": (64, 64)}, {"together": True}),
        ({"size": (64, 64), "gradients": True}, {"together": True}),
        ({"size": (64, 64), "gradients": True, "one_sided": True}, {}),
        ({"size": (64, 64), "compiles": True}, {"compiled": True}),
        # Strips keep more for a backward pass than whole planes, unless they are computed again.
        ({"size": (1080, 1920), "gradients": True}, {}),
        (
            {"size": (1080, 1920), "gradients": True, "checkpoints": True},
            {"pieces": "strips", "again": True},
        ),
        ({"items": 4}, {}),
        ({"items": 4, "compiles": True}, {"compiled": True, "stacked": True}),
        ({"items": 4, "compiles": True, "stackable": False}, {"compiled": True}),
        # On a GPU few operations, of all that there is.
        ({"accelerated": True, "size": (1080, 1920)}, dataclasses.asdict(ACCELERATED)),
        (
            {"accelerated": True, "gradients": True, "one_sided": True},
            dataclasses.asdict(ACCELERATED) | {"together": False},
        ),
        (
            {"accelerated": True, "gradients": True, "checkpoints": True},
            dataclasses.asdict(ACCELERATED) | {"again": True, "few": limits.FEW_NODES},
        ),
        # A graph that somebody else makes has all of it, in one piece.
        ({"size": (1080, 1920), "compiles": True, "traced": True}, {"few": 0}),
    ],
    ids=str,
)
def test_a_schedule_is_chosen_for_the_job(
    changes: dict[str, object], expected: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    assert chosen(JOB._replace(**changes)) == Schedule(**expected)  # type: ignore[arg-type]


def test_it_is_told() -> None:
    images = torch.rand(2, 2, 3, 8, 8)
    assert VDM().scheduled(*images) == Schedule(together=True)
    assert "schedule=chosen for each pair" in repr(VDM())
    assert "schedule=Schedule(pieces='strips'" in repr(VDM(schedule=Schedule("strips")))
    assert "few=0" in repr(VDMLoss(schedule=Schedule(few=0)))
    # Too small to be cut.
    images = torch.rand(2, 1, 3, 8, 5)
    torch.testing.assert_close(VDM(schedule=Schedule("strips"))(*images), VDM()(*images))
    with pytest.raises(ValueError, match="not stacked with Steerable"):
        VDM(transform=Steerable(), schedule=Schedule(stacked=True))
    with pytest.raises(ValueError, match="expected schedule: Schedule, got 'strips'"):
        VDM(schedule="strips")  # type: ignore[arg-type]  # wrong on purpose
