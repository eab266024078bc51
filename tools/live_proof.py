"""Prove that a map made live, over a real ROS, is the map of the recording, and measure how late poses are.

    python tools/live_proof.py --ros 1 --rate 5 --seconds 150 fr079.mcap
    python tools/live_proof.py --ros 1 office --seconds 60 --set simulation.camera.rate_hz=30 --json

The source, a bag or the name of a simulated world, is cut to its first seconds and written as a ROS 1 bag. `hybridmap map` maps
that bag. Then a `rosmaster` runs on a port of the loopback device, `hybridmap ros1` maps what `rosbag play` plays at
the rate, and this program listens beside it: it calls every service, holds the transforms against the trajectory, reads
`/map` back, and times poses (`live_checks.py`). It exits with 1 if the graphs differ, odometry was lost, a check fails, or
poses are late at rate 1. With `--overload 3` mapping is made 3 times too slow: then lag, what is left out, and the error of the
map against `--reference` are what must be right. ROS 1 comes from Debian's packages (`tools/ros1.py`), into the folder
`--ros-folder`.

With `--ros 2` the same bag is played to `hybridmap ros2` by `ros2_play.py`, with wheels of ROS 2 (`tools/ros2.py`).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import live_ros2
import numpy as np
from live_checks import planar
from live_ros1 import Drive, Heard, play
from overload import ERROR_RATIO, LAG_S, error_m, slowness
from ros1 import Ros1Error, fetch
from ros2 import Ros2Error
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from hybridmap.config import Config
from hybridmap.geometry import interpolate
from hybridmap.streams.rosbag import BagStream
from hybridmap.trajectory import NS_PER_S

PROGRAM = (sys.executable, "-c", "from hybridmap.cli import main; main()")
P99_S = 0.02
"""Bar at rate 1: 99 % of the poses come sooner after their odometry."""


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


def _pairs(settings: list[str]) -> list[tuple[str, str]]:
    return [(key, value) for key, _, value in (one.partition("=") for one in settings if one.startswith("sensors."))]


def offline(bag: Path, settings: list[str], folder: Path) -> dict[str, Any]:
    """Map the recording as such; returns the head of the session."""
    out = folder / "offline"
    more = [word for setting in settings for word in ("--set", setting)]
    subprocess.run([*PROGRAM, "-q", "map", str(bag), "--out", str(out), *more], check=True, stdout=subprocess.DEVNULL)
    head: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return head


def prove(given: argparse.Namespace, keep: Path) -> dict[str, Any]:
    """Map a source both ways; returns the figures."""
    bag = recording(given.source, given.seconds, given.settings, keep)
    if given.odometry_hz is not None:
        bag = with_odometry_at(bag, given.odometry_hz, given.settings, keep / "denser.bag")
    before, heard = offline(bag, given.settings, keep), Heard()
    odometry = BagStream(bag, Config.load(None, dict(_pairs(given.settings)))).uses["odometry"]
    slow = slowness(keep / "offline", given.rate, given.overload)
    folder = given.ros_folder or Path.home() / ".cache" / "hybridmap" / f"ros{given.ros}"
    if given.ros == 2:
        now, told = live_ros2.play(bag, folder, given.rate, odometry, given.settings, keep)
        heard.late_s, heard.status = told["late_s"], told["status"]
    else:
        drive = Drive(bag, given.rate, odometry, given.settings, keep)
        now = play(drive, fetch(folder), slow, heard, checks=not given.overload and not given.no_checks)
    late_ms = 1000.0 * np.array(heard.late_s)
    quantiles_ms = [round(float(one), 3) for one in np.percentile(late_ms, (50, 99, 100))] if len(late_ms) else None
    sent, taken = int(before["stream"]["odometry"]), int(now["stream"].get("odometry", 0))
    in_time = odometry.startswith("/tf") or (quantiles_ms is not None and quantiles_ms[1] <= 1000.0 * P99_S)
    same = before["graph_hash"] == now["graph_hash"]
    found = {
        "source": given.source,
        "ros": given.ros,
        "rate": given.rate,
        "seconds": given.seconds,
        "same_graph": same,
        "graph_hash_offline": before["graph_hash"],
        "graph_hash_live": now["graph_hash"],
        "stream_offline": before["stream"],
        "stream_live": now["stream"],
        "odometry_sent": sent,
        "odometry_lost": sent - taken,
        "poses_heard": len(heard.late_s),
        "pose_after_odometry_p50_p99_max_ms": quantiles_ms,
        "last_diagnostics": heard.status,
        **heard.checks,
    }
    checked = all(value for name, value in heard.checks.items() if name.endswith("_passed"))
    if given.overload:
        found |= overloaded(now, heard, slow, given.reference, keep)
        found["passed"] = bool(found["overload_passed"] and sent == taken)
    else:
        found["passed"] = bool(same and sent == taken and checked and (given.rate > 1.0 or in_time))
    return found


def overloaded(now: dict[str, Any], heard: Heard, slow: float, reference: Path | None, keep: Path) -> dict[str, Any]:
    """The figures of a machine that is too slow: its lag, what was left out, where that is said, and the error of its map."""
    lag_s = max(*heard.lags_s, float(heard.status["largest lag, s"]))
    told = {name: count for name, count in heard.status.items() if name.endswith("too slow")}
    counted = {name: count for name, count in now["stream"].items() if "too slow" in name}
    said = [reason for reason in now["reasons"] if reason["kind"] == "views dropped"]
    found: dict[str, Any] = {"slower": slow, "largest_lag_s": lag_s, "told": told, "counted": counted, "verdict": said}
    well = lag_s <= LAG_S and bool(told) == bool(counted) == bool(said)
    reference = reference or next((keep / "offline" / "reference").glob("*.tum"), None)
    if reference is not None:
        found["error_live_m"], found["error_offline_m"] = (error_m(keep / name, reference) for name in ("live", "offline"))
        well = well and found["error_live_m"] <= ERROR_RATIO * found["error_offline_m"]
    return {**found, "overload_passed": well}


def with_odometry_at(bag: Path, rate_hz: float, settings: list[str], out: Path) -> Path:
    """The bag with odometry at another rate, interpolated between its messages."""
    stream = BagStream(bag, Config.load(None, dict(_pairs(settings))))
    topic = stream.uses["odometry"]
    with AnyReader([bag]) as reader, Writer(out) as writer:
        topics = {
            one.id: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore) for one in reader.connections
        }
        kept = [(at_ns, one.id, data) for one, at_ns, data in reader.messages() if one.topic != topic]
        (moving,) = (one for one in reader.connections if one.topic == topic)
        moves = [reader.deserialize(data, moving.msgtype) for _, _, data in reader.messages([moving])]
        stamps_ns = np.array([one.header.stamp.sec * NS_PER_S + one.header.stamp.nanosec for one in moves])
        poses = np.array([planar(one.pose.pose.position, one.pose.pose.orientation) for one in moves])
        dense_ns = np.arange(stamps_ns[0], stamps_ns[-1], round(NS_PER_S / rate_hz))
        for stamp_ns in dense_ns.tolist():
            after = max(int(np.searchsorted(stamps_ns, stamp_ns)), 1)
            share = (stamp_ns - stamps_ns[after - 1]) / (stamps_ns[after] - stamps_ns[after - 1])
            kept.append(
                (
                    stamp_ns,
                    moving.id,
                    _moved(reader.typestore, moves[0], moving.msgtype, stamp_ns, poses[after - 1 : after + 1], share),
                )
            )
        for at_ns, connection, data in sorted(kept, key=lambda row: row[0]):
            writer.write(topics[connection], at_ns, bytes(data))
    return out


def _moved(store: Any, like: Any, msgtype: str, stamp_ns: int, poses: Any, share: float) -> bytes:
    x, y, yaw_rad = interpolate(poses[0], poses[1], share)
    like.header.stamp.sec, like.header.stamp.nanosec = divmod(stamp_ns, NS_PER_S)
    position, turned = like.pose.pose.position, like.pose.pose.orientation
    position.x, position.y = float(x), float(y)
    turned.x = turned.y = 0.0
    turned.z, turned.w = float(np.sin(yaw_rad / 2)), float(np.cos(yaw_rad / 2))
    return bytes(store.serialize_ros1(like, msgtype))


def main() -> int:
    """Prove and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("--ros", type=int, choices=(1, 2), default=1)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--seconds", type=float, default=None, help="of the recording")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    parser.add_argument("--odometry-hz", type=float, default=None, help="odometry at this rate, interpolated")
    parser.add_argument("--overload", type=float, default=0.0, metavar="N", help="make mapping N times too slow for the rate")
    parser.add_argument(
        "--reference",
        type=Path,
        default=None,
        help="true trajectory (TUM), for the errors under overload; default: the source's",
    )
    parser.add_argument("--no-checks", action="store_true", help="the graph and the times alone, no services and transforms")
    parser.add_argument("--ros-folder", type=Path, default=None, help="default: ~/.cache/hybridmap/ros1 or ros2")
    parser.add_argument("--keep", type=Path, default=None, help="folder for the bag and both sessions; default: none is kept")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        keep = given.keep or Path(scratch)
        keep.mkdir(parents=True, exist_ok=True)
        found = prove(given, keep)
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
