"""What judges pictures: our metric, the simplest ones, and those of others where installed.

Each takes the light of a picture and of its reference, (1, 3, H, W), linear BT.709 over white, and
gives figures by name. White is 100 cd/m2, and 60 pixels are a degree, for every judge that knows
of them.
"""

import importlib.util
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_vdm import VDM, Display
from torch_vdm.model.display import encode_srgb

Judge = Callable[[Tensor, Tensor], dict[str, float]]

PPD, WHITE = 60.0, 100.0

# Whether more is better, of every figure.
MORE_IS_BETTER = {
    "visible": False,
    "JND p95": False,
    "JND max": False,
    "FLIP": False,
    "HDR-FLIP": False,
    "cvvdp": True,
    "LPIPS": False,
    "PSNR": True,
    "SSIM": True,
}

# The weights that LPIPS needs beside those in its package, as torchvision names them on disk.
ALEXNET = "alexnet-owt-7be5be79.pth"


def judges() -> tuple[dict[str, Judge], dict[str, str]]:
    """Return the judges, and why others are missing, by name."""
    found: dict[str, Judge] = {"JND": _jnd(), "simple": _simple}
    missing = {}
    for name, make, need in (
        ("FLIP", _flip, _no_package("flip_evaluator", "flip-evaluator")),
        ("cvvdp", _cvvdp, _no_package("pycvvdp", "cvvdp")),
        ("LPIPS", _lpips, _no_lpips()),
    ):
        if need:
            missing[name] = need
        else:
            found[name] = make()
    return found, missing


def psnr(test: Tensor, reference: Tensor) -> float:
    """Return the peak signal-to-noise ratio of values in [0, 1], in dB."""
    return float(-10.0 * torch.log10((test - reference).square().mean()))


def cvvdp_metric() -> Any:
    """Return cvvdp for an sRGB display of our white and angle, one that takes (B, 3, H, W)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its source has some, when it is compiled
        import pycvvdp

    return pycvvdp.cvvdp(
        display_photometry=pycvvdp.vvdp_display_photo_eotf(WHITE, source_colorspace="sRGB"),
        display_geometry=pycvvdp.vvdp_display_geometry((1920, 1080), ppd=PPD),
        quiet=True,
        device=torch.device("cpu"),
    )


def _jnd() -> Judge:
    metric = VDM(PPD, Display.linear(WHITE))

    def judge(test: Tensor, reference: Tensor) -> dict[str, float]:
        jnd = metric(test, reference)
        return {
            "visible": float((jnd > 1.0).float().mean()),
            "JND p95": float(jnd.quantile(0.95)),
            "JND max": float(jnd.max()),
        }

    return judge


def _simple(test: Tensor, reference: Tensor) -> dict[str, float]:
    from kornia.metrics import ssim

    test, reference = _shown(test), _shown(reference)
    return {"PSNR": psnr(test, reference), "SSIM": float(ssim(test, reference, 11).mean())}


def _flip() -> Judge:
    from benchmarks.flip import flip

    def judge(test: Tensor, reference: Tensor) -> dict[str, float]:
        shown = flip(_shown(test)[0], _shown(reference)[0], PPD)
        light = flip(test[0], reference[0], PPD, "HDR")
        return {"FLIP": float(shown.mean()), "HDR-FLIP": float(light.mean())}

    return judge


def _cvvdp() -> Judge:
    metric = cvvdp_metric()

    def judge(test: Tensor, reference: Tensor) -> dict[str, float]:
        quality, _ = metric.predict(_shown(test), _shown(reference), dim_order="BCHW")
        return {"cvvdp": float(quality)}

    return judge


def _lpips() -> Judge:
    from torchmetrics.functional.image import learned_perceptual_image_patch_similarity as lpips

    def judge(test: Tensor, reference: Tensor) -> dict[str, float]:
        return {"LPIPS": float(lpips(_shown(test), _shown(reference), "alex", normalize=True))}

    return judge


def _shown(light: Tensor) -> Tensor:
    """Return what an sRGB display shows, in [0, 1]."""
    return encode_srgb(light).clamp(0.0, 1.0)


def _no_package(module: str, package: str) -> str:
    return "" if importlib.util.find_spec(module) else f"{package} is not installed"


def _no_lpips() -> str:
    for module in ("torchmetrics", "torchvision"):
        if missing := _no_package(module, module):
            return missing
    weights = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET
    return "" if weights.is_file() else f"the weights {ALEXNET} are not on this machine"
