"""A calibration as the text of a camera file (pure)."""

from __future__ import annotations

from prism_edge.calibration.solve import Calibration


def camera_text(
    result: Calibration, views: int, source: str, board: str, readout_ms: float | None = None
) -> str:
    """YAML that `prism_edge.sources.camera_file` reads back; comments say what it was made from.

    ``readout_ms`` is a rolling shutter's, which no board shows: None where it is not known.
    """
    camera = result.camera
    sigmas = ", ".join(
        f"{name} {value:.2g}" for name, value in zip(("fx", "fy", "cx", "cy"), result.sigmas, strict=True)
    )
    # No line of a comment may end early, or hold what YAML can't, whatever a source is called.
    words = " ".join(f"{views} views of {board} from {source}".split())
    made_from = "".join(c if c.isprintable() else "?" for c in words)
    lines = [
        f"# Made by prism-edge calibrate: {made_from}",
        f"# Reprojection error {result.rms:.3f} pixels (rms); standard deviations (pixels): {sigmas}",
        f"model: {camera.model}",
        f"width: {camera.width}",
        f"height: {camera.height}",
        *(f"{name}: {getattr(camera, name):.6f}" for name in ("fx", "fy", "cx", "cy")),
        f"distortion: [{', '.join(f'{value:.9f}' for value in camera.distortion)}]",
        *([] if readout_ms is None else [f"readout_ms: {readout_ms:g}"]),
    ]
    return "\n".join(lines) + "\n"
