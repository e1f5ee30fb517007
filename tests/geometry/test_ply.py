"""PLY files against their bytes."""

from __future__ import annotations

import struct

import numpy as np

from prism_edge.geometry.ply import ply


def test_a_file_is_its_header_and_three_floats_a_point() -> None:
    data = ply("a few points", np.array([[1.0, -2.0, 0.5], [1e6, 0.1, 0.0]]))
    expected = (
        b"ply\nformat binary_little_endian 1.0\ncomment a few points\n"
        b"element vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    assert data == expected + struct.pack("<6f", 1.0, -2.0, 0.5, 1e6, 0.1, 0.0)


def test_normals_and_colours_follow_each_point() -> None:
    points, normals = np.array([[1.0, 2.0, 3.0]]), np.array([[0.0, 0.0, -1.0]])
    data = ply("one", points, normals, np.array([[10, 20, 255]], np.uint8))
    header, _, body = data.partition(b"end_header\n")
    names = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    assert names == [
        *(["float", name] for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(["uchar", name] for name in ("red", "green", "blue")),
    ]
    assert body == struct.pack("<6f3B", 1.0, 2.0, 3.0, 0.0, 0.0, -1.0, 10, 20, 255)


def test_no_points() -> None:
    none = np.zeros((0, 3))
    data = ply("none", none, none, none.astype(np.uint8))
    assert b"element vertex 0\n" in data
    assert data.endswith(b"end_header\n")
