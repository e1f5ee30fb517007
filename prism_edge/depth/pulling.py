"""All files of a network from the web into a folder of its own: either the whole network, or none of it."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote, unquote, urljoin, urlsplit

from prism_edge.depth import contract, download
from prism_edge.depth.contract import card_from_metadata
from prism_edge.depth.download import Patience, Progress, Wanted
from prism_edge.depth.onnx_file import Outline
from prism_edge.depth.pulled import MANIFEST, NAME, Pulled, manifest_of, write_manifest
from prism_edge.depth.registry import Entry, File, find, find_digest, read_file_item, sha256_of
from prism_edge.depth.vetting import LARGEST_DATA, LARGEST_FILE, check_location, inspect
from prism_edge.depth.web import check_url
from prism_edge.errors import ModelError

Approve = Callable[[str], None]  # is given the licence ("": none is stated), raises ModelError to refuse
ProgressOf = Callable[[str], Progress]
_REMOVE = "`prism-edge models remove {}` first"


def from_entry(entry: Entry, into: Path) -> Pulled:
    """What pulling a registered network gives. Raises ModelError where it is not known where it is."""
    if not entry.can_be_pulled:
        file = entry.files[0] if entry.files else None
        by_hand = f"; put {file.name} (SHA-256 {file.sha256}) into {into}" if file else ""
        raise ModelError(f"{entry.name}: no place to pull it from is known ({entry.obtain}){by_hand}")
    return Pulled(entry.name, entry.licence, entry.card is not None, entry.files, into / entry.name)


def from_url(url: str, into: Path, sha256: str = "", name: str = "") -> Pulled:
    """What pulling an ONNX file from anywhere gives. Raises ModelError for a URL or a name that won't do."""
    check_url(url)
    file = unquote(urlsplit(url).path).rpartition("/")[2]
    if not file.endswith(".onnx"):
        raise ModelError(f"{url}: an ONNX file is needed, whose name ends in .onnx")
    name = name or file.removesuffix(".onnx")
    if not NAME.fullmatch(name):
        raise ModelError(f"{name!r} is no name (letters, digits, dot, dash, underscore); give --name")
    if find(name):
        raise ModelError(f"{name} is the name of a registered network; give another with --name")
    try:
        digest = contract.sha256_text(sha256)
    except ValueError as error:
        raise ModelError(f"--sha256: {error}") from None
    return Pulled(name, "", True, (File(f"{name}.onnx", digest, 0, url),), into / name)


def pull(
    plan: Pulled,
    approve: Approve,
    progress: ProgressOf,
    unverified: bool = False,
    patience: Patience = Patience(),
) -> Pulled:
    """Fetches what is missing, checks it, and puts it in place; the network's own file comes last.

    A file without a digest is fetched only if ``unverified``, or where it has come before: it must be the
    same then. ``approve`` is asked before anything comes, or, where the licence is known only from the file
    itself, before that is put in place. Raises ModelError in one line; then nothing but parts has been added.
    """
    _check_pinned(plan, unverified, _remembered(plan))
    if plan.licence:
        approve(plan.licence)
    with _locked(plan.folder):
        done = manifest_of(plan.folder)
        if done and all((plan.folder / file.name).is_file() for file in done.files):
            _check_same(plan, done)
            return _given_since(plan, done)
        before = _remembered(plan)
        parts = {file: _fetch(plan, file, before, progress, patience) for file in plan.files}
        if plan.runnable:
            network = plan.files[0]
            if not plan.licence:
                extra, licence = _described(plan, parts[network])
                plan = replace(plan, licence=licence, files=(network, *extra))
                _check_pinned(plan, unverified, before)
                approve(licence)
                parts |= {file: _fetch(plan, file, before, progress, patience) for file in extra}
            else:
                _check_licence(plan, parts[network])
        plan = replace(plan, given=all(file.sha256 for file in plan.files))
        plan = replace(plan, files=tuple(_measured(file, parts[file]) for file in plan.files))
        for file, part in reversed(list(zip(plan.files, parts.values(), strict=True))):
            if file is plan.files[0]:
                write_manifest(plan)
            target = plan.folder / file.name
            if part != target:
                download.settle(part, target)
    return plan


def _given_since(plan: Pulled, done: Pulled) -> Pulled:
    """What is there already, whose digests are all given now if they were not when it came."""
    given = {file.name for file in plan.files if file.sha256}
    if done.given or not given >= {file.name for file in done.files}:
        return done
    confirmed = replace(done, given=True)
    write_manifest(confirmed)
    return confirmed


def _remembered(plan: Pulled) -> Mapping[str, str]:
    """The digests of what came before. Raises ModelError where that was from elsewhere."""
    done = manifest_of(plan.folder)
    if done and done.files[0].url != plan.files[0].url:
        raise ModelError(f"{plan.name}: was pulled from {done.files[0].url}; {_REMOVE.format(plan.name)}")
    return {file.name: file.sha256 for file in done.files} if done else {}


def _check_pinned(plan: Pulled, unverified: bool, remembered: Mapping[str, str]) -> None:
    open_ones = [file.name for file in plan.files if not file.sha256 and file.name not in remembered]
    if open_ones and not unverified:
        raise ModelError(
            f"{plan.name}: no SHA-256 of {' and '.join(open_ones)} is known, so nothing tells that what "
            "comes is the real one; --unverified takes what comes and remembers its SHA-256"
        )


def _fetch(
    plan: Pulled, file: File, remembered: Mapping[str, str], progress: ProgressOf, patience: Patience
) -> Path:
    sha256 = file.sha256 or remembered.get(file.name, "")
    largest = LARGEST_FILE if plan.runnable and file is plan.files[0] else LARGEST_DATA
    target = plan.folder / file.name
    if sha256 and target.is_file() and sha256_of(target) == sha256:
        return target  # of an earlier pull that was cut short when all had come
    wanted = Wanted(file.url, target, sha256, file.size, largest)
    return download.fetch(wanted, patience, progress(file.name))


def _described(plan: Pulled, part: Path) -> tuple[list[File], str]:
    """Files of external data that an unregistered network needs, and the licence that it states."""
    digest, outline = _inspected(part)
    registered = find_digest(digest)
    card = card_from_metadata(outline.metadata, plan.files[0].name) if registered is None else registered.card
    extra = []
    for location in sorted({item.location for item in outline.external}):
        check_location(part, location)
        if "/" in location:
            what = f"external data {location[:80]!r} in a folder of their own"
            raise ModelError(f"{plan.name}: names {what}, which is not fetched")
        if location in (plan.files[0].name, MANIFEST) or location.endswith(".part"):
            raise ModelError(f"{plan.name}: names external data {location[:80]!r}, which is not fetched")
        url = urljoin(plan.files[0].url, quote(location))
        extra.append(read_file_item({"file": location, "url": url}, plan.name))
    return extra, card.licence if card else ""


def _inspected(part: Path) -> tuple[str, Outline]:
    """As vetting.inspect; a part that is refused is removed, or the next pull would take it for complete."""
    try:
        return inspect(part)
    except ModelError:
        if part.suffix == ".part":
            part.unlink(missing_ok=True)
        raise


def _check_licence(plan: Pulled, part: Path) -> None:
    """Raises ModelError where a registered file states another licence, or needs files not registered."""
    _, outline = _inspected(part)
    card = card_from_metadata(outline.metadata, plan.files[0].name)
    if card and card.licence != plan.licence:
        raise ModelError(
            f"{plan.name}: the file says licence {card.licence}, but it is registered under {plan.licence}"
        )
    missing = {item.location for item in outline.external} - {file.name for file in plan.files[1:]}
    if missing:
        raise ModelError(f"{plan.name}: needs {sorted(missing)[0][:80]!r}, which is not registered with it")


def _check_same(plan: Pulled, done: Pulled) -> None:
    known = {file.name: file.sha256 for file in plan.files if file.sha256}
    for file in done.files:
        digest = sha256_of(plan.folder / file.name)
        if digest != file.sha256 or known.get(file.name, digest) != digest:
            advice = _REMOVE.format(plan.name)
            raise ModelError(f"{plan.folder / file.name}: is not the file it should be; {advice}")


def _measured(file: File, part: Path) -> File:
    return replace(file, sha256=file.sha256 or sha256_of(part), size=part.stat().st_size)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keeps a second pull into the same folder out. Raises ModelError where one is at work."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise ModelError(f"{folder}: can't be made ({error.strerror})") from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise ModelError(f"{folder}: another pull is at work there") from None
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # it is kept where there is anything in it
            folder.rmdir()
        os.close(handle)
