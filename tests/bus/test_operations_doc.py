"""docs/OPERATIONS.md: its table of commands is the code's."""

from __future__ import annotations

import re
from pathlib import Path

from prism_edge.backend.map_file import MAGIC, VERSION
from prism_edge.topics import COMMANDS

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "OPERATIONS.md").read_text(encoding="utf-8")


def test_the_table_of_commands_is_the_codes_own() -> None:
    section = TEXT.split("## Commands\n", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\| (\w+) \|", section, re.MULTILINE)
    assert {name: process for name, _, process in rows} == {c.name: c.process for c in COMMANDS.values()}
    for name, argument, _ in rows:
        assert bool(argument.strip()) == bool(COMMANDS[name].argument)


def test_the_layout_of_maps_is_the_codes_own() -> None:
    assert f"| 0 | `{MAGIC.decode()}` |" in TEXT
    assert f"version of the layout, u32: {VERSION} |" in TEXT
