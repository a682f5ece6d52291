"""Places drawn from the film's filter, against the image that Mitsuba splats with it."""

import math
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sampling.renderers.filter import NAMES
from sampling.renderers.mitsuba import AOV_NAMES, AOVS, MitsubaRenderer
from torch_vdm import VDM, Display

FILTERS = tuple(NAMES.values())

# A picture that is nowhere even, so that every pixel has noise: at a film's border, too.
BOARD = """
<shape type="rectangle"><transform name="to_world"><scale value="4"/>
  <translate z="-1.5"/></transform><bsdf type="diffuse"><texture type="checkerboard"
  name="reflectance"><transform name="to_uv"><scale x="9" y="9"/></transform></texture></bsdf>
</shape>
<shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="0.6,0.3,0.2"/></bsdf>
</shape>
"""
SCENES = {
    # Light from a patch and from all around, seen through a pinhole.
    "lamp": """
<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="11"/><integer name="height" value="9"/>
    <string name="pixel_format" value="rgb"/><string name="component_format" value="float32"/>
    FILM</film></sensor>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/>
  <translate y="4"/></transform><emitter type="area"><rgb name="radiance" value="9,8,7"/></emitter>
</shape><emitter type="constant"><rgb name="radiance" value="0.2,0.3,0.4"/></emitter>"""
    + BOARD
    + "</scene>",
    # A lens, a shutter and fog.
    "fog": """
<scene version="3.0.0"><integrator type="volpath"><integer name="max_depth" value="4"/></integrator>
<medium type="homogeneous" id="fog"><rgb name="albedo" value="0.8"/>
  <float name="sigma_t" value="0.2"/></medium>
<sensor type="thinlens"><float name="aperture_radius" value="0.2"/>
  <float name="focus_distance" value="4"/><float name="fov" value="40"/>
  <float name="shutter_open" value="0"/><float name="shutter_close" value="1"/>
  <transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="11"/><integer name="height" value="9"/>
    <string name="pixel_format" value="rgb"/><string name="component_format" value="float32"/>
    FILM</film><ref id="fog"/></sensor>
<emitter type="constant"><rgb name="radiance" value="0.4,0.5,0.6"/><ref id="fog"/></emitter>"""
    + BOARD
    + "</scene>",
}
CROP = (
    '<integer name="crop_offset_x" value="3"/><integer name="crop_offset_y" value="2"/>'
    '<integer name="crop_width" value="5"/><integer name="crop_height" value="4"/>'
)
# A window so narrow that every filter is cut off on both sides.
SLIT = CROP.replace('"5"', '"1"')
WIDER = '<boolean name="sample_border" value="true"/>'
FILMS = {"whole": "", "crop": CROP, "slit": SLIT, "border sampled": WIDER, "both": CROP + WIDER}
CASES = [*(("lamp", film) for film in FILMS), ("fog", "whole"), ("fog", "both")]


def scene(folder: Path, name: str, rfilter: str, film: str = "") -> Path:
    """Return a scene whose film has a filter."""
    path = folder / "scene.xml"
    path.write_text(SCENES[name].replace("FILM", f'{film}<rfilter type="{rfilter}"/>'))
    return path


def samples(renderer: MitsubaRenderer, count: int) -> NDArray[np.float64]:
    """Return samples of every pixel, (P, count, 3)."""
    pixels = np.arange(math.prod(renderer.size))
    drawn = renderer.sample(pixels, 0 * pixels, 0 * pixels + count)
    return drawn.radiance.reshape(-1, count, 3).astype(np.float64)


def rendered(
    mitsuba: Any, path: Path, spp: int, images: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean of Mitsuba's own images, (P, C), and the variance of it."""
    mitsuba.set_variant("llvm_ad_rgb")
    film = mitsuba.load_file(str(path))
    drawn = [np.array(mitsuba.render(film, spp=spp, seed=seed)) for seed in range(1, images + 1)]
    every = np.stack(drawn).astype(np.float64).reshape(images, -1, drawn[0].shape[-1])
    return every.mean(0), every.var(0, ddof=1) / images


@pytest.mark.parametrize(("name", "film"), CASES)
@pytest.mark.parametrize("rfilter", FILTERS)
def test_the_mean_is_that_of_mitsubas_own_image(
    mitsuba: Any, tmp_path: Path, rfilter: str, name: str, film: str
) -> None:
    count, spp, images = 2048, 2048, 4
    path = scene(tmp_path, name, rfilter, FILMS[film])
    renderer = MitsubaRenderer(path, seed=3)
    assert renderer.pixel_filter.name == rfilter
    drawn = samples(renderer, count)
    mean, variance = drawn.mean(1), drawn.var(1, ddof=1) / count
    assert (variance > 0.0).all()
    wanted, _ = rendered(mitsuba, path, spp, images)
    # A splatted image has less noise than one of as many samples of its own in each pixel: taken
    # as much, it makes the test of the largest a little easier, by a tenth at most.
    z = (mean - wanted) / np.sqrt(variance * (1.0 + count / (spp * images)))
    # Significance 1e-3 / 7 for the largest of all pixels and channels, and for their mean, whose
    # channels are taken as one for they go together: 1e-3 over the scenes and films of a filter.
    rare = 1e-3 / 7.0
    assert np.abs(z).max() < NormalDist().inv_cdf(1.0 - rare / (2.0 * z.size))
    assert abs(z.mean()) < NormalDist().inv_cdf(1.0 - rare / 2.0) / math.sqrt(z.size / 3.0)


@pytest.mark.parametrize("rfilter", FILTERS)
def test_the_interpreted_variant_draws_from_the_same_filter(
    mitsuba: Any, tmp_path: Path, rfilter: str
) -> None:
    path = scene(tmp_path, "lamp", rfilter, SLIT)
    drawn = samples(MitsubaRenderer(path, seed=3, variant="scalar_rgb"), 512)
    mean, variance = drawn.mean(1), drawn.var(1, ddof=1) / 512
    wanted, _ = rendered(mitsuba, path, 4096, 4)
    z = (mean - wanted) / np.sqrt(variance * (1.0 + 512 / (4 * 4096)))
    assert np.abs(z).max() < NormalDist().inv_cdf(1.0 - 1e-3 / (2.0 * z.size))


@pytest.mark.parametrize("rfilter", ["gaussian", "mitchell", "lanczos"])
def test_the_variance_is_that_of_the_mean_and_pixels_are_independent(
    mitsuba: Any, tmp_path: Path, rfilter: str
) -> None:
    path = scene(tmp_path, "lamp", rfilter)
    wanted, of_it = rendered(mitsuba, path, 8192, 8)
    count, seeds = 64, 24
    runs = [samples(MitsubaRenderer(path, seed=seed), count)[..., 1] for seed in range(seeds)]
    mean = np.stack([run.mean(1) for run in runs])
    variance = np.mean([run.var(1, ddof=1) / count for run in runs], axis=0)
    z = (mean - wanted[:, 1]) / np.sqrt(variance + of_it[:, 1])
    # Chi-square of all pixels and runs; normal for so many. Significance 1e-3.
    limit = NormalDist().inv_cdf(1.0 - 1e-3 / 2.0)
    assert abs((z**2).mean() - 1.0) < limit * math.sqrt(2.0 / z.size)
    # The noise of neighbours is not correlated.
    noise = (z - z.mean(0)).reshape(seeds, 9, 11)
    assert abs((noise[:, :, 1:] * noise[:, :, :-1]).mean()) < limit / math.sqrt(
        noise[:, :, 1:].size
    )
    if rfilter == "gaussian":  # in Mitsuba's own image it is, if the filter is wide and positive
        film = mitsuba.load_file(str(path))
        theirs = np.stack(
            [np.array(mitsuba.render(film, spp=count, seed=seed))[..., 1] for seed in range(seeds)]
        )
        theirs = (theirs - theirs.mean(0)) / theirs.std(0)
        assert (theirs[:, :, 1:] * theirs[:, :, :-1]).mean() > 0.2


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
@pytest.mark.parametrize("rfilter", FILTERS)
def test_where_the_picture_is_even_there_is_no_noise(
    mitsuba: Any, tmp_path: Path, rfilter: str, variant: str
) -> None:
    del mitsuba
    path = tmp_path / "even.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective">'
        '<film type="hdrfilm"><integer name="width" value="5"/><integer name="height" value="3"/>'
        '</film></sensor><emitter type="constant"><rgb name="radiance" value="0.3,0.4,0.5"/>'
        "</emitter></scene>"
    )
    drawn = samples(MitsubaRenderer(path, filter=rfilter, variant=variant), 16)
    assert (drawn.std(1) == 0.0).all()
    np.testing.assert_allclose(drawn, np.broadcast_to([0.3, 0.4, 0.5], drawn.shape), rtol=1e-5)


@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos"])
def test_converged_pictures_look_the_same(mitsuba: Any, tmp_path: Path, rfilter: str) -> None:
    path = scene(tmp_path, "lamp", rfilter)
    renderer = MitsubaRenderer(path)
    height, width = renderer.size
    mean = np.mean([samples(MitsubaRenderer(path, seed=s), 8192).mean(1) for s in range(8)], axis=0)
    wanted, _ = rendered(mitsuba, path, 8192, 8)
    metric = VDM(ppd=60.0, display=Display.linear(white=100.0))
    ours, theirs = (
        torch.tensor(x.T.reshape(1, 3, height, width), dtype=torch.float32) for x in (mean, wanted)
    )
    assert float(metric.score(ours, theirs)) < 0.1
    # That is no blind test: the box filter's picture is another one.
    boxed = samples(MitsubaRenderer(path, filter="box"), 8192).mean(1)
    other = torch.tensor(boxed.T.reshape(1, 3, height, width), dtype=torch.float32)
    assert float(metric.score(other, theirs)) > 0.15


@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos"])
def test_albedo_and_normals_come_from_the_same_places(
    mitsuba: Any, tmp_path: Path, rfilter: str
) -> None:
    path = scene(tmp_path, "lamp", rfilter, CROP)
    guides = []
    for seed in range(16):
        renderer = MitsubaRenderer(path, seed=seed, aov=True)
        samples(renderer, 1024)
        guides.append(np.stack([renderer.aovs()[name].reshape(-1) for name in AOV_NAMES]))
    mitsuba.set_variant("llvm_ad_rgb")
    film = mitsuba.load_file(str(path))
    around = mitsuba.load_dict({"type": "aov", "aovs": AOVS, "image": film.integrator()})
    theirs = [
        np.array(mitsuba.render(film, integrator=around, spp=4096, seed=seed))[..., 3:]
        for seed in range(16)
    ]
    wanted = np.stack(theirs).reshape(16, -1, len(AOV_NAMES)).swapaxes(1, 2).astype(np.float64)
    ours = np.stack(guides)
    spread = np.sqrt((ours.var(0, ddof=1) + wanted.var(0, ddof=1)) / 16.0)
    known = spread > 1e-6
    t = (ours.mean(0) - wanted.mean(0))[known] / spread[known]
    # Student's t of 30 degrees of freedom: 6.7 has a chance of 2e-7, of all of them 1e-4 at most.
    assert known.mean() > 0.7  # the wall's normal is always the same
    assert np.abs(t).max() < 6.7


def test_filters_are_named(mitsuba: Any, tmp_path: Path) -> None:
    del mitsuba
    path = scene(tmp_path, "lamp", "gaussian")
    plan = MitsubaRenderer(path).plan()
    assert plan["pixel_filter"] == "gaussian"
    assert "stddev=0.50" in plan["pixel_filter_why"]
    asked = MitsubaRenderer(path, filter="lanczos").plan()
    assert (asked["pixel_filter"], "2 a sample" in asked["pixel_filter_why"]) == ("lanczos", True)
    with pytest.raises(ValueError, match=r"expected a filter among scene, box, .*, got 'sinc'"):
        MitsubaRenderer(path, filter="sinc")
