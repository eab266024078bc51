"""Which files of the package one visits who follows a laser scan that becomes a node: every function that `Mapper.step` calls.

    python tools/walk.py [TREE] [--source SOURCE] [--end SECONDS]

TREE is the folder that holds `hybridmap/`; default: the one that this file lies in. Functions that numba has compiled are not
seen. Files are counted a node, so that a search for loops counts where it is made.
"""

from __future__ import annotations

import argparse
import inspect
import os
import statistics
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ACES = Path(os.environ.get("HYBRIDMAP_DATA") or ROOT.parent / "shared" / "data") / "real" / "aces" / "aces.bag"


def main() -> None:
    """Map a stretch and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", nargs="?", type=Path, default=ROOT)
    parser.add_argument("--source", default=str(ACES), help="recording or simulated world with a laser; default: aces")
    parser.add_argument("--end", type=float, default=200.0, help="seconds of it")
    options = parser.parse_args()
    sys.path.insert(0, str(options.tree))
    visited = walk(options.source, options.end, options.tree.resolve() / "hybridmap")
    counts = [len(files) for files in visited]
    print(f"{len(counts)} nodes: {statistics.mean(counts):.1f} files a node on average, {max(counts)} at most")
    for file, times in sorted(Counter(file for files in visited for file in files).items(), key=lambda row: (-row[1], row[0])):
        print(f"{times / len(counts):6.0%}  {file}")


def walk(source: str, end_s: float, package: Path, overrides: Mapping[str, Any] = MappingProxyType({})) -> list[set[str]]:
    """The files of the package that each step that made a node visited."""
    from hybridmap.cli.choose import choose
    from hybridmap.mapper import Mapper

    visited: list[set[str]] = []

    class Watched(Mapper):
        """A mapper whose steps are watched."""

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

    chosen = choose(source, None, overrides, end_s=end_s)
    mapper = Watched(chosen.config, chosen.stream.rig)
    for sample in chosen.stream:
        mapper.add(sample)
    return visited


if __name__ == "__main__":
    main()
