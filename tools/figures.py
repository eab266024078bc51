"""Draw the picture of the README from a session of the demo.

    python tools/figures.py [--session DIR] [--out docs/images/demo.png]

Without `--session` the demo is run first.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from hybridmap.report import style
from hybridmap.report.outline import outlines, raster
from hybridmap.report.session_figures import draw_errors, draw_trajectories
from hybridmap.report.session_scene import load_scene
from hybridmap.store import MapStore, SessionFolder

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Draw a session. Run the demo first if no session is given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--session", type=Path, help="session folder; without it, the demo is run")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "demo.png", help="PNG file to write")
    arguments = parser.parse_args()
    if arguments.session is not None:
        draw(SessionFolder(arguments.session), arguments.out)
        return
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "demo"
        command = [sys.executable, "-c", "from hybridmap.cli import main; main()", "demo", "--out", str(out)]
        subprocess.run(command, check=True)
        draw(SessionFolder(out), arguments.out)


def draw(session: SessionFolder, out: Path) -> None:
    """Draw one PNG: the map with all trajectories, and the position error over time below it."""
    with MapStore.open(session.path) as store:
        scene = load_scene(session, store)
        building = raster(outlines(store, len(scene.nodes)), scene.nodes)
    out.parent.mkdir(parents=True, exist_ok=True)
    with style.figure(style.PAGE_WIDTH_IN, 6.0) as picture:
        above, below = picture.subplots(2, 1, height_ratios=(2, 1))
        draw_trajectories(above, scene, building)
        draw_errors(below, scene, heading=False)
        picture.legend(*above.get_legend_handles_labels(), loc="outside upper left", ncols=6)
        picture.savefig(out, dpi=130, metadata={"Software": None}, pil_kwargs={"optimize": True})
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
