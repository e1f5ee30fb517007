"""Camera geometry in operators that can be exported; the package's own uses masks and .mT, which can't."""

from __future__ import annotations

import torch
from torch import Tensor


def inverse(pose: Tensor) -> Tensor:
    """(..., 3, 4) inverse of rigid transforms (..., 3 or 4, 4)."""
    rotation, translation = pose[..., :3, :3], pose[..., :3, 3:]
    turned = rotation.transpose(-1, -2)
    return torch.cat([turned, -turned @ translation], dim=-1)


def quaternion(rotation: Tensor) -> Tensor:
    """(..., 4) x y z w with w >= 0 of rotation matrices (..., 3, 3).

    Shepperd's method: of the four ways to write a quaternion from a rotation matrix, the one that divides
    by the largest component, as 4 q q^T is linear in the matrix.
    """
    r = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    xx, yy, zz = r[0][0], r[1][1], r[2][2]
    x, y, z = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    xy, xz, yz = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    rows = torch.stack(
        [
            torch.stack([1 + xx - yy - zz, xy, xz, x], dim=-1),
            torch.stack([xy, 1 - xx + yy - zz, yz, y], dim=-1),
            torch.stack([xz, yz, 1 - xx - yy + zz, z], dim=-1),
            torch.stack([x, y, z, 1 + xx + yy + zz], dim=-1),
        ],
        dim=-2,
    )  # 4 q q^T: each row is q times one of its components
    diagonal = torch.stack([rows[..., i, i] for i in range(4)], dim=-1)
    largest = diagonal.argmax(dim=-1)[..., None, None].expand(*diagonal.shape[:-1], 1, 4)
    row = torch.gather(rows, -2, largest)[..., 0, :]
    unit = row / torch.sqrt((row * row).sum(dim=-1, keepdim=True))
    return torch.where(unit[..., 3:] < 0, -unit, unit)


def pose_encoding(extrinsics: Tensor, intrinsics: Tensor, height: int, width: int) -> Tensor:
    """(..., 9) what the camera encoder takes: translation, quaternion, vertical and horizontal field of view.

    ``extrinsics`` (..., 4, 4) are camera_from_world, ``intrinsics`` (..., 3, 3) in pixels of the network's
    input of ``height`` x ``width``; translation and quaternion are of world_from_camera.
    """
    world_from_camera = inverse(extrinsics)
    vertical = 2 * torch.atan(height / 2 / intrinsics[..., 1, 1])
    horizontal = 2 * torch.atan(width / 2 / intrinsics[..., 0, 0])
    turn = quaternion(world_from_camera[..., :3])
    return torch.cat([world_from_camera[..., 3], turn, vertical[..., None], horizontal[..., None]], dim=-1)
