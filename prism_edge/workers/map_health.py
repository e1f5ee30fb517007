"""What `health` shows of the backend's map."""

from __future__ import annotations

from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.lens import radial


def show_map(values: dict[str, str], world: GlobalMap, behind: int) -> None:
    """Put a map's size, and what was found of its camera, among a pulse's values.

    ``behind``: keyframes that wait.
    """
    values.update(keyframes=str(len(world.keyframes)), points=str(len(world.points)), behind=str(behind))
    found = {"k1": "", "readout_ms": ""}
    if world.camera is not None:
        found["k1"] = f"{radial(world.camera):.4f}"
    if world.readout_ms:
        found["readout_ms"] = f"{world.readout_ms:.1f}"
    for name, value in found.items():  # never away for a moment: a heartbeat may come between
        if value:
            values[name] = value
        else:
            values.pop(name, None)
