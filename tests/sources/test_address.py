"""Addresses as they may be shown: nothing secret in them, whatever was mistyped."""

from __future__ import annotations

import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.sources import open_source
from prism_edge.sources.address import shown_address


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("rtsp://me:secret@camera:554/live?token=secret#timeout=3", "rtsp://camera:554/live?..."),
        ("HTTP://me:sec@secret@camera/live", "http://camera/live"),
        ("rtsp://camera/live", "rtsp://camera/live"),
        ("rtsp://camera:554/live", "rtsp://camera:554/live"),
        ("rtsp://me:12/secret@camera/live", "rtsp://..."),
        ("rtsp://me:12?secret@camera/live", "rtsp://..."),
        ("rtsp://me:12#secret@camera/live", "rtsp://..."),
        ("rtsp://me:secret@[camera/live", "rtsp://..."),
        ("rstp://me:secret@camera/live", "rstp://camera/live"),
        ("rtsp:/me:secret@camera/live", "rtsp://camera/live"),
        ("me:secret@camera/live?token=secret", "...@camera/live"),
        ("v4l2:/dev/v4l/by-id/usb-A@1?rate=30", "v4l2:/dev/v4l/by-id/usb-A@1?rate=30"),
        ("oak:?width=640", "oak:?width=640"),
        ("sim:room?seed=3&frames=9", "sim:room?seed=3&frames=9"),
        ("/data/12:30@lab/video.mp4", "/data/12:30@lab/video.mp4"),
        ("walk@lab.mp4", "walk@lab.mp4"),
        ("", ""),
    ],
)
def test_an_address_is_shown_without_what_is_secret(uri: str, expected: str) -> None:
    assert shown_address(uri) == expected


@pytest.mark.parametrize("name", ["x" * 300, f"{'x' * 300}/seq-01"])
def test_what_can_not_be_looked_for_is_refused_in_one_line(name: str) -> None:
    """As what lies in a folder that is closed to us."""
    with pytest.raises(SourceError, match=r"can't be read \(File name too long\)$"):
        open_source(SourceConfig(uri=name))


@pytest.mark.parametrize("scheme", ["rstp://", "rtsp:/", ""])
def test_a_misspelt_address_is_refused_without_its_password(scheme: str) -> None:
    with pytest.raises(SourceError, match="does not exist") as error:
        open_source(SourceConfig(uri=f"{scheme}me:secret@camera/s"))
    assert "secret" not in str(error.value)
    assert "camera/s" in str(error.value)
