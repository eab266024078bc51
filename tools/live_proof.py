"""Prove that a map made live, over a real ROS, is the map of the recording, and measure how late poses are.

    python tools/live_proof.py --ros 1 --rate 5 --seconds 150 fr079.mcap
    python tools/live_proof.py --ros 1 office --seconds 60 --set simulation.camera.rate_hz=30 --json

The source, a bag or the name of a simulated world, is cut to its first seconds and written as a ROS 1 bag. `hybridmap map` maps
that bag. Then a `rosmaster` runs on a port of the loopback device, `hybridmap ros1` maps what `rosbag play` plays at
the rate, and this program listens beside it. It exits with 1 if the graphs differ, odometry was lost, or poses are late at
rate 1. ROS 1 comes from Debian's packages (`tools/ros1.py`), into the folder `--ros-folder`.

With `--ros 2` the same bag is played to `hybridmap ros2` by `ros2_play.py`, with wheels of ROS 2 (`tools/ros2.py`).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import live_ros2
import numpy as np
from ros1 import Ros1, Ros1Error, fetch, master
from ros2 import Ros2Error
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from hybridmap.config import Config
from hybridmap.streams.rosbag import BagStream
from hybridmap.trajectory import NS_PER_S

PROGRAM = (sys.executable, "-c", "from hybridmap.cli import main; main()")
P99_S = 0.02
"""Bar at rate 1: 99 % of the poses come sooner after their odometry."""
_CONNECT_S = 5
"""How long `rosbag play` waits after it has advertised its topics, s: the node looks twice before it subscribes."""
_AFTER_S = 3.0
_END_S = 600.0


@dataclass
class Heard:
    """What was heard beside the node.

    Attributes:
        came_s: stamp of an odometry message, ns -> when it came.
        late_s: how long after its odometry each pose came.
        status: last diagnostics of the node, by name.
    """

    came_s: dict[int, float] = field(default_factory=dict)
    late_s: list[float] = field(default_factory=list)
    status: dict[str, str] = field(default_factory=dict)
    messages: int = 0


def recording(source: str, seconds: float | None, settings: list[str], folder: Path) -> Path:
    """A ROS 1 bag of the first seconds of a source."""
    path = Path(source)
    if not path.exists():
        path = folder / f"{source}.bag"
        cut = [] if seconds is None else ["--set", f"simulation.duration_s={seconds}"]
        more = [word for setting in settings for word in ("--set", setting)]
        subprocess.run([*PROGRAM, "-q", "simulate", source, "--out", str(path), *cut, *more], check=True, capture_output=True)
    if path.suffix == ".bag" and seconds is None:
        return path
    return _cut(path, seconds, folder / "cut.bag")


def _cut(path: Path, seconds: float | None, out: Path) -> Path:
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    with AnyReader([path]) as reader, Writer(out) as writer:
        connections: dict[Any, Any] = {}
        end_ns = reader.start_time + round((seconds if seconds is not None else 1e9) * NS_PER_S)
        for connection, at_ns, data in reader.messages():
            if at_ns > end_ns:
                break
            if connection.id not in connections:
                latched = int(connection.topic.endswith("tf_static"))
                store = reader.typestore if reader.is2 is False else _with(ros1, reader.typestore, connection.msgtype)
                connections[connection.id] = writer.add_connection(
                    connection.topic, connection.msgtype, typestore=store, latching=latched
                )
            if reader.is2:
                data = reader.typestore.cdr_to_ros1(data, connection.msgtype)
            writer.write(connections[connection.id], at_ns, data)
    return out


def _with(ros1: Any, ros2: Any, msgtype: str) -> Any:
    """The types of ROS 1, with one of ROS 2 that it does not have by this name."""
    if msgtype not in ros1.fielddefs:
        ros1.register({msgtype: ros2.fielddefs[msgtype]})
    return ros1


def listen(environment: dict[str, str], ros: Ros1, odometry_topic: str, heard: Heard) -> Any:
    """Listen to odometry, poses and diagnostics, in threads of rospy."""
    os.environ.update(environment)
    sys.path.append(str(ros.python_path))
    import rospy
    from diagnostic_msgs.msg import DiagnosticArray

    rospy.init_node("live_proof", disable_signals=True)
    lock = threading.Lock()

    def moved(message: Any) -> None:
        _, s, ns = np.frombuffer(message._buff, "<u4", 3)
        with lock:
            heard.came_s[int(s) * NS_PER_S + int(ns)] = time.monotonic()
            heard.messages += 1

    def placed(message: Any) -> None:
        now_s = time.monotonic()
        _, s, ns = np.frombuffer(message._buff, "<u4", 3)
        with lock:
            came_s = heard.came_s.get(int(s) * NS_PER_S + int(ns))
            if came_s is not None:
                heard.late_s.append(now_s - came_s)

    def diagnosed(message: Any) -> None:
        heard.status = {value.key: value.value for value in message.status[0].values}

    if odometry_topic not in ("/tf", "/tf_static"):
        rospy.Subscriber(odometry_topic, rospy.AnyMsg, moved, tcp_nodelay=True)
        rospy.Subscriber("/hybridmap/pose", rospy.AnyMsg, placed, tcp_nodelay=True)
    rospy.Subscriber("/diagnostics", DiagnosticArray, diagnosed)
    return rospy


def play(bag: Path, ros: Ros1, rate: float, odometry: str, settings: list[str], heard: Heard, folder: Path) -> dict[str, Any]:
    """Map what `rosbag play` plays; returns the head of the session."""
    out = folder / "live"
    with master(ros) as environment:
        rospy = listen(environment, ros, odometry, heard)
        more = [word for setting in settings for word in ("--set", setting)]
        log = (folder / "node.log").open("w")
        node = subprocess.Popen([*PROGRAM, "ros1", "--out", str(out), *more], env=environment, stdout=log, stderr=log)
        _wait_for(lambda: "state" in heard.status or node.poll() is not None)
        player = [str(ros.player), "--quiet", f"--rate={rate}", f"--delay={_CONNECT_S}", str(bag)]
        subprocess.run(player, env=environment, check=True, stdout=subprocess.DEVNULL)
        time.sleep(_AFTER_S)
        node.send_signal(signal.SIGINT)
        node.wait(_END_S)
        rospy.signal_shutdown("done")
    if node.returncode:
        raise Ros1Error(f"hybridmap ros1 ended with exit code {node.returncode}: {(folder / 'node.log').read_text()[-500:]}")
    head: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return head


def _wait_for(there: Callable[[], bool]) -> None:
    until_s = time.monotonic() + _END_S
    while not there():
        if time.monotonic() > until_s:
            raise Ros1Error(f"waited {_END_S:g} s in vain")
        time.sleep(0.1)


def _pairs(settings: list[str]) -> list[tuple[str, str]]:
    return [(key, value) for key, _, value in (one.partition("=") for one in settings if one.startswith("sensors."))]


def offline(bag: Path, settings: list[str], folder: Path) -> dict[str, Any]:
    """Map the recording as such; returns the head of the session."""
    out = folder / "offline"
    more = [word for setting in settings for word in ("--set", setting)]
    subprocess.run([*PROGRAM, "-q", "map", str(bag), "--out", str(out), *more], check=True, stdout=subprocess.DEVNULL)
    head: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return head


def prove(
    source: str, version: int, ros_folder: Path, rate: float, seconds: float | None, settings: list[str], keep: Path
) -> dict[str, Any]:
    """Map a source both ways; returns the figures."""
    bag = recording(source, seconds, settings, keep)
    before, heard = offline(bag, settings, keep), Heard()
    odometry = BagStream(bag, Config.load(None, dict(_pairs(settings)))).uses["odometry"]
    if version == 2:
        now, told = live_ros2.play(bag, ros_folder, rate, odometry, settings, keep)
        heard.late_s, heard.status = told["late_s"], told["status"]
    else:
        now = play(bag, fetch(ros_folder), rate, odometry, settings, heard, keep)
    late_ms = 1000.0 * np.array(heard.late_s or [np.nan])
    sent, taken = int(before["stream"]["odometry"]), int(now["stream"].get("odometry", 0))
    p99_ms = float(np.percentile(late_ms, 99))
    same = before["graph_hash"] == now["graph_hash"]
    return {
        "source": source,
        "ros": version,
        "rate": rate,
        "seconds": seconds,
        "same_graph": same,
        "graph_hash_offline": before["graph_hash"],
        "graph_hash_live": now["graph_hash"],
        "stream_offline": before["stream"],
        "stream_live": now["stream"],
        "odometry_sent": sent,
        "odometry_lost": sent - taken,
        "poses_heard": len(heard.late_s),
        "pose_after_odometry_p50_ms": float(np.percentile(late_ms, 50)),
        "pose_after_odometry_p99_ms": p99_ms,
        "pose_after_odometry_max_ms": float(late_ms.max()),
        "last_diagnostics": heard.status,
        "passed": bool(same and sent == taken and (rate > 1.0 or p99_ms <= 1000.0 * P99_S)),
    }


def main() -> int:
    """Prove and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--ros", type=int, choices=(1, 2), default=1)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=None, help="of the recording")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--ros-folder", type=Path, default=None, help="default: ~/.cache/hybridmap/ros1 or ros2")
    parser.add_argument("--keep", type=Path, default=None, help="folder for the bag and both sessions; default: none is kept")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        keep = given.keep or Path(scratch)
        keep.mkdir(parents=True, exist_ok=True)
        ros_folder = given.ros_folder or Path.home() / ".cache" / "hybridmap" / f"ros{given.ros}"
        found = prove(given.source, given.ros, ros_folder, given.rate, given.seconds, given.settings, keep)
    if given.json:
        print(json.dumps(found, indent=2))
    else:
        for name, value in found.items():
            print(f"{name:30} {value}")
    return 0 if found["passed"] else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (Ros1Error, Ros2Error) as error:
        sys.exit(f"live_proof: {error}")
