"""`prism-edge models`: which depth networks are known, and what one says of itself."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import Any

from rich.console import Console
from rich.table import Table

from prism_edge.config import DepthConfig
from prism_edge.depth import entries, find, locate, open_onnx
from prism_edge.depth.contract import ModelCard
from prism_edge.depth.registry import Entry, sha256_of


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "models",
        help="list the known depth networks, or describe one",
        description="Depth networks. A network is named to `run` and `eval` by its file, by its registered "
        "name once its file is at hand, or as nested:RELATIVE,METRIC. docs/MODELS.md says how a file of "
        "your own describes itself.",
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    actions.add_parser("list", help="every registered network, its licence, and whether it is at hand")
    info = actions.add_parser("info", help="one network's card; a file is loaded and checked against it")
    info.add_argument("model", metavar="NAME_OR_PATH", help="registered name or ONNX file")


def run(args: argparse.Namespace) -> int:
    """List or describe; returns the exit code. Raises ModelError for a network that can't be used."""
    console = Console(highlight=False, soft_wrap=False)
    if args.action == "list":
        console.print(_listing())
    else:
        _describe(console, args.model)
    return 0


def _listing() -> Table:
    table = Table(title="Depth networks")
    for heading in ("name", "depth", "licence", "input", "state"):
        table.add_column(heading, no_wrap=heading in ("name", "licence", "state"))
    for entry in entries():
        card = entry.card
        table.add_row(
            entry.name,
            entry.depth_kind.replace("_", " "),
            entry.licence,
            f"{card.input_width}x{card.input_height}" if card else "",
            _state(entry),
        )
    return table


def _state(entry: Entry) -> str:
    """Whether it can be run by name here, in words."""
    if entry.card is None:
        return "needs export"
    path = entry.located()
    if path is None:
        return "no file here"
    return "ready" if sha256_of(path) == entry.card.sha256 else "wrong digest"


def _describe(console: Console, model: str) -> None:
    entry = find(model)
    if entry is not None and entry.located() is None:
        _describe_entry(console, entry)
        return
    network = open_onnx(model, DepthConfig())
    console.print(_card_table(network.card, f"{network.name}: the file agrees with its card"))
    console.print(f"file      {locate(model)}", soft_wrap=True)
    console.print(f"sha256    {network.digest}", soft_wrap=True)
    console.print(f"provider  {network.provider}")
    _say_use(console, network.card)


def _describe_entry(console: Console, entry: Entry) -> None:
    """A registered network whose file is not here."""
    if entry.card is None:
        console.print(f"{entry.name}: {entry.export}", soft_wrap=True)
        console.print(f"licence   {entry.licence}")
        console.print("It must be exported to ONNX first; then name the exported file.")
        return
    console.print(_card_table(entry.card, f"{entry.name}: file not at hand"))
    console.print(f"file      {entry.file}: {entry.obtain}", soft_wrap=True)
    _say_use(console, entry.card)


def _card_table(card: ModelCard, title: str) -> Table:
    table = Table(title=title)
    table.add_column("key", no_wrap=True)
    table.add_column("value", overflow="fold")
    for field in fields(card):
        value = getattr(card, field.name)
        if value in ("", None):
            value = "none"
        if isinstance(value, tuple):
            value = ", ".join(f"{item:g}" for item in value)
        table.add_row(field.name, f"{value:.6g}" if isinstance(value, float) else str(value))
    return table


def _say_use(console: Console, card: ModelCard) -> None:
    if not card.has_metres:
        console.print("It has no metres of its own: use it as nested:THIS,METRIC.")
