"""What a pair of images calls for: what can be left out without a difference that counts.

Only what provably makes no difference is left out: the map changes by rounding only.

- **Equal images.** The map is exactly 0 (`torch_vdm.model.level`: each image takes the same path).
- **Equal regions.** Where the two are equal in a pixel and so far around it that no filter, no
  pooling and no parent's share has a difference, the map is exactly 0
  (`torch_vdm.model.charging`). The finest levels are computed only where the images differ, the
  coarse ones from the whole images, where the second shares the first's nodes wherever they are
  equal. This is for an observer whose coarse differences are charged, and for contrast sensitivity
  on the levels.
- **Grey images.** For light of one colour the three cones' responses are one plane times three
  numbers, before and after every linear step, and so are their details: one plane is decomposed,
  and the three channels' contrasts are its details times three weights.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

# Pixels a side of the squares in which images are equal or not: as many booleans as an integer of
# 64 bits holds.
SQUARE = 8

# The spacing of the rows that are looked at first: if most of these differ, all are taken to.
# Status: choice.
ROWS = 32

# Regions are left out if no more than this share of the squares differs: the rest of an image is
# computed twice along their borders. Status: choice, measured.
MOST = 0.5

# Images with fewer pixels are computed whole: calling an operation costs more than its arithmetic.
# Status: choice, measured.
SMALLEST = 512 * 512


@dataclass(frozen=True, eq=False)
class Plan:
    """What is computed for a pair of images, and what is not.

    Attributes
    ----------
    effects
        The names of the effects that are simulated.
    equal
        Whether each batch item's two images are equal: its map is 0, and nothing is computed.
    differing
        For each item, the squares in which its images differ, (rows, columns), in a plane of
        squares that covers them; None if all of it is computed.
    square
        Pixels a side of a square.
    grey
        Whether one plane stands for the three cones.
    """

    effects: tuple[str, ...]
    equal: tuple[bool, ...]
    differing: tuple[Tensor | None, ...]
    square: int
    grey: bool

    @property
    def whole(self) -> bool:
        """Whether nothing is left out."""
        return not (self.grey or any(self.equal) or any(d is not None for d in self.differing))

    def reasons(self) -> list[str]:
        """Return what is left out and why, one sentence each; none if nothing is."""
        found = []
        if any(self.equal):
            which = _items(self.equal)
            found.append(f"nothing is computed of {which}: its two images are equal")
        for item, squares in enumerate(self.differing):
            if squares is not None:
                share = float(squares.float().mean())
                name = "" if len(self.equal) == 1 else f" of batch item {item}"
                found.append(
                    f"the fine levels{name} are computed in {share:.0%} of the image: elsewhere "
                    "the two are equal"
                )
        if self.grey:
            found.append("one plane stands for the three cones: both images are grey")
        return found

    def data(self) -> dict[str, Any]:
        """Return the same for a JSON file."""
        return {
            "effects": list(self.effects),
            "equal": list(self.equal),
            "computed_fraction": [
                0.0 if same else 1.0 if squares is None else float(squares.float().mean())
                for same, squares in zip(self.equal, self.differing, strict=True)
            ],
            "grey": self.grey,
            "left_out": self.reasons(),
        }


def everything(effects: tuple[str, ...], items: int) -> Plan:
    """Return the plan that leaves nothing out, for so many pairs."""
    return Plan(effects, (False,) * items, (None,) * items, SQUARE, grey=False)


def plan_of(test: Tensor, reference: Tensor, effects: tuple[str, ...], regions: bool) -> Plan:
    """Return the plan of two batches (B, 3, H, W); it reads numbers back from the device.

    ``regions``: whether equal regions may be left out.
    """
    pairs = [(test[i : i + 1], reference[i : i + 1]) for i in range(len(test))]
    equal: list[bool] = []
    differing: list[Tensor | None] = []
    for one, other in pairs:
        squares = _differing(one, other)
        equal.append(squares is not None and not bool(squares.any()))
        few = regions and squares is not None and not equal[-1] and _few(squares, one)
        differing.append(squares if few else None)
    grey = not all(equal) and is_grey(test) and is_grey(reference)
    return Plan(effects, tuple(equal), tuple(differing), SQUARE, grey)


def _few(squares: Tensor, image: Tensor) -> bool:
    large = image.shape[-2] * image.shape[-1] >= SMALLEST
    return large and float(squares.float().mean()) <= MOST


def _differing(test: Tensor, reference: Tensor) -> Tensor | None:
    """Return the squares in which two images (1, 3, H, W) differ; None if most rows do."""
    some = (test[..., ::ROWS, :] != reference[..., ::ROWS, :]).any(1)
    if float(some.float().mean()) > MOST:
        return None
    red, green, blue = (test != reference)[0]
    differ = red | green | blue
    height, width = differ.shape
    down, across = -(-height // SQUARE), -(-width // SQUARE)
    whole = functional.pad(differ, (0, across * SQUARE - width, 0, down * SQUARE - height))
    # Eight booleans are one integer: all of them are tested at once.
    return (whole.view(torch.int64) != 0).view(down, SQUARE, across).any(1)


def is_grey(image: Tensor) -> bool:
    """Return whether the three channels (B, 3, H, W) are equal, and nothing is below 0."""
    red, green, blue = image.unbind(1)
    for rows in (slice(None, None, ROWS), slice(None)):
        first = red[:, rows]
        same = torch.equal(first, green[:, rows]) and torch.equal(first, blue[:, rows])
        if not same or bool((first < 0.0).any()):
            return False
    return True


def _items(flags: tuple[bool, ...]) -> str:
    if len(flags) == 1:
        return "this pair"
    which = [str(item) for item, flag in enumerate(flags) if flag]
    return f"batch item{'s' if len(which) > 1 else ''} {', '.join(which)}"
