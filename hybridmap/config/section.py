"""The base of every configuration section, and the one reader of YAML."""

from __future__ import annotations

from collections.abc import Hashable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from hybridmap.config.gone import what_became_of
from hybridmap.errors import ConfigError, HybridMapError

_WORDS = {"tuple_type": "a list", "list_type": "a list", "dict_type": "keys with values", "model_type": "keys with values"}


_DEEPEST = 50
"""Levels of a YAML document. The configuration has five; a document of thousands exhausts Python's stack."""
_MOST_BYTES = 10_000_000
"""Size of a YAML document; a configuration has some kB, and PyYAML reads 0.1 MB a second."""
_MOST_VALUES = 1_000_000
"""Values of a document with its aliases written out; ten aliases of ten aliases and so on are a few lines of text."""


class _Strict(yaml.SafeLoader):
    """The safe loader of YAML; it takes no key twice, of which the last would win unseen, and no deep nesting."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.depth >= _DEEPEST:
            raise yaml.composer.ComposerError(None, None, _TOO_DEEP, self.get_mark())
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue  # refused by the safe loader
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key {key.value!r} is there twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


_TOO_DEEP = f"nested more than {_DEEPEST} levels deep"


def _check_extent(tree: Any) -> None:
    """Refuse a document that its aliases make too large, or endless.

    Raises:
        ValueError: it has too many levels or values.
    """
    level, count = [tree], 0
    for _ in range(_DEEPEST + 1):
        if not level:
            return
        count += len(level)
        if count > _MOST_VALUES:
            raise ValueError(f"more than {_MOST_VALUES} values, its aliases written out")
        inner = (held.values() if isinstance(held, dict) else held for held in level if isinstance(held, dict | list | tuple))
        level = [value for values in inner for value in values]
    raise ValueError(_TOO_DEEP)


class Section(BaseModel):
    """A section of the configuration. It is frozen and refuses unknown keys.

    The docstring under each field is its help text; the part after "Watch:" says what to watch when changing it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False)


def said(error: ValidationError, model: type[BaseModel], section: str = "") -> str:
    """Describe the first error of pydantic in one line: the key, what was expected, what was found.

    An unknown key is reported before a missing one, as it may be the missing key, misspelt.

    Args:
        error: the error raised when a section was validated.
        model: class of that section.
        section: dotted name of that section; empty for the whole configuration.
    """
    complaints = error.errors()
    unknown = {_dotted(section, *each["loc"]): each.get("input") for each in complaints if each["type"] == "extra_forbidden"}
    gone = {key: fate for key, value in unknown.items() if (fate := what_became_of(key, value)) is not None}
    if len(gone) > 1:
        return f"{len(gone)} keys are no longer settings; the first: {next(iter(gone.values()))}; all: {', '.join(gone)}"
    if gone:
        return next(iter(gone.values()))
    first = min(complaints, key=lambda complaint: complaint["type"] != "extra_forbidden")
    kind, message = first["type"], first["msg"]
    where = _dotted("", *first["loc"])
    if kind == "extra_forbidden":
        return f"unknown key {where!r}{_hint(where, model)}"
    if kind == "missing":
        return f"{where}: is missing"
    if kind == "value_error":
        return f"{where}: {first['ctx']['error']}" if where else str(first["ctx"]["error"])
    if kind == "too_short":
        message = f"expected at least {first['ctx']['min_length']} of them"
    elif kind in _WORDS:
        message = f"expected {_WORDS[kind]}"
    elif message.startswith("Input should be "):
        expected = message.removeprefix("Input should be ")
        message = f"expected {'a number ' if expected.startswith(('greater', 'less')) else ''}{expected}"
    return f"{where}: {message}, found {repr(first.get('input'))[:80]}"


def _hint(unknown: str, model: type[BaseModel]) -> str:
    """The key that was probably meant, or else the keys of the section in which the unknown one stands; empty: not known."""
    *parts, last = unknown.split(".")
    for part in parts:
        field = model.model_fields.get(part)
        if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            return ""
        model = field.annotation
    near = get_close_matches(last, model.model_fields, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; expected one of {', '.join(model.model_fields)}"


def _dotted(section: str, *parts: int | str) -> str:
    return ".".join(str(part) for part in (section, *parts) if part != "")


def read_mapping(path: Path, error: type[HybridMapError] = ConfigError) -> dict[str, Any]:
    """Read a YAML file that holds a mapping; an empty file gives an empty mapping.

    Args:
        path: the file.
        error: class of the exception to raise.

    Raises:
        OSError: there is no such file, or it cannot be opened.
        HybridMapError: of the class `error`: the file is not YAML (the message names the line), or holds no mapping.
    """
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise error(f"{path}: holds {size} bytes, expected at most {_MOST_BYTES}; is it a configuration?")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as mistake:
        raise error(f"{path}: not YAML: {mistake}") from None
    return mapping_of(text, str(path), error)


def mapping_of(text: str, origin: str, error: type[HybridMapError] = ConfigError) -> dict[str, Any]:
    """Read a YAML text that holds a mapping; an empty text gives an empty mapping.

    Args:
        text: the YAML text.
        origin: name of the text in error messages.
        error: type of the error to raise if the text is not YAML or holds no mapping.
    """
    tree = value_of(text, origin, error)
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise error(f"{origin}: expected a mapping of keys to values, found {type(tree).__name__}")
    return tree


def value_of(text: str, origin: str, error: type[HybridMapError] = ConfigError) -> Any:
    """Read one YAML value; an empty text gives None.

    Args:
        text: the YAML text.
        origin: name of the text in error messages.
        error: type of the error to raise if the text is not YAML, a mapping in it has the same key twice, or a value in it is
            nested too deep or cannot be used.
    """
    if len(text) > _MOST_BYTES:
        raise error(f"{origin}: holds {len(text)} characters, expected at most {_MOST_BYTES}; is it a configuration?")
    try:
        tree = yaml.load(text, Loader=_Strict)
        _check_extent(tree)
    except yaml.YAMLError as mistake:
        mark = getattr(mistake, "problem_mark", None)
        line = f"line {mark.line + 1}: " if mark is not None else ""
        raise error(f"{origin}: not YAML: {line}{getattr(mistake, 'problem', None) or mistake}") from None
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        TypeError,
        ValueError,
    ) as mistake:  # as of 2001-99-99
        raise error(f"{origin}: a value cannot be used: {mistake}") from None
    return tree
