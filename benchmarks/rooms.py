"""Random rooms, as scenes of Mitsuba: to train on without any file of data.

A room has a floor and a wall or three, things of several shapes and materials, one to three small
lights that are noisy to find, and sometimes a dim sky. All of it follows from the seed.
"""

import math
from collections.abc import Callable

import numpy as np

# Number of segments of a path: two bounces of indirect light. Status: choice.
DEPTH = 4

# Things in a room, at least and at most. Status: choice.
FEWEST, MOST = 4, 9


def room(seed: int) -> str:
    """Return the XML of the room of a seed; its parameters are ``width`` and ``height``.

    The same text for the same seed and version of NumPy.
    """
    rng = np.random.default_rng((1999, seed))
    things = [_thing(rng) for _ in range(rng.integers(FEWEST, MOST + 1))]
    parts = [_sensor(rng), *_walls(rng), *things, *_lights(rng)]
    body = "\n".join(parts)
    return f"""<scene version="3.0.0">
<default name="width" value="128"/>
<default name="height" value="128"/>
<integrator type="path"><integer name="max_depth" value="{DEPTH}"/></integrator>
{body}
</scene>
"""


def _numbers(*values: float) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _sensor(rng: np.random.Generator) -> str:
    """A camera at eye level that looks at the middle; every fourth has a lens."""
    angle, height = rng.uniform(-0.6, 0.6), rng.uniform(1.0, 3.0)
    distance = rng.uniform(5.0, 7.0)
    origin = _numbers(distance * math.sin(angle), height, distance * math.cos(angle))
    target = _numbers(rng.uniform(-0.4, 0.4), rng.uniform(0.4, 1.0), 0.0)
    lens = rng.random() < 0.25
    kind = "thinlens" if lens else "perspective"
    focus = (
        f'<float name="aperture_radius" value="{rng.uniform(0.03, 0.12):.4g}"/>'
        f'<float name="focus_distance" value="{distance:.4g}"/>'
        if lens
        else ""
    )
    return f"""<sensor type="{kind}"><float name="fov" value="{rng.uniform(28, 50):.4g}"/>{focus}
<transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="$width"/><integer name="height" value="$height"/>
<rfilter type="box"/></film></sensor>"""


def _colour(rng: np.random.Generator) -> str:
    """A reflectance: from nearly black to nearly white, most of them muted."""
    grey = rng.uniform(0.05, 0.8)
    return _numbers(*np.clip(grey * (1.0 + rng.normal(0.0, 0.35, 3)), 0.02, 0.9))


def _reflectance(rng: np.random.Generator, name: str) -> str:
    """A colour, or a chequered pattern of two, fine or coarse."""
    if rng.random() < 0.55:
        return f'<rgb name="{name}" value="{_colour(rng)}"/>'
    across, down = np.exp(rng.uniform(math.log(2.0), math.log(40.0), 2))
    return (
        f'<texture type="checkerboard" name="{name}"><rgb name="color0" value="{_colour(rng)}"/>'
        f'<rgb name="color1" value="{_colour(rng)}"/><transform name="to_uv">'
        f'<scale x="{across:.4g}" y="{down:.4g}"/></transform></texture>'
    )


def _matt(rng: np.random.Generator) -> str:
    return (
        '<bsdf type="twosided"><bsdf type="diffuse">'
        f"{_reflectance(rng, 'reflectance')}</bsdf></bsdf>"
    )


def _glossy(rng: np.random.Generator) -> str:
    return (
        '<bsdf type="twosided"><bsdf type="roughplastic">'
        f"{_reflectance(rng, 'diffuse_reflectance')}"
        f'<float name="alpha" value="{rng.uniform(0.05, 0.3):.4g}"/></bsdf></bsdf>'
    )


def _metal(rng: np.random.Generator) -> str:
    metal = rng.choice(["Au", "Cu", "Ag", "Al"])
    return (
        f'<bsdf type="twosided"><bsdf type="roughconductor"><string name="material" '
        f'value="{metal}"/><float name="alpha" value="{rng.uniform(0.05, 0.4):.4g}"/></bsdf></bsdf>'
    )


def _glass(rng: np.random.Generator) -> str:
    index = rng.uniform(1.3, 1.7)
    return f'<bsdf type="dielectric"><float name="int_ior" value="{index:.4g}"/></bsdf>'


def _walls(rng: np.random.Generator) -> list[str]:
    """A floor, a wall behind, and now and then one at each side."""
    wall = (_matt, _glossy)
    places = [
        '<rotate x="1" angle="-90"/>',
        f'<translate y="5" z="{-rng.uniform(2, 4):.4g}"/>',
    ]
    if rng.random() < 0.5:
        aside = rng.uniform(3.0, 5.0)
        places += [
            f'<rotate y="1" angle="90"/><translate x="{-aside:.4g}" y="5"/>',
            f'<rotate y="1" angle="-90"/><translate x="{aside:.4g}" y="5"/>',
        ]
    return [
        '<shape type="rectangle"><transform name="to_world"><scale x="10" y="10"/>'
        f"{place}</transform>{wall[int(rng.random() < 0.2)](rng)}</shape>"
        for place in places
    ]


def _thing(rng: np.random.Generator) -> str:
    """A sphere, a box, a pillar or a leaning plate that stands on the floor."""
    materials: tuple[Callable[[np.random.Generator], str], ...] = (_matt, _glossy, _metal, _glass)
    material = materials[int(rng.choice(4, p=(0.55, 0.2, 0.15, 0.1)))](rng)
    x, z, size = rng.uniform(-2.2, 2.2), rng.uniform(-1.6, 1.8), rng.uniform(0.15, 0.7)
    match rng.integers(4):
        case 0:
            shape = f'<shape type="sphere"><point name="center" value="{_numbers(x, size, z)}"/>'
            return f'{shape}<float name="radius" value="{size:.4g}"/>{material}</shape>'
        case 1:
            tall, turn = size * rng.uniform(0.5, 2.0), rng.uniform(0.0, 90.0)
            place = (
                f'<scale value="{_numbers(size, tall, size)}"/><rotate y="1" angle="{turn:.4g}"/>'
            )
            move = f'<translate value="{_numbers(x, tall, z)}"/>'
            kind = "cube"
        case 2:
            top = rng.uniform(0.5, 2.5)
            return (
                f'<shape type="cylinder"><point name="p0" value="{_numbers(x, 0.0, z)}"/>'
                f'<point name="p1" value="{_numbers(x, top, z)}"/>'
                f'<float name="radius" value="{0.5 * size:.4g}"/>{material}</shape>'
            )
        case _:
            lean, turn = rng.uniform(-30.0, 0.0), rng.uniform(-50.0, 50.0)
            place = (
                f'<scale x="{size:.4g}" y="{1.3 * size:.4g}"/><rotate x="1" angle="{lean:.4g}"/>'
                f'<rotate y="1" angle="{turn:.4g}"/>'
            )
            move = f'<translate value="{_numbers(x, 1.2 * size, z)}"/>'
            kind = "rectangle"
    return (
        f'<shape type="{kind}"><transform name="to_world">{place}{move}</transform>'
        f"{material}</shape>"
    )


def _lights(rng: np.random.Generator) -> list[str]:
    """One to three globes over or beside the things, and a dim sky over every other room."""
    lights = []
    for _ in range(rng.integers(1, 4)):
        centre = rng.uniform((-3.0, 2.5, -1.0), (3.0, 5.0, 4.0))
        radius = rng.uniform(0.08, 0.6)
        # The smaller, the brighter: about as much light from each.
        radiance = rng.uniform(5.0, 20.0) / radius**2 * (1.0 + rng.uniform(-0.25, 0.25, 3))
        lights.append(
            f'<shape type="sphere"><point name="center" value="{_numbers(*centre)}"/>'
            f'<float name="radius" value="{radius:.4g}"/><emitter type="area">'
            f'<rgb name="radiance" value="{_numbers(*radiance)}"/></emitter></shape>'
        )
    if rng.random() < 0.5:
        sky = rng.uniform(0.02, 0.4) * (1.0 + rng.uniform(-0.3, 0.3, 3))
        lights.append(
            f'<emitter type="constant"><rgb name="radiance" value="{_numbers(*sky)}"/></emitter>'
        )
    return lights
