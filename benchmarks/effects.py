"""What each effect costs, and what leaving it out would show; and what the plan of a pair saves.

For each effect, the map's time with and without it, and the largest difference that it makes
anywhere; for each pair, everything against `effects="auto"`. Times are medians of interleaved
rounds: every round runs each contender once. The renderer's half is `benchmarks.transport`.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks import record, transport
from benchmarks.pictures import distorted, grainy, photographs, renders
from benchmarks.transport import draw_times, times_as_fast
from torch_vdm import VDM, Effects

THREADS = 2

# What is measured, and in how many rounds; with --quick.
SIZE, QUICK = (1080, 1920), (96, 128)
ROUNDS = 9

# The four effects, one by one off.
EFFECTS = ("aberration", "chromatic", "masking", "pooling")

# What auto is to save, against all of it: times as fast.
WANTED = {"grey": 2.0, "local edits": 4.0}
# And at most so many times as slow where nothing can be left out.
BUSIEST = 1.05

# How much all that is left out by bounds could change a map, JND.
MOST_LOST = 0.02


class Pair(NamedTuple):
    """A test and a reference, sRGB-coded (1, 3, H, W)."""

    test: Tensor
    reference: Tensor


def filled(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a picture (1, 3, h, w) repeated to a size, every second one mirrored."""
    rows, columns = (-(-side // part) for side, part in zip(size, picture.shape[-2:], strict=True))
    across = torch.cat([picture.flip(-1) if n % 2 else picture for n in range(columns)], -1)
    whole = torch.cat([across.flip(-2) if n % 2 else across for n in range(rows)], -2)
    return whole[..., : size[0], : size[1]].contiguous()


def drawn(size: tuple[int, int]) -> Tensor:
    """Return a picture of our own: colours, slopes, edges and a texture; sRGB-coded."""
    sides = (torch.arange(side, dtype=torch.float32) for side in size)
    y, x = torch.meshgrid(*sides, indexing="ij")
    periods = (31.0, 47.0), (53.0, 29.0), (41.0, 61.0)
    waves = torch.stack([torch.sin(x / a) * torch.cos(y / b) for a, b in periods])
    edges = 0.1 * ((x // 96 + y // 72) % 2) + 0.05 * torch.sin(x * y / 900.0)
    return (0.45 + 0.2 * waves + edges).clamp(0.0, 1.0)[None]


def pairs(size: tuple[int, int]) -> dict[str, Pair]:
    """Return the pairs by name: ours, and photographs and a render where they are."""
    generator = torch.Generator().manual_seed(1)
    ours = drawn(size)
    grey = ours.mean(1, keepdim=True).expand(-1, 3, -1, -1).contiguous()
    normal = torch.randn(grey[:, :1].shape, generator=generator)
    tests = distorted(ours, generator)
    found = {
        "grey": Pair(grainy(grey, normal).clamp(0.0, 1.0), grey),
        "local edits": Pair(_edited(ours), ours),
        "one pixel": Pair(_edited(ours, 1), ours),
        "equal": Pair(ours.clone(), ours),
        "uniform": Pair((0.97 * ours), ours),
        **{name: Pair(tests[name], ours) for name in ("noise", "blur", "cast", "grating")},
    }
    for name, photo in photographs(1).items():
        whole = filled(photo, size)
        test = grainy(whole, torch.randn(whole.shape, generator=generator))
        found[f"photograph {name}, noise"] = Pair(test.clamp(0.0, 1.0), whole)
        render = next(renders(), None)
        if render is not None:
            found[f"render, {render.kind}"] = Pair(
                filled(render.test, size), filled(render.reference, size)
            )
    return found


def _edited(picture: Tensor, side: int = 0) -> Tensor:
    """Return a picture that is brighter in a few rectangles, 5 % of it, or in one pixel."""
    test = picture.clone()
    height, width = picture.shape[-2:]
    if side:
        test[..., height // 3, width // 5] = 1.0 - test[..., height // 3, width // 5]
        return test
    # Five of a hundredth each, two of them beside one another.
    for y, x in ((0.1, 0.1), (0.1, 0.21), (0.45, 0.6), (0.7, 0.3), (0.8, 0.85)):
        top, left = int(y * height), int(x * width)
        part = test[..., top : top + height // 10, left : left + width // 10]
        part.copy_((1.1 * part).clamp(0.0, 1.0))
    return test


def timed(contenders: dict[str, Callable[[], Tensor]], rounds: int) -> dict[str, float]:
    """Return the median seconds of each, of interleaved rounds."""
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(rounds + 1):
        for name in record.in_turn(contenders, number):
            start = time.perf_counter()
            contenders[name]()
            if number:
                seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in seconds.items()}


def of_pair(pair: Pair, rounds: int) -> dict[str, Any]:
    """Return what is measured of a pair."""
    metrics = {
        "auto": VDM(effects="auto"),
        "full": VDM(effects="full"),
        **{name: VDM(effects=Effects(**{name: False})) for name in EFFECTS},
    }
    maps = {name: metric(*pair) for name, metric in metrics.items()}
    seconds = timed({n: partial(metric, *pair) for n, metric in metrics.items()}, rounds)
    return {
        "max_jnd": maps["full"].max().item(),
        "seconds": seconds,
        "largest_difference_jnd": {
            name: (jnd - maps["full"]).abs().max().item() for name, jnd in maps.items()
        },
        "left_out": metrics["auto"].plan(*pair).reasons(),
        "unseen_share": unseen_share(pair),
    }


def unseen_share(pair: Pair) -> float:
    """Return the share of nodes, times channels, that the best of all bounds could leave out.

    A channel of a level can be left out whole where its squared differences, which masking only
    makes smaller, stay so small everywhere that all of them together, were all left out, would
    change the map by at most `MOST_LOST`. A real bound is no less than this largest difference.
    """
    metric = VDM(effects="full")
    responses = (metric.respond(metric.represent(image)) for image in pair)
    differences = [one - other for one, other in zip(*responses, strict=True)]
    channels = sum(difference.shape[1] for difference in differences)
    # Orientations are added up too, and a single contrast is raised by 2^q below threshold.
    raised = 2.0 ** metric.get_buffer("transducer_exponent").item()
    exponent = metric.observer.summation_exponent
    most = MOST_LOST / (3 * channels) ** (1.0 / exponent) / raised
    unseen = every = 0
    for difference in differences:
        nodes = difference.shape[-2] * difference.shape[-1]
        largest = difference.abs().amax((0, 2, 3, 4))
        unseen += int((largest <= most).sum()) * nodes
        every += len(largest) * nodes
    return unseen / every


def run(quick: bool, output: Path | None, part: str | None = None) -> None:
    if part != "renderer":
        run_metric(quick, output)
    if part != "metric":
        transport.run(quick, output)


def run_metric(quick: bool, output: Path | None) -> None:
    torch.set_num_threads(THREADS)
    size = QUICK if quick else SIZE
    found, taken = {}, pairs(size)
    with torch.no_grad():
        for name, pair in taken.items():
            found[name] = of_pair(pair, 1 if quick else ROUNDS)
    result = {**record.circumstances(), "size": list(size), "pairs": found}
    text = table(result)
    print(text)
    if output is not None:
        record.save(output, "effects", result, text)
        plot(result, output / "effects.png")
        if not quick:  # small images are computed whole
            draw_way(taken["local edits"], output / "effects_plan.png")


def draw_way(pair: Pair, path: Path) -> None:
    """Draw one pair's way through its plan: the two images, what the plan keeps, the map."""
    metric = VDM()
    plan = metric.plan(*pair)
    squares = plan.differing[0]
    assert squares is not None
    with torch.no_grad():
        jnd = metric(*pair)[0, 0]
    figure = record.blank_figure(9.0, 5.6)
    (one, other), (kept, mapped) = figure.subplots(2, 2)
    for axes, image, title in ((one, pair.reference, "reference"), (other, pair.test, "test")):
        axes.imshow(image[0].permute(1, 2, 0).numpy())
        axes.set_title(title, fontsize=10)
    kept.imshow(squares.numpy(), cmap="gray", interpolation="nearest")
    share = float(squares.float().mean())
    kept.set_title(f"plan: squares of {plan.square} pixels that differ, {share:.1%}", fontsize=10)
    drawn_map = mapped.imshow(jnd.numpy(), cmap="inferno")
    mapped.set_title(f"map: 0 in {(jnd == 0.0).float().mean():.0%} of the pixels", fontsize=10)
    figure.colorbar(drawn_map, ax=mapped, label="JND")
    for axes in (one, other, kept, mapped):
        axes.set_xticks([])
        axes.set_yticks([])
    figure.savefig(path)


def table(result: dict[str, Any]) -> str:
    height, width = result["size"]
    lines = [
        "# What each effect costs, and what leaving it out would show",
        "",
        record.caption(result),
        "",
        f"{width} x {height}, the default metric, not compiled. Milliseconds with everything; how "
        'many times as fast `effects="auto"` is, by how much its map differs at most, and what it '
        "leaves out; for each effect what leaving it out saves of the time, and the largest "
        "difference that it makes anywhere; and the share of nodes, times channels, that the best "
        f"bound on their differences could leave out with {MOST_LOST} JND lost.",
        "",
        "| pair | JND | ms | auto, times as fast | differs, JND | "
        + " | ".join(f"no {name}: time, JND" for name in EFFECTS)
        + " | left out | under any bound |",
        "|---|---|---|---|---|" + "---|" * len(EFFECTS) + "---|---|",
    ]
    for name, of in result["pairs"].items():
        seconds, lost = of["seconds"], of["largest_difference_jnd"]
        cells = [
            f"{seconds[effect] / seconds['full'] - 1.0:+.0%}, {lost[effect]:.2f}"
            for effect in EFFECTS
        ]
        lines.append(
            f"| {name} | {of['max_jnd']:.2f} | {1e3 * seconds['full']:.0f} | "
            f"{seconds['full'] / seconds['auto']:.2f} | {lost['auto']:.1e} | "
            + " | ".join(cells)
            + f" | {'; '.join(of['left_out']) or 'nothing'} | {of['unseen_share']:.0%} |"
        )
    lines += ["", "| target | wanted | found | |", "|---|---|---|---|"]
    for name, wanted in WANTED.items():
        times = times_as_fast(result["pairs"][name])
        verdict = "met" if times >= wanted else "**not met**"
        lines.append(f"| {name}, times as fast | {wanted:.1f} | {times:.2f} | {verdict} |")
    busy = [name for name, of in result["pairs"].items() if not of["left_out"]]
    busiest = max(1.0 / times_as_fast(result["pairs"][name]) for name in busy)
    verdict = "met" if busiest <= BUSIEST else "**not met**"
    lines.append(f"| nothing left out, times as slow | {BUSIEST:.2f} | {busiest:.2f} | {verdict} |")
    return "\n".join(lines) + "\n"


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw what each effect saves against what leaving it out shows, and what auto saves."""
    figure = record.blank_figure(9.0, 4.2)
    left, right = figure.subplots(1, 2)
    pairs_of = result["pairs"]
    for number, effect in enumerate(EFFECTS):
        saved = [1.0 - of["seconds"][effect] / of["seconds"]["full"] for of in pairs_of.values()]
        lost = [of["largest_difference_jnd"][effect] for of in pairs_of.values()]
        left.scatter(
            [100.0 * share for share in saved],
            [max(jnd, 1e-4) for jnd in lost],
            s=26,
            color=f"C{number}",
            label=effect,
        )
    left.axhline(1.0, color="0.6", linewidth=0.8)
    left.set_yscale("log")
    left.set_xlabel("time saved without it, %")
    left.set_ylabel("largest difference it makes, JND")
    left.set_title("One effect left out, each pair", fontsize=10)
    # Within the plot its marks would look like data.
    figure.legend(loc="outside lower center", ncols=len(EFFECTS), fontsize=8, frameon=False)
    draw_times(right, list(pairs_of), list(map(times_as_fast, pairs_of.values())))
    right.set_xscale("log")
    right.set_title("Nothing lost", fontsize=10)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
