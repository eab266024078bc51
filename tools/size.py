"""Count the lines, modules and settings of a checkout, and the modules that only one other module imports.

    python tools/size.py [TREE]

TREE is the folder that holds `hybridmap/` and `tools/`; default: this checkout. Every `import` counts, also inside a
function.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

PACKAGE = "hybridmap"


def main(tree: Path) -> None:
    """Print the counts."""
    sys.path.insert(0, str(tree))
    from hybridmap.config import Config

    files = {name_of(path, tree): path for path in sorted((tree / PACKAGE).rglob("*.py"))}
    single = sorted(name for name, users in importers(files).items() if len(users) == 1 and not is_command(name))
    keys = sorted(settings(Config))
    for part in (PACKAGE, "tools"):
        lines = [line for path in (tree / part).rglob("*.py") for line in path.read_text(encoding="utf-8").splitlines()]
        print(f"{part}: {len(lines)} lines, {sum(bool(line.strip()) for line in lines)} of them not blank")
    print(f"modules: {sum(path.name != '__init__.py' for path in files.values())}, with the packages themselves {len(files)}")
    print(f"modules outside cli/ with a single importer: {len(single)}")
    print(f"settings: {len(keys)}, the deepest of {max(key.count('.') + 1 for key in keys)} levels")
    print("\n".join(["", "single importers:", *(f"  {name}" for name in single)]))


def name_of(path: Path, tree: Path) -> str:
    """Return the dotted name of a module."""
    return ".".join(path.relative_to(tree).with_suffix("").parts).removesuffix(".__init__")


def is_command(name: str) -> bool:
    """Tell whether a module belongs to the command line."""
    return name.startswith(f"{PACKAGE}.cli")


def importers(files: dict[str, Path]) -> dict[str, set[str]]:
    """Return module -> the modules that import it. The `__init__` modules of packages are left out."""
    found: dict[str, set[str]] = defaultdict(set)
    for user, path in files.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for name in imported(node):
                if name in files and name != user and files[name].name != "__init__.py":
                    found[name].add(user)
    return found


def imported(node: ast.AST) -> Iterator[str]:
    """Yield the dotted names that a statement imports: modules, and names in modules."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module is not None:
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)


def settings(section: type[BaseModel], above: str = "") -> Iterator[str]:
    """Yield the dotted name of each setting. An optional section counts as one setting."""
    for name, field in section.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from settings(kind, f"{above}{name}.")
        else:
            yield above + name


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1])
