"""Count the reasons why edges of sessions are not in the graph.

    python tools/edge_records.py DIR [DIR ...]

A reason is the first failed check of an edge, or what the edge lacks, such as support. The exit code is 1 if an edge outside
the graph has no reason in its record, or if an edge in the graph has one.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from hybridmap.graph.edges import Edge, Status
from hybridmap.store import MapStore


def why(edge: Edge) -> str:
    """Return what an edge lacks, or its first failed check. Return an empty text if there is neither."""
    return f"lack: {edge.lack}" if edge.lack else edge.failed[0].figure if edge.failed else ""


def main() -> None:
    """Print a table for each session."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="session folders")
    unexplained = 0
    for folder in parser.parse_args().folders:
        with MapStore.open(folder) as store:
            edges = store.map().edges
        wrong = [edge for edge in edges if (edge.status is Status.ACCEPTED) == bool(why(edge))]
        unexplained += len(wrong)
        counts = Counter((str(edge.status), why(edge)) for edge in edges if edge.status is not Status.ACCEPTED)
        print(f"{folder.name}: {len(edges)} edges, {counts.total()} not in the graph, {len(wrong)} unexplained")
        for (status, reason), count in counts.most_common():
            print(f"  {count:6d} {status:10} {reason}")
    sys.exit(bool(unexplained))


if __name__ == "__main__":
    main()
