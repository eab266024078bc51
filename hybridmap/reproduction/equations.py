"""The paper's equations and where they are in the code: the table of docs/paper.md, which comes with the package."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from hybridmap.errors import ConfigError
from hybridmap.reproduction.paper import EQUATIONS, Status

_HEADING = "\n## Equation -> function\n"
_ROW = re.compile(r"^\| (?P<number>[\d, ]+) \|(?P<cells>.*)\|$")
_BETWEEN_CELLS = re.compile(r"(?<!\\)\|")


@dataclass(frozen=True, slots=True)
class Equation:
    """A row of the table of equations.

    Attributes:
        number: the paper's number of it, or several.
        equation, where, here: the equation, the functions that are it, and what it is here; in Markdown.
        status: what became of it.
        why: why it is not as printed; empty if it is.
    """

    number: str
    equation: str
    where: str
    here: str
    status: Status
    why: str


def equations() -> list[Equation]:
    """Every row of the table, in order.

    Raises:
        ConfigError: the document is not there, or its table has other rows than `paper.EQUATIONS`.
    """
    package = Path(str(resources.files("hybridmap")))
    path = next((p for p in (package / "docs" / "paper.md", package.parent / "docs" / "paper.md") if p.is_file()), None)
    if path is None:
        raise ConfigError(f"{package / 'docs' / 'paper.md'}: no such file; install hybridmap again")
    section = path.read_text(encoding="utf-8").partition(_HEADING)[2].partition("\n## ")[0]
    rows = list(filter(None, map(_ROW.match, section.splitlines())))
    numbers, known = [row["number"] for row in rows], [number for number, _, _ in EQUATIONS]
    if numbers != known:
        raise ConfigError(
            f"{path}: found the equations {'; '.join(numbers)}, expected those of reproduction/paper.py: {'; '.join(known)}"
        )
    found = []
    for row, (number, status, why) in zip(rows, EQUATIONS, strict=True):
        equation, where, here = (cell.strip().replace("\\|", "|") for cell in _BETWEEN_CELLS.split(row["cells"]))
        found.append(Equation(number, equation, where, here, status, why))
    return found
