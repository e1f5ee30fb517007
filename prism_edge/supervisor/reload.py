"""What a configuration that is read again changes in a running daemon; the supervisor does it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

from prism_edge.config import Config
from prism_edge.config_file import leaves
from prism_edge.processes import processes_for


@dataclass(frozen=True)
class Change:
    """The configuration that results, who starts anew with it, and what had to be left as it was."""

    config: Config
    applied: tuple[str, ...]  # keys
    refused: tuple[str, ...]  # keys that need a restart of the daemon
    restart: frozenset[str]  # processes
    elsewhere: tuple[str, ...] = ()  # keys refused as well: all that would take them up is on other hosts
    behind: frozenset[str] = frozenset()  # processes on other hosts that applied keys concern too


def difference(running: Config, wanted: Config) -> Change:
    """Which of the keys that differ can change while poses flow.

    config.py declares it (``reload``): a key that no process can take up without losing the map or the
    subscribers is refused. So is a depth network that comes or goes, as processes would with it, and what
    only processes on other hosts would take up: their configuration is there.
    """
    config, applied, refused, elsewhere = running, [], [], []
    restart: set[str] = set()
    processes = processes_for(running)
    for leaf in leaves():
        value = attrgetter(leaf.key)(wanted)
        if value == attrgetter(leaf.key)(running):
            continue
        changed = put(config, leaf.key, value)
        if not leaf.reload or processes_for(changed) != processes:
            refused.append(leaf.key)
            continue
        if set(leaf.reload) <= set(running.network.remote):
            elsewhere.append(leaf.key)
            continue
        config = changed
        applied.append(leaf.key)
        restart |= set(leaf.reload)
    remote = restart & set(running.network.remote)
    here = restart & {process.name for process in processes} - remote
    return Change(
        config, tuple(applied), tuple(refused), frozenset(here), tuple(elsewhere), frozenset(remote)
    )


def put(tree: Any, key: str, value: Any) -> Any:
    """A copy of the tree with another value at a dotted key."""
    name, _, rest = key.partition(".")
    return replace(tree, **{name: put(getattr(tree, name), rest, value) if rest else value})
