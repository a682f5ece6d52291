"""Checkpoints: what is continued is the same run, and nothing else is continued."""

import contextlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sampling import Sampler, Settings, checkpoint
from sampling.checkpoint import WORDS, Checkpoint, CheckpointError
from sampling.renderers.synthetic import Synthetic
from torch_vdm import VDM, Display

METRIC = VDM(30.0, Display.linear(100.0))
SETTINGS = Settings(tolerance=3.0, pilot=8, max_spp=64)
IDENTITY: dict[str, Any] = {name: f"a {name}" for name in WORDS} | {
    "scene": "abc",
    "tolerance": 3.0,
}


def scene() -> Synthetic:
    """Return a scene of 12 x 9 pixels with rare events."""
    rng = np.random.default_rng(3)
    base = rng.uniform(0.1, 0.5, (9, 12, 3))
    return Synthetic(base, 0.5 * base, rng.uniform(0.05, 0.5, (9, 12)))


def planes(sampler: Sampler) -> list[NDArray[Any]]:
    """Return what a run gives."""
    report = sampler.report()
    assert report is not None
    return [sampler.image, sampler.count, sampler.variance, report.jnd]


def test_a_run_that_is_killed_after_every_part_ends_the_same(tmp_path: Path) -> None:
    renderer, path = scene(), tmp_path / "run.checkpoint"
    whole = Sampler(renderer.size, METRIC, SETTINGS)
    while (request := whole.ask()) is not None:
        whole.tell(renderer.sample(request.pixels, request.first, request.count))
    killed = Sampler(renderer.size, METRIC, SETTINGS)
    parts = 0
    while (request := killed.ask()) is not None:
        part = next(request.parts(700))
        killed.tell(renderer.sample(part.pixels, part.first, part.count))
        checkpoint.save(path, Checkpoint(IDENTITY, killed.state()))
        killed = Sampler.restore(checkpoint.load(path, IDENTITY), METRIC)
        parts += 1
    assert parts > 5
    for ours, wanted in zip(planes(killed), planes(whole), strict=True):
        np.testing.assert_array_equal(ours, wanted)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_values_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "run"
    state: dict[str, Any] = {
        "file": np.array([0.1, -0.0, np.inf, 1e-320]),
        "whole": np.array([[2**62]]),
        "number": 0.1 + 0.2,
        "large": 2**60,
        "nothing": None,
        "switch": True,
        "word": "größe",
    }
    checkpoint.save(path, Checkpoint(IDENTITY, state))
    loaded = checkpoint.load(path, IDENTITY)
    assert set(loaded) == set(state)
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            assert loaded[name].dtype == value.dtype
            assert loaded[name].tobytes() == value.tobytes()
        else:
            assert loaded[name] == value
            assert type(loaded[name]) is type(value)


@pytest.mark.parametrize("name", WORDS)
def test_another_run_is_refused_by_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / "run"
    checkpoint.save(path, Checkpoint(IDENTITY, {}))
    with pytest.raises(CheckpointError, match=re.escape(f"begun with {WORDS[name]} ")):
        checkpoint.load(path, IDENTITY | {name: "another"})


def test_another_scene_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run"
    checkpoint.save(path, Checkpoint(IDENTITY, {}))
    with pytest.raises(CheckpointError, match="another scene"):
        checkpoint.load(path, IDENTITY | {"scene": "abd"})


def test_damaged_and_foreign_files_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "run"
    checkpoint.save(path, Checkpoint(IDENTITY, {"a": np.arange(50.0)}))
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for size in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(CheckpointError, match="run: "):
            checkpoint.load(path, IDENTITY)
    for _ in range(200):  # the sum of every entry is checked
        noisy = bytearray(whole)
        noisy[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
        path.write_bytes(noisy)
        with contextlib.suppress(CheckpointError):
            loaded = checkpoint.load(path, IDENTITY)
            np.testing.assert_array_equal(loaded["a"], np.arange(50.0))
    for foreign in (b"P6 1 1 255 abc", np.array([{}], object).dumps()):
        path.write_bytes(foreign)
        with pytest.raises(CheckpointError, match="damaged or another file"):
            checkpoint.load(path, IDENTITY)
    with path.open("wb") as file:
        np.savez(file, header=np.array("{}"))
    with pytest.raises(CheckpointError, match="damaged or another file"):
        checkpoint.load(path, IDENTITY)
    with pytest.raises(CheckpointError, match="no such file"):
        checkpoint.load(tmp_path / "none", IDENTITY)


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "run"
    checkpoint.save(path, Checkpoint(IDENTITY, {"a": 1}))
    (tmp_path / ".run.partial").mkdir()
    with pytest.raises(CheckpointError, match="cannot be written"):
        checkpoint.save(path, Checkpoint(IDENTITY, {"a": 2}))
    assert checkpoint.load(path, IDENTITY)["a"] == 1


def test_a_link_in_the_way_is_not_written_through(tmp_path: Path) -> None:
    path, other = tmp_path / "run", tmp_path / "other"
    other.write_text("kept")
    (tmp_path / ".run.partial").symlink_to(other)
    checkpoint.save(path, Checkpoint(IDENTITY, {"a": 1}))
    assert other.read_text() == "kept"
    assert checkpoint.load(path, IDENTITY)["a"] == 1
