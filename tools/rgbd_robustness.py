"""Map simulated RGB-D drives through what real cameras and wheels bring; no map may be worse than odometry.

    python tools/rgbd_robustness.py --recordings /somewhere                      every case in the laboratory, seed 1
    python tools/rgbd_robustness.py --recordings /somewhere --worlds office --seeds 1 2 3 --cases holes "wheels 3x"

Pictures are spoilt and wheels replaced while a recorded drive is read, so that one rendering serves every case of a camera;
cameras of other sizes and rates have recordings of their own. An edge is *false* as in `rgbd_study.py`. Exit code 1 if a robust
map is worse than odometry or keeps a false edge.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from mapping_runs import Floats, map_stream, recorded
from numpy.typing import NDArray
from rgbd_study import figures_of

from hybridmap.cli.choose import parse_settings
from hybridmap.config import Config
from hybridmap.config.inputs import WheelErrorConfig
from hybridmap.metrics import Metric, to_json
from hybridmap.simulation.wheels import wheel_odometry
from hybridmap.streams.base import Rig, Sample, SelfMotion, Stream, StreamReport
from hybridmap.streams.open import open_stream
from hybridmap.streams.rgbd import RgbdFrame
from hybridmap.trajectory import NS_PER_S, Trajectory

MAP = "ate_gtsam-gnc"
EDGES = ("edge_median_cm", "edge_p95_cm", "chi2_loop", "chi2_registration")
SHOWN = ("recall", "loops", "false", *EDGES, "ate_odometry", MAP, "ate_relaxation-ratslam")


@dataclass(frozen=True)
class Case:
    """What is wrong with a drive.

    Attributes:
        lost: share of the depth pixels that are missing at random.
        range_max_m: no depth beyond.
        color_noise: standard deviation added to every colour value, of 255.
        exposure_s: time over which a picture is smeared by the robot's turn.
        light: factor on every colour value; 0: night, which a depth camera does not mind.
        noise, bias: factors on the random and on the systematic errors of the wheels.
        camera: settings of the simulated camera.
    """

    lost: float = 0.0
    range_max_m: float = np.inf
    color_noise: float = 0.0
    exposure_s: float = 0.0
    light: float = 1.0
    noise: float = 1.0
    bias: float = 1.0
    camera: tuple[int, int, float] | None = None


CASES: dict[str, Case] = {
    "as it is": Case(),
    "holes": Case(lost=0.3, range_max_m=4.0),
    "grain": Case(color_noise=12.0),
    "blur": Case(exposure_s=0.03),
    "holes, grain, blur": Case(lost=0.3, range_max_m=4.0, color_noise=12.0, exposure_s=0.03),
    "noise 3x": Case(noise=3.0),
    "bias 3x": Case(bias=3.0),
    "wheels 3x": Case(noise=3.0, bias=3.0),
    "all of it": Case(0.3, 4.0, 12.0, 0.03, 1.0, 3.0, 3.0),
    "dusk": Case(light=0.1),
    "night": Case(light=0.0),
    "night, wheels 3x": Case(light=0.0, noise=3.0, bias=3.0),
    "160x120@5": Case(camera=(160, 120, 5.0)),
    "160x120@30": Case(camera=(160, 120, 30.0)),
    "640x480@5": Case(camera=(640, 480, 5.0)),
    "640x480@30": Case(camera=(640, 480, 30.0)),
}


class Spoilt:
    """A recorded drive as a worse camera and worse wheels would have had it."""

    def __init__(self, stream: Stream, case: Case, seed: int) -> None:
        truth = stream.groundtruth
        assert truth is not None
        self.rig: Rig = stream.rig
        self.groundtruth: Trajectory = truth
        self.name = stream.name
        self._stream = stream
        self._case = case
        self._seed = seed
        self._odometry = None if case.noise == case.bias == 1.0 else self._wheels()

    @property
    def expected_observations(self) -> int | None:
        """As the recording."""
        return self._stream.expected_observations

    @property
    def report(self) -> StreamReport:
        """As the recording's."""
        return self._stream.report

    def __iter__(self) -> Iterator[Sample]:
        """The samples, spoilt; the same each time."""
        rng = np.random.default_rng(self._seed)
        for sample in self._stream:
            if isinstance(sample, RgbdFrame):
                yield self._picture(sample, rng)
            elif isinstance(sample, SelfMotion) and self._odometry is not None:
                yield replace(sample, pose_odom_robot=self._odometry.at([sample.stamp_ns])[0])
            else:
                yield sample

    def _wheels(self) -> Trajectory:
        usual = WheelErrorConfig()
        systematic = {"scale_bias", "turn_bias", "heading_bias_deg_per_m"}
        worse = {
            name: value * (self._case.bias if name in systematic else self._case.noise)
            for name, value in usual.model_dump().items()
        }
        errors = WheelErrorConfig(**worse)
        rng = np.random.default_rng([self._seed, 1])
        return Trajectory(self.groundtruth.stamps_ns, wheel_odometry(self.groundtruth.poses, errors, rng))

    def _picture(self, frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
        case, depth = self._case, frame.depth_m
        gone = depth > case.range_max_m
        if case.lost > 0.0:
            gone = gone | (rng.random(depth.shape, dtype=np.float32) < case.lost)
        color = np.rint(case.light * self._smeared(frame)).astype(np.uint8)
        if case.color_noise > 0.0:
            grain = np.float32(case.color_noise) * rng.standard_normal(color.shape, dtype=np.float32)
            color = np.clip(color + grain + np.float32(0.5), 0, 255).astype(np.uint8)
        return RgbdFrame(frame.stamp_ns, color, np.where(gone, np.float32(0.0), depth))

    def _smeared(self, frame: RgbdFrame) -> NDArray[np.uint8]:
        """The picture averaged along its rows over what the turn moves it within the exposure."""
        half_ns = round(0.5 * self._case.exposure_s * NS_PER_S)
        if half_ns == 0:
            return frame.color
        ends: Floats = self.groundtruth.at([frame.stamp_ns - half_ns, frame.stamp_ns + half_ns])
        turn = abs(float(np.angle(np.exp(1j * (ends[1, 2] - ends[0, 2])))))
        assert "camera" in self.rig.sensors
        width = max(1, round(turn * self.rig.sensors["camera"].fx_px))
        return np.asarray(cv2.blur(frame.color, (width, 1)), dtype=np.uint8)


def main() -> None:
    """Parse the command line, map, print."""
    options = _parser().parse_args()
    out = sys.stderr if options.json else sys.stdout
    print("| case | " + " | ".join(SHOWN) + " | |\n|---|" + "---:|" * len(SHOWN) + "---|", file=out, flush=True)
    metrics: list[Metric] = []
    for world, name, seed in product(options.worlds, options.cases, options.seeds):
        figures = figures_in(CASES[name], world, seed, options.recordings, options.set)
        found = held(f"{name}/{world}-{seed}", figures)
        cells = [f"{figures[figure]:.4g}" if figure in figures else "" for figure in SHOWN]
        verdict = "" if all(metric.passed for metric in found) else "✗"
        print(f"| {name}, {world} {seed} | " + " | ".join(cells) + f" | {verdict} |", file=out, flush=True)
        metrics += found
    if options.json:
        print(to_json({}, metrics))
    raise SystemExit(0 if all(metric.passed for metric in metrics) else 1)


def held(name: str, figures: dict[str, float]) -> list[Metric]:
    """The robust map's error, whose bar is that of odometry, and the false edges that it keeps, of which there may be none."""
    ate_m, odometry_m, false = figures[MAP], figures["ate_odometry"], figures["false"]
    return [
        Metric(f"{MAP}/{name}", ate_m, "m", "of the robust map", odometry_m, ate_m <= odometry_m),
        Metric(f"false/{name}", false, "1", "false loops with weight", 0.0, false == 0),
    ]


def figures_in(case: Case, world: str, seed: int, recordings: Path, settings: list[str]) -> dict[str, float]:
    """Every figure of one drive."""
    camera: dict[str, object] = {}
    if case.camera is not None:
        keys = ("width_px", "height_px", "rate_hz")
        camera = {f"simulation.camera.{key}": value for key, value in zip(keys, case.camera, strict=True)}
    config = Config.load(world, {"seed": seed, **camera, **parse_settings(settings)})
    stream = open_stream(recorded(world, seed, camera, recordings), config)
    return figures_of(map_stream(Spoilt(stream, case, seed), config))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True, help="folder in which the rendered drives are kept")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES), help="what is wrong")
    parser.add_argument("--worlds", nargs="+", default=["lab"], help="simulated worlds")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], help="seeds of the sensors' errors")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output; the table goes to stderr")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings")
    return parser


if __name__ == "__main__":
    main()
