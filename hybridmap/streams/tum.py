"""A folder in the TUM RGB-D format, with files of wheel odometry and calibration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from hybridmap.config.inputs import CameraIntrinsics, CameraMounting, SensorsConfig
from hybridmap.config.root import Config, is_allowed
from hybridmap.config.section import read_mapping
from hybridmap.errors import StreamError, counted
from hybridmap.geometry import Array
from hybridmap.streams.base import Rig, Sample, SelfMotion, StreamReport
from hybridmap.streams.cameras import (
    Calibration,
    check_size,
    clean_depth,
    decode_picture,
    depth_from_units,
    from_intrinsics,
    mounted,
)
from hybridmap.streams.mounting import invert, matrix, planar
from hybridmap.streams.order import Window, check_overlap, first_of, merge, sorted_order
from hybridmap.streams.pairing import pair_nearest
from hybridmap.streams.rgbd import RGBD, RgbdFrame, pinhole
from hybridmap.streams.sensors import wanted
from hybridmap.trajectory import Trajectory, read_stamp_ns, read_tum


@dataclass(frozen=True, slots=True)
class _Pair:
    precedence: ClassVar[int] = RgbdFrame.precedence
    stamp_ns: int
    color: Path
    depth: Path


class TumStream:
    """A folder in the TUM RGB-D format as a stream.

    It holds `rgb/` and `depth/` with their lists or `associations.txt`, `odometry.txt` (poses of base_link), and `camera.yaml`
    unless the configuration has its content.
    """

    def __init__(self, folder: Path, config: Config, window: Window | None = None, *, skip_damaged: bool = False) -> None:
        """Read the lists, the odometry and the calibration, and check that every image exists.

        Args:
            folder: the folder.
            config: calibration, mounting, synchronisation.
            window: the part to use.
            skip_damaged: leave out pictures that are damaged or missing, and count them, instead of ending with an error.

        Raises:
            StreamError: a file is missing, damaged or contradicts another; the message names it.
        """
        self.name = folder.name or str(folder)
        self._folder, self._sensors, self._skip_damaged = folder, config.sensors, skip_damaged
        self.report = StreamReport()
        self.remarks: list[str] = []
        self._odometry = self._read_odometry()
        self._calibration, self._T_base_camera, self._units_per_m = _read_calibration(folder, config.sensors)
        self._pairs, self.losses = _read_pairs(folder, config.sensors.sync_tolerance_s)
        kinds = wanted(config.vision.sensor)
        if not kinds:
            self._pairs = []
        elif all(kind.sensor_name != RGBD.sensor_name for kind in kinds):
            raise StreamError(f"{folder}: no {kinds[0].needs}: a TUM folder holds {RGBD.needs}; set vision.sensor to rgbd")
        for path in (path for pair in self._pairs for path in (pair.color, pair.depth)):
            if not path.is_file() and not skip_damaged:
                raise StreamError(f"{path}: no such picture, though the folder's lists name it")
        if self._pairs and all(
            self._readable(pair) is None for pair in self._pairs
        ):  # sizes and kinds that contradict each other show at once
            raise StreamError(f"{folder}: none of its {counted(len(self._pairs), 'picture')} can be read")
        frame_ns = np.array([pair.stamp_ns for pair in self._pairs], dtype=np.int64)
        check_overlap(self._odometry.stamps_ns, frame_ns, str(folder))
        self.rig = Rig(camera=pinhole(self._calibration, self._T_base_camera) if self._pairs else None)
        self.groundtruth = self._read_groundtruth()
        self._apply(window or Window())

    @property
    def expected_observations(self) -> int | None:
        """Number of frames in the part of the recording that is used."""
        return len(self._pairs)

    def __iter__(self) -> Iterator[Sample]:
        """Yield odometry and frames in order of stamp.

        Raises:
            StreamError: an image is damaged, or of another size or kind than expected.
        """
        return self.onward(0, StreamReport(dict(self.losses), list(self.remarks)))

    def first_stamps(self, count: int) -> tuple[int, ...]:
        """Stamps of the first samples, ns; see `SeekableStream`."""
        return first_of(count, self._odometry.stamps_ns, (pair.stamp_ns for pair in self._pairs))

    def onward(self, taken: int, report: StreamReport) -> Iterator[Sample]:
        """Iterate without the first `taken` samples, whose pictures are not read; see `SeekableStream`.

        Raises:
            StreamError: an image is damaged, or of another size or kind than expected.
        """
        self.report = report
        due: Iterator[SelfMotion | _Pair] = merge(self._motions(), self._pairs)
        for item in islice(due, taken + len(report.skipped), None):
            sample = self._readable(item) if isinstance(item, _Pair) else item
            if sample is not None:
                report.count("odometry" if isinstance(sample, SelfMotion) else RGBD.counted)
                yield sample

    @property
    def uses(self) -> dict[str, str]:
        """Role (such as `odometry`, `color`) -> file that the samples come from."""
        listed = (self._folder / "associations.txt").is_file()
        lists = {"frames": "associations.txt"} if listed else {"color": "rgb.txt", "depth": "depth.txt"}
        truths = [name for name in ("groundtruth_base.txt", "groundtruth.txt") if (self._folder / name).is_file()]
        found = {"odometry": self._sensors.odometry_file or "odometry.txt"} | (lists if self._pairs else {})
        return found | ({"groundtruth": truths[0]} if truths else {})

    def _motions(self) -> Iterator[SelfMotion]:
        for stamp, pose in zip(self._odometry.stamps_ns, self._odometry.poses, strict=True):
            yield SelfMotion(int(stamp), pose)

    def _readable(self, pair: _Pair) -> RgbdFrame | None:
        """The frame of a pair; None if it is damaged and damaged ones are skipped."""
        try:
            return self._frame(pair)
        except StreamError as error:
            if not self._skip_damaged:
                raise
            name = next(name for role, name in self.uses.items() if role in ("frames", "color"))
            self.report.skip(name, len(self._pairs), pair.stamp_ns, str(error).removeprefix(f"{self._folder}/"))
            return None

    def _frame(self, pair: _Pair) -> RgbdFrame:
        color, depth = _read_color(pair.color), _read_depth(pair.depth)
        if color.shape[:2] != depth.shape:
            raise StreamError(
                f"{pair.depth}: depth is {depth.shape[1]}x{depth.shape[0]}, colour {color.shape[1]}x{color.shape[0]}; "
                "expected depth registered to colour"
            )
        check_size(color, self._calibration, str(pair.color))
        depth_m = clean_depth(depth_from_units(depth, self._units_per_m), self._sensors)
        color, depth_m = self._calibration.undistort_color(color), self._calibration.undistort_depth(depth_m)
        return RgbdFrame(pair.stamp_ns, color, depth_m)

    def _read_odometry(self) -> Trajectory:
        named = self._sensors.odometry_file
        path = self._folder / (named or "odometry.txt")
        if path.is_file():
            return read_tum(path)
        others = sorted(p.name for p in self._folder.glob("*odom*.txt"))
        hint = f"; found {', '.join(others)}: name one as sensors.odometry_file" if others else ""
        raise StreamError(
            f"{path}: no odometry: expected `stamp x y z qx qy qz qw` lines with the wheel odometry of base_link{hint}"
        )

    def _read_groundtruth(self) -> Trajectory | None:
        """`groundtruth_base.txt`, else `groundtruth.txt` (of the camera), transformed to the base by `base_to_camera`."""
        base, camera = self._folder / "groundtruth_base.txt", self._folder / "groundtruth.txt"
        if base.is_file():
            return read_tum(base)
        if not camera.is_file():
            return None
        stamps, rows = _read_poses(camera)
        T_camera_base = invert(self._T_base_camera)
        poses = [planar(matrix(tuple(row[:3]), tuple(row[3:])) @ T_camera_base) for row in rows]
        return Trajectory(stamps, np.array(poses))

    def _apply(self, window: Window) -> None:
        first = min([int(self._odometry.stamps_ns[0])] + [pair.stamp_ns for pair in self._pairs[:1]])
        low, high = window.limits_over(self._odometry.stamps_ns, first, str(self._folder))
        inside = (self._odometry.stamps_ns >= low) & (self._odometry.stamps_ns <= high)
        self._odometry = Trajectory(self._odometry.stamps_ns[inside], self._odometry.poses[inside])
        self._pairs = [pair for pair in self._pairs if low <= pair.stamp_ns <= high]


def _stamp_ns(text: str, path: Path, number: int) -> int:
    try:
        return read_stamp_ns(text)
    except ValueError as error:
        raise StreamError(f"{path}:{number}: {error}") from None


_LINES = {2: "`stamp file`", 4: "`stamp file stamp file`", 8: "`stamp x y z qx qy qz qw`"}
"""Number of fields of a line -> its format."""


def _read_lines(path: Path, fields: int) -> list[tuple[int, list[str]]]:
    """(line number, fields) of a list file without comments."""
    if not path.is_file():
        raise StreamError(f"{path}: no such file; a TUM folder needs associations.txt, or rgb.txt and depth.txt")
    lines = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if words and len(words) < fields:
            raise StreamError(f"{path}:{number}: expected {fields} fields {_LINES[fields]}, found {len(words)}")
        if words:
            lines.append((number, words))
    if not lines:
        raise StreamError(f"{path}: names no picture; expected one line {_LINES[fields]} per picture")
    return lines


def read_picture_list(path: Path, stamp_column: int = 0) -> tuple[NDArray[np.int64], list[list[str]]]:
    """Read the list of images `rgb.txt`, `depth.txt` or `associations.txt`.

    Args:
        path: of the list.
        stamp_column: column of the stamp to sort by, from 0; `associations.txt` has two, 0 and 2.

    Returns:
        Stamps (N,), ns, ascending, and in the same order all fields of each line.

    Raises:
        StreamError: the file is missing, empty or damaged, or its stamps are out of order by more than one line.
    """
    lines = _read_lines(path, 4 if path.name == "associations.txt" else 2)
    stamps = np.array([_stamp_ns(words[stamp_column], path, number) for number, words in lines], dtype=np.int64)
    order = sorted_order(stamps, str(path))
    return stamps[order], [lines[i][1] for i in order]


def _read_pairs(folder: Path, tolerance_s: float) -> tuple[list[_Pair], dict[str, int]]:
    """Pairs of colour and depth images, and the number of images without a partner."""
    listed = folder / "associations.txt"
    if listed.is_file():
        return _read_associations(listed), {}
    color_ns, colors = read_picture_list(folder / "rgb.txt")
    depth_ns, depths = read_picture_list(folder / "depth.txt")
    pairs = pair_nearest(color_ns, depth_ns, tolerance_s)
    losses = {"unmatched color": pairs.unmatched_color, "unmatched depth": pairs.unmatched_depth}
    if not len(pairs.color):
        raise StreamError(f"{folder}: no colour picture has a depth picture within sensors.sync_tolerance_s = {tolerance_s} s")
    matched = zip(pairs.color, pairs.depth, strict=True)
    return [_Pair(int(color_ns[i]), folder / colors[i][1], folder / depths[j][1]) for i, j in matched], losses


def _read_associations(path: Path) -> list[_Pair]:
    """`stamp rgb stamp depth`, or with depth first if the first image is a depth image."""
    first = _read_lines(path, 4)[0][1]
    swapped = "depth" in first[1] and "depth" not in first[3]
    color, depth = (2, 0) if swapped else (0, 2)
    stamps, lines = read_picture_list(path, stamp_column=color)
    named = zip(stamps, lines, strict=True)
    return [_Pair(int(stamp), path.parent / words[color + 1], path.parent / words[depth + 1]) for stamp, words in named]


def _read_poses(path: Path) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) and rows (N, 7) `x y z qx qy qz qw` of a TUM file; of equal stamps the first is kept."""
    stamps = read_tum(path).stamps_ns  # says what is wrong with the file, if anything is
    rows: dict[int, list[float]] = {}
    for number, words in _read_lines(path, 8):
        rows.setdefault(_stamp_ns(words[0].rstrip(","), path, number), [float(word.rstrip(",")) for word in words[1:8]])
    return stamps, np.array([rows[int(stamp)] for stamp in stamps])


def _read_calibration(folder: Path, sensors: SensorsConfig) -> tuple[Calibration, Array, float]:
    """Intrinsics, (4, 4) pose of the optical frame in the base, and depth units per metre."""
    path = folder / "camera.yaml"
    tree = read_mapping(path, StreamError) if path.is_file() else {}
    camera, mounting = tree.get("camera") or {}, tree.get("base_to_camera") or {}
    if sensors.camera_intrinsics is None and not camera:
        raise StreamError(
            f"{path}: no calibration: expected a section `camera`, or sensors.camera_intrinsics in the configuration"
        )
    if sensors.camera_mounting is None and not mounting:
        raise StreamError(
            f"{path}: no mounting: expected a section `base_to_camera`, or sensors.camera_mounting in the configuration"
        )
    try:
        calibration = from_intrinsics(sensors.camera_intrinsics or _intrinsics_of(camera))
        given = sensors.camera_mounting or CameraMounting(
            translation_m=tuple(mounting["translation"]), quaternion_xyzw=tuple(mounting["quaternion_xyzw"])
        )
        units_per_m = float(sensors.depth_scale or camera["depth_scale"])
    except (KeyError, TypeError, ValueError) as error:
        found = str(error).replace("\n", " ")[:160]
        raise StreamError(f"{path}: missing or unusable entry: {found}") from None
    if not is_allowed("sensors.depth_scale", units_per_m):
        raise StreamError(f"{path}: camera.depth_scale: found {units_per_m:g}, expected units per metre, 0.001 to 1e6")
    return calibration, mounted(given), units_per_m


def _intrinsics_of(camera: dict[str, Any]) -> CameraIntrinsics:
    return CameraIntrinsics(
        width_px=camera["width"],
        height_px=camera["height"],
        fx_px=camera["fx"],
        fy_px=camera["fy"],
        cx_px=camera["cx"],
        cy_px=camera["cy"],
        distortion=tuple(camera.get("distortion") or ()),
    )


def _load(path: Path, flags: int) -> NDArray[Any]:
    try:
        return decode_picture(path.read_bytes(), flags)
    except OSError as error:
        raise StreamError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise StreamError(f"{path}: a picture that {error}") from None


def _read_color(path: Path) -> NDArray[np.uint8]:
    import cv2

    return np.ascontiguousarray(_load(path, cv2.IMREAD_COLOR)[..., ::-1], dtype=np.uint8)


def _read_depth(path: Path) -> NDArray[np.uint16]:
    import cv2

    depth = _load(path, cv2.IMREAD_UNCHANGED)
    if depth.ndim != 2 or depth.dtype != np.uint16:
        raise StreamError(f"{path}: found a picture {depth.shape} of {depth.dtype}, expected one channel of 16 bit")
    return depth
