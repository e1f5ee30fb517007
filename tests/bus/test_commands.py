"""Commands over a real session, and every kind of query and reply that is none."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from dataclasses import replace

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.bus import commands
from prism_edge.bus.arriving import arriving
from prism_edge.bus.commands import (
    LARGEST_QUERY,
    LARGEST_REPLY,
    Reply,
    on_or_off,
    pack_reply,
    parse_query,
    parse_reply,
    send,
)
from prism_edge.bus.links import open_session
from prism_edge.bus.session import Bus
from prism_edge.errors import BusError, SourceError
from prism_edge.topics import COMMANDS, Command
from tests.waiting import until

PAUSE, INFO = COMMANDS["pause"], COMMANDS["info"]
NEEDS = Command("keep", "backend", "keeps", "a name")


@pytest.fixture
def served(config):
    """A bus on which a thread serves `pause` and `info`; the words that came."""
    heard = []

    def pause(argument):
        if argument == "raise":
            raise RuntimeError("a defect")
        if argument == "refuse":
            raise SourceError("no camera; plug one in")
        heard.append(argument)
        return Reply(True, f"said {argument}", {"n": str(len(heard))})

    with Bus.open(config, "supervisor", listen=True) as bus:
        desk = bus.commands({"pause": pause, "info": lambda argument: Reply(True, "well")})
        done = threading.Event()

        def serve():
            while not done.wait(0.01):
                desk.serve()

        thread = threading.Thread(target=serve)
        thread.start()
        yield heard
        done.set()
        thread.join()


@pytest.fixture
def session(config, served):
    with open_session(config.bus, listen=False, client=True) as session:
        yield session


def test_the_reply_says_what_came_of_it(session, served):
    assert send(session, "robot", PAUSE, "off", 10) == Reply(True, "said off", {"n": "1"})
    assert send(session, "robot", PAUSE, None, 10) == Reply(True, "said on", {"n": "2"})  # the default
    assert served == ["off", "on"]


def test_an_error_is_one_line_and_the_next_command_is_served(session):
    refused = send(session, "robot", PAUSE, "refuse", 10)
    assert (refused.ok, refused.said) == (False, "no camera; plug one in")
    failed = send(session, "robot", PAUSE, "raise", 10)
    assert not failed.ok
    assert "RuntimeError" in failed.said
    assert send(session, "robot", INFO, None, 10).ok


def test_what_waits_is_done_in_the_order_asked(config):
    """A process that was busy: a map that is loaded and then saved is not saved first."""
    done = []

    def take(name):
        return lambda argument: done.append((name, argument)) or Reply(True, "done")

    with Bus.open(config, "supervisor", listen=True) as bus:
        desk = bus.commands({name: take(name) for name in ("save_map", "load_map", "reset")})
        with open_session(config.bus, listen=False, client=True) as asker:
            asked = [("load_map", "a"), ("save_map", "a"), ("reset", ""), ("load_map", "b")]
            replies = []
            for name, argument in asked:
                payload = json.dumps({"argument": argument}).encode() if argument else b""
                replies.append(asker.get(f"prism/robot/command/{name}", payload=payload, timeout=60))
                until(lambda: len(desk._waiting) == len(replies))
            desk.serve()
            assert [parse_reply(reply.ok.payload.to_bytes()).ok for r in replies for reply in r] == 4 * [True]
    assert done == asked


def test_no_thread_outlasts_the_desk(config, monkeypatch):
    """One that comes back from Zenoh only while Python shuts down aborts the process."""
    over = []

    def slowly(declared):
        yield from arriving(declared)
        time.sleep(0.2)  # a machine that is busy
        over.append(declared)

    monkeypatch.setattr(commands, "arriving", slowly)
    with Bus.open(config, "supervisor", listen=True) as bus:
        bus.commands({name: lambda argument: Reply(True, "done") for name in ("pause", "info")})
    assert len(over) == 2


@pytest.mark.parametrize(
    "asked",
    ["prism/robot/**", "**", "prism/robot/command/*", "prism/*/*/pause", "prism/robot/command/pa$*"],
)
def test_what_reads_by_wildcard_commands_nothing_and_is_not_left_waiting(session, served, asked):
    replies = session.get(asked, timeout=60)
    found, ended = [], threading.Event()

    def collect():
        found.extend(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)
        ended.set()

    threading.Thread(target=collect, daemon=True).start()
    assert ended.wait(30), "it was left to wait until its time was over"
    assert not [key for key in found if "/command/" in key]
    assert send(session, "robot", PAUSE, "off", 10).ok
    assert served == ["off"]


def test_a_command_to_all_robots_is_done_and_answered_by_each(config, session, served):
    done = threading.Event()

    def serve(desk):
        while not done.wait(0.01):
            desk.serve()

    def answers():
        """As most programs ask: Zenoh hands on one reply of those on the same key."""
        return {
            str(reply.ok.key_expr): parse_reply(reply.ok.payload.to_bytes()).said
            for reply in session.get("prism/*/command/pause", timeout=10)
            if reply.ok is not None
        }

    with Bus.open(replace(config, robot="second"), "source") as second:
        desk = second.commands({"pause": lambda argument: Reply(True, "second stands")})
        thread = threading.Thread(target=serve, args=(desk,))
        thread.start()
        try:
            until(lambda: len(answers()) == 2)
            said = {"prism/robot/command/pause": "said on", "prism/second/command/pause": "second stands"}
            assert answers() == said
        finally:
            done.set()
            thread.join()


def test_nobody_who_answers_is_an_error(session):
    with pytest.raises(BusError, match=r"no answer.*'other'"):
        send(session, "other", PAUSE, "on", 0.3)


def test_only_who_waited_says_how_long(config, session):
    def said(robot, timeout_s):
        with (
            open_session(config.bus, listen=False, client=True) as asker,
            pytest.raises(BusError) as caught,
        ):
            send(asker, robot, PAUSE, "on", timeout_s)
        return str(caught.value)

    assert said("other", 60).startswith("pause: no answer; is")
    with session.declare_queryable("prism/mute/command/pause", zenoh.handlers.FifoChannel(1000)):
        until(lambda: said("mute", 0.3).startswith("pause: no answer in 0.3 s; is"))


@pytest.mark.parametrize(
    "payload",
    [
        b"\xff\xfe",
        b"[",
        b"[1]",
        b'{"argument": 5}',
        b'{"other": "x"}',
        b'{"argument": "off", "argument": "on"}',
        b"9" * (LARGEST_QUERY + 1),
    ],
)
def test_what_is_no_query_is_refused_in_words(session, served, payload):
    (reply,) = session.get("prism/robot/command/pause", payload=payload, timeout=10)
    answer = parse_reply(reply.ok.payload.to_bytes())
    assert not answer.ok
    assert "pause" in answer.said
    assert served == []


@given(st.binary(max_size=200) | st.recursive(st.none() | st.integers() | st.text(), st.lists).map(
    lambda value: json.dumps(value).encode()
))
@settings(max_examples=150, deadline=None)
def test_whatever_comes_is_an_argument_or_an_error(data):
    for parse in (lambda: parse_query(PAUSE, data), lambda: parse_reply(data)):
        with contextlib.suppress(BusError):
            parse()


def test_an_argument_that_has_no_default_is_asked_for():
    with pytest.raises(BusError, match="needs its argument as text: a name"):
        parse_query(NEEDS, b"")
    assert parse_query(NEEDS, b'{"argument": "lab"}') == "lab"


@pytest.mark.parametrize("given", [b'{"argument": "x"}', b'{"argument": null}'])
def test_a_command_without_argument_takes_none(given):
    with pytest.raises(BusError, match="takes no argument"):
        parse_query(INFO, given)


@pytest.mark.parametrize("behind", ["argument=off", "off", "_time=[now(-1s)..];off"])
def test_an_argument_behind_the_key_is_refused_and_not_passed_over(session, served, behind):
    """Zenoh's own way to pass one: unread, `pause?off` would pause the robot."""
    (reply,) = session.get(f"prism/robot/command/pause?{behind}", timeout=10)
    answer = parse_reply(reply.ok.payload.to_bytes())
    assert not answer.ok
    assert "goes into the payload" in answer.said
    assert served == []


def test_what_zenoh_itself_puts_behind_a_key_is_no_argument(session, served):
    (reply,) = session.get("prism/robot/command/pause?_anyke", timeout=10)
    assert parse_reply(reply.ok.payload.to_bytes()).ok


def test_switches_know_two_words():
    assert on_or_off("on")
    assert not on_or_off("off")
    for word in ("", "ON", "1", "yes"):
        with pytest.raises(BusError, match="expected on or off"):
            on_or_off(word)


def test_replies_survive_the_way():
    reply = Reply(False, "über", {"a": "b"})
    assert parse_reply(pack_reply(reply)) == reply
    not_text = b'{"ok": true, "said": "", "values": {"a": 1}}'
    not_said = b'{"ok": true, "said": 5, "values": {}}'
    for data in (b"{}", b'{"ok": 1, "said": "", "values": {}}', not_said, not_text):
        with pytest.raises(BusError, match="another version"):
            parse_reply(data)
    with pytest.raises(BusError, match="are allowed"):
        parse_reply(b" " * (LARGEST_REPLY + 1))


def test_the_table_is_sound():
    for name, command in COMMANDS.items():
        assert command.name == name
        assert command.default is None or command.argument
        assert zenoh.KeyExpr(command.key)
