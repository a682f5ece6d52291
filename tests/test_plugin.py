"""The integrator ``vdm``: `mi.render` itself stops when nobody can see what is missing."""

import math
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

import sampling
from sampling.renderers.llvm import LLVMError
from sampling.renderers.mitsuba import SceneError, load_mitsuba

TOLERANCE = 2.0


@pytest.fixture(params=["llvm_ad_spectral", "scalar_rgb", "llvm_ad_rgb"])
def mitsuba(request: pytest.FixtureRequest) -> Any:
    """Return Mitsuba with the integrator, of a variant."""
    try:
        mitsuba = load_mitsuba(request.param)
    except (SceneError, LLVMError) as error:
        pytest.skip(str(error))
    sampling.register_integrator()
    return mitsuba


def scene(mitsuba: Any, inner: dict[str, Any] | None = None, **film: Any) -> Any:
    """Return a Cornell box with a second sensor, rendered by the integrator."""
    box = mitsuba.cornell_box()
    box["sensor"]["film"] |= {"width": 8, "height": 6} | film
    box["other"] = box["sensor"] | {"film": box["sensor"]["film"] | {"width": 5}}
    inner = inner or {"type": "path", "max_depth": 3}
    box["integrator"] = {"type": "vdm", "tolerance": TOLERANCE, "inner": inner}
    return mitsuba.load_dict(box)


@pytest.mark.parametrize("rfilter", ["gaussian", "lanczos"])
def test_it_is_what_render_gives(mitsuba: Any, rfilter: str) -> None:
    box = scene(mitsuba, rfilter={"type": rfilter})
    options: dict[str, Any] = {"max_spp": 24} if mitsuba.variant() == "scalar_rgb" else {}
    spp = options.get("max_spp", 0)
    for sensor in (0, 1):
        image = np.array(mitsuba.render(box, sensor=sensor, seed=5, spp=spp))
        wanted = sampling.render(box, TOLERANCE, sensor=sensor, seed=5, **options)
        np.testing.assert_array_equal(image, wanted.image.astype(np.float32))
        result = box.integrator().result
        assert result.stop_reason == wanted.stop_reason
        assert result.converged == (wanted.stop_reason == "tolerance")
        np.testing.assert_array_equal(result.samples, wanted.samples)
    assert (image != np.array(mitsuba.render(box, sensor=1, seed=6, spp=spp))).any()


def test_the_picture_stays_in_the_film_without_develop(mitsuba: Any) -> None:
    box = scene(mitsuba)
    sensor = box.sensors()[1]
    image = np.array(mitsuba.render(box, sensor=sensor, seed=1, spp=4))
    assert image.shape == (6, 5, 3)
    assert (box.integrator().result.samples == 4).all()
    sensor.film().clear()
    nothing = box.integrator().render(box, sensor, seed=1, spp=4, develop=False)
    assert math.prod(nothing.shape) == 0
    np.testing.assert_array_equal(np.array(sensor.film().develop()), image)
    np.testing.assert_array_equal(np.array(box.integrator().render(box, 1, 1, 4)), image)


def test_another_integrator_s_scene_can_be_rendered_with_it(mitsuba: Any) -> None:
    box = mitsuba.cornell_box()
    box["sensor"]["film"] |= {"width": 8, "height": 6}
    plain = mitsuba.load_dict(box)
    integrator = mitsuba.load_dict({"type": "vdm", "inner": {"type": "direct"}})
    image = np.array(mitsuba.render(plain, integrator=integrator, spp=8))
    wanted = sampling.render(plain, integrator=integrator.nested, max_spp=8)
    np.testing.assert_array_equal(image, wanted.image.astype(np.float32))
    assert wanted.figures["plan"]["integrator"] == "direct"


def test_alpha_and_aovs_are_mitsubas_own(mitsuba: Any) -> None:
    inner = {"type": "aov", "aovs": "depth:depth,n:sh_normal", "inner": {"type": "direct"}}
    # Only half of the picture is covered, and a crop of it is taken.
    ball = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 30,
            "to_world": mitsuba.ScalarTransform4f().look_at([0, 0, 5], [0.5, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": 10,
                "height": 8,
                "crop_offset_x": 2,
                "crop_offset_y": 1,
                "crop_width": 6,
                "crop_height": 5,
                "pixel_format": "rgba",
                "rfilter": {"type": "mitchell"},
            },
        },
        "ball": {"type": "sphere"},
        "lamp": {"type": "point", "position": [1, 3, 5], "intensity": 30.0},
        # So little that all samples are drawn.
        "integrator": {"type": "vdm", "tolerance": 1e-4, "inner": inner},
    }
    loaded = mitsuba.load_dict(ball)
    runs, count = 8, 64 if mitsuba.variant() == "scalar_rgb" else 1024
    ours = np.stack([np.array(mitsuba.render(loaded, seed=s, spp=count)) for s in range(runs)])
    nested, film = loaded.integrator().nested, loaded.sensors()[0].film()
    pictures = []
    for seed in range(runs):
        mitsuba.render(loaded, integrator=nested, seed=seed, spp=256)
        pictures.append(np.array(film.develop()))  # with what the AOVs' integrator leaves out
    theirs = np.stack(pictures)
    assert ours.shape == theirs.shape
    assert ours.shape[-1] == 4 + len(loaded.integrator().aov_names())
    spread = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / runs)
    known = spread > 1e-5
    # Welch's t has at least 7 degrees of freedom: for the chance of a normal z below 1e-3 over all
    # pixels and channels (4 standard deviations) t has to be under 9.2 or so.
    z = (ours.mean(0) - theirs.mean(0))[known] / spread[known]
    assert NormalDist().inv_cdf(1.0 - 1e-3 / (2.0 * z.size)) < 9.2
    assert np.abs(z).max() < 9.2
    np.testing.assert_allclose(ours.mean(0)[~known], theirs.mean(0)[~known], atol=1e-4)


def test_what_is_inside_it_is_one_integrator(mitsuba: Any) -> None:
    with pytest.raises(RuntimeError, match="expected one integrator inside vdm"):
        mitsuba.load_dict({"type": "vdm"})


def test_it_needs_a_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sampling.plugin.sys.modules", {})
    with pytest.raises(SceneError, match="expected Mitsuba with a variant"):
        sampling.register_integrator()
