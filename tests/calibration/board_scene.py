"""A printed board in front of a known camera, drawn ray by ray."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from prism_edge.calibration.board import CHARUCO, Board, View
from prism_edge.geometry.cameras import FISHEYE, Camera

PINHOLE_CAMERA = Camera(
    640, 480, 612.4, 608.9, 331.7, 228.3, distortion=(-0.28, 0.09, 0.0008, -0.0012)
)
FISHEYE_CAMERA = Camera(640, 480, 231.5, 232.6, 316.2, 243.1, FISHEYE, (-0.012, 0.006, -0.004, 0.0008))
_TEXELS = 40  # of a square
_SAMPLES = 2  # rays a pixel, each way
_QUIET = 1.2  # white around the printed squares, in squares


def poses(
    count: int, board: Board, camera: Camera, seed: int = 0, tilt_deg: float = 40.0
) -> list[np.ndarray]:
    """camera_from_board (4, 4): boards all over the image, turned at random, wholly or nearly in view."""
    rng = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    span = max(board.columns, board.rows)
    margin = 0.02 * camera.width
    reach = 0.62 if camera.model == FISHEYE else 0.5
    while len(found) < count:
        angles = np.radians(rng.uniform(-tilt_deg, tilt_deg, 2))
        turn = cv2.Rodrigues(np.array([angles[0], angles[1], rng.uniform(-0.5, 0.5)]))[0]
        size = np.array([camera.width, camera.height])
        aim = rng.uniform(-reach, reach, 2) * size + size / 2
        ray = np.append(camera.normalise(aim[None])[0], 1.0)
        distance = rng.uniform(0.7, 2.2) * span * min(camera.fx / camera.width, 1.0)
        if camera.model == FISHEYE:  # the board faces the camera, wherever it is
            ray /= np.linalg.norm(ray)
            distance = rng.uniform(0.45, 0.9) * span
            axis = np.cross([0, 0, 1.0], ray)
            turn = cv2.Rodrigues(axis / max(np.linalg.norm(axis), 1e-9) * np.arccos(ray[2]))[0] @ turn
        centre = np.append((board.outline.mean(axis=0)), 0.0)
        pose = np.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = ray * distance - turn @ centre
        seen = board.points @ turn.T + pose[:3, 3]
        if seen[:, 2].min() < 0.2:
            continue
        pixels = camera.project(seen)
        if pixels.min() > margin and np.all(pixels < np.array([camera.width, camera.height]) - margin):
            found.append(pose)
    return found


def texture(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """The print (h, w), and the texel (2,) at which the board's first corner lies."""
    origin = 1.0  # the first corner is a square in, on either board
    if board.kind == CHARUCO:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
        squares = (board.columns, board.rows)
        printed = cv2.aruco.CharucoBoard(squares, 1.0, board.marker, dictionary)
        size = squares[0] * _TEXELS, squares[1] * _TEXELS
        print_ = printed.generateImage(size, marginSize=0, borderBits=1)
    else:
        y, x = np.mgrid[: board.rows + 1, : board.columns + 1]
        print_ = np.kron(((x + y) % 2 * 255).astype(np.uint8), np.ones((_TEXELS, _TEXELS), np.uint8))
    quiet = round(_QUIET * _TEXELS)
    print_ = cv2.copyMakeBorder(print_, quiet, quiet, quiet, quiet, cv2.BORDER_CONSTANT, value=255)
    return print_, np.full(2, origin * _TEXELS + quiet - 0.5)


@lru_cache(maxsize=4)
def rays(camera: Camera) -> list[np.ndarray]:
    """Rays (3, h, w) on the plane z = 1, of each of a pixel's samples."""
    offsets = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    found = []
    for dv in offsets:
        for du in offsets:
            flat = camera.normalise(np.stack([u.ravel() + du, v.ravel() + dv], axis=1))
            found.append(np.stack([*flat.T, np.ones(len(flat))]).reshape(3, *u.shape).astype(np.float32))
    return found


def draw(board: Board, camera: Camera, pose: np.ndarray, seed: int = 0) -> np.ndarray:
    """The image (h, w) of the board, several rays a pixel, with noise."""
    print_, first = texture(board)
    total = np.zeros((camera.height, camera.width), np.float32)
    # Texels of a ray: by the plane's homography.
    from_board = np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]])
    from_texel = np.diag([1 / _TEXELS, 1 / _TEXELS, 1.0])
    from_texel[:2, 2] = -first / _TEXELS
    to_texel = np.linalg.inv(from_board @ from_texel)
    to_texel *= np.sign(to_texel[2] @ pose[:3] @ np.append(board.outline.mean(axis=0), [0.0, 1.0]))
    for ray in rays(camera):
        x, y, w = np.tensordot(to_texel.astype(np.float32), ray, axes=1)
        ahead = w > 1e-6
        x = np.where(ahead, x / np.where(ahead, w, 1), -1e4).clip(-1e4, 1e4)
        y = np.where(ahead, y / np.where(ahead, w, 1), -1e4).clip(-1e4, 1e4)
        total += cv2.remap(print_, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=130)
    image = 20 + 0.8 * total / _SAMPLES**2
    noise = np.random.default_rng(seed).normal(0, 2.0, image.shape)
    return (image + noise).clip(0, 255).astype(np.uint8)


@lru_cache(maxsize=8)
def gallery(spec: str, camera: Camera, count: int = 16) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Poses and images of a board."""
    board = Board.parse(spec)
    places = poses(count, board, camera)
    return places, [draw(board, camera, pose, k) for k, pose in enumerate(places)]


def seen(board: Board, camera: Camera, places: list[np.ndarray], noise: float, seed: int = 0) -> list[View]:
    """Views as a perfect detector with ``noise`` (pixels) would give them."""
    rng = np.random.default_rng(seed)
    views = []
    for pose in places:
        pixels = truth(board, camera, pose)
        views.append(View(np.arange(len(pixels)), pixels + rng.normal(0, noise, pixels.shape)))
    return views


def truth(board: Board, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of all corners."""
    return camera.project(board.points @ pose[:3, :3].T + pose[:3, 3])
