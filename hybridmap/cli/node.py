"""Run a ROS node until Ctrl-C, and conclude its session; `ros1` and `ros2` differ by their middleware."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from hybridmap.cli.show import emit

if TYPE_CHECKING:
    from hybridmap.ros.middleware import Middleware
    from hybridmap.session import Session

_SWITCH_S = 0.0005
"""Python lets another thread run after so long, s, and not after 5 ms: odometry need not wait while the graph of a large map is
written. A pose passes through several threads, so that the waits add up."""
_STOP = (signal.SIGINT, signal.SIGTERM)

RobotTopic = Annotated[
    str | None, typer.Option(metavar="TOPIC", help="Topic of the robot to use instead of the one found by type and name.")
]
Rate = Annotated[float, typer.Option(help="How often map -> odom is published on /tf, Hz.", min=0.1, max=1000)]
MapEvery = Annotated[
    float, typer.Option(help="Seconds between two grids on /map; after a loop closure the next comes at once.", min=0.5)
]
Resolution = Annotated[float, typer.Option(help="Side of a cell of /map and of save_map, m.", min=0.005, max=10)]
MapFrame = Annotated[str, typer.Option(help="Name of the frame of the map.")]
KnownMap = Annotated[
    Path | None,
    typer.Option(
        "--map",
        help="Session folder of a finished map: the robot is looked for on it while it maps, and its pose there is published in"
        " the frame known_map. The finished map stays as it is.",
    ),
]
CorrectionSpeed = Annotated[
    float, typer.Option(help="map -> odom on /tf moves the robot no faster than this, m/s, after a loop closure.", min=0.001)
]
CorrectionTurn = Annotated[float, typer.Option(help="As --correction-m-s, for its heading, degrees/s.", min=0.01)]
Lag = Annotated[
    float,
    typer.Option(
        help="Views are left out so that the others are on the map this soon after they came, s; see docs/live.md.", min=0.1
    ),
]


Configuration = Annotated[
    str | None,
    typer.Option(
        help="Configuration: a name (an unknown one gives the list) or a YAML file. Default: the one for the sensor found."
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")]


class Node(Protocol):
    """A node that maps: `ros.robot.RobotNode`, or one with a lifecycle around it.

    Attributes:
        ended: set when there is nothing more to wait for.
    """

    ended: threading.Event

    def start(self) -> None:
        """Begin; returns at once."""

    def finish(self) -> Session:
        """Conclude the session."""


def overrides_of(settings: list[str] | None, **topics: str | None) -> dict[str, Any]:
    """Dotted key -> value over the configuration: `--set`, and topics of the robot by their role."""
    from hybridmap.cli.choose import parse_settings

    named = {f"sensors.{role}_topic": topic for role, topic in topics.items() if topic is not None}
    return {**named, **parse_settings(settings)}


def run_node(middleware: Middleware, node: Node, *, as_json: bool) -> None:
    """Map until Ctrl-C, SIGTERM or the end of the middleware; then conclude the session and show its figures.

    Raises:
        HybridMapError: nothing could be mapped, or mapping failed.
    """
    from hybridmap.report import write_report

    sys.setswitchinterval(_SWITCH_S)
    middleware.when_stopped(node.ended.set)
    try:
        with _stopped_by_signals(node.ended.set):
            node.start()
            while not node.ended.wait(0.2):
                pass
        session = node.finish()
    finally:
        middleware.stop()
    write_report(session.folder)
    written = session.folder.read_metrics()
    folder = session.folder.path
    emit(written.head, written.metrics, as_json=as_json, title=f"{folder}: {written.head['source']}")
    if not as_json:
        typer.echo(f"page: {folder / 'report.html'}")


@contextmanager
def _stopped_by_signals(stop: Any) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the drive; a second one, while the session is concluded, ends the process as usual."""
    before = {number: signal.signal(number, lambda *_: stop()) for number in _STOP}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
