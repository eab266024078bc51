"""The base of every configuration section."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, ValidationError

_WORDS = {"tuple_type": "a list", "list_type": "a list", "dict_type": "keys with values", "model_type": "keys with values"}


class Section(BaseModel):
    """Frozen, with unknown keys refused; the docstring under each field is its help text."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


def said(error: ValidationError) -> str:
    """The first of pydantic's complaints in the form of every other error: where, what was expected, what was found.

    An unknown key comes before all others: one that is missing may be the same key, misspelt.
    """
    first = min(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    kind, message = first["type"], first["msg"]
    where = ".".join(str(part) for part in first["loc"])
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
