"""A cluster of Dask, of which workers die, and on which no more is put than it can do."""

import json
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
import torch

from torch_vdm import cluster, write_image
from torch_vdm.cli import main
from torch_vdm.cluster import ClusterError
from torch_vdm.evaluate import journal
from torch_vdm.evaluate.cluster import placed, results
from torch_vdm.evaluate.frames import Job
from torch_vdm.evaluate.journal import Journal, Result
from torch_vdm.evaluate.judge import Judge
from torch_vdm.io import ImageError

distributed = pytest.importorskip("distributed")


@dataclass
class Fragile:
    """Stands for a `Judge`: it dies of one frame, fails at another, and notes what it did."""

    output: Path
    dies_of: str = ""
    fails_at: str = ""
    error: type[Exception] = ImageError

    def __call__(self, job: Job, known: Result | None = None) -> Result:
        """Return a result, or not."""
        with (self.output / "done").open("a") as file:
            file.write(f"{job.frame} {os.getpid()}\n")
        if job.frame == self.dies_of:
            os._exit(9)
        if job.frame == self.fails_at:
            raise self.error("out: cannot be written: no space")
        return known or Result(frame=job.frame, test=job.test, key="k")


class Watched(Sequence[Job]):
    """Jobs that are made as they are asked for, and how many were."""

    def __init__(self, count: int) -> None:
        self.length, self.taken = count, 0

    def __len__(self) -> int:
        """Return how many there are."""
        return self.length

    def __getitem__(self, number: Any) -> Any:
        """Return one."""
        raise AssertionError

    def __iter__(self) -> Iterator[Job]:
        """Make them."""
        for number in range(self.length):
            self.taken += 1
            yield Job(str(number), "A", Path("r"), Path(f"{number}.exr"))


def jobs(count: int) -> list[Job]:
    return list(Watched(count))


def fragile(folder: Path, **more: Any) -> Judge:
    with Journal(folder):
        pass
    return cast(Judge, Fragile(folder, **more))


@pytest.fixture(scope="module")
def threads() -> Iterator[Any]:
    """Return a cluster whose two workers are threads of this process: it starts at once."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as started:
        yield started


def test_no_more_is_in_hand_than_the_cluster_can_do(
    tmp_path: Path, threads: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "FEWEST_IN_HAND", 12)
    made = Watched(600)
    judge, address = fragile(tmp_path), threads.scheduler_address
    most = most_held = 0
    found: set[str] = set()
    for result in results(judge, made, {}, address, None):
        assert result.frame not in found
        found.add(result.frame)
        # Whatever was taken and not yet given back: with the cluster, or on its way.
        most = max(most, made.taken - len(found))
        most_held = max(most_held, len(threads.scheduler.tasks))
    assert found == {str(number) for number in range(600)}
    assert 2 <= most <= 12
    assert most_held <= 2 * 12  # those that are done are forgotten, if a little later


def test_many_threads_have_more_in_hand(tmp_path: Path, threads: Any) -> None:
    made = Watched(600)
    coming = results(fragile(tmp_path), made, {}, threads.scheduler_address, None)
    next(coming)
    assert made.taken == cluster.FEWEST_IN_HAND
    coming.close()
    # What was not asked for any more is not done: the scheduler forgets it.
    for _ in range(200):
        if not threads.scheduler.tasks:
            return
        time.sleep(0.05)
    raise AssertionError(len(threads.scheduler.tasks))


def test_one_that_dies_takes_its_frame_alone(tmp_path: Path) -> None:
    judge = fragile(tmp_path, dies_of="2")
    known = {("3", "A"): Result(frame="3", test="A", key="known")}
    found = {each.frame: each for each in results(judge, jobs(7), known, "local", 1)}
    assert set(found) == {str(number) for number in range(7)}
    assert [frame for frame, each in found.items() if each.skipped] == ["2"]
    assert "2.exr: every worker that compared it died" in found["2"].skipped
    assert found["3"].key == "known"
    ids = {line.split()[1] for line in (tmp_path / "done").read_text().splitlines()}
    assert str(os.getpid()) not in ids
    assert len(ids) >= 2  # one died of it, then one that had nothing else


@pytest.mark.parametrize(
    ("error", "expected", "told"),
    [
        (ImageError, ImageError, "^out: cannot be written: no space$"),
        (RuntimeError, ClusterError, "3 of A: a worker failed, RuntimeError: out: cannot"),
    ],
)
def test_what_fails_ends_all_in_one_line(
    tmp_path: Path, threads: Any, error: type[Exception], expected: type[Exception], told: str
) -> None:
    judge = fragile(tmp_path, fails_at="3", error=error)
    with pytest.raises(expected, match=told):
        list(results(judge, jobs(7), {}, threads.scheduler_address, None))


def test_workers_that_differ_are_refused(tmp_path: Path, threads: Any) -> None:
    judge = fragile(tmp_path)
    (tmp_path / journal.NAME).unlink()  # as on a machine that does not see the folder
    with pytest.raises(ClusterError, match="name one on a shared file system"):
        list(results(judge, jobs(2), {}, threads.scheduler_address, None))
    other = cluster.Work("0.0", tmp_path, b"")
    with pytest.raises(ClusterError, match=r"expected torch-vdm 0\.0 on every worker, got"):
        cluster._done(other, jobs(1)[0], None)


def killed_after(worker: Any, lines: Path, count: int) -> None:
    """Kill a worker when a journal has so many lines."""
    for _ in range(1200):
        if lines.exists() and lines.read_bytes().count(b"\n") >= count:
            os.kill(worker.pid, signal.SIGKILL)
            return
        time.sleep(0.02)


def test_a_worker_that_is_killed_loses_and_doubles_nothing(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(1)
    for folder in ("ref", "a"):
        (tmp_path / folder).mkdir()
        for number in range(80):
            image = 0.2 + 0.6 * torch.rand(3, 16, 16, generator=generator)
            write_image(tmp_path / f"{folder}/{number:03}.exr", image)
    command = ["evaluate", f"--reference={tmp_path}/ref", f"--test=A={tmp_path}/a"]
    assert main([*command, f"--output={tmp_path}/alone"]) == 0
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as started:
        lines = tmp_path / "out" / journal.NAME
        victim = started.workers[0]
        before = victim.pid
        killer = threading.Thread(target=killed_after, args=(victim, lines, 5))
        killer.start()
        address = started.scheduler_address
        assert main([*command, f"--output={tmp_path}/out", f"--scheduler={address}"]) == 0
        killer.join()
        assert victim.pid != before
    names = [(json.loads(line)["frame"]) for line in lines.read_bytes().splitlines()]
    assert sorted(names) == [f"{number:03}" for number in range(80)]

    def told(folder: str) -> list[dict[str, Any]]:
        found = json.loads((tmp_path / folder / "results.json").read_text())["frames"]
        return [{name: each[name] for name in each if name != "seconds"} for each in found]

    # The same figures and files as of one process, to the last bit.
    assert told("out") == told("alone")
    for path in (tmp_path / "alone").glob("*/**/*"):
        other = tmp_path / "out" / path.relative_to(tmp_path / "alone")
        assert path.is_dir() or path.read_bytes() == other.read_bytes()


def test_jobs_and_a_cluster_of_its_own_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", "--reference=r", "--test=A=a", f"--output={tmp_path}/out"]
    assert main([*command, "--scheduler", "tcp://127.0.0.1:9", "--jobs", "2"]) == 2
    assert "leave --jobs out" in capsys.readouterr().err


def test_paths_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    job = placed(Job("1", "A", Path("r.exr"), Path("t.exr"), (Path("a"), Path("b"))))
    assert (job.reference, job.path) == (tmp_path / "r.exr", tmp_path / "t.exr")
    assert job.before == (tmp_path / "a", tmp_path / "b")


def test_a_scheduler_that_is_lost_is_told(tmp_path: Path) -> None:
    made = Watched(100000)
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0",
            silence_logs=50,
        ) as started,
        distributed.Client(started, set_as_default=False) as administrator,
    ):  # fmt: skip
        coming = results(fragile(tmp_path), made, {}, started.scheduler_address, None)
        next(coming)
        threading.Timer(0.3, administrator.shutdown).start()
        with pytest.raises(ClusterError, match="the scheduler was lost"):
            list(coming)
    assert made.taken < len(made)


@pytest.mark.parametrize(
    ("where", "told"),
    [
        ("tcp://127.0.0.1:9", "no scheduler answers: Timed out"),
        ("http://127.0.0.1:9", "no scheduler answers: unknown address scheme"),
        ("none.json", "no such file"),
        ("bad.json", "no scheduler answers"),
    ],
)
def test_a_scheduler_that_does_not_answer_is_told(tmp_path: Path, where: str, told: str) -> None:
    dask = pytest.importorskip("dask")
    (tmp_path / "bad.json").write_text("{")
    place = where if "://" in where else str(tmp_path / where)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(ClusterError, match=told) as error,
    ):
        list(results(fragile(tmp_path), jobs(1), {}, place, None))
    assert "\n" not in str(error.value)
