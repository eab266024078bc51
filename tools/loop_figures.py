"""How well each mode of matching tells places apart on a session with a reference.

    python tools/loop_figures.py DIR [DIR ...] [--reference GT.tum] [--json]

The profiles are made again from the stored pictures (of a laser: as they were stored, as a fan and, where it sees all around,
as a full circle). Every view is compared with all nodes that are at least 10 s older.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from hybridmap.evaluate.loops import every_mode

COLUMNS = {
    "revisits": "revisits",
    "pair_auc": "pair AUC",
    "top1": "top-1",
    "average_precision": "average precision",
    "recall_full_precision": "recall at 100 %",
}


def main() -> None:
    """Print a line a mode."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="session folders")
    parser.add_argument("--reference", type=Path, metavar="GT.tum", help="true trajectory of base_link")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    options = parser.parse_args()
    found = {str(folder): dict(every_mode(folder, options.reference)) for folder in options.folders}
    if options.json:
        print(json.dumps({name: {mode: asdict(errors) for mode, errors in rows.items()} for name, rows in found.items()}))
        return
    for name, rows in found.items():
        first = next(iter(rows.values()))
        print(f"{name}: {first.queries} views against all that are at least 10 s older, {first.pairs} pairs")
        print(f"{'mode':40}" + "".join(f"{title:>20}" for title in COLUMNS.values()))
        for mode, errors in rows.items():
            print(f"{mode:40}" + "".join(f"{getattr(errors, column):20.4g}" for column in COLUMNS))


if __name__ == "__main__":
    main()
