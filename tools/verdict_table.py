"""Hold the verdicts of studies against the truth: a table, and every map of which the verdict was wrong.

    hybridmap study verdicts --out verdicts
    hybridmap study drift --out drift
    python tools/verdict_table.py verdicts drift

A map is wrong if its error is more than three times that of the clean map of the same source and back-end, and above 5 cm.
The clean map is the median over the seeds in the first setting without false loops. A back-end that rejects more than 5 % of
the true loops even there has no clean map; the best one of the source stands for it. A wrong map must not be trusted; of the
right ones at most 5 % may be doubted. Exit code 1 if not.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from hybridmap.study.measures import NEAR_M
from hybridmap.verdict import Verdict

TIMES = 3.0
DOUBTED_MAX = 0.05
ERRORS = ("ate_m", "relation_m")
GROUP = ("source", "backend")
LOST_MAX_PERCENT = 5.0
"""Most true loops that a back-end may reject from clean data for its map to count as clean."""


@dataclass(frozen=True)
class Judged:
    """One map of a study.

    Attributes:
        name: source, setting, false loops, seed and back-end.
        error_m, clean_m: its error, and that of the clean map.
        verdict: what was said about it.
    """

    name: str
    error_m: float
    clean_m: float
    verdict: Verdict

    @property
    def wrong(self) -> bool:
        """Whether the map is wrong; one without an error is no map, and wrong."""
        return not self.error_m <= max(TIMES * self.clean_m, NEAR_M)


def main() -> None:
    """Print the table of the studies named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", type=Path, nargs="+", help="folders of studies")
    maps = [one for folder in parser.parse_args().studies for one in judged(folder)]
    raise SystemExit(show(maps))


def judged(folder: Path) -> list[Judged]:
    """Read every map of a study; dead reckoning is none."""
    with (folder / "cells.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["backend"] != "odometry" and row.get("verdict")]
    if not rows:
        raise SystemExit(f"{folder}: holds no verdict; expected a study of this version")
    clean = clean_errors(rows)
    labels = (*GROUP[:1], "setting", "false_loop_kind", "false_loop_rate", "seed", *GROUP[1:])
    return [
        Judged(
            ", ".join(filter(None, (row[label] for label in labels))),
            error(row),
            clean.get(tuple(row[key] for key in GROUP), 0.0),
            list(Verdict)[int(row["verdict"])],
        )
        for row in rows
    ]


def clean_errors(rows: list[dict[str, str]]) -> dict[tuple[str, ...], float]:
    """(Source, back-end) -> error of its clean map, m."""
    errors: dict[tuple[str, ...], list[float]] = {}
    lost: dict[tuple[str, ...], list[float]] = {}
    for row in rows:
        if row["setting"] == rows[0]["setting"] and float(row.get("false_loop_rate") or 0.0) == 0.0:
            group = tuple(row[key] for key in GROUP)
            errors.setdefault(group, []).append(error(row))
            lost.setdefault(group, []).append(float(row.get("own_lost_percent") or 0.0))
    median = {group: statistics.median(values) for group, values in errors.items()}
    whole = {group for group, values in lost.items() if statistics.median(values) <= LOST_MAX_PERCENT}
    best = {source: min((median[group] for group in whole if group[0] == source), default=None) for source, _ in median}
    return {group: value if group in whole or (other := best[group[0]]) is None else other for group, value in median.items()}


def error(row: dict[str, str]) -> float:
    """Error of a map in m; NaN if it has none."""
    return next((float(row[name]) for name in ERRORS if row.get(name)), math.nan)


def show(maps: Iterable[Judged]) -> int:
    """Print the table and the maps of which the verdict was wrong. Return 1 if a bar is missed, else 0."""
    maps = list(maps)
    count = Counter((one.wrong, one.verdict) for one in maps)
    print("| map | maps | " + " | ".join(Verdict) + " |\n|---|---:|" + "---:|" * len(Verdict))
    for name, wrong in (("right", False), ("wrong", True)):
        cells = [count[wrong, verdict] for verdict in Verdict]
        print(f"| {name} | {sum(cells)} | " + " | ".join(map(str, cells)) + " |")
    for one in maps:
        if one.wrong == (one.verdict is Verdict.TRUSTED):
            said = "wrong and trusted" if one.wrong else f"right and {one.verdict}"
            print(f"{said}: {one.name}: {one.error_m:.4f} m, clean {one.clean_m:.4f} m")
    right = sum(number for (wrong, _), number in count.items() if not wrong)
    doubted = right - count[False, Verdict.TRUSTED]
    return int(count[True, Verdict.TRUSTED] > 0 or doubted > DOUBTED_MAX * right)


if __name__ == "__main__":
    main()
