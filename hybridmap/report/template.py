"""Fill a template of this folder: every page is made here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_MARK = '<meta name="generator" content="hybridmap '  # in the head of the pages that have a folder of their own


def is_page(path: Path) -> bool:
    """Whether a file is a page that was made here, and that no session or study folder holds."""
    return path.is_file() and _MARK in path.read_text(encoding="utf-8", errors="replace")


def rendered(template: str, **content: Any) -> str:
    """The text of a page: a template by its file name, filled; text is escaped, and a name that is missing is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("hybridmap", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(content)
