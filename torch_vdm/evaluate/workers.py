"""Jobs run by several processes, any of which may die."""

from collections.abc import Generator, Mapping, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import NamedTuple

import torch

from torch_vdm.cluster import no_interrupts
from torch_vdm.evaluate.frames import Job
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.judge import Judge
from torch_vdm.io.refusal import printable

Known = Mapping[tuple[str, str], Result]


class _Hand(NamedTuple):
    """A process, and the job it was given."""

    process: SpawnProcess
    job: Job


def results(
    judge: Judge, jobs: Sequence[Job], known: Known, count: int
) -> Generator[Result, None, None]:
    """Yield the results of jobs as they come.

    Parameters
    ----------
    judge
        Does a job; it is sent to each process.
    jobs
        The jobs.
    known
        Results of an earlier run, which are kept where files and settings are the same.
    count
        Number of processes; 1 works in this one. They share its threads. If one dies, its job is
        reported as skipped, and another takes its place.

    Raises
    ------
    Exception
        What ``judge`` raises, as it comes.
    """
    if count == 1 or len(jobs) < 2:
        for job in jobs:
            yield judge(job, known.get((job.frame, job.test)))
        return
    count = min(count, len(jobs))
    threads = max(1, torch.get_num_threads() // count)
    waiting = iter(jobs)
    hands: dict[Connection, _Hand] = {}
    try:
        for _, job in zip(range(count), waiting, strict=False):
            _start(hands, judge, threads, job, known)
        while hands:
            for connection in wait(list(hands)):
                assert isinstance(connection, Connection)
                hand = hands.pop(connection)
                try:
                    answer = connection.recv()
                except (EOFError, OSError):
                    yield _died(connection, hand)
                    following = next(waiting, None)
                    if following:
                        _start(hands, judge, threads, following, known)
                    continue
                following = next(waiting, None)
                if following:
                    hands[connection] = _Hand(hand.process, following)
                    _give(connection, following, known)
                else:
                    _end(connection, hand)
                if isinstance(answer, Exception):
                    raise answer
                yield answer
    finally:
        for connection, hand in hands.items():
            _end(connection, hand)


def _start(
    hands: dict[Connection, _Hand], judge: Judge, threads: int, job: Job, known: Known
) -> None:
    """Start a process on a job."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, judge, threads), daemon=True)
    with no_interrupts():
        process.start()
    theirs.close()
    hands[ours] = _Hand(process, job)
    _give(ours, job, known)


def _give(connection: Connection, job: Job, known: Known) -> None:
    # A process that died is noticed where its answer is awaited.
    with suppress(BrokenPipeError, ConnectionResetError):
        connection.send((job, known.get((job.frame, job.test))))


def _end(connection: Connection, hand: _Hand) -> None:
    """End a process whose work is done, and close it: by itself it would take half a second."""
    connection.close()
    hand.process.terminate()
    hand.process.join()
    hand.process.close()


def _died(connection: Connection, hand: _Hand) -> Result:
    """Return the result of a job whose process died."""
    hand.process.join()
    why = (
        f"{hand.job.path}: the process that compared it died (exit code {hand.process.exitcode}); "
        "give it more memory, or use fewer --jobs"
    )
    _end(connection, hand)
    return Result(frame=hand.job.frame, test=hand.job.test, skipped=printable(why))


def _work(connection: Connection, judge: Judge, threads: int) -> None:
    """Do jobs until there are no more, or nobody takes the results."""
    torch.set_num_threads(threads)
    while True:
        try:
            job, known = connection.recv()
        except (EOFError, OSError):
            return
        answer: Result | Exception
        try:
            answer = judge(job, known)
        except Exception as error:  # the other process raises it
            answer = error
        try:
            connection.send(answer)
        except (BrokenPipeError, ConnectionResetError):
            return
