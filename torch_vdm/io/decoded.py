"""What a decoder returns: pixels, and what they are."""

from typing import Literal, NamedTuple, TypeAlias

from torch_vdm.io.refusal import Floats

# What pixels are. "coded": sRGB-coded, 1.0 is the screen's white, and colours outside BT.709 lie
# outside [0, 1]. "scene": linear BT.709, 1.0 is what the scene calls white. "absolute": linear
# BT.709 in cd/m2.
Kind: TypeAlias = Literal["coded", "scene", "absolute"]


class Decoded(NamedTuple):
    """An image as a file has it, before it is composited over a background."""

    pixels: Floats
    """(3, H, W)."""
    kind: Kind
    alpha: Floats | None = None
    """(H, W) in [0, 1]; None where the file has no transparency."""
    associated: bool = False
    """Whether the colours are already multiplied by alpha."""
    views: tuple[str, ...] = ()
    """The names of the views (eyes) of a multi-view file; the first is the one that is shown."""
