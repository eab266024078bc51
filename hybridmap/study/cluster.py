"""Computing on a Dask cluster: any number of machines with the same hybridmap installed."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from hybridmap.errors import StudyError
from hybridmap.study.pools import Lost

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

_CONNECT_S = 30


class DaskCluster:
    """A Dask scheduler with its workers; if a worker dies, another one gets its task.

    Start the workers with one thread each (`dask worker --nthreads 1`), which also limits their numerical libraries to one.
    """

    def __init__(self, address: str) -> None:
        """Connect to `tcp://host:port`.

        Raises:
            StudyError: the extra `cluster` is not installed, there is no scheduler at the address, or it has no worker.
        """
        try:
            import distributed
        except ImportError:
            raise StudyError("--scheduler needs the extra `cluster`: pip install 'hybridmap[cluster]'") from None
        _require_listener(address)
        self._dask: Any = distributed
        try:
            self._client = distributed.Client(address, timeout=f"{_CONNECT_S}s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise _no_scheduler(address, error) from None
        try:
            self._client.wait_for_workers(1, timeout=_CONNECT_S)
        except TimeoutError:
            self.close()
            raise StudyError(f"{address}: the scheduler has no worker; start some with `dask worker {address}`") from None

    def run(self, work: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[tuple[int, Outcome | Lost]]:
        """Run every task on the cluster; yield (index of the task, outcome) in any order, each index once.

        Raises:
            StudyError: the connection to the scheduler is lost, or a worker cannot import hybridmap; finished tasks have been
                yielded.
        """
        futures = {self._client.submit(work, task, pure=False): index for index, task in enumerate(tasks)}
        try:
            for future in self._dask.as_completed(list(futures), loop=self._client.loop):
                if future.status == "cancelled":
                    raise StudyError("the connection to the Dask scheduler is lost; run again to go on")
                error = future.exception()
                yield futures[future], future.result() if error is None else self._lost(error)
                future.release()
        finally:
            self._client.cancel(list(futures))

    def close(self) -> None:
        """Close the connection to the scheduler; scheduler and workers keep running."""
        self._client.close()

    def _lost(self, error: BaseException) -> Lost:
        """The outcome of a task that raised or that killed its workers; a worker without our package ends the study."""
        if isinstance(error, ImportError):
            raise StudyError(f"a worker cannot import hybridmap: {error}; install the same version on all") from None
        return Lost.by(error)


def _require_listener(address: str) -> None:
    """Refuse an address without a listener at once, before Dask retries for a long time.

    Raises:
        StudyError: it is not an address, or the connection is refused.
    """
    found = re.fullmatch(r"(tcp|tls)://\[?([^/]+?)\]?:(\d{1,5})", address)
    if found is None:
        raise StudyError(f"--scheduler {address}: expected tcp://HOST:PORT, as `dask scheduler` prints it")
    try:
        socket.create_connection((found[2], int(found[3])), timeout=_CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise _no_scheduler(address, error) from None


def _no_scheduler(address: str, error: BaseException) -> StudyError:
    said = " ".join(str(error).split())[:160] or type(error).__name__
    return StudyError(f"{address}: no Dask scheduler answers: {said}; start one with `dask scheduler`")
