"""The visual difference metric: the stages of Fig. 2, in order. Only this file knows the order."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.aberration import attenuation
from torch_vdm.charging import Charge, changes, charge
from torch_vdm.cones import XYZ_TO_SML, cone_responses
from torch_vdm.contrast import (
    SML_TO_OPPONENTS,
    adapted,
    local_contrast,
    opponents,
    weber_contrast,
)
from torch_vdm.cortex import DEEPEST, Cortex, Haar, Transform, bands
from torch_vdm.cortex.haar import lowpass_of_light
from torch_vdm.cortex.transform import Base, mean_of
from torch_vdm.csf import barten, butterworth
from torch_vdm.display import BT709_TO_XYZ, Display, linear_values
from torch_vdm.distance import (
    LARGEST_DIFFERENCE,
    Paths,
    accumulate,
    local_visual_difference,
    local_visual_difference_of_energy,
)
from torch_vdm.effects import Effects
from torch_vdm.fast import SMALLEST, compiled, step
from torch_vdm.gradient import by_hand, local_difference
from torch_vdm.grid import Before, Grid
from torch_vdm.masking import unmasked
from torch_vdm.matrix import mix_row, product
from torch_vdm.observer import Observer
from torch_vdm.pair import Nonfinite, Numbers
from torch_vdm.pooling import (
    covering,
    pool,
    pool_halves,
    surround,
    surround_halves,
    within,
)
from torch_vdm.quadtree import apart, push, stacked
from torch_vdm.response import (
    OF_LUMINANCE,
    Level,
    Levels,
    Options,
    Sight,
    adapted_luminance,
    difference_of,
    response,
    response_difference,
    response_difference_at,
    sensitivity_at,
    sights_of,
)
from torch_vdm.sarnoff import Sarnoff
from torch_vdm.tiled import TiledMetric
from torch_vdm.tiling import Slices, Tile, Tiling, cut

# Planes with more numbers are computed in parts. Status: choice, measured.
LARGEST_AT_ONCE = 2**18

# Pixels of a strip of a large image, and how many levels, from the finest, are computed in strips.
# Status: choice, measured.
STRIP, STRIP_LEVELS = 2**19, 2

# Pixels of a strip in which a large image is filtered. Status: choice, measured.
BAND_STRIP = 2**17

# Levels of at most as many nodes are computed at once: there an operation costs more than the
# numbers that it works on. Status: choice, measured.
FEW_NODES = 64 * 64

# Where the weights of a filter's bands are worked out, log2 cd/m2, and between them interpolated:
# sensitivities change by less than 3 dB from one to the next. Status: choice.
LUMINANCES = tuple(range(-8, 18))

# A Butterworth filter's parameters.
FILTER = ("gain", "cutoff", "order")


class VDM(TiledMetric):
    """The visual difference metric of Bolin and Meyer 1999 as a module.

    Calling it with a test and a reference image, both (B, 3, H, W), gives the map of their
    visible differences, (B, 1, H, W) in just-noticeable differences: 1 is just noticeable. The
    order of the two makes no difference, and equal images give exactly 0.

    It computes in float64 where an input is float64, else in float32, under autocast too. Its
    constants follow from its options: they move with the module, keep their precision through
    `half()` and the like, and are no part of its state dict.

    Parameters
    ----------
    ppd
        Pixels in one degree of the visual field; see `pixels_per_degree`.
    display
        What the pixel values are; `Display.srgb()` by default.
    observer
        Who looks; `Observer.calibrated()` by default, and that one with what was fitted with the
        transform.
    transform
        How the image is decomposed: `Haar()`, the default, `StationaryHaar()` or `Steerable()`.
    effects
        What is simulated; everything by default.
    nonfinite
        "raise": NaN or infinity in an image is a ValueError that names the batch item (a graph
        of torch.export cannot raise: there it gives NaN). To know, one number an image is read
        back from the device, and one of a mask of `VDMLoss`. "mask": such pixels are taken as equal
        in both images, with the value that one of them has, or else that of their surroundings,
        and the map is 0 there; nothing is read back. In both cases the first call reads once more:
        values that are no sRGB codes, where the display takes these, are told by a warning.

    Raises
    ------
    ValueError
        Where a parameter or an image is not as stated.
    """

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        observer: Observer | None = None,
        transform: Transform | None = None,
        effects: Effects | None = None,
        nonfinite: Nonfinite = "raise",
    ) -> None:
        super().__init__(ppd, display, nonfinite)
        for name, option, kind in (
            ("observer", observer, Observer),
            ("effects", effects, Effects),
        ):
            if not isinstance(option, kind | None):
                raise ValueError(f"expected {name}: {kind.__name__}, got {option!r}")
        if isinstance(transform, type) or not isinstance(transform, Transform | None):
            raise ValueError(
                f"expected transform: Haar(), StationaryHaar() or Steerable(), got {transform!r}"
            )
        self.transform = transform or Haar()
        self.observer = (observer or Observer.calibrated()).fitted_to(self.transform)
        self.effects = effects or Effects()

        peaks = [self.transform.peaks(level) for level in range(DEEPEST)]
        constants: dict[str, Numbers] = {
            "primaries": BT709_TO_XYZ,
            "cones": XYZ_TO_SML,
            "opponents": SML_TO_OPPONENTS if self.effects.chromatic else SML_TO_OPPONENTS[:1],
            "luminance_of_cones": np.linalg.inv(XYZ_TO_SML)[1:2].tolist(),
            "dark_cones": [self.observer.dark_light * sum(row) for row in XYZ_TO_SML],
            "frequencies": [[self.ppd * frequency for frequency, _ in level] for level in peaks],
            # Without them the orientations keep what they have to one another.
            "gains": [
                [gain if self.observer.level_gain else gain / level[0][1] for _, gain in level]
                for level in peaks
            ],
            **self.observer.numbers(),
        }
        if self.observer.lowpass_gains is not None:
            channels = 3 if self.effects.chromatic else 1
            constants["lowpass_gains"] = self.observer.lowpass_gains[:channels]
        if self.transform.csf == "filter":
            constants["band_frequencies"] = [self.ppd * cycles for cycles in bands.frequencies()]
            constants["band_weights"] = bands.weights()
        self._set_constants(constants)

    @classmethod
    def paper(cls, ppd: float = 60.0, display: Display | None = None, **options: Any) -> Self:
        """Return the metric with the paper's observer, every equation as printed."""
        return cls(ppd, display, observer=Observer.paper(), **options)

    @staticmethod
    def sarnoff(ppd: float = 60.0, display: Display | None = None, **options: Any) -> Sarnoff:
        """Return the model that the paper simplifies: Lubin 1995, of luminance alone."""
        return Sarnoff(ppd, display, **options)

    def extra_repr(self) -> str:
        """Return the options."""
        return (
            f"ppd={self.ppd}, display={self.display}, observer={self.observer.name}, "
            f"transform={self.transform}, effects={self.effects.names()}"
        )

    def _accumulated(self, test: Tensor, reference: Tensor) -> Tensor:
        # With gradients strips take less memory and more time, as checkpoints do.
        graph = torch.is_grad_enabled() and (test.requires_grad or reference.requires_grad)
        if (
            math.prod(_size(test)) >= 2 * STRIP
            and not torch.compiler.is_compiling()
            and (self._checkpointed or not graph)
        ):
            return self._accumulated_in_strips(test, reference)
        if not self._fast or len(test) == 1:
            return self.compare(self.represent(test), self.represent(reference))
        # Below one another: compiled code for one image serves a batch. `_at_once` gives several
        # items to this transform alone.
        options, items = (self._fast, self.observer.true_means), len(test)
        first, second = (
            Haar().decompose(self._cone_planes(stacked(image)), *options, items)
            for image in (test, reference)
        )
        return apart(self.compare(first, second)[0], items).transpose(0, 1)

    def _at_once(self, size: tuple[int, int]) -> int:
        if self.transform != Haar():
            return 1
        # As many pixels as are not yet cut in strips, and so few items that their planes of 2x2
        # nodes are not compiled: another form would be, for a side that becomes 1.
        return min(max(1, 2 * STRIP // math.prod(size)), SMALLEST // 16)

    def _accumulated_in_strips(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the same of large images, the finest levels strip by strip.

        A strip stays in the processor's cache, and its memory is used again for the next one, where
        whole planes would be asked from the system anew in every call.
        """
        size, count = _size(test), STRIP_LEVELS + 1
        transform, shifts = self.transform, self.transform.shifts
        options = self._fast, self.observer.true_means
        constants = self._constants(test.dtype)
        # One level more than are computed, for the parents of the last.
        levels = self._levels(0, count, constants)
        pooled = 2 * shifts - 1
        grid = self._grid(size)
        tiling = Tiling.strips(size, STRIP, STRIP_LEVELS, shifts, transform.reach + pooled, grid)
        octaves = count - shifts
        filtered = transform.csf == "filter"
        sources = [test, reference]
        if filtered:  # which needs the image whole
            sources = [self._cone_planes(image) for image in sources]
            sources += [self._filtered(planes) for planes in sources]

        def strip_of(strip: Tile, *images: Tensor) -> list[Tensor]:
            """Return what the rest needs and rows of two images, and what their levels add."""
            parts: list[Tensor] = []
            strips: list[Cortex] = []
            for image, contrast in zip(images[:2], images[2:] or (None, None), strict=True):
                light = image if filtered else self._cone_planes(image)
                rows = light.mean(-1, keepdim=True)
                planes = light if contrast is None else contrast
                part = tiling.grid_of(strip.around)
                cortex, reduced = transform.begin(planes, count, *options, grid=part)
                parts.append(cut(rows, (strip.within(1)[0], slice(None))))
                parts.append(cut(reduced, strip.within(2**octaves)))
                if filtered:
                    base = Base(light, 0, _size(light), rows)
                    cortex = lowpass_of_light(cortex, base, self.observer.true_means)
                    parts.append(cut(cortex.lowpass[shifts - 1], strip.within(2**octaves)))
                strips.append(cortex)
            for number in range(1, count):
                level, within = levels.only(number), strip.within(2 ** (count - number) // shifts)
                local = self._local_difference(strips[0], strips[1], number, level, constants)
                parts.append(cut(local, within))
                if self.observer.charging:
                    parts.append(cut(self._change(strips[0], strips[1], number), within))
            return parts

        pieces = [
            strip_of(strip, *around)
            for strip, *around in zip(
                tiling, *(tiling.split_rows(source) for source in sources), strict=True
            )
        ]
        joined = [torch.cat(parts, -2) for parts in zip(*pieces, strict=True)]
        each = 3 if filtered else 2
        coarser: list[Cortex] = []
        for rows, *planes in (joined[:each], joined[each : 2 * each]):
            mean = mean_of(rows)
            bases = [Base(plane, octaves, size, mean) for plane in planes]
            cortex = transform.rest(bases[0], *options)
            if filtered:
                cortex = lowpass_of_light(cortex, bases[1], self.observer.true_means)
            coarser.append(cortex)
        paths = self._differences(*coarser)
        fine = joined[2 * each :]
        kinds = 2 if self.observer.charging else 1
        paths = Paths(
            (*paths.local, *fine[::kinds]),
            (*paths.changes, *fine[1::kinds]) if kinds == 2 else (),
            paths.root,
        )
        return self._descended(paths, grid.down(len(paths.local)))

    def _grid(self, size: tuple[int, int]) -> Grid:
        return self.transform.grid(size, self.observer.true_means)

    def _to_pixels(self, plane: Tensor, size: tuple[int, int], grid: Grid | None = None) -> Tensor:
        if self.transform.shifts > 1:  # the leaves of overlapping nodes are the pixels
            return plane
        grid = self._grid(size) if grid is None else grid
        return push(plane, size, before=grid.before(0))

    def score(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the largest value of each item's map, (B,), JND: 1 is just noticeable."""
        largest: Tensor = self(test, reference).amax((1, 2, 3))
        return largest

    def represent(self, image: Tensor) -> Cortex:
        """Return the cortex representation of an image: display, cones, transform.

        ``image`` is (B, 3, H, W), as the display expects it; of half precision in float32.
        """
        self._require_image("an image", image)
        dtype = torch.promote_types(image.dtype, torch.float32)
        return self._decomposed(self._cone_planes(image.to(dtype).contiguous()))

    def _decomposed(
        self,
        planes: Tensor,
        coarser: Tensor | None = None,
        part: Slices | None = None,
        grid: Grid | None = None,
    ) -> Cortex:
        options = self._fast, self.observer.true_means
        source = self._filtered(planes, coarser)
        source = source if part is None else cut(source, part)
        cortex = self.transform.decompose(source, *options, grid=grid)
        if self.transform.csf == "levels":
            return cortex
        mean = mean_of(planes)
        planes = planes if part is None else cut(planes, part)
        light = Base(planes, 0, _size(planes), mean)
        return lowpass_of_light(cortex, light, self.observer.true_means)

    def _filtered(self, planes: Tensor, coarser: Tensor | None = None, finest: int = 0) -> Tensor:
        if self.transform.csf == "levels":
            return planes
        return self._weighted_contrast(planes, coarser, finest)

    def _cone_planes(self, image: Tensor) -> Tensor:
        """Return the cone responses (B, 3, H, W) to an image: display, cones."""
        constants = self._constants(image.dtype, "primaries", "cones")
        # From the display's primaries to cones at once: one mixing of all pixels instead of two.
        matrix = constants["cones"]
        if self.display.encoding != "xyz":
            matrix = product(matrix, constants["primaries"]) * self.display.gain
        # Numbers as tensors: compiled code is specialised on others.
        around = self.display.encoding, self.display.limit(image), matrix
        if self._fast:
            planes: Tensor = compiled(_light)(image, *around)
            return planes
        return self._in_rows(lambda part: _light(part, *around), image)

    def _in_rows(self, function: Callable[..., Tensor], *images: Tensor) -> Tensor:
        """Return a function of pixels, a few rows at a time, which stay in the cache."""
        rows = max(1, LARGEST_AT_ONCE * images[0].shape[-2] // images[0].numel())
        parts = zip(*(image.split(rows, -2) for image in images), strict=True)
        return torch.cat([self._kept(function, *part) for part in parts], -2)

    def _weighted_contrast(
        self, planes: Tensor, coarser: Tensor | None = None, finest: int = 0
    ) -> Tensor:
        """Return the weighted contrast of A, C1, C2, 1 at threshold, of cone planes (B, 3, H, W).

        The stages from chromatic aberration to the contrast sensitivity on smooth bands, each in
        its own lowpass and luminance, and all bands together again: (B, channels, H, W). From the
        scale ``finest`` on, to the coarsest or to that where ``coarser`` is the sum of the rest.
        """
        constants = self._constants(planes.dtype)
        passed = self._passed(constants["band_frequencies"], constants)
        weights, local = self._band_weights(constants)
        seen: list[Tensor] = []
        here, last = planes, (1, 1) if coarser is None else _size(coarser)
        for scale in itertools.count(finest):
            if _size(here) == last:
                break
            some = slice(0, 2) if scale == 0 else slice(scale + 1, scale + 2)
            table = None if local is None else torch.cat((local[some], local[-1:]))
            weighing = passed[some].clone(), weights[:, some].clone(), table
            contrast_of = partial(
                self._scale_contrast, finest=scale == 0, weighing=weighing, constants=constants
            )
            contrast, here = self._in_strips(contrast_of, here)
            seen.append(contrast)
        if coarser is not None:
            seen.append(coarser)
        if not seen:  # one pixel
            return 0.0 * planes[:, : len(constants["opponents"])]
        return bands.gathered(seen, self._fast)

    def _in_strips(
        self, contrast_of: Callable[[Tensor], tuple[Tensor, Tensor]], plane: Tensor
    ) -> Sequence[Tensor]:
        """Return `_scale_contrast` of a plane; a large one in strips, which stay in the cache."""
        few = math.prod(_size(plane)) < 2 * BAND_STRIP
        if few or self._fast or torch.compiler.is_compiling():
            whole: tuple[Tensor, Tensor] = self._kept(contrast_of, plane)
            return whole
        tiling = Tiling.strips(_size(plane), BAND_STRIP, 0, 1, bands.REACH)
        pieces = []
        for strip, around in zip(tiling, tiling.split_rows(plane), strict=True):
            found = self._kept(contrast_of, around)
            pieces.append([cut(part, strip.within(n)) for n, part in enumerate(found, 1)])
        return [torch.cat(parts, -2) for parts in zip(*pieces, strict=True)]

    def _scale_contrast(
        self,
        plane: Tensor,
        finest: bool,
        weighing: tuple[Tensor, Tensor, Tensor | None],
        constants: dict[str, Tensor],
    ) -> tuple[Tensor, Tensor]:
        """Return the weighted contrast of a scale's bands, and the lowpass that it leaves.

        ``weighing``: what chromatic aberration leaves, weights, and the table of those that follow
        the luminance, all of these bands.
        """
        planes, around, lowpass = bands.parted(plane, finest, self._fast)
        *weights, table = weighing
        at_places = None
        if table is not None:
            weigh = step(_band_sensitivity, lowpass, self._fast)
            at_places = weigh(lowpass, table, constants)
            at_places = bands.expanded(at_places, _size(around), self._fast)
        eye = constants["dark_cones"], constants["opponents"]
        seen = step(_band_contrast, lowpass, self._fast)
        return seen(planes, around, *weights, at_places, *eye), lowpass

    def _band_weights(self, constants: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
        """Return what weights bands so that the contrast sensitivity passes at their frequencies.

        (channels, bands), and, where the luminance is local, what they are multiplied by at
        `LUMINANCES`, (bands + 1, luminances): A's by the rows of the bands, C1's and C2's by the
        last.
        """
        frequency = constants["band_frequencies"]
        ones = torch.ones_like(frequency)
        bright = self._bright(frequency[None], ones[None], constants)[0]
        # No matrix products, which autocast would round.
        weights = (constants["band_weights"] * bright.unsqueeze(1)).sum(2)
        if self.observer.adaptation_luminance is not None:
            return weights, None
        # Of the light alone: the eye's own is added to it again.
        luminances = torch.exp2(ones.new_tensor(LUMINANCES)) - constants["dark_light"]
        grey = luminances * constants["cones"].sum(1, keepdim=True)
        at_bands = (part[..., None, None] for part in (ones, frequency, ones, bright))
        level = Level(*at_bands)
        chromatic = self.effects.chromatic
        sensitivity = sensitivity_at(grey[None, :, None], level, constants, chromatic)[0, :, :, 0]
        achromatic = (constants["band_weights"][..., None] * sensitivity[0]).sum(1)
        dim = sensitivity[-1, 0] / bright[-1, 0]
        if not chromatic:
            weights = weights[:0]
        return torch.cat((ones[None], weights)), torch.cat((achromatic, dim[None]))

    def respond(self, cortex: Cortex) -> tuple[Tensor, ...]:
        """Return the responses of one image: chromatic aberration to the transducer.

        One (B, channels, orientations, h, w) a level, level 0 first; 1 is threshold. Those of a
        signed observer are weighted contrasts: what masks them is of the other image too.
        """
        constants = self._constants(cortex.mean.dtype)
        responses = []
        levels = self._levels(cortex.finest, len(cortex.details), constants)
        for number, detail in enumerate(cortex.details):
            (sight,) = self._sights(levels.only(number), constants, [cortex], number)
            pushed = sight.pushed(_size(detail), before=cortex.before[number])
            responses.append(response(detail, pushed, self._options(constants)))
        return tuple(responses)

    def lowpass_difference(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the weighted contrast between the means of two images, the lowpass term.

        (B, channels, 1, 1), not negative, 1 at threshold; 0 for an observer that never compares
        them. A uniform change is seen here and nowhere else.
        """
        one, other = first.mean, second.mean
        if self.observer.lowpass_gains is None:
            # Of the graph, so that an image of one pixel has a gradient.
            return 0.0 * one[:, :1] + 0.0 * other[:, :1]
        constants = self._constants(one.dtype, "dark_cones", "opponents", "lowpass_gains")
        contrast = weber_contrast(one, other, constants["dark_cones"])
        gains = constants["lowpass_gains"].view(-1, 1, 1)
        weighted = opponents(contrast, constants["opponents"]) * gains
        return weighted.abs().clamp_max(LARGEST_DIFFERENCE)

    def compare(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the accumulated differences of two representations, before the root.

        (B, 1, h, w) of the finest level. The responses of a level are taken and dropped one
        level at a time, which bounds memory.
        """
        return self._descended(self._differences(first, second), first.before, first.items)

    def beside(self, first: Cortex) -> Callable[[Cortex], Tensor]:
        """Return `compare` with a first representation that stays, whose responses are taken once.

        It may stand for a batch of others, (1, ...) beside (B, ...), but not for images below one
        another. Nearly half of the time where many are compared with one; in the last bits other
        numbers than `compare`. Coarse differences are charged to all pixels below them: where the
        largest of the map is wanted, of noise that is everywhere, it is the same.
        """
        responses = self.respond(first)

        def compare(second: Cortex) -> Tensor:
            constants = self._constants(second.mean.dtype)
            options = self._options(constants)
            root = self.lowpass_difference(first, second) ** constants["summation_exponent"]
            local = tuple(
                self._gathered(difference_of(own, seen, options), constants)
                for own, seen in zip(responses, self.respond(second), strict=True)
            )
            return accumulate(local, root.sum(1, keepdim=True), before=first.before)

        return compare

    def _differences(self, first: Cortex, second: Cortex) -> Paths:
        """Return what the map is accumulated from."""
        constants = self._constants(first.mean.dtype, "summation_exponent")
        root = self.lowpass_difference(first, second) ** constants["summation_exponent"]
        local = self.local_differences(first, second)
        return Paths(local, self._changes(first, second), root.sum(1, keepdim=True))

    def _changes(self, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
        """Return the `changes` of every level, level 0 first; none where nothing is charged."""
        if not self.observer.charging:
            return ()
        few = 0 if self._quartered else _few(first)
        coarse: list[Tensor] = []
        if few:
            rows = changes(*(_in_a_row(cortex.lowpass[:few]) for cortex in (first, second)))
            coarse = _planes(rows, [_size(detail) for detail in first.details[:few]])
        fine = range(few, len(first.details))
        return (*coarse, *(self._change(first, second, number) for number in fine))

    def _change(self, first: Cortex, second: Cortex, number: int) -> Tensor:
        """Return the `changes` (B, 1, h, w) at the nodes of one level."""
        one, other = first.lowpass[number], second.lowpass[number]
        change: Tensor = step(changes, one, self._fast)(one, other)
        if not self._quartered:
            return change
        # The mean of the quarters that a node has.
        top, left = first.grid.before(first.finest + len(first.details) - 1 - number)
        height, width = _size(change)
        sides = (left, (width + left) % 2, top, (height + top) % 2)
        return functional.avg_pool2d(functional.pad(change, sides, mode="replicate"), 2)

    def _descended(self, paths: Paths, before: Sequence[Before], items: int = 1) -> Tensor:
        charges = self._charges(paths.changes, items)
        return accumulate(paths.local, paths.root, items, before, charges)

    def _charges(self, changes: Sequence[Tensor], items: int = 1) -> list[Charge] | None:
        if not self.observer.charging:
            return None
        options = self.transform.shifts, self.transform.csf == "filter", items
        return [step(charge, change, self._fast)(change, *options) for change in changes]

    @property
    def _quartered(self) -> bool:
        """Whether lowpass planes have the quarters of nodes; see `lowpass_of_light`."""
        return self.transform.csf == "filter" and self.transform.shifts == 1

    def local_differences(self, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
        """Return the local visual difference of every node (Eq. 5), before the root.

        One (B, 1, h, w) a level, level 0 first.
        """
        constants = self._constants(first.mean.dtype)
        levels = self._levels(first.finest, len(first.details), constants)
        few = _few(first)
        return (
            *self._local_differences_of_few(first, second, few, levels, constants),
            *(
                self._local_difference(first, second, number, levels.only(number), constants)
                for number in range(few, len(first.details))
            ),
        )

    def _local_differences_of_few(
        self, first: Cortex, second: Cortex, few: int, levels: Levels, constants: dict[str, Tensor]
    ) -> list[Tensor]:
        """Return the local visual differences of the ``few`` coarsest levels, nodes in a row."""
        if few == 0:
            return []
        items = first.items
        sizes = [_size(detail) for detail in first.details[:few]]
        nodes = [math.prod(size) for size in sizes]
        details = _in_a_row(first.details[:few]), _in_a_row(second.details[:few])
        fast = self._fast and details[0].numel() >= SMALLEST
        level, options = levels.in_a_row(nodes), self._options(constants)
        if self.transform.csf == "filter":
            sight = _weights_alone(level)
            difference = response_difference(details[0], details[1], sight, sight, options)
        else:
            # Both images in one batch, where nothing is computed.
            images = first, second
            parents = _in_a_row(
                push(
                    torch.cat([cortex.parent_lowpass(number) for cortex in images]),
                    size,
                    items,
                    first.before[number],
                )
                for number, size in enumerate(sizes)
            )
            both = [parent.clone() for parent in parents.chunk(2)]
            respond = compiled(response_difference_at) if fast else response_difference_at
            seen_at = (both, level, *self._sight_options(constants))
            difference = respond(*details, seen_at, options)
        around = [self._surrounded(plane, items=items) for plane in _planes(difference, sizes)]
        # Beside one another along the longer side, where the least is left to fill up.
        along = -1 if sizes[-1][0] <= sizes[-1][1] else -2
        gather = compiled(_pooled_difference) if fast else _pooled_difference
        gathered: Tensor = gather(_joined(around, along), *self._pooling(constants))
        starts = itertools.accumulate((plane.shape[along] for plane in around), initial=0)
        local = []
        for start, plane, (rows, columns) in zip(starts, around, sizes, strict=False):
            # What was put around the items is still between them.
            long = rows + (items - 1) * (plane.shape[-1] - columns)
            part = gathered.narrow(along, start, (long, columns)[along])[..., :long, :columns]
            local.append(within(part, rows, items))
        return local

    def _local_difference(
        self,
        first: Cortex,
        second: Cortex,
        number: int,
        level: Level,
        constants: dict[str, Tensor],
    ) -> Tensor:
        """Return the local visual difference (B, 1, h, w) of one level."""
        details, others = first.details[number], second.details[number]
        fast, items = self._fast and details.numel() >= SMALLEST, first.items
        sight, other_sight = (
            sight.pushed(_size(details), items, first.before[number])
            for sight in self._sights(level, constants, (first, second), number, fast)
        )
        orientations = details.shape[2]
        respond = compiled(response_difference) if fast else response_difference
        # One orientation at a time where the planes are large and no orientation masks another:
        # what is computed on the way then stays in the cache. Compiled code keeps nothing.
        at_once = orientations
        apart = not (self.observer.signed and self.effects.masking)
        if apart and not fast and details.numel() > LARGEST_AT_ONCE:
            at_once = self.transform.phases

        options = self._options(constants)

        def gathered(one: Tensor, other: Tensor, sight: Sight, other_sight: Sight) -> Tensor:
            difference = respond(one, other, sight, other_sight, options)
            return self._gathered(difference, constants, fast, items)

        # Where the gradient is known by hand, nothing needs to be kept.
        names = "opponents", "transducer_exponent", "summation_exponent"
        fixed = tuple(constants[name] for name in names)
        known = (
            by_hand()
            and self.observer.signed
            and self.effects.masking
            and self.effects.pooling
            and self.transform.csf == "levels"
            and self.transform.shifts == self.transform.phases == 1
            and not fast
            and items == 1
            and not any(constant.requires_grad for constant in fixed)
        )
        local = []
        # Itself where it is not cut, for compiled code is specialised on views.
        parts, other_parts = (
            (plane,) if at_once == orientations else plane.split(at_once, 2)
            for plane in (details, others)
        )
        planes = zip(parts, other_parts, strict=True)
        for number, (one, other) in enumerate(planes):
            some = slice(number * at_once, (number + 1) * at_once)
            arguments = one, other, sight.of(some), other_sight.of(some)
            if known:
                local.append(local_difference(gathered, *arguments, *fixed))
            else:
                local.append(self._kept(gathered, *arguments))
        return torch.stack(local).sum(0) if len(local) > 1 else local[0]

    def _options(self, constants: dict[str, Tensor]) -> Options:
        overlapping = self.transform.shifts > 1
        return Options(
            constants["opponents"],
            self.observer.signed,
            self.effects.masking,
            # Neighbouring responses with signs would cancel, and of overlapping nodes and of
            # quadrature pairs the energy hardly depends on the phase of a grating.
            self.observer.signed or overlapping,
            self.transform.phases,
        )

    def _gathered(
        self,
        difference: Tensor,
        constants: dict[str, Tensor],
        fast: bool = False,
        items: int = 1,
    ) -> Tensor:
        """Return the local visual difference of `difference_of`, after spatial pooling."""
        gather = compiled(_pooled_difference) if fast else _pooled_difference
        surrounded = self._surrounded(difference, fast, items)
        local: Tensor = gather(surrounded, *self._pooling(constants))
        return within(local, difference.shape[-2], items)

    def _surrounded(self, difference: Tensor, fast: bool = False, items: int = 1) -> Tensor:
        """Return `difference_of` with the neighbours that `_pooled_difference` takes."""
        nodes = self._pooled_nodes
        if self.transform.shifts == 1:
            return surround(difference, items) if nodes > 1 else difference
        rows = compiled(pool_halves) if fast else pool_halves
        pooled: Tensor = rows(surround_halves(difference, nodes), nodes, -1)
        return pooled

    @property
    def _pooled_nodes(self) -> int:
        """How many nodes in a row are pooled."""
        return 3 if self.effects.pooling else 1

    def _pooling(self, constants: dict[str, Tensor]) -> tuple[Options, bool, int, Tensor, Tensor]:
        """Return what `_pooled_difference` takes beside the differences."""
        return (
            self._options(constants),
            self.transform.shifts > 1,
            self._pooled_nodes,
            constants["transducer_exponent"],
            constants["summation_exponent"],
        )

    def _sights(
        self,
        level: Level,
        constants: dict[str, Tensor],
        images: Sequence[Cortex],
        number: int,
        fast: bool = False,
    ) -> list[Sight]:
        """Return the sight of a level, the one of this number, for each image, at its parents."""
        if self.transform.csf == "filter":
            return [_weights_alone(level)] * len(images)
        parents = [cortex.parent_lowpass(number) for cortex in images]
        look = compiled(sights_of) if fast else sights_of
        sights: list[Sight] = look(parents, level, *self._sight_options(constants))
        return sights

    def _sight_options(self, constants: dict[str, Tensor]) -> tuple[dict[str, Tensor], bool, bool]:
        """Return what `sights_of` takes beside parents and level."""
        local = self.observer.adaptation_luminance is None
        # No more than it needs: a compiled function checks every tensor that it is given.
        names = ("dark_cones", *(OF_LUMINANCE if local else ()))
        return {name: constants[name] for name in names}, local, self.effects.chromatic

    def _levels(self, finest: int, count: int, constants: dict[str, Tensor]) -> Levels:
        """Return what ``count`` levels respond to, from the level ``finest``; the coarsest first.

        All levels at once: on small images the operations of a level cost more than its numbers.
        """
        some = slice(finest, finest + count)
        frequency, gain = (constants[name][some].flip(0) for name in ("frequencies", "gains"))
        passed = self._passed(frequency[:, 0], constants)
        bright = self._bright(frequency, gain, constants)
        return Levels(passed, frequency, gain, bright)

    def _passed(self, frequency: Tensor, constants: dict[str, Tensor]) -> Tensor:
        """Return the share (levels, 3) of the cones' details that chromatic aberration leaves."""
        if not self.effects.aberration:
            return torch.ones_like(frequency).unsqueeze(1).expand(-1, 3)
        return attenuation(
            frequency, constants["aberration_cutoff"], constants["aberration_exponent"]
        )

    def _bright(self, frequency: Tensor, gain: Tensor, constants: dict[str, Tensor]) -> Tensor:
        """Return the sensitivity of all channels, or of C1 and C2 where the luminance is local.

        (levels, channels, as many) from (levels, as many); in bright light, over the gain.
        """
        channels = []
        if self.observer.adaptation_luminance is not None:
            luminance, size = constants["adaptation_luminance"], constants["achromatic_size"]
            channels = [constants["achromatic_gain"] * barten(frequency, luminance, size)]
        if self.effects.chromatic:
            channels += [
                butterworth(frequency, *(constants[f"{name}_{part}"] for part in FILTER))
                for name in ("red_green", "yellow_violet")
            ]
        return torch.stack(channels, 1) / gain.unsqueeze(1) if channels else gain.unsqueeze(1)


def _size(plane: Tensor) -> tuple[int, int]:
    return plane.shape[-2], plane.shape[-1]


def _few(cortex: Cortex) -> int:
    """Return how many levels, from the coarsest, are computed at once."""
    return sum(math.prod(_size(detail)) <= FEW_NODES for detail in cortex.details)


def _weights_alone(level: Level) -> Sight:
    """Return the sight of a level of filtered images: of details that are contrasts already."""
    return Sight(None, (1.0 / level.gain)[None, None])


def _in_a_row(planes: Iterable[Tensor]) -> Tensor:
    """Return the nodes of planes (..., h, w) in a row, (..., 1, all of them)."""
    return torch.cat([plane.flatten(-2).unsqueeze(-2) for plane in planes], -1)


def _planes(row: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Tensor]:
    """Return the planes (..., h, w) of nodes in a row, (..., 1, all of them)."""
    parts = row.squeeze(-2).split([math.prod(size) for size in sizes], -1)
    return [part.unflatten(-1, size) for part, size in zip(parts, sizes, strict=True)]


def _joined(planes: Sequence[Tensor], along: int) -> Tensor:
    """Return planes (..., h, w) beside one another in one, along its last or last but one side.

    The other side is that of the longest; shorter ones go on with zeros.
    """
    lengths = [plane.shape[-3 - along] for plane in planes]
    padded = []
    for plane, length in zip(planes, lengths, strict=True):
        rest = max(lengths) - length
        sides = (0, 0, 0, rest) if along == -1 else (0, rest)
        padded.append(functional.pad(plane, sides) if rest else plane)
    return torch.cat(padded, along)


def _light(image: Tensor, encoding: str, limit: Tensor | None, matrix: Tensor) -> Tensor:
    """Return the cone responses (B, 3, H, W) to an image; ``matrix`` is of linear values."""
    return cone_responses(linear_values(image, encoding, limit), matrix)


def _band_sensitivity(lowpass: Tensor, table: Tensor, constants: dict[str, Tensor]) -> Tensor:
    """Return the rows of a table at the local luminance, (B, rows, h, w).

    ``lowpass`` is (B, 3, h, w); ``table`` is at `LUMINANCES`, and between them linear.
    """
    seen = adapted_luminance(lowpass, constants)
    last = len(LUMINANCES) - 1
    place = (torch.log2(seen[:, 0]) - LUMINANCES[0]).clamp(0.0, last)
    low = place.detach().floor().clamp_max(last - 1.0)
    index, rest = low.long(), place - low
    # Selected from columns, and not by an index of any shape, which takes four times as long.
    before, after = (
        table.index_select(1, column.flatten()).unflatten(1, place.shape)
        for column in (index, index + 1)
    )
    return torch.lerp(before, after, rest).transpose(0, 1)


def _band_contrast(
    scale: tuple[Tensor, ...],
    around: Tensor,
    passed: Tensor,
    weights: Tensor,
    at_places: Tensor | None,
    dark_cones: Tensor,
    matrix: Tensor,
) -> Tensor:
    """Return the weighted contrast (B, channels, h, w) of the n bands (B, 3, h, w) of a scale.

    ``around`` (B, 3, h, w) is what the eye is adapted to, ``passed`` (n, 3) what chromatic
    aberration leaves, ``weights`` (channels, n), ``at_places`` (B, n + 1, h, w) what multiplies
    those of A, and of C1 and C2, where they are local.
    """
    adaptation = 1.0 / adapted(around, dark_cones)
    seen: list[Tensor] = []
    for number, band in enumerate(scale):
        contrast = local_contrast(band.unsqueeze(2), adaptation).squeeze(2).unbind(1)
        mixing = matrix * passed[number] * weights[:, number, None]
        channels = [mix_row(row, contrast) for row in mixing]
        if at_places is not None:  # A's by themselves, for they follow the luminance band by band
            channels[0] = channels[0] * at_places[:, number]
        seen = [a + b for a, b in zip(seen, channels, strict=True)] if seen else channels
    if at_places is not None:
        seen[1:] = [colour * at_places[:, -1] for colour in seen[1:]]
    return torch.stack(seen, 1)


def _pooled_difference(
    surrounded: Tensor,
    options: Options,
    overlapping: bool,
    nodes: int,
    masking: Tensor,
    summation: Tensor,
) -> Tensor:
    """Return the local visual difference of `difference_of`, pooled over ``nodes`` nodes.

    Their neighbours are given; those of overlapping nodes are pooled along rows. Printed responses
    are pooled as a difference, for pooling is linear; others come as squares.
    """
    count = 1.0
    if overlapping:
        pooled, count = pool_halves(surrounded, nodes, -2), covering(nodes)
    else:
        pooled = pool(surrounded) if nodes > 1 else surrounded
    if not options.energies:
        return local_visual_difference(pooled, summation)
    # The sums of overlapping nodes are divided where it costs least.
    left: Tensor | float = -math.log2(count)
    if options.signed and options.masking:
        left = unmasked(pooled[:, :, -1:] / count, masking) + left
        pooled = pooled[:, :, :-1]
    return local_visual_difference_of_energy(pooled, summation, left)
