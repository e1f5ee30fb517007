"""From addresses to live cameras."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError, PrismError, SourceError
from prism_edge.sources import open_source
from prism_edge.sources.live.camera import LiveCamera
from prism_edge.sources.live.open import is_live, open_live


@pytest.mark.parametrize(
    "uri", ["v4l2:/dev/video0", "rtsp://camera/x", "HTTP://camera/x", "https://c/", "oak:", "oak:10.0.0.7"]
)
def test_cameras_are_known_by_their_address(uri: str) -> None:
    assert is_live(uri)
    source = open_source(SourceConfig(uri=uri), calibrated=False)
    assert isinstance(source, LiveCamera)
    assert source.live
    assert source.peek() is None


@pytest.mark.parametrize("uri", ["/dev/video0", "recording", "sim:room", "v4l2", "rtsp:", "ftp://camera/x"])
def test_other_addresses_are_not(uri: str) -> None:
    assert not is_live(uri)


def test_a_missing_camera_file_is_named(tmp_path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match="no-such-file"):
        open_source(SourceConfig(uri="rtsp://camera/x", camera=str(tmp_path / "no-such-file.yaml")))
    with pytest.raises(ConfigError, match="prism-edge calibrate"):
        open_source(SourceConfig(uri="v4l2:/dev/video0"))


@settings(max_examples=300, deadline=None)
@given(
    scheme=st.sampled_from(["v4l2:", "v4l2:/dev/video0?", "oak:", "oak:?", "rtsp://", "rtsp://c/#", "http://"]),
    rest=st.text(max_size=40) | st.text(alphabet="widthrate=&?#0123456789.-:@/[]", max_size=40),
)
def test_any_address_is_a_camera_or_one_line(scheme: str, rest: str) -> None:
    with contextlib.suppress(SourceError, ConfigError):
        open_live(SourceConfig(uri=scheme + rest), calibrated=False)


@settings(max_examples=200, deadline=None)
@given(
    before=st.text(alphabet="ab:@#?/[%", max_size=6),
    after=st.text(max_size=10) | st.text(alphabet="=&#?@:/a", max_size=10),
)
def test_passwords_stay_out_of_names_and_errors(before: str, after: str) -> None:
    uri = f"rtsp://me:{before}hunter2@camera/{after}?p=hunter2"
    try:
        told = open_live(SourceConfig(uri=uri), calibrated=False).name
    except PrismError as error:
        told = str(error)
    assert "hunter2" not in told
