"""What docs/ARCHITECTURE.md says of the code's shape: who imports whom, and who listens to what."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from prism_edge.processes import PROCESSES
from prism_edge.topics import COMMANDS, TOPICS

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = CHECKOUT / "prism_edge"
TABLES = {"config", "topics", "processes", "messages", "config_file", "errors", "vital"}
TABLES |= {"named_path", "all_or_nothing", "huge_pages"}
# What each part may import besides the tables, from the bottom up. The cores know nothing of the bus.
BELOW = {
    "geometry": set(),
    "tracking": {"geometry"},
    "depth": {"geometry"},
    "scale": {"geometry"},
    "backend": {"geometry", "tracking"},
    "sources": {"geometry"},
    "calibration": {"geometry"},
    "reconstruction": {"geometry", "tracking", "depth", "scale", "backend"},
    "bus": {"geometry"},
    "workers": {"geometry", "tracking", "depth", "scale", "backend", "sources", "bus"},
    "supervisor": {"bus", "sources", "workers"},
    "evaluation": {"geometry", "depth", "bus", "sources", "workers"},
}


def imported(part: str) -> Iterator[str]:
    """Modules of prism_edge that a folder's files import, wherever in the file."""
    for file in sorted((PACKAGE / part).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("prism_edge."):
                yield str(node.module).split(".")[1]
            elif isinstance(node, ast.Import):
                yield from (n.name.split(".")[1] for n in node.names if n.name.startswith("prism_edge."))


@pytest.mark.parametrize("part", BELOW)
def test_imports_run_downwards(part: str) -> None:
    found = set(imported(part)) - {part} - TABLES
    assert found <= BELOW[part]


def test_every_folder_has_its_place() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert folders == BELOW.keys() | {"cli"}
    page = (CHECKOUT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8")
    tree = page.split("## The tree", 1)[1]
    assert set(re.findall(r"^  (\w+)/ ", tree, re.MULTILINE)) == folders


def heard(process: str) -> set[str]:
    """Topics whose names a worker's file hands to ``queue``, ``latest`` or ``ask``."""
    names: set[str] = set()
    files = [f"{process}.py", *(["map_adoption.py"] if process == "tracker" else [])]
    trees = [ast.parse((PACKAGE / "workers" / file).read_text(encoding="utf-8")) for file in files]
    for node in (node for tree in trees for node in ast.walk(tree)):
        # {name: bus.queue(name) for name in ("depth", ...)} asks for what it runs over
        asked = node.generators[0].iter if isinstance(node, ast.DictComp) else node
        is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if isinstance(node, ast.DictComp) or (is_call and node.func.attr in ("queue", "latest", "ask")):
            names |= {c.value for c in ast.walk(asked) if isinstance(c, ast.Constant)} & TOPICS.keys()
    return names


@pytest.mark.parametrize("process", PROCESSES)
def test_the_topic_table_says_who_listens(process: str) -> None:
    # The source hears acknowledgements through bus/lockstep.py's gatekeeper.
    found = heard(process) | ({"acknowledged"} if process == "source" else set())
    assert found == {name for name, topic in TOPICS.items() if process in topic.consumers}


COMMAND_FILES = {"source": "workers/pause.py", "supervisor": "supervisor/supervisor.py"}


@pytest.mark.parametrize("process", sorted({command.process for command in COMMANDS.values()}))
def test_the_command_table_says_who_does_them(process: str) -> None:
    file = PACKAGE / COMMAND_FILES.get(process, f"workers/{process}.py")
    taken: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        if is_call and node.func.attr == "commands":
            (handlers,) = node.args
            assert isinstance(handlers, ast.Dict)
            taken |= {key.value for key in handlers.keys if isinstance(key, ast.Constant)}
    assert taken == {command.name for command in COMMANDS.values() if command.process == process}
