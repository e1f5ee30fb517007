"""Points as a PLY file, which every viewer of clouds reads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prism_edge.geometry.poses import Array

_WORDS = {"<f4": "float", "u1": "uchar"}


def ply(
    comment: str, points: Array, normals: Array | None = None, colours: NDArray[np.uint8] | None = None
) -> bytes:
    """A binary file of points (n, 3) in metres, with unit normals (n, 3) and RGB colours (n, 3) if given."""
    columns: dict[str, tuple[NDArray, str]] = {
        name: (points[:, i], "<f4") for i, name in enumerate(("x", "y", "z"))
    }
    if normals is not None:
        columns |= {name: (normals[:, i], "<f4") for i, name in enumerate(("nx", "ny", "nz"))}
    if colours is not None:
        columns |= {name: (colours[:, i], "u1") for i, name in enumerate(("red", "green", "blue"))}
    rows = np.empty(len(points), np.dtype([(name, dtype) for name, (_, dtype) in columns.items()]))
    for name, (values, _) in columns.items():
        rows[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {comment}",
        f"element vertex {len(points)}",
        *(f"property {_WORDS[dtype]} {name}" for name, (_, dtype) in columns.items()),
        "end_header",
    ]
    return "".join(line + "\n" for line in header).encode() + rows.tobytes()
