"""`prism-edge models list` and `info`."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from rich.console import Console
from rich.table import Table

from prism_edge.cli.models_trial import tried
from prism_edge.config import DepthConfig
from prism_edge.depth import entries, find, locate, networks_of, open_network
from prism_edge.depth.cards import sidecar_at
from prism_edge.depth.contract import ModelCard, input_ranges
from prism_edge.depth.offline import open_file
from prism_edge.depth.pulled import Pulled, all_pulled, find_pulled
from prism_edge.depth.registry import Entry, File, is_non_commercial, sha256_of
from prism_edge.errors import ModelError


def run(args: argparse.Namespace) -> int:
    """List or describe; returns the exit code. Raises ModelError for a network that can't be used."""
    console = Console(highlight=False, soft_wrap=False, markup=False, emoji=False)
    if args.action == "list":
        console.print(listing())
        console.print("`pull` brings a checkpoint that needs export; unverified: no digest of it is known.")
        return 0
    parts = networks_of(args.model)
    useful = [_describe(console, part) for part in parts]
    if not all(useful):
        return ModelError.exit_code
    if len(parts) > 1:
        open_network(args.model, DepthConfig())
        console.print(f"They are a pair: use it with --model {args.model}", soft_wrap=True)
    return 0


def listing() -> Table:
    """Every registered network, then whatever else was pulled."""
    table = Table(title="Depth networks")
    for heading in ("name", "depth", "licence", "input", "state"):
        table.add_column(heading, no_wrap=heading in ("name", "licence"))
    for entry in entries():
        card = entry.card
        size = f"{card.input_width}x{card.input_height}" if card else ""
        table.add_row(entry.name, entry.depth_kind.replace("_", " "), entry.licence, size, state(entry))
    for pulled in all_pulled():
        if find(pulled.name) is None:
            table.add_row(pulled.name, "", pulled.licence or "not stated", "", _state_of_pulled(pulled))
    return table


def state(entry: Entry) -> str:
    """Whether it can be run by name here, in words."""
    path = entry.located()
    if path is None:
        if entry.card is None:
            return "needs export" if entry.is_pinned else "needs export (unverified)"
        return "can be pulled" if entry.can_be_pulled else "no file here"
    if entry.card is None:
        return "pulled, needs export"
    return _held_to_digests(path.parent, entry.files) or "ready"


def _state_of_pulled(pulled: Pulled) -> str:
    if not all((pulled.folder / file.name).is_file() for file in pulled.files):
        return "incomplete: pull again"
    return _held_to_digests(pulled.folder, pulled.files) or "pulled from elsewhere"


def _held_to_digests(folder: Path, files: tuple[File, ...]) -> str:
    """What is wrong with the files, in words; empty where all are what they should be."""
    try:
        right = all(sha256_of(folder / file.name) == file.sha256 for file in files)
    except ModelError as error:
        return str(error)
    return "" if right else "wrong digest"


def _describe(console: Console, model: str) -> bool:
    """Whether what it answers is of use, as far as can be told here."""
    entry = find(model)
    if entry is not None and (entry.card is None or entry.located() is None):
        _describe_entry(console, entry)
        return True
    network = open_file(model, DepthConfig())
    trial = tried(network)
    console.print(_card_table(network.card, f"{network.name}: the file agrees with its card"))
    console.print(f"file      {locate(model)}", soft_wrap=True)
    console.print(f"sha256    {sha256_of(locate(model))}", soft_wrap=True)
    console.print(f"card      {_origin(locate(model), network.card)}", soft_wrap=True)
    console.print(f"provider  {network.provider}")
    ranges = dict.fromkeys(input_ranges(network.card))
    inputs = ", ".join(f"{dark:.3g} to {bright:.3g}" for dark, bright in ranges)
    console.print(f"input     of black to white: {inputs}", soft_wrap=True)
    console.print(f"depth     of a test picture: {trial.words}", soft_wrap=True)
    if trial.warning:
        console.print(f"warning   {trial.warning}", soft_wrap=True)
    pulled = find_pulled(model)
    if pulled:
        console.print(f"pulled    {pulled.files[0].url}", soft_wrap=True)
    _say_use(console, network.card)
    return trial.usable


def _origin(path: Path, card: ModelCard) -> str:
    """Where the card of a file is from, in words."""
    entry = find(card.name)
    own = "the registry" if entry is not None and entry.card == card else "the file itself"
    return str(sidecar_at(path) or own)


def _describe_entry(console: Console, entry: Entry) -> None:
    """A checkpoint, or a registered network whose file is not here."""
    if entry.card is not None:
        console.print(_card_table(entry.card, f"{entry.name}: file not at hand"))
        console.print(f"file      {entry.file}: {entry.obtain}", soft_wrap=True)
        _say_pull(console, entry)
        _say_use(console, entry.card)
        return
    console.print(f"{entry.name}: {entry.export}", soft_wrap=True)
    terms = ", non-commercial" if is_non_commercial(entry.licence) else ""
    console.print(f"licence   {entry.licence}{terms}")
    console.print(f"source    {entry.source}", soft_wrap=True)
    folder = entry.located()
    if folder is None:
        _say_pull(console, entry)
    else:
        console.print(f"folder    {folder}", soft_wrap=True)
    console.print("It must be exported to ONNX first (tools/export_da3); then name the file.", soft_wrap=True)


def _say_pull(console: Console, entry: Entry) -> None:
    if not entry.can_be_pulled:
        return
    extra = "" if entry.is_pinned else " --unverified"
    console.print(f"pull      prism-edge models pull {entry.name}{extra}")
    if not entry.is_pinned:
        console.print("          no digest is known: nothing tells that what comes is the real one")


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
    if card.views > 1:
        how = "use it with `prism-edge reconstruct`"
        console.print(f"It takes {card.views} pictures and their poses at once: {how}.", soft_wrap=True)
    elif not card.has_metres:
        console.print("It has no metres of its own: use it as nested:THIS,METRIC.")
