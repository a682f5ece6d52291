"""The model: Fig. 2 in order, from two images to what accumulates at every place.

`Model.difference` is the whole of it, and every executor of `torch_vdm.run` must reproduce it. The
two observers differ in six places: whether contrast sensitivity follows the local luminance
(`Model.sights`), levels are divided by their gains (the constants), responses keep their sign
(`torch_vdm.model.level`), the means of the images are compared (`Model.lowpass_difference`),
border nodes count for the pixels that they have (``true_means``), and coarse differences are
charged to the pixels that caused them (`Model.charges`).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.effects import Effects
from torch_vdm.model import filtering, lowpass
from torch_vdm.model.aberration import attenuation
from torch_vdm.model.charging import Charge, changes, charge
from torch_vdm.model.cones import of_grey, pixels_to_cones
from torch_vdm.model.cortex import Cortex, Transform
from torch_vdm.model.cortex.haar import lowpass_of_light
from torch_vdm.model.cortex.transform import DEEPEST, Base, mean_of
from torch_vdm.model.csf import barten, butterworth
from torch_vdm.model.display import Display, linear_values
from torch_vdm.model.distance import Paths, accumulate
from torch_vdm.model.grid import Before, Grid
from torch_vdm.model.level import (
    OF_LUMINANCE,
    Level,
    Levels,
    Options,
    Sight,
    local_difference,
    pushed,
    response,
    sights_of,
)
from torch_vdm.model.matrix import product
from torch_vdm.model.quadtree import push
from torch_vdm.model.steps import PLAIN, Steps
from torch_vdm.observer import Observer

# A Butterworth filter's parameters.
FILTER = ("gain", "cutoff", "order")


class Derived(NamedTuple):
    """What follows from the constants of a model alone."""

    levels: Levels
    """What all levels respond to, the coarsest first."""
    to_cones: Tensor
    """(3, 3), from linear values to cones."""
    bands: filtering.Weights | None = None
    """What filters the images, where they are filtered."""


class Model:
    """What is computed from two images: the boxes of Fig. 2, with all that they depend on.

    Parameters
    ----------
    display, observer, transform, effects
        As in `torch_vdm.VDM`.
    constants
        Their numbers as tensors, in the precision and on the device of the computation.
    steps
        How steps are called; one after the other by default.
    grey
        Whether the images' three channels are equal, so that one plane stands for the three cones.
        Results change by rounding only.
    cubes
        Whether the summation exponent is 6, and needs no gradient.
    derived
        What `derive` gives, where that is known.
    """

    def __init__(
        self,
        display: Display,
        observer: Observer,
        transform: Transform,
        effects: Effects,
        constants: Mapping[str, Tensor],
        steps: Steps = PLAIN,
        grey: bool = False,
        cubes: bool = False,
        derived: Derived | None = None,
    ) -> None:
        self.display = display
        self.observer = observer
        self.transform = transform
        self.effects = effects
        self.constants = constants
        self.steps = steps
        self.cubes = cubes
        self.derived = derived
        self.grey = self._of_grey() if grey else None

    # One image.

    def represent(self, image: Tensor) -> Cortex:
        """Return the cortex representation of an image (B, 3, H, W): display, cones, transform."""
        return self.decomposed(self.cone_planes(image))

    def cone_planes(self, image: Tensor) -> Tensor:
        """Return the cone responses (B, 3, H, W) to an image: display, cone fundamentals."""
        # Numbers are passed as tensors: compiled code is specialised on others.
        around = self.display.encoding, self.display.limit(image)
        if self.grey is not None:
            # The mean where there may be a gradient, which all three channels then share.
            one = image.mean(1, keepdim=True) if image.requires_grad else image[:, :1]
            return self.steps.pixels(lambda part: self.steps(linear_values, part, *around), one)
        matrix = self._to_cones()
        return self.steps.pixels(
            lambda part: self.steps(pixels_to_cones, part, *around, matrix), image
        )

    def _to_cones(self) -> Tensor:
        """Return the matrix from linear values to cones, so that pixels are mixed only once."""
        if self.derived is not None:
            return self.derived.to_cones
        matrix = self.constants["cones"]
        if self.display.encoding == "xyz":
            return matrix
        return product(matrix, self.constants["primaries"]) * self.display.gain

    def _of_grey(self) -> Tensor:
        """Return the cone responses (3,) to a linear value of 1 in all channels."""
        return self._to_cones().sum(1)

    def cones(self, planes: Tensor) -> Tensor:
        """Return the planes of the three cones (B, 3, h, w) for what is linear in `cone_planes`."""
        return of_grey(planes, self.grey)

    def decomposed(self, planes: Tensor) -> Cortex:
        """Return the cortex representation of cone planes (B, 3, H, W)."""
        return self.decomposed_of(self.filtered(planes), planes)

    def decomposed_of(self, source: Tensor, planes: Tensor, grid: Grid | None = None) -> Cortex:
        """Return the same from what is `filtered`, and the light it comes from.

        ``grid``: that of a part of an image.
        """
        cortex = self.transform.decompose(source, self.steps, self.observer.true_means, grid=grid)
        if self.transform.csf == "levels":
            return cortex
        light = Base(planes, 0, _size(planes), mean_of(planes))
        return lowpass_of_light(cortex, light, self.observer.true_means)

    def filtered(self, planes: Tensor, coarser: Tensor | None = None, finest: int = 0) -> Tensor:
        """Return what is decomposed: the cone planes themselves, or their weighted contrast.

        ``coarser`` and ``finest`` are as in `filtering.weighted_contrast`.
        """
        if self.transform.csf == "levels":
            return planes
        return filtering.weighted_contrast(
            planes, self.band_weights(), self.constants, coarser, finest, self.grey, self.steps
        )

    def band_weights(self) -> filtering.Weights:
        """Return the weights of the bands of an image that is filtered."""
        if self.derived is not None and self.derived.bands is not None:
            return self.derived.bands
        frequency = self.constants["band_frequencies"]
        bright = self._bright(frequency[None], torch.ones_like(frequency)[None])[0]
        passed = self._passed(frequency)
        local = self.observer.adaptation_luminance is None
        return filtering.weights(self.constants, passed, bright, local, self.effects.chromatic)

    def responses(
        self, cortex: Cortex, sights: Sequence[Sight] | None = None
    ) -> tuple[Tensor, ...]:
        """Return the responses of one image, one (B, channels, orientations, h, w) per level.

        These include all boxes from chromatic aberration to the transducer; level 0 comes first,
        and 1 is threshold. ``sights``: the image's `adaptation`, where that is known.
        """
        options = self.options()
        seen_at = zip(cortex.details, sights or self.adaptation(cortex), strict=True)
        return tuple(response(detail, sight, options) for detail, sight in seen_at)

    def adaptation(self, cortex: Cortex) -> list[Sight]:
        """Return the channel weighting of each level of one image, at its nodes."""
        levels = self.levels(cortex.finest, len(cortex.details))
        found = []
        for number, detail in enumerate(cortex.details):
            (sight,) = self.sights(levels.only(number), [cortex], number)
            found.append(sight.pushed(_size(detail), before=cortex.before[number]))
        return found

    # Two images.

    def difference(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the accumulated differences (B, 1, h, w) of two images, before the final root."""
        first, second = self.represent(test), self.represent(reference)
        local = self.local_differences(first, second)
        paths = Paths(local, self.changes(first, second), self.root(first, second))
        return self.descended(paths, first.before)

    def local_differences(self, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
        """Return the local visual differences (Eq. 5): (B, 1, h, w) per level, level 0 first."""
        levels = self.levels(first.finest, len(first.details))
        return tuple(
            self.local_difference(first, second, number, levels.only(number))
            for number in range(len(first.details))
        )

    def local_difference(self, first: Cortex, second: Cortex, number: int, level: Level) -> Tensor:
        """Return the local visual difference (B, 1, h, w) of the level of this number."""
        details, others = first.details[number], second.details[number]
        sight, other_sight = pushed(
            self.sights(level, (first, second), number), _size(details), first.before[number]
        )
        images = details, others, sight, other_sight
        return local_difference(*images, self.options(), self.steps)

    def nothing(self, image: Tensor) -> Tensor:
        """Return the `difference` of an image (1, 3, H, W) and itself."""
        return image.new_zeros(1, 1, *self.leaves((image.shape[-2], image.shape[-1])))

    def leaves(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the size of the plane of leaves: pixels, or nodes of 2x2 where none overlap.

        An image of one pixel is its own node.
        """
        if self.transform.shifts > 1 or size == (1, 1):
            return size
        top, left = self.grid(size).before(0)
        return -(-(size[0] + top) // 2), -(-(size[1] + left) // 2)

    def lowpass_difference(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the weighted contrast between the means of two images, the lowpass term.

        It is (B, channels, 1, 1), not negative, 1 at threshold; and 0 for an observer that never
        compares them. A uniform change is seen here and nowhere else.
        """
        return self._of_means(lowpass.lowpass_difference, first, second)

    def root(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the value that every path starts from, (B, 1, 1, 1)."""
        return self._of_means(lowpass.root, first, second, "summation_exponent")

    def _of_means(
        self, function: Callable[..., Tensor], first: Cortex, second: Cortex, *others: str
    ) -> Tensor:
        """Return a function of `torch_vdm.model.lowpass`; 0 if the means are never compared.

        ``others``: which constants it takes besides those of `lowpass.lowpass_difference`.
        """
        one, other = self.cones(first.mean), self.cones(second.mean)
        if self.observer.lowpass_gains is None:
            # Part of the autograd graph, so that an image of one pixel has a gradient.
            return 0.0 * one[:, :1] + 0.0 * other[:, :1]
        names = "dark_cones", "opponents", "lowpass_gains", *others
        constants = (self.constants[name] for name in names)
        found: Tensor = self.steps.once(function, one, other, *constants)
        return found

    def changes(self, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
        """Return the `charging.changes` of every level, level 0 first; none without charging."""
        if not self.observer.charging:
            return ()
        return tuple(self.change(first, second, number) for number in range(len(first.details)))

    def change(self, first: Cortex, second: Cortex, number: int) -> Tensor:
        """Return the `charging.changes` (B, 1, h, w) at the nodes of one level."""
        found: Tensor = self.steps(changes, first.lowpass[number], second.lowpass[number])
        if not self.quartered:
            return found
        # The mean over those quarters that a node has.
        top, left = first.grid.before(first.finest + len(first.details) - 1 - number)
        height, width = _size(found)
        sides = (left, (width + left) % 2, top, (height + top) % 2)
        return functional.avg_pool2d(functional.pad(found, sides, mode="replicate"), 2)

    @property
    def quartered(self) -> bool:
        """Whether lowpass planes hold the quarters of nodes; see `lowpass_of_light`."""
        return self.transform.csf == "filter" and self.transform.shifts == 1

    def descended(self, paths: Paths, before: Sequence[Before]) -> Tensor:
        """Return what has accumulated at the leaves of all paths, (B, 1, h, w)."""
        return accumulate(paths.local, paths.root, before, self.charges(paths.changes))

    def charges(self, changes: Sequence[Tensor]) -> list[Charge] | None:
        """Return the shares that the nodes of each level are charged; None: all."""
        if not self.observer.charging:
            return None
        options = self.transform.shifts, self.transform.csf == "filter", self.steps
        return [charge(change, *options) for change in changes]

    def grid(self, size: tuple[int, int]) -> Grid:
        """Return where the nodes lie on an image of ``size`` = (H, W) pixels."""
        return self.transform.grid(size, self.observer.true_means)

    def to_pixels(self, plane: Tensor, size: tuple[int, int], grid: Grid | None = None) -> Tensor:
        """Return a plane of leaves at pixel resolution; ``grid``: that of a part of an image."""
        if self.transform.shifts > 1:  # the leaves of overlapping nodes are the pixels
            return plane
        grid = self.grid(size) if grid is None else grid
        return push(plane, size, before=grid.before(0)).contiguous()

    # What follows from the constants.

    def derive(self) -> Derived:
        """Return what follows from the constants alone."""
        bands = self.band_weights() if self.transform.csf == "filter" else None
        return Derived(self.all_levels(), self._to_cones(), bands)

    # What a level depends on.

    def options(self) -> Options:
        """Return what the boxes of a level depend on."""
        return Options(
            self.observer.signed,
            self.effects.masking,
            self.transform.phases,
            self.transform.shifts > 1,
            3 if self.effects.pooling else 1,
            self.cubes,
            self.constants["opponents"],
            self.constants["transducer_exponent"],
            self.constants["summation_exponent"],
        )

    def sights(self, level: Level, images: Sequence[Cortex], number: int) -> list[Sight]:
        """Return each image's channel weighting of the level of this number, at the parents."""
        if self.transform.csf == "filter":
            return [weights_alone(level)] * len(images)
        parents = [cortex.parent_lowpass(number) for cortex in images]
        # Images that are compared at the same light share it, and what follows from it.
        one = all(parent is parents[0] for parent in parents)
        some = parents[:1] if one else parents
        sights: list[Sight] = self.steps(sights_of, some, level, *self.sight_options())
        return sights * len(images) if one else sights

    def sight_options(self) -> tuple[dict[str, Tensor], bool, bool, Tensor | None]:
        """Return what `sights_of` takes besides parents and level."""
        local = self.observer.adaptation_luminance is None
        # No more than it needs: a compiled function checks every tensor that it is given.
        names = ("dark_cones", *(OF_LUMINANCE if local else ()))
        names = names if self.grey is None else (*names, "opponents")
        constants = {name: self.constants[name] for name in names}
        return constants, local, self.effects.chromatic, self.grey

    def levels(self, finest: int, count: int) -> Levels:
        """Return what ``count`` levels respond to, the coarsest first; the finest is ``finest``."""
        coarsest = finest + count
        if self.derived is None:
            return self.all_levels(slice(finest, coarsest))
        some = slice(DEEPEST - coarsest, DEEPEST - finest)
        return Levels(*(part[some] for part in self.derived.levels))

    def all_levels(self, some: slice = slice(None)) -> Levels:
        """Return what all levels respond to, or some from the finest; the coarsest first.

        All levels at once: on small images, calling a level's operations costs more than their
        arithmetic.
        """
        frequency, gain = (self.constants[name][some].flip(0) for name in ("frequencies", "gains"))
        passed = self._passed(frequency[:, 0])
        return Levels(passed, frequency, gain, self._bright(frequency, gain))

    def _passed(self, frequency: Tensor) -> Tensor:
        """Return the fraction (levels, 3) of cone details that chromatic aberration passes."""
        if not self.effects.aberration:
            return torch.ones_like(frequency).unsqueeze(1).expand(-1, 3)
        of_eye = self.constants["aberration_cutoff"], self.constants["aberration_exponent"]
        return attenuation(frequency, *of_eye)

    def _bright(self, frequency: Tensor, gain: Tensor) -> Tensor:
        """Return the sensitivity of all channels, or of C1 and C2 where the luminance is local.

        It is (levels, channels, n) from (levels, n), for bright light, and divided by the gain.
        """
        of, channels = self.constants, []
        if self.observer.adaptation_luminance is not None:
            luminance, size = of["adaptation_luminance"], of["achromatic_size"]
            channels = [of["achromatic_gain"] * barten(frequency, luminance, size)]
        if self.effects.chromatic:
            channels += [
                butterworth(frequency, *(of[f"{name}_{part}"] for part in FILTER))
                for name in ("red_green", "yellow_violet")
            ]
        return torch.stack(channels, 1) / gain.unsqueeze(1) if channels else gain.unsqueeze(1)


def weights_alone(level: Level) -> Sight:
    """Return the channel weighting of a level of filtered images: details are contrasts already."""
    return Sight(None, (1.0 / level.gain).unsqueeze(0))


def _size(plane: Tensor) -> tuple[int, int]:
    return plane.shape[-2], plane.shape[-1]
