"""Pages for people say what is there: their links lead somewhere, their commands and figures are right."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from prism_edge.cli.main import COMMANDS, build_parser
from prism_edge.config import ABLATIONS

CHECKOUT = Path(__file__).resolve().parents[1]
PAGES = sorted([*CHECKOUT.glob("*.md"), *CHECKOUT.glob("docs/*.md")])


def anchors(page: Path) -> set[str]:
    """What links may name in a page: its headings, as they are shown on the web."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_named_by_the_readme() -> None:
    said = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    pages = [f"docs/{page.name}" for page in PAGES if page.parent.name == "docs"]
    assert [page for page in pages if f"]({page})" not in said] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_take_the_options_shown(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    shown: dict[str, set[str]] = {}
    for command, rest in re.findall(r"prism-edge ([a-z]+)((?: [^`\n|#]*)?)", text):
        if command in COMMANDS:
            shown.setdefault(command, set()).update(re.findall(r"(?<=\s)--[a-z][a-z0-9-]+", rest))
    for command, options in shown.items():
        arguments = [command, "--help"]
        if command == "models":
            arguments, options = [command, "bench", "--help"], options & {"--providers", "--threads"}
        if command == "map":
            arguments = [command, "export", "--help"]
        with pytest.raises(SystemExit):
            build_parser(command).parse_args(arguments)
        taken = set(re.findall(r"--[a-z][a-z0-9-]+", capsys.readouterr().out))
        assert options <= taken, command


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tools_and_targets_are_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z]+):", (CHECKOUT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for tool in re.findall(r"(?<![\w/])tools/[\w/]+\.(?:py|sh)\b", text):
        assert (CHECKOUT / tool).is_file(), tool
    for target in re.findall(r"`make ([a-z]+)|^make ([a-z]+)", text, re.MULTILINE):
        assert "".join(target) in targets


def test_the_readme_has_the_figures_of_the_performance_page() -> None:
    table = (CHECKOUT / "docs" / "PERFORMANCE.md").read_text(encoding="utf-8")
    said = (CHECKOUT / "README.md").read_text(encoding="utf-8")
    for row, pattern in {
        "live ATE, Sim(3)": r"within ([\d.]+) cm of the true path in shape",
        "live ATE, SE(3)": r"in shape and ([\d.]+) cm in metres",
        "first metric pose": r"the first is out after ([\d.]+) s",
        "latency p50": r"reach a subscriber within ([\d.]+) ms",
        "CPU, all processes": r"all processes together take ([\d.]+) ms",
        "memory, all processes (PSS)": r"of CPU a frame and ([\d.]+) MB",
    }.items():
        median = re.search(rf"^\| {re.escape(row)} \| ([\d.]+)", table, re.MULTILINE)
        quoted = re.search(pattern, said)
        assert median is not None, row
        assert quoted is not None, row
        assert quoted[1] == median[1], row


def test_every_part_that_can_be_switched_off_is_explained() -> None:
    page = (CHECKOUT / "docs" / "EVALUATION.md").read_text(encoding="utf-8")
    explained = next(line for line in page.splitlines() if line.startswith("`--ablate`"))
    assert [part for part in ABLATIONS if f"`{part}` (" not in explained] == []
