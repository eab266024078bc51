"""Play a bag to `hybridmap ros1` over a real master, and listen beside it; used by `live_proof.py`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from live_checks import Client, call_on_known_map, call_services
from overload import slowed
from ros1 import Ros1, Ros1Error, master

from hybridmap.trajectory import NS_PER_S

_PROGRAM = (sys.executable, "-c", "from hybridmap.cli import main; main()")
_CONNECT_S = 5
"""How long `rosbag play` waits after it has advertised its topics, s: the node looks twice before it subscribes."""
_AFTER_S = 3.0
_END_S = 600.0
_AGAIN_S = 20
"""So much of the recording is played to a node that is told to begin anew, and again afterwards."""


@dataclass
class Heard:
    """What was heard beside the node.

    Attributes:
        came_s: stamp of an odometry message, ns -> when it came.
        late_s: how long after its odometry each pose came.
        status: last diagnostics of the node, by name.
        lags_s: the lag at each of them.
        checks: what was checked, by name.
    """

    came_s: dict[int, float] = field(default_factory=dict)
    late_s: list[float] = field(default_factory=list)
    status: dict[str, str] = field(default_factory=dict)
    lags_s: list[float] = field(default_factory=list)
    checks: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Drive:
    """A bag, and how it is played.

    Attributes:
        bag: its path.
        rate: times real time.
        odometry: topic of the odometry.
        settings: `KEY=VALUE`, for the node.
        folder: where the session goes, as `live`.
    """

    bag: Path
    rate: float
    odometry: str
    settings: list[str]
    folder: Path


def listen(ros: Ros1, environment: dict[str, str], odometry_topic: str, heard: Heard) -> Any:
    """Listen to odometry, poses and diagnostics, in threads of rospy."""
    os.environ.update(environment)
    sys.path.append(str(ros.python_path))
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray
    from nav_msgs.msg import Odometry

    rospy.init_node("live_proof", disable_signals=True)
    lock = threading.Lock()

    def moved(message: Any) -> None:
        with lock:
            heard.came_s[message.header.stamp.to_nsec()] = time.monotonic()

    def placed(message: Any) -> None:
        now_s = time.monotonic()
        _, s, ns = np.frombuffer(message._buff, "<u4", 3)
        with lock:
            came_s = heard.came_s.get(int(s) * NS_PER_S + int(ns))
            if came_s is not None:
                heard.late_s.append(now_s - came_s)

    def diagnosed(message: Any) -> None:
        heard.status = {value.key: value.value for value in message.status[0].values}
        if "lag, s" in heard.status:
            heard.lags_s.append(float(heard.status["lag, s"]))

    if not odometry_topic.startswith("/tf"):
        rospy.Subscriber(odometry_topic, Odometry, moved, tcp_nodelay=True)
        rospy.Subscriber("/hybridmap/pose", rospy.AnyMsg, placed, tcp_nodelay=True)
    rospy.Subscriber("/diagnostics", DiagnosticArray, diagnosed)
    return rospy


def play(drive: Drive, ros: Ros1, slow: float, heard: Heard, *, checks: bool) -> dict[str, Any]:
    """Map what `rosbag play` plays; returns the head of the session.

    Args:
        drive: what is played.
        ros: the ROS 1 to use.
        slow: how many times slower the mapping process is made.
        heard: filled in.
        checks: whether transforms and services are checked as well.
    """
    out = drive.folder / "live"
    with master(ros) as environment:
        rospy = listen(ros, environment, drive.odometry, heard)
        client = Client(drive.odometry) if checks else None
        with _node(drive, out, environment, heard) as node:
            player = threading.Thread(target=_played, args=(drive, ros, environment))
            player.start()
            _wait_for(lambda: heard.status["state"] == "mapping" or not player.is_alive(), node)
            with slowed(_mapping(node), slow):  # its start is no part of the drive
                player.join()
            _wait_for(lambda: heard.status.get("lag, s") == "0.000", node)
            if client is not None:
                heard.checks |= call_services(out, drive.folder)
        head: dict[str, Any] = json.loads((out / "metrics.json").read_text())
        if client is not None:
            later_s = next(one["value"] for one in metrics_of(out) if one["name"] == "clock_offset_used") or 0.0
            heard.checks |= client.transforms(out, head["primary_backend"], later_s)
            _begin_anew(drive, out, ros, environment, heard)
        rospy.signal_shutdown("done")
    return head


def metrics_of(session: Path) -> list[dict[str, Any]]:
    """The figures of a session."""
    metrics: list[dict[str, Any]] = json.loads((session / "metrics.json").read_text())["metrics"]
    return metrics


def _begin_anew(drive: Drive, base: Path, ros: Ros1, environment: dict[str, str], heard: Heard) -> None:
    """A second node, on the map of the first: it is localised, reset and misled."""
    out = drive.folder / "again"
    last, heard.status = (heard.status, list(heard.late_s)), {}
    with _node(drive, out, environment, heard, "--map", str(base)) as node:
        _played(drive, ros, environment, f"--duration={_AGAIN_S}")
        _wait_for(lambda: int(heard.status.get("nodes", 0)) > 0, node)
        heard.checks |= call_on_known_map(
            lambda: int(heard.status["nodes"]), lambda: _played(drive, ros, environment, f"--duration={_AGAIN_S}"), base
        )
    said = (drive.folder / "again.log").read_text()
    heard.checks["reset_names_no_resume"] = "--resume" not in said
    heard.checks["known_map_passed"] &= "--resume" not in said
    heard.status, heard.late_s = last


def _played(drive: Drive, ros: Ros1, environment: dict[str, str], *more: str) -> None:
    player = [
        str(ros.player),
        "--quiet",
        f"--rate={drive.rate}",
        f"--delay={_CONNECT_S}",
        "--queue=10000",
        *more,
        str(drive.bag),
    ]
    subprocess.run(player, env=environment, check=True, stdout=subprocess.DEVNULL)
    time.sleep(_AFTER_S)


@contextmanager
def _node(drive: Drive, out: Path, environment: dict[str, str], heard: Heard, *more: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run the node until the end of the context, and conclude its session."""
    settings = [word for setting in drive.settings for word in ("--set", setting)]
    path = drive.folder / f"{out.name}.log"
    with path.open("w") as log:
        command = [*_PROGRAM, "ros1", "--out", str(out), *more, *settings]
        node = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        try:
            _wait_for(lambda: "state" in heard.status, node)
            yield node
            node.send_signal(signal.SIGINT)
            node.wait(_END_S)
        finally:
            node.kill()
    if node.returncode:
        raise Ros1Error(f"hybridmap ros1 ended with exit code {node.returncode}: {path.read_text()[-500:]}")


def _mapping(node: subprocess.Popen[bytes]) -> int:
    """Number of the process that maps, a child of the node."""
    found = subprocess.run(["pgrep", "-P", str(node.pid), "-f", "hybridmap.live.worker"], capture_output=True, text=True)
    return int(found.stdout.split()[0])


def _wait_for(there: Callable[[], bool], node: subprocess.Popen[bytes]) -> None:
    until_s = time.monotonic() + _END_S
    while not there() and node.poll() is None:
        if time.monotonic() > until_s:
            raise Ros1Error(f"waited {_END_S:g} s in vain")
        time.sleep(0.1)
