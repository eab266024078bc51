"""Pools of workers: this process, or several processes on this machine.

A pool yields outcomes in any order; no result may depend on that order.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol, TypeVar

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

ATTEMPTS = 4
"""Workers that a task may take with it before it is given up."""

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Set to 1 in every worker: sums must not depend on how many threads share them."""


@dataclass(frozen=True, slots=True)
class Lost:
    """A task without an outcome: it raised an unexpected exception, or too many workers died. The next run tries it again."""

    message: str

    @classmethod
    def by(cls, error: BaseException) -> Lost:
        """Make the outcome of a task that raised this exception."""
        return cls(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")


class Pool(Protocol):
    """Interface of a pool of workers that runs tasks."""

    def run(self, work: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[tuple[int, Outcome | Lost]]:
        """Run `work` on every task; yield (index of the task, outcome) in any order, each index once.

        A task that raises has the outcome `Lost`; the others go on. `work` must be a function of a module, so that another
        process can import it.
        """


class ThisProcess:
    """Runs one task after the other in this process."""

    def run(self, work: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[tuple[int, Outcome | Lost]]:
        """Run `work` on every task in order; yield (index of the task, outcome). A task that raises has the outcome `Lost`."""
        for index, task in enumerate(tasks):
            yield index, _attempt(work, task)


class LocalProcesses:
    """Processes on this machine with one thread each. If one dies it is replaced, and another gets its task."""

    def __init__(self, count: int) -> None:
        """Use at most this many processes; they are started by `run` and end with it."""
        self._count = count
        self._workers: list[_Worker] = []

    @property
    def pids(self) -> tuple[int, ...]:
        """Process ids of the current workers; empty while `run` is not running."""
        return tuple(worker.pid for worker in self._workers)

    def run(self, work: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[tuple[int, Outcome | Lost]]:
        """Run `work` on every task in parallel; yield (index of the task, outcome) in any order, each index once.

        A task that raises, or of which `ATTEMPTS` processes died, has the outcome `Lost`.
        """
        waiting, deaths = deque(range(len(tasks))), [0] * len(tasks)
        try:
            self._workers = [_Worker(work) for _ in range(min(self._count, len(tasks)))]
            while waiting or any(worker.index is not None for worker in self._workers):
                for worker in self._workers:
                    if worker.index is None and waiting:
                        worker.give(waiting[0], tasks[waiting.popleft()])
                for worker in self._ready():
                    index, answer = worker.take()
                    if answer is not None:
                        yield index, answer[0]
                        continue
                    self._workers[self._workers.index(worker)] = _Worker(work)
                    deaths[index] += 1
                    if deaths[index] < ATTEMPTS:
                        waiting.appendleft(index)
                    else:
                        yield index, Lost(f"{ATTEMPTS} workers died of it")
        finally:
            for worker in self._workers:
                worker.stop()
            self._workers = []

    def _ready(self) -> list[_Worker]:
        """Workers with an outcome, or dead ones; waits for the first."""
        busy = {worker.connection: worker for worker in self._workers if worker.index is not None}
        return [busy[connection] for connection in wait(list(busy))]  # type: ignore[index]  # they are what was given


class _Worker:
    """A process, and the number of its task."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.index: int | None = None
        self._process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        with one_thread_for_children():
            self._process.start()
        theirs.close()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def give(self, index: int, task: Any) -> None:
        self.index = index
        with contextlib.suppress(OSError):  # it is dead: `take` will say so
            self.connection.send(task)

    def take(self) -> tuple[int, tuple[Any] | None]:
        """The task's number with its outcome, or with None if the process died."""
        assert self.index is not None
        index, self.index = self.index, None
        try:
            return index, (self.connection.recv(),)
        except (EOFError, OSError):
            self.stop()
            return index, None

    def stop(self) -> None:
        self.connection.close()
        self._process.kill()
        self._process.join()


def _serve(connection: Connection, work: Callable[[Any], Any]) -> None:
    """The loop of a worker: it ends when its parent closes the connection or dies."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            connection.send(_attempt(work, connection.recv()))


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _attempt(work: Callable[[Task], Outcome], task: Task) -> Outcome | Lost:
    try:
        return work(task)
    except Exception as error:  # noqa: BLE001 - the study goes on; the cell says what happened
        return Lost.by(error)


@contextlib.contextmanager
def one_thread_for_children() -> Iterator[None]:
    """Processes started within this context use one thread for matrix products, since there are as many processes as cores."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
