"""The renderer on Mitsuba: its numbers against themselves and against Mitsuba's own image."""

import itertools
import math
import os
import re
import subprocess
import sys
from importlib.resources import as_file, files
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.places import ROOT
from sampling.renderers import Samples, llvm
from sampling.renderers.llvm import LLVMError, find_llvm
from sampling.renderers.mitsuba import MitsubaRenderer, SceneError, load_mitsuba

# A lens, a shutter, fog and a window cut out of the picture, in one scene.
FOG = """
<scene version="3.0.0">
  <default name="albedo" value="0.8"/>
  <integrator type="volpath"><integer name="max_depth" value="4"/></integrator>
  <medium type="homogeneous" id="fog"><rgb name="albedo" value="$albedo"/>
    <float name="sigma_t" value="0.2"/></medium>
  <sensor type="thinlens"><float name="aperture_radius" value="0.2"/>
    <float name="focus_distance" value="4"/><float name="fov" value="40"/>
    <float name="shutter_open" value="0"/><float name="shutter_close" value="1"/>
    <transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="20"/><integer name="height" value="16"/>
      <integer name="crop_offset_x" value="5"/><integer name="crop_offset_y" value="3"/>
      <integer name="crop_width" value="12"/><integer name="crop_height" value="9"/>
      <string name="component_format" value="float32"/><rfilter type="box"/></film>
    <ref id="fog"/>
  </sensor>
  <emitter type="constant"><rgb name="radiance" value="0.4,0.5,0.6"/><ref id="fog"/></emitter>
  <shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="0.6,0.3,0.2"/></bsdf>
    <ref name="exterior" id="fog"/></shape>
</scene>
"""

# Spectra that no three numbers stand for, one of a file of Mitsuba's, and a material of our own.
SPECTRA = """
<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="4"/></integrator>
  <sensor type="perspective"><float name="fov" value="35"/>
    <transform name="to_world"><lookat origin="0,1,5" target="0,0.3,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="9"/>
      <string name="component_format" value="float32"/><rfilter type="box"/></film>
  </sensor>
  <emitter type="constant"><spectrum name="radiance" type="blackbody">
    <float name="temperature" value="3000"/></spectrum></emitter>
  <shape type="sphere"><bsdf type="dielectric"><string name="int_ior" value="bk7"/></bsdf></shape>
  <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/>
      <scale value="4"/><translate y="-1"/></transform><bsdf type="diffuse">
    <spectrum name="reflectance" value="400:0.1, 500:0.9, 550:0.2, 700:0.8"/></bsdf></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.4"/>
      <translate x="1.3" y="-0.5"/></transform>
    <bsdf type="hemisphere"><rgb name="reflectance" value="0.8,0.3,0.1"/></bsdf></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.4"/>
      <translate x="-1.3" y="-0.5"/></transform>
    <bsdf type="roughconductor"><string name="material" value="Au"/></bsdf></shape>
</scene>
"""

SENSOR = """
<integrator type="path"/><sensor type="perspective">
  <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
</sensor>
"""


@pytest.fixture(scope="module")
def still_life(mitsuba: Any) -> Path:  # noqa: ARG001  # skips
    """Return the scene that ships with the package."""
    with as_file(files("sampling") / "scenes" / "still_life.xml") as path:
        return path


@pytest.fixture(params=["still life", "fog"])
def scene(
    request: pytest.FixtureRequest, still_life: Path, tmp_path: Path
) -> tuple[Path, dict[str, str]]:
    """Return a scene and its parameters."""
    if request.param == "still life":
        return still_life, {"width": "18", "height": "12"}
    path = tmp_path / "fog.xml"
    path.write_text(FOG)
    return path, {"albedo": "0.9"}


def draw(renderer: MitsubaRenderer, count: int, first: int = 0) -> Samples:
    """Return samples of every pixel."""
    pixels = np.arange(math.prod(renderer.size))
    return renderer.sample(pixels, np.full_like(pixels, first), np.full_like(pixels, count))


def moments(samples: Samples, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each pixel's mean, (P, 3), and the variance of it."""
    radiance = samples.radiance.reshape(-1, count, 3).astype(np.float64)
    return radiance.mean(1), radiance.var(1, ddof=1) / count


@pytest.mark.parametrize(
    ("variant", "rfilter"),
    [
        *itertools.product(("llvm_ad_rgb", "scalar_rgb"), ("box", "gaussian", "lanczos")),
        ("llvm_ad_spectral", "box"),
    ],
)
def test_sample_k_of_a_pixel_is_the_same_number_however_it_is_drawn(
    scene: tuple[Path, dict[str, str]], variant: str, rfilter: str
) -> None:
    path, parameters = scene
    options: dict[str, Any] = {"seed": 5, "variant": variant, "filter": rfilter}
    whole = MitsubaRenderer(path, parameters, **options)
    samples = draw(whole, 7)
    wanted = samples.radiance.reshape(-1, 7, 3)
    np.testing.assert_array_equal(samples.pixels, np.repeat(np.arange(len(wanted)), 7))
    # In small batches, which cut pixels anywhere, and along with albedo and normals.
    parts = MitsubaRenderer(path, parameters, batch=11, aov=True, **options)
    np.testing.assert_array_equal(draw(parts, 7).radiance, samples.radiance)
    # In rounds, the later one first.
    late, early = draw(whole, 3, first=4), draw(whole, 4)
    np.testing.assert_array_equal(early.radiance.reshape(-1, 4, 3), wanted[:, :4])
    np.testing.assert_array_equal(late.radiance.reshape(-1, 3, 3), wanted[:, 4:])
    # Few pixels, from different numbers on; one sample alone; none.
    pixels, first, count = np.array([3, 50, 51]), np.array([6, 0, 2]), np.array([1, 3, 2])
    some = whole.sample(pixels, first, count)
    np.testing.assert_array_equal(
        some.radiance, np.concatenate([wanted[3, 6:], wanted[50, :3], wanted[51, 2:4]])
    )
    one = whole.sample(np.array([60]), np.array([2]), np.array([1]))
    np.testing.assert_array_equal(one.radiance, wanted[60, 2:3])
    assert whole.sample(pixels[:0], first[:0], count[:0]).radiance.shape == (0, 3)


def test_another_process_without_llvm_draws_the_same(still_life: Path, tmp_path: Path) -> None:
    parameters = {"width": "6", "height": "4"}
    code = f"""if True:
        import numpy as np
        from sampling.renderers.mitsuba import MitsubaRenderer
        renderer = MitsubaRenderer({str(still_life)!r}, {parameters}, variant="scalar_rgb")
        pixels = np.arange(24)
        samples = renderer.sample(pixels, 0 * pixels, 0 * pixels + 5)
        np.save({str(tmp_path / "radiance.npy")!r}, samples.radiance)
    """
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    here = draw(MitsubaRenderer(still_life, parameters, variant="scalar_rgb"), 5)
    np.testing.assert_array_equal(np.load(tmp_path / "radiance.npy"), here.radiance)


@pytest.mark.usefixtures("mitsuba")
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
def test_on_a_single_core_the_pool_has_a_thread_to_spare() -> None:
    """With one thread Dr.Jit waits for ever where a scene names a bitmap."""
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from sampling.renderers.mitsuba import load_mitsuba\n"
        "load_mitsuba('llvm_ad_rgb')\n"
        "import drjit; print(drjit.thread_count())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) >= 2


def test_seeds_pixels_and_samples_have_numbers_of_their_own(still_life: Path) -> None:
    parameters = {"width": "18", "height": "12"}
    drawn = [draw(MitsubaRenderer(still_life, parameters, seed=s), 64).radiance for s in (0, 1)]
    both = np.concatenate(drawn)
    lit = both[both.any(1)]
    assert len(np.unique(lit, axis=0)) > 0.999 * len(lit)
    # Neighbouring sample numbers and seeds are not correlated: r is about normal with a standard
    # deviation of n^-1/2; significance 1e-4.
    residual = [x.reshape(-1, 64, 3)[..., 1] for x in drawn]
    residual = [(x - x.mean(1, keepdims=True)) / (x.std(1, keepdims=True) + 1e-9) for x in residual]
    limit = NormalDist().inv_cdf(1.0 - 1e-4 / 2.0) / math.sqrt(residual[0].size)
    assert abs((residual[0] * residual[1]).mean()) < limit
    assert abs((residual[0][:, 1:] * residual[0][:, :-1]).mean() + 1.0 / 64.0) < limit


SPECTRAL = [("llvm_ad_spectral", 2048), ("scalar_spectral", 128)]


@pytest.mark.parametrize(
    ("variant", "count"), [("llvm_ad_rgb", 2048), ("scalar_rgb", 128), *SPECTRAL]
)
def test_the_mean_is_that_of_mitsubas_own_image(
    mitsuba: Any, scene: tuple[Path, dict[str, str]], variant: str, count: int
) -> None:
    assert_the_mean_is_mitsubas(mitsuba, *scene, variant, count)


@pytest.mark.parametrize(("variant", "count"), SPECTRAL)
def test_wavelengths_become_mitsubas_colours(
    mitsuba: Any, tmp_path: Path, variant: str, count: int
) -> None:
    path = tmp_path / "spectra.xml"
    path.write_text(SPECTRA)
    assert_the_mean_is_mitsubas(mitsuba, path, {}, variant, count)


def assert_the_mean_is_mitsubas(
    mitsuba: Any, path: Path, parameters: dict[str, str], variant: str, count: int
) -> None:
    """Assert that ``count`` samples of a pixel have the mean of `mi.render`."""
    renderer = MitsubaRenderer(path, parameters, variant=variant)
    assert renderer.variant == variant
    mean, variance = moments(draw(renderer, count), count)
    mitsuba.set_variant(variant.replace("scalar", "llvm_ad"))
    spp = 2048
    film = mitsuba.load_file(str(path), **parameters)
    image = np.array(mitsuba.render(film, spp=spp, seed=1))[..., :3].reshape(-1, 3)
    known = variance > 0.0
    z = (mean - image)[known] / np.sqrt(variance[known] * (1.0 + count / spp))
    assert known.mean() > 0.9
    # Significance 1e-3 for the largest of all pixels and channels and 1e-3 for their mean, whose
    # channels are taken as one for they go together.
    largest = NormalDist().inv_cdf(1.0 - 1e-3 / (2.0 * z.size))
    assert np.abs(z).max() < largest
    assert abs(z.mean()) < NormalDist().inv_cdf(1.0 - 1e-3 / 2.0) / math.sqrt(z.size / 3.0)


def test_albedo_normals_and_depth_come_along(still_life: Path) -> None:
    renderer = MitsubaRenderer(still_life, {"width": "18", "height": "12"}, aov=True)
    draw(renderer, 4)
    draw(renderer, 5, first=4)
    aovs = renderer.aovs()
    wall = tuple(aovs[f"albedo.{name}"][0, 0] for name in "RGB")
    assert wall == pytest.approx((0.46, 0.50, 0.52), abs=1e-6)
    normal = tuple(aovs[f"normal.{name}"][0, 0] for name in "XYZ")
    assert normal == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)
    # The wall is 8.8 from the eye, at z = -2.2; rays to the corner are longer.
    assert 8.8 < aovs["depth.Z"][0, 0] < 1.2 * 8.8


@pytest.mark.parametrize("rfilter", ["box", "mitchell"])
def test_a_sensor_of_one_ray(mitsuba: Any, rfilter: str) -> None:
    mitsuba.set_variant("llvm_ad_rgb")
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "sensor": {
                "type": "radiancemeter",
                "to_world": mitsuba.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": rfilter}},
            },
            "light": {
                "type": "sphere",
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
            },
        }
    )
    renderer = MitsubaRenderer(scene, aov=True)
    samples = draw(renderer, 6)
    np.testing.assert_allclose(samples.radiance, np.tile([[1.0, 2.0, 3.0]], (6, 1)), rtol=1e-6)
    aovs = renderer.aovs()
    assert aovs["depth.Z"].item() == pytest.approx(2.0, rel=1e-3)
    assert aovs["normal.Z"].item() == pytest.approx(1.0, rel=1e-3)


def test_radiance_that_is_not_finite_is_handed_on(mitsuba: Any, tmp_path: Path) -> None:
    del mitsuba
    path = tmp_path / "nan.xml"
    path.write_text(
        f'<scene version="3.0.0">{SENSOR}<emitter type="constant"/><shape type="sphere">'
        '<bsdf type="diffuse"><rgb name="reflectance" value="nan,1,1"/></bsdf></shape></scene>'
    )
    for variant in ("llvm_ad_rgb", "scalar_rgb"):
        bad = ~np.isfinite(draw(MitsubaRenderer(path, variant=variant), 4).radiance).all(1)
        assert 0 < bad.sum() < bad.size


def test_the_plan_reads_the_scene(scene: tuple[Path, dict[str, str]]) -> None:
    plan = MitsubaRenderer(*scene).plan()
    simulated = {each["effect"] for each in plan["effects"] if each["simulated"]}
    if "albedo" in scene[1]:
        assert (plan["integrator"], plan["max_depth"]) == ("volpath", 4)
        expected = {"indirect light", "depth of field", "motion blur", "media", "environment"}
    else:
        assert (plan["integrator"], plan["max_depth"]) == ("path", 4)
        expected = {"indirect light", "glossy reflection"}
    assert simulated == expected


def test_the_fingerprint_is_of_everything_that_is_named(mitsuba: Any, tmp_path: Path) -> None:
    del mitsuba
    mesh, scene = tmp_path / "one.obj", tmp_path / "scene.xml"
    included = tmp_path / "part.xml"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    included.write_text(f'<scene version="3.0.0">{SENSOR}</scene>')
    scene.write_text(
        '<scene version="3.0.0"><default name="x" value="1"/><include filename="part.xml"/>'
        '<shape type="obj"><string name="filename" value="one.obj"/></shape>'
        '<emitter type="constant"><float name="scale" value="$x"/></emitter></scene>'
    )
    seen = [MitsubaRenderer(scene).fingerprint, MitsubaRenderer(scene).fingerprint]
    assert seen[0] == seen[1]
    seen = [seen[0], MitsubaRenderer(scene, {"x": "2"}).fingerprint]
    for file in (mesh, included, scene):
        file.write_text(file.read_text() + "\n")
        seen.append(MitsubaRenderer(scene).fingerprint)
    assert len(set(seen)) == 5


def triangle(size: int) -> str:
    """Return a mesh, as an OBJ file."""
    return f"v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nf 1 2 3\n"


def test_the_fingerprint_is_of_the_files_that_are_loaded(
    mitsuba: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, linked, working, named = (tmp_path / name for name in ("own", "linked", "cwd", "named"))
    for folder in (own, linked, working, named):
        folder.mkdir()
    monkeypatch.chdir(working)
    scene, spectrum = own / "scene.xml", own / "grey.spd"
    scene.write_text(
        f'<scene version="3.0.0">{SENSOR}<path value="{named}"/><emitter type="constant"/>'
        '<shape type="obj"><string name="filename" value="one.obj"/><bsdf type="diffuse">'
        '<spectrum name="reflectance" filename="grey.spd"/></bsdf></shape></scene>'
    )
    spectrum.write_text("400 0.5\n700 0.25\n")
    (linked / "scene.xml").symlink_to(scene)
    paths = list(mitsuba.file_resolver())

    # From where it is looked for last to where it is looked for first.
    for folder in (working, own, linked, named):
        (folder / "one.obj").write_text(triangle(1))
        before = MitsubaRenderer(linked / "scene.xml")
        assert before._scene.bbox().max.x == 1.0
        (folder / "one.obj").write_text(triangle(2))
        after = MitsubaRenderer(linked / "scene.xml")
        assert after._scene.bbox().max.x == 2.0
        assert after.fingerprint != before.fingerprint
    spectrum.write_text("400 0.5\n700 0.75\n")
    assert MitsubaRenderer(linked / "scene.xml").fingerprint != after.fingerprint
    assert list(mitsuba.file_resolver()) == paths


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<scene", "Parsing of XML file"),
        ('<scene version="3.0.0"></scene>', "expected a sensor, got none"),
        ('<shape version="3.0.0" type="sphere"/>', "expected a <scene>"),
        (
            '<scene version="3.0.0">'
            + SENSOR.replace('<integrator type="path"/>', "")
            + "</scene>",
            "expected an integrator, got none",
        ),
        (
            f'<scene version="3.0.0">{SENSOR}<shape type="sphere"><bsdf type="velvet"/></shape>'
            "</scene>",
            'Plugin "velvet" not found',
        ),
        (
            f'<scene version="3.0.0">{SENSOR}<shape type="obj"><string name="filename" '
            'value="no.obj"/></shape></scene>',
            '"no.obj": file not found',
        ),
        (
            f'<scene version="3.0.0">{SENSOR}<include filename="no.xml"/></scene>',
            '"no.xml" not found',
        ),
        (
            f'<scene version="3.0.0">{SENSOR}<shape type="sphere"><float name="radius" '
            'value="$size"/></shape></scene>',
            "undefined parameter: $size",
        ),
        (
            '<scene version="3.0.0">' + SENSOR.replace('value="8"', 'value="0"') + "</scene>",
            "at least one pixel, got 0 x 0",
        ),
        (
            '<scene version="3.0.0">' + SENSOR.replace('"path"', '"ptracer"') + "</scene>",
            "expected an integrator that samples single rays",
        ),
        (
            '<scene version="3.0.0">' + SENSOR.replace('"path"', '"prb"') + "</scene>",
            "expected an integrator that samples single rays, such as path, volpath or direct, "
            "got prb",
        ),
        (
            f'<scene version="3.0.0">{SENSOR}<shape type="sphere"/></scene>',
            "expected a light, got none",
        ),
        (
            '<scene version="3.0.0"><emitter type="constant"/>'
            + SENSOR.replace(
                '"path"/>', '"aov"><string name="aovs" value="dd:depth"/></integrator>'
            )
            + "</scene>",
            "expected an integrator inside that of the type aov, got none",
        ),
    ],
)
def test_scenes_that_are_refused(mitsuba: Any, tmp_path: Path, text: str, words: str) -> None:
    del mitsuba
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(SceneError, match=re.escape(words)) as refusal:
        MitsubaRenderer(path)
    message = str(refusal.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert ".cpp" not in message


def test_unknown_parameters_missing_files_and_variants_are_refused(still_life: Path) -> None:
    with pytest.raises(SceneError, match=r"unused parameters: \$hue=3"):
        MitsubaRenderer(still_life, {"hue": "3"})
    with pytest.raises(SceneError, match="cannot be given a parameter named 'filename'"):
        MitsubaRenderer(still_life, {"filename": "3"})
    with pytest.raises(SceneError, match="no such file"):
        MitsubaRenderer(still_life.with_name("none.xml"))
    with pytest.raises(SceneError, match="a folder"):
        MitsubaRenderer(still_life.parent)
    for variant, instead in (
        ("llvm_ad_spectral_polarized", "llvm_ad_spectral"),
        ("llvm_ad_mono", "llvm_ad_rgb"),
        ("llvm_ad_blue", "one of these"),
    ):
        wanted = f"expected a variant among .*, got {variant}; .* set {instead} before"
        with pytest.raises(SceneError, match=wanted):
            MitsubaRenderer(still_life, variant=variant)
    with pytest.raises(ValueError, match="expected a seed"):
        MitsubaRenderer(still_life, seed=-1)


def test_without_mitsuba_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(SceneError, match=re.escape("torch-vdm[render]")):
        load_mitsuba("scalar_rgb")


@pytest.fixture
def other_llvm(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Forget which LLVM was found, before and after the test."""
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    find_llvm.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    find_llvm.cache_clear()


def test_an_llvm_that_is_none_is_refused(other_llvm: pytest.MonkeyPatch, tmp_path: Path) -> None:
    library = tmp_path / "libLLVM.so"
    library.write_text("no library")
    other_llvm.setenv(llvm.VARIABLE, str(library))
    with pytest.raises(LLVMError, match="expected an LLVM library of version 17 or newer"):
        find_llvm()


def test_an_llvm_that_would_abort_is_refused(other_llvm: pytest.MonkeyPatch) -> None:
    other_llvm.setattr(llvm, "major_version", lambda _: 15)
    other_llvm.setenv(llvm.VARIABLE, "libLLVM-15.so")
    with pytest.raises(LLVMError, match="got version 15"):
        find_llvm()
    find_llvm.cache_clear()
    other_llvm.delenv(llvm.VARIABLE)
    assert find_llvm() is None


def test_an_llvm_that_someone_else_chose_is_refused(
    mitsuba: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    del mitsuba
    monkeypatch.setattr("drjit.detail.llvm_version", lambda: (15, 0, 6))
    with pytest.raises(SceneError, match="expected LLVM 17 or newer, got 15"):
        load_mitsuba()


def test_without_llvm_it_warns_and_interprets(mitsuba: Any, other_llvm: pytest.MonkeyPatch) -> None:
    if mitsuba.variant().startswith("cuda"):
        pytest.skip("a GPU is there, and is taken")
    other_llvm.setattr(llvm, "major_version", lambda _: None)
    with pytest.warns(UserWarning, match="rendering with scalar_rgb"):
        assert load_mitsuba().variant() == "scalar_rgb"
    with pytest.raises(SceneError, match="llvm_ad_rgb needs an LLVM; install"):
        load_mitsuba("llvm_ad_rgb")


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("/usr/lib/llvm-19/lib/libLLVM.so.19.1", 19),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib64/libLLVM.so.20.1", 20),
        ("/opt/homebrew/opt/llvm@18/lib/libLLVM.dylib", 18),
        ("/usr/lib/libLLVM.so", 0),
    ],
)
def test_versions_are_read_from_names(name: str, version: int) -> None:
    assert llvm._version_in_name(name) == version
