"""Other metrics of the same frame, so that readers see where they disagree."""

import importlib.util
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_vdm.model.display import encode_srgb

# The side of SSIM's window, in pixels. Source: Wang et al. 2004. Status: source.
SSIM_WINDOW = 11

# Strips of an image that are filtered as channels: with one channel alone the convolution takes
# five times as long. Status: choice.
SSIM_STRIPS = 4

# Luma of BT.709. Source: ITU-R BT.709-6. Status: source.
LUMA = (0.2126, 0.7152, 0.0722)

# Packages of the peers that are asked for by name.
PACKAGES = {"flip": "flip_evaluator", "cvvdp": "pycvvdp"}

# How to install them.
EXTRA = "pip install 'torch-vdm[peers]'"


def missing(names: list[str]) -> list[str]:
    """Return those of the peers whose package is not installed."""
    return [name for name in names if importlib.util.find_spec(PACKAGES[name]) is None]


def judged(
    names: Sequence[str], test: Tensor, reference: Tensor, ppd: float, white: float
) -> tuple[dict[str, float | None], list[str]]:
    """Return the peers' figures for two images of light (3, H, W), where 1.0 is white.

    Parameters
    ----------
    names
        On the images in sRGB code, clipped to [0, 1]: "psnr" in dB, None where they are equal;
        "ssim", the mean over the luma where its window fits; "flip", the mean error, 0 to 1, less
        is better. On the light: "cvvdp", quality in JOD, 10 is best.
    test, reference
        The images.
    ppd
        Pixels per degree.
    white
        Luminance of 1.0, in cd/m2.

    Returns
    -------
    The figures, None for one that fails, as on very small images; and a sentence for each failure.
    """
    one, other = (encode_srgb(image).clamp(0.0, 1.0) for image in (test, reference))
    peers: dict[str, Callable[[], float | None]] = {
        "psnr": lambda: _psnr(one, other),
        "ssim": lambda: _ssim(one, other),
        "flip": lambda: _flip(one, other, ppd),
        "cvvdp": lambda: _cvvdp(test, reference, ppd, white),
    }
    values: dict[str, float | None] = {}
    notes = []
    for name in names:
        try:
            values[name] = peers[name]()
        except Exception as error:  # whatever foreign code raises
            values[name] = None
            notes.append(f"no {name}: {' '.join(str(error).split())}")
    return values, notes


def _psnr(test: Tensor, reference: Tensor) -> float | None:
    difference = test - reference
    # Its squares are summed in float64 as they are made, without a copy.
    error = torch.linalg.vector_norm(difference, dtype=torch.float64).item() ** 2
    return -10.0 * math.log10(error / difference.numel()) if error > 0.0 else None


def _ssim(test: Tensor, reference: Tensor) -> float:
    from kornia.metrics import ssim

    height, width = (side - SSIM_WINDOW + 1 for side in test.shape[-2:])
    if height < 1 or width < 1:
        raise ValueError(f"expected {SSIM_WINDOW} pixels a side or more")
    rows = -(-height // SSIM_STRIPS)
    tops = [min(number * rows, height - rows) for number in range(SSIM_STRIPS)]
    strips = []
    for image in (test, reference):
        luma = torch.tensordot(torch.tensor(LUMA), image, 1)
        strips.append(torch.stack([luma[top : top + rows + SSIM_WINDOW - 1] for top in tops]))
    similarity: Tensor = ssim(strips[0][None], strips[1][None], SSIM_WINDOW, padding="valid")[0]
    # A strip that begins above its place repeats rows of the strip before.
    new = [strip[number * rows - tops[number] :] for number, strip in enumerate(similarity)]
    total: float = sum(strip.double().sum().item() for strip in new)
    return total / (height * width)


def _flip(test: Tensor, reference: Tensor, ppd: float) -> float:
    import flip_evaluator

    images = (image.permute(1, 2, 0).contiguous().numpy() for image in (reference, test))
    parameters = {"ppd": ppd}
    _, mean, _ = flip_evaluator.evaluate(*images, "LDR", applyMagma=False, parameters=parameters)
    return float(mean)


def _cvvdp(test: Tensor, reference: Tensor, ppd: float, white: float) -> float:
    import pycvvdp

    # A screen that shows the light of the file as it is, without reflections.
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
