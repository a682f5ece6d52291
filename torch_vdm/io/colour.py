"""What a file states about its colours: its codes as sRGB codes, or as absolute light.

Where a file states several things, cICP takes precedence, then an ICC profile, then sRGB, then gAMA
and cHRM (PNG, third edition, 4.3). Colours outside sRGB's gamut lie outside [0, 1].
"""

from typing import NamedTuple

import numpy as np

from torch_vdm.io import icc
from torch_vdm.io.curves import (
    BT1886_EXPONENT,
    Values,
    decode_gamma,
    decode_hlg,
    decode_pq,
    decode_srgb,
    encode_srgb,
)
from torch_vdm.io.decoded import Kind
from torch_vdm.io.primaries import (
    BT709,
    BT2020,
    DCI_P3,
    P3,
    Chromaticities,
    converted,
    is_identity,
    rgb_to_xyz,
    to_bt709,
)
from torch_vdm.io.refusal import Floats, ImageError

# Code points of ITU-T H.273, tables 2 and 3.
PRIMARIES = {1: BT709, 9: BT2020, 11: DCI_P3, 12: P3}
VIDEO = (1, 6, 14, 15)
GAMMA22, GAMMA28, LINEAR, SRGB, PQ, HLG = 4, 5, 8, 13, 16, 18

# A stated gamma within this of 1 / 2.2 means sRGB's curve, as writers of sRGB state it (PNG, third
# edition, 11.3.2.5), where the primaries are sRGB's too. Status: choice.
NEAR_GAMMA = 0.01


class Colour(NamedTuple):
    """What a file states about its colours."""

    cicp: tuple[int, int, int, int] | None = None
    """Primaries, transfer, matrix and range of ITU-T H.273."""
    profile: bytes | None = None
    """An ICC profile."""
    srgb: bool = False
    """Whether it states that it is sRGB."""
    gamma: float | None = None
    """The encoding exponent, from light to code."""
    chromaticities: Chromaticities | None = None
    """x, y of red, green, blue and white."""


def shown(codes: Floats, colour: Colour, bits: int, notes: list[str]) -> tuple[Floats, Kind]:
    """Return codes (3, H, W) from 0 to 1 as what they mean: sRGB codes, or cd/m2."""
    if colour.cicp is not None:
        return _by_cicp(codes, colour.cicp, bits, notes)
    if colour.profile is not None:
        return _by_profile(codes, colour.profile, bits, notes)
    if colour.srgb or (colour.gamma is None and colour.chromaticities is None):
        return codes, "coded"
    return _by_gamma(codes, colour.gamma, colour.chromaticities or BT709, notes), "coded"


def check_cicp(cicp: tuple[int, int, int, int]) -> None:
    """Refuse colours that are not supported."""
    space, transfer, matrix, _ = cicp
    known = (*VIDEO, GAMMA22, GAMMA28, LINEAR, SRGB, PQ, HLG)
    if space not in PRIMARIES or transfer not in known or matrix != 0:
        raise ImageError(
            f"expected colours of BT.709, BT.2020 or P3 as sRGB, linear, PQ, HLG or video, got "
            f"cICP {space}/{transfer}/{matrix}; convert the image to sRGB first"
        )


def _by_cicp(
    codes: Floats, cicp: tuple[int, int, int, int], bits: int, notes: list[str]
) -> tuple[Floats, Kind]:
    check_cicp(cicp)
    space, transfer, matrix, full = cicp
    if cicp == (1, SRGB, 0, 1):
        return codes, "coded"
    values = codes.astype(np.float64)
    if not full:  # ITU-T H.273, 8.3: black at 16 and white at 235 of 8 bits
        values = (values * (2**bits - 1) / 2 ** (bits - 8) - 16) / 219
    primaries = PRIMARIES[space]
    weights = rgb_to_xyz(primaries)[1]
    light = _to_bt709(_decoded(values, transfer, weights), primaries)
    notes.append(
        f"Colours are decoded as the file says (cICP {space}/{transfer}/{matrix}/{full}): "
        f"{_named(transfer)}."
    )
    if transfer in (PQ, HLG):
        return light, "absolute"
    return encode_srgb(light).astype(np.float32), "coded"


def _decoded(values: Values, transfer: int, weights: Values) -> Values:
    if transfer == PQ:
        return decode_pq(values)
    if transfer == HLG:
        return decode_hlg(values, weights)
    if transfer == SRGB:
        return decode_srgb(values)
    exponents = {LINEAR: 1.0, GAMMA22: 2.2, GAMMA28: 2.8}
    return decode_gamma(values, exponents.get(transfer, BT1886_EXPONENT))


def _named(transfer: int) -> str:
    names = {
        PQ: "PQ, absolute light in cd/m2",
        HLG: "HLG, on a display of 1000 cd/m2",
        SRGB: "sRGB's curve",
        LINEAR: "linear",
    }
    return names.get(transfer, "a power, as its display has it")


def _by_profile(codes: Floats, data: bytes, bits: int, notes: list[str]) -> tuple[Floats, Kind]:
    profile = icc.read_profile(data)
    if profile.cicp is not None:
        return _by_cicp(codes, profile.cicp, bits, notes)
    if profile.is_srgb:
        return codes, "coded"
    if profile.curves:
        notes.append("Colours are converted to sRGB as its ICC profile says.")
        return encode_srgb(profile.light(codes)).astype(np.float32), "coded"
    if bits > 8:
        raise ImageError(
            "expected an ICC profile of a matrix and curves for more than 8 bits, got one with "
            "tables; convert the image to sRGB first"
        )
    notes.append(
        "Colours are converted to sRGB by its ICC profile's tables, with 8 bits; those that sRGB "
        "lacks are clipped, and their differences with them."
    )
    return icc.through_lcms(codes, data), "coded"


def _by_gamma(
    codes: Floats, gamma: float | None, chromaticities: Chromaticities, notes: list[str]
) -> Floats:
    matrix = to_bt709(rgb_to_xyz(chromaticities), chromaticities[6:])
    near = gamma is None or abs(gamma - 1 / 2.2) <= NEAR_GAMMA
    if is_identity(matrix) and near:
        return codes
    if gamma is not None and not 0.1 <= gamma <= 10:
        raise ImageError(f"damaged: it states a gamma of {gamma:g}; export it again")
    light = decode_srgb(codes) if gamma is None else decode_gamma(codes, 1 / gamma)
    told = "sRGB's curve" if gamma is None else f"a gamma of {gamma:g}"
    notes.append(f"Colours are converted to sRGB from the primaries that it states, with {told}.")
    return encode_srgb(_to_bt709(light, chromaticities)).astype(np.float32)


def _to_bt709(light: Values, chromaticities: Chromaticities) -> Floats:
    matrix = to_bt709(rgb_to_xyz(chromaticities), chromaticities[6:])
    image: Floats = light.astype(np.float32)
    return image if is_identity(matrix) else converted(image, matrix)
