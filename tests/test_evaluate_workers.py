"""Several processes, one of which dies."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest

from torch_vdm.evaluate.frames import Job
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.judge import Judge
from torch_vdm.evaluate.workers import results
from torch_vdm.io import ImageError


@dataclass
class Fragile:
    """Stands for a `Judge`: it dies of one frame, and cannot write another."""

    dies_of: str
    fails_at: str

    def __call__(self, job: Job, known: Result | None = None) -> Result:
        """Return a result, or not."""
        if job.frame == self.dies_of:
            os._exit(9)
        if job.frame == "3":
            time.sleep(0.5)  # until it is seen that another died
        if job.frame == self.fails_at:
            raise ImageError("out: cannot be written: no space")
        return known or Result(frame=job.frame, test=job.test, key=str(os.getpid()))


def jobs(count: int) -> list[Job]:
    return [Job(str(number), "A", Path("r"), Path(f"{number}.exr")) for number in range(count)]


def test_one_that_dies_takes_its_frame_alone_and_output_that_fails_ends_all() -> None:
    judge = cast(Judge, Fragile(dies_of="2", fails_at="6"))
    found: dict[str, Result] = {}
    coming = results(judge, jobs(7), {}, 2)
    while "2" not in found:
        result = next(coming)
        found[result.frame] = result
    assert [frame for frame, each in found.items() if each.skipped] == ["2"]
    assert "2.exr: the process that compared it died (exit code 9)" in found["2"].skipped
    assert str(os.getpid()) not in {each.key for each in found.values()}
    with pytest.raises(ImageError, match="no space"):
        list(coming)


def test_one_job_is_done_here() -> None:
    judge = cast(Judge, Fragile(dies_of="", fails_at=""))
    assert {each.key for each in results(judge, jobs(3), {}, 1)} == {str(os.getpid())}
    assert [each.key for each in results(judge, jobs(1), {}, 5)] == [str(os.getpid())]
    known = Result(frame="1", test="A", key="known")
    assert list(results(judge, jobs(2), {("1", "A"): known}, 1))[1] is known
