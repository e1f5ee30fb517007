"""Commands: a query asks, one process does, and the reply says in words what happened (docs/OPERATIONS.md).

The query's payload is a JSON object, ``{"argument": "lab"}``, or nothing; the reply's is
``{"ok": true, "said": "...", "values": {"name": "value"}}``. Both are outside input to whoever reads them.
"""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import zenoh

from prism_edge.bus import keys
from prism_edge.bus.arriving import arriving, no_more
from prism_edge.errors import BusError, PrismError
from prism_edge.topics import COMMANDS, Command
from prism_edge.vital import vital

LARGEST_QUERY = 4096  # bytes
LARGEST_REPLY = 256 * 1024
_WAITING = 16  # commands that nobody has looked at yet; of more the oldest get no answer

log = logging.getLogger("prism_edge.bus")


@dataclass(frozen=True)
class Reply:
    """What came of a command."""

    ok: bool
    said: str  # one line
    values: dict[str, str] = field(default_factory=dict)


Handler = Callable[[str], Reply]


class CommandDesk:
    """The commands that one process does, in the order asked, in the thread that calls :meth:`serve`."""

    def __init__(self, session: Any, robot: str, handlers: Mapping[str, Handler]) -> None:
        """``handlers`` maps names of ``topics.COMMANDS`` to what does them; it may raise PrismError."""
        self._handlers = dict(handlers)
        self._keys = {name: keys.key(robot, COMMANDS[name]) for name in handlers}
        self._waiting: deque[tuple[str, Any]] = deque(maxlen=_WAITING)
        self._queryables = [
            session.declare_queryable(key, zenoh.handlers.FifoChannel(_WAITING), complete=True)
            for key in self._keys.values()
        ]
        # A channel of their own each has forgotten which came first.
        self._threads = [
            vital(self._take_in, name, (name, queryable))
            for name, queryable in zip(self._keys, self._queryables, strict=True)
        ]
        for thread in self._threads:
            thread.start()

    def serve(self) -> None:
        """Do what has been asked since the last call; costs next to nothing where that is nothing."""
        while self._waiting:
            name, query = self._waiting.popleft()
            with query:
                if names(str(query.key_expr), COMMANDS[name]):
                    self._serve(COMMANDS[name], query)
            del query  # the asker waits until it is gone

    def close(self) -> None:
        """Answer no more."""
        for queryable, thread in zip(self._queryables, self._threads, strict=True):
            no_more(queryable, thread)
        self._waiting.clear()

    def _take_in(self, name: str, queryable: Any) -> None:
        for query in arriving(queryable):
            self._waiting.append((name, query))
            del query

    def _serve(self, command: Command, query: Any) -> None:
        try:
            data = query.payload.to_bytes() if query.payload is not None else b""
            argument = parse_query(command, data, str(query.parameters))
            reply = self._handlers[command.name](argument)
        except PrismError as error:
            reply = Reply(False, str(error))
        except Exception as error:  # a command must not end the process that does it
            log.exception("command %s failed", command.name)
            reply = Reply(False, f"failed: {type(error).__name__}; the log says more")
        level = logging.INFO if command.changes else logging.DEBUG
        log.log(level, "command %s: %s%s", command.name, "" if reply.ok else "refused: ", reply.said)
        try:
            # On our own key: of replies on one key, such as `prism/*/command/info`, Zenoh hands on only one.
            key, json_text = self._keys[command.name], zenoh.Encoding.APPLICATION_JSON
            query.reply(key, pack_reply(reply), encoding=json_text)
        except zenoh.ZError as error:
            log.warning("command %s: the asker has gone: %s", command.name, error)


def names(asked: str, command: Command) -> bool:
    """Whether who asks for this key expression means the command; one that reads ``prism/**`` does not.

    The robot may be a wildcard: ``prism/*/command/pause`` is meant for every robot.
    """
    return asked.endswith(f"/{command.key}")


def send(session: Any, robot: str, command: Command, argument: str | None, timeout_s: float) -> Reply:
    """Ask for a command and wait for the reply.

    Raises BusError where nobody answers in time: the process is down, or may not be asked from here.
    """
    payload = b"" if argument is None else json.dumps({"argument": argument}).encode()
    until_s = time.monotonic() + timeout_s
    try:
        replies = session.get(
            keys.key(robot, command),
            payload=payload,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            if reply.ok is not None:
                return parse_reply(reply.ok.payload.to_bytes())
    except zenoh.ZError as error:
        raise BusError(f"{command.name}: {error}") from None
    # Where nobody is to ask, that shows at once.
    waited = f" in {timeout_s:g} s" if time.monotonic() >= until_s else ""
    raise BusError(
        f"{command.name}: no answer{waited}; is the daemon of {robot!r} running there, "
        "and may you command it?"
    )


def parse_query(command: Command, data: bytes, parameters: str = "") -> str:
    """The argument in a query's payload. Raises BusError for anything that is no query for ``command``.

    So for ``parameters`` behind its key, but those that are Zenoh's own: `pause?off`, left unread, would do
    the opposite.
    """
    own = [word for word in parameters.split(";") if word and not word.startswith("_")]
    if own:
        raise BusError(f"{command.name}: its argument goes into the payload, not behind the key")
    if len(data) > LARGEST_QUERY:
        raise BusError(f"{command.name}: a payload of {len(data)} bytes; {LARGEST_QUERY} are allowed")
    given = _json_object(data, command.name) if data else {}
    argument = given.pop("argument", command.default if command.argument else "")
    if given:
        unknown = sorted(given)[0]
        raise BusError(f"{command.name}: unknown key {unknown!r:.40}; the one it takes is 'argument'")
    if not isinstance(argument, str):
        words = f"needs its argument as text: {command.argument}" if command.argument else "takes no argument"
        raise BusError(f"{command.name}: {words}")
    if argument and not command.argument:
        raise BusError(f"{command.name}: takes no argument, got {argument!r:.40}")
    return argument


def on_or_off(argument: str) -> bool:
    """The argument of a command that switches something. Raises BusError for any other word."""
    if argument not in ("on", "off"):
        raise BusError(f"expected on or off, got {argument!r:.40}")
    return argument == "on"


def pack_reply(reply: Reply) -> bytes:
    """The reply as JSON."""
    values = {str(k): str(v) for k, v in reply.values.items()}
    return json.dumps({"ok": reply.ok, "said": reply.said, "values": values}).encode()


def parse_reply(data: bytes) -> Reply:
    """A reply from JSON. Raises BusError for anything else."""
    if len(data) > LARGEST_REPLY:
        raise BusError(f"a reply of {len(data)} bytes; {LARGEST_REPLY} are allowed")
    given = _json_object(data, "the reply")
    ok, said, values = given.get("ok"), given.get("said"), given.get("values")
    fits = isinstance(values, dict) and all(isinstance(v, str) for v in values.values())
    if not (isinstance(ok, bool) and isinstance(said, str) and fits and isinstance(values, dict)):
        raise BusError("a reply that is none of this version's; is the daemon another version?")
    return Reply(ok, said, values)


def _json_object(data: bytes, what: str) -> dict[str, Any]:
    try:
        given = json.loads(data, object_pairs_hook=_without_repeats)
    except (ValueError, RecursionError):
        raise BusError(f"{what}: the payload is no JSON") from None
    if not isinstance(given, dict):
        raise BusError(f"{what}: the payload is no JSON object, or says a key twice")
    return given


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any] | None:
    """What these make; None where a key comes twice, of which nobody knows which is meant."""
    made = dict(pairs)
    return made if len(made) == len(pairs) else None
