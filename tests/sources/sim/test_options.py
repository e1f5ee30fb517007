"""Addresses of the simulator: what they mean, and what is refused in one line."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.errors import SourceError
from prism_edge.sources.sim.options import KINDS, Options, is_simulated, parse

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "SIMULATOR.md"


def test_every_option_is_taken() -> None:
    uri = (
        "sim:room?seed=3&frames=900&path=wheeled&rate=15&width=320&height=240&focal=250.5&speed=0.4"
        "&actors=2&noise=0.5&blur=0&exposure=2"
    )
    assert parse(uri) == Options("room", 3, 900, "wheeled", 15.0, 320, 240, 250.5, 0.4, 2, 0.5, 0.0, 2.0)


def test_defaults_need_no_query() -> None:
    assert parse("sim:loop") == Options(kind="loop")
    assert parse("sim:loop?") == Options(kind="loop")
    assert parse("sim:static").path == "still"
    assert parse("sim:street").path == "drive"
    assert parse("sim:town").path == "drive"


def test_what_repeats_says_how_much_alike_it_is() -> None:
    assert parse("sim:stairs").unlike == 0.3
    assert parse("sim:corridor?unlike=0&path=handheld").unlike == 0.0


def test_a_car_may_be_faster_than_a_robot_indoors() -> None:
    assert parse("sim:street?speed=20").speed == 20.0
    assert parse("sim:town?speed=20").speed == 20.0
    assert parse("sim:loop?speed=5").speed == 5.0


def test_focal_length_follows_the_width() -> None:
    assert parse("sim:room").focal_length == 525.0
    assert parse("sim:room?width=320&height=240").focal_length == 262.5
    assert parse("sim:room?width=320&height=240&focal=400").focal_length == 400.0


@pytest.mark.parametrize(
    ("uri", "names"),
    [
        ("sim:", "''"),
        ("sim:castle", "castle"),
        ("sim:room?sed=3", "seed"),
        ("sim:room?colour=red", "colour"),
        ("sim:room?kind=loop", "kind"),
        ("sim:room?seed", "seed"),
        ("sim:room?seed=", "seed"),
        ("sim:room?seed=1&seed=2", "twice"),
        ("sim:room?seed=-1", "seed"),
        ("sim:room?seed=1.5", "whole number"),
        ("sim:room?rate=fast", "rate"),
        ("sim:room?rate=0", "rate"),
        ("sim:room?rate=nan", "rate"),
        ("sim:room?noise=inf", "noise"),
        ("sim:room?noise=-1", "noise"),
        ("sim:room?actors=4", "actors"),
        ("sim:room?path=flying", "handheld"),
        ("sim:room?width=161", "even"),
        ("sim:room?width=100000", "width"),
        ("sim:static?path=wheeled", "static"),
        ("sim:room?path=turn&speed=1", "speed"),
        ("sim:loop?path=stops", "one room"),
        ("sim:street?path=wheeled", "car"),
        ("sim:street?path=still", "car"),
        ("sim:room?path=drive", "street"),
        ("sim:street?actors=1", "actors"),
        ("sim:town?path=wheeled", "car"),
        ("sim:town?actors=1", "actors"),
        ("sim:corridor?path=wheeled", "carries"),
        ("sim:stairs?path=still", "carries"),
        ("sim:stairs?actors=1", "actors"),
        ("sim:corridor?unlike=1.1", "unlike"),
        ("sim:room?unlike=0.5", "use corridor or stairs"),
        ("sim:street?speed=20.5", "speed"),
        ("sim:loop?speed=5.1", "speed"),
        ("sim:room?seed=1?frames=3", "seed"),
        ("sim:loop?follow=way.tum", "use room"),
        ("sim:street?follow=way.tum", "use room"),
        ("sim:room?follow=way.tum&path=handheld", "leave out path"),
        ("sim:room?follow=way.tum&actors=1", "leave out path and actors"),
        ("sim:room?follow=", "no value"),
        ("sim:room?&", "''"),
    ],
)
def test_refused_in_one_line(uri: str, names: str) -> None:
    with pytest.raises(SourceError) as caught:
        parse(uri)
    assert names in str(caught.value)
    assert uri in str(caught.value)
    assert "\n" not in str(caught.value)


@settings(max_examples=100)
@given(st.text(alphabet="abefimnorst=&?0123456789.-", max_size=30))
def test_any_text_is_an_address_or_refused(text: str) -> None:
    try:
        kind = parse("sim:room?" + text).kind
    except SourceError as error:
        kind = str(error)
    assert kind == "room" or kind.startswith("sim:room?" + text)


def test_ours_by_the_scheme() -> None:
    assert is_simulated("sim:room")
    assert not is_simulated("/data/sim:room")
    assert not is_simulated("simulated")


def test_the_document_names_every_option_kind_and_path() -> None:
    text = DOCUMENT.read_text()
    for field in fields(Options):
        if field.name != "kind":
            assert f"| `{field.name}` |" in text
    for word in (*KINDS, "handheld", "wheeled", "stops", "turn", "still", "drive"):
        assert f"`{word}`" in text
