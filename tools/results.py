"""Run the commands behind every figure that the project claims. Write `docs/results.md` and the table of the README.

    python tools/results.py                  run every topic
    python tools/results.py --only demo      run some topics; the others keep their figures
    python tools/results.py --list           print the names and commands of the topics
    python tools/results.py --page           write the page and the table again without running anything

The figures are kept in `docs/results.csv`, one line each: value, median, worst, bar, day and machine. A figure of a study has
one value for each seed. The page sums up the figures, with one line for each question. A topic whose recordings are missing is
left as it was. The folder of recordings is `$HYBRIDMAP_DATA`, or `../shared/data` if that is not set.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from fnmatch import fnmatchcase
from importlib.metadata import version
from pathlib import Path
from typing import Any

from result_studies import HEADLINES, PARTS, TOPICS, Figure, Question, Step, Topic

ROOT = Path(__file__).resolve().parents[1]
PAGE, RECORD, README = ROOT / "docs" / "results.md", ROOT / "docs" / "results.csv", ROOT / "README.md"
HEADLINES_BEGIN, HEADLINES_END = "<!-- results: written by tools/results.py -->\n", "<!-- end of results -->\n"
DATA = "$HYBRIDMAP_DATA"
COLUMNS = ("topic", "command", "figure", "unit", "values", "median", "worst", "side", "bar", "passed", "day", "machine")
PROGRAMS = {
    "hybridmap": (sys.executable, "-c", "from hybridmap.cli import main; main()"),
    "python": (sys.executable,),
}
HEAD = ("| what | figures | median | worst | bar | |", "|---|---:|---:|---:|---|---|")
Row = dict[str, str]


def main() -> None:
    """Run the topics given on the command line and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[topic.name for topic in TOPICS], help="topics to run; default: all")
    parser.add_argument("--list", action="store_true", help="print the topics and their commands, and run nothing")
    parser.add_argument("--page", action="store_true", help="write the page and the table again, and run nothing")
    arguments = parser.parse_args()
    if arguments.list:
        print("\n".join(f"{topic.name}: {step.command}" for topic in TOPICS for step in topic.steps))
        return
    rows = recorded()
    for topic in TOPICS:
        if arguments.page or (arguments.only and topic.name not in arguments.only):
            continue
        if topic.needs and not (data_folder() / topic.needs).exists():
            print(f"{topic.name}: left out, {DATA}/{topic.needs} is not here")
            continue
        rows = [row for row in rows if row["topic"] != topic.name] + run(topic)
        write(rows)
    write(rows)


def recorded() -> list[Row]:
    """Return the recorded figures."""
    if not RECORD.is_file():
        return []
    with RECORD.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write(rows: list[Row]) -> None:
    """Write the record, the page and the table of the README."""
    order = {topic.name: number for number, topic in enumerate(TOPICS)}
    rows = sorted((row for row in rows if row["topic"] in order), key=lambda row: order[row["topic"]])
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    RECORD.write_text(text.getvalue(), encoding="utf-8")
    PAGE.write_text(page(rows), encoding="utf-8")
    README.write_text(with_headlines(README.read_text(encoding="utf-8"), rows), encoding="utf-8")


def data_folder() -> Path:
    """Return the folder of recordings. It may not exist."""
    return Path(os.environ.get("HYBRIDMAP_DATA") or ROOT.parent / "shared" / "data")


def run(topic: Topic) -> list[Row]:
    """Run the steps of a topic in an empty folder. Return one row for each figure."""
    rows: list[Row] = []
    seen = {"topic": topic.name, "machine": machine(), "day": time.strftime("%Y-%m-%d", time.gmtime())}
    with tempfile.TemporaryDirectory() as folder:
        hashes: list[str] = []
        for step in topic.steps:
            print(f"{topic.name}: {step.command}", flush=True)
            started = time.perf_counter()
            done = execute(step, Path(folder))
            rows += [row | seen for row in read(step, done, time.perf_counter() - started, hashes, Path(folder))]
    return rows


def execute(step: Step, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run one command. `$HYBRIDMAP_DATA` in it stands for the folder of recordings."""
    program, *arguments = shlex.split(step.command.replace(DATA, str(data_folder())).replace("$OUT", str(folder)))
    cwd = ROOT if program == "python" else folder
    command = [*PROGRAMS[program], *arguments, *(["--json"] if step.figures or step.own_bars else [])]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    missed_bars = step.own_bars and done.stdout.startswith("{")
    if done.returncode != 0 and not (step.holds or missed_bars):
        raise SystemExit(f"{step.command}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done


def read(step: Step, done: subprocess.CompletedProcess[str], elapsed_s: float, hashes: list[str], folder: Path) -> list[Row]:
    """Return the rows of a step: its figures and, where asked for, its success, wall time, and comparison of graphs."""
    rows = []
    if step.study:
        rows += [study_row(step, line) for line in csv.DictReader((folder / step.study / "bars.csv").open(encoding="utf-8"))]
    if step.holds:
        rows.append(row(step, step.holds, float(done.returncode == 0), "1", "at least", 1.0))
    if step.figures or step.own_bars:
        output = json.loads(done.stdout)
        values = {metric["name"]: metric for metric in output["metrics"]}
        primary = output.get("primary_backend", "")
        for figure in step.figures:
            name = figure.name.replace("PRIMARY", primary)
            if name not in values:
                raise SystemExit(f"{step.command}: gave no figure {name}; there are {', '.join(values)}")
            rows.append(figure_row(step, figure, name, values[name]))
        if step.own_bars and not step.study:
            rows += [own_row(step, metric) for metric in output["metrics"] if metric.get("bar") is not None]
        hashes.append(output.get("graph_hash", ""))
    if step.same_graph:
        rows.append(row(step, "same_graph", float(len(set(hashes)) == 1), "1", "at least", 1.0))
    if step.wall_bar_s is not None:
        rows.append(row(step, "wall_time", elapsed_s, "s", "at most", step.wall_bar_s))
    return rows


def figure_row(step: Step, figure: Figure, name: str, metric: dict[str, Any]) -> Row:
    """Return the row of a figure whose bar stands in `result_studies`."""
    return row(step, name, metric["value"], metric["unit"], "at least" if figure.at_least else "at most", figure.bar)


def own_row(step: Step, metric: dict[str, Any]) -> Row:
    """Return the row of a figure with a bar of the command itself. Its description says `at least` or `at most`."""
    side = "at least" if f"at least {metric['bar']:g}" in metric["description"] else "at most"
    return row(step, metric["name"], metric["value"], metric["unit"], side, metric["bar"]) | {
        "passed": "yes" if metric["passed"] else "no"
    }


def study_row(step: Step, line: Row) -> Row:
    """Return the row of a line of `bars.csv` of a study."""
    rate = f"{line['false_loop_kind']} {100 * float(line['false_loop_rate']):g} %" if line["false_loop_kind"] else ""
    where = "/".join(part for part in (line["source"], line["setting"], rate, line["backend"]) if part)
    found = {name: line[name] for name in ("unit", "values", "median", "worst", "side", "bar", "passed")}
    statistic = ""
    if line["statistic"] != "worst":
        statistic, found["median"], found["worst"] = f" {line['statistic']}", line["value"], line["value"]
    return {"command": step.command, "figure": f"{line['figure']}{statistic}/{where}", **found}


def row(step: Step, figure: str, value: float | None, unit: str, side: str, bar: float | None) -> Row:
    """Return a row with one value."""
    text = "" if value is None else f"{value:.6g}"
    passed = None if bar is None else value is not None and (value >= bar if side == "at least" else value <= bar)
    return {
        "command": step.command,
        "figure": figure,
        "unit": unit,
        "values": text,
        "median": text,
        "worst": text,
        "side": "" if bar is None else side,
        "bar": "" if bar is None else f"{bar:.6g}",
        "passed": {None: "", True: "yes", False: "no"}[passed],
    }


def machine() -> str:
    """Describe this machine: processor, load, system and versions."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0] if names else model
    libraries = ", ".join(f"{name} {version(name)}" for name in ("gtsam", "open3d", "numpy"))
    system = f"{platform.system()}, Python {platform.python_version()}, {libraries}"
    return f"{os.cpu_count()} cores of {model} (load {os.getloadavg()[0]:.1f} from other work), {system}"


def page(rows: list[Row]) -> str:
    """Return the Markdown page. It has one line for each question."""
    lines = [
        "# Results",
        "",
        "This page shows the figures behind the claims of the project. Each line gives the number of figures, their median,",
        "the worst of them, and the bar that each of them must meet. [results.csv](results.csv) holds every figure of every",
        "seed with its command, day and machine. `tools/results.py` writes this page; do not edit it by hand.",
        f"`{DATA}` is the folder of recordings.",
    ]
    for part, names in PARTS.items():
        found = [line for topic in TOPICS if topic.name in names for line in table(topic, rows)]
        if found:
            lines += ["", f"## {part}", "", *HEAD, *found]
    return "\n".join([*lines, *commands(rows)]) + "\n"


def table(topic: Topic, rows: list[Row]) -> list[str]:
    """Return one line for each question of a topic that has recorded figures."""
    lines = []
    for number, question in enumerate(topic.questions):
        asked = [row for row in rows if row["topic"] == topic.name and is_of(row, question)]
        if asked:
            title = f"**{topic.title}**: " if number == 0 else ""
            lines.append(line(title + question.what, asked))
    return lines


def is_of(found: Row, question: Question) -> bool:
    """Tell whether a figure belongs to a question."""
    return any(fnmatchcase(found["figure"], pattern) for pattern in question.figures)


def line(what: str, rows: list[Row]) -> str:
    """Return one line of the page: the number of figures, their median, the worst, and the bar.

    Each seed is one figure. A mean or median over the seeds that has a bar of its own is one figure.
    """
    shown = [found for found in rows if found["side"] == rows[0]["side"]]
    single = any(" mean/" in found["figure"] or " median/" in found["figure"] for found in shown)
    values = [value for found in shown for value in ([found["median"]] if single else found["values"].split()) if value != "-"]
    count = sum(1 if single else len(found["values"].split()) or 1 for found in shown)
    medians = [float(value) for value in values or [found["median"] for found in shown] if value]
    worsts = [float(found["worst"]) for found in shown if found["worst"]]
    units = {found["unit"] for found in shown}
    unit = "" if units == {"1"} else f" {shown[0]['unit']}"
    median = f"{statistics.median(medians):.4g}{unit}" if medians and count > 1 and len(units) == 1 else ""
    worst = f"{(min if shown[0]['side'] == 'at least' else max)(worsts):.4g}{unit}" if worsts and len(units) == 1 else ""
    missed = sum(found["passed"] == "no" for found in rows)
    verdict = "" if not rows[0]["passed"] else "✓" if not missed else f"✗ {missed} missed"
    return f"| {what} | {count} | {median} | {worst} | {bar_text(rows, unit)} | {verdict} |"


def bar_text(rows: list[Row], unit: str) -> str:
    """Return the bar as text. If the figures have different bars, give the worst figure in % of its own bar."""
    texts = []
    for side, sign in (("at least", ">="), ("at most", "<=")):
        held = [found for found in rows if found["bar"] and found["side"] == side]
        if len({found["bar"] for found in held}) == 1:
            texts.append(f"{sign} {float(held[0]['bar']):.4g}{unit}")
        elif held:
            shares = [float(found["worst"]) / float(found["bar"]) for found in held if found["worst"] and float(found["bar"])]
            texts.append(f"{sign} its own; at worst {100.0 * (min if sign == '>=' else max)(shares):.3g} % of it")
    return ", ".join(texts)


def commands(rows: list[Row]) -> list[str]:
    """Return the last part of the page: the command of each topic, and the day and machine of its figures."""
    lines = ["", "## Commands", "", "| of | commands | seen |", "|---|---|---|"]
    machines = list(dict.fromkeys(bare(found["machine"]) for found in rows))
    for topic in TOPICS:
        found = [row for row in rows if row["topic"] == topic.name]
        if found:
            seen = ", ".join(sorted({f"{row['day']} [{machines.index(bare(row['machine'])) + 1}]" for row in found}))
            typed = f"`{topic.steps[0].command}`" + (f" and {len(topic.steps) - 1} more" if len(topic.steps) > 1 else "")
            lines.append(f"| {topic.title} | {typed} | {seen} |")
    return [*lines, "", *(f"[{number}]: {name}.  " for number, name in enumerate(machines, start=1))]


def bare(name: str) -> str:
    """Return the description of a machine without its load."""
    before, _, after = name.partition(" (load ")
    return before + after.partition(")")[2]


def with_headlines(readme: str, rows: list[Row]) -> str:
    """Return the README with its table of results brought up to date."""
    before, rest = readme.split(HEADLINES_BEGIN)
    _, after = rest.split(HEADLINES_END)
    lines = ["| | odometry | mapped |", "|---|---:|---:|"]
    for headline in HEADLINES:
        values = {found["figure"]: found["worst"] for found in rows if found["topic"] == headline.topic}
        if headline.odometry in values and headline.mapped in values:
            odometry, mapped = (float(values[name]) for name in (headline.odometry, headline.mapped))
            lines.append(f"| {headline.label} | {odometry:.2f} m | {mapped:.3f} m |")
    return before + HEADLINES_BEGIN + "\n" + "\n".join(lines) + "\n\n" + HEADLINES_END + after


if __name__ == "__main__":
    main()
