"""Edges of sessions against the truth, kind by kind: errors, calibration of covariances, wrong ones and their weights.

    python tools/edge_errors.py DIR [DIR ...] [--reference GT.tum] [--map]

The truth is the session's own reference, or a file, or (`--map`) the final map of the session itself: then an edge is
compared with what it helped to make, so that errors come out too small, but a false one still stands out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from hybridmap.evaluate.edges import EdgeErrors, edge_errors, edge_errors_on
from hybridmap.graph.edges import EdgeKind
from hybridmap.store import MapStore, SessionFolder
from hybridmap.trajectory import read_tum


def judged(folder: Path, reference: Path | None, on_map: bool) -> dict[EdgeKind, EdgeErrors]:
    """Errors of a session's edges, with the weights of its primary back-end."""
    with MapStore.open(folder) as store:
        experiences, solution = store.map(), store.solutions()[store.primary]
    weights = solution.report.weights
    if on_map:
        return edge_errors_on(experiences, solution.poses, weights=weights)
    return edge_errors(experiences, read_tum(reference or SessionFolder(folder).groundtruth), weights)


def main() -> None:
    """Print a line a kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="session folders")
    parser.add_argument("--reference", type=Path, metavar="GT.tum", help="true trajectory of base_link")
    parser.add_argument("--map", action="store_true", help="compare with the final map of the primary back-end instead")
    options = parser.parse_args()
    titles = ("n", "m: median", "p95", "deg: median", "p95", "chi2 ratio", "wrong", "kept")
    print(f"{'session':20} {'edges':12}" + "".join(f" {title:>11}" for title in titles))
    for folder in options.folders:
        for kind, e in judged(folder, options.reference, options.map).items():
            metres = (e.trans_median_m, e.trans_p95_m, e.rot_median_deg, e.rot_p95_deg, e.chi2_ratio)
            row = [f"{e.count:d}", *(f"{value:.4f}" for value in metres), f"{e.wrong:d}", f"{e.wrong_kept:d}"]
            print(f"{folder.name:20.20} {kind.name.lower():12}" + "".join(f" {cell:>11}" for cell in row))


if __name__ == "__main__":
    main()
