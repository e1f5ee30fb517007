"""What `health` says: one row for the run as a whole and one for each process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from prism_edge.bus import ros
from prism_edge.config import WITHOUT_NETWORK

OK, WARN, ERROR, STALE = ros.LEVEL_OK, ros.LEVEL_WARN, ros.LEVEL_ERROR, ros.LEVEL_STALE


@dataclass(frozen=True)
class Row:
    """One diagnostic_msgs/DiagnosticStatus."""

    name: str
    level: int
    message: str
    values: dict[str, str]

    @property
    def essence(self) -> tuple[str, int, str, str]:
        """What makes a row worth publishing before its time; counters and activities don't."""
        return self.name, self.level, self.values.get("pid", ""), self.values.get("restarts", "")


def no_network(has_map: bool = False) -> Row:
    """The row of `depth` in a run without a network, whose depth would begin a map."""
    if has_map:
        return Row("depth", OK, "no network: the map was loaded", {"state": "none"})
    return Row("depth", WARN, WITHOUT_NETWORK, {"state": "none"})


def summary(rows: Sequence[Row], pid: int, ready_s: float | None) -> Row:
    """The supervisor's own row: the worst of the others, and seconds from start to ready (None: not yet)."""
    troubled = [f"{row.name} {row.message}" for row in rows if row.level != OK]
    # STALE is the highest number but less of a trouble than ERROR.
    worst = max((row.level for row in rows), key=(OK, WARN, STALE, ERROR).index, default=OK)
    state = "starting" if ready_s is None else "ready"
    values = {"state": state, "pid": str(pid), "ready_s": "" if ready_s is None else f"{ready_s:.3f}"}
    return Row("supervisor", worst, "; ".join(troubled) or state, values)


def status_line(rows: Sequence[Row]) -> str:
    """The run in one line, for the service manager: the summary's message, and how tracking goes."""
    by_name = {row.name: row for row in rows}
    said = [by_name["supervisor"].message]
    tracker = by_name["tracker"].values if "tracker" in by_name else {}
    source = by_name["source"].values if "source" in by_name else {}
    if "odometry" in tracker:
        said.append(f"{tracker['odometry']} {tracker.get('map', '')}".strip())
    if "fps" in source:
        said.append(f"{source['fps']} images/s")
    if "keyframes" in tracker:
        said.append(f"{tracker['keyframes']} keyframes")
    return ", ".join(said)
