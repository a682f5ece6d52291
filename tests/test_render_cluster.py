"""``vdm-render`` of many pictures on a cluster of Dask, of which a worker dies."""

import argparse
import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sampling import checkpoint, cluster
from sampling.checkpoint import Checkpoint, CheckpointError
from sampling.cli import main
from sampling.renderers.mitsuba import MitsubaRenderer
from tests.conftest import one_line_error
from tests.test_render_cli import same_image
from torch_vdm.io import atomic_path

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.usefixtures("mitsuba")

# A lamp over a floor, which a frame's number moves.
SCENE = """<scene version="3.0.0">
<default name="frame" value="0"/><default name="depth" value="3"/>
<integrator type="path"><integer name="max_depth" value="$depth"/></integrator>
<sensor type="perspective"><transform name="to_world"><lookat origin="0, 3, -4" target="0, 0, 0"
up="0, 1, 0"/></transform><film type="hdrfilm"><integer name="width" value="12"/>
<integer name="height" value="8"/></film></sensor>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
</transform></shape>
<shape type="sphere"><point name="center" x="$frame" y="1" z="0"/><float name="radius" value="0.3"/>
<emitter type="area"><rgb name="radiance" value="4"/></emitter></shape></scene>"""

OPTIONS = ("--tolerance", "1.5", "--seed", "3")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "lamp.xml").write_text(SCENE)
    return tmp_path / "lamp.xml"


@pytest.fixture(scope="module")
def threads() -> Iterator[str]:
    """Return the address of a cluster whose worker is a thread of this process."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as started:
        yield started.scheduler_address


def killed_after(worker: Any, pattern: Path) -> None:
    """Kill a worker when there is a file of a pattern."""
    for _ in range(6000):
        if list(pattern.parent.glob(pattern.name)):
            os.kill(worker.pid, signal.SIGKILL)
            return
        time.sleep(0.005)


def test_a_worker_that_is_killed_loses_nothing(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as started:
        victim = started.workers[0]
        before = victim.pid
        killer = threading.Thread(target=killed_after, args=(victim, out / "*.exr"))
        killer.start()
        words = [str(scene), *OPTIONS, "--frames", "0-11", "--output", str(out)]
        assert main([*words, "--scheduler", started.scheduler_address]) == 0
        killer.join()
        assert victim.pid != before
    names = [f"lamp.{number:04}" for number in range(12)]
    wanted = {*(f"{name}.exr" for name in names), *(f"{name}.json" for name in names)}
    assert {path.name for path in out.iterdir()} == wanted | {"vdm-render.run"}
    # The one that was killed may have written its last picture, and not said so.
    said = re.match(r"(\d+) rendered, (\d+) done before, 0 failed", capsys.readouterr().out)
    assert said is not None
    assert (int(said[1]) + int(said[2]), int(said[2]) <= 1) == (12, True)
    for number in (0, 5, 11):
        alone = tmp_path / "alone.exr"
        words = [str(scene), *OPTIONS, "-D", f"frame={number}", "--output", str(alone)]
        assert main(words) == 0
        same_image(out / f"lamp.{number:04}.exr", alone)


def test_what_is_done_stands_and_what_changed_is_done_again(
    scene: Path, tmp_path: Path, threads: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    other = tmp_path / "other.xml"
    other.write_text(SCENE.replace('value="4"/></emitter', 'value="2"/></emitter'))
    words = [str(scene), str(other), *OPTIONS, "--output", str(out), "--scheduler", threads]
    assert main(words) == 0

    def times() -> list[int]:
        return [(out / f"{name}.exr").stat().st_mtime_ns for name in ("lamp", "other")]

    before = times()
    capsys.readouterr()
    assert main(words) == 2
    assert (
        "expected a folder without pictures, got one with vdm-render.run" in capsys.readouterr().err
    )
    moved = out.rename(tmp_path / "moved")
    words[words.index(str(out))] = str(moved)
    out = moved
    # A worker that dies after its record leaves the checkpoint; one that dies while it writes, what
    # it wrote. Another's files stay.
    left = [out / "lamp.checkpoint", out / ".lamp.checkpoint.partial"]
    for name in ("lamp.exr", "lamp.json"):
        with atomic_path(out / name) as temporary:
            shutil.copy2(out / name, temporary)
            left.append(temporary)
    others = [out / ".0123456789abcdef.exr", out / ".note"]
    for path in (*left, *others):
        path.write_bytes(b"")
    assert main([*words, "--resume", "--json", "-"]) == 0
    assert not any(path.exists() for path in left)
    assert all(path.exists() for path in others)
    told = json.loads(capsys.readouterr().out)
    assert [[Path(view["scene"]).name for view in views] for views in told] == [
        ["lamp.xml"],
        ["other.xml"],
    ]
    assert times() == before
    # Another scene, another setting, a picture that is gone.
    other.write_text(SCENE)
    assert main([*words, "--resume"]) == 0
    assert "1 rendered, 1 done before, 0 failed" in capsys.readouterr().out
    same_image(out / "lamp.exr", out / "other.exr")
    assert main([*words, "--resume", "-D", "depth=2"]) == 0
    assert "2 rendered, 0 done before, 0 failed" in capsys.readouterr().out
    (out / "lamp.exr").unlink()
    assert main([*words, "--resume", "-D", "depth=2"]) == 0
    assert "1 rendered, 1 done before, 0 failed" in capsys.readouterr().out


def test_a_record_does_not_outlive_its_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A picture of other settings is written over: killed then, the record would stand for it.
    options = argparse.Namespace(
        output=tmp_path / "a.exr", checkpoint=tmp_path / "a.checkpoint", sensor=None
    )
    record = tmp_path / "a.json"
    record.write_text("{}")
    monkeypatch.setattr(cluster, "_known", lambda *_: None)

    def killed(_: argparse.Namespace) -> Any:
        assert not record.exists()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cluster._rendered(killed, options)


def test_one_that_cannot_be_rendered_takes_no_other_with_it(
    scene: Path, tmp_path: Path, threads: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.xml").write_text("<scene")
    out = tmp_path / "out"
    words = [str(tmp_path / "bad.xml"), str(scene), "--output", str(out), "--scheduler", threads]
    assert main([*words, *OPTIONS, "--json", str(tmp_path / "all.json")]) == 2
    told = capsys.readouterr()
    assert "1 rendered, 0 done before, 1 failed" in told.out
    assert told.err.startswith(f"vdm-render: {tmp_path}/bad.xml: ")
    assert told.err.count("\n") == 1
    assert (out / "lamp.exr").is_file()
    views = json.loads((tmp_path / "all.json").read_text())
    assert list(views[0][0]) == ["scene", "failed"]
    assert views[1][0]["stop_reason"] == "tolerance"


def test_a_checkpoint_is_gone_on_from_where_it_is_of_this_run(
    scene: Path, tmp_path: Path, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    kept = out / "lamp.checkpoint"
    alone = [str(scene), "--output", str(tmp_path / "alone.exr"), "--checkpoint", str(kept)]
    assert main([*alone, "--max-spp", "16", "--seed", "9"]) == 0
    words = [str(scene), *OPTIONS, "--output", str(out), "--scheduler", threads]
    assert main(words) == 0
    assert not kept.exists()
    assert main([*alone, *OPTIONS]) == 0
    same_image(out / "lamp.exr", tmp_path / "alone.exr")
    assert kept.exists()
    (out / "lamp.exr").unlink()

    def drawn(*_: Any) -> None:
        raise AssertionError

    monkeypatch.setattr(MitsubaRenderer, "sample", drawn)
    assert main([*words, "--resume"]) == 0
    assert not kept.exists()
    same_image(out / "lamp.exr", tmp_path / "alone.exr")


def test_a_full_disk_at_the_last_checkpoint_costs_no_picture(
    scene: Path,
    tmp_path: Path,
    threads: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    kept = out / "lamp.checkpoint"
    # A worker has begun it, and its checkpoint is gone on from.
    alone = [str(scene), "--output", str(tmp_path / "alone.exr"), "--checkpoint", str(kept)]
    assert main([*alone, *OPTIONS]) == 0
    times = []

    def full(path: Path, _: Checkpoint) -> None:
        times.append(path)
        raise CheckpointError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(checkpoint, "save", full)
    words = [str(scene), *OPTIONS, "--output", str(out), "--scheduler", threads]
    capsys.readouterr()
    assert main(words) == 0
    told = capsys.readouterr()
    assert len(times) == 1
    assert "warning" in told.err
    assert "No space left on device; the picture is not affected" in told.err
    assert "1 rendered, 0 done before, 0 failed" in told.out
    same_image(out / "lamp.exr", tmp_path / "alone.exr")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--frames", "5-1"), "expected FIRST-LAST, such as 1-240, got '5-1'"),
        (("--frames", "1-2", "-D", "frame=3"), "expected --frames or -D frame"),
        (("--jobs", "0"), "expected a number of workers, got '0'"),
        (("--jobs", "2", "--scheduler", "tcp://127.0.0.1:9"), "leave --jobs out"),
        (("--jobs", "2", "--checkpoint", "x"), "expected no --checkpoint with many pictures"),
        (("--unbiased", "lamp.xml"), "expected scenes of different names"),
        (("--jobs", "2", "--json", "none/x.json"), "expected the folder to exist"),
        (("--scheduler", "none.json"), "got no such file"),
    ],
)
def test_options_that_do_not_fit_get_one_line(
    scene: Path,
    tmp_path: Path,
    words: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in one_line_error(main, capsys, "--output", "out", *words, scene.name)
