"""Why the edges of sessions are not in the graph: how many by each check that failed and each thing that they lacked.

    python tools/edge_records.py DIR [DIR ...]

The exit code is 1 where an edge is not in the graph and its record does not say why, or is in it against its record.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from hybridmap.graph.edges import Edge, Status
from hybridmap.store import MapStore


def why(edge: Edge) -> str:
    """The named lack or the first failed check of an edge; empty where there is neither."""
    return f"lack: {edge.lack}" if edge.lack else edge.failed[0].figure if edge.failed else ""


def main() -> None:
    """Print a table a session."""
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
