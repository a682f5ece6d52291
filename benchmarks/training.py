"""A small U-Net denoises Monte Carlo renders, trained with L1, SSIM and `VDMLoss`.

The same network, first weights, crops and steps for every loss, three seeds each. Scenes are
rendered by `benchmarks.renders` and split by scene; `benchmarks.judges` judges held-out scenes. In
the same table: the losses on the pixels themselves (`benchmarks.pixels`).

The target: of the three, `VDMLoss` leaves the lowest share of pixels over 1 JND, and its FLIP is
at most 2 % over the best one.
"""

import hashlib
import importlib.metadata
import importlib.util
import logging
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import pixels, renders, unet
from benchmarks.judges import MORE_IS_BETTER, PPD, WHITE, cvvdp_metric, judges
from benchmarks.places import CACHE
from benchmarks.record import blank_figure, caption, circumstances, save
from benchmarks.renders import Picture, held_out_scenes, picture, training_scenes
from torch_vdm import VDM, Display, VDMLoss
from torch_vdm.io import atomic_path
from torch_vdm.model.display import encode_srgb

Loss = Callable[[Tensor, Tensor], Tensor]

SEEDS = (0, 1, 2)

# What must hold: FLIP of `VDMLoss` over the best.
FLIP_MARGIN = 1.02

# Digits after the point in tables; 4 for others.
DIGITS = {"JND p95": 2, "JND max": 1, "PSNR": 2, "cvvdp": 3}

# Whose pictures are shown.
SHOWN = "still life"


def l1(test: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute difference of sRGB-coded values."""
    return (test - reference).abs().mean()


def ssim(test: Tensor, reference: Tensor) -> Tensor:
    """Kornia's SSIM loss of sRGB-coded values, with its window of 11 pixels."""
    from kornia.losses import ssim_loss

    return ssim_loss(test, reference, 11)


def trained_losses() -> dict[str, Loss]:
    """Return the losses that are trained with, each as it comes."""
    return {"L1": l1, "SSIM": ssim, "VDMLoss": VDMLoss(PPD)}


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the tables, and write training.json, .md and .png to ``output``.

    Renders and trained networks are kept in `CACHE`, so that a run that was interrupted goes on;
    a quick run keeps nothing.
    """
    torch.set_num_threads(1 if quick else 2)
    logging.disable(logging.WARNING)  # cvvdp warns of every picture that is black
    if quick:
        with tempfile.TemporaryDirectory() as folder:
            _run(Path(folder), output, quick)
    else:
        _run(CACHE, output, quick)


def _run(cache: Path, output: Path | None, quick: bool) -> None:
    training, held_out = quick_pictures(cache) if quick else full_pictures(cache)
    seeds = SEEDS[:1] if quick else SEEDS
    steps = 8 if quick else unet.STEPS
    found, missing = judges()
    result: dict[str, Any] = {
        **circumstances(),
        "peers": _versions(),
        "missing": missing,
        "settings": {
            "steps": steps,
            "seeds": list(seeds),
            "crop": unet.CROP,
            "batch": unet.BATCH,
            "rate": unet.RATE,
            "widths": list(unet.WIDTHS),
            "noisy_spp": renders.NOISY_SPP,
            "reference_spp": renders.REFERENCE_SPP,
            "ppd": PPD,
            "white": WHITE,
        },
        "training_scenes": [each.name for each in training],
        "held_out_scenes": [each.name for each in held_out],
        "noisy": judge({"": lambda noisy: noisy[:, :3]}, held_out, found)[""],
        "losses": {},
    }
    networks = {}
    for name, loss in trained_losses().items():
        for seed in seeds:
            networks[name, seed] = trained(name, loss, training, seed, steps, cache)
        result["losses"][name] = judge(
            {f"seed {seed}": _denoiser(networks[name, seed]) for seed in seeds}, held_out, found
        )
    reference = _middle(encode_srgb(_named(held_out, SHOWN).reference), pixels.SIDE)[None]
    result["pixels"] = pixel_curves(reference, 10 if quick else pixels.STEPS)
    text = _text(result)
    print(text)
    if output is not None:
        save(output, "training", result, text)
        shown = {name: networks[name, seeds[0]] for name in result["losses"]}
        _plot(_named(held_out, SHOWN), shown, output / "training.png")
        pixels.plot(result["pixels"], output / "training_pixels.png")


def full_pictures(cache: Path) -> tuple[list[Picture], list[Picture]]:
    """Return what the committed result was trained on, and what it was judged on."""
    training = [picture(scene, cache, takes=renders.TAKES) for scene in training_scenes()]
    return training, [picture(scene, cache) for scene in held_out_scenes()]


def quick_pictures(cache: Path) -> tuple[list[Picture], list[Picture]]:
    """Return a smoke test's: few, small and hardly converged."""
    options = {"side": 64, "reference_spp": 64}
    training = training_scenes(range(2))
    held_out = held_out_scenes(range(0), shared=False)
    return (
        [picture(scene, cache, takes=1, **options) for scene in training],
        [picture(scene, cache, **options) for scene in held_out],
    )


def trained(
    name: str, loss: Loss, pictures: Sequence[Picture], seed: int, steps: int, cache: Path
) -> unet.UNet:
    """Train a network, or read it from ``cache`` if this loss has trained it on this data."""
    # What would make another network: the loss as it computes, the data, the network's file with
    # its settings.
    probe = torch.rand(2, 1, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    state = [
        f"{float(loss(*probe)):.5g}",
        [f"{float(each.noisy.double().sum() + each.reference.sum()):.6g}" for each in pictures],
        (seed, steps, Path(unet.__file__).read_bytes()),
    ]
    key = hashlib.sha256(repr(state).encode()).hexdigest()[:16]
    kept = cache / f"{name}_{seed}_{key}.pt"
    if not kept.exists():
        network = unet.train(loss, pictures, seed, steps)
        with atomic_path(kept) as temporary:
            torch.save(network.state_dict(), temporary)
    network = unet.UNet()
    network.load_state_dict(torch.load(kept, weights_only=True))
    return network.eval()


def judge(
    denoisers: Mapping[str, Callable[[Tensor], Tensor]],
    held_out: Sequence[Picture],
    found: Mapping[str, Callable[[Tensor, Tensor], dict[str, float]]],
) -> dict[str, dict[str, dict[str, float]]]:
    """Return the figures of each denoiser on each scene, by name."""
    with torch.no_grad():
        return {
            name: {
                each.name: {
                    key: value
                    for judge in found.values()
                    for key, value in judge(denoiser(each.noisy[:1]), each.reference[None]).items()
                }
                for each in held_out
            }
            for name, denoiser in denoisers.items()
        }


def pixel_curves(reference: Tensor, steps: int) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return the curves of `benchmarks.pixels`, by start and loss; cvvdp's where installed."""
    losses: dict[str, Loss] = {
        **trained_losses(),
        "VDMLoss, l1=0": VDMLoss(PPD, l1=0.0),
    }
    if importlib.util.find_spec("pycvvdp"):
        metric = cvvdp_metric()
        losses["cvvdp"] = lambda test, reference: metric.loss(
            test.clamp(0.0, 1.0), reference, dim_order="BCHW"
        )
    return {
        name: {key: pixels.curve(loss, start, reference, steps) for key, loss in losses.items()}
        for name, start in pixels.starts(reference).items()
    }


def means(seeds: Mapping[str, Mapping[str, Mapping[str, float]]], figure: str) -> list[float]:
    """Return a figure's mean over the held-out scenes, for each seed."""
    return [statistics.fmean(each[figure] for each in scenes.values()) for scenes in seeds.values()]


def winner(result: Mapping[str, Any], figure: str) -> str:
    """Return the loss with the best mean over scenes and seeds."""
    found = {
        name: statistics.fmean(means(seeds, figure)) for name, seeds in result["losses"].items()
    }
    sign = 1.0 if MORE_IS_BETTER[figure] else -1.0
    best: str = max(found, key=lambda name: sign * found[name])
    return best


def _denoiser(network: unet.UNet) -> Callable[[Tensor], Tensor]:
    return lambda noisy: unet.denoise(network, noisy)


def _middle(image: Tensor, side: int) -> Tensor:
    """Return the middle of an image (3, H, W), clipped to [0, 1]."""
    top, left = ((length - side) // 2 for length in image.shape[-2:])
    return image[:, top : top + side, left : left + side].clamp(0.0, 1.0)


def _named(pictures: Sequence[Picture], name: str) -> Picture:
    return next(each for each in pictures if each.name == name)


def _versions() -> dict[str, str]:
    """Return the versions of what judges, where installed."""
    found = {}
    for package in ("mitsuba", "flip-evaluator", "cvvdp"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def _figures(result: Mapping[str, Any]) -> list[str]:
    """Return the figures that were measured, in the table's order."""
    return [name for name in MORE_IS_BETTER if name in next(iter(result["noisy"].values()))]


def _cell(values: Sequence[float], digits: int, bold: bool) -> str:
    """Return a mean, with the standard deviation over seeds."""
    text = f"{statistics.fmean(values):.{digits}f}"
    if len(values) > 1:
        text += f" ± {statistics.stdev(values):.{digits}f}"
    return f"**{text}**" if bold else text


def _text(result: dict[str, Any]) -> str:
    losses, settings = result["losses"], result["settings"]
    figures = _figures(result)
    peers = ", ".join(f"{name} {version}" for name, version in result["peers"].items())
    lines = [
        "# A small denoiser, trained with each loss",
        "",
        f"{caption(result)}; {peers}",
        "",
        f"{settings['steps']} steps of Adam, {settings['batch']} crops of {settings['crop']} "
        f"pixels a step, {len(settings['seeds'])} seeds; {settings['noisy_spp']} samples a pixel; "
        f"{len(result['training_scenes'])} scenes trained on, {len(result['held_out_scenes'])} "
        "others judged. Means over these, ± the standard deviation over seeds.",
        "",
        "| | noisy | " + " | ".join(losses) + " |",
        "|---" * (len(losses) + 2) + "|",
    ]
    for figure in figures:
        digits = DIGITS.get(figure, 4)
        name = "share of pixels over 1 JND" if figure == "visible" else figure
        more = "more" if MORE_IS_BETTER[figure] else "less"
        cells = [_cell(means({"": result["noisy"]}, figure), digits, False)] + [
            _cell(means(losses[loss], figure), digits, loss == winner(result, figure))
            for loss in losses
        ]
        lines.append(f"| {name}, {more} is better | " + " | ".join(cells) + " |")
    lines += ["", *(f"{name} is left out: {why}." for name, why in result["missing"].items())]
    lines += ["", _verdict(result, figures)]
    lines += ["", "## Share of pixels over 1 JND, by scene", ""]
    lines += ["| scene | noisy | " + " | ".join(losses) + " |", "|---" * (len(losses) + 2) + "|"]
    for scene, noisy in result["noisy"].items():
        shares = {
            name: statistics.fmean(each[scene]["visible"] for each in seeds.values())
            for name, seeds in losses.items()
        }
        least = min(shares.values())
        cells = [
            f"**{share:.3f}**" if share == least else f"{share:.3f}" for share in shares.values()
        ]
        lines.append(f"| {scene} | {noisy['visible']:.3f} | " + " | ".join(cells) + " |")
    lines += ["", "## The pixels themselves", "", *pixels.text(result["pixels"])]
    return "\n".join(lines) + "\n"


def _verdict(result: dict[str, Any], figures: Sequence[str]) -> str:
    """Return who wins what, and what of the target holds."""
    wins: dict[str, list[str]] = {name: [] for name in result["losses"]}
    for figure in figures:
        wins[winner(result, figure)].append("visible share" if figure == "visible" else figure)
    told = "; ".join(
        f"{name} wins {', '.join(won) if won else 'nothing'}" for name, won in wins.items()
    )
    checks = [("lowest visible share", winner(result, "visible") == "VDMLoss")]
    if "FLIP" in figures:
        flip = {
            name: statistics.fmean(means(each, "FLIP")) for name, each in result["losses"].items()
        }
        ratio = flip["VDMLoss"] / min(flip.values())
        checks.append((f"FLIP {ratio:.3f} of the best (1.02)", ratio <= FLIP_MARGIN))
    targets = "; ".join(f"{what}: {'met' if met else 'not met'}" for what, met in checks)
    return f"{told}. Targets of VDMLoss: {targets}."


def _plot(shown: Picture, networks: Mapping[str, unet.UNet], path: Path) -> None:
    """Draw a held-out picture by each network, and its map of JND beneath."""
    reference = shown.reference[None]
    images = {"noisy": shown.noisy[:1, :3]}
    images |= {name: unet.denoise(each, shown.noisy[:1]) for name, each in networks.items()}
    metric = VDM(PPD, Display.linear(WHITE))
    figure = blank_figure(2.3 * (len(images) + 1), 5.1)
    axes: Any = figure.subplots(2, len(images) + 1)
    for axis in axes.flat:
        axis.set_axis_off()
    drawn: Any = None
    for (above, below), (name, image) in zip(axes.T, images.items(), strict=False):
        with torch.no_grad():
            jnd = metric(image, reference)[0, 0]
        above.imshow(_screen(image), interpolation="nearest")
        above.set_title(name, fontsize=10)
        drawn = below.imshow(jnd, cmap="inferno", vmin=0.0, vmax=4.0, interpolation="nearest")
        below.set_title(f"{float((jnd > 1.0).float().mean()):.0%} over 1 JND", fontsize=9)
    axes[0, -1].imshow(_screen(reference), interpolation="nearest")
    axes[0, -1].set_title("reference", fontsize=10)
    bar = axes[1, -1].inset_axes((0.02, 0.05, 0.07, 0.9))
    figure.colorbar(drawn, cax=bar, label="JND", extend="max")
    figure.savefig(path)


def _screen(light: Tensor) -> Any:
    return encode_srgb(light)[0].clamp(0.0, 1.0).permute(1, 2, 0).numpy()
