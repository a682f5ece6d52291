"""Whether hard images stay finite, and how much half and single precision cost.

Every case is run in every precision, for both observers and every choice of effects; a cell is the
largest error of the map against float64 on the same rounded input, relative to 1 JND or to the
map's maximum, whichever is larger. Map, loss and first gradients of both must be finite in all.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.record import caption, circumstances, save
from torch_vdm import VDM, Display, Effects, Observer, VDMLoss

SIZE = (24, 31)
DTYPES = {
    "float64": torch.float64,
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}
OBSERVERS = (Observer.calibrated(), Observer.paper())
EFFECTS = [Effects(*switches) for switches in itertools.product((True, False), repeat=4)]
Pair = tuple[Tensor, Tensor]


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write stability.json, .md and .png to ``output``."""
    effects = EFFECTS[:1] + EFFECTS[-1:] if quick else EFFECTS
    result: dict[str, Any] = {
        **circumstances(),
        "size": SIZE,
        "observers": [observer.name for observer in OBSERVERS],
        "choices_of_effects": len(effects),
        "cases": {
            name: {precision: _cell(*make(), dtype, effects) for precision, dtype in DTYPES.items()}
            for name, make in CASES.items()
        },
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


def _cell(test: Tensor, reference: Tensor, dtype: torch.dtype, effects: list[Effects]) -> Any:
    """Return the largest error of the map over observers and effects, and what is not finite."""
    largest = torch.finfo(dtype).max
    test, reference = (image.clamp(-largest, largest).to(dtype) for image in (test, reference))
    worst = 0.0
    bad: list[str] = []
    for observer, choice in itertools.product(OBSERVERS, effects):
        options: dict[str, Any] = {
            "display": Display.xyz(), "observer": observer, "effects": choice,
        }  # fmt: skip
        metric = VDM(**options)
        loss = VDMLoss(**options)
        image = test.clone().requires_grad_()
        jnd, value = metric(image, reference), loss(image, reference)
        (of_map,) = torch.autograd.grad(jnd.sum(), image)
        (of_loss,) = torch.autograd.grad(value, image)
        for what, tensor in (
            ("map", jnd), ("loss", value), ("map's gradient", of_map), ("loss's gradient", of_loss),
        ):  # fmt: skip
            if not bool(torch.isfinite(tensor).all()):
                bad.append(f"{what}, {observer.name}, {'+'.join(choice.names()) or 'no effects'}")
        exact = metric(test.double(), reference.double())
        error = (jnd.detach().double() - exact).abs().max() / exact.max().clamp_min(1.0)
        worst = max(worst, error.item())
    return {"error": worst, "not_finite": bad}


def _table(result: dict[str, Any]) -> str:
    lines = [
        "# Stability",
        "",
        caption(result),
        "",
        f"Largest error of the map against float64, relative to its maximum or 1 JND, over "
        f"{len(result['observers'])} observers and {result['choices_of_effects']} choices of "
        "effects; the inputs are rounded to the precision first. Map, loss and the gradients of "
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
    return "\n".join(lines) + "\n"


def _plot(result: dict[str, Any], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.2), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
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
