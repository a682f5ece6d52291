"""Whether hard images stay finite, and how much half and single precision cost.

Every case is run in every precision, for both observers with every choice of effects, for the other
transforms with all effects and with none, and for Sarnoff's model; a cell is the largest error of
the map against float64 on the same rounded input, relative to 1 JND or to the map's maximum,
whichever is larger. Map, loss and first gradients of both must be finite in all, but for gradients
that half precision cannot hold, which are infinite and never NaN. float64 itself is
held to 50 digits, see `benchmarks.exact`.
"""

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.exact import DIGITS, largest_error
from benchmarks.record import blank_figure, caption, circumstances, save
from torch_vdm import VDM, Display, Effects, Haar, Observer, StationaryHaar, Steerable, VDMLoss
from torch_vdm.model.cortex import Transform

SIZE = (24, 31)
DTYPES = {
    "float64": torch.float64,
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
    "autocast": torch.float32,
}
OBSERVERS = (Observer.calibrated(), Observer.paper())
EFFECTS = [Effects(*switches) for switches in itertools.product((True, False), repeat=4)]
Pair = tuple[Tensor, Tensor]


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write stability.json, .md and .png to ``output``."""
    models = _models(quick)
    cases = dict(itertools.islice(CASES.items(), 6)) if quick else CASES
    result: dict[str, Any] = {
        **circumstances(),
        "size": SIZE,
        "models": [model.name for model in models],
        "cases": {
            name: {precision: _cell(*make(), precision, models) for precision in DTYPES}
            for name, make in cases.items()
        },
        "digits": {observer.name: largest_error(observer) for observer in OBSERVERS},
    }
    result["not_finite"] = [
        f"{name} in {precision}: {what}"
        for name, cells in result["cases"].items()
        for precision, cell in cells.items()
        for what in cell["not_finite"]
    ]
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "stability", result, table)
        _plot(result, output / "stability.png")
    if result["not_finite"]:
        raise SystemExit("not finite: " + "; ".join(result["not_finite"]))


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _pair(scale: float = 1.0, offset: float = 0.0, size: tuple[int, int] = SIZE) -> Pair:
    test, reference = (scale * (_random(1, 3, *size, seed=seed) + offset) for seed in (1, 2))
    return test, reference


def _flat(value: float) -> Tensor:
    return torch.full((1, 3, *SIZE), value, dtype=torch.float64)


def _one_bright(value: float) -> Pair:
    image = _flat(0.0)
    image[..., 5, 7] = value
    return image, _flat(0.0)


def _checkerboard() -> Pair:
    y, x = torch.meshgrid(*(torch.arange(side) for side in SIZE), indexing="ij")
    board = (1e5 * ((x + y) % 2)).double().expand(1, 3, *SIZE)
    return board, board.flip(-1)


def _without_blue() -> Pair:
    # XYZ of the reddest light of BT.2020, which has no Z: the S cones get nothing.
    red = torch.tensor([0.6370, 0.2627, 0.0], dtype=torch.float64).view(1, 3, 1, 1)
    test, reference = _pair(100.0)
    return red * test[:, :1], red * reference[:, :1]


# Every image is absolute XYZ in cd/m2.
CASES: dict[str, Callable[[], Pair]] = {
    "ordinary": lambda: _pair(100.0),
    "identical": lambda: (_pair(100.0)[0], _pair(100.0)[0]),
    "black against black": lambda: (_flat(0.0), _flat(0.0)),
    "black against noise": lambda: (_flat(0.0), _pair(100.0)[0]),
    "one pixel of 1 on black": lambda: _one_bright(1.0),
    "one pixel of 65504 on black": lambda: _one_bright(65504.0),
    "no S-cone response": _without_blue,
    "denormal": lambda: _pair(1e-40),
    "1e-9 cd/m2": lambda: _pair(1e-9),
    "1e6 cd/m2": lambda: _pair(1e6),
    "negative": lambda: _pair(100.0, -0.5),
    "checkerboard of 0 and 1e5": _checkerboard,
    "1 x 1": lambda: _pair(100.0, size=(1, 1)),
    "2 x 4097": lambda: _pair(100.0, size=(2, 4097)),
}


class Model(NamedTuple):
    """A metric and, where there is one, its loss."""

    name: str
    metric: nn.Module
    loss: nn.Module | None


def _models(quick: bool) -> list[Model]:
    """Return everything that is run."""
    few = [EFFECTS[0], EFFECTS[-1]]
    choices: list[tuple[Transform, list[Effects]]] = [
        (Haar(), EFFECTS),
        (StationaryHaar(), few),
        (Steerable(), few),
    ]
    if quick:
        choices = [(Haar(), few)]
    models = []
    for observer, (transform, effects) in itertools.product(OBSERVERS, choices):
        for choice in effects:
            options: dict[str, Any] = {
                "display": Display.xyz(), "observer": observer, "transform": transform,
                "effects": choice,
            }  # fmt: skip
            words = type(transform).__name__, observer.name, "+".join(choice.names()) or "none"
            models.append(Model(", ".join(words), VDM(**options), VDMLoss(**options)))
    if quick:
        return models
    return [*models, Model("Sarnoff", VDM.sarnoff(display=Display.xyz()), None)]


def _cell(test: Tensor, reference: Tensor, precision: str, models: list[Model]) -> Any:
    """Return the largest error of the map over the models, and what is not finite."""
    dtype = DTYPES[precision]
    largest = torch.finfo(dtype).max
    test, reference = (image.clamp(-largest, largest).to(dtype) for image in (test, reference))
    worst = 0.0
    bad: list[str] = []
    for model in models:
        image = test.clone().requires_grad_()
        mixed = torch.autocast("cpu", torch.bfloat16)
        with mixed if precision == "autocast" else contextlib.nullcontext():
            jnd = model.metric(image, reference)
            found = {"map": jnd, "map's gradient": _gradient(jnd.sum(), image)}
            if model.loss is not None:
                value = model.loss(image, reference)
                found |= {"loss": value, "loss's gradient": _gradient(value, image)}
        bad += [
            f"{what}, {model.name}"
            for what, tensor in found.items()
            if not bool(torch.isfinite(tensor).all())
        ]
        exact = model.metric(test.double(), reference.double())
        error = (jnd.detach().double() - exact).abs().max() / exact.max().clamp_min(1.0)
        worst = max(worst, error.item())
    return {"error": worst, "not_finite": bad}


def _gradient(value: Tensor, image: Tensor) -> Tensor:
    (gradient,) = torch.autograd.grad(value, image)
    if image.dtype != torch.float16:
        return gradient
    # What half precision cannot hold is infinite, by which a loss's scaler lowers its scale.
    largest = torch.finfo(image.dtype).max
    return gradient.clamp(-largest, largest)


def _table(result: dict[str, Any]) -> str:
    lines = [
        "# Stability",
        "",
        caption(result),
        "",
        f"Largest error of the map against float64, relative to its maximum or 1 JND, over "
        f"{len(result['models'])} models: both observers with every choice of effects, the other "
        "transforms with all effects and with none, and Sarnoff's model. The inputs are rounded to "
        "the precision first; under autocast they are float32. Map, loss and the gradients of "
        f"both: {len(result['not_finite'])} cells are not finite.",
        "",
        "| absolute XYZ | " + " | ".join(DTYPES) + " |",
        "|---|" + "---|" * len(DTYPES),
    ]
    for name, cells in result["cases"].items():
        shown = [
            "**not finite**" if cell["not_finite"] else f"{cell['error']:.0e}"
            for cell in cells.values()
        ]
        lines.append(f"| {name} | " + " | ".join(shown) + " |")
    digits = ", ".join(f"{name} {error:.0e}" for name, error in result["digits"].items())
    lines += [
        "",
        f"float64 against {DIGITS} digits, one coefficient from light to JND (`benchmarks.exact`), "
        f"largest relative error: {digits}.",
    ]
    return "\n".join(lines) + "\n"


def _plot(result: dict[str, Any], path: Path) -> None:
    figure = blank_figure(8.0, 4.2)
    axis = figure.subplots()
    names = list(result["cases"])
    for precision, marker in zip(("float32", "bfloat16", "float16"), "osv", strict=True):
        errors = [max(cells[precision]["error"], 1e-9) for cells in result["cases"].values()]
        axis.plot(errors, names, marker, label=precision, alpha=0.8)
    axis.set_xscale("log")
    axis.invert_yaxis()
    axis.grid(axis="x", alpha=0.3)
    axis.set_xlabel("largest error against float64, relative (1e-9: none)")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, title="images in", loc="center", bbox_to_anchor=(0.35, 0.5))
    figure.savefig(path)
