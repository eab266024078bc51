"""What is measured of the cells alone: the verification, and where path integration over 16.8 m ends. Each is stored."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap import provenance
from hybridmap.config import Config
from hybridmap.geometry import Array, between
from hybridmap.metrics import Metric
from hybridmap.neural import PathIntegrator
from hybridmap.output import write_text
from hybridmap.simulation import SimulatedStream
from hybridmap.simulation.stream import ODOMETRY_RATE_HZ
from hybridmap.verification import Scale, rows_of, verification
from hybridmap.verification.page import figures_of
from hybridmap.verification.rows import recurrence_verdict

CELLS, ENDS = "verification.json", "ends.json"
"""Names of the files in which these are stored, in the folder of a reproduction."""

PAPER_NETWORK_M, PAPER_ODOMETRY_M = (16.88, 0.58), (16.57, 0.56)
"""Where the paper's network and its wheel odometry end after 16.8 m."""

_SEED = 0
_ARRIVED_M = 1e-3


@dataclass(frozen=True, slots=True)
class CellsMeasured:
    """The verification of the cells.

    Attributes:
        rows: its table.
        figures: name -> its pictures, as `data:` URIs.
        recurrence: sentences on what recurrent competition does for place fields.
    """

    rows: list[Metric]
    figures: dict[str, str]
    recurrence: str


@dataclass(frozen=True, slots=True)
class End:
    """Where a drive of 16.8 m down the corridor ends, (x, y) from its start, m: of one seed of the wheels' errors.

    Attributes:
        truth: in the world.
        odometry: by composing the increments of the wheels.
        network: by the cells, from the same increments.
    """

    truth: tuple[float, float]
    odometry: tuple[float, float]
    network: tuple[float, float]


def measured_cells(folder: Path, scale: Scale, progress: Callable[[int, int | None], None] | None = None) -> CellsMeasured:
    """The verification of the cells of the configuration `paper`: stored in the folder by an earlier run, or made now.

    Args:
        folder: folder of the reproduction.
        scale: size of the experiments.
        progress: called with the number of finished experiments and of all.
    """
    settings = Config.load("paper").neural.model_dump()
    sizes = {name: value for name, value in asdict(scale).items() if name != "workers"}
    key = provenance.digest({"code": _code(), "scale": sizes, "settings": settings, "seed": _SEED})
    stored = _stored(folder / CELLS, key)
    if stored is None:
        result = verification.verify_cells(_SEED, scale, settings, progress)
        stored = {
            "rows": [asdict(row) for row in rows_of(result)],
            "figures": figures_of(result),
            "recurrence": recurrence_verdict(result.place),
        }
        _keep(folder / CELLS, key, stored)
    return CellsMeasured([Metric(**row) for row in stored["rows"]], stored["figures"], stored["recurrence"])


def ends(folder: Path, seeds: Sequence[int]) -> dict[int, End]:
    """Seed -> where the drive ends, for each of the seeds: stored in the folder by an earlier run, or computed now."""
    key = provenance.digest({"code": _code(), "settings": _corridor().model_dump(mode="json")})
    stored = _stored(folder / ENDS, key) or {}
    missing = [seed for seed in seeds if str(seed) not in stored]
    if missing:
        stored |= {str(seed): asdict(_end(seed)) for seed in missing}
        _keep(folder / ENDS, key, stored)
    return {seed: End(**{name: tuple(point) for name, point in stored[str(seed)].items()}) for seed in seeds}


def _end(seed: int) -> End:
    """Drive the simulated corridor once, as its robot does, and integrate what its wheels say."""
    config = _corridor()
    stream = SimulatedStream(config.simulation, seed)
    truth, wheels = stream.groundtruth.poses, stream.odometry.poses
    ahead_m = truth[:, 0] - truth[0, 0]
    last = int(np.argmax(ahead_m > ahead_m.max() - _ARRIVED_M))
    integrator = PathIntegrator(config.neural)
    for delta in between(wheels[:last], wheels[1 : last + 1]):
        integrator.step(delta, 1.0 / ODOMETRY_RATE_HZ)
    return End(_place(between(truth[0], truth[last])), _place(between(wheels[0], wheels[last])), _place(integrator.pose))


def _corridor() -> Config:
    return Config.load("paper", {"simulation.world": "corridor"})


def _code() -> list[str]:
    """Digests of the code on which the figures depend: the code of mapping, and this module."""
    return [provenance.mapping(), hashlib.sha256(Path(__file__).read_bytes()).hexdigest()]


def _place(pose: Array) -> tuple[float, float]:
    return float(pose[0]), float(pose[1])


def _stored(path: Path, key: str) -> dict[str, Any] | None:
    """What an earlier run stored under this key; None if there is nothing, or if the file is damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return dict(found["content"]) if found["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _keep(path: Path, key: str, content: dict[str, Any]) -> None:
    write_text(path, json.dumps({"key": key, "content": content}))
