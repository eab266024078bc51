"""Compare the maps that two checkouts of the project make: errors, graph hashes, trajectories, and CPU time.

    python tools/same_maps.py measure --tree ../before --out before.json
    python tools/same_maps.py measure --out after.json
    python tools/same_maps.py compare before.json after.json
    python tools/same_maps.py speed --before ../before --pairs 5

`measure` maps every case with one checkout and records the results. `compare` compares two records. It exits with 1 if an
error grew by more than 2 % and by more than 0.5 mm. `speed` maps with both checkouts in turn. It exits with 1 if the median
ratio of the CPU times is above 1.02. The folder of recordings is `$HYBRIDMAP_DATA`, or `../shared/data` if that is not set.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap import backends
from hybridmap.geometry import align, transform_points
from hybridmap.graph.io import read_graph, write_g2o
from hybridmap.study.false_loops import inject

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("HYBRIDMAP_DATA") or ROOT.parent / "shared" / "data")
PROGRAM = (sys.executable, "-c", "from hybridmap.cli import main; main()")
WORSE_SHARE, WORSE_M, SLOWER = 1.02, 0.0005, 1.02


@dataclass(frozen=True)
class Case:
    """One drive or pose graph.

    Attributes:
        commands: run one after the other in one folder. `DATA` stands for the folder of recordings. The first one makes `out`.
        figures: errors in m that must not grow. `PRIMARY` stands for the primary back-end.
        graph: name of a pose graph, or empty. The commands then solve copies of it with 40 % false loops, one for each kind
            and seed. The figures are the errors of these copies against the optimum of the graph without false loops.
    """

    commands: tuple[str, ...]
    figures: tuple[str, ...]
    graph: str = ""


def _logged(folder: str, recording: str) -> Case:
    source = f"DATA/real/{folder}"
    commands = (f"map {source}/{recording} --out out", f"evaluate out --relations {source}/relations.txt")
    return Case(commands, ("relation_trans_mean/PRIMARY", "relation_loop_trans_mean/PRIMARY"))


def _driven(command: str) -> Case:
    return Case((f"{command} --out out",), ("ate_rmse/PRIMARY",))


def _kidnapped(config: str, seed: int) -> Case:
    return _driven(f"map office --config {config} --set simulation.carried_m=20 --seed {seed}")


def _falsified(graph: str) -> Case:
    names = [f"{kind}-{seed}" for kind in ("random", "aliased") for seed in range(3)]
    return Case(
        tuple(f"optimize {name}.g2o --backend gtsam-gnc --out {name}-solved.g2o" for name in names), tuple(names), graph
    )


HOLOLENS = "map DATA/real/hololens_office"
CASES = {
    "fr079": _logged("fr079", "fr079.mcap"),
    "aces": _logged("aces", "aces.bag"),
    "office": _driven("map office"),
    "demo": _driven("demo"),
    "hololens": _driven(HOLOLENS),
    "hololens-hard": _driven(f"{HOLOLENS} --odometry-file odometry_hard.txt"),
    **{f"kidnapped-laser-{seed}": _kidnapped("laser", seed) for seed in range(1, 6)},
    **{f"kidnapped-rgbd-{seed}": _kidnapped("rgbd", seed) for seed in range(1, 4)},
    **{f"false-loops-{name}": _falsified(name) for name in ("intel", "manhattanOlson3500")},
}
SPEED = {"aces": "map DATA/real/aces/aces.bag --out out", "demo": "demo --out out"}


def main() -> None:
    """Run the subcommand given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("measure", help="map every case with one checkout and record the results")
    one.add_argument("--tree", type=Path, default=ROOT, help="checkout to measure; default: this one")
    one.add_argument("--out", type=Path, required=True, help="JSON file; results in it of cases that are not run are kept")
    one.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES), help="cases to run")
    two = commands.add_parser("compare", help="compare two records")
    two.add_argument("before", type=Path, help="JSON file of `measure`")
    two.add_argument("after", type=Path, help="JSON file of `measure`")
    three = commands.add_parser("speed", help="compare the CPU time of two checkouts")
    three.add_argument("--before", type=Path, required=True, help="checkout to compare with")
    three.add_argument("--after", type=Path, default=ROOT, help="checkout to judge; default: this one")
    three.add_argument("--pairs", type=int, default=5, help="number of runs of each checkout")
    chosen = parser.parse_args()
    if chosen.command == "measure":
        measure(chosen.tree.resolve(), chosen.out, chosen.only)
    elif chosen.command == "compare":
        raise SystemExit(compare(json.loads(chosen.before.read_text()), json.loads(chosen.after.read_text())))
    else:
        raise SystemExit(speed(chosen.before.resolve(), chosen.after.resolve(), chosen.pairs))


def measure(tree: Path, out: Path, names: list[str]) -> None:
    """Run cases with a checkout. The results are written after each case."""
    found: dict[str, Any] = json.loads(out.read_text()) if out.is_file() else {}
    for name in names:
        found[name] = measured(tree, CASES[name])
        print(name, json.dumps(found[name]), flush=True)
        out.write_text(json.dumps(found, indent=1) + "\n")


def measured(tree: Path, case: Case) -> dict[str, Any]:
    """Run one case. Return its errors, the hashes of graph and trajectories, and the CPU time."""
    with tempfile.TemporaryDirectory() as name:
        folder, figures, graph_hash, cpu_s = Path(name), dict[str, float](), "", 0.0
        wanted = case.figures
        if case.graph:
            falsify(case, folder)
        for command in case.commands:
            output, seconds = run(tree, command, folder)
            cpu_s += seconds
            primary, graph_hash = output.get("primary_backend", ""), output.get("graph_hash") or graph_hash
            values = {metric["name"]: metric["value"] for metric in output["metrics"]}
            chosen = [figure.replace("PRIMARY", primary) for figure in wanted]
            figures |= {figure: values[figure] for figure in chosen if figure in values}
        if case.graph:
            figures |= graph_errors(case, folder)
        lines = b"".join(path.read_bytes() for path in sorted((folder / "out").glob("trajectory/*.tum")))
        trajectories = hashlib.sha256(lines).hexdigest()[:16] if lines else ""
        return {"figures": figures, "graph_hash": graph_hash, "trajectories": trajectories, "cpu_s": round(cpu_s, 2)}


def falsify(case: Case, folder: Path) -> None:
    """Write the copies of a pose graph with 40 % false loops."""
    graph = read_graph(DATA / "posegraphs" / f"{case.graph}.g2o")
    for name in case.figures:
        kind, seed = name.split("-")
        copy = inject(graph, 0.4, "random" if kind == "random" else "aliased", np.random.default_rng(int(seed)))
        write_g2o(folder / f"{name}.g2o", copy, copy.initial)


def graph_errors(case: Case, folder: Path) -> dict[str, float]:
    """Return the ATE of each solved copy against the optimum, in m."""
    optimum = backends.create("gtsam-lm").solve(read_graph(DATA / "posegraphs" / f"{case.graph}.g2o")).poses
    found = {}
    for name in case.figures:
        poses = read_graph(folder / f"{name}-solved.g2o").initial
        error = transform_points(align(optimum, poses), poses[:, :2]) - optimum[:, :2]
        found[f"ate/{name}"] = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return found


def run(tree: Path, command: str, folder: Path) -> tuple[dict[str, Any], float]:
    """Run one command with a checkout. Return its JSON output and its CPU time in s."""
    arguments = [*command.replace("DATA", str(DATA)).split(), "--json"]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, **threads, "PYTHONPATH": str(tree), "HYBRIDMAP_DATA": str(DATA)}
    done = subprocess.run([*PROGRAM, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1) or not done.stdout.startswith("{"):
        raise SystemExit(f"{tree}: {command}: exit code {done.returncode}\n{done.stderr}")
    return json.loads(done.stdout), after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compare(before: dict[str, Any], after: dict[str, Any]) -> int:
    """Print one line for each figure. Return 1 if a figure got worse, else 0."""
    worse = 0
    print("| case | error | before, m | after, m | same graph | same trajectories |\n|---|---|---:|---:|---|---|")
    for name in (name for name in before if name in after):
        old, new = before[name], after[name]
        graph, track = (same(old[key], new[key]) for key in ("graph_hash", "trajectories"))
        for figure, value in old["figures"].items():
            now = new["figures"].get(figure, float("nan"))
            bad = not now <= max(value * WORSE_SHARE, value + WORSE_M)
            worse += bad
            print(f"| {name} | {figure} | {value:.5f} | {now:.5f}{' **worse**' if bad else ''} | {graph} | {track} |")
    print(f"\n{worse} figures got worse" if worse else "\nno figure got worse")
    return min(worse, 1)


def same(before: str, after: str) -> str:
    """Say whether two hashes are equal. A pose graph that was read from a file has no hash."""
    return "–" if not before else "yes" if before == after else "no"


def speed(before: Path, after: Path, pairs: int) -> int:
    """Map with both checkouts in turn. Return 1 if a median ratio is above the bar, else 0."""
    slow = 0
    for name, command in SPEED.items():
        ratios = []
        for pair in range(pairs + 1):
            trees = (before, after) if pair % 2 else (after, before)
            seconds = {tree: timed(tree, command) for tree in trees}
            if pair:  # the first pair only fills the caches of compiled code
                ratios.append(seconds[after] / seconds[before])
                print(f"{name}: {seconds[before]:.2f} s before, {seconds[after]:.2f} s after", flush=True)
        median = statistics.median(ratios)
        slow += median > SLOWER
        print(f"{name}: median ratio {median:.3f} ({min(ratios):.3f} to {max(ratios):.3f}), bar {SLOWER}")
    return min(slow, 1)


def timed(tree: Path, command: str) -> float:
    """Processor time of the mapping that one command does, s; the page and the start of the program do not count."""
    with tempfile.TemporaryDirectory() as folder:
        output, _ = run(tree, command, Path(folder))
    return next(float(metric["value"]) for metric in output["metrics"] if metric["name"] == "cpu_s/mapping")


if __name__ == "__main__":
    main()
