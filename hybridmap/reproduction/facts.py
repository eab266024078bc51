"""The figures that the texts of `paper` name in braces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hybridmap.metrics import Metric
from hybridmap.reproduction.cells import PAPER_NETWORK_M, PAPER_ODOMETRY_M, End
from hybridmap.reproduction.systems import SystemResult
from hybridmap.study.statistics import Interval
from hybridmap.verification.drives import office_laps

NOT_RUN = "(not run)"
"""Stands for the error of a system that was not run."""

_OF_SYSTEMS = ("ate ", "odometry ")


class Facts(dict[str, str]):
    """Name of a figure -> its text. The error of a system that was not run is said to be so; any other name must be known."""

    def __missing__(self, name: str) -> str:
        if name.startswith(_OF_SYSTEMS):
            return NOT_RUN
        raise KeyError(name)

    def fill(self, text: str) -> str:
        """A text with the figures in the place of the names in braces."""
        return text.format_map(self)


def facts_of(rows: Sequence[Metric], results: Sequence[SystemResult], ends: Mapping[int, End]) -> Facts:
    """Every figure that a text may name.

    Args:
        rows: the table of the verification.
        results: the systems.
        ends: seed -> where path integration over 16.8 m ends.
    """
    found = {row.name.removeprefix("verify/"): f"{row.value:.3g}" for row in rows}
    found["office lap"] = f"{office_laps(1.0)[1]:.0f}"
    for one in results:
        found[f"odometry {one.world} {one.system}"] = metres(one.odometry_m)
        found[f"ate {one.world} {one.system}"] = metres(one.error_m) + (f" ({one.without_map})" if one.lost else "")
    for name in ("network", "odometry", "truth"):
        x, y = np.median([getattr(end, name) for end in ends.values()], axis=0)
        found |= {f"end {name} x": f"{x:.2f}", f"end {name} y": f"{y:.2f}"}
    apart = [np.subtract(end.network, end.odometry) for end in ends.values()]
    gain = PAPER_NETWORK_M[0] / PAPER_ODOMETRY_M[0]
    found |= {
        "end apart": f"{1e3 * float(np.linalg.norm(apart, axis=1).max()):.2g}",
        "end gain": f"{gain:.3f}",
        "end gained y": f"{gain * PAPER_ODOMETRY_M[1]:.2f}",
    }
    return Facts(found)


def metres(found: Interval) -> str:
    """A median error in m, with three digits; a dash if there is none."""
    return f"{found.value:.3g} m" if found.count else "–"
