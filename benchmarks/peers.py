"""Other metrics, each given the light of a stimulus as it wants it; what is missing is named.

A peer that knows no luminance gets sRGB-coded values whose white is `WHITE` times the background's
luminance: mid-grey with room above it. What no such display shows, colours out of its gamut and
light over its white, is clipped. One that has a map may use its mean or its maximum, whichever
serves it better.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.display import BT709_TO_XYZ, encode_srgb

# White of the display of a peer that knows no luminance, over the background. Status: choice.
WHITE = 4.0

# Multi-scale SSIM takes images of at least 161 pixels a side; the background goes on.
SMALLEST_SIDE = 176

# Not measured, and why.
WITHOUT = {
    "LPIPS": "the weights of its network are downloaded, not in the package",
    "SSIMULACRA 2": "its package reads files of 8 bits, coarser than a threshold",
    "Butteraugli": "not in the Python package index; its program reads files of 8 bits",
}

Values = Callable[[Tensor, Tensor, float], Tensor]


@dataclass(frozen=True)
class Peer:
    """A metric that is compared.

    Attributes
    ----------
    name
        What tables call it.
    values
        Of tests (N, 3, H, W) against one reference (1, 3, H, W), CIE XYZ in cd/m2, at pixels per
        degree: (N, k), k figures that grow with the difference.
    timed
        What is timed: of two sRGB-coded images (1, 3, H, W).
    """

    name: str
    values: Values
    timed: Callable[[Tensor, Tensor], Any]


def coded(light: Tensor, background: float) -> Tensor:
    """Return sRGB-coded values in [0, 1] of XYZ (N, 3, H, W) on a display for its background."""
    to_rgb = torch.linalg.inv(torch.tensor(BT709_TO_XYZ, dtype=light.dtype))
    linear = torch.einsum("ij,njhw->nihw", to_rgb, light) / (WHITE * background)
    return encode_srgb(linear.clamp(0.0, 1.0))


def clipped(light: Tensor, background: float) -> bool:
    """Return whether `coded` clips XYZ (N, 3, H, W)."""
    to_rgb = torch.linalg.inv(torch.tensor(BT709_TO_XYZ, dtype=light.dtype))
    linear = torch.einsum("ij,njhw->nihw", to_rgb, light) / (WHITE * background)
    return bool(((linear < -1e-9) | (linear > 1.0 + 1e-9)).any())


def _coded_pair(tests: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    background = float(reference[0, 1, 0, 0])
    pair = [coded(light, background) for light in (tests, reference.expand_as(tests))]
    more = max(0, SMALLEST_SIDE - tests.shape[-1])
    sides = (more // 2, more - more // 2) * 2
    one, other = (functional.pad(image, sides, mode="replicate") for image in pair)
    return one, other


def _of_map(difference: Tensor) -> Tensor:
    flat = difference.flatten(1)
    return torch.stack((flat.mean(1), flat.amax(1)), 1)


def _ssim() -> Peer:
    from kornia.metrics import ssim

    def values(tests: Tensor, reference: Tensor, _: float) -> Tensor:
        return _of_map(1.0 - ssim(*_coded_pair(tests, reference), 11))

    return Peer("SSIM", values, lambda test, reference: ssim(test, reference, 11))


def _ms_ssim() -> Peer:
    from torchmetrics.functional.image import multiscale_structural_similarity_index_measure

    def similarity(test: Tensor, reference: Tensor, reduction: Any = None) -> Any:
        return multiscale_structural_similarity_index_measure(
            test, reference, data_range=1.0, reduction=reduction
        )

    def values(tests: Tensor, reference: Tensor, _: float) -> Tensor:
        seen: Tensor = similarity(*_coded_pair(tests, reference))
        return 1.0 - seen.reshape(-1, 1)

    return Peer(
        "MS-SSIM",
        values,
        lambda test, reference: similarity(test, reference, "elementwise_mean"),
    )


def _flip() -> Peer:
    from benchmarks.flip import flip

    def values(tests: Tensor, reference: Tensor, ppd: float) -> Tensor:
        pairs = zip(*_coded_pair(tests, reference), strict=True)
        return _of_map(torch.stack([flip(*pair, ppd) for pair in pairs])).double()

    def timed(test: Tensor, reference: Tensor) -> Tensor:
        return flip(test[0], reference[0], 60.0)

    return Peer("FLIP", values, timed)


def _cvvdp() -> Peer:
    import pycvvdp

    geometry = pycvvdp.vvdp_display_geometry

    def values(tests: Tensor, reference: Tensor, ppd: float) -> Tensor:
        screen = pycvvdp.vvdp_display_photo_eotf(
            1e5, contrast=1e9, source_colorspace="BT.709-linear", EOTF="linear", k_refl=0.0
        )
        metric = pycvvdp.cvvdp(
            display_photometry=screen,
            display_geometry=geometry([1920, 1080], ppd=ppd),
            quiet=True,
            device=torch.device("cpu"),
        )
        to_rgb = torch.linalg.inv(torch.tensor(BT709_TO_XYZ, dtype=tests.dtype))

        def light(image: Tensor) -> Any:
            return torch.einsum("ij,jhw->hwi", to_rgb, image).float().numpy()

        base = light(reference[0])
        judged = [float(metric.predict(light(t), base, dim_order="HWC")[0]) for t in tests]
        return 10.0 - torch.tensor(judged, dtype=torch.float64).view(-1, 1)

    whole = pycvvdp.cvvdp(
        display_name="standard_4k", heatmap="raw", quiet=True, device=torch.device("cpu")
    )

    def timed(test: Tensor, reference: Tensor) -> Any:
        return whole.predict(test, reference, dim_order="BCHW")[0]

    return Peer("ColorVideoVDP", values, timed)


PEERS = {"SSIM": _ssim, "MS-SSIM": _ms_ssim, "FLIP": _flip, "ColorVideoVDP": _cvvdp}


def installed() -> tuple[list[Peer], dict[str, str]]:
    """Return the peers that are here, and why others are not."""
    found, missing = [], dict(WITHOUT)
    for name, make in PEERS.items():
        try:
            found.append(make())
        except ImportError as error:
            missing[name] = f"not installed: {error}"
    return found, missing
