"""Transfer curves: from the code that a file stores to light, and to sRGB's code.

Codes and light are from 0 to 1 unless stated otherwise, in arrays of any shape and float type.
"""

from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from torch_vdm.model import display

Values: TypeAlias = NDArray[Any]

# SMPTE ST 2084, 5.2 (PQ): its constants, and the light of code 1 in cd/m2.
PQ_M1, PQ_M2 = 2610 / 16384, 2523 / 4096 * 128
PQ_C1, PQ_C2, PQ_C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
PQ_PEAK = 10000.0

# ITU-R BT.2100-2, table 5 (HLG): its constants; and the nominal peak of the display, in cd/m2, with
# the exponent of the system gamma there.
HLG_A, HLG_B, HLG_C = 0.17883277, 0.28466892, 0.55991073
HLG_PEAK, HLG_GAMMA = 1000.0, 1.2

# ITU-R BT.1886: the display of video in BT.709, BT.601 and BT.2020, its black at 0.
BT1886_EXPONENT = 2.4


def decode_srgb(code: Values) -> Values:
    """Return the light of sRGB codes on a display; below 0 the linear part continues."""
    return display.decode_srgb(torch.from_numpy(np.ascontiguousarray(code))).numpy()


def encode_srgb(light: Values) -> Values:
    """Return the sRGB codes of light, not clipped."""
    return display.encode_srgb(torch.from_numpy(np.ascontiguousarray(light))).numpy()


def decode_gamma(code: Values, exponent: float) -> Values:
    """Return the light of codes, their power ``exponent``; an odd function."""
    return np.sign(code) * np.abs(code) ** exponent


def decode_pq(code: Values) -> Values:
    """Return the light of PQ codes, in cd/m2."""
    root = np.clip(code, 0, 1) ** (1 / PQ_M2)
    return PQ_PEAK * (np.maximum(root - PQ_C1, 0) / (PQ_C2 - PQ_C3 * root)) ** (1 / PQ_M1)


def decode_hlg(code: Values, weights: Values) -> Values:
    """Return the light of HLG codes (3, H, W) on a display of 1000 cd/m2, in cd/m2.

    ``weights`` are the shares of red, green and blue in luminance.
    """
    code = np.clip(code, 0, 1)
    bright = (np.exp((np.maximum(code, 0.5) - HLG_C) / HLG_A) + HLG_B) / 12
    scene = np.where(code <= 0.5, code**2 / 3, bright)
    luminance = np.tensordot(weights, scene, 1)
    # 0 to the power 0.2 is 0, and so is the whole pixel.
    return HLG_PEAK * scene * luminance ** (HLG_GAMMA - 1)
