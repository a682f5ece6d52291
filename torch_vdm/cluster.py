"""Work shared by a Dask cluster, on this machine or on many; workers may leave at any time.

It needs Dask's ``distributed``, which is imported when work begins.
"""

import importlib.util
import logging
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from torch_vdm import __version__
from torch_vdm.io import ImageError
from torch_vdm.io.refusal import printable

if TYPE_CHECKING:
    import distributed

# The value of ``--scheduler`` for workers on this machine.
LOCAL = "local"

# How Dask is installed.
EXTRA = "pip install 'torch-vdm[cluster]'"

# Units that the scheduler has at once: at least so many, so that a cluster that scales with its
# queue sees that there is work, and so many for each thread, so that none waits for this process.
# Each takes about 10 kB. Status: choice.
FEWEST_IN_HAND, IN_HAND_PER_THREAD = 256, 4

# Seconds for which the cluster's number of threads is taken as unchanged. Status: choice.
BELIEVED = 5.0

Unit = TypeVar("Unit", bound=Hashable)


class ClusterError(ValueError):
    """A cluster that cannot be used, or that was lost; one line."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class Work(NamedTuple):
    """What is sent to workers.

    Attributes
    ----------
    version
        The version of this package, which a worker must have too.
    shared
        A file in the output folder, which a worker must see too.
    function
        The function that does a unit, pickled: each of a worker's threads unpickles it once, so
        what it keeps is made once for each thread.
    """

    version: str
    shared: Path
    function: bytes


def check(scheduler: str, count: int | None) -> None:
    """Refuse, before anything is done, a missing scheduler, or a worker count for a given cluster.

    Raises
    ------
    ClusterError
        If Dask is not installed, or a number of workers is given that is not ours to choose.
    """
    if count and scheduler != LOCAL:
        raise ClusterError(
            "expected --jobs or the --scheduler of a cluster, which has its own workers, got both; "
            "leave --jobs out"
        )
    if importlib.util.find_spec("distributed") is None:
        raise ClusterError(f"--scheduler {scheduler}: Dask is not installed; {EXTRA}")


def work(function: Callable[..., Any], shared: Path) -> Work:
    """Return a function that can be pickled as it is sent to workers; ``shared`` as in `Work`."""
    return Work(__version__, shared.absolute(), pickle.dumps(function))


def answers(
    sent: Work,
    units: Iterable[Unit],
    told: Callable[[Unit], tuple[Any, ...]],
    scheduler: str,
    count: int | None,
) -> Generator[tuple[Unit, Any], None, None]:
    """Yield units with their answers as they come, each once.

    A unit whose worker goes away is done by another one: doing one twice must do no harm. If
    workers die several times over, the units that they had are suspected: these are then done one
    at a time, and one whose workers still die has no answer.

    Parameters
    ----------
    sent
        The work that does a unit.
    units
        The units to do; they are taken as there is room, and not stored.
    told
        Returns the function's arguments for a unit.
    scheduler
        The address of a scheduler, a scheduler file, or `LOCAL`.
    count
        Number of workers of `LOCAL`, of one thread each; None for one per processor.

    Yields
    ------
    tuple
        The unit, and its answer: None for one whose workers died.

    Raises
    ------
    ClusterError
        If the scheduler does not answer, or is lost, if a worker has another version or does not
        see the output folder, or if the function fails.
    ImageError
        If the function raises it: the output cannot be written.
    """
    with _client(scheduler, count) as client:
        hands = _Hands[Unit](client, sent, told)
        suspects: list[Unit] = []
        waiting = iter(units)
        while hands.take(waiting):
            for unit, answer in hands.done():
                if answer is None:
                    suspects.append(unit)
                else:
                    yield unit, answer
        # One at a time, so that no other unit can have caused a worker's death.
        for unit in suspects:
            hands.take(iter((unit,)))
            yield from hands.done()


class _Hands(Generic[Unit]):
    """Units that the cluster has, never more than it can soon do."""

    def __init__(
        self, client: "distributed.Client", sent: Work, told: Callable[[Unit], tuple[Any, ...]]
    ) -> None:
        from distributed import as_completed

        self._client, self._sent, self._told = client, sent, told
        self._units: dict[Any, Unit] = {}
        self._coming: Any = as_completed(loop=client.loop, with_results=True, raise_errors=False)
        self._most, self._asked = 0, -BELIEVED

    def take(self, waiting: Iterator[Unit]) -> bool:
        """Hand out units while there is room; say whether any are in hand."""
        for unit in islice(waiting, max(0, self._room() - len(self._units))):
            told = self._told(unit)
            try:
                future = self._client.submit(_done, self._sent, *told, pure=False)
            except Exception as error:  # a connection breaks in many ways
                raise _lost() from error
            self._units[future] = unit
            self._coming.add(future)
        return bool(self._units)

    def done(self) -> Iterator[tuple[Unit, Any]]:
        """Wait for answers; yield units with them, None for one whose workers died."""
        for future, answer in self._coming.next_batch():
            unit = self._units.pop(future)
            if future.status == "finished":
                yield unit, answer
            elif future.status == "error":
                _check_died(answer[1], unit)
                yield unit, None
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


def _check_died(error: BaseException, unit: Hashable) -> None:
    """Raise the error that ended a unit, unless its workers died."""
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return
    if isinstance(error, ClusterError | ImageError):
        raise error
    text = " ".join(str(error).split())
    raise ClusterError(
        f"{unit}: a worker failed, {type(error).__name__}: {text}; expected "
        f"torch-vdm {__version__} and what it needs on every worker"
    ) from error


def _lost() -> ClusterError:
    return ClusterError(
        "the scheduler was lost; what is done is kept, start it again and go on with --resume"
    )


# What a thread of a worker was sent last: it keeps metrics, which two threads must not share.
_here = threading.local()


def _done(sent: Work, *told: Any) -> Any:
    """Do a unit on a worker."""
    if getattr(_here, "sent", None) != sent:
        if sent.version != __version__:
            raise ClusterError(
                f"expected torch-vdm {sent.version} on every worker, got {__version__}; install "
                "the same version"
            )
        if not sent.shared.is_file():
            raise ClusterError(
                f"{sent.shared.parent}: expected a folder that every worker sees, got one that a "
                "worker lacks; name one on a shared file system"
            )
        _here.function, _here.sent = pickle.loads(sent.function), sent
    return _here.function(*told)


@contextmanager
def _client(scheduler: str, count: int | None) -> Generator["distributed.Client", None, None]:
    """Connect to a scheduler, or start one with workers on this machine."""
    import distributed

    with ExitStack() as stack:
        # What ends a run is reported in one line, and workers that come and go are no news.
        stack.enter_context(_quiet())
        if scheduler == LOCAL:
            with no_interrupts():
                cluster = distributed.LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",  # any free port: several may run
                    # The machine's memory is the limit, as it is for processes without a cluster.
                    memory_limit=0,
                    # Nobody takes these workers away: one that dies was killed by its own work.
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
            raise ClusterError(
                f"--scheduler {scheduler}: expected an address such as tcp://host:8786, a "
                f"scheduler file, or {LOCAL}; got no such file"
            )
        try:
            client = distributed.Client(**where, set_as_default=False)
        except Exception as error:  # an address or a file may be wrong in many ways
            text = " ".join(str(error).split()) or type(error).__name__
            raise ClusterError(
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


@contextmanager
def no_interrupts() -> Iterator[None]:
    """Hide Ctrl-C from processes that are started here: only this process handles it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
