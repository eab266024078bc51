"""A robot's node that is moved through the lifecycle of ROS 2: each activation from `unconfigured` is a session of its own."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

from hybridmap.errors import HybridMapError, RosError
from hybridmap.report import write_report
from hybridmap.ros.robot import NodeOptions, RobotNode
from hybridmap.ros.ros2 import Ros2
from hybridmap.session import Session


class RobotLifecycle:
    """What the transitions of the node do.

    `configure` makes topics and loads what mapping needs; `activate` maps; `deactivate` leaves views out and publishes nothing,
    until the next `activate`; `cleanup` concludes the session; `shutdown` does so, too, and ends the node. The second session
    of a node is written into OUT-2, and so on.

    Attributes:
        ended: set when there is nothing more to wait for.
    """

    def __init__(self, ros: Ros2, options: NodeOptions, *, autostart: bool) -> None:
        self._ros, self._options, self._autostart = ros, options, autostart
        self.ended = threading.Event()
        self._robot: RobotNode | None = None
        self._started = False
        self._sessions = 0
        self._concluding = threading.Lock()
        self._last: Session | HybridMapError = RosError(f"{ros.source}: nothing was mapped: the node was never activated")

    def start(self) -> None:
        """Let others move the node, or begin to map at once; returns at once.

        Raises:
            HybridMapError: it does not become active.
        """
        self._ros.follow(self, autostart=self._autostart)

    def finish(self) -> Session:
        """Conclude the session that runs.

        Returns:
            The last session.

        Raises:
            HybridMapError: nothing was mapped, or mapping has failed.
        """
        self.ended.set()
        self._conclude()
        if isinstance(self._last, HybridMapError):
            raise self._last
        return self._last

    # ------------------------------------------------------------------ transitions

    def configure(self) -> None:
        """Make topics, and load what mapping needs."""
        self._sessions += 1
        self._robot = RobotNode(self._ros, replace(self._options, out=self._out))
        self._ros.begin()

    def activate(self) -> None:
        """Map, or go on mapping."""
        assert self._robot is not None
        if self._started:
            self._robot.pause(False)
            return
        self._robot.start()
        self._started = True
        threading.Thread(target=self._watch, args=(self._robot,), name="hybridmap-watch", daemon=True).start()

    def deactivate(self) -> None:
        """Leave views out; odometry counts all the time."""
        assert self._robot is not None
        self._robot.pause()

    def cleanup(self) -> None:
        """Conclude the session."""
        self._conclude()
        self._ros.forget()
        if isinstance(self._last, HybridMapError):
            self._ros.warn(str(self._last))
        else:
            write_report(self._last.folder)

    def shutdown(self) -> None:
        """End the node; the session is concluded by who waits for it."""
        self.ended.set()

    # ------------------------------------------------------------------ own

    @property
    def _out(self) -> Path:
        out = self._options.out
        return out if self._sessions == 1 else out.with_name(f"{out.name}-{self._sessions}")

    def _conclude(self) -> None:
        with self._concluding:  # Ctrl-C may come during `cleanup`
            robot, self._robot = self._robot, None
            if robot is None:
                return
            self._ros.end()
            started, self._started = self._started, False
            try:
                self._last = robot.finish()
            except HybridMapError as error:
                if started:
                    self._last = error

    def _watch(self, robot: RobotNode) -> None:
        """End the node when mapping has failed."""
        robot.ended.wait()
        if robot is self._robot:
            self.ended.set()
