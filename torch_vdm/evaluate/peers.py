"""What other metrics say of the same frame, so that readers see where they disagree."""

import importlib.util
import math

import torch
from torch import Tensor

# The side of SSIM's window, in pixels. Source: Wang et al. 2004. Status: source.
SSIM_WINDOW = 11

# Luma of BT.709. Source: ITU-R BT.709-6. Status: source.
LUMA = (0.2126, 0.7152, 0.0722)

# Packages of the peers that are asked for by name.
PACKAGES = {"flip": "flip_evaluator", "cvvdp": "pycvvdp"}

# What is installed to have them.
EXTRA = "pip install 'torch-vdm[peers]'"


def psnr(test: Tensor, reference: Tensor) -> float | None:
    """Return PSNR in dB of two sRGB-coded images (3, H, W) in [0, 1]; None where they are equal."""
    error = (test.double() - reference.double()).square().mean().item()
    return -10.0 * math.log10(error) if error > 0.0 else None


def ssim(test: Tensor, reference: Tensor) -> float:
    """Return the mean SSIM of the luma of two sRGB-coded images (3, H, W) in [0, 1]."""
    from kornia.metrics import ssim as kornia_ssim

    weights = torch.tensor(LUMA).view(3, 1, 1)
    one, other = ((image * weights).sum(0)[None, None] for image in (test, reference))
    similarity: Tensor = kornia_ssim(one, other, SSIM_WINDOW)
    return similarity.double().mean().item()


def missing(names: list[str]) -> list[str]:
    """Return those of the peers whose package is not installed."""
    return [name for name in names if importlib.util.find_spec(PACKAGES[name]) is None]


def asked(name: str, test: Tensor, reference: Tensor, ppd: float, white: float) -> float:
    """Return what a peer says of two images (3, H, W) of light, where 1.0 is white.

    Parameters
    ----------
    name
        "flip": the mean error of the images as sRGB shows them, 0 to 1, less is better; "cvvdp":
        quality in JOD, 10 is best.
    test, reference
        The images.
    ppd
        Pixels per degree.
    white
        Luminance of 1.0, in cd/m2.
    """
    return (_flip if name == "flip" else _cvvdp)(test, reference, ppd, white)


def _flip(test: Tensor, reference: Tensor, ppd: float, _: float) -> float:
    import flip_evaluator

    from torch_vdm.display import encode_srgb

    images = (
        encode_srgb(image).clamp(0.0, 1.0).permute(1, 2, 0).contiguous().numpy()
        for image in (reference, test)
    )
    parameters = {"ppd": ppd}
    _, mean, _ = flip_evaluator.evaluate(*images, "LDR", applyMagma=False, parameters=parameters)
    return float(mean)


def _cvvdp(test: Tensor, reference: Tensor, ppd: float, white: float) -> float:
    import pycvvdp

    # A screen that shows all light as it is, without reflections: the file's own.
    screen = pycvvdp.vvdp_display_photo_eotf(
        1e5, contrast=1e9, source_colorspace="BT.709-linear", EOTF="linear", k_refl=0.0
    )
    geometry = pycvvdp.vvdp_display_geometry([test.shape[-1], test.shape[-2]], ppd=ppd)
    metric = pycvvdp.cvvdp(
        display_photometry=screen,
        display_geometry=geometry,
        quiet=True,
        device=torch.device("cpu"),
    )
    light = ((image.clamp_min(0.0) * white).numpy() for image in (test, reference))
    return float(metric.predict(*light, dim_order="CHW")[0])
