"""Versions and source text of the running code, so that results of different code are never mixed."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from functools import cache
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hybridmap.plugins import packages

SCHEMA = 1
"""Raised when the meaning of a figure changes."""

_LIBRARIES = ("gtsam", "numba", "numpy", "scipy", "opencv-python-headless")
_SHOWING = ("cli", "export", "report", "reproduction", "session.py", "study")
_SOLVING = (
    "backends",
    "config/backends.py",
    "geometry.py",
    "graph",
    "study/cell.py",
    "study/false_loops.py",
    "study/sources.py",
)
_JUDGING = ("study/disturb.py", "study/drive.py")


def digest(tree: Mapping[str, Any]) -> str:
    """SHA-256 of a nested mapping of plain values, independent of the order of keys; 64 hexadecimal digits."""
    text = json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def solving() -> str:
    """Digest of what determines the figures of a given graph: our code of solving, libraries, plugins, the kind of machine.

    Of libraries and plugins the versions count. Changed code of mapping changes `mapping` only.
    """
    return digest({"code": digest_of_code(solving_only=True), **_surroundings()})


@cache
def mapping() -> str:
    """Digest as `solving`, of mapping and solving; a stored drive is reused only if it is the same."""
    return digest({"code": digest_of_code(solving_only=False), **_surroundings()})


def _surroundings() -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "hybridmap": version("hybridmap"),
        "machine": platform.machine(),
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "plugins": packages(),
    }


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:  # the same library under another distribution's name
        return ""


def digest_of_code(*, solving_only: bool) -> str:
    """SHA-256 of hybridmap's source text, without the modules that only show results (commands, pages, exports).

    Args:
        solving_only: leave out the modules that only mapping a drive uses, and not solving a graph.
    """
    package = Path(str(resources.files("hybridmap")))
    total = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package).as_posix()
        wanted = name.startswith(_SOLVING) or (
            not solving_only and (name.startswith(_JUDGING) or not name.startswith(_SHOWING))
        )
        if wanted:
            total.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return total.hexdigest()
