"""What the depth network is shown: keyframes, and now and then what a lost camera sees."""

from __future__ import annotations

from prism_edge.bus.session import Bus
from prism_edge.geometry.mount import quarter_turns
from prism_edge.geometry.poses import Array
from prism_edge.messages import Frame, KeyframeImage, probe_of
from prism_edge.tracking.announcement import picture_message
from prism_edge.tracking.depth_watch import SILENT_NS, DepthWatch

PROBE_NS = 300_000_000  # between two looks of the network at what a lost camera sees


class Pictures:
    """Sends them to the depth worker; ``answered``: whether there is one that answers.

    ``mount`` is the camera's on the robot, base_from_camera (4, 4): a network is to see them upright.
    """

    def __init__(self, bus: Bus, answered: bool, mount: Array) -> None:
        self._bus, self._answered, self._turns = bus, answered, quarter_turns(mount)
        self._newest: KeyframeImage | None = None  # of a keyframe,
        self._shown_ns = 0  # ... and when it was shown last
        self._probed_ns = -PROBE_NS

    def keyframe(self, frame: Frame, number: int, epoch: int, watch: DepthWatch) -> None:
        """Show a keyframe, whose depth is waited for from now on."""
        self._newest, self._shown_ns = picture_message(frame, number, epoch, self._turns), frame.stamp_ns
        self._bus.publish("keyframe_image", self._newest)
        if self._answered:
            watch.keyframe(number, frame.stamp_ns)

    def once_more(self, now_ns: int, watch: DepthWatch) -> None:
        """Show the newest keyframe again, now and then, while no answer to it comes.

        A camera that stands makes no other: where the network died over that picture, or it was lost on its
        way, the map would have no depth there, and say so, until the camera moves.
        """
        picture = self._newest
        if picture is None or now_ns - self._shown_ns <= SILENT_NS or not watch.is_waiting(picture.keyframe):
            return
        self._shown_ns = now_ns
        self._bus.publish("keyframe_image", picture)

    def probe(self, frame: Frame, epoch: int) -> KeyframeImage | None:
        """Show what a lost camera sees, now and then; what was shown, if it was."""
        if not self._answered or frame.stamp_ns - self._probed_ns < PROBE_NS:
            return None
        self._probed_ns = frame.stamp_ns
        picture = picture_message(frame, probe_of(frame.index), epoch, self._turns)
        self._bus.publish("keyframe_image", picture)
        return picture
