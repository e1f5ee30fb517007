"""What is set on a Linux camera, and when."""

from __future__ import annotations

import pytest
from sources.live.fake_v4l2 import FakeCamera

from prism_edge.errors import SourceError
from prism_edge.sources.live import v4l2_abi as abi
from prism_edge.sources.live.driver import CameraLostError
from prism_edge.sources.live.v4l2 import V4l2Connection, V4l2Driver


def connect(fake: FakeCamera, query: str = "") -> V4l2Connection:
    address = f"v4l2:{fake.path}?width=64&height=48&{query}"
    return V4l2Driver(address.rstrip("&"), None, fake).connect()  # type: ignore[arg-type]


def test_a_camera_that_another_program_has_keeps_its_settings() -> None:
    fake = FakeCamera(busy=True)
    fake.controls[abi.CID_EXPOSURE_AUTO][2] = abi.EXPOSURE_MANUAL
    before = {control: list(values) for control, values in fake.controls.items()}
    with pytest.raises(CameraLostError, match="in use by another program"):
        connect(fake, "exposure_ms=8&gain=7")
    assert fake.controls == before


def test_a_rate_that_a_control_held_down_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of drivers whose automatic exposure may lower the rate until it is told not to."""
    fake = FakeCamera()
    ask = fake._s_parm

    def slow_in_the_dark(asked: abi.StreamParm) -> None:
        ask(asked)
        if fake.controls[abi.CID_EXPOSURE_AUTO_PRIORITY][2]:
            fake._rate = 7.5

    monkeypatch.setattr(fake, "_s_parm", slow_in_the_dark)
    connect(fake, "rate=30&format=YUYV")
    assert fake._rate == 30.0


def test_controls_that_the_firmware_does_not_tell_of_are_as_good_as_absent() -> None:
    connect(FakeCamera(stalling={abi.CID_EXPOSURE_AUTO_PRIORITY}))
    with pytest.raises(SourceError, match="no setting for gain"):
        connect(FakeCamera(stalling={abi.CID_GAIN}), "gain=7")


@pytest.mark.parametrize(
    ("pixels", "size"), [("YUYV", (65, 48)), ("UYVY", (65, 48)), ("NV12", (64, 47)), ("YU12", (65, 48))]
)
def test_odd_sizes_of_formats_that_share_colours_are_refused(pixels: str, size: tuple[int, int]) -> None:
    fake = FakeCamera(modes={pixels: {size: 30.0}})
    address = f"v4l2:{fake.path}?width={size[0]}&height={size[1]}"
    with pytest.raises(SourceError, match=f"{size[0]}x{size[1]} as {pixels} only, which needs an even size"):
        V4l2Driver(address, None, fake).connect()  # type: ignore[arg-type]
    fake.modes["GREY"] = {size: 30.0}  # one that can
    driver = V4l2Driver(address, None, fake)  # type: ignore[arg-type]
    driver.connect()
    assert "GREY" in driver.name
