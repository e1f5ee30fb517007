"""What a server's words mean; requests themselves are test_download.py's."""

from __future__ import annotations

from email.message import Message

import pytest

from prism_edge.depth.web import StaleError, _words, content_range


def headers(said: str) -> Message:
    message = Message()
    message["Content-Range"] = said
    return message


@pytest.mark.parametrize(
    ("said", "first_and_length"),
    [
        ("bytes 5-9/10", (5, 10)),
        ("bytes 0-9/10", (0, 10)),
        ("bytes 9-9/10", (9, 10)),
        ("bytes 5-9/*", (5, 10)),
    ],
)
def test_a_range_says_where_it_begins_and_how_long_all_is(said: str, first_and_length: tuple) -> None:
    assert content_range(headers(said)) == first_and_length


@pytest.mark.parametrize(
    "said",
    [
        *("", "bytes", "bytes 9-5/10", "bytes 5-8/10", "bytes 5-10/10", "bytes -1-9/10"),
        *("lines 5-9/10", "bytes */10"),
    ],
)
def test_a_range_that_does_not_reach_the_end_or_is_none_is_not_gone_on_with(said: str) -> None:
    with pytest.raises(StaleError):
        content_range(headers(said))


def test_an_error_is_told_in_its_words_or_else_by_its_kind() -> None:
    assert _words(OSError("no route\n  to host")) == "no route to host"
    assert _words(TimeoutError()) == "TimeoutError"
    assert len(_words("x" * 500)) == 120
