"""What must be simulated in a Mitsuba scene, as far as it can be read from the scene.

Mitsuba's module is passed in: `sampling.renderers.mitsuba` alone imports it.
"""

import re
from typing import Any, NamedTuple

import numpy as np

# Integrators whose depth or kind may be chosen, by the names of their classes.
PATH = "path"
KNOWN = {
    "PathIntegrator": PATH,
    "VolumetricPathIntegrator": "volpath",
    "VolpathMisIntegratorImpl": "volpathmis",
}

# Smallest roughness of a material that does not count as a mirror: light by way of a smoother one
# is hit too rarely. Status: choice.
ROUGH = 0.1


class Needs(NamedTuple):
    """What was read from a scene."""

    integrator: str | None
    """path, volpath or volpathmis; None: another one, a nested one, or one that hides emitters,
    which is left unchanged."""
    max_depth: int | None
    """Most segments of a path; None: no limit."""
    rr_depth: int
    """The depth at which Russian roulette begins."""
    media: bool
    """Whether any surface borders a medium, or the sensor is in one."""
    passes: bool
    """Whether light passes through any surface without bending (null, mask, thin glass)."""
    mirrors: bool
    """Whether any surface is a mirror or clear, or nearly so."""
    scatters: bool
    """Whether any surface scatters light."""
    broad_lights: bool
    """Whether any light can be hit by chance: it has an area, or is the environment."""
    sharp_lights: bool
    """Whether any light is a point or has one direction, and cannot be hit by chance."""
    unread: bool
    """Whether there are instances, whose materials cannot be read."""
    tellable: bool
    """Whether a pilot can tell the bounces apart: the variant is compiled, and computes in RGB."""


def read(mi: Any, scene: Any, sensor: Any, integrator: Any) -> Needs:
    """Read a scene as ``integrator`` would render it from ``sensor``."""
    words = str(integrator)
    depth = re.search(r"max_depth = (\d+)", words)
    gamble = re.search(r"rr_depth = (\d+)", words)
    name = KNOWN.get(integrator.class_name())
    if depth is None or gamble is None or integrator.hide_emitters:
        name = None
    most = int(depth.group(1)) if depth is not None else 0
    shapes = scene.shapes()
    # Each once, because many shapes share a material.
    every = [shape.bsdf() for shape in shapes if shape.bsdf() is not None]
    bsdfs = list({bsdf.ptr: bsdf for bsdf in every}.values())
    flags = [int(bsdf.flags()) for bsdf in bsdfs]
    lights = [int(light.flags()) for light in scene.emitters()]
    null, delta = int(mi.BSDFFlags.Null), int(mi.BSDFFlags.Delta)
    return Needs(
        integrator=name,
        max_depth=most if most < 2**31 else None,
        rr_depth=int(gamble.group(1)) if gamble is not None else 0,
        media=sensor.get_medium() is not None
        or any(
            shape.interior_medium() is not None
            or shape.exterior_medium() is not None
            or shape.is_medium_transition()
            for shape in shapes
        ),
        passes=any(flag & null for flag in flags),
        mirrors=any(
            flag & delta or not _rough(mi, bsdf, flag)
            for bsdf, flag in zip(bsdfs, flags, strict=True)
        ),
        scatters=any(not _black(mi, bsdf) for bsdf in bsdfs),
        broad_lights=any(
            light & int(mi.EmitterFlags.Surface | mi.EmitterFlags.Infinite) for light in lights
        ),
        sharp_lights=any(light & int(mi.EmitterFlags.Delta) for light in lights),
        unread=any(shape.class_name() in ("Instance", "ShapeGroup") for shape in shapes),
        tellable=not mi.variant().startswith("scalar") and mi.variant().endswith("_rgb"),
    )


def _rough(mi: Any, bsdf: Any, flags: int) -> bool:
    """Return whether a material has no glossy part, or one that is known to be rough."""
    if not flags & int(mi.BSDFFlags.Glossy):
        return True
    values = dict(mi.traverse(bsdf))
    # Too little is known of Disney's, whose roughness is another quantity, and of mixtures.
    if any("roughness" in name or "bsdf_" in name for name in values):
        return False
    alphas = [
        value
        for name, value in values.items()
        if re.search(r"(^|\.)alpha(_[uv])?(\.value)?$", name) is not None
    ]
    # Mitsuba's own 0.1 is in single precision.
    return bool(alphas) and all(
        float(np.min(np.asarray(alpha))) >= ROUGH * (1.0 - 1e-6) for alpha in alphas
    )


def _black(mi: Any, bsdf: Any) -> bool:
    """Return whether a material is known to reflect nothing."""
    # In spectral variants these values are not reflectances.
    if bsdf.class_name() != "SmoothDiffuse" or mi.is_spectral:
        return False
    value = dict(mi.traverse(bsdf)).get("reflectance.value")
    return value is not None and not np.asarray(value).any()
