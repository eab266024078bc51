"""Fill a template of this folder: every page is made here."""

from __future__ import annotations

from typing import Any


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
