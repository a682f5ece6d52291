"""Mitsuba as the renderer: single pixels of a scene, sample by sample.

This is the only file that imports mitsuba. Each sample is a ray through a place that is drawn from
the pixel's filter, traced by the scene's own integrator; its random numbers are a function of the
pixel, the number of the sample and the seed. The film and the scene's sampler are not used: samples
are independent, as the statistics assume.
"""

import contextlib
import functools
import hashlib
import importlib
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sampling.renderers import bounces, hemisphere
from sampling.renderers.bounces import BOTH, LIGHTS, MATERIALS
from sampling.renderers.filter import FILTERS, SCENE, PixelFilter
from sampling.renderers.llvm import OLDEST, PACKAGE, VARIABLE, find_llvm
from sampling.renderers.needs import PATH, Needs
from sampling.renderers.needs import read as read_needs
from sampling.renderers.protocol import Samples

# Variants chosen automatically, in the order of preference; and with them the spectral ones.
RGB_VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
VARIANTS = (*RGB_VARIANTS, "cuda_ad_spectral", "llvm_ad_spectral", "scalar_spectral")

# Samples in one call of the compiled variants. Speed is flat from 3e5 on, and each needs 27 bytes.
# Status: choice, measured.
BATCH = 2**20

# Fewest threads of Dr.Jit's pool: with one, loading a bitmap never ends. Status: measured, Mitsuba
# 3.9.1.
FEWEST_THREADS = 2

# The request to the `aov` integrator, in its own syntax, and the names of its channels.
AOVS = "albedo:albedo,normal:sh_normal,depth:depth"
AOV_NAMES = ("albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y", "normal.Z", "depth.Z")

# The channel of the share of rays that hit something; the value for the integrator's own AOVs.
ALPHA, OWN = "A", "own"


# How the names begin of integrators that give a black picture of a scene without lights.
LIT = ("path", "direct", "vol")


class SceneError(ValueError):
    """A scene that cannot be rendered; the message is one line."""


class Bounced(NamedTuple):
    """Samples, and what they would be with shorter paths, and with light found in another way."""

    samples: Samples
    within: NDArray[np.float32]
    """(N, 3), with paths of no more than so many segments."""
    alone: NDArray[np.float32]
    """(N, 3), the same with light found by ``found_by``."""
    excess: dict[str, NDArray[np.float32]]
    """(N,), by `LIGHTS` and `MATERIALS`: estimates of how much larger the second moment of
    ``alone`` is than that of ``within``, summed over R, G, B."""
    rays: NDArray[np.float32]
    """(N,), how many rays were traced, those aimed at lights included."""
    rays_within: dict[str, NDArray[np.float32]]
    """(N,), the same with the shorter paths, by `BOTH`, `LIGHTS` and `MATERIALS`."""


class MitsubaRenderer:
    """A Mitsuba scene, sampled pixel by pixel; see `sampling.renderers.Renderer`.

    Parameters
    ----------
    scene
        An XML file, a dict as `mi.load_dict` takes it, or an `mi.Scene`.
    parameters
        Values for a scene file's own parameters, ``<default name="..."/>``.
    sensor
        Its number, from 0 on, its id, or an `mi.Sensor`.
    seed
        0 to 2^32 - 1; other seeds give independent images.
    aov
        Whether albedo, shading normal and depth are averaged in the same pass; depth is the length
        of the ray, in the scene's units, and 0 where it hits nothing. `OWN`: the integrator's own
        AOVs.
    integrator
        One to render with in place of the scene's own; None: its own.
    filter
        One of `FILTERS`: the film's own, or another of Mitsuba's by name, with its defaults.
    variant
        One of `VARIANTS`, or "auto": that of an `mi.Scene`, for a dict the active one; otherwise a
        GPU if there is one, else compiled code if there is an LLVM, else the interpreted variant,
        with a warning.
    batch
        Samples in one call of the compiled variants; changes memory and speed, but no bit.

    Attributes
    ----------
    name
        The file's name, or "the scene".
    variant, version
        The variant in use, and the version of Mitsuba.
    sensor, sensors
        Number and id of the sensor, and how many the scene has.
    size
        Height and width of the image, in pixels: the film's crop.
    pixel_filter
        The filter; its ``rays`` says how many each sample takes.
    fingerprint
        A hash of the scene's file, of every file that it names, and of the parameters; empty
        for a scene that is not in a file.
    planes
        What is averaged besides the light: alpha where the film has it, then the AOVs.
    aov_sums
        (P + 1, H W), float64: sums of the P ``planes``, and how many samples they are of; None
        without planes. A continued run begins with those of the earlier part.

    Raises
    ------
    SceneError
        If Mitsuba, the variant or something the scene names is missing, or if the scene cannot be
        rendered.
    LLVMError
        If DRJIT_LIBLLVM_PATH names a library that cannot be used.
    ValueError
        If the seed or the filter is not valid.
    """

    def __init__(
        self,
        scene: Any,
        parameters: Mapping[str, str] | None = None,
        *,
        sensor: Any = 0,
        seed: int = 0,
        aov: bool | str = False,
        integrator: Any = None,
        filter: str = SCENE,  # noqa: A002  # what --filter is called
        variant: str = "auto",
        batch: int = BATCH,
    ) -> None:
        if not 0 <= seed < 2**32:
            raise ValueError(f"expected a seed from 0 to {2**32 - 1}, got {seed}")
        if filter not in FILTERS:
            raise ValueError(f"expected a filter among {', '.join(FILTERS)}, got {filter!r}")
        self.seed, self.filter, self._batch = seed, filter, batch
        self.parameters = dict(parameters or {})
        self.name, self.fingerprint = "the scene", ""
        self.sensor: tuple[int | None, str]
        if isinstance(scene, str | os.PathLike):
            self._load_file(Path(scene), variant)
        else:
            self._take(scene, variant)
        self.variant: str = self._mi.variant()
        self.version: str = self._mi.__version__
        self._sensor = self._chosen_sensor(sensor)
        film = self._sensor.film()
        width, height = (int(side) for side in film.crop_size())
        if film.flags() & int(self._mi.FilmFlags.Special):
            raise SceneError(
                f"{self.name}: expected a film of colours, such as hdrfilm, got "
                f"{film.class_name()}, which keeps something else"
            )
        if width * height == 0:
            raise SceneError(
                f"{self.name}: expected a film of at least one pixel, got {width} x {height}"
            )
        if width * height >= 2**31:
            raise SceneError(
                f"{self.name}: expected fewer than 2^31 pixels, got {width} x {height}"
            )
        self.size = height, width
        self._integrator = self._sampling_integrator(integrator)
        if integrator is not None or self.sensor[0] is None:
            self.fingerprint = ""  # not all of it is in the file
        self.pixel_filter = PixelFilter(
            self._mi,
            importlib.import_module("drjit"),
            film,
            film.rfilter() if filter == SCENE else self._mi.load_dict({"type": filter}),
        )
        self._alpha: bool = film.flags() & int(self._mi.FilmFlags.Alpha) != 0
        self.planes = [ALPHA] if self._alpha else []
        self.needs: Needs = read_needs(self._mi, self._scene, self._sensor, self._integrator)
        self._aov = aov
        own = self._integrator.aov_names()
        self.planes += own if aov == OWN else AOV_NAMES if aov else ()
        # Among the integrator's AOVs: where the wanted ones begin, and those about paths.
        self._aov_at = 0 if aov == OWN else len(own)
        self._told = slice(0)
        self._with_aovs(self._integrator)
        self.aov_sums: NDArray[np.float64] | None = (
            np.zeros((len(self.planes) + 1, width * height)) if self.planes else None
        )

    def sample(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> Samples:
        """Draw samples ``first[i]`` to ``first[i] + count[i] - 1`` of each of ``pixels``.

        ``pixels`` must be sorted: neighbours are traced together.
        """
        return self._sampled(pixels, first, count)[0]

    def sample_bounces(
        self,
        pixels: NDArray[np.int64],
        first: NDArray[np.int64],
        count: NDArray[np.int64],
        cut: int | None,
        found_by: str = BOTH,
    ) -> Bounced:
        """Draw the same samples, and what each is with at most ``cut`` path segments.

        It takes the integrators of `Needs`, without media and in compiled RGB variants only. The
        samples are those of ``path``, bit for bit, and the shorter ones those of ``path`` of that
        depth; those by ``found_by`` are what is drawn after `simulate` with the same. See
        `bounces.make`.
        """
        before = self._integrator, self._aov_at
        needs, dr = self.needs, importlib.import_module("drjit")
        self._mi.set_variant(self.variant)
        told = bounces.make(self._mi, dr, needs.max_depth, needs.rr_depth, cut, found_by)
        self._aov_at = len(told.aov_names())
        self._with_aovs(told)
        self._told = slice(self._aov_at - len(told.aov_names()), self._aov_at)
        try:
            samples, beside = self._sampled(pixels, first, count)
        finally:
            self._integrator, self._aov_at = before
            self._told = slice(0)
        *light, of_lights, of_materials, rays, both, lights, materials = beside
        return Bounced(
            samples,
            np.stack(light[:3], -1),
            np.stack(light[3:], -1),
            {LIGHTS: of_lights, MATERIALS: of_materials},
            rays,
            {BOTH: both, LIGHTS: lights, MATERIALS: materials},
        )

    def simulate(self, max_depth: int | None, found_by: str = BOTH) -> None:
        """Render with ``path`` of that depth instead of the scene's own integrator.

        With `LIGHTS` or `MATERIALS` it finds light by these alone.
        """
        mi, needs = self._mi, self.needs
        mi.set_variant(self.variant)
        depth = -1 if max_depth is None else max_depth
        words = {"type": PATH, "max_depth": depth, "rr_depth": needs.rr_depth}
        self._aov_at = 0
        self._with_aovs(
            mi.load_dict(words)
            if found_by == BOTH
            else bounces.alone(
                mi, importlib.import_module("drjit"), max_depth, needs.rr_depth, found_by
            )
        )
        self._named = PATH, max_depth

    def _with_aovs(self, integrator: Any) -> None:
        """Render with an integrator, inside one for the AOVs that were asked for."""
        self._integrator = integrator
        if self._aov and self._aov != OWN:
            self._integrator = self._mi.load_dict(
                {"type": "aov", "aovs": AOVS, "image": integrator}
            )
            self._aov_at = len(self._integrator.aov_names()) - len(AOV_NAMES)

    def _sampled(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> tuple[Samples, list[NDArray[np.float32]]]:
        """Draw samples, and the values about paths besides the AOVs."""
        which = np.repeat(np.asarray(pixels, np.int64), count)
        starts = np.cumsum(count) - count
        number = np.arange(len(which)) - np.repeat(starts - first, count)
        radiance = np.empty((len(which), 3), np.float32)
        beside = [
            np.empty(len(which), np.float32)
            for _ in range(self._told.stop - (self._told.start or 0))
        ]
        self._mi.set_variant(self.variant)  # other code may have set another one
        draw = self._draw_one_by_one if self.variant.startswith("scalar") else self._draw
        at_once = max(self._batch // self.pixel_filter.rays, 1)
        for begin in range(0, len(which), at_once):
            part = slice(begin, begin + at_once)
            try:
                radiance[part], aovs = draw(which[part], number[part])
            except RuntimeError as error:
                raise SceneError(f"{self.name}: {_one_line(error)}") from error
            averaged, told = aovs[: len(self.planes)], aovs[len(self.planes) :]
            for plane, found in zip(beside, told, strict=True):
                plane[part] = found
            if self.aov_sums is not None:
                for sums, summand in zip(self.aov_sums, [*averaged, None], strict=True):
                    sums += np.bincount(which[part], summand, len(sums))
        return Samples(which, radiance), beside

    def _draw(
        self, pixels: NDArray[np.int64], numbers: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
        """Draw samples in one call of compiled code."""
        mi, dr = self._mi, importlib.import_module("drjit")
        drawn, rays = len(pixels), self.pixel_filter.rays
        if drawn == 1:  # a width of one would be recompiled
            pixels, numbers = pixels.repeat(2), numbers.repeat(2)
        ray = dr.arange(mi.UInt32, rays * len(pixels))
        pixel = mi.UInt32(pixels.astype(np.uint32).repeat(rays))
        number = mi.UInt32(numbers.astype(np.uint32).repeat(rays))
        sampler = _pixel_sampler(self.variant)
        sampler.start(pixel, number, dr.opaque(mi.UInt32, self.seed))
        width = self.size[1]
        # Of two rays the second is subtracted.
        radiance, aovs = self._follow(sampler, pixel % width, pixel // width, (ray & 1) == 1)
        dr.eval(radiance, aovs)
        # A plane that is the same for all samples is one number.
        light, *planes = (
            np.broadcast_to(plane.numpy(), (*plane.numpy().shape[:-1], rays * len(pixels)))
            for plane in (radiance, *aovs)
        )
        return (
            light.T.reshape(-1, rays, 3).sum(1)[:drawn],
            [plane.reshape(-1, rays).sum(1)[:drawn] for plane in planes],
        )

    def _draw_one_by_one(
        self, pixels: NDArray[np.int64], numbers: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
        """Draw samples with the interpreted variant.

        It does not render crops: a pixel's random numbers would then depend on the crop and on the
        number of threads.
        """
        mi = self._mi
        sampler = mi.load_dict({"type": "independent"})
        width = self.size[1]
        radiance = np.zeros((len(pixels), 3), np.float32)
        aovs = np.zeros((len(pixels), len(self.planes)))
        for i, (pixel, number) in enumerate(zip(pixels.tolist(), numbers.tolist(), strict=True)):
            high, low = mi.sample_tea_32(pixel, self.seed)
            for negative in (False, True)[: self.pixel_filter.rays]:
                sampler.seed(mi.sample_tea_32((high + number) % 2**32, low)[0], 1)
                light, values = self._follow(sampler, pixel % width, pixel // width, negative)
                radiance[i] += light
                aovs[i] += values
        return radiance, list(aovs.T.astype(np.float32))

    def _follow(self, sampler: Any, x: Any, y: Any, negative: Any) -> tuple[Any, list[Any]]:
        """Return the light along a random ray for each pixel, and its AOVs, both weighted."""
        mi, dr, sensor = self._mi, importlib.import_module("drjit"), self._sensor
        height, width = self.size
        place = self.pixel_filter.place(sampler, x, y, negative)
        position = mi.Point2f(place.x * (1.0 / width), place.y * (1.0 / height))
        lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        time = mi.Float(sensor.shutter_open())
        if sensor.shutter_open_time() > 0.0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0.5)
        ray, weight = sensor.sample_ray_differential(time, wavelength, position, lens)
        light, valid, aovs = self._integrator.sample(
            self._scene, sampler, ray, sensor.get_medium(), True
        )
        light = weight * light
        if mi.is_spectral:
            # By the CIE curves at the ray's wavelengths to XYZ, and on to RGB, as films do.
            light = mi.spectrum_to_srgb(light, ray.wavelengths)
        planes = [mi.Float(dr.select(valid, 1.0, 0.0))] if self._alpha else []
        planes += aovs[self._aov_at :]
        planes = [plane * place.weight for plane in planes]
        lights, moments = len(bounces.LIGHT_AOVS), len(bounces.MOMENT_AOVS)
        for i, plane in enumerate(aovs[self._told]):
            if i < lights:
                planes.append(weight[i % 3] * plane * place.weight)
            elif i < lights + moments:
                planes.append(dr.square(dr.max(weight) * place.weight) * plane)
            else:
                planes.append(plane)
        return light * place.weight, planes

    def _load_file(self, path: Path, variant: str) -> None:
        """Load a scene from its file."""
        self.name = str(path)
        if not path.is_file():
            what = "a folder or a device" if path.exists() else "no such file"
            raise SceneError(f"{path}: expected a scene of Mitsuba (XML), got {what}")
        self._mi = load_mitsuba(variant)
        with _files_of(self._mi, path) as found:
            state = self._parse(path, found)
            self._scene = self._instantiate(path, state)
        self._named = _integrator_names(self._mi, state)

    def _take(self, scene: Any, variant: str) -> None:
        """Load a scene from a dict, or take it as it is."""
        if self.parameters:
            raise SceneError(
                "expected parameters with a scene in a file alone; "
                "put their values into the dict, or set them with mi.traverse"
            )
        loaded = None if isinstance(scene, Mapping) else getattr(scene, "variant_name", None)
        if isinstance(scene, Mapping):
            # Objects in the dict may belong to the active variant.
            mi = sys.modules.get("mitsuba")
            before = mi.variant() if mi is not None else None
            variant = before if variant == "auto" and before is not None else variant
        elif loaded is None or scene.class_name() != "Scene":
            kind = type(scene).__name__ if loaded is None else scene.class_name()
            raise SceneError(f"expected a scene: a path, a dict or an mi.Scene, got {kind}")
        else:
            if variant not in ("auto", loaded()):
                raise SceneError(f"expected the variant of the scene, {loaded()}, got {variant}")
            variant = loaded()
        self._mi = load_mitsuba(variant)
        if loaded is None:
            try:
                scene = self._mi.load_dict(dict(scene))
            except RuntimeError as error:
                raise SceneError(f"{self.name}: {_one_line(error)}") from error
            if not isinstance(scene, self._mi.Scene):
                raise SceneError(
                    f'{self.name}: expected a dict with "type": "scene", got one of a '
                    f"{scene.class_name()}"
                )
        self._scene = scene
        self._named = _innermost(str(scene.integrator()))

    def _chosen_sensor(self, wanted: Any) -> Any:
        """Return the sensor with a number or an id."""
        sensors = self._scene.sensors()
        self.sensors = len(sensors)
        if isinstance(wanted, self._mi.Sensor):
            self.sensor = sensors.index(wanted) if wanted in sensors else None, wanted.id()
            return wanted
        if not sensors:
            raise SceneError(
                f"{self.name}: expected a sensor, got none; add a <sensor> to the scene"
            )
        named = [sensor.id() for sensor in sensors]
        if isinstance(wanted, str) and wanted and wanted in named:
            wanted = named.index(wanted)
        if not isinstance(wanted, int | np.integer) or not 0 <= wanted < len(sensors):
            ids = ", ".join(name for name in named if name)
            raise SceneError(
                f"{self.name}: expected a sensor from 0 to {len(sensors) - 1}"
                f"{f', or {ids}' if ids else ''}, got {wanted!r}"
            )
        self.sensor = int(wanted), named[wanted]
        return sensors[wanted]

    def _parse(self, path: Path, found: Callable[[str], Path]) -> Any:
        """Read the file and what it includes, and hash all of it.

        ``found`` returns the file that is loaded for a name.
        """
        mi, parser = self._mi, self._mi.parser
        for name in ("config", "filename"):
            if name in self.parameters:
                raise SceneError(
                    f"{path}: Mitsuba cannot be given a parameter named {name!r}; "
                    "call it otherwise in the scene"
                )
        config = parser.ParserConfig(self._mi.variant())
        try:
            state = parser.parse_file(config, os.fspath(path), **self.parameters)
            included = list(state.files)
            parser.transform_all(config, state)
        except RuntimeError as error:
            raise SceneError(f"{path}: {_one_line(error)}") from error
        if state.root.type != mi.ObjectType.Scene:
            raise SceneError(f"{path}: expected a <scene> as the outermost element")
        values = [value for node in state.nodes for _, value in node.props.items()]
        named = sorted({str(value) for value in values if isinstance(value, str) and value})
        digest = hashlib.sha256()
        for name, value in sorted(self.parameters.items()):
            digest.update(f"{name}={value}\n".encode())
        for file in (*(Path(str(file)) for file in included), *map(found, named)):
            if _is_file(file):
                with file.open("rb") as content:
                    digest.update(hashlib.file_digest(content, "sha256").digest())
        # Spectra in files have been read already, and the files' names are gone.
        for value in values:
            if hasattr(value, "wavelengths"):
                digest.update(np.array([value.wavelengths, value.values]).tobytes())
        self.fingerprint = digest.hexdigest()
        return state

    def _instantiate(self, path: Path, state: Any) -> Any:
        """Build the scene."""
        parser = self._mi.parser
        try:
            return parser.instantiate(parser.ParserConfig(self._mi.variant()), state)
        except RuntimeError as error:
            raise SceneError(f"{path}: {_one_line(error)}") from error

    def _sampling_integrator(self, other: Any) -> Any:
        """Return the scene's integrator, or another, if it can sample single rays."""
        mi = self._mi
        integrator = other or self._scene.integrator()
        if other is not None:
            self._named = _innermost(str(other))
        if integrator is None:
            raise SceneError(
                f'{self.name}: expected an integrator, got none; add <integrator type="path"/>'
            )
        # Integrators in Python are sampled differently, and their base is not always loaded.
        names = {kind.__name__ for kind in type(integrator).__mro__}
        if not isinstance(integrator, mi.SamplingIntegrator) or "ADIntegrator" in names:
            raise SceneError(
                f"{self.name}: expected an integrator that samples single rays, such as path, "
                f"volpath or direct, got {self._named[0]}"
            )
        name = self._named[0]
        if name == "aov":
            raise SceneError(
                f"{self.name}: expected an integrator inside that of the type aov, got none, "
                'whose picture is black; put <integrator type="path"/> into it'
            )
        dark = not self._scene.emitters() and self._scene.environment() is None
        if dark and name.startswith(LIT):
            raise SceneError(
                f"{self.name}: expected a light, got none, and a picture that is black; "
                "add an <emitter> to the scene"
            )
        return integrator

    def aovs(self) -> dict[str, NDArray[np.float64]]:
        """Return the means of ``planes`` so far, (H, W) each, by name of channel."""
        if self.aov_sums is None:
            return {}
        *sums, count = self.aov_sums
        return {
            name: (plane / np.maximum(count, 1.0)).reshape(self.size)
            for name, plane in zip(self.planes, sums, strict=True)
        }

    def plan(self) -> dict[str, Any]:
        """Return what is simulated and why, for the JSON."""
        return _plan(self._mi, self._scene, self._sensor, self._named) | {
            "sensor": (
                f"number {self.sensor[0]} of {self.sensors}"
                if self.sensor[0] is not None
                else "none of the scene's own"
            )
            + (f", {self.sensor[1]}" if self.sensor[1] else ""),
            "pixel_filter": self.pixel_filter.name,
            "pixel_filter_why": (
                f"{'the film has' if self.filter == SCENE else 'asked for:'} "
                f"{self.pixel_filter.words}; rays are placed by it, "
                f"{self.pixel_filter.rays} a sample"
            ),
        }


def load_mitsuba(variant: str = "auto") -> Any:
    """Import mitsuba with a variant that runs here, and return the module.

    Raises
    ------
    SceneError
        If mitsuba is not installed, or the variant that was asked for cannot run.
    """
    if variant not in ("auto", *VARIANTS):
        like = variant.removesuffix("_polarized").replace("_mono", "_rgb")
        raise SceneError(
            f"expected a variant among {', '.join(VARIANTS)}, got {variant}; those with "
            "polarization, or with luminance alone, are not rendered, so set "
            f"{like if like in VARIANTS else 'one of these'} before the scene is loaded"
        )
    llvm = find_llvm() is not None if variant == "auto" or "llvm" in variant else False
    try:
        mi = importlib.import_module("mitsuba")
        dr = importlib.import_module("drjit")
    except ImportError as error:
        raise SceneError(
            f"expected Mitsuba 3.9, got none ({error}); install it with: "
            "pip install 'torch-vdm[render]'"
        ) from error
    llvm = llvm and bool(dr.has_backend(dr.JitBackend.LLVM))
    if llvm and dr.detail.llvm_version()[0] < OLDEST:
        # Mitsuba was imported before, and Dr.Jit chose for itself, once and for all.
        raise SceneError(
            f"expected LLVM {OLDEST} or newer, got {dr.detail.llvm_version()[0]}, which was loaded "
            f"when mitsuba was imported; call sampling.find_llvm() before that, or set {VARIABLE}"
        )
    usable = {"cuda": bool(dr.has_backend(dr.JitBackend.CUDA)), "llvm": llvm, "scalar": True}
    if variant == "auto":
        variant = next(name for name in RGB_VARIANTS if usable[name.split("_")[0]])
        if variant == "scalar_rgb":
            warnings.warn(
                "neither a GPU nor an LLVM of version 17 or newer was found: rendering with "
                f"scalar_rgb, which is slow; install {PACKAGE}, or set {VARIABLE}",
                stacklevel=2,
            )
    if variant not in mi.variants():
        raise SceneError(
            f"expected a variant that Mitsuba was built with, {', '.join(mi.variants())}, "
            f"got {variant}"
        )
    if not usable[variant.split("_")[0]]:
        need = f"an LLVM; install {PACKAGE}, or set {VARIABLE}" if "llvm" in variant else "a GPU"
        raise SceneError(f"{variant} needs {need}")
    # It is 1 on a machine, or in a container, with a single core.
    if dr.thread_count() < FEWEST_THREADS:
        dr.set_thread_count(FEWEST_THREADS)
    mi.set_variant(variant)
    # Its warnings would break the live line; what matters is reported here.
    mi.set_log_level(mi.LogLevel.Error)
    _register_materials(variant)
    return mi


@contextlib.contextmanager
def preserved() -> Iterator[None]:
    """Restore Mitsuba's variant and log level, and Dr.Jit's threads, afterwards.

    If Mitsuba was not imported before, it keeps a variant, because it cannot be left without one.
    """
    mi, dr = sys.modules.get("mitsuba"), sys.modules.get("drjit")
    found = None
    if mi is not None and dr is not None:
        found = mi.variant(), mi.log_level(), dr.thread_count()
    try:
        yield
    finally:
        mi, dr = sys.modules.get("mitsuba"), sys.modules.get("drjit")
        if mi is not None and dr is not None:
            variant, level, threads = found or (None, mi.LogLevel.Warn, dr.thread_count())
            mi.set_log_level(level)
            if variant is not None:
                mi.set_variant(variant)
            if dr.thread_count() != threads:
                dr.set_thread_count(threads)


@functools.cache
def _register_materials(variant: str) -> None:
    """Register the package's own materials, once with each variant."""
    mi = importlib.import_module("mitsuba")
    assert mi.variant() == variant
    hemisphere.register(mi, importlib.import_module("drjit"))


@functools.cache
def _sampler_class(variant: str) -> Any:
    """Return the class of samplers whose numbers are a function of pixel, sample and seed."""
    mi = importlib.import_module("mitsuba")
    assert mi.variant() == variant

    base: Any = mi.Sampler

    class PixelSampler(base):  # type: ignore[misc]  # its base is known once Mitsuba is loaded
        """Random numbers of sample k of a pixel, whatever else is drawn along with it."""

        def __init__(self) -> None:
            super().__init__(mi.Properties("pixel"))
            self.generator = mi.PCG32()

        def start(self, pixel: Any, number: Any, seed: Any) -> None:
            """Start at the first random number of each sample."""
            high, low = mi.sample_tea_32(pixel, seed)
            first, second = mi.sample_tea_32(high + number, low)
            state = mi.UInt64(first) << 32 | mi.UInt64(second)
            stream = mi.UInt64(high) << 32 | mi.UInt64(low)
            # Not the constructor, which would add the lane's index to both.
            self.generator.seed(state, stream)

        def next_1d(self, active: Any = True) -> Any:
            return self.generator.next_float32(active)

        def next_2d(self, active: Any = True) -> Any:
            first = self.generator.next_float32(active)
            return mi.Point2f(first, self.generator.next_float32(active))

    return PixelSampler


def _pixel_sampler(variant: str) -> Any:
    return _sampler_class(variant)()


@contextlib.contextmanager
def _files_of(mi: Any, path: Path) -> Iterator[Callable[[str], Path]]:
    """Look for a scene's files where Mitsuba does; yield a function from a name to its file.

    The folders are the scene's, that of the file it is a link to, the working directory and
    Mitsuba's own. Those that the scene adds by ``<path>`` are dropped afterwards.
    """
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    for folder in (path.resolve().parent, path.absolute().parent):
        resolver.prepend(os.fspath(folder))
    mi.set_file_resolver(resolver)
    try:
        yield lambda name: Path(str(mi.file_resolver().resolve(name)))
    finally:
        mi.set_file_resolver(before)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a string that cannot be a file name
        return False


def _one_line(error: Exception) -> str:
    """Return an error of Mitsuba without the names of its source files, on one line."""
    text = re.sub(r"\[[\w.]+\.(?:cpp|h):\d+\]\s*", "", str(error))
    return re.sub(r"\s*\n\s*(?:- )?", " ", text).strip()


def _nodes(mi: Any, state: Any, kind: str) -> list[Any]:
    """Return the properties of the scene's elements of one kind."""
    wanted = getattr(mi.ObjectType, kind)
    return [node.props for node in state.nodes if node.type == wanted]


def _integrator_names(mi: Any, state: Any) -> tuple[str, int | None]:
    """Return the plugin of the scene's integrator and its depth, None: no limit.

    Of nested ones (aov, moment) it is the innermost.
    """
    found = _nodes(mi, state, "Integrator")
    if not found:
        return "", None
    inner = [node for node in found if not list(node.references())] or found
    depth = int(inner[-1].get("max_depth", -1))
    return inner[-1].plugin_name(), depth if depth >= 0 else None


def _innermost(words: str) -> tuple[str, int | None]:
    """Return the same of a loaded integrator, from Mitsuba's description of it."""
    names = re.findall(r"(\w+?)(?:Integrator)?\[", words)
    depths = [int(depth) for depth in re.findall(r"max_depth = (\d+)", words)]
    # Without a limit it is the largest number of 32 bits.
    depth = depths[-1] if depths and depths[-1] < 2**31 else None
    return (names[-1].lower() if names else words), depth


def _plan(mi: Any, scene: Any, sensor: Any, integrator: tuple[str, int | None]) -> dict[str, Any]:
    """Return what is simulated and why."""
    name, depth = integrator
    shapes = scene.shapes()
    flags = 0
    for shape in shapes:
        if shape.bsdf() is not None:
            flags |= int(shape.bsdf().flags())
    medium = sensor.get_medium() is not None or any(
        shape.interior_medium() is not None or shape.exterior_medium() is not None
        for shape in shapes
    )
    lights = name not in ("direct", "depth") and (depth is None or depth > 2)
    bounces = "any number of" if depth is None else f"up to {depth}"
    effects = [
        (
            "indirect light",
            lights,
            f"integrator {name}, {bounces} path segments"
            if name != "direct"
            else "integrator direct: light that is reflected once",
        ),
        (
            "depth of field",
            bool(sensor.needs_aperture_sample()),
            "the sensor has a lens"
            if sensor.needs_aperture_sample()
            else "the sensor is a pinhole",
        ),
        (
            "motion blur",
            sensor.shutter_open_time() > 0.0,
            f"the shutter is open for {float(sensor.shutter_open_time()):g} s",
        ),
        (
            "media",
            medium and name.startswith(("vol", "prbvol")),
            f"the scene has {'one' if medium else 'none'}, and the integrator is {name}",
        ),
        (
            "environment",
            scene.environment() is not None,
            f"the scene has {'one' if scene.environment() is not None else 'none'}",
        ),
    ]
    for effect, mask in (
        ("glossy reflection", mi.BSDFFlags.GlossyReflection),
        ("mirror reflection", mi.BSDFFlags.DeltaReflection),
        ("refraction", mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.DeltaTransmission),
    ):
        present = bool(flags & int(mask))
        effects.append((effect, present, f"{'some' if present else 'no'} material of the scene"))
    return {
        "integrator": name,
        "max_depth": depth,
        "effects": [
            {"effect": effect, "simulated": simulated, "why": why}
            for effect, simulated, why in effects
        ],
    }
