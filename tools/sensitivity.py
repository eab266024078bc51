"""Measure how much each numeric setting changes the error of a map.

    python tools/sensitivity.py aces.bag --config laser --relations relations.txt --end 200
    hybridmap simulate lab --out lab.mcap
    python tools/sensitivity.py lab.mcap --config rgbd

Each setting is lowered by 30 % and raised by 30 %, and the recording is mapped each time. Only the primary back-end runs. The
error is the mean translation error over verified relations, or else the ATE against the ground truth in the recording.

Each result is one row of `docs/sensitivity.csv`. Rows that are in the file are not measured again, so an interrupted run can
be continued. Delete the file to start again. `tools/configuration_page.py` shows the settings that matter.
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
"""Settings of the simulated world and its noise. The mapper does not use them."""


def main() -> None:
    """Measure every setting that has no row yet."""
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
    """A recording that is mapped with changed settings."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.name = Path(options.source).name
        self.config = Config.load(options.config)
        self._options, self._folder = options, folder

    def error_m(self, settings: dict[str, Any]) -> float:
        """Map with some settings changed. Return the error of the primary back-end, in m."""
        primary = self.config.backends.names[0]
        config = Config.load(self._options.config, {"backends.names": [primary], **settings})
        stream = open_stream(self._options.source, config, end_s=self._options.end)
        out = self._folder / "session"
        session.run(stream, config, out, overwrite=True)
        estimate = read_tum(out / "trajectory" / f"{primary}.tum")
        if self._options.relations is not None:
            return relation_errors(estimate, relations_of(self._options.relations, estimate)).all.trans_mean_m
        if stream.groundtruth is None:
            raise ConfigError(f"{self.name}: holds no ground truth; give --relations")
        return absolute_error(estimate, stream.groundtruth).rmse_m


def moved(config: Config, elsewhere: tuple[str, ...]) -> Iterator[tuple[str, float, float]]:
    """Yield each numeric setting that is not 0, twice: its key, its usual value, and the lowered or raised value."""
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
    """Return the recorded rows."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def add(path: Path, row: tuple[str, ...]) -> None:
    """Append one row. A new file gets the header first."""
    new = not path.is_file()
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([FIELDS, row] if new else [row])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="recording to map")
    parser.add_argument("--config", default="laser", help="configuration whose settings are changed")
    parser.add_argument("--relations", type=Path, help="file of verified relations; needed where there is no ground truth")
    parser.add_argument("--end", type=float, help="map only the first so many seconds")
    parser.add_argument("--out", type=Path, default=SENSITIVITY, help="CSV file to which rows are added")
    return parser


if __name__ == "__main__":
    main()
