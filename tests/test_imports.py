"""Layers: hmc stands alone, loads fast, and every file stays small and says what it is."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("hmc", "train", "deploy", "tools", "tests")
MAX_LINES = 399
HEAVY = ("mujoco_warp", "warp", "rsl_rl", "tensorboard", "onnx", "matplotlib", "imageio", "tyro")

# Who may import whom, of the folders of this repository; hmc may import none of the others.
ALLOWED = {
    "hmc": {"hmc"},
    "train": {"hmc", "train"},
    "deploy": {"hmc", "deploy"},
    "tools": {"hmc", "train", "deploy", "tools"},
    "tests": set(FOLDERS),
}


def sources() -> list[Path]:
    """Every Python file of the project, relative to its root."""
    return sorted(path.relative_to(ROOT) for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def imported(tree: ast.Module) -> Iterator[str]:
    """Top-level package of every absolute import in a module, those inside functions included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.split(".")[0]


@pytest.mark.parametrize("path", sources(), ids=str)
def test_module(path: Path) -> None:
    text = (ROOT / path).read_text(encoding="utf-8")
    tree = ast.parse(text, filename=str(path))

    lines = len(text.splitlines())
    assert lines <= MAX_LINES, f"{path} has {lines} lines, at most {MAX_LINES}: split it"

    assert ast.get_docstring(tree), f"{path} must open with a docstring: one sentence on what it is"

    wrong = (set(imported(tree)) & set(FOLDERS)) - ALLOWED[path.parts[0]]
    assert not wrong, f"{path} imports {', '.join(sorted(wrong))}, which {path.parts[0]} must not"


def loaded(code: str, names: tuple[str, ...]) -> list[str]:
    """Which of the packages a fresh interpreter has loaded after running `code`."""
    code = f"import sys\n{code}\nprint(*[name for name in {names!r} if name in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return ran.stdout.split()


def test_public_names_need_no_extras() -> None:
    """A robot or a user of the CPU engine has none of these installed, or does not want the wait."""
    assert loaded("import hmc\nfor name in hmc.__all__: getattr(hmc, name)", HEAVY) == []


def test_import_alone_loads_nothing() -> None:
    """A real-time process may take a constant or a setting from hmc without paying for torch."""
    assert loaded("import hmc, hmc.cfg, hmc.go2.facts", ("torch", "numpy", "mujoco", *HEAVY)) == []


def test_the_estimator_needs_numpy_alone() -> None:
    """It runs in the robot's real-time process."""
    assert loaded("import deploy.estimator", ("torch", "mujoco", "onnxruntime", "hmc", *HEAVY)) == []


def test_import_prints_nothing() -> None:
    ran = subprocess.run([sys.executable, "-c", "import hmc"], cwd=ROOT, capture_output=True, text=True)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "")


def test_every_folder_of_hmc_is_a_package() -> None:
    """A folder without __init__.py would silently be left out of the wheel."""
    folders = {(ROOT / path).parent for path in sources() if path.parts[0] == "hmc"}
    missing = [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").exists()]
    assert not missing, f"no __init__.py in {', '.join(sorted(missing))}"
