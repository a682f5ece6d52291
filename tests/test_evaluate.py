"""``torch-vdm evaluate`` as a user runs it: folders in, a folder with results out."""

import csv
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import torch

from torch_vdm import read_image, write_image
from torch_vdm.cli import main
from torch_vdm.evaluate import journal, judge
from torch_vdm.io import atomic_path

FRAMES = 8
D3 = Path(str(files("torch_vdm.evaluate") / "web" / "d3.min.js"))


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """Return a folder with a reference of eight frames, and two tests of which B is better."""
    generator = torch.Generator().manual_seed(1)
    for name in ("ref", "a", "b"):
        (tmp_path / name).mkdir()
    for number in range(FRAMES):
        reference = 0.2 + 0.6 * torch.rand(3, 24, 32, generator=generator)
        noise = torch.randn(reference.shape, generator=generator)
        write_image(tmp_path / f"ref/{number:03}.exr", reference)
        for name, size in (("a", 0.1), ("b", 0.03)):
            write_image(tmp_path / f"{name}/{number:03}.exr", (reference + size * noise).abs())
    return tmp_path


def arguments(folder: Path, *more: str) -> list[str]:
    return [
        "evaluate", "--reference", f"{folder}/ref", "--test", f"A={folder}/a",
        "--test", f"B={folder}/b", "--output", f"{folder}/out", *more,
    ]  # fmt: skip


def results(folder: Path) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((folder / "out/results.json").read_text())
    return told


def one_line(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the one line on standard error of a command that ends with 2."""
    capsys.readouterr()
    assert main(words) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1, told.err
    assert "Traceback" not in told.err
    return told.err


def test_what_a_killed_worker_left_half_written_is_removed(folders: Path) -> None:
    assert main(arguments(folders)) == 0
    out = folders / "out"
    kept = [out / "maps/A/.hidden.exr", out / "pictures/.0123456789abcde.js", folders / "ref/.n"]
    left = []
    for target in (out / "maps/A/000.exr", out / "maps/B/007.png", out / "pictures/unknown.js"):
        with atomic_path(target) as temporary:
            temporary.touch()
            left.append(temporary.with_name(temporary.name))
    before = {path for path in out.rglob("*") if path.name not in ("unknown.js",)}
    (out / "pictures/unknown.js").unlink()
    for path in (*left, *kept):
        path.write_bytes(b"half")
    assert main(arguments(folders, "--resume")) == 0
    assert not any(path.exists() for path in left)
    assert all(path.read_bytes() == b"half" for path in kept)
    assert before <= set(out.rglob("*"))


def test_everything_is_written_and_said(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments(folders)) == 0
    said = capsys.readouterr().out
    assert "Maximum: B is better than A" in said
    assert f"on {FRAMES} of {FRAMES} frames" in said
    told = results(folders)
    assert len(told["frames"]) == 2 * FRAMES
    assert told["settings"]["accuracy"] == "standard"
    assert told["settings"]["ppd"] == 60.0
    assert told["settings"]["tests"] == f"A={folders}/a, B={folders}/b"
    assert told["summary"]["tests"]["A"]["compared"] == FRAMES
    first = told["frames"][0]
    assert (first["frame"], first["test"], first["size"]) == ("000", "A", [32, 24])
    jnd = read_image(folders / "out/maps/A/000.exr")[0]
    assert first["figures"]["max_jnd"] == jnd.max().item()
    assert first["figures"]["visible_fraction"] == pytest.approx((jnd > 1.0).float().mean().item())
    with (folders / "out/table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * FRAMES
    assert float(rows[1]["max_jnd"]) == told["frames"][1]["figures"]["max_jnd"]
    assert (folders / "out/report.html").stat().st_size > 10000
    assert (folders / "out/maps/B/007.png").is_file()


def test_the_figures_are_those_of_compare(
    folders: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--ppd", "30", "--white", "200", "--exposure", "1"]
    assert main(arguments(folders, *options)) == 0
    capsys.readouterr()
    pair = [str(folders / "ref/003.exr"), str(folders / "b/003.exr")]
    assert main(["compare", *pair, *options, "--json", "-"]) == 0
    alone = json.loads(capsys.readouterr().out)
    ours = next(
        each for each in results(folders)["frames"] if (each["frame"], each["test"]) == ("003", "B")
    )
    for name in ("max_jnd", "mean_jnd", "p95_jnd", "visible_fraction"):
        assert ours["figures"][name] == alone[name]
    change = ours["figures"]["mean_luminance_change"]
    assert change == pytest.approx(alone["mean_luminance_change"], abs=1e-5)
    assert ours["max_pixel"] == alone["max_pixel"]


def test_broken_frames_are_told_and_counted(
    folders: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (folders / "a/001.exr").read_bytes()
    (folders / "a/001.exr").write_bytes(whole[: len(whole) // 2])
    (folders / "a/002.exr").unlink()
    write_image(folders / "a/003.exr", torch.rand(3, 5, 5))
    write_image(folders / "a/004.exr", torch.full((3, 24, 32), torch.nan))
    (folders / "a/005.exr").write_bytes(b"")
    write_image(folders / "a/099.exr", torch.rand(3, 5, 5))
    assert main(arguments(folders, "--junit", f"{folders}/out/junit.xml", "--fail-above", "0")) == 1
    said = capsys.readouterr().out
    assert f"Skipped 7 of {2 * FRAMES + 2} comparisons" in said
    skipped = {
        (each["frame"], each["test"]): each["skipped"]
        for each in results(folders)["frames"]
        if each["skipped"]
    }
    assert set(skipped) == {(f"00{n}", "A") for n in (1, 2, 3, 4, 5)} | {
        ("099", "A"), ("099", "B"),
    }  # fmt: skip
    assert "expected the size of" in skipped["003", "A"]
    assert "NaN" in skipped["004", "A"]
    suite = ElementTree.parse(folders / "out/junit.xml").getroot()
    counts = {each.get("name"): each for each in suite}
    assert (counts["A"].get("tests"), counts["A"].get("skipped")) == ("9", "6")
    assert counts["A"].get("failures") == str(FRAMES - 5)
    assert "JND at x" in str(suite.findall(".//failure")[0].get("message"))


@pytest.mark.parametrize(("limit", "status"), [("0.01", 1), ("1000", 0)])
def test_fail_above_is_told_by_the_status(folders: Path, limit: str, status: int) -> None:
    assert main(arguments(folders, "--fail-above", limit)) == status
    assert main(arguments(folders, "--fail-above", limit, "--resume")) == status


def counted_calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list to which every frame is added that is computed from now on."""
    calls: list[str] = []
    computed = judge.Judge._judged

    def noted(self: judge.Judge, job: Any) -> Any:
        calls.append(f"{job.frame} {job.test}")
        return computed(self, job)

    monkeypatch.setattr(judge.Judge, "_judged", noted)
    return calls


def test_what_is_done_is_never_done_again(
    folders: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(folders)) == 0
    before = results(folders)
    calls = counted_calls(monkeypatch)
    assert "without results" in one_line(capsys, *arguments(folders))
    assert main(arguments(folders, "--resume")) == 0
    assert calls == []
    assert results(folders) == before
    lines = (folders / "out/journal.jsonl").read_bytes().count(b"\n")
    assert lines == 2 * FRAMES
    # Another content, another setting, and a file that is gone: each is done, and nothing else.
    write_image(folders / "a/002.exr", read_image(folders / "a/003.exr"))
    (folders / "out/maps/B/004.exr").unlink()
    os.utime(folders / "b/005.exr")
    assert main(arguments(folders, "--resume")) == 0
    assert calls == ["002 A", "004 B"]
    calls.clear()
    assert main(arguments(folders, "--resume", "--ppd", "59")) == 0
    assert len(calls) == 2 * FRAMES


def wait_for_lines(process: "subprocess.Popen[bytes]", path: Path, count: int) -> None:
    for _ in range(1200):
        if path.exists() and path.read_bytes().count(b"\n") >= count:
            return
        assert process.poll() is None
        time.sleep(0.05)
    raise AssertionError("no results in a minute")


@pytest.mark.parametrize(
    ("jobs", "ending", "status"),
    [
        (["--jobs=2"], signal.SIGINT, 130),
        (["--jobs=1"], signal.SIGKILL, -9),
        (["--jobs=2", "--scheduler=local"], signal.SIGINT, 130),
    ],
)
def test_what_is_done_outlives_an_end(
    folders: Path,
    jobs: list[str],
    ending: signal.Signals,
    status: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if "--scheduler=local" in jobs:
        pytest.importorskip("distributed")
    for number in range(FRAMES, 150):  # so that there is always something left to do
        for name in ("ref", "a", "b"):
            (folders / f"{name}/{number:03}.exr").symlink_to(folders / f"{name}/000.exr")
    command = [sys.executable, "-m", "torch_vdm", *arguments(folders, *jobs)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    lines = folders / "out/journal.jsonl"
    wait_for_lines(process, lines, 3)
    os.killpg(process.pid, ending)
    _, error = process.communicate(timeout=60)
    assert process.returncode == status
    assert b"Traceback" not in error
    if ending == signal.SIGINT:
        assert error.count(b"\n") == 2
        assert b"--resume goes on" in error
    with journal.Journal(folders / "out") as kept:
        known = list(kept)
    assert 3 <= len(known) < 300
    for path in folders.glob("*/*.exr"):
        if path.is_symlink():
            path.unlink()
    calls = counted_calls(monkeypatch)
    assert main(arguments(folders, "--resume")) == 0
    assert not {f"{frame} {test}" for frame, test in known} & set(calls)
    assert len(results(folders)["frames"]) == 2 * FRAMES


def test_flicker_needs_a_frame_before(folders: Path) -> None:
    (folders / "ref/003.exr").write_bytes(b"broken")
    assert main(arguments(folders, "--flicker")) == 0
    told = {(r["frame"], r["test"]): r for r in results(folders)["frames"]}
    assert "flicker_max_jnd" not in told["000", "A"]["figures"]
    assert told["002", "A"]["figures"]["flicker_max_jnd"] > 0.5
    assert "flicker_max_jnd" not in told["004", "A"]["figures"]
    assert any("no flicker" in note for note in told["004", "A"]["notes"])
    assert told["003", "A"]["skipped"]


def test_a_still_error_does_not_flicker(folders: Path) -> None:
    reference = read_image(folders / "ref/000.exr")
    for number in range(FRAMES):
        write_image(folders / f"ref/{number:03}.exr", reference)
        write_image(folders / f"a/{number:03}.exr", reference * 1.2)
    assert main(arguments(folders, "--flicker")) == 0
    told = {(r["frame"], r["test"]): r["figures"] for r in results(folders)["frames"]}
    assert told["005", "A"]["max_jnd"] > 1.0
    assert told["005", "A"]["flicker_max_jnd"] < 0.01


def test_a_manifest_and_files_of_any_kind(folders: Path) -> None:
    write_image(folders / "x.png", torch.rand(3, 2, 3))
    write_image(folders / "y.exr", torch.rand(3, 2, 3))
    (folders / "m.csv").write_text("frame,reference,test,path\n</script>,x.png,T,y.exr\n")
    command = ["evaluate", "--manifest", f"{folders}/m.csv", "--output", f"{folders}/out"]
    assert main([*command, "--tile", "16"]) == 0
    told = results(folders)["frames"][0]
    assert told["frame"] == "</script>"
    assert told["figures"]["max_jnd"] > 1.0
    page = (folders / "out/report.html").read_text()
    assert page.count("</script>") == 3


def test_names_are_text_in_the_page(folders: Path) -> None:
    (folders / "a").rename(folders / "a&<b>")
    command = ["evaluate", "--reference", f"{folders}/ref", "--output", f"{folders}/out"]
    assert main([*command, "--test", f"<i>&amp;={folders}/a&<b>"]) == 0
    page = (folders / "out/report.html").read_text()
    assert "<i>" not in page
    assert "<title>Visible differences: &lt;i&gt;&amp;amp;</title>" in page
    # D3 has the names of its site and of namespaces in it; the page asks for neither.
    assert "http" not in page.replace(D3.read_text(), "")


def test_the_library_in_the_page_is_the_one_that_was_released() -> None:
    """The file of the npm package d3 7.9.0, byte for byte, with its licence beside it."""
    released = "f2094bbf6141b359722c4fe454eb6c4b0f0e42cc10cc7af921fc158fceb86539"
    assert hashlib.sha256(D3.read_bytes()).hexdigest() == released
    assert "Mike Bostock" in D3.with_name("d3.LICENSE").read_text()


def test_parquet_holds_the_table(folders: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    (folders / "a/001.exr").unlink()
    assert main(arguments(folders, "--parquet")) == 0
    table = parquet.read_table(folders / "out/table.parquet").to_pydict()
    assert len(table["frame"]) == 2 * FRAMES
    assert table["max_jnd"][2] is None
    assert table["skipped"][2] == "missing in the test"


def test_bad_input_gets_one_line(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--output", f"{folders}/out"]
    one, two = f"--reference={folders}/ref", f"--test=A={folders}/a"
    assert "give what to compare" in one_line(capsys, "evaluate", *out, two)
    assert "give one of the two" in one_line(capsys, "evaluate", *out, one, two, "--manifest", "m")
    assert "different names" in one_line(capsys, "evaluate", *out, one, two, two)
    assert "expected a folder" in one_line(capsys, "evaluate", *out, "--reference=none", two)
    assert not (folders / "out").exists()
    (folders / "out").write_text("")
    assert "got a file" in one_line(capsys, "evaluate", *out, one, two)


def test_nothing_to_compare_is_bad_input(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (folders / "a").iterdir():
        path.write_bytes(b"no image")
    command = ["evaluate", f"--reference={folders}/ref", f"--test=A={folders}/a"]
    told = one_line(capsys, *command, "--output", f"{folders}/out", f"--junit={folders}/j.xml")
    assert f"nothing could be compared: {FRAMES} comparisons skipped" in told
    assert (folders / "j.xml").is_file()


@pytest.mark.parametrize(
    "option", [["--jobs", "0"], ["--jobs", "x"], ["--test", "dir"], ["--peers", "none"]]
)
def test_wrong_options_get_one_line(
    tmp_path: Path, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ending:
        main(["evaluate", "--reference", "r", "--output", str(tmp_path / "out"), *option])
    assert ending.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_peer_that_is_not_installed_is_told(
    folders: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert "pip install" in one_line(capsys, *arguments(folders, "--peers", "flip"))
    assert "pyarrow" in one_line(capsys, *arguments(folders, "--parquet"))
    assert "torch-vdm[cluster]" in one_line(capsys, *arguments(folders, "--scheduler", "local"))
