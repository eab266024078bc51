"""Move each numeric setting by 30 % down and up, map a recording each time, and record what that does to the error of the map.

    python tools/sensitivity.py aces.bag --config laser --relations relations.txt --end 200
    hybridmap simulate lab --out lab.mcap
    python tools/sensitivity.py lab.mcap --config rgbd

The error is that of the primary back-end, which runs alone: the mean translation error over verified relations, or the ATE
against the recording's own truth. Rows are added to `docs/sensitivity.csv` one by one, and those that are there are not run
again, so that a run can be broken off and taken up; delete the file to begin anew. `tools/configuration_page.py` shows those
that matter.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from configuration_page import SENSITIVITY, tables

from hybridmap import session
from hybridmap.config import Config
from hybridmap.errors import ConfigError
from hybridmap.evaluate.relations import relation_errors, relations_of
from hybridmap.evaluate.trajectory_errors import absolute_error
from hybridmap.streams.open import open_stream
from hybridmap.trajectory import read_tum

SHARE, MATTERS = 0.3, 0.02
FIELDS = ("recording", "setting", "usual", "value", "error_m", "usual_m", "change", "matters")
ELSEWHERE = {"laser": ("vision.rgbd.",), "rgbd": ("vision.laser.",)}
NOT_THE_MAPPER = ("seed", "simulation.")
"""Settings of the world and its noise, not of the mapper."""


def main() -> None:
    """Parse the command line, map, write rows."""
    options = _parser().parse_args()
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(options, Path(folder))
        known = {(row["recording"], row["setting"], row["value"]) for row in rows(options.out)}
        usual_m = trial.error_m({})
        print(f"{trial.name}: {usual_m:.5f} m as it is", flush=True)
        for key, usual, value in moved(trial.config, ELSEWHERE.get(options.config, ())):
            if (trial.name, key, f"{value:g}") in known:
                continue
            try:
                error_m = trial.error_m({key: value})
            except ConfigError as error:
                print(error, flush=True)
                continue
            change = error_m / usual_m - 1.0
            row = (trial.name, key, f"{usual:g}", f"{value:g}", f"{error_m:.5f}", f"{usual_m:.5f}", f"{100 * change:+.1f} %")
            add(options.out, (*row, "yes" if abs(change) > MATTERS else "no"))
            print(" ".join(row), flush=True)


class Trial:
    """One recording, mapped again and again."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.name = Path(options.source).name
        self.config = Config.load(options.config)
        self._options, self._folder = options, folder

    def error_m(self, settings: dict[str, Any]) -> float:
        """Error of the primary back-end, m, with some settings of their own."""
        primary = self.config.backends.names[0]
        config = Config.load(self._options.config, {"backends.names": [primary], **settings})
        stream = open_stream(self._options.source, config, end_s=self._options.end)
        out = self._folder / "session"
        session.run(stream, config, out, overwrite=True)
        estimate = read_tum(out / "trajectory" / f"{primary}.tum")
        if self._options.relations is not None:
            return relation_errors(estimate, relations_of(self._options.relations, estimate)).all.trans_mean_m
        if stream.groundtruth is None:
            raise ConfigError(f"{self.name}: holds no truth; give --relations")
        return absolute_error(estimate, stream.groundtruth).rmse_m


def moved(config: Config, elsewhere: tuple[str, ...]) -> Iterator[tuple[str, float, float]]:
    """Each numeric setting that is not 0: its key, its value, and the value 30 % down and up."""
    for setting in (setting for table in tables() for setting in table.settings):
        usual: Any = config
        for name in setting.key.split("."):
            usual = getattr(usual, name, None)
        number = isinstance(usual, (int, float)) and not isinstance(usual, bool)
        if not number or usual == 0 or setting.key.startswith((*NOT_THE_MAPPER, *elsewhere)):
            continue
        for sign in (-1, 1):
            if isinstance(usual, int):
                yield setting.key, usual, usual + sign * max(1, round(SHARE * usual))
            else:
                yield setting.key, usual, usual * (1.0 + sign * SHARE)


def rows(path: Path) -> list[dict[str, str]]:
    """What has been recorded."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def add(path: Path, row: tuple[str, ...]) -> None:
    """Write one more row, with the header before the first."""
    new = not path.is_file()
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([FIELDS, row] if new else [row])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="a recording")
    parser.add_argument("--config", default="laser", help="configuration whose settings are moved")
    parser.add_argument("--relations", type=Path, help="file of verified relations, where the recording holds no truth")
    parser.add_argument("--end", type=float, help="seconds of the recording that are mapped")
    parser.add_argument("--out", type=Path, default=SENSITIVITY, help="CSV file that rows are added to")
    return parser


if __name__ == "__main__":
    main()
