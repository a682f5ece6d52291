"""The command line, run as a user runs it: files in, status and text out."""

import json
import shlex
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import PIL.Image
import pytest
import torch

from tests.conftest import one_line_error
from tests.test_colour import chunk, with_chunks
from tests.test_io import ACES, hand_made_exr, png16, rgb, write_exr
from torch_vdm import VDM, Display, Haar, StationaryHaar, Steerable, __version__
from torch_vdm.cli import main
from torch_vdm.io import ImageError, load, read_image, write_channels, write_image
from torch_vdm.model.cortex import Transform

Pair = tuple[str, str]


@pytest.fixture
def pair(tmp_path: Path) -> Pair:
    """Return a reference and a test file, PNG."""
    generator = torch.Generator().manual_seed(1)
    reference = torch.rand(3, 20, 30, generator=generator)
    test = (reference + 0.1 * torch.randn(reference.shape, generator=generator)).clamp(0.0, 1.0)
    write_image(tmp_path / "reference.png", reference)
    write_image(tmp_path / "test.png", test)
    return str(tmp_path / "reference.png"), str(tmp_path / "test.png")


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, object]:
    """Return the JSON that a comparison prints."""
    assert main(["compare", *arguments, "--json", "-"]) == 0
    figures: dict[str, object] = json.loads(capsys.readouterr().out)
    return figures


def test_json_has_the_figures_of_the_metric(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    told = run_json(capsys, *pair, "--ppd", "48", "--peak", "250", "--exposure", "-1")
    reference, test = (read_image(path)[None] for path in pair)
    metric = VDM(48.0, Display.srgb(250.0, exposure=-1.0), transform=StationaryHaar("filter"))
    jnd = metric(test, reference)
    assert told["max_jnd"] == pytest.approx(jnd.max().item())
    assert told["mean_jnd"] == pytest.approx(jnd.mean().item())
    assert told["score_jnd"] == pytest.approx(metric.score(test, reference).item())
    assert (told["width"], told["height"], told["ppd"]) == (30, 20, 48.0)
    assert told["accuracy"] == "standard"
    assert told["observer"] == "calibrated"
    assert told["effects"] == ["aberration", "chromatic", "masking", "pooling"]
    assert told["version"] == __version__


def test_the_reproduce_string_reproduces(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    told = run_json(capsys, *pair, "--observer", "paper", "--peak", "80")
    program, command, *arguments = shlex.split(str(told["reproduce"]))
    assert (program, command) == ("torch-vdm", "compare")
    again = run_json(capsys, *arguments)
    assert told | {"seconds": 0, "assumptions": 0} == again | {"seconds": 0, "assumptions": 0}


def test_the_table_says_what_was_found_and_assumed(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure = tmp_path / "map.png"
    assert main(["compare", *pair, "--map", str(figure)]) == 0
    told = capsys.readouterr().out
    for words in ("maximum", "95th percentile", "visible pixels", "Visible at 60 pixels"):
        assert words in told
    assert "white is 100 cd/m2 (--peak)" in told
    assert f"written: {figure}" in told
    assert figure.stat().st_size > 1000


def test_the_raw_map_is_an_exr(pair: Pair, tmp_path: Path) -> None:
    raw = tmp_path / "map.exr"
    assert main(["compare", *pair, "--map", str(raw)]) == 0
    reference, test = (read_image(path)[None] for path in pair)
    expected = VDM(transform=StationaryHaar("filter"))(test, reference)[0]
    torch.testing.assert_close(read_image(raw)[:1], expected)


def test_fail_above_is_told_by_the_status(pair: Pair) -> None:
    assert main(["compare", *pair, "--fail-above", "0.5"]) == 1
    assert main(["compare", *pair, "--fail-above", "1000"]) == 0
    assert main(["compare", pair[0], pair[0], "--fail-above", "0"]) == 0


def test_exr_scale_is_explicit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reference, test = torch.full((3, 8, 8), 2.0), torch.full((3, 8, 8), 1.0)
    paths = [str(tmp_path / name) for name in ("reference.exr", "test.exr")]
    for path, image in zip(paths, (reference, test), strict=True):
        write_image(path, image)
    told = run_json(capsys, *paths, "--white", "50")
    assert told["mean_luminance_change"] == pytest.approx(-0.5)
    assert "EXR is linear BT.709, and 1.0 is 50 cd/m2 (--white)" in str(told["assumptions"])
    assert main(["compare", *paths, "--white", "50"]) == 0
    assert "100 to 50 cd/m2" in capsys.readouterr().out


def test_the_papers_observer_admits_that_it_is_blind_to_uniform_changes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, level in (("one.exr", 0.5), ("other.exr", 0.6)):
        write_image(tmp_path / name, torch.full((3, 8, 8), level))
    paths = [str(tmp_path / name) for name in ("one.exr", "other.exr")]
    assert main(["compare", *paths, "--observer", "paper"]) == 0
    assert "never sees a uniform change" in capsys.readouterr().out
    assert main(["compare", *paths]) == 0
    assert "never sees" not in capsys.readouterr().out


def test_an_exr_and_a_png_of_the_same_light_are_equal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    coded = torch.full((3, 6, 6), 0.5)
    write_image(tmp_path / "coded.png", coded)
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4
    write_image(tmp_path / "linear.exr", torch.full((3, 6, 6), linear))
    told = run_json(capsys, str(tmp_path / "linear.exr"), str(tmp_path / "coded.png"))
    assert told["max_jnd"] == pytest.approx(0.0, abs=1e-3)


def test_a_screen_gives_pixels_per_degree(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    screen = ["--screen", "3840x2160", "--diagonal", "27", "--distance", "0.6"]
    told = run_json(capsys, *pair, *screen)
    assert told["ppd"] == pytest.approx(67.277, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--ppd", "0"], "--ppd: expected a number over 0, got '0'"),
        (["--ppd", "inf"], "--ppd: expected a number over 0"),
        (["--exposure", "99"], "stops between -32 and 32"),
        (["--fail-above", "-1"], "a number of JND, 0 or more"),
        (["--map", "map.jpg"], "a file name in .png or .exr"),
        (["--screen", "1920"], "expected WIDTHxHEIGHT"),
        (["--screen", "1920x1080", "--distance", "1"], "--screen, --diagonal and --distance"),
        (["--ppd", "60", "--distance", "1"], "--ppd alone"),
        (["--accuracy", "exact"], "--accuracy"),
        (["--json", "missing/folder.json"], "missing/folder.json"),
        (["--map", "missing/folder.png"], "missing/folder.png"),
    ],
)
def test_wrong_options_get_one_line(
    options: list[str],
    words: str,
    pair: Pair,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert words in one_line_error(main, capsys, "compare", *pair, *options)
    assert sorted(tmp_path.iterdir()) == before


def test_outputs_never_take_the_place_of_inputs_or_of_each_other(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path(pair[0]).read_bytes()
    shared = str(tmp_path / "both.png")
    for options in (["--map", pair[0]], ["--json", pair[0]], ["--map", shared, "--json", shared]):
        line = one_line_error(main, capsys, "compare", *pair, *options)
        assert "expected a file of its own" in line
    assert Path(pair[0]).read_bytes() == before
    assert not Path(shared).exists()


@pytest.mark.parametrize("options", [[], ["--json", "-"]])
def test_a_reader_that_stops_reading_is_no_error(pair: Pair, options: list[str]) -> None:
    command = [sys.executable, "-m", "torch_vdm", "compare", *pair, *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait(timeout=120) == 0


def test_wrong_files_get_one_line(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "small.png", torch.zeros(3, 4, 5))
    (tmp_path / "empty.exr").touch()
    (tmp_path / "words.png").write_text("not a picture")
    small = one_line_error(main, capsys, "compare", pair[0], str(tmp_path / "small.png"))
    assert "small.png: expected the size of" in small
    assert "30 x 20, got 5 x 4" in small
    for name in ("empty.exr", "words.png", "missing.png"):
        assert name in one_line_error(main, capsys, "compare", pair[0], str(tmp_path / name))
    assert "got a folder" in one_line_error(main, capsys, "compare", pair[0], str(tmp_path))


def test_nonfinite_and_negative_values_are_refused_or_repaired(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = torch.full((3, 8, 8), 0.5)
    write_image(tmp_path / "good.exr", image)
    image[1, 2, 3], image[0, 4, 1] = float("nan"), -0.25
    write_image(tmp_path / "bad.exr", image)
    paths = [str(tmp_path / name) for name in ("good.exr", "bad.exr")]
    line = one_line_error(main, capsys, "compare", *paths)
    assert "bad.exr" in line
    assert "--nonfinite zero" in line
    assert "--negative clip" in one_line_error(
        main, capsys, "compare", *paths, "--nonfinite", "zero"
    )
    told = run_json(capsys, *paths, "--nonfinite", "zero", "--negative", "clip")
    assumptions = told["assumptions"]
    assert isinstance(assumptions, list)
    assert sum("bad.exr" in line for line in assumptions) >= 2


def test_demo_needs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    assert "Visible at 60 pixels per degree" in capsys.readouterr().out
    assert (tmp_path / "torch-vdm-demo.png").stat().st_size > 10_000


def test_interruption_is_one_line(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("torch_vdm.loading.load", interrupted)
    assert main(["compare", *pair]) == 130
    assert capsys.readouterr().err == "torch-vdm: interrupted\n"


def test_jnd_falls_with_samples_per_pixel(
    shared_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for scene in sorted(path for path in (shared_data / "mc_pairs").iterdir() if path.is_dir()):
        means = [
            run_json(capsys, str(scene / "ref_512spp.exr"), str(next(scene.glob(pattern))))
            for pattern in ("noisy_004spp*.exr", "noisy_016spp*.exr", "noisy_064spp*.exr")
        ]
        for key in ("max_jnd", "mean_jnd", "p95_jnd", "score_jnd"):
            values = [float(str(told[key])) for told in means]
            assert values[0] > values[1] > values[2], (scene.name, key)


@pytest.mark.parametrize(
    ("accuracy", "transform"),
    [("fast", Haar()), ("standard", StationaryHaar("filter")), ("reference", Steerable())],
)
def test_accuracy_is_the_transform(
    pair: Pair,
    accuracy: str,
    transform: Transform,
    capsys: pytest.CaptureFixture[str],
) -> None:
    told = run_json(capsys, *pair, "--accuracy", accuracy)
    reference, test = (read_image(path)[None] for path in pair)
    metric = VDM(60.0, transform=transform)
    assert told["accuracy"] == accuracy
    assert told["max_jnd"] == pytest.approx(metric(test, reference).max().item())
    assert told["score_jnd"] == pytest.approx(metric.score(test, reference).item())
    assert f"--accuracy {accuracy}" in str(told["reproduce"])
    # What the quickest may miss is told.
    assert ("missed" in str(told["assumptions"])) == (accuracy == "fast")


def test_the_papers_observer_has_the_papers_transform(
    pair: Pair, capsys: pytest.CaptureFixture[str]
) -> None:
    told = run_json(capsys, *pair, "--observer", "paper")
    assert told["accuracy"] == "fast"
    assert "missed" not in str(told["assumptions"])


def test_an_unknown_accuracy_is_refused(pair: Pair, capsys: pytest.CaptureFixture[str]) -> None:
    told = one_line_error(main, capsys, "compare", *pair, "--accuracy", "best")
    assert "fast" in told
    assert "reference" in told


def test_a_negative_number_may_have_an_exponent(
    pair: Pair, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = (run_json(capsys, *pair, "--exposure", text) for text in ("-1e-1", "-0.1"))
    assert one["max_jnd"] == other["max_jnd"]


def test_tiles_give_the_same_figures(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run_json(capsys, *pair)
    tiled = run_json(capsys, *pair, "--tile", "8")
    assert "--tile 8" in str(tiled["reproduce"])
    for name in ("max_jnd", "mean_jnd", "p95_jnd", "visible_fraction", "score_jnd"):
        assert tiled[name] == pytest.approx(whole[name], abs=1e-5)
    assert "4 or more" in one_line_error(main, capsys, "compare", *pair, "--tile", "2")
    # Arrays on a disk, the codes of the same pictures: whole, and in tiles.
    arrays = []
    for name, path in zip(("reference", "test"), pair, strict=True):
        codes = (255.0 * read_image(path)).round().to(torch.uint8)
        np.save(tmp_path / f"{name}.npy", codes.permute(1, 2, 0).numpy())
        arrays.append(str(tmp_path / f"{name}.npy"))
    figure = str(tmp_path / "map.png")
    for paths in (arrays, [pair[0], arrays[1]]):
        for extra in ([], ["--tile", "8", "--map", figure]):
            told = run_json(capsys, *paths, *extra)
            assert told["max_jnd"] == pytest.approx(whole["max_jnd"], abs=1e-5)
            assert told["mean_luminance_change"] == pytest.approx(whole["mean_luminance_change"])
    assert "read part by part" in str(told["assumptions"])
    linear = str(tmp_path / "linear.npy")
    np.save(linear, np.full((3, 20, 30), 0.5, np.float32))
    told = run_json(capsys, linear, pair[1], "--tile", "8")
    # float32: 1e-5 JND, or the last bits of a large figure.
    in_one = run_json(capsys, linear, pair[1])["max_jnd"]
    assert told["max_jnd"] == pytest.approx(in_one, abs=1e-5, rel=2e-6)
    np.save(linear, np.full((3, 20, 30), np.nan, np.float32))
    assert "linear.npy: expected finite" in one_line_error(main, capsys, "compare", linear, linear)


# --- Files as people have them --------------------------------------------------------------------


def two(folder: Path, suffix: str, *images: torch.Tensor) -> list[str]:
    """Write images of one name and suffix into folders of their own."""
    paths = []
    for number, image in enumerate(images):
        (folder / str(number)).mkdir(exist_ok=True)
        paths.append(str(folder / str(number) / f"image{suffix}"))
        write_image(paths[-1], image)
    return paths


def see_through(path: Path, colours: int, alpha: int) -> str:
    """Write a PNG of one colour and transparency."""
    PIL.Image.new("RGBA", (12, 10), (colours, colours, colours, alpha)).save(path)
    return str(path)


@pytest.mark.parametrize(("colours", "alpha"), [(0, 64), (255, 64), (128, 0), (200, 254)])
def test_transparency_that_differs_is_a_difference(
    tmp_path: Path, colours: int, alpha: int, capsys: pytest.CaptureFixture[str]
) -> None:
    # Whatever the colour: black on black and white on white are seen on the other one.
    one = see_through(tmp_path / "one.png", colours, 255)
    other = see_through(tmp_path / "other.png", colours, alpha)
    told = run_json(capsys, one, other)
    assert float(str(told["max_jnd"])) > (0.0 if alpha == 254 else 3.0)
    assert "the transparency of the two differs: compared over black and over" in str(told)
    single = [
        float(str(run_json(capsys, one, other, "--background", name)["max_jnd"]))
        for name in ("black", "white")
    ]
    assert told["max_jnd"] == pytest.approx(max(single))
    told = run_json(capsys, one, other, "--background", "#102030")
    assert "the transparency of the two differs: compared over #102030 alone" in str(told)
    assert "--background '#102030'" in str(told["reproduce"])


def test_colours_under_nothing_are_no_difference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = see_through(tmp_path / "one.png", 0, 0)
    other = see_through(tmp_path / "other.png", 255, 0)
    told = run_json(capsys, one, other)
    assert told["max_jnd"] == 0.0
    assert "shown over black (--background)" in str(told["assumptions"])


def test_an_exr_without_alpha_is_compared_with_one_that_has_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # As a denoiser leaves it: the picture over black is the same.
    image = torch.full((3, 8, 8), 0.5)
    alpha = torch.full((8, 8), 0.75)
    write_channels(tmp_path / "one.exr", dict(zip("RGBA", (*image, alpha), strict=True)))
    write_image(tmp_path / "other.exr", image)
    paths = [str(tmp_path / name) for name in ("one.exr", "other.exr")]
    told = run_json(capsys, *paths)
    assert told["max_jnd"] == 0.0
    assert "one.exr: It is transparent, and shown over black" in str(told["assumptions"])
    write_channels(tmp_path / "other.exr", dict(zip("RGBA", (*image, alpha / 2), strict=True)))
    assert float(str(run_json(capsys, *paths)["max_jnd"])) > 1.0


@pytest.mark.parametrize("options", [[], ["--tile", "8"]])
def test_both_eyes_are_compared(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    generator = torch.Generator().manual_seed(1)
    left, right = torch.rand(2, 3, 16, 24, generator=generator).numpy()
    eyes = {"R": left[0], "G": left[1], "B": left[2]}
    eyes |= {f"right.{name}": plane for name, plane in zip("RGB", right, strict=True)}
    paths = []
    for name, factor in (("one.exr", 1.0), ("other.exr", 1.1)):
        channels = {key: (p * factor if "." in key else p, 1) for key, p in eyes.items()}
        views = b"\4\0\0\0left\5\0\0\0right"
        attributes = {"multiView": ("stringvector", views)}
        paths.append(str(hand_made_exr(tmp_path / name, channels, attributes=attributes)))
    told = run_json(capsys, *paths, *options)
    assert "the views left and right are compared" in str(told["assumptions"])
    assert "the views" not in str(run_json(capsys, *paths, "--part", "left")["assumptions"])
    assert run_json(capsys, *paths, "--part", "left")["max_jnd"] == 0.0
    only = run_json(capsys, *paths, "--part", "right")
    assert told["max_jnd"] == pytest.approx(only["max_jnd"], abs=1e-5)
    assert float(str(only["max_jnd"])) > 1.0


def write_eyes(path: Path, eyes: dict[str, torch.Tensor]) -> str:
    """Write an OpenEXR file of a part for each view, in this order."""
    parts = []
    for view, planes in eyes.items():
        header = {"type": OpenEXR.scanlineimage, "view": view}
        parts.append(OpenEXR.Part(header, rgb(planes.numpy().copy()), view))
    OpenEXR.File(parts).write(str(path))
    return str(path)


def test_eyes_are_matched_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = torch.rand(2, 3, 16, 24, generator=torch.Generator().manual_seed(1))
    one = write_eyes(tmp_path / "one.exr", {"left": left, "right": right})
    swapped = write_eyes(tmp_path / "swapped.exr", {"right": right, "left": left})
    assert run_json(capsys, one, swapped)["max_jnd"] == 0.0
    broken = write_eyes(tmp_path / "broken.exr", {"right": right, "left": left * 1.1})
    plain = write_eyes(tmp_path / "plain.exr", {"left": left * 1.1, "right": right})
    found = float(str(run_json(capsys, one, broken)["max_jnd"]))
    assert found == run_json(capsys, one, plain)["max_jnd"]
    assert found > 1.0
    three = {"centre": left * 2, "right": right, "left": left}
    more = run_json(capsys, one, write_eyes(tmp_path / "more.exr", three))
    assert more["max_jnd"] == 0.0
    lacking = "more.exr: views that the other file lacks are not compared: centre"
    assert lacking in str(more["assumptions"])
    centre = write_eyes(tmp_path / "centre.exr", {"centre": left})
    line = one_line_error(main, capsys, "compare", one, centre)
    assert "expected a view that" in line
    assert "(left, right), got centre; render the same views" in line


def test_channels_are_named_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(3, 8, 9, generator=generator)
    write_channels(tmp_path / "one.exr", dict(zip(("x", "y.z", "w"), image, strict=True)))
    write_image(tmp_path / "other.exr", image)
    paths = [str(tmp_path / name) for name in ("one.exr", "other.exr")]
    assert "--channels" in one_line_error(main, capsys, "compare", *paths)
    line = one_line_error(main, capsys, "compare", *paths, "--channels", "R=x,G=y.z")
    assert "expected R=NAME,G=NAME,B=NAME" in line
    write_channels(tmp_path / "other.exr", dict(zip(("x", "y.z", "w"), image, strict=True)))
    told = run_json(capsys, *paths, "--channels", "r=x,g=y.z,b=w")
    assert told["max_jnd"] == 0.0
    assert "--channels R=x,G=y.z,B=w" in str(told["reproduce"])


def test_absolute_light_needs_no_white(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # 58 % of PQ is close to 203 cd/m2 (ITU-R BT.2408-7, table 1).
    values = np.full((8, 9, 3), round(0.5806 * 65535), np.uint16)
    data = with_chunks(png16(values, 2, interlaced=False), chunk(b"cICP", bytes((9, 16, 0, 1))))
    (tmp_path / "pq.png").write_bytes(data)
    write_image(tmp_path / "white.png", torch.ones(3, 8, 9))
    write_image(tmp_path / "light.exr", torch.full((3, 8, 9), 2.03))
    for other in (["white.png", "--peak", "203"], ["light.exr"], ["light.exr", "--white", "100"]):
        paths = [str(tmp_path / "pq.png"), str(tmp_path / other[0])]
        told = run_json(capsys, *paths, *other[1:])
        assert float(str(told["max_jnd"])) < 0.2
        assert "PNG is absolute light in cd/m2" in str(told["assumptions"])


def test_infinity_is_held_to_the_largest_half(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = np.full((3, 8, 9), 0.5, np.float16)
    paths = []
    for name, largest in (("inf.exr", np.inf), ("max.exr", 65504)):
        values[:, 4, 4] = largest
        paths.append(str(write_exr(tmp_path / name, rgb(values))))
    assert "--nonfinite clamp" in one_line_error(main, capsys, "compare", *paths)
    told = run_json(capsys, *paths, "--nonfinite", "clamp")
    assert told["max_jnd"] == 0.0
    assert "Infinity was held to 65504" in str(told["assumptions"])
    assert float(str(run_json(capsys, *paths, "--nonfinite", "zero")["max_jnd"])) > 1.0


def test_files_of_one_name_are_told_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = two(tmp_path, ".exr", torch.zeros(3, 8, 9), torch.ones(3, 8, 9))
    write_channels(paths[0], {name: torch.zeros(8, 9) for name in ("R", "G", "B", "Z")})
    told = run_json(capsys, *paths)
    assert f"{paths[0]}: Channels that are not used: Z." in told["assumptions"]  # type: ignore[operator]


@pytest.mark.parametrize("dtype", [">u1", ">u2", "<u2", ">f4", ">f8", ">f2", "<f2"])
def test_arrays_of_any_order_of_bytes(
    tmp_path: Path, dtype: str, capsys: pytest.CaptureFixture[str]
) -> None:
    values = np.random.default_rng(1).uniform(0, 1, (3, 8, 9))
    whole = dtype[1] == "u"
    stored = np.rint(values * np.iinfo(dtype).max) if whole else values
    native = np.dtype(dtype).newbyteorder("=")
    np.save(tmp_path / "one.npy", stored.astype(dtype))
    np.save(tmp_path / "other.npy", stored.astype(native))
    told = run_json(capsys, str(tmp_path / "one.npy"), str(tmp_path / "other.npy"))
    assert told["max_jnd"] == 0.0


@pytest.mark.parametrize(
    "dtype", ["int8", "int16", "int32", "uint32", "int64", "bool", "complex64"]
)
def test_arrays_that_are_refused(
    tmp_path: Path, dtype: str, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "image.npy", np.zeros((3, 8, 9), dtype))
    line = one_line_error(main, capsys, "compare", *[str(tmp_path / "image.npy")] * 2)
    assert "image.npy: expected numbers of uint8, uint16, float16" in line
    assert f"got {dtype}" in line


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-3, 4, 4)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4, 999999999999999999999)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4, 4)",
        "((((",
        "-" * 9000 + "1",
    ],
)
def test_damaged_arrays_are_refused(
    tmp_path: Path, header: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "image.npy"
    size = struct.pack("<H", len(header))
    path.write_bytes(b"\x93NUMPY\1\0" + size + header.encode() + bytes(192))
    line = one_line_error(main, capsys, "compare", str(path), str(path))
    assert "image.npy: damaged or no array: " in line


def test_arrays_are_not_for_load(tmp_path: Path) -> None:
    np.save(tmp_path / "image.npy", np.zeros((3, 8, 9), np.float32))
    with pytest.raises(ImageError, match=r"use numpy\.load or torch_vdm\.io\.ArrayFile"):
        load(tmp_path / "image.npy")


def test_floats_may_be_coded(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = run_json(capsys, *pair)
    arrays, files = [], []
    for name, path in zip(("reference", "test"), pair, strict=True):
        image = read_image(path)
        arrays.append(str(tmp_path / f"{name}.npy"))
        np.save(arrays[-1], image.numpy())
        files.append(str(tmp_path / f"{name}.exr"))
        write_image(files[-1], image)
    for paths in (arrays, files, [arrays[0], pair[1]], [files[0], arrays[1]]):
        told = run_json(capsys, *paths, "--coded")
        assert told["max_jnd"] == pytest.approx(whole["max_jnd"], abs=1e-5)
        assert "--coded" in str(told["reproduce"])
    assert run_json(capsys, *arrays)["max_jnd"] != pytest.approx(whole["max_jnd"], abs=1e-2)
    aces = write_exr(
        tmp_path / "aces.exr", rgb(np.ones((3, 20, 30), np.float32)), chromaticities=ACES
    )
    line = one_line_error(main, capsys, "compare", str(aces), files[0], "--coded")
    assert "leave out --coded" in line


def test_neighbours_of_nan_are_found_across_tiles(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = np.random.default_rng(1).uniform(0.2, 1, (3, 32, 32)).astype(np.float32)
    holed = values.copy()
    holed[1, 16, 15:18] = np.nan
    holed[0, 15, 16] = np.inf
    np.save(tmp_path / "one.npy", holed)
    write_image(tmp_path / "one.exr", torch.from_numpy(holed))
    np.save(tmp_path / "other.npy", values)
    paths = [str(tmp_path / name) for name in ("one.npy", "other.npy")]
    clamp = "--nonfinite", "clamp"
    figures = [
        run_json(capsys, first, paths[1], *clamp, *tile)["max_jnd"]
        for first in (paths[0], str(tmp_path / "one.exr"))
        for tile in ([], ["--tile", "8"])
    ]
    assert figures == pytest.approx([figures[0]] * 4, rel=1e-5)


# --- Surroundings ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("redirection", "arguments", "status"),
    [
        (">&-", "compare {0} {1}", 0),
        (">&-", "compare {0} {1} --fail-above 0.5", 1),
        ("| head -c 0", "compare {0} {1}", 0),
        ("| head -c 0", "--help", 0),
        (">&- 2>&- <&-", "compare {0} {1}", 0),
        ("2>&-", "compare {0} missing.png", 2),
    ],
)
def test_closed_streams_end_quietly(
    pair: Pair, redirection: str, arguments: str, status: int
) -> None:
    words = arguments.format(*(shlex.quote(path) for path in pair))
    command = f"{shlex.quote(sys.executable)} -m torch_vdm {words} {redirection}"
    script = f"set -o pipefail; {command}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, check=False, timeout=120)
    assert done.returncode == status
    assert done.stderr == b""


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (
            ValueError("a bug\nof ours"),
            3,
            "internal error, ValueError: a bug of ours; please report",
        ),
        (RuntimeError("shape"), 3, "internal error, RuntimeError: shape"),
        (MemoryError(), 3, "not enough memory; make the images smaller, or compare in tiles"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you"), 3, "not enough memory; "),
        (OSError(12, "Cannot allocate memory"), 3, "not enough memory; make the images smaller"),
        (OSError(28, "No space left on device"), 2, "output: No space left on device"),
    ],
)
def test_errors_of_our_own_are_not_bad_input(
    pair: Pair,
    error: Exception,
    status: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr("torch_vdm.cli.figures", failing)
    assert main(["compare", *pair, "--fail-above", "1"]) == status
    line = capsys.readouterr().err
    assert line.startswith(f"torch-vdm: {words}")
    assert line.count("\n") == 1


@pytest.mark.parametrize("options", [["--peak", "1e13"], ["--white", "1e-13"], ["--ppd", "1e-9"]])
def test_options_that_the_model_refuses_are_bad_input(
    pair: Pair, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert "expected" in one_line_error(main, capsys, "compare", *pair, *options)


def test_only_tiles_need_a_folder(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none(*_: object, **__: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.mkdtemp", none)
    run_json(capsys, *pair)
    assert main(["compare", *pair, "--tile", "8"]) == 2
    assert "Read-only file system" in capsys.readouterr().err
