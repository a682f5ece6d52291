"""Jobs run by a Dask cluster."""

from collections.abc import Generator, Sequence
from dataclasses import replace

from torch_vdm import cluster
from torch_vdm.evaluate import journal
from torch_vdm.evaluate.frames import Job
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.judge import Judge
from torch_vdm.evaluate.workers import Known
from torch_vdm.io.refusal import printable


def results(
    judge: Judge, jobs: Sequence[Job], known: Known, scheduler: str, count: int | None
) -> Generator[Result, None, None]:
    """Yield the results of jobs as they come, each once.

    A job whose workers all die is reported as skipped. A job that is done twice writes the same
    files again.

    Parameters
    ----------
    judge
        Does a job.
    jobs
        The jobs; they are taken as there is room, and not kept.
    known
        Results of an earlier run, which are kept where files and settings are the same.
    scheduler, count
        See `torch_vdm.cluster.answers`, which also says what is raised.
    """
    output = judge.output.absolute()  # valid in whatever folder a worker is started
    sent = cluster.work(replace(judge, output=output), output / journal.NAME)

    def told(job: Job) -> tuple[Job, Result | None]:
        return placed(job), known.get((job.frame, job.test))

    most = count and max(1, min(count, len(jobs)))
    for job, result in cluster.answers(sent, jobs, told, scheduler, most):
        yield result or _died(job)


def _died(job: Job) -> Result:
    why = f"{job.path}: every worker that compared it died; give the workers more memory"
    return Result(frame=job.frame, test=job.test, skipped=printable(why))


def placed(job: Job) -> Job:
    """Return a job whose files are found from any folder."""
    before = job.before and (job.before[0].absolute(), job.before[1].absolute())
    return replace(job, reference=job.reference.absolute(), path=job.path.absolute(), before=before)
