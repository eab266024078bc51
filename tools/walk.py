"""Count the files of the package that take part when a laser scan becomes a node.

    python tools/walk.py [TREE] [--source SOURCE] [--end SECONDS]

The script maps a recording and notes each function that `Mapper.step` calls. For each new node it counts the files of these
functions. Functions compiled by numba are not seen. TREE is the folder that holds `hybridmap/`; default: this checkout.
"""

from __future__ import annotations

import argparse
import inspect
import os
import statistics
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ACES = Path(os.environ.get("HYBRIDMAP_DATA") or ROOT.parent / "shared" / "data") / "real" / "aces" / "aces.bag"


def main() -> None:
    """Map part of a recording and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", nargs="?", type=Path, default=ROOT, help="folder that holds hybridmap/")
    parser.add_argument("--source", default=str(ACES), help="recording or simulated world with a laser; default: aces")
    parser.add_argument("--end", type=float, default=200.0, help="map only the first so many seconds")
    options = parser.parse_args()
    sys.path.insert(0, str(options.tree))
    visited = walk(options.source, options.end, options.tree.resolve() / "hybridmap")
    counts = [len(files) for files in visited]
    print(f"{len(counts)} nodes: {statistics.mean(counts):.1f} files a node on average, {max(counts)} at most")
    for file, times in sorted(Counter(file for files in visited for file in files).items(), key=lambda row: (-row[1], row[0])):
        print(f"{times / len(counts):6.0%}  {file}")


def walk(source: str, end_s: float, package: Path) -> list[set[str]]:
    """Return one set of files for each node: those whose functions were called in the step that made it."""
    from hybridmap.cli.choose import choose
    from hybridmap.mapper import Mapper

    visited: list[set[str]] = []

    class Watched(Mapper):
        """A mapper that notes which functions its steps call."""

        def step(self, ready: Any) -> Any:
            files: set[str] = set()

            def note(frame: FrameType, event: str, _: Any) -> None:
                code = frame.f_code
                if event == "call" and code.co_flags & inspect.CO_OPTIMIZED:  # a function, not the body of an imported module
                    files.add(code.co_filename)

            sys.setprofile(note)
            try:
                update = super().step(ready)
            finally:
                sys.setprofile(None)
            if update.new_node is not None:
                inside = (Path(file) for file in files if file.startswith(f"{package}{os.sep}"))
                visited.append({str(path.relative_to(package)) for path in inside})
            return update

    chosen = choose(source, None, {}, end_s=end_s)
    mapper = Watched(chosen.config, chosen.stream.rig)
    for sample in chosen.stream:
        mapper.add(sample)
    return visited


if __name__ == "__main__":
    main()
