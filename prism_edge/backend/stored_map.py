"""The global map as arrays, and back: what map_file.py writes. Reading trusts nothing and says what is wrong.

For K keyframes with N keypoints in all, M points, D numbers a place descriptor:

================ =========== ================================================================
keyframes        i8 (K)      numbers
indices          i8 (K)      frames they were made from
poses            f8 (K,4,4)  world_from_camera, map units
cameras          i8 (K)      row of info["cameras"]: [model, [width, height, fx, fy, cx, cy, ...]]
scale_factors    f8 (K)      between pyramid levels
travelled        f8 (K)      path length to there, map units
starts           i8 (K+1)    where each one's keypoints begin
pixels           f4 (N,2)    undistorted
octaves          u1 (N)      pyramid level
descriptors      u1 (N,32)   ORB
seen             i8 (N)      point that a keypoint shows, -1 for none
depths           f4 (N)      network depth there along z, map units; 0 for none
weights          f4 (N)      the gate's weight there in [0, 1]; -1 where it knows nothing
points           i8 (M)      numbers
positions        f8 (M,3)    map units
parallax_deg     f4 (M)      widest angle between a point's rays
carried          i8 (C,3)    culled keyframe, the keyframe it hangs on, its frame
links            f8 (C,4,4)  keyframe_from_culled
places           i8 (P)      keyframes that have a place descriptor
place_descriptors f4 (P,D)   of norm 1
depth_sigmas     f8 (K)      relative noise of depths, 0 where the source did not know it; may be
                             left out where it is 0 for all
made_by          i8 (M)      keyframe that a point was made from, -1 where that is not known
depth_units      f8 (K)      map units a metre of network depth; 0 where that is not known
renamed          i8 (R,2)    point that there was, and the one that it was made one with
grown            f8 (K)      by how much a loop has lengthened its part since it was made
twists           f8 (K,6)    how the camera moved, a second, in its own frame and the units it was made in
================ =========== ================================================================

The last five are not in maps that `save_map` writes, which builds before them read as well. When
keyframes were taken, and more of the kind, is told beside the arrays (map_facts.py).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.backend.global_map import UNKNOWN, GlobalKeyframe, GlobalMap, GlobalPoint
from prism_edge.backend.map_facts import (
    growth_info,
    growth_told,
    is_readout_said,
    parts_info,
    parts_told,
    readout_info,
    readout_told,
    stamps_info,
    stamps_told,
    stand_ins_info,
    stand_ins_told,
)
from prism_edge.backend.map_file import Arrays, Info
from prism_edge.errors import ConfigError, MapError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import are_rotations, normalised
from prism_edge.messages import HOME, LARGEST_ID
from prism_edge.tracking.features import Features, grid
from prism_edge.tracking.place_index import PlaceIndex

MOST_KEYFRAMES, MOST_POINTS, MOST_KEYPOINTS = 200_000, 20_000_000, 50_000_000
FARTHEST = 1e9  # map units; pixels
HIGHEST_OCTAVE = 32
LARGEST_IMAGE = 20_000  # pixels a side
# Cells that keypoints are filed in, 8 bytes each: 1500 keyframes of 3840 x 2160, and more where all are full.
MOST_CELLS, CELLS_A_KEYPOINT = 50_000_000, 20

_COLUMNS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "keyframes": ("<i8", ("K",)),
    "indices": ("<i8", ("K",)),
    "poses": ("<f8", ("K", 4, 4)),
    "cameras": ("<i8", ("K",)),
    "scale_factors": ("<f8", ("K",)),
    "travelled": ("<f8", ("K",)),
    "starts": ("<i8", ("K+1",)),
    "pixels": ("<f4", ("N", 2)),
    "octaves": ("|u1", ("N",)),
    "descriptors": ("|u1", ("N", 32)),
    "seen": ("<i8", ("N",)),
    "depths": ("<f4", ("N",)),
    "weights": ("<f4", ("N",)),
    "points": ("<i8", ("M",)),
    "positions": ("<f8", ("M", 3)),
    "parallax_deg": ("<f4", ("M",)),
    "carried": ("<i8", ("C", 3)),
    "links": ("<f8", ("C", 4, 4)),
    "places": ("<i8", ("P",)),
    "place_descriptors": ("<f4", ("P", "D")),
    "depth_sigmas": ("<f8", ("K",)),
    "made_by": ("<i8", ("M",)),
    "depth_units": ("<f8", ("K",)),
    "renamed": ("<i8", ("R", 2)),
    "grown": ("<f8", ("K",)),
    "twists": ("<f8", ("K", 6)),
}
# Earlier builds lack them, and can read maps that do.
_OPTIONAL = {"depth_sigmas", "made_by", "depth_units", "renamed", "grown", "twists"}


def to_arrays(world: GlobalMap, index: PlaceIndex, in_use: bool = False) -> tuple[Info, Arrays]:
    """Everything of a map that is worth keeping; ``in_use``: for one who goes on with who told it to us."""
    keyframes = list(world.keyframes.values())
    sizes = [len(k.features) for k in keyframes]
    cameras: dict[tuple[str, bytes], int] = {}
    listed: list[list[Any]] = []
    rows = []
    for k in keyframes:
        numbers = k.camera.to_array()
        key = (k.camera.model, numbers.tobytes())
        if key not in cameras:
            cameras[key] = len(listed)
            listed.append([k.camera.model, numbers.tolist()])
        rows.append(cameras[key])
    seen = np.full(sum(sizes), -1, np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    positions = _stack((point.position for point in world.points.values()), (3,))
    near: list[bool] = (np.abs(positions).max(axis=1, initial=0.0) < FARTHEST).tolist()
    # A star that ran off would make the whole map one that nobody reads.
    far = {point for point, is_near in zip(world.points, near, strict=True) if not is_near}
    for start, k in zip(starts.tolist(), keyframes, strict=False):
        for point, keypoint in k.observed.items():
            if point not in far:
                seen[start + keypoint] = point
    kept = np.unique(seen[seen >= 0]).tolist()
    places = [k.id for k in keyframes if k.id in index]
    descriptors = [index.get(k) for k in places]
    arrays = {
        "keyframes": np.array([k.id for k in keyframes], np.int64),
        "indices": np.array([k.index for k in keyframes], np.int64),
        "poses": _stack((k.world_from_camera for k in keyframes), (4, 4)),
        "cameras": np.array(rows, np.int64),
        "scale_factors": np.array([k.scale_factor for k in keyframes], np.float64),
        "travelled": np.array([k.travelled for k in keyframes], np.float64),
        "starts": starts,
        "pixels": _join([k.features.pixels for k in keyframes], (0, 2), np.float32),
        "octaves": _join([k.features.octaves for k in keyframes], (0,), np.uint8),
        "descriptors": _join([_bytes_of(k.features) for k in keyframes], (0, 32), np.uint8),
        "seen": seen,
        "depths": _join([_depths_of(k) for k in keyframes], (0,), np.float32),
        "weights": _join([_weights_of(k) for k in keyframes], (0,), np.float32),
        "points": np.array(kept, np.int64),
        "positions": _stack((world.points[p].position for p in kept), (3,)),
        "parallax_deg": np.array([world.points[p].parallax_deg for p in kept], np.float32),
        "carried": world.carried.numbers.copy(),
        "links": world.carried.links,
        "places": np.array(places, np.int64),
        "place_descriptors": np.array(descriptors, np.float32).reshape(len(places), -1 if places else 0),
    }
    if any(k.depth_sigma for k in keyframes):
        arrays["depth_sigmas"] = np.array([k.depth_sigma for k in keyframes], np.float64)
    if in_use:
        arrays["made_by"] = np.array([world.points[p].made_by for p in kept], np.int64)
        arrays["depth_units"] = np.array([_units_of(k) for k in keyframes], np.float64)
        arrays["renamed"] = world.renamed()
        arrays["grown"] = np.array([k.grown for k in keyframes], np.float64)
        arrays["twists"] = _stack((_twist_of(k) for k in keyframes), (6,))
    known = stamps_info([k.taken_ns for k in keyframes]) | parts_info({k.id: k.part for k in keyframes})
    known |= growth_info(world.growth) if in_use else {}
    standing = stand_ins_info([k.id for k in keyframes if k.stands_in])
    known |= readout_info(world.readout_ms, in_use and world.readout_said)
    return {"cameras": listed, "places_of": index.network, **known, **standing}, arrays


def from_arrays(info: Info, arrays: Arrays, max_carried: int) -> tuple[GlobalMap, PlaceIndex]:
    """The map that :func:`to_arrays` was given. Raises MapError for one that can't be."""
    _check_columns(arrays)
    unsaid = {
        "depth_sigmas": np.zeros(len(arrays["keyframes"])),
        "made_by": np.full(len(arrays["points"]), UNKNOWN),
        "depth_units": np.zeros(len(arrays["keyframes"])),
        "renamed": np.zeros((0, 2), np.int64),
        "grown": np.ones(len(arrays["keyframes"])),
        "twists": np.zeros((len(arrays["keyframes"]), 6)),
    }
    arrays = unsaid | arrays
    _check_values(arrays)
    cameras = _cameras(info, arrays["cameras"])
    _check_room(cameras, arrays)
    stamps = stamps_told(info, len(arrays["keyframes"]))
    away, standing = parts_told(info), stand_ins_told(info)
    if away and away.keys() >= set(arrays["keyframes"].tolist()):
        away = None  # none is at home: earlier builds wrote that too
    world = GlobalMap(max_carried)
    world.readout_ms, world.readout_said = readout_told(info), is_readout_said(info)
    world.rename(arrays["renamed"])
    world.growth = growth_told(info)
    ids = arrays["points"].tolist()
    columns = arrays["positions"], arrays["parallax_deg"].tolist(), arrays["made_by"].tolist()
    for p, position, parallax, made_by in zip(ids, *columns, strict=True):
        world.points[p] = GlobalPoint(position.copy(), set(), parallax, made_by)
    if not np.isin(arrays["seen"][arrays["seen"] >= 0], arrays["points"]).all():
        raise MapError("the map's keyframes see points that it does not have")
    starts = arrays["starts"].tolist()
    for row, number in enumerate(arrays["keyframes"].tolist()):
        part = slice(starts[row], starts[row + 1])
        made = world.keyframes[number] = _keyframe(number, row, part, arrays, cameras)
        made.taken_ns, made.stands_in = stamps[row], number in standing
        made.part = None if away is None else away.get(number, HOME)
        for keypoint, point in enumerate(arrays["seen"][part].tolist()):
            if point >= 0:
                world.observe(number, point, keypoint)
    for point in [p for p, seen in world.points.items() if not seen.keyframes]:
        del world.points[point]
    for (culled, anchor, frame), link in zip(arrays["carried"].tolist(), arrays["links"], strict=True):
        if anchor not in world.keyframes or culled in world.keyframes:
            raise MapError("the map's culled keyframes hang on ones that it does not have")
        world.carried.add(culled, anchor, normalised(link), frame)
    index, network = PlaceIndex(), str(info.get("places_of", ""))
    for number, descriptor in zip(arrays["places"].tolist(), arrays["place_descriptors"], strict=True):
        if number not in world.keyframes or not index.add(number, descriptor, network):
            raise MapError("the map's place descriptors are none")
    return world, index


def _keyframe(
    number: int, row: int, part: slice, arrays: Arrays, cameras: list[Camera]
) -> GlobalKeyframe:
    camera = cameras[int(arrays["cameras"][row])]
    pixels = arrays["pixels"][part].astype(np.float64)
    octaves = arrays["octaves"][part].astype(np.intp)
    packed = np.ascontiguousarray(arrays["descriptors"][part]).view(np.uint64).reshape(-1, 4)
    factor = float(arrays["scale_factors"][row])
    depths = arrays["depths"][part].astype(np.float64)
    weights = arrays["weights"][part].astype(np.float64)
    known = weights >= 0.0
    return GlobalKeyframe(
        number,
        int(arrays["indices"][row]),
        camera,
        normalised(arrays["poses"][row]),
        pixels,
        factor ** octaves.astype(np.float64),
        {},
        depths if depths.any() else None,
        depth_sigma=float(arrays["depth_sigmas"][row]),
        depth_units=float(arrays["depth_units"][row]),
        features=Features.build(pixels, octaves, packed, camera.width, camera.height),
        scale_factor=factor,
        travelled=float(arrays["travelled"][row]),
        grown=float(arrays["grown"][row]),
        twist=arrays["twists"][row].copy(),
        weights=np.where(known, weights, np.nan) if known.any() else None,
    )


def _check_columns(arrays: Arrays) -> None:
    """Names, types and shapes, which must agree with one another."""
    if missing := _COLUMNS.keys() - arrays.keys() - _OPTIONAL:
        raise MapError(f"the map has no {', '.join(sorted(missing))[:100]}")
    if unknown := arrays.keys() - _COLUMNS.keys():
        raise MapError(f"the map has {', '.join(sorted(unknown))[:100]}, which this version does not know")
    sizes: dict[str, int] = {}
    for name, array in arrays.items():
        dtype, shape = _COLUMNS[name]
        fits = array.dtype == np.dtype(dtype) and array.ndim == len(shape)
        for want, have in zip(shape, array.shape, strict=False):
            if isinstance(want, str):
                size = have - 1 if want == "K+1" else have
                fits &= sizes.setdefault(want.removesuffix("+1"), size) == size
            else:
                fits &= want == have
        if not fits:
            raise MapError(f"the map's {name} are {array.dtype} {array.shape}: not as many as belong there")
    for size, least, most, what in (
        ("K", 1, MOST_KEYFRAMES, "keyframes"),
        ("N", 0, MOST_KEYPOINTS, "keypoints"),
        ("M", 0, MOST_POINTS, "points"),
    ):
        if not least <= sizes[size] <= most:
            raise MapError(f"the map has {sizes[size]} {what}; {least} to {most} can be")


def _check_values(arrays: Arrays) -> None:
    starts = arrays["starts"]
    checks = {
        "keyframes": _numbers(arrays["keyframes"]),
        "indices": _between(arrays["indices"], 0, LARGEST_ID),
        "poses": _rigid(arrays["poses"]),
        "scale_factors": _between(arrays["scale_factors"], 1.01, 4.0),
        "travelled": _between(arrays["travelled"], 0.0, FARTHEST),
        "starts": starts[0] == 0 and starts[-1] == len(arrays["seen"]) and bool((np.diff(starts) >= 0).all()),
        "pixels": _between(arrays["pixels"], -FARTHEST, FARTHEST),
        "octaves": _between(arrays["octaves"], 0, HIGHEST_OCTAVE),
        "seen": _between(arrays["seen"], -1, LARGEST_ID),
        "depths": _between(arrays["depths"], 0.0, FARTHEST),
        "depth_sigmas": _between(arrays["depth_sigmas"], 0.0, FARTHEST),
        "weights": _between(arrays["weights"], -1.0, 1.0),
        "points": _numbers(arrays["points"]),
        "positions": _between(arrays["positions"], -FARTHEST, FARTHEST),
        "parallax_deg": _between(arrays["parallax_deg"], 0.0, 180.0),
        "made_by": _between(arrays["made_by"], UNKNOWN, LARGEST_ID),
        "depth_units": _between(arrays["depth_units"], 0.0, FARTHEST),
        "renamed": _names(arrays["renamed"], arrays["points"]),
        "grown": _between(arrays["grown"], 1.0 / FARTHEST, FARTHEST),
        "twists": _between(arrays["twists"], -FARTHEST, FARTHEST),
        "carried": _between(arrays["carried"], 0, LARGEST_ID) and _numbers(arrays["carried"][:, 0]),
        "links": _rigid(arrays["links"]),
        "places": _numbers(arrays["places"]),
        "place_descriptors": _between(arrays["place_descriptors"], -1.01, 1.01),
    }
    wrong = [name for name, sound in checks.items() if not sound]
    if wrong:
        raise MapError(f"the map's {wrong[0]} hold values that can't be")


def _between(array: NDArray[Any], low: float, high: float) -> bool:
    """Whether all values are within bounds, which no NaN is."""
    return bool(((array >= low) & (array <= high)).all())


def _numbers(array: NDArray[Any]) -> bool:
    return _between(array, 0, LARGEST_ID) and len(np.unique(array)) == len(array)


def _names(renamed: NDArray[np.int64], points: NDArray[np.int64]) -> bool:
    """Whether each point that there was has one new name, which is nobody's old one."""
    gone, now = renamed.T
    elsewhere = not np.isin(gone, np.concatenate([now, points])).any()
    return _numbers(gone) and _between(now, 0, LARGEST_ID) and elsewhere


def _rigid(poses: NDArray[np.float64]) -> bool:
    """Whether matrices (n, 4, 4) are rotations and finite shifts."""
    if not _between(poses, -FARTHEST, FARTHEST):
        return False
    return are_rotations(poses[:, :3, :3], 1e-3) and bool((poses[:, 3] == (0.0, 0.0, 0.0, 1.0)).all())


def _cameras(info: Info, rows: NDArray[np.int64]) -> list[Camera]:
    listed = info.get("cameras")
    if not isinstance(info.get("places_of", ""), str):
        raise MapError("the map's places are described by no network")
    if not isinstance(listed, list) or not _between(rows, 0, len(listed) - 1):
        raise MapError("the map's cameras are none")
    cameras = []
    for entry in listed:
        try:
            model, numbers = entry
            camera = Camera.from_array(model, np.array(numbers, np.float64))
        except (ConfigError, TypeError, ValueError, OverflowError) as error:
            raise MapError(f"a camera of the map is none: {error}".replace("\n", " ")[:200]) from None
        if max(camera.width, camera.height) > LARGEST_IMAGE:
            raise MapError(f"a camera of the map has images of {camera.width}x{camera.height}")
        cameras.append(camera)
    return cameras


def _check_room(cameras: list[Camera], arrays: Arrays) -> None:
    """What keyframes take in memory besides what is in the file goes with the size of their images."""
    cells = np.array([np.prod(grid(camera.width, camera.height)) for camera in cameras])
    needed = int(cells[arrays["cameras"]].sum())
    if needed > MOST_CELLS + CELLS_A_KEYPOINT * len(arrays["seen"]):
        raise MapError(f"the map's images are so large that its {needed} cells would take too much memory")


def _bytes_of(features: Features) -> NDArray[np.uint8]:
    return np.ascontiguousarray(features.descriptors).view(np.uint8).reshape(-1, 32)


def _depths_of(keyframe: GlobalKeyframe) -> NDArray[np.float64]:
    """None that reading would refuse the map for: a network may say that the sky is 1e10 m away."""
    if keyframe.depths is None:
        return np.zeros(len(keyframe.features))
    return np.where(keyframe.depths < FARTHEST, keyframe.depths, 0.0)


def _units_of(keyframe: GlobalKeyframe) -> float:
    """None that reading would refuse the map for."""
    return keyframe.depth_units if 0.0 < keyframe.depth_units < FARTHEST else 0.0


def _twist_of(keyframe: GlobalKeyframe) -> NDArray[np.float64]:
    """None that reading would refuse the map for."""
    return keyframe.twist if _between(keyframe.twist, -FARTHEST, FARTHEST) else np.zeros(6)


def _weights_of(keyframe: GlobalKeyframe) -> NDArray[np.float64]:
    if keyframe.weights is None:
        return np.full(len(keyframe.features), -1.0)
    return np.nan_to_num(keyframe.weights, nan=-1.0)


def _stack(matrices: Iterable[NDArray[np.float64]], shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.array(list(matrices), np.float64).reshape(-1, *shape)


def _join(parts: list[NDArray[Any]], empty: tuple[int, ...], dtype: type) -> NDArray[Any]:
    return np.concatenate([np.zeros(empty, dtype), *parts]).astype(dtype)
