"""Jobs worked through by a cluster of Dask, on this machine or on many; workers may go at any time.

Imported where ``--scheduler`` is given: it needs Dask's ``distributed``.
"""

import logging
import pickle
import sys
import threading
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import distributed

from torch_vdm import __version__
from torch_vdm.evaluate import journal
from torch_vdm.evaluate.frames import EvaluationError, Job
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.judge import Judge
from torch_vdm.evaluate.workers import Known, no_interrupts
from torch_vdm.io import ImageError
from torch_vdm.io.refusal import printable

# What ``--scheduler`` is given for workers on this machine.
LOCAL = "local"

# Jobs that the scheduler has at once: at least so many, so that a cluster that scales by what waits
# sees that there is work, and so many for each thread, so that none waits for this process. About
# 10 kB each are held for them. Status: choice.
FEWEST_IN_HAND, IN_HAND_PER_THREAD = 256, 4

# Seconds for which the number of threads of the cluster is believed. Status: choice.
BELIEVED = 5.0


class Sent(NamedTuple):
    """A judge on its way to workers.

    Attributes
    ----------
    version
        Of this package, which a worker must have too.
    output
        The output folder, which a worker must see too.
    judge
        Pickled: a worker unpickles it once, and its metrics are then made once.
    """

    version: str
    output: Path
    judge: bytes


def results(
    judge: Judge, jobs: Sequence[Job], known: Known, scheduler: str, count: int | None
) -> Generator[Result, None, None]:
    """Yield the results of jobs as they come, each once.

    A job whose worker goes away is done by another one. Workers that die several times over are
    blamed on the jobs that they had: these are then done one at a time, and one that still has its
    workers die is told as skipped. A job that is done twice writes the same files again.

    Parameters
    ----------
    judge
        What does a job.
    jobs
        What to do; they are taken as there is room, and not held.
    known
        Results of an earlier run, which stand where files and settings are the same.
    scheduler
        The address of a scheduler, a scheduler file, or `LOCAL`.
    count
        Number of workers of `LOCAL`, of one thread each; None for one a processor.

    Raises
    ------
    EvaluationError
        If the scheduler does not answer, or is lost, or if a worker has another version or does not
        see the output folder.
    ImageError
        If the output cannot be written.
    """
    sent = Sent(__version__, judge.output.absolute(), _packed(judge))
    with _client(scheduler, count, len(jobs)) as client:
        hands = _Hands(client, sent, known)
        suspects: list[Job] = []
        waiting = iter(jobs)
        while hands.take(waiting):
            for job, result in hands.done():
                if result is None:
                    suspects.append(job)
                else:
                    yield result
        # Alone, so that a worker's death is nobody else's doing.
        for job in suspects:
            hands.take(iter((job,)))
            for _, result in hands.done():
                yield result or _died(job)


class _Hands:
    """Jobs that the cluster has, never more than it can soon do."""

    def __init__(self, client: distributed.Client, sent: Sent, known: Known) -> None:
        self._client, self._sent, self._known = client, sent, known
        self._jobs: dict[distributed.Future[Any], Job] = {}
        self._coming: Any = distributed.as_completed(
            loop=client.loop, with_results=True, raise_errors=False
        )
        self._most, self._asked = 0, -BELIEVED

    def take(self, waiting: Iterator[Job]) -> bool:
        """Hand out jobs while there is room; say whether any are in hand."""
        for job in islice(waiting, max(0, self._room() - len(self._jobs))):
            known = self._known.get((job.frame, job.test))
            try:
                future = self._client.submit(_judged, self._sent, _placed(job), known, pure=False)
            except Exception as error:  # a connection breaks in many ways
                raise _lost() from error
            self._jobs[future] = job
            self._coming.add(future)
        return bool(self._jobs)

    def done(self) -> Iterator[tuple[Job, Result | None]]:
        """Wait for results; yield them with their jobs, None for one whose workers died."""
        for future, answer in self._coming.next_batch():
            job = self._jobs.pop(future)
            if future.status == "finished":
                yield job, answer
            elif future.status == "error":
                _check_died(answer[1], job)
                yield job, None
            else:
                raise _lost()

    def _room(self) -> int:
        now = time.monotonic()
        if now - self._asked > BELIEVED:
            try:
                threads = sum(self._client.nthreads().values())
            except Exception as error:  # a connection breaks in many ways
                raise _lost() from error
            self._most = max(FEWEST_IN_HAND, IN_HAND_PER_THREAD * threads)
            self._asked = now
        return self._most


def _check_died(error: BaseException, job: Job) -> None:
    """Raise what ended a job, unless it was its workers' death."""
    if isinstance(error, distributed.KilledWorker):
        return
    if isinstance(error, EvaluationError | ImageError):
        raise error
    text = " ".join(str(error).split())
    raise EvaluationError(
        f"{job.frame} of {job.test}: a worker failed, {type(error).__name__}: {text}; expected "
        f"torch-vdm {__version__} and what it needs on every worker"
    ) from error


def _died(job: Job) -> Result:
    why = f"{job.path}: every worker that compared it died; give the workers more memory"
    return Result(frame=job.frame, test=job.test, skipped=printable(why))


def _lost() -> EvaluationError:
    return EvaluationError(
        "the scheduler was lost; what is done is kept, start it again and go on with --resume"
    )


def _packed(judge: Judge) -> bytes:
    """Return a judge as a worker is to have it, whatever folder that is started in."""
    return pickle.dumps(replace(judge, output=judge.output.absolute()))


def _placed(job: Job) -> Job:
    """Return a job whose files are found from any folder."""
    before = job.before and (job.before[0].absolute(), job.before[1].absolute())
    return replace(job, reference=job.reference.absolute(), path=job.path.absolute(), before=before)


# The judge that a thread of a worker has: it keeps metrics, which two threads must not share.
_here = threading.local()


def _judged(sent: Sent, job: Job, known: Result | None) -> Result:
    """Do a job on a worker."""
    if getattr(_here, "sent", None) != sent:
        if sent.version != __version__:
            raise EvaluationError(
                f"expected torch-vdm {sent.version} on every worker, got {__version__}; install "
                "the same version"
            )
        if not (sent.output / journal.NAME).is_file():
            raise EvaluationError(
                f"{sent.output}: expected a folder that every worker sees, got one that a worker "
                "lacks; name one on a shared file system"
            )
        _here.judge, _here.sent = pickle.loads(sent.judge), sent
    result: Result = _here.judge(job, known)
    return result


@contextmanager
def _client(
    scheduler: str, count: int | None, jobs: int
) -> Generator[distributed.Client, None, None]:
    """Connect to a scheduler, or start one with workers on this machine."""
    with ExitStack() as stack:
        # What ends a run is said in one line, and that workers come and go is no news.
        stack.enter_context(_quiet())
        if scheduler == LOCAL:
            with no_interrupts():
                cluster = distributed.LocalCluster(
                    n_workers=count and max(1, min(count, jobs)),
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",  # any free port: several may run
                    # The machine's memory is the limit, as it is for processes without a cluster.
                    memory_limit=0,
                    # Nobody takes these workers away: one that dies has died of what it did.
                    scheduler_kwargs={"allowed_failures": 0},
                    silence_logs=logging.CRITICAL,
                )
            stack.enter_context(cluster)
            # Dask gives up a worker that dies twice within moments; this brings it back.
            workers = len(cluster.workers)
            cluster.adapt(minimum=workers, maximum=workers)
            yield stack.enter_context(distributed.Client(cluster, set_as_default=False))
            return
        where = {"address": scheduler} if "://" in scheduler else {"scheduler_file": scheduler}
        if "scheduler_file" in where and not Path(scheduler).is_file():
            raise EvaluationError(
                f"--scheduler {scheduler}: expected an address such as tcp://host:8786, a "
                f"scheduler file, or {LOCAL}; got no such file"
            )
        try:
            client = distributed.Client(**where, set_as_default=False)
        except Exception as error:  # an address or a file may be wrong in many ways
            text = " ".join(str(error).split()) or type(error).__name__
            raise EvaluationError(
                f"--scheduler {scheduler}: no scheduler answers: {text}; start one with "
                "'dask scheduler'"
            ) from error
        stack.enter_context(client)
        if not client.nthreads():
            print(f"{scheduler} has no workers yet; waiting for one", file=sys.stderr)
        yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's log off the terminal."""
    handlers = {
        handler: handler.level
        for name in ("distributed", "distributed.client")
        for handler in logging.getLogger(name).handlers
    }
    for handler in handlers:
        handler.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for handler, level in handlers.items():
            handler.setLevel(level)
