"""The base of every configuration section."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, ValidationError

from hybridmap.config.gone import what_became_of

_WORDS = {"tuple_type": "a list", "list_type": "a list", "dict_type": "keys with values", "model_type": "keys with values"}


class Section(BaseModel):
    """Frozen, with unknown keys refused.

    The docstring under each field is its help text; what follows on "Watch:" says what to watch when changing it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


def said(error: ValidationError, section: str = "") -> str:
    """The first of pydantic's complaints in the form of every other error: where, what was expected, what was found.

    An unknown key comes before all others: one that is missing may be the same key, misspelt.

    Args:
        error: of a section.
        section: dotted name of that section in the whole configuration; empty for the whole.
    """
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    kind, message = first["type"], first["msg"]
    where = ".".join(str(part) for part in first["loc"])
    gone = what_became_of(f"{section}.{where}" if section else where, first.get("input"))
    if gone is not None:
        return gone
    if kind == "extra_forbidden":
        return f"unknown key {where!r}"
    if kind == "missing":
        return f"{where}: is missing"
    if kind == "value_error":
        return f"{where}: {first['ctx']['error']}"
    if kind == "too_short":
        message = f"expected at least {first['ctx']['min_length']} of them"
    elif kind in _WORDS:
        message = f"expected {_WORDS[kind]}"
    elif message.startswith("Input should be "):
        expected = message.removeprefix("Input should be ")
        message = f"expected {'a number ' if expected.startswith(('greater', 'less')) else ''}{expected}"
    return f"{where}: {message}, found {repr(first.get('input'))[:80]}"
