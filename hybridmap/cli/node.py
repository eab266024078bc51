"""Run a ROS node until Ctrl-C, and conclude its session; what `ros1` has beside other nodes is its middleware."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hybridmap.cli.show import emit

if TYPE_CHECKING:
    from hybridmap.ros.middleware import Middleware
    from hybridmap.ros.robot import NodeOptions

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
    float, typer.Option(help="Views are left out so that none is on the map later than this after it came, s.", min=0.1)
]


def run_node(middleware: Middleware, options: NodeOptions, *, as_json: bool) -> None:
    """Map until Ctrl-C, SIGTERM or the end of the middleware; then conclude the session and show its figures.

    Raises:
        HybridMapError: nothing could be mapped, or mapping failed.
    """
    from hybridmap.report import write_report
    from hybridmap.ros.robot import RobotNode

    sys.setswitchinterval(_SWITCH_S)
    node = RobotNode(middleware, options)
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
    emit(written.head, written.metrics, as_json=as_json, title=f"{options.out}: {written.head['source']}")
    if not as_json:
        typer.echo(f"page: {Path(options.out) / 'report.html'}")


@contextmanager
def _stopped_by_signals(stop: Any) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the drive; a second one, while the session is concluded, ends the process as usual."""
    before = {number: signal.signal(number, lambda *_: stop()) for number in _STOP}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
