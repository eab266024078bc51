"""Write `docs/configuration.md`, the page of all settings.

    python tools/configuration_page.py

The page gives the unit, limits and default of each setting, what it does, and what to watch when changing it. The settings
are the fields of `hybridmap.config.Config`. The texts are the docstrings under the fields. The last part of the page shows
figures from `docs/sensitivity.csv`, which `tools/sensitivity.py` writes.
"""

from __future__ import annotations

import csv
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from hybridmap.config import Config
from hybridmap.config.section import Section

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "configuration.md"
SENSITIVITY = ROOT / "docs" / "sensitivity.csv"

UNITS = {
    "rad_m": "rad/m",
    "deg_per_sqrt_m": "deg/√m",
    "deg_per_m": "deg/m",
    "per_sqrt_m": "m/√m",
    "per_turn": "rad/√rad",
    "per_m": "m/m",
    "m": "m",
    "s": "s",
    "deg": "deg",
    "rad": "rad",
    "px": "px",
    "hz": "Hz",
}
"""End of a name -> unit. The longest end that fits counts. A number whose name has no such end has no unit."""

INTRODUCTION = """# Settings

A configuration is a YAML file of sections, as in `configs/`. `--config NAME_OR_FILE` chooses one, and
`--set SECTION.KEY=VALUE` sets one setting on top. Command line > file > default. A file may begin with `extends: OTHER`.
An unknown key is refused. For a key of an older version the error says what became of it. The resolved configuration
is saved with every session as `config.yaml`.

There are {count} settings. A mounting or a calibration is given as a whole or not at all, and counts as one. All other
parameters are named constants in the code, each with the reason for its value.
This page is written by `python tools/configuration_page.py`.
"""


@dataclass(frozen=True, slots=True)
class Setting:
    """One row of the page."""

    key: str
    unit: str
    type: str
    default: str
    does: str
    watch: str


@dataclass(frozen=True, slots=True)
class Table:
    """One section of the configuration: its dotted name, its title, and its own settings."""

    key: str
    title: str
    settings: tuple[Setting, ...]


def tables(section: type[Section] = Config, key: str = "", title: str = "The whole") -> Iterator[Table]:
    """Yield each section that has settings of its own, in the order of the model."""
    inner: list[tuple[str, FieldInfo, type[Section]]] = []
    own: list[Setting] = []
    for name, field in section.model_fields.items():
        dotted = f"{key}.{name}" if key else name
        below = section_of(field.annotation)
        if below is None:
            own.append(_setting(dotted, name, field))
        else:
            inner.append((dotted, field, below))
    if own:
        yield Table(key, title, tuple(own))
    for dotted, field, below in inner:
        yield from tables(below, dotted, _words(field)[0])


def section_of(annotation: Any) -> type[Section] | None:
    """Return the section that a field holds, also if it is optional. Return None for a setting."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    return next((found for part in typing.get_args(annotation) if (found := section_of(part))), None)


def count(tree: dict[str, Any]) -> int:
    """Count the settings of a configuration. A section that is given as a whole or not at all counts as one."""
    return sum(count(value) if isinstance(value, dict) else 1 for value in tree.values())


def page() -> str:
    """Return the whole page."""
    found = list(tables())
    parts = [INTRODUCTION.format(count=count(Config().model_dump()))]
    for table in found:
        parts.append(f"## {f'`{table.key}`: ' if table.key else ''}{table.title}\n")
        parts.append("| setting | unit | type | default | what it does | what to watch |\n|---|---|---|---|---|---|")
        parts += [_row(s.key.rpartition(".")[2], s.unit, s.type, s.default, s.does, s.watch) for s in table.settings]
        parts.append("")
    return "\n".join([*parts, *_sensitive()])


def _sensitive() -> list[str]:
    """Return the part on the settings that changed the error of a map, from the record."""
    if not SENSITIVITY.is_file():
        return []
    with SENSITIVITY.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    matter = [row for row in rows if row["matters"] == "yes"]
    tried = len({row["setting"] for row in rows})
    head = (
        "## Which of them matter\n\n"
        f"`python tools/sensitivity.py` raised and lowered each of {tried} numeric settings by 30 %. The maps\n"
        "are of the first 200 s of aces by laser (mean relation error) and of the simulated laboratory by RGB-D (ATE).\n"
        "Only the primary back-end ran. The table shows the settings that changed the error of a map by more than 2 %.\n"
        "[sensitivity.csv](sensitivity.csv) holds all of them.\n"
    )
    table = ["| setting | recording | value | error | as it is | change |\n|---|---|---|---|---|---|"]
    for row in matter:
        table.append(_row(row["setting"], row["recording"], row["value"], row["error_m"], row["usual_m"], row["change"]))
    return [head, *table, ""]


def _setting(dotted: str, name: str, field: FieldInfo) -> Setting:
    does, watch = _words(field)
    unit = "" if not _is_number(field.annotation) else unit_of(name)
    default = "required" if field.default is PydanticUndefined else _value(field.default)
    return Setting(dotted, unit, _type(field), default, does, watch)


def unit_of(name: str) -> str:
    """Return the unit that the end of a name stands for; `1` for a number without unit."""
    ends = [end for end in UNITS if name == end or name.endswith(f"_{end}")]
    return UNITS[max(ends, key=len)] if ends else "1"


def _words(field: FieldInfo) -> tuple[str, str]:
    """Split the docstring of a setting into what it does and what to watch."""
    does, _, watch = " ".join((field.description or "").split()).partition(" Watch: ")
    return does, watch


def _is_number(annotation: Any) -> bool:
    return annotation in (int, float) or any(_is_number(part) for part in typing.get_args(annotation))


def _type(field: FieldInfo) -> str:
    parts = [part for part in typing.get_args(field.annotation) or (field.annotation,) if part is not NoneType]
    if typing.get_origin(field.annotation) is Literal:
        return ", ".join(f"`{part}`" for part in parts)
    if typing.get_origin(field.annotation) is tuple:
        number = "any number of" if Ellipsis in parts else str(len(parts))
        return f"list of {number} {_name(parts[0])}s"
    limits = [
        f"{sign} {getattr(limit, name):g}"
        for limit in field.metadata
        for name, sign in (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))
        if getattr(limit, name, None) is not None
    ]
    return " ".join([_name(parts[0]), ", ".join(limits)]).strip()


def _name(kind: Any) -> str:
    return {int: "integer", float: "number", str: "text", bool: "true or false"}.get(kind, str(kind))


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "none"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)


def _row(name: str, *cells: str) -> str:
    return f"| {' | '.join([f'`{name}`', *(cell.replace('|', chr(92) + '|') for cell in cells)])} |"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
