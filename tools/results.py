"""Run the commands behind every figure that the project claims; write `docs/results.md` and the README's table.

    python tools/results.py                  every study (those without their recordings are left as they were)
    python tools/results.py --only demo      some of them; the others keep what was found before
    python tools/results.py --list           their names

What was found is kept in `docs/results.json`, so that studies can be run one at a time. Recordings are looked for in
`$HYBRIDMAP_DATA`, else in `../shared/data`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from result_studies import HEADLINES, STUDIES, Figure, Step, Study

ROOT = Path(__file__).resolve().parents[1]
PAGE, RECORD, README = ROOT / "docs" / "results.md", ROOT / "docs" / "results.json", ROOT / "README.md"
HEADLINES_BEGIN, HEADLINES_END = "<!-- results: written by tools/results.py -->\n", "<!-- end of results -->\n"
DATA = "$HYBRIDMAP_DATA"
PROGRAMS = {
    "hybridmap": (sys.executable, "-c", "from hybridmap.cli import main; main()"),
    "python": (sys.executable,),
}


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[study.name for study in STUDIES], help="these studies alone")
    parser.add_argument("--list", action="store_true", help="name the studies and stop")
    arguments = parser.parse_args()
    if arguments.list:
        print("\n".join(f"{study.name}: {study.title}" for study in STUDIES))
        return
    found: dict[str, Any] = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    for study in STUDIES:
        if arguments.only and study.name not in arguments.only:
            continue
        if study.needs and not (data_folder() / study.needs).exists():
            print(f"{study.name}: left out, {DATA}/{study.needs} is not here")
            continue
        found[study.name] = run(study)
        RECORD.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        PAGE.write_text(page(found), encoding="utf-8")
        README.write_text(with_headlines(README.read_text(encoding="utf-8"), found), encoding="utf-8")


def data_folder() -> Path:
    """Where the recordings are, if they are anywhere."""
    return Path(os.environ.get("HYBRIDMAP_DATA") or ROOT.parent / "shared" / "data")


def run(study: Study) -> dict[str, Any]:
    """Run the steps of a study in an empty folder; what each of its figures came to."""
    rows: list[dict[str, Any]] = []
    where = machine()
    with tempfile.TemporaryDirectory() as folder:
        hashes: list[str] = []
        for step in study.steps:
            print(f"{study.name}: {step.command}", flush=True)
            started = time.perf_counter()
            done = execute(step, Path(folder))
            elapsed_s = time.perf_counter() - started
            rows += read(step, done, elapsed_s, hashes)
    return {"rows": rows, "machine": where, "day": time.strftime("%Y-%m-%d", time.gmtime())}


def execute(step: Step, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run one command; `$HYBRIDMAP_DATA` in it is the folder of recordings."""
    program, *arguments = shlex.split(step.command.replace(DATA, str(data_folder())).replace("$OUT", str(folder)))
    cwd = ROOT if program == "python" else folder
    command = [*PROGRAMS[program], *arguments, *(["--json"] if step.figures or step.own_bars else [])]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    missed_bars = step.own_bars and done.stdout.startswith("{")
    if done.returncode != 0 and not (step.holds or missed_bars):
        raise SystemExit(f"{step.command}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done


def read(step: Step, done: subprocess.CompletedProcess[str], elapsed_s: float, hashes: list[str]) -> list[dict[str, Any]]:
    """The rows that a step gives: its figures, its wall time if asked for, whether it passed, whether its graph is the same."""
    rows = []
    if step.holds:
        rows.append(row(step, step.holds, "holds" if done.returncode == 0 else "fails", "", None, done.returncode == 0))
    if step.figures or step.own_bars:
        output = json.loads(done.stdout)
        values = {metric["name"]: metric for metric in output["metrics"]}
        primary = output.get("primary_backend", "")
        for figure in step.figures:
            name = figure.name.replace("PRIMARY", primary)
            if name not in values:
                raise SystemExit(f"{step.command}: gave no figure {name}; there are {', '.join(values)}")
            rows.append(figure_row(step, figure, values[name], primary))
        if step.own_bars:
            rows += [own_row(step, metric) for metric in output["metrics"] if metric.get("bar") is not None]
        hashes.append(output.get("graph_hash", ""))
    if step.same_graph:
        same = len(set(hashes)) == 1
        rows.append(row(step, "the same graph as before (one hash)", "yes" if same else "no", "", None, same))
    if step.wall_bar_s is not None:
        rows.append(row(step, "wall time", f"{elapsed_s:.1f}", "s", step.wall_bar_s, elapsed_s <= step.wall_bar_s))
    return rows


def figure_row(step: Step, figure: Figure, metric: dict[str, Any], primary: str) -> dict[str, Any]:
    """One figure, held against its bar if it has one."""
    value = metric["value"]
    passed = None
    if figure.bar is not None:
        passed = value is not None and (value >= figure.bar if figure.at_least else value <= figure.bar)
    name = figure.name.replace("PRIMARY", primary)
    return row(step, f"`{name}`", shown(value), metric["unit"], figure.bar, passed, at_least=figure.at_least)


def own_row(step: Step, metric: dict[str, Any]) -> dict[str, Any]:
    """One figure that the command itself holds against a bar; its description says on which side it must lie."""
    at_least = f"at least {metric['bar']:g}" in metric["description"]
    what = f"`{metric['name']}`"
    return row(step, what, shown(metric["value"]), metric["unit"], metric["bar"], metric["passed"], at_least=at_least)


def shown(value: float | None) -> str:
    """A value as it stands in the table."""
    return "–" if value is None else f"{value:.5g}"


def row(
    step: Step, what: str, value: str, unit: str, bar: float | None, passed: bool | None, *, at_least: bool = False
) -> dict[str, Any]:
    """A line of the table."""
    line = {"what": what, "value": value, "unit": unit, "bar": bar, "passed": passed, "command": step.command}
    return {**line, "at_least": True} if at_least else line


def machine() -> str:
    """What it was seen on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0] if names else model
    libraries = ", ".join(f"{name} {version(name)}" for name in ("gtsam", "open3d", "numpy"))
    system = f"{platform.system()}, Python {platform.python_version()}, {libraries}"
    return f"{os.cpu_count()} cores of {model} (load {os.getloadavg()[0]:.1f} from other work), {system}"


def page(found: dict[str, Any]) -> str:
    """The Markdown page."""
    lines = [
        "# Results",
        "",
        "Every figure that the project claims, with the command that gives it and the machine it was seen on. Written by",
        f"`tools/results.py`; do not edit. `{DATA}` is the folder of recordings. A figure with a bar is held against it.",
    ]
    for study in STUDIES:
        if study.name in found:
            lines += section(study, found[study.name])
    return "\n".join(lines) + "\n"


def with_headlines(readme: str, found: dict[str, Any]) -> str:
    """The README with its table of results brought up to what was found."""
    before, rest = readme.split(HEADLINES_BEGIN)
    _, after = rest.split(HEADLINES_END)
    lines = ["| | odometry | mapped |", "|---|---:|---:|"]
    for headline in HEADLINES:
        values = {line["what"].strip("`"): line["value"] for line in found.get(headline.study, {"rows": []})["rows"]}
        if headline.odometry in values and headline.mapped in values:
            odometry, mapped = (float(values[name]) for name in (headline.odometry, headline.mapped))
            lines.append(f"| {headline.label} | {odometry:.2f} m | {mapped:.3f} m |")
    return before + HEADLINES_BEGIN + "\n" + "\n".join(lines) + "\n\n" + HEADLINES_END + after


def section(study: Study, result: dict[str, Any]) -> list[str]:
    """One study: each command with its figures, and where it was seen."""
    lines = ["", f"## {study.title}", "", study.about]
    commands: list[str] = []
    for step in study.steps:
        commands.append(step.command)
        rows = [line for line in result["rows"] if line["command"] == step.command]
        if rows:
            lines += ["", "```console", *commands, "```", "", "| figure | value | unit | bar |", "|---|---:|---|---|"]
            lines += [table_line(line) for line in rows]
            commands.clear()
    return [*lines, "", f"Seen on {result['day']}: {result['machine']}."]


def table_line(line: dict[str, Any]) -> str:
    """A figure as a line of a Markdown table."""
    verdict = {None: "", True: "✓", False: "✗ missed"}[line["passed"]]
    side = ">=" if line.get("at_least") else "<="
    bar = f"{side} {line['bar']:g} {verdict}" if line["bar"] is not None else verdict
    unit = "" if line["unit"] == "1" else line["unit"]
    return f"| {line['what']} | {line['value']} | {unit} | {bar} |"


if __name__ == "__main__":
    main()
