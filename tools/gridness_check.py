"""Compare the grid scores of cells along a recorded path with those that opexebo, of the Moser group, gives the same rate maps.

Needs opexebo (`pip install opexebo scikit-image`), which is no dependency of the package. RatInABox ships a rat's path
(`ratinabox/data/sargolini.npz`), which this tool takes as it is. Exits with 1 if a score differs by more than 0.05.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.verification import read_path, verify_along
from hybridmap.verification.recorded import RecordedPath

BAR = 0.05


def main() -> None:
    """Print both scores of every grid cell, and the largest difference."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, help="TUM, CSV or NWB file, or an npz file with t (s) and pos (m)")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    score = opexebo_score()
    result = verify_along(_read(asked.path), asked.seed, {}, shuffles=1, workers=1)
    worst = 0.0
    print("module  Sargolini  Langston  opexebo")
    for _, cell, found in result.of_kind("grid"):
        theirs = score(found.rates)
        worst = max(worst, abs(found.scores["langston"] - theirs))
        print(f"{cell.module:6d}  {found.scores['sargolini']:9.4f}  {found.scores['langston']:8.4f}  {theirs:7.4f}")
    print(f"largest difference of Langston's score from opexebo's: {worst:.4f}, at most {BAR:g}")
    sys.exit(0 if worst <= BAR else 1)


def opexebo_score() -> Any:
    """The function of opexebo from a rate map (H, W), Hz, to its grid score."""
    analysis = import_module("opexebo.analysis")
    module: Any = sys.modules["opexebo.analysis.grid_score"]
    radius = module._findCentreRadius
    module._findCentreRadius = lambda *args, **kwargs: float(
        np.squeeze(radius(*args, **kwargs))
    )  # an array of one: numpy < 2.4
    return lambda rates: float(analysis.grid_score(analysis.autocorrelation(rates))[0])


def _read(path: Path) -> RecordedPath:
    if path.suffix != ".npz":
        return read_path(path)
    with np.load(path) as data:
        return RecordedPath(np.round(1e9 * data["t"]).astype(np.int64), data["pos"], None, None, path.name)


if __name__ == "__main__":
    main()
