"""Everything that is said: one table of topics, one of commands."""

from __future__ import annotations

from dataclasses import dataclass

from prism_edge import messages as m


@dataclass(frozen=True)
class Topic:
    """One key on the bus. ``type`` is a dataclass of messages.py, or the name of a ROS 2 type (CDR)."""

    key: str  # below prism/<robot>/
    type: type | str
    rate_hz: float  # nominal; 0: on events
    producer: str
    consumers: tuple[str, ...] = ()
    reliable: bool = True  # False: best effort, the newest wins (congestion control: bus/links.py)
    priority: str = "data"  # zenoh priority, lower case
    latched: bool = False  # the last value answers a get() on the same key

    @property
    def internal(self) -> bool:
        """Whether it stays between our own processes."""
        return self.key.startswith("internal/")

    @property
    def of_all(self) -> bool:
        """Whether every process says it, each below the key under its own name (``process`` of the type)."""
        return self.producer == "all"


TOPICS = {
    topic.key.removeprefix("internal/"): topic
    for topic in (
        # public: what robots subscribe to
        Topic("odom", "nav_msgs/msg/Odometry", 30, "tracker", priority="real_time"),
        Topic("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", 30, "tracker", priority="real_time"),
        Topic("tf", "tf2_msgs/msg/TFMessage", 30, "tracker", priority="interactive_high", latched=True),
        Topic("scale", "prism_edge_msgs/msg/Scale", 2, "scale", latched=True),
        Topic("status", "diagnostic_msgs/msg/DiagnosticArray", 2, "tracker", latched=True),
        Topic(
            "health",
            "diagnostic_msgs/msg/DiagnosticArray",
            1,
            "supervisor",
            priority="data_low",
            latched=True,
        ),
        # for scorers alone: the exact camera pose of each frame, from sources that make their own images
        Topic("truth", "geometry_msgs/msg/PoseStamped", 30, "source"),
        # for a look at the gate: u and w of each keyframe, only where gate.images is set
        Topic("uncertainty", "sensor_msgs/msg/Image", 3, "scale", reliable=False, priority="data_low"),
        Topic("weight", "sensor_msgs/msg/Image", 3, "scale", reliable=False, priority="data_low"),
        # internal: what the five tell each other
        Topic("internal/frame", m.Frame, 30, "source", ("tracker",), reliable=False),
        Topic(
            "internal/end", m.EndOfStream, 0, "source", ("tracker", "depth", "scale", "backend"), latched=True
        ),
        Topic(
            "internal/tracked",
            m.Tracked,
            30,
            "tracker",
            ("source", "depth", "scale", "backend"),
            latched=True,
        ),
        Topic("internal/keyframe", m.Keyframe, 3, "tracker", ("scale", "backend")),
        Topic("internal/keyframe_image", m.KeyframeImage, 3, "tracker", ("depth",), reliable=False),
        Topic("internal/depth", m.Depth, 3, "depth", ("tracker", "scale", "backend")),
        Topic("internal/gate", m.Gate, 3, "scale", ("backend",)),
        Topic("internal/log_scale", m.Scale, 3, "scale", ("tracker", "backend")),
        Topic("internal/map_update", m.MapUpdate, 3, "backend", ("tracker",)),
        # for reports: what adjusting costs, and when
        Topic("internal/solved", m.Solved, 3, "backend", priority="data_low"),
        # asked for by whoever wants the whole map: the evaluation
        Topic("internal/map_snapshot", m.MapSnapshot, 0, "backend", latched=True),
        # asked for by a tracker that was started again, or that hears of a loaded map
        Topic("internal/whole_map", m.WholeMap, 0, "backend", ("tracker",), latched=True),
        # asked for by a scale that was started again
        Topic("internal/map_loaded", m.MapLoaded, 0, "backend", ("tracker", "scale"), latched=True),
        # asked for by a backend that is to load a map
        Topic("internal/epoch", m.Epoch, 0, "tracker", ("backend",), latched=True),
        # told where a map was given up on command, which may be long before the next keyframe
        Topic("internal/new_map", m.Epoch, 0, "tracker", ("scale", "backend")),
        Topic("internal/acknowledged", m.Acknowledged, 30, "all", ("source",)),
        Topic("internal/heartbeat", m.Heartbeat, 2, "all", ("supervisor",), priority="data_low"),
    )
}


@dataclass(frozen=True)
class Command:
    """Something that the daemon is told to do: a get() on prism/<robot>/command/<name> (bus/commands.py)."""

    name: str
    process: str  # who does it
    does: str
    argument: str = ""  # what its one word means; empty: it takes none
    default: str | None = None  # where the word may be left out
    changes: bool = True  # something, which the log then says

    @property
    def key(self) -> str:
        """The key below prism/<robot>/."""
        return f"command/{self.name}"


COMMANDS = {
    command.name: command
    for command in (
        Command("info", "supervisor", "say what runs and how it is", changes=False),
        Command("pause", "source", "hold the images back, or let them go on", "on or off", "on"),
        Command("reset", "tracker", "begin a new map; odom goes on"),
        Command("save_map", "backend", "save the map in the state directory", "a name"),
        Command("load_map", "backend", "take up a saved map, and find the camera in it", "a name"),
        Command("localise_only", "tracker", "leave the map as it is, or build it again", "on or off", "on"),
    )
}
