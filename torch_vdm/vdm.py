"""The visual difference metric as a module: its options and its methods."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from torch_vdm.effects import Effects
from torch_vdm.images import SQUARE as WHOLE_SQUARE
from torch_vdm.images import can_be_read, is_queued, masked
from torch_vdm.model.cones import XYZ_TO_SML
from torch_vdm.model.contrast import SML_TO_OPPONENTS
from torch_vdm.model.cortex import DEEPEST, Cortex, Haar, Transform, bands
from torch_vdm.model.display import BT709_TO_XYZ, Display
from torch_vdm.model.distance import accumulate
from torch_vdm.model.grid import Grid
from torch_vdm.model.level import difference_of, gathered
from torch_vdm.model.model import Model
from torch_vdm.model.steps import Steps
from torch_vdm.observer import Observer
from torch_vdm.options import choice
from torch_vdm.pair import Nonfinite, Numbers, PairMetric
from torch_vdm.plan import Plan, everything, is_grey, plan_of
from torch_vdm.precision import computed_in
from torch_vdm.run import kernels, regions, strips, whole
from torch_vdm.run.kernels import mask as kernel_of_mask
from torch_vdm.run.schedule import Schedule
from torch_vdm.run.tiles import Done, Progress, in_tiles
from torch_vdm.run.tiling import TILE, Source, check_sources, read
from torch_vdm.sarnoff import Sarnoff

# The summation exponent with which energies are cubed: the calibrated observer's.
CUBES = 6.0


class VDM(PairMetric):
    """The visual difference metric of Bolin and Meyer 1999 as a module.

    Calling it with a test and a reference image, both (B, 3, H, W), gives the map of their
    visible differences, (B, 1, H, W) in just-noticeable differences: 1 is just noticeable. The
    order of the two makes no difference, and equal images give exactly 0.

    It computes in float64 if an input is float64, otherwise in float32, also under autocast. Its
    constants follow from its options: they move with the module, keep their precision through
    `half()` and the like, and are not part of its state dict.

    Parameters
    ----------
    ppd
        Pixels in one degree of the visual field; see `pixels_per_degree`.
    display
        What the pixel values are; `Display.srgb()` by default.
    observer
        Who looks; `Observer.calibrated()` by default, which takes the numbers that were fitted with
        the transform.
    transform
        How the image is decomposed: `Haar()`, the default, `StationaryHaar()` or `Steerable()`.
    effects
        What is simulated. "auto", the default: everything, except that what a pair does not need is
        not computed, see `plan`. "full": all of it is computed. Or an `Effects`. Or a `Plan`, as
        `plan` gives it for some pairs of a data set: of all pairs is left out what it leaves out of
        grey ones, on every device, with gradients and in compiled code. An image that is not grey
        is then a ValueError, where values may be read.
    nonfinite
        "raise": NaN or infinity in an image is a ValueError that names the batch item (a graph
        of torch.export cannot raise: there it gives NaN). For this, one number is read back from
        the device, on a GPU when all else has been launched there, and one for a mask of
        `VDMLoss`. "mask": such pixels are taken as equal in both images, with the value that one of
        them has, or otherwise that of their surroundings, and the map is 0 there; nothing is read
        back. In both cases the first call reads once more, to warn of values that are not sRGB
        codes where the display expects these.
    schedule
        How it is computed, which changes only the last bits of results; by default chosen for each
        pair, see `scheduled`.

    Raises
    ------
    ValueError
        If a parameter or an image is not as stated.
    """

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        observer: Observer | None = None,
        transform: Transform | None = None,
        effects: Effects | Plan | Literal["auto", "full"] | None = None,
        nonfinite: Nonfinite = "raise",
        schedule: Schedule | None = None,
    ) -> None:
        super().__init__(ppd, display, nonfinite)
        for name, option, kind in (
            ("observer", observer, Observer),
            ("schedule", schedule, Schedule),
        ):
            if not isinstance(option, kind | None):
                raise ValueError(f"expected {name}: {kind.__name__}, got {option!r}")
        if isinstance(transform, type) or not isinstance(transform, Transform | None):
            raise ValueError(
                f"expected transform: Haar(), StationaryHaar() or Steerable(), got {transform!r}"
            )
        self.transform = transform or Haar()
        self.observer = (observer or Observer.calibrated()).fitted_to(self.transform)
        if not isinstance(effects, Effects | Plan | str | None):
            raise ValueError(f'expected effects: "auto", "full", Effects or Plan, got {effects!r}')
        if isinstance(effects, str):
            choice("effects", effects, ("auto", "full"))
        self._planned = effects is None or effects == "auto"
        self._grey = isinstance(effects, Plan) and effects.grey
        if isinstance(effects, Plan):
            effects = Effects.named(effects.effects)
        self.effects = effects if isinstance(effects, Effects) else Effects()
        if schedule is not None and schedule.stacked and not self._stackable:
            raise ValueError(
                f"expected a schedule that is not stacked with {self.transform}, got one that is; "
                "items lie below one another with Haar() alone"
            )
        if schedule is not None and schedule.kernel:
            kernels.require(self.observer, self.transform, self.effects)
        self.schedule = schedule

        peaks = [self.transform.peaks(level) for level in range(DEEPEST)]
        constants: dict[str, Numbers] = {
            "primaries": BT709_TO_XYZ,
            "cones": XYZ_TO_SML,
            "opponents": SML_TO_OPPONENTS if self.effects.chromatic else SML_TO_OPPONENTS[:1],
            "luminance_of_cones": np.linalg.inv(XYZ_TO_SML)[1:2].tolist(),
            "dark_cones": [self.observer.dark_light * sum(row) for row in XYZ_TO_SML],
            "frequencies": [[self.ppd * frequency for frequency, _ in level] for level in peaks],
            # Without level gains the orientations keep their gains relative to one another.
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
            f"transform={self.transform}, "
            f"effects={'auto' if self._planned else self.effects.names()}"
            f"{' of grey images' if self._grey else ''}, "
            f"schedule={self.schedule or 'chosen for each pair'}"
        )

    def model(self, dtype: torch.dtype, steps: Steps | None = None, grey: bool = False) -> Model:
        """Return the model with constants of a precision; see `torch_vdm.model.model`."""
        constants = self._constants(dtype)
        derived = self._derived[dtype] if self._has_own_constants() else None
        return Model(
            self.display,
            self.observer,
            self.transform,
            self.effects,
            constants,
            self._schedule if steps is None else steps,
            grey,
            self.observer.summation_exponent == CUBES and self._is_own("summation_exponent"),
            derived,
        )

    def _place(self, device: torch.device) -> None:
        """Make the constants on a device, and what follows from them."""
        super()._place(device)
        options = self.display, self.observer, self.transform, self.effects
        with torch.no_grad(), torch.inference_mode(False):
            self._derived = {
                dtype: Model(*options, constants).derive()
                for dtype, constants in self._cast.items()
            }

    def plan(self, test: Tensor, reference: Tensor) -> Plan:
        """Return what is computed for a pair, (B, 3, H, W) twice, and what is left out, and why.

        What is left out changes the map by rounding only. Something is left out only on the CPU,
        without gradients or compiled code, and where values may be read; for other cases see the
        parameter ``effects``.
        """
        test, reference, _ = self._checked(test, reference)
        return self._plan(test, reference)

    def _plan(self, test: Tensor, reference: Tensor) -> Plan:
        names = tuple(self.effects.names())
        if self._grey:
            if self._reads(test) and not (is_grey(test) and is_grey(reference)):
                raise ValueError(
                    "expected grey images, as those of the plan that was given, got colours; "
                    'take effects="auto"'
                )
            return replace(everything(names, len(test)), grey=True)
        job = self._job(test, reference)
        reads = self.nonfinite == "raise" and not is_queued(test) and can_be_read(test)
        by_kernel = self.schedule is not None and self.schedule.kernel  # of all there is
        if (
            not self._planned
            or job.gradients
            or job.compiles
            or job.traced
            or by_kernel
            or not reads
        ):
            return everything(names, len(test))
        may = self.observer.charging and self.transform.csf == "levels"
        return plan_of(test, reference, names, may)

    def scheduled(self, test: Tensor, reference: Tensor) -> Schedule:
        """Return how a pair, (B, 3, H, W) twice, is computed; `repr` shows it."""
        return self.schedule or super().scheduled(test, reference)

    @property
    def _schedule(self) -> Schedule:
        """How anything other than a pair of images is computed."""
        compiled = self._compiles and not torch.compiler.is_compiling()
        return self.schedule or Schedule(compiled=compiled)

    def _accumulated(self, test: Tensor, reference: Tensor) -> Tensor:
        plan = self._plan(test, reference)
        schedule = self.scheduled(test, reference)
        model = self.model(test.dtype, schedule, plan.grey)
        if not any(plan.equal) and not any(squares is not None for squares in plan.differing):
            return self._executed(model, schedule, test, reference)
        items = zip(test.split(1), reference.split(1), plan.differing, strict=True)
        return torch.cat(
            [
                # The power of an image against itself is 0 in every pixel.
                model.nothing(one)
                if same
                else self._executed(model, schedule, one, other, some, plan.square)
                for (one, other, some), same in zip(items, plan.equal, strict=True)
            ]
        )

    def _executed(
        self,
        model: Model,
        schedule: Schedule,
        test: Tensor,
        reference: Tensor,
        differing: Tensor | None = None,
        square: int = 1,
    ) -> Tensor:
        if differing is not None:
            return regions.accumulated(model, schedule, test, reference, differing, square)
        if schedule.pieces == "strips" and strips.can_be_cut(test):
            return strips.accumulated(model, schedule, test, reference)
        return whole.accumulated(model, schedule, test, reference)

    def _finite_in_both(self, test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        by_kernel = self.schedule is not None and self.schedule.by_kernel
        found = kernel_of_mask.finite_in_both if by_kernel else super()._finite_in_both
        return found(test, reference)

    @property
    def _stackable(self) -> bool:
        return self.transform == Haar()

    def _to_pixels(self, plane: Tensor, size: tuple[int, int], grid: Grid | None = None) -> Tensor:
        return self.model(plane.dtype).to_pixels(plane, size, grid)

    def score(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the largest value of each item's map, (B,), JND: 1 is just noticeable."""
        largest: Tensor = self(test, reference).amax((1, 2, 3))
        return largest

    def represent(self, image: Tensor, grey: bool = False) -> Cortex:
        """Return the cortex representation of an image: display, cones, transform.

        ``image`` is (B, 3, H, W), as the display expects it; half precision becomes float32. With
        ``grey`` its channels must be equal: one plane, of linear values, then stands for the three
        cones, with a transform that is `Haar()` or another without a filter before it. What is
        computed from it changes by rounding only, and takes less time.
        """
        self._require_image("an image", image)
        if grey and self.transform.csf != "levels":
            raise ValueError(f"expected grey with csf 'levels', got {self.transform.csf!r}")
        image = image.to(torch.promote_types(image.dtype, torch.float32)).contiguous()
        return self.model(image.dtype, grey=grey).represent(image)

    def _model_of(self, cortex: Cortex, steps: Steps | None = None) -> Model:
        """Return the model for a representation, of three cones or of the one plane of a grey."""
        grey = self.transform.csf == "levels" and cortex.mean.shape[1] == 1
        return self.model(cortex.mean.dtype, steps, grey)

    def respond(self, cortex: Cortex) -> tuple[Tensor, ...]:
        """Return the responses of one image, from chromatic aberration to the transducer.

        There is one (B, channels, orientations, h, w) per level, level 0 first; 1 is threshold.
        Those of a signed observer are weighted contrasts: their masking involves the other image.
        """
        return self._model_of(cortex).responses(cortex)

    def lowpass_difference(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the weighted contrast between the means of two images, the lowpass term.

        It is (B, channels, 1, 1), not negative, 1 at threshold; and 0 for an observer that never
        compares them. A uniform change is seen here and nowhere else.
        """
        return self._model_of(first).lowpass_difference(first, second)

    def local_differences(self, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
        """Return the local visual difference of every node (Eq. 5), before the root is taken.

        There is one (B, 1, h, w) per level, level 0 first.
        """
        schedule = self._schedule
        model = self._model_of(first, schedule)
        return whole.local_differences(model, schedule, first, second)

    def compare(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the accumulated differences of two representations, before the root is taken.

        They are (B, 1, h, w), of the finest level. Responses are computed and dropped one level at
        a time, which bounds memory.
        """
        schedule = self._schedule
        return whole.compared(self._model_of(first, schedule), schedule, first, second)

    def beside(self, first: Cortex) -> Callable[[Cortex], Tensor]:
        """Return `compare` with a fixed first representation, whose responses are computed once.

        The eye's adaptation is not computed again for a second one with the windows of the first.
        The first may serve a batch of others, (1, ...) against (B, ...). It nearly halves the time
        when many are compared with one; the last bits differ from `compare`. Coarse differences are
        charged to all pixels below them, which makes no difference to the largest value of the map
        for noise that is everywhere.
        """
        model = self._model_of(first)
        sights = model.adaptation(first)
        responses = model.responses(first, sights)

        def compare(second: Cortex) -> Tensor:
            model = self._model_of(second)
            options = model.options()
            same = first.windows is not None and second.windows is first.windows
            others = model.responses(second, sights if same else None)
            local = tuple(
                gathered(difference_of(own, seen, options), options)
                for own, seen in zip(responses, others, strict=True)
            )
            return accumulate(local, model.root(first, second), before=first.before)

        return compare

    @torch.no_grad()
    def tiled(
        self,
        test: Source,
        reference: Source,
        tile: int = TILE,
        out: Tensor | None = None,
        progress: Progress | None = None,
    ) -> Tensor:
        """Return the map of images that may be larger than memory, the same up to rounding.

        Levels up to the size of a tile are computed tile by tile, coarser ones once, from the
        lowpass pyramid of the whole images, which is read first: so the images are read twice, and
        little more than the map and one tile is in memory. With a filter they are read once more,
        because what is coarser than a tile is filtered first. There are no gradients.

        Parameters
        ----------
        test, reference
            (3, H, W) or (B, 3, H, W): tensors, or sources that are read part by part; see
            `torch_vdm.run.tiling.Source`. Integers of 8 and 16 bits stand for 0 to 1.
        tile
            Pixels a side of a tile, 4 or more; rounded down to a multiple of what its levels need.
        out
            Where the map is written, for example a tensor over a memory-mapped file: (1, H, W) or
            (B, 1, H, W), floating point. By default a new tensor in memory.
        progress
            Called after each step with the number of steps done and the number of all steps.

        Returns
        -------
        Tensor
            ``out``, JND.

        Raises
        ------
        ValueError
            If a parameter or an image is not as stated; ``out`` then holds what was done.
        """
        items, size = check_sources(test, reference)
        shape = (*test.shape[:-3], 1, *size)
        if out is None:
            pixel = slice(0, 1), slice(0, 1)
            double = torch.float64 in {read(source, 0, pixel).dtype for source in (test, reference)}
            out = torch.empty(shape, dtype=torch.float64 if double else torch.float32)
        if tuple(out.shape) != shape or not out.is_floating_point():
            raise ValueError(
                f"expected an out of shape {shape} of floating point, "
                f"got {tuple(out.shape)}, {out.dtype}"
            )
        planes = out.view(items, *size)
        for done, jnd in self._in_tiles(test, reference, tile, progress):
            planes[done.item, done.part[0], done.part[1]] = jnd.to(out)
        return out

    @torch.no_grad()
    def tiled_score(
        self,
        test: Source,
        reference: Source,
        tile: int = TILE,
        progress: Progress | None = None,
    ) -> Tensor:
        """Return the largest value of each item's map, (B,), JND, and keep no map.

        It is that of the whole images up to rounding; arguments as in `tiled`.
        """
        items, _ = check_sources(test, reference)
        largest: list[list[Tensor]] = [[] for _ in range(items)]
        for done, jnd in self._in_tiles(test, reference, tile, progress):
            largest[done.item].append(jnd.amax())
        return torch.stack([torch.stack(of_item).amax() for of_item in largest])

    def _in_tiles(
        self, test: Source, reference: Source, side: int, progress: Progress | None
    ) -> Iterator[tuple[Done, Tensor]]:
        """Yield every tile, and its map (h, w)."""
        check_sources(test, reference)
        corner = slice(0, 1), slice(0, 1)
        dtype = computed_in(*(read(source, 0, corner) for source in (test, reference)))
        schedule = self._schedule
        model = self.model(dtype, schedule)
        square = WHOLE_SQUARE if self.nonfinite == "mask" else 1
        tiles = in_tiles(model, schedule, (test, reference), side, self._checked, square, progress)
        for done in tiles:
            yield done, masked(done.jnd(model), done.seen)[0, 0]
