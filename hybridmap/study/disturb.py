"""Disturbances of a drive before it is mapped: worse scans, frames, wheels and clocks, and kidnapping.

A disturbance is a function in `TABLE`; a study gives its name and strength. Strength 0 changes nothing. The same seed
gives the same bits.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import ConfigError
from hybridmap.geometry import IDENTITY, Array, between, compose, wrap_angle
from hybridmap.streams.base import Motion, Observation, Rig, Sample, SelfMotion
from hybridmap.streams.laser import LaserScan
from hybridmap.streams.order import ReorderBuffer
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.trajectory import NS_PER_S

Ranges = NDArray[np.float32]
Samples = Iterable[Sample]
KIDNAPPED = "kidnapped_s"
_Seen = TypeVar("_Seen", bound=Observation)

_NEAR_DEPTH_M = 1.0  # at this depth its noise is as strong as it is told; it grows with the square of the depth
_ANY = (-math.inf, math.inf)
_SHARE = (0.0, 1.0)
_EXPOSURE_S = (0.0, 10.0)  # a longer one smears a turn over the whole picture anyway
_DELAY_S = (-1e4, 1e4)  # longer than a drive; it has to fit into a stamp
_TIME_S = (0.0, 1e6)  # eleven days, longer than a drive
_SLIP = (0.3, 0.05, math.radians(15.0))  # standard deviations of a slip: ahead, sideways (m), and turn (rad)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """An entry of the table of disturbances.

    Attributes:
        apply: (samples, strength, generator, rig) -> disturbed samples. The strength is a number, or a tuple of `count`.
        by_chance: whether the disturbance uses random numbers.
        bounds: least and greatest strength that a study may give.
        count: how many numbers the strength consists of.
    """

    apply: Callable[[Samples, Any, np.random.Generator, Rig], Iterator[Sample]]
    by_chance: bool = False
    bounds: tuple[float, float] = _ANY
    count: int = 1


def disturbed(samples: Samples, rig: Rig, disturbances: Mapping[str, float | tuple[float, ...]], seed: int) -> Iterator[Sample]:
    """Disturb the samples of a drive while they are read; the disturbances are applied in the order of `TABLE`.

    Args:
        samples: samples of a stream, in order of stamp; they are not changed in place.
        rig: the sensors of the stream.
        disturbances: name (a key of `TABLE`) -> strength; a missing one and a strength of 0 change nothing. Names are not
            checked, see `check`.
        seed: seed of the random disturbances; each has a generator of its own, so that one does not change another.

    Returns:
        The disturbed samples, in order of stamp.
    """
    for name, one in TABLE.items():
        strength = disturbances.get(name, 0.0)
        if np.any(strength):
            samples = one.apply(samples, strength, np.random.default_rng([seed, zlib.crc32(name.encode())]), rig)
    return iter(samples)


def by_chance(disturbances: Mapping[str, float | tuple[float, ...]]) -> bool:
    """Whether any of the disturbances (name -> strength) uses random numbers, so that the samples depend on the seed."""
    return any(TABLE[name].by_chance and np.any(strength) for name, strength in disturbances.items())


def check(name: str, strength: float | tuple[float, ...], origin: str) -> None:
    """Check the name and the strength of a disturbance that a study asks for; `origin` names the study in the error.

    Raises:
        ConfigError: an unknown disturbance, or an invalid strength.
    """
    if name not in TABLE:
        raise ConfigError(f"{origin}: unknown disturbance {name!r}; there are {', '.join(TABLE)}")
    numbers = (strength,) if isinstance(strength, float) else strength
    if np.any(strength) and len(numbers) != TABLE[name].count:
        raise ConfigError(f"{origin}: disturb: {name}: expected {TABLE[name].count} number(s), found {len(numbers)}")
    least, most = TABLE[name].bounds
    beyond = next((number for number in numbers if not least <= number <= most), None)
    if beyond is not None:
        raise ConfigError(f"{origin}: disturb: {name}: expected {least:g} to {most:g}, found {beyond:g}")
    if name == KIDNAPPED and np.any(strength) and not numbers[0] < numbers[1] < numbers[2]:
        found = ", ".join(f"{number:g}" for number in numbers)
        raise ConfigError(
            f"{origin}: disturb: {name}: expected [picked up, put down, end], ascending seconds from the first stamp,"
            f" found [{found}]"
        )


def scan_range_m(ranges: Ranges, limit_m: float, _rng: np.random.Generator) -> Ranges:
    """Set the ranges of one scan, m, that reach `limit_m` or more to NaN (no return)."""
    return np.where(ranges < limit_m, ranges, np.float32(np.nan))


def scan_covered(ranges: Ranges, share: float, _rng: np.random.Generator) -> Ranges:
    """Set this share (0..1) of the ranges of one scan to NaN: half of it at either end of the field of view."""
    ranges, covered = ranges.copy(), round(0.5 * share * len(ranges))
    ranges[:covered] = ranges[len(ranges) - covered :] = np.nan
    return ranges


def scan_noise_m(ranges: Ranges, sigma_m: float, rng: np.random.Generator) -> Ranges:
    """Add white noise of standard deviation `sigma_m` to every range of one scan, m, drawn anew for each scan."""
    return ranges + np.float32(sigma_m) * rng.standard_normal(ranges.shape, dtype=np.float32)


def beams_lost(ranges: Ranges, share: float, rng: np.random.Generator) -> Ranges:
    """Set a random share (0..1) of the ranges of one scan to NaN, drawn anew for each scan."""
    return np.where(rng.random(ranges.shape) < share, np.float32(np.nan), ranges)


def beams_short(ranges: Ranges, share: float, rng: np.random.Generator) -> Ranges:
    """Shorten a random share (0..1) of the ranges of one scan, each to a random part of itself, as dust or passers-by would.

    Both are drawn anew for each scan.
    """
    stopped, where = rng.random((2, *ranges.shape), dtype=np.float32)
    return np.where(stopped < share, where * ranges, ranges)


def blur_s(samples: Samples, exposure_s: float, _rng: np.random.Generator, rig: Rig) -> Iterator[Sample]:
    """Blur colour images along their rows, as the robot's turn during an exposure of `exposure_s` would.

    The turn rate is that of the last two odometry messages. Depth and scans stay.
    """
    newest: SelfMotion | None = None
    rate_rad_s, camera = 0.0, rig.sensors.get("camera")
    for sample in samples:
        if isinstance(sample, SelfMotion):
            if newest is not None and sample.stamp_ns > newest.stamp_ns:
                turn = wrap_angle(sample.pose_odom_robot[2] - newest.pose_odom_robot[2])
                rate_rad_s = abs(float(turn)) * NS_PER_S / (sample.stamp_ns - newest.stamp_ns)
            newest = sample
        elif isinstance(sample, RgbdFrame) and camera is not None:
            width = max(1, round(rate_rad_s * exposure_s * camera.fx_px))
            sample = replace(sample, color=np.asarray(cv2.blur(sample.color, (width, 1)), dtype=np.uint8))
        yield sample


def darker(frame: RgbdFrame, share: float, _rng: np.random.Generator) -> RgbdFrame:
    """Reduce every colour value of one frame by this share (0..1): 0.9 is like dusk; 1 gives a black image. Depth stays."""
    return replace(frame, color=np.rint(round(1.0 - share, 9) * frame.color).astype(np.uint8))


def color_noise(frame: RgbdFrame, sigma: float, rng: np.random.Generator) -> RgbdFrame:
    """Add white noise of standard deviation `sigma` to every colour value of one frame, drawn anew; the sum stays in 0..255."""
    grain = np.float32(sigma) * rng.standard_normal(frame.color.shape, dtype=np.float32)
    return replace(frame, color=np.clip(frame.color + grain + np.float32(0.5), 0, 255).astype(np.uint8))


def depth_noise_m(frame: RgbdFrame, sigma_m: float, rng: np.random.Generator) -> RgbdFrame:
    """Add white noise to every depth of one frame, drawn anew; pixels without depth (0) stay without.

    Its standard deviation is `sigma_m` at 1 m and grows with the square of the depth.
    """
    grain = np.float32(sigma_m) * rng.standard_normal(frame.depth_m.shape, dtype=np.float32)
    noisy = frame.depth_m + grain * (frame.depth_m / np.float32(_NEAR_DEPTH_M)) ** 2
    return replace(frame, depth_m=np.where(frame.depth_m > 0.0, np.maximum(noisy, 0.0), frame.depth_m))


def depth_range_m(frame: RgbdFrame, limit_m: float, _rng: np.random.Generator) -> RgbdFrame:
    """Set depth of one frame beyond `limit_m` to 0 (no depth)."""
    return replace(frame, depth_m=np.where(frame.depth_m > limit_m, np.float32(0.0), frame.depth_m))


def depth_lost(frame: RgbdFrame, share: float, rng: np.random.Generator) -> RgbdFrame:
    """Set the depth of a random share (0..1) of the pixels of one frame to 0 (no depth), drawn anew for each frame."""
    gone = rng.random(frame.depth_m.shape, dtype=np.float32) < share
    return replace(frame, depth_m=np.where(gone, np.float32(0.0), frame.depth_m))


def wheel_scale(step: Array, share: float, _rng: np.random.Generator) -> Array:
    """Increase the translation of an odometry step (3,), m and rad, by this share of it (negative: reduce it)."""
    factors: Array = np.array([1.0 + share, 1.0 + share, 1.0])
    return step * factors


def wheel_turn_scale(step: Array, share: float, _rng: np.random.Generator) -> Array:
    """Increase the turn of an odometry step (3,), m and rad, by this share of it (negative: reduce it)."""
    factors: Array = np.array([1.0, 1.0, 1.0 + share])
    return step * factors


def wheel_pull_deg_per_m(step: Array, bias_deg: float, _rng: np.random.Generator) -> Array:
    """Add a turn of `bias_deg` per metre driven to an odometry step (3,), m and rad; positive is to the left."""
    return _turned(step, math.radians(bias_deg) * math.hypot(step[0], step[1]))


def wheel_noise_deg_per_sqrt_m(step: Array, sigma_deg: float, rng: np.random.Generator) -> Array:
    """Add a random turn to an odometry step (3,), m and rad, of standard deviation `sigma_deg` times the root of its metres."""
    return _turned(step, rng.normal() * math.radians(sigma_deg) * math.sqrt(math.hypot(step[0], step[1])))


def _turned(step: Array, turn_rad: float) -> Array:
    more: Array = np.array([0.0, 0.0, turn_rad])
    return step + more


def wheel_slips_per_m(step: Array, rate: float, rng: np.random.Generator) -> Array:
    """Add slips to random odometry steps (3,), m and rad, on average `rate` slips per metre driven.

    A slip is normal noise with standard deviations of 0.3 m ahead, 0.05 m sideways and 15 degrees.
    """
    hit, slip = rng.random() < rate * math.hypot(step[0], step[1]), rng.normal(size=3) * _SLIP
    return step + slip if hit else step


def views_lost(samples: Samples, share: float, _rng: np.random.Generator, _rig: Rig) -> Iterator[Sample]:
    """Leave out this share (0..1) of the scans and frames at regular intervals, as a lower sensor rate would; not random."""
    number, kept = 0, 1.0 - share
    for sample in samples:
        if isinstance(sample, Observation):
            number += 1
            if math.ceil(number * kept - 1e-9) == math.ceil((number - 1) * kept - 1e-9):
                continue
        yield sample


def views_late_s(samples: Samples, late_s: float, _rng: np.random.Generator, _rig: Rig) -> Iterator[Sample]:
    """Make scans and frames late by `late_s` against odometry: odometry is stamped that much earlier (later if negative).

    The stamps of the views stay, so that a map is compared with the same truth. Samples are yielded in order of the new stamps.
    """
    order, early_ns = ReorderBuffer(abs(late_s)), round(late_s * NS_PER_S)
    for sample in samples:
        moved = isinstance(sample, Motion)
        yield from order.push(replace(sample, stamp_ns=sample.stamp_ns - early_ns) if moved else sample)
    yield from order.flush()


def kidnapped_s(
    samples: Samples, times_s: tuple[float, float, float], _rng: np.random.Generator, _rig: Rig
) -> Iterator[Sample]:
    """Kidnap the robot at `times_s`: picked up, put down, end of the drive; seconds from the first stamp.

    Samples between the first two times, and after the third, are left out. Odometry continues from its last pose, as the wheels
    do not turn.
    """
    up_ns = down_ns = end_ns = -1
    held, onward = IDENTITY, None
    for sample in samples:
        if end_ns < 0:
            up_ns, down_ns, end_ns = (sample.stamp_ns + round(time_s * NS_PER_S) for time_s in times_s)
        if sample.stamp_ns > end_ns:
            return
        before, after = sample.stamp_ns <= up_ns, sample.stamp_ns >= down_ns
        if isinstance(sample, SelfMotion) and before:
            held = sample.pose_odom_robot
        elif isinstance(sample, SelfMotion) and after:
            onward = sample.pose_odom_robot if onward is None else onward
            sample = replace(sample, pose_odom_robot=compose(held, between(onward, sample.pose_odom_robot)))
        if before or (after and onward is not None):
            yield sample


def _each(
    kind: type[_Seen],
    change: Callable[[_Seen, float, np.random.Generator], _Seen],
    *,
    by_chance: bool = False,
    bounds: tuple[float, float] = _ANY,
) -> Disturbance:
    """Apply a function to every sample of a kind by itself."""

    def apply(samples: Samples, strength: float, rng: np.random.Generator, _rig: Rig) -> Iterator[Sample]:
        for sample in samples:
            yield change(sample, strength, rng) if isinstance(sample, kind) else sample

    return Disturbance(apply, by_chance, bounds)


def _ranges(change: Callable[[Ranges, float, np.random.Generator], Ranges]) -> Callable[..., LaserScan]:
    """Apply a function to the ranges of every scan."""
    return lambda scan, strength, rng: replace(scan, ranges_m=change(scan.ranges_m, strength, rng))


def _wheels(change: Callable[[Array, float, np.random.Generator], Array], *, by_chance: bool = False) -> Disturbance:
    """Apply a function to every step between two odometry messages, in the robot's frame."""

    def apply(samples: Samples, strength: float, rng: np.random.Generator, _rig: Rig) -> Iterator[Sample]:
        before: Array | None = None
        pose = IDENTITY
        for sample in samples:
            if isinstance(sample, SelfMotion):
                given = sample.pose_odom_robot
                pose = given if before is None else compose(pose, change(between(before, given), strength, rng))
                before, sample = given, replace(sample, pose_odom_robot=pose)
            yield sample

    return Disturbance(apply, by_chance)


TABLE: dict[str, Disturbance] = {
    "scan_range_m": _each(LaserScan, _ranges(scan_range_m)),
    "scan_covered": _each(LaserScan, _ranges(scan_covered), bounds=_SHARE),
    "scan_noise_m": _each(LaserScan, _ranges(scan_noise_m), by_chance=True),
    "beams_short": _each(LaserScan, _ranges(beams_short), by_chance=True, bounds=_SHARE),
    "beams_lost": _each(LaserScan, _ranges(beams_lost), by_chance=True, bounds=_SHARE),
    "blur_s": Disturbance(blur_s, bounds=_EXPOSURE_S),
    "darker": _each(RgbdFrame, darker, bounds=_SHARE),
    "color_noise": _each(RgbdFrame, color_noise, by_chance=True),
    "depth_noise_m": _each(RgbdFrame, depth_noise_m, by_chance=True),
    "depth_range_m": _each(RgbdFrame, depth_range_m),
    "depth_lost": _each(RgbdFrame, depth_lost, by_chance=True, bounds=_SHARE),
    "wheel_scale": _wheels(wheel_scale),
    "wheel_turn_scale": _wheels(wheel_turn_scale),
    "wheel_pull_deg_per_m": _wheels(wheel_pull_deg_per_m),
    "wheel_noise_deg_per_sqrt_m": _wheels(wheel_noise_deg_per_sqrt_m, by_chance=True),
    "wheel_slips_per_m": _wheels(wheel_slips_per_m, by_chance=True),
    "views_lost": Disturbance(views_lost, bounds=_SHARE),
    "views_late_s": Disturbance(views_late_s, bounds=_DELAY_S),
    KIDNAPPED: Disturbance(kidnapped_s, bounds=_TIME_S, count=3),
}
"""Name -> disturbance, in the order in which they are applied."""
