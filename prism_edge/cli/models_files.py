"""`prism-edge models pull`, `verify` and `remove`."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)
from rich.prompt import Confirm
from rich.table import Table

from prism_edge.cli.models_trial import tried
from prism_edge.config import DepthConfig
from prism_edge.depth import entries, find, networks_of, open_network, pulling
from prism_edge.depth.download import Patience
from prism_edge.depth.folders import download_folder, folders
from prism_edge.depth.offline import open_file
from prism_edge.depth.pulled import MANIFEST, NAME, Pulled, find_pulled, manifest_of, pulled_at, pulled_names
from prism_edge.depth.registry import File, find_digest, is_non_commercial, sha256_of
from prism_edge.errors import ModelError
from prism_edge.named_path import named_path

_AS_REGISTERED = "as registered"
_AS_PULLED = {True: "as pulled (given digest)", False: "as pulled (unverified then)", None: "as pulled"}


def run(args: argparse.Namespace) -> int:
    """Do what was asked; returns the exit code. Raises ModelError where it can't be done."""
    console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)
    if args.action == "pull":
        return _pull(console, args)
    return _verify(console, args.models) if args.action == "verify" else _remove(console, args.name, args.yes)


def _pull(console: Console, args: argparse.Namespace) -> int:
    into = named_path(str(args.into)) if args.into else download_folder()
    entry = find(args.model)
    here = entry.located() if entry and not entry.can_be_pulled else None
    if here is not None:
        said = f"{args.model} is here already, as {here}: use it with --model {args.model}"
        console.print(said)
        return 0
    plan = _plan(args, into)
    console.print(f"{plan.name} from {plan.files[0].url.rpartition('/')[0]}")

    def approve(licence: str) -> None:
        console.print(f"licence: {licence or 'the file states none'}")
        if is_non_commercial(licence) and not args.accept_licence:
            _confirm(console, f"{plan.name}: its licence {licence} forbids commercial use")

    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )

    def progress_of(name: str) -> pulling.Progress:
        task = bars.add_task(name, total=None)
        return lambda have, total: bars.update(task, completed=have, total=total or None)

    showing: AbstractContextManager[object] = bars if console.is_terminal else nullcontext()
    with showing:
        done = pulling.pull(plan, _paused(bars, approve), progress_of, args.unverified, Patience(args.stall))
    for file in done.files:
        console.print(f"{file.name}  {file.size} bytes  SHA-256 {file.sha256}")
    console.print(f"in {done.folder}")
    _say_next(console, done)
    return 0


def _plan(args: argparse.Namespace, into: Path) -> Pulled:
    if "://" in args.model:
        return pulling.from_url(args.model, into, args.sha256, args.name)
    if args.sha256 or args.name:
        raise ModelError("--sha256 and --name go with a URL; a registered network has its own")
    entry = find(args.model)
    if entry is None:
        names = ", ".join(item.name for item in entries())
        raise ModelError(f"{args.model!r} is neither a URL nor a registered network ({names})")
    return pulling.from_entry(entry, into)


def _paused(bars: Progress, approve: pulling.Approve) -> pulling.Approve:
    """The question is asked without bars running across it."""

    def asked(licence: str) -> None:
        running = bars.live.is_started
        if running:
            bars.stop()
        approve(licence)
        if running:
            bars.start()

    return asked


def _confirm(console: Console, what: str) -> None:
    if not (console.is_terminal and sys.stdin.isatty()):
        raise ModelError(f"{what}: --accept-licence says that you keep to it")
    if not Confirm.ask(f"{what}. Do you keep to it?", default=False, console=console):
        raise ModelError(f"{what}: not accepted")


def _say_next(console: Console, done: Pulled) -> None:
    if not done.runnable:
        script = f".venv-export/bin/python tools/export_da3 {done.folder} {done.name}.onnx"
        console.print(f"Next: export it to ONNX: {script} (docs/EXPORT.md)")
        return
    try:
        network = open_file(str(done.path), DepthConfig())
    except ModelError as error:
        console.print(f"It can't be run yet: {error}")
        return
    name = done.name if done.folder.parent in folders() else str(done.path)
    use = f"--model {name}" if network.card.has_metres else f"--model nested:{name},METRIC"
    if network.card.views > 1:
        use = f"`prism-edge reconstruct --model {name}`"
    console.print(f"It loads and runs: use it with {use}")


def _verify(console: Console, names: list[str]) -> int:
    """A row for each network, of a pair for each part; 5 where one fails."""
    chosen = names or _at_hand()
    if not chosen:
        console.print("No network is at hand: `prism-edge models list` shows what is known.")
        return 0
    table = Table(title="Depth networks at hand")
    for heading in ("name", "digests", "runs"):
        table.add_column(heading, overflow="fold")
    failed = False
    for name in chosen:
        try:
            parts = networks_of(name)
        except ModelError as error:
            table.add_row(name, "", str(error))
            failed = True
            continue
        all_run = True
        for part in parts:
            digests, digests_right = _digests(part)
            runs, is_running = _runs(part)
            failed = failed or not (digests_right and is_running)
            all_run = all_run and is_running
            table.add_row(part, digests, runs)
        unfit = _unfit(name) if len(parts) > 1 and all_run else ""
        if unfit:
            failed = True
            table.add_row(name, "", unfit)
    Console(highlight=False, markup=False, emoji=False).print(table)
    return ModelError.exit_code if failed else 0


def _at_hand() -> list[str]:
    known = [entry.name for entry in entries() if entry.located()]
    return known + [name for name in pulled_names() if name not in known]


def _digests(name: str) -> tuple[str, bool]:
    """What the files' digests say, and whether they are right."""
    path = named_path(name)
    try:
        return _digests_of_path(path) if os.path.isfile(path) else _digests_of_name(name)
    except ModelError as error:
        return str(error), False


def _digests_of_name(name: str) -> tuple[str, bool]:
    entry, pulled = find(name), find_pulled(name)
    files: tuple[File, ...] = ()
    folder = Path()
    if pulled:
        files, folder = pulled.files, pulled.folder
    place = entry.located() if entry else None
    if entry and place and entry.is_pinned:
        files, folder = entry.files, place.parent
    if not files:
        is_here = entry and not entry.is_pinned and (entry.card or place)
        return ("none is known" if is_here else "not at hand"), True
    wrong = _wrong(folder, files)
    if wrong:
        return wrong, False
    if pulled and not (entry and entry.is_pinned):
        return _AS_PULLED[pulled.given], True
    return _AS_REGISTERED, True


def _digests_of_path(path: Path) -> tuple[str, bool]:
    registered, pulled = find_digest(sha256_of(path)), pulled_at(path)
    wrong = _wrong(pulled.folder, pulled.files) if pulled else ""
    if wrong:
        return wrong, False
    if registered:
        return _AS_REGISTERED, True
    return _AS_PULLED[pulled.given] if pulled else "none is known", True


def _wrong(folder: Path, files: tuple[File, ...]) -> str:
    for file in files:
        if not (folder / file.name).is_file():
            return f"{file.name} is missing"
        if sha256_of(folder / file.name) != file.sha256:
            return f"{file.name} is not the file it should be"
    return ""


def _runs(name: str) -> tuple[str, bool]:
    """Whether it can be loaded and run to some use, and if not, whether that is as it should be."""
    try:
        entry, pulled = find(name), find_pulled(name)
        if (entry and entry.card is None) or (pulled and not pulled.runnable):
            return "needs export", bool(pulled or (entry and entry.located()))
        network = open_file(name, DepthConfig())
        trial = tried(network)
    except ModelError as error:
        return str(error), False
    if not trial.usable:
        return f"on {network.provider}, but {trial.words}", False
    warning = f"; warning: {trial.warning}" if trial.warning else ""
    return f"on {network.provider}: {trial.words}{warning}", True


def _unfit(pair: str) -> str:
    """Why two networks that run are no pair; empty where they are one."""
    try:
        open_network(pair, DepthConfig())
    except ModelError as error:
        return str(error)
    return ""


def _remove(console: Console, name: str, yes: bool) -> int:
    folder, files = _removable(name)
    size = sum(path.stat().st_size for path in files)
    if not yes:
        what = f"delete {len(files)} files ({size >> 20} MB) in {folder}"
        if not (console.is_terminal and sys.stdin.isatty()):
            raise ModelError(f"{what}? --yes says so")
        if not Confirm.ask(what, default=False, console=console):
            return 0
    try:
        for path in files:
            path.unlink()
        with suppress(OSError):  # kept where there is something else in it
            folder.rmdir()
    except OSError as error:
        raise ModelError(f"{folder}: can't be deleted ({error.strerror})") from None
    console.print(f"deleted {len(files)} files in {folder}")
    return 0


def _removable(name: str) -> tuple[Path, list[Path]]:
    """What ``pull`` brought of a network, parts included: its folder and the files. Raises ModelError."""
    for folder in (place / name for place in folders() if NAME.fullmatch(name)):
        pulled = manifest_of(folder)
        listed = [folder / MANIFEST, *(folder / file.name for file in pulled.files)] if pulled else []
        files = [path for path in (*listed, *sorted(folder.glob("*.part"))) if path.is_file()]
        if files:
            return folder, files
    entry = find(name)
    place = entry.located() if entry else None
    where = f"{place} was put there by hand" if place else "there is nothing of it here"
    raise ModelError(f"{name} was not pulled; {where}")
