"""The mapping process, seen from the robot's: it is started, written to, listened to, and let go."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import hybridmap
from hybridmap import errors
from hybridmap.errors import HybridMapError, LiveError
from hybridmap.live.messages import Begin, Failed
from hybridmap.session import Session

_BEHIND = 10
"""By how much the priority of a process is lower that lets mapping go first."""
_PACKAGE = str(Path(hybridmap.__file__).parents[1])


class PipedProcess:
    """A process that runs `main` of a module of this package, with a pipe in both directions; its number is the only argument.

    It is started anew and not forked, as a robot's program has threads. It gets no Ctrl-C, as that is for the robot's
    program, and ends when the pipe is closed.

    Attributes:
        pipe: this end of the pipe.
    """

    def __init__(self, module: str, *, yields: bool = False) -> None:
        """Start the process.

        Args:
            module: its name.
            yields: whether it lets processes that map go first, where there are too few processors for all.

        Raises:
            LiveError: it cannot be started.
        """
        self._socket, theirs = socket.socketpair()
        for end in (self._socket, theirs):
            end.setblocking(True)  # whatever `socket.setdefaulttimeout` says: rospy sets it
        self.pipe = Connection(os.dup(self._socket.fileno()))
        paths = [_PACKAGE, *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            try:
                self._process = subprocess.Popen(
                    [
                        sys.executable,
                        "-c",
                        f"import os; os.nice({_BEHIND * yields}); from {module} import main; main()",
                        str(theirs.fileno()),
                    ],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    start_new_session=True,
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
                )
            except OSError as error:
                raise LiveError(f"a process cannot be started: {error}") from None

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def send(self, messages: Iterable[Any]) -> None:
        """Write messages; it waits while the pipe is full. That the process has gone is seen when reading, and not here."""
        with suppress(OSError):
            for message in messages:
                self.pipe.send(message)

    def close(self) -> None:
        """Close the pipe. It may be called twice."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def end(self) -> str:
        """Wait for the end of the process, and say in words how it was."""
        code = self._process.wait()
        self._socket.close()
        return f"by signal {-code}" if code < 0 else f"with exit code {code}"


class MappingProcess(PipedProcess):
    """The process that maps.

    Until `begin` it only loads what mapping needs, which takes some seconds: start it early. When the pipe is closed it
    concludes its session.
    """

    def __init__(self) -> None:
        super().__init__("hybridmap.live.worker")

    def begin(self, begin: Begin, receive: Callable[[Any], None], ended: Callable[[HybridMapError], None]) -> None:
        """Begin to map.

        Args:
            begin: what, and where to.
            receive: called in a thread of its own with each message from the process.
            ended: called in that thread, once, if the process ends before it has sent its session.
        """
        self.send([begin])
        threading.Thread(target=self._listen, args=(receive, ended), name="hybridmap-listen", daemon=True).start()

    def _listen(self, receive: Callable[[Any], None], ended: Callable[[HybridMapError], None]) -> None:
        """Pass on messages until the process ends."""
        error: HybridMapError | None = None
        finished = False
        with suppress(EOFError, OSError):
            while True:
                message = self.pipe.recv()
                if isinstance(message, Failed):
                    error = getattr(errors, message.error, LiveError)(message.words)
                else:
                    finished |= isinstance(message, Session)
                    receive(message)
        how = self.end()
        if not finished:
            ended(error or LiveError(f"the mapping process ended {how}; what it had mapped is in the session folder"))
