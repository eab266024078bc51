"""Write a folder in the TUM RGB-D format, with wheel odometry, ground truth and calibration."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StreamError
from hybridmap.geometry import Array
from hybridmap.output import staged
from hybridmap.simulation.writers.messages import (
    RECORDING,
    Progress,
    millimetres,
    quaternion_of,
    quaternion_of_rotation,
    silent,
)
from hybridmap.streams.base import SelfMotion, Stream
from hybridmap.streams.rgbd import Camera, RgbdFrame
from hybridmap.trajectory import format_stamp

UNITS_PER_M = 5000
_UNITS_PER_MM = 5
_LARGEST_MM = 65535 // _UNITS_PER_MM
_POSE_HEADER = "# timestamp tx ty tz qx qy qz qw\n"


def write_tum(stream: Stream, folder: Path, *, overwrite: bool = False, progress: Progress = silent) -> dict[str, int]:
    """Write `rgb/`, `depth/`, their lists, `odometry.txt`, `camera.yaml`, and `groundtruth_base.txt` if the truth is known.

    Args:
        stream: with poses as self-motion and a camera.
        folder: to be made.
        overwrite: replace a recording that is there.
        progress: called after every frame with the number written, and that of all observations, None if unknown.

    Returns:
        Numbers by name: `odometry` (poses), `frames`, and `scans left out`, which such a folder cannot hold, if there are any.

    Raises:
        OutputError: the place is taken or cannot be written to.
        StreamError: the stream has no camera, or depth beyond 13.1 m.
    """
    camera = stream.rig.sensors.get("camera")
    if camera is None:
        raise StreamError(f"{folder}: a TUM folder holds colour and depth, and {stream.name} has no camera; write a bag")
    left_out = 0
    with staged(folder, kind=RECORDING, overwrite=overwrite) as work:
        partial = work / folder.name
        for name in ("rgb", "depth"):
            (partial / name).mkdir(parents=True)
        odometry: list[str] = []
        stamps: list[str] = []
        for sample in stream:
            if isinstance(sample, SelfMotion):
                odometry.append(_pose_line(sample.stamp_ns, sample.pose_odom_robot))
            elif isinstance(sample, RgbdFrame):
                stamps.append(format_stamp(sample.stamp_ns))
                _write_pictures(partial, stamps[-1], sample)
                progress(len(stamps), stream.expected_observations)
            else:
                left_out += 1
        _write_lists(partial, stamps)
        _write_poses(partial / "odometry.txt", "wheel odometry: base_link in odom", odometry)
        if (truth := stream.groundtruth) is not None:
            lines = [_pose_line(int(stamp), pose) for stamp, pose in zip(truth.stamps_ns, truth.poses, strict=True)]
            _write_poses(partial / "groundtruth_base.txt", "true pose of base_link in the world", lines)
        (partial / "camera.yaml").write_text(_calibration(camera), encoding="utf-8")
    counts = {"odometry": len(odometry), "frames": len(stamps)}
    return counts | ({"scans left out": left_out} if left_out else {})


def _pose_line(stamp_ns: int, pose: Array) -> str:
    q = quaternion_of(float(pose[2]))
    return f"{format_stamp(stamp_ns)} {pose[0]:.17g} {pose[1]:.17g} 0 0 0 {q[2]:.17g} {q[3]:.17g}\n"


def _write_poses(path: Path, what: str, lines: Iterable[str]) -> None:
    path.write_text(f"# {what}\n{_POSE_HEADER}{''.join(lines)}", encoding="utf-8")


def _write_lists(folder: Path, stamps: list[str]) -> None:
    for name, what in (("rgb", "color images"), ("depth", f"depth maps (16 bit, metres * {UNITS_PER_M}, 0 = none)")):
        lines = "".join(f"{stamp} {name}/{stamp}.png\n" for stamp in stamps)
        (folder / f"{name}.txt").write_text(f"# {what}\n# timestamp filename\n{lines}", encoding="utf-8")
    pairs = "".join(f"{stamp} rgb/{stamp}.png {stamp} depth/{stamp}.png\n" for stamp in stamps)
    (folder / "associations.txt").write_text(pairs, encoding="utf-8")


def _write_pictures(folder: Path, stamp: str, frame: RgbdFrame) -> None:
    depth_mm = millimetres(frame.depth_m)
    if int(depth_mm.max(initial=0)) > _LARGEST_MM:
        raise StreamError(f"{folder.name}: depth of {depth_mm.max()} mm at {stamp}; a TUM folder holds up to {_LARGEST_MM} mm")
    _write_png(folder / "rgb" / f"{stamp}.png", np.ascontiguousarray(frame.color[..., ::-1]))
    _write_png(folder / "depth" / f"{stamp}.png", depth_mm * np.uint16(_UNITS_PER_MM))


def _write_png(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    import cv2

    done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert done
    path.write_bytes(data.tobytes())


def _calibration(camera: Camera) -> str:
    T = camera.T_base_camera
    quaternion = ", ".join(repr(float(value)) for value in quaternion_of_rotation(T[:3, :3]))
    translation = ", ".join(repr(float(value)) for value in T[:3, 3])
    return f"""camera:
  model: pinhole
  width: {camera.width_px}
  height: {camera.height_px}
  fx: {float(camera.fx_px)!r}
  fy: {float(camera.fy_px)!r}
  cx: {float(camera.cx_px)!r}
  cy: {float(camera.cy_px)!r}
  distortion: [0.0, 0.0, 0.0, 0.0, 0.0]
  depth_scale: {float(UNITS_PER_M)}
base_to_camera:   # pose of the optical frame (x right, y down, z forward) in base_link
  translation: [{translation}]
  quaternion_xyzw: [{quaternion}]
"""
