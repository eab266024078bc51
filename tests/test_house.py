"""What holds for the package as a whole: cheap imports, a complete wheel, documented and small modules, layers."""

import ast
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.narrowing import known

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hybridmap"
MODULES = sorted(path.relative_to(ROOT) for path in PACKAGE.rglob("*.py"))
TESTS = sorted(path.relative_to(ROOT) for path in (ROOT / "tests").rglob("*.py"))
HEAVY = ("open3d", "matplotlib", "gtsam", "cv2", "scipy", "rosbags", "numba")
MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60

HELP = f"""
import sys
sys.argv = ["hybridmap", "--help"]
from hybridmap.cli import main
try:
    main()
except SystemExit as stop:
    assert not stop.code, stop.code
print("HEAVY", [name for name in {HEAVY!r} if name in sys.modules])
"""

BY_NAME = """
import sys, hybridmap
from pathlib import Path
from hybridmap.config import Config, named_configs
assert Path(hybridmap.__file__).is_relative_to(sys.argv[1]), hybridmap.__file__
for name, path in named_configs().items():
    assert path.is_relative_to(sys.argv[1]), path
    Config.load(name)
print(" ".join(named_configs()))
"""


def run(*command: str | Path, cwd: Path, path: Path | None = None) -> str:
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    if path is not None:
        env["PYTHONPATH"] = str(path)
    done = subprocess.run([*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_help_loads_no_heavy_library(tmp_path: Path) -> None:
    out = run(sys.executable, "-c", HELP, cwd=tmp_path)
    assert "Usage: hybridmap" in out
    assert out.splitlines()[-1] == "HEAVY []"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_holds_every_file_that_the_package_reads(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {str(path) for path in MODULES}
    expected |= {f"hybridmap/configs/{path.name}" for path in (ROOT / "configs").glob("*.yaml")}
    expected |= {str(path.relative_to(ROOT)) for path in PACKAGE.rglob("*.j2")}
    expected.add("hybridmap/docs/paper.md")
    assert expected - names == set()
    assert [name for name in names if name.endswith("licenses/LICENSE")]


def test_the_wheel_works_outside_a_checkout(wheel: Path, tmp_path: Path) -> None:
    installed, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", installed, wheel)
    run(*pip, cwd=empty)
    names = run(sys.executable, "-c", BY_NAME, installed, cwd=empty, path=installed).split()
    assert sorted(names) == sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))
    assert {"rgbd", "laser"} <= set(names)
    mapping = ("map", "lab", "--config", "rgbd", "--end", "1", "--out", "session", "--json")
    out = run(sys.executable, "-c", "from hybridmap.cli import main; main()", *mapping, cwd=empty, path=installed)
    assert json.loads(out)["source"] == "lab"
    assert (empty / "session" / "report.html").is_file()


def public(tree: ast.Module) -> list[ast.Module | ast.ClassDef | ast.FunctionDef]:
    """The module itself and every public class, function and method at any depth of public classes."""
    found: list[ast.Module | ast.ClassDef | ast.FunctionDef] = [tree]
    for node in found:
        if not isinstance(node, ast.FunctionDef):
            children = (child for child in node.body if isinstance(child, ast.ClassDef | ast.FunctionDef))
            found += [child for child in children if not child.name.startswith("_")]
    return found


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_everything_public_is_documented(module: Path) -> None:
    tree = ast.parse((ROOT / module).read_text())
    assert [getattr(node, "name", "module") for node in public(tree) if not ast.get_docstring(node)] == []


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_files_and_functions_stay_small(module: Path) -> None:
    text = (ROOT / module).read_text()
    assert len(text.splitlines()) <= MAX_FILE_LINES
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    lines = {f.name: known(f.end_lineno) - f.lineno + 1 for f in functions}
    assert {name: count for name, count in lines.items() if count > MAX_FUNCTION_LINES} == {}


def private(name: str) -> bool:
    return any(part.startswith("_") and not part.startswith("__") for part in name.split("."))


def reaches_inside(node: ast.AST) -> bool:
    """Whether a piece of a test takes a private attribute of something else, imports a private name, or patches one by name."""
    if isinstance(node, ast.Attribute):
        own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
        return private(node.attr) and not own
    if isinstance(node, ast.Import | ast.ImportFrom):
        module = node.module if isinstance(node, ast.ImportFrom) else None
        return private(module or "") or any(private(alias.name) for alias in node.names)
    if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in ("getattr", "setattr", "delattr"):
        return any(isinstance(word, ast.Constant) and isinstance(word.value, str) and private(word.value) for word in node.args)
    return False


@pytest.mark.parametrize("test", TESTS, ids=str)
def test_tests_hold_behaviour_and_reach_into_nothing_private(test: Path) -> None:
    tree = ast.parse((ROOT / test).read_text())
    assert [f"{getattr(node, 'lineno', 0)}: {ast.unparse(node)}" for node in ast.walk(tree) if reaches_inside(node)] == []


def test_imports_point_only_to_earlier_stages() -> None:
    out = run(Path(sys.executable).with_name("lint-imports"), "--no-cache", cwd=ROOT)
    assert " 0 broken" in out
