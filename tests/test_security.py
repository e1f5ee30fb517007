"""What the code must never do with what comes from outside: looked for in every file."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
FILES = sorted(file for folder in ("prism_edge", "tools") for file in (CHECKOUT / folder).rglob("*.py"))

# Modules whose reader runs what it reads, or trusts it.
FORBIDDEN = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "joblib"}
CALLS = {"eval", "exec", "compile", "__import__"}
TRUSTING_YAML = {"load", "load_all", "full_load", "unsafe_load", "Loader", "FullLoader", "UnsafeLoader"}


def nodes(file: Path) -> Iterator[ast.AST]:
    return ast.walk(ast.parse(file.read_text(encoding="utf-8")))


def called(node: ast.AST) -> tuple[str, str]:
    """``("np", "load")`` of a call ``np.load(...)``, ``("", "eval")`` of ``eval(...)``."""
    if isinstance(node, ast.Call):
        if isinstance(node.func, ast.Name):
            return "", node.func.id
        if isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name):
            return node.func.value.id, node.func.attr
    return "", ""


def safe_loaders(file: Path) -> set[str]:
    """Classes of a file that stand on yaml.SafeLoader."""
    classes = (node for node in nodes(file) if isinstance(node, ast.ClassDef))
    return {c.name for c in classes if "yaml.SafeLoader" in map(ast.unparse, c.bases)}


def has_pipes(file: Path) -> bool:
    """Whether a file uses multiprocessing, whose connections pickle what ``send`` is given."""
    imports = (node for node in nodes(file) if isinstance(node, ast.Import | ast.ImportFrom))
    return any("multiprocessing" in ast.unparse(node) for node in imports)


def flaws(file: Path) -> Iterator[str]:
    safe = safe_loaders(file)
    pipes = has_pipes(file)
    for node in nodes(file):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
            yield from (f"imports {name}" for name in names if name.split(".")[0] in FORBIDDEN)
        owner, name = called(node)
        if not owner and name in CALLS:
            yield f"calls {name}()"
        by_safe = isinstance(node, ast.Call) and any(ast.unparse(a) in safe for a in node.args[1:])
        if owner == "yaml" and name in TRUSTING_YAML and not by_safe:
            yield f"calls yaml.{name}()"
        if pipes and isinstance(node, ast.Attribute) and node.attr in ("send", "recv"):
            yield f"pickles by {node.attr}"
        if owner in ("os", "subprocess") and name in ("system", "popen", "getoutput", "getstatusoutput"):
            yield f"calls {owner}.{name}()"
        if isinstance(node, ast.keyword):
            value = node.value.value if isinstance(node.value, ast.Constant) else None
            if node.arg in ("allow_pickle", "shell") and value is not False:
                yield f"gives {node.arg}={value}"
        if owner == "np" and name == "load":
            given = {k.arg for k in node.keywords} if isinstance(node, ast.Call) else set()
            if "allow_pickle" not in given:
                yield "calls np.load() without allow_pickle=False"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(CHECKOUT)))
def test_nothing_from_outside_is_run(file: Path) -> None:
    assert list(flaws(file)) == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "import os; os.system('x')",
        "eval('x')",
        "import yaml; yaml.load(x)",
        "import yaml\nclass L(yaml.Loader): pass\nyaml.load(x, L)",
        "import numpy as np; np.load('x')",
        "import numpy as np; np.load('x', allow_pickle=True)",
        "import multiprocessing as m; m.Pipe()[0].recv()",
        "import subprocess; subprocess.run('x', shell=True)",
    ],
)
def test_the_search_finds(code: str, tmp_path: Path) -> None:
    file = tmp_path / "code.py"
    file.write_text(code)
    assert list(flaws(file))


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-extras.lock"])
def test_every_dependency_is_pinned(name: str) -> None:
    lock = (CHECKOUT / name).read_text().splitlines()
    lines = [line for line in (text.partition("#")[0].strip() for text in lock) if line]
    assert lines
    assert all("==" in line for line in lines)
