"""docs/OPERATIONS.md: its table of commands is the code's."""

from __future__ import annotations

import re
from pathlib import Path

from prism_edge.backend.map_file import MAGIC, VERSION
from prism_edge.config_file import leaves
from prism_edge.topics import COMMANDS
from prism_edge.workers.map_keeper import AGAIN_S, SELDOM_S

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "OPERATIONS.md").read_text(encoding="utf-8")


def test_the_table_of_commands_is_the_codes_own() -> None:
    section = TEXT.split("## Commands\n", 1)[1].split("\n## ", 1)[0]
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\| (\w+) \|", section, re.MULTILINE)
    assert {name: process for name, _, process in rows} == {c.name: c.process for c in COMMANDS.values()}
    for name, argument, _ in rows:
        assert bool(argument.strip()) == bool(COMMANDS[name].argument)


def test_every_section_that_can_be_reloaded_is_named() -> None:
    section = TEXT.split("## Reloading\n", 1)[1].split("\n## ", 1)[0]
    taken_up = section.split("What can change", 1)[1].split("Other keys", 1)[0]
    reloaded = {leaf.key.split(".")[0] for leaf in leaves() if leaf.reload}
    assert set(re.findall(r"`(\w+)`", taken_up)) == reloaded


def test_how_often_a_journal_is_tried_again() -> None:
    assert (AGAIN_S, SELDOM_S) == (2.0, 60.0)
    assert "tried again after two seconds, then less and less often, once a minute at last" in TEXT


def test_the_layout_of_maps_is_the_codes_own() -> None:
    assert f"| 0 | `{MAGIC.decode()}` |" in TEXT
    assert f"version of the layout, u32: {VERSION} |" in TEXT
