"""Writes docs/CONFIGURATION.md's tables from the configuration tree itself; `--check` only compares."""

from __future__ import annotations

import argparse
import sys
import typing
from itertools import groupby
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge import config as tree
from prism_edge.config_file import Leaf, leaves

PAGE = Path(__file__).resolve().parents[1] / "docs" / "CONFIGURATION.md"
BEGIN = "<!-- written by `make docs`: change the help in prism_edge/config.py instead -->\n"


def tables() -> str:
    """One table for each section, in the tree's order."""
    parts = []
    for section, group in groupby(leaves(), key=lambda leaf: leaf.key.rpartition(".")[0]):
        rows = list(group)
        parts += [f"## {section or 'Top level'}", _purpose(section), *_reloads(rows), ""]
        parts += ["| key | default | takes | meaning |", "|---|---|---|---|", *map(_line, rows), ""]
    return "\n".join(parts)


def _purpose(section: str) -> str:
    types = typing.get_type_hints(tree.Config)
    return str((types[section] if section else tree.Config).__doc__).strip()


def _reloads(rows: list[Leaf]) -> list[str]:
    """What SIGHUP does with a section's keys; nothing where only a restart changes them."""
    who = {leaf.reload for leaf in rows if leaf.reload}
    if not who:
        return []
    usual = min(who, key=len)
    said = [f"SIGHUP takes changes up{_by(usual)}"]
    said += [f"`{leaf.key}`{_by(leaf.reload)}" for leaf in rows if leaf.reload != usual]
    return ["", "; ".join(said) + "."]


def _by(who: tuple[str, ...]) -> str:
    if not who:
        return ": only by a restart"
    return "" if who == ("supervisor",) else f": starts {' and '.join(f'`{name}`' for name in who)} anew"


def _line(leaf: Leaf) -> str:
    default = list(leaf.default) if isinstance(leaf.default, tuple) else leaf.default
    shown = str(default).lower() if isinstance(default, bool) else str(default) or "(empty)"
    cells = (f"`{leaf.key}`", shown, leaf.expects, leaf.help)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def page(current: str) -> str:
    """The page with its tables brought up to date; what stands before them is kept."""
    return current.partition(BEGIN)[0] + BEGIN + "\n" + tables()


def main() -> int:
    """Write or check; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="exit 1 where the page is out of date")
    args = parser.parse_args()
    current = PAGE.read_text(encoding="utf-8")
    if args.check:
        if current != page(current):
            print(f"{PAGE} is out of date: run `make docs`", file=sys.stderr)
            return 1
        return 0
    PAGE.write_text(page(current), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
