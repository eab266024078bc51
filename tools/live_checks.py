"""What a client of `hybridmap ros1` checks besides the graph: transforms, services, `/map`, smoothed speeds.

Used by `live_proof.py`. rospy must be on the path before a `Client` is made.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.geometry import Array, compose, interpolate
from hybridmap.live import LiveLimits
from hybridmap.trajectory import NS_PER_S, read_tum

TRANSFORM_M = 0.01
"""Bar: 95 % of the poses of the online trajectory are `map -> odom -> base_link` within this, by the raw correction, m."""
_JITTER_S = 0.15
"""A message may come so much later than the one before it than it was published."""
_LATER_NS = 3 * NS_PER_S
_PROGRAM = (sys.executable, "-c", "from hybridmap.cli import main; main()")


class Client:
    """Listens beside the node, and calls its services."""

    def __init__(self, odometry_topic: str) -> None:
        """Subscribe; `odometry_topic` may be /tf."""
        import rospy
        from geometry_msgs.msg import TransformStamped
        from nav_msgs.msg import Odometry
        from tf2_msgs.msg import TFMessage

        self._lock = threading.Lock()
        self.frames: set[tuple[str, str]] = set()
        self.stamps_ns: list[int] = []
        self.poses: list[Array] = []  # of odometry, at these stamps
        self.raw: list[tuple[int, Array]] = []
        self.smooth: list[tuple[float, Array, Array]] = []  # when it came; the correction; the newest odometry
        self._by_tf = odometry_topic.startswith("/tf")
        if not self._by_tf:
            rospy.Subscriber(odometry_topic, Odometry, self._moved, tcp_nodelay=True)
        rospy.Subscriber("/hybridmap/map_to_odom", TransformStamped, self._corrected, tcp_nodelay=True)
        rospy.Subscriber("/tf", TFMessage, self._transformed, tcp_nodelay=True)

    def _moved(self, message: Any) -> None:
        self._add(message.header.stamp.to_nsec(), planar(message.pose.pose.position, message.pose.pose.orientation))

    def _add(self, stamp_ns: int, pose: Array) -> None:
        with self._lock:
            if not self.stamps_ns or stamp_ns > self.stamps_ns[-1]:
                self.stamps_ns.append(stamp_ns)
                self.poses.append(pose)

    def _corrected(self, message: Any) -> None:
        pose = planar(message.transform.translation, message.transform.rotation)
        self.raw.append((message.header.stamp.to_nsec(), pose))

    def _transformed(self, message: Any) -> None:
        for one in message.transforms:
            frames, pose = (one.header.frame_id, one.child_frame_id), planar(one.transform.translation, one.transform.rotation)
            if frames == ("map", "odom"):
                self.frames.add(frames)
                self.smooth.append((time.monotonic(), pose, self.poses[-1] if self.poses else np.zeros(3)))
            elif self._by_tf and frames[0] == "odom":
                self._add(one.header.stamp.to_nsec(), pose)

    def transforms(self, session: Path, primary: str, odometry_later_s: float) -> dict[str, Any]:
        """Hold `map -> odom -> base_link` against the online trajectory of a session, and the smoothed one against its limits.

        Args:
            session: its folder.
            primary: name of its primary back-end.
            odometry_later_s: what the mapper adds to the stamps of odometry once it knows it.
        """
        online = read_tum(session / "trajectory" / f"{primary}_online.tum")
        raw_ns = np.array([stamp_ns for stamp_ns, _ in self.raw], dtype=np.int64)
        raw = np.array([pose for _, pose in self.raw])
        off_m = []
        for stamp_ns, pose in zip(online.stamps_ns.tolist(), online.poses, strict=True):
            near = raw[(raw_ns >= stamp_ns) & (raw_ns <= stamp_ns + _LATER_NS)]
            moved = [self._odometry(stamp_ns - later_ns) for later_ns in (0, round(odometry_later_s * NS_PER_S))]
            off = [np.hypot(*(compose(near, one) - pose)[:, :2].T).min() for one in moved if one is not None and len(near)]
            off_m += [float(min(off))] if off else []
        speeds = np.array(self._speeds() or [(0.0, 0.0)])
        limits = LiveLimits()
        quantiles = np.percentile(off_m or [np.inf], (50, 95, 100))
        return {
            "tf_frames": sorted(self.frames),
            "tf_poses_compared": len(off_m),
            "tf_off_online_p50_p95_max_m": [round(float(one), 5) for one in quantiles],
            "smoothed_steps": len(speeds),
            "smoothed_m_s": float(speeds[:, 0].max()),
            "smoothed_deg_s": float(speeds[:, 1].max()),
            "tf_passed": bool(self.frames == {("map", "odom")} and quantiles[1] <= TRANSFORM_M),
            "smoothed_passed": bool((speeds <= [limits.correction_m_s, limits.correction_deg_s]).all()),
        }

    def _odometry(self, stamp_ns: int) -> Array | None:
        after = bisect_left(self.stamps_ns, stamp_ns)
        if after in (0, len(self.stamps_ns)):
            return None
        before_ns, after_ns = self.stamps_ns[after - 1 : after + 1]
        return interpolate(self.poses[after - 1], self.poses[after], (stamp_ns - before_ns) / (after_ns - before_ns))

    def _speeds(self) -> list[tuple[float, float]]:
        """Speed of the robot on the map by changes of the smoothed correction alone, m/s and degrees/s, at every step."""
        found = []
        for (before_s, before, moved), (now_s, now, _) in zip(self.smooth, self.smooth[1:], strict=False):
            step = compose(now, moved) - compose(before, moved)
            turned = abs(np.rad2deg(np.arctan2(np.sin(step[2]), np.cos(step[2]))))
            dt_s = now_s - before_s + _JITTER_S
            found.append((float(np.hypot(step[0], step[1])) / dt_s, float(turned) / dt_s))
        return found


def planar(position: Any, q: Any) -> Array:
    """(3,) x, y and heading of a pose of ROS."""
    return np.array([position.x, position.y, np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))])


def call_services(out: Path, folder: Path, resolution_m: float = 0.05) -> dict[str, Any]:
    """Call every service that leaves the map as it is, and read the grid back by the rules of map_server.

    Args:
        out: session folder of the node; all that was played is on its map.
        folder: where the exported grid goes.
        resolution_m: side of its cells.
    """
    from nav_msgs.srv import GetMap
    from std_srvs.srv import Empty, SetBool, Trigger

    pause, resume = _call("/hybridmap/pause", Empty), _call("/hybridmap/resume", Empty)
    saved, kept = _call("/hybridmap/save_map", Trigger), _call("/hybridmap/serialize_map", Trigger)
    mode, base = _call("/hybridmap/set_localization_mode", SetBool, False), _call("/hybridmap/deserialize_map", Trigger)
    grid = _call("/dynamic_map", GetMap).map
    exported = [*_PROGRAM, "-q", "export", str(out), "--format", "grid", "--resolution", str(resolution_m)]
    subprocess.run([*exported, "--out", str(folder / "exported.yaml")], check=True, stdout=subprocess.DEVNULL)
    files = [read_by_map_server(path) for path in (out.with_name(f"{out.name}.yaml"), folder / "exported.yaml")]
    served = np.array(grid.data, dtype=np.int64).reshape(grid.info.height, grid.info.width)
    frame = [grid.info.resolution, grid.info.origin.position.x, grid.info.origin.position.y]
    same = [cells.shape == served.shape and bool((cells == served).all()) for cells, _ in files]
    placed = [bool(np.allclose(one, frame, atol=1e-6)) for _, one in files]
    answered = {
        "pause": pause is not None,
        "resume": resume is not None,
        "save_map": saved.success,
        "serialize_map": kept.success,
        "set_localization_mode": mode.success,
        "deserialize_map refused without --map": not base.success and "--map" in base.message,
        "dynamic_map": bool((served == 100).any() and (served == 0).any() and (served == -1).any()),
    }
    return {
        "services": answered,
        "map_cells_occupied_free_unknown": [int((served == value).sum()) for value in (100, 0, -1)],
        "map_is_that_of_save_map": same[0] and placed[0],
        "map_is_the_exported_grid": same[1] and placed[1],
        "services_passed": bool(all(answered.values()) and all(same) and all(placed)),
    }


def call_on_known_map(nodes: Callable[[], int], play: Callable[[], None], base: Path) -> dict[str, Any]:
    """Call what begins anew or localises, of a node that was started with `--map`; it must be mapping.

    Args:
        nodes: the number of nodes of its map, as the diagnostics have it.
        play: plays the drive again, which is a new map after the reset.
        base: the session folder of the finished map.
    """
    import rospy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from std_srvs.srv import Empty, SetBool, Trigger

    before = digest(base)
    teller = rospy.Publisher("/initialpose", PoseWithCovarianceStamped, queue_size=1, latch=True)
    wrong = PoseWithCovarianceStamped()
    wrong.header.frame_id, wrong.pose.pose.position.x, wrong.pose.pose.orientation.w = "known_map", 500.0, 1.0
    teller.publish(wrong)
    first, off = nodes(), _call("/hybridmap/set_localization_mode", SetBool, False)
    _call("/hybridmap/reset", Empty)
    again, on = _call("/hybridmap/deserialize_map", Trigger), _call("/hybridmap/set_localization_mode", SetBool, True)
    teller.publish(wrong)
    play()
    answered = {
        "set_localization_mode": bool(off.success and on.success),
        "deserialize_map": bool(again.success),
        "reset": first > 0 and nodes() > 0,
        "the finished map is as it was": digest(base) == before,
    }
    return {"services_on_known_map": answered, "known_map_passed": all(answered.values())}


def digest(session: Path) -> str:
    """Hash of the map file of a session."""
    return hashlib.sha256((session / "map.db").read_bytes()).hexdigest()


def _call(name: str, kind: Any, *arguments: Any) -> Any:
    import rospy

    rospy.wait_for_service(name, 60.0)
    return rospy.ServiceProxy(name, kind)(*arguments)


def read_by_map_server(yaml: Path) -> tuple[NDArray[np.int64], list[float]]:
    """Cells (H, W), row by row from the lower left, as map_server publishes the files of a map; resolution and origin, m."""
    words = dict(line.split(": ", 1) for line in yaml.read_text().splitlines())
    head, size, _, pixels = (yaml.parent / words["image"]).read_bytes().split(b"\n", 3)
    assert head == b"P5"
    width, height = map(int, size.split())
    values = np.frombuffer(pixels, np.uint8).reshape(height, width)[::-1].astype(float)
    occupied = (values if int(words["negate"]) else 255.0 - values) / 255.0
    cells = np.full(occupied.shape, -1, dtype=np.int64)
    cells[occupied > float(words["occupied_thresh"])] = 100
    cells[occupied < float(words["free_thresh"])] = 0
    origin = [float(one) for one in words["origin"].strip("[]").split(",")]
    return cells, [float(words["resolution"]), *origin[:2]]
