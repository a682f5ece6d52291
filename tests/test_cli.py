"""The command line, run as a user runs it: files in, status and text out."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_vdm import VDM, Display, Haar, StationaryHaar, Steerable, __version__
from torch_vdm.cli import main
from torch_vdm.cortex import Transform
from torch_vdm.io import read_image, write_image

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


def one_line_error(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the one line on standard error of a command that ends with 2."""
    try:
        status = main(arguments)
    except SystemExit as ending:
        status = int(ending.code or 0)
    told = capsys.readouterr()
    assert status == 2
    assert told.out == ""
    assert told.err.count("\n") == 1
    return told.err


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
    assert words in one_line_error(capsys, "compare", *pair, *options)
    assert sorted(tmp_path.iterdir()) == before


def test_outputs_never_take_the_place_of_inputs_or_of_each_other(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path(pair[0]).read_bytes()
    shared = str(tmp_path / "both.png")
    for options in (["--map", pair[0]], ["--json", pair[0]], ["--map", shared, "--json", shared]):
        line = one_line_error(capsys, "compare", *pair, *options)
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
    small = one_line_error(capsys, "compare", pair[0], str(tmp_path / "small.png"))
    assert "small.png: expected the size of" in small
    assert "30 x 20, got 5 x 4" in small
    for name in ("empty.exr", "words.png", "missing.png"):
        assert name in one_line_error(capsys, "compare", pair[0], str(tmp_path / name))
    assert "got a folder" in one_line_error(capsys, "compare", pair[0], str(tmp_path))


def test_nonfinite_and_negative_values_are_refused_or_repaired(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = torch.full((3, 8, 8), 0.5)
    write_image(tmp_path / "good.exr", image)
    image[1, 2, 3], image[0, 4, 1] = float("nan"), -0.25
    write_image(tmp_path / "bad.exr", image)
    paths = [str(tmp_path / name) for name in ("good.exr", "bad.exr")]
    line = one_line_error(capsys, "compare", *paths)
    assert "bad.exr" in line
    assert "--nonfinite zero" in line
    assert "--negative clip" in one_line_error(capsys, "compare", *paths, "--nonfinite", "zero")
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

    monkeypatch.setattr("torch_vdm.cli.load", interrupted)
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
    told = one_line_error(capsys, "compare", *pair, "--accuracy", "best")
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
    assert "4 or more" in one_line_error(capsys, "compare", *pair, "--tile", "2")
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
    assert "linear.npy: expected finite" in one_line_error(capsys, "compare", linear, linear)
