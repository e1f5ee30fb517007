"""What is exported: the package's networks, with the outputs that a daemon or a reconstruction uses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from depth_anything_3.model.da3 import DepthAnything3Net
from depth_anything_3.model.utils.transform import pose_encoding_to_extri_intri
from torch import Tensor, nn

from prism_edge.depth.inner_tensor import GRID, MEAN, TOKEN, halves
from tools.export_da3 import cameras
from tools.export_da3.nested import NestedDepth

PATCH = 14  # pixels
# The package counts pixels from the image's corner, prism_edge from the first one's centre.
HALF_PIXEL = ((0.0, 0.0, 0.5), (0.0, 0.0, 0.5), (0.0, 0.0, 0.0))
DESCRIPTORS = (GRID, MEAN, TOKEN)


@dataclass(frozen=True)
class Wanted:
    """Which outputs besides depth, and confidence or sky."""

    descriptor: str = GRID  # one of DESCRIPTORS, or "" for none
    rays: bool = False
    intrinsics: bool = False


class SingleView(nn.Module):
    """image (1, 3, H, W) -> the outputs named by ``output_names``, in that order."""

    def __init__(self, net: DepthAnything3Net, wanted: Wanted) -> None:
        super().__init__()
        self.net = net
        self._wanted = wanted
        self.several_views = net.cam_dec is not None
        names = ["depth", "confidence" if self.several_views else "sky"]
        names += ["descriptor"] if wanted.descriptor else []
        names += ["rays"] if wanted.rays and self.several_views else []
        names += ["intrinsics"] if wanted.intrinsics and self.several_views else []
        self.output_names = tuple(names)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        height, width = int(image.shape[-2]), int(image.shape[-1])
        features, _ = self.net.backbone(image[:, None], cam_token=None, export_feat_layers=[])
        dense = self.net.head(features, height, width, patch_start_idx=0)
        given = {"depth": dense["depth"][:, 0]}
        if self.several_views:
            given["confidence"] = dense["depth_conf"][:, 0]
            given["rays"] = dense["ray"][:, 0]  # direction, then origin, in the camera's frame
        else:
            given["sky"] = dense["sky"][:, 0]
        if self._wanted.descriptor:
            grid = (height // PATCH, width // PATCH)
            given["descriptor"] = _descriptor(self.net, features, grid, self._wanted.descriptor)
        if "intrinsics" in self.output_names:
            encoded = self.net.cam_dec(features[-1][1])
            matrix = pose_encoding_to_extri_intri(encoded, (height, width))[1][:, 0]
            given["intrinsics"] = matrix - matrix.new_tensor(HALF_PIXEL)
        return tuple(given[name] for name in self.output_names)


class Nested(nn.Module):
    """A relative network in a metric one's unit: as :class:`SingleView`, and the metric one's sky."""

    def __init__(self, relative: DepthAnything3Net, metric: DepthAnything3Net, wanted: Wanted) -> None:
        super().__init__()
        self.relative = SingleView(relative, wanted)
        self.metric = SingleView(metric, Wanted(descriptor=""))
        self.alignment = NestedDepth()  # its name is in those of its operators: convert.NESTED_PART
        self.output_names = (*self.relative.output_names, "sky")

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        depth, confidence, *rest = self.relative(image)
        metric, sky = self.metric(image)
        return self.alignment(depth, confidence, metric, sky), confidence, *rest, sky


class SeveralViews(nn.Module):
    """images (N, 3, H, W), camera_from_world (N, 4, 4), intrinsics (N, 3, 3) -> depth maps and cameras.

    The poses are the network's condition: relative to the first view, their median distance from it being
    1 (docs/EXPORT.md). Depths are in that unit, up to the factor by which the predicted cameras differ.
    """

    def __init__(self, net: DepthAnything3Net, wanted: Wanted) -> None:
        super().__init__()
        self.net = net
        names = ["depth", "confidence", "predicted_extrinsics", "predicted_intrinsics"]
        self.output_names = tuple(names + (["rays"] if wanted.rays else []))

    def forward(self, images: Tensor, extrinsics: Tensor, intrinsics: Tensor) -> tuple[Tensor, ...]:
        height, width = int(images.shape[-2]), int(images.shape[-1])
        encoder = self.net.cam_enc
        encoded = cameras.pose_encoding(extrinsics[None], intrinsics[None], height, width)
        token = encoder.trunk_norm(encoder.trunk(encoder.token_norm(encoder.pose_branch(encoded))))
        features, _ = self.net.backbone(images[None], cam_token=token, export_feat_layers=[])
        dense = self.net.head(features, height, width, patch_start_idx=0)
        poses, matrices = pose_encoding_to_extri_intri(self.net.cam_dec(features[-1][1]), (height, width))
        given = {
            "depth": dense["depth"][0],
            "confidence": dense["depth_conf"][0],
            "predicted_extrinsics": cameras.inverse(poses[0]),
            "predicted_intrinsics": matrices[0] - matrices.new_tensor(HALF_PIXEL),
            "rays": dense["ray"][0],
        }
        return tuple(given[name] for name in self.output_names)


def descriptor_layer(net: DepthAnything3Net, pooling: str) -> str:
    """In words, where the descriptor comes from."""
    blocks = net.backbone.out_layers
    if pooling == TOKEN:
        return f"{'camera' if net.cam_dec is not None else 'class'} token of block {blocks[-1]}"
    return f"patch features of block {blocks[1]}"


def _descriptor(
    net: DepthAnything3Net, features: Sequence[tuple[Tensor, Tensor]], grid: tuple[int, int], pooling: str
) -> Tensor:
    """(1, n) of norm 1.

    The middle of the encoder knows places best in the networks that were measured (docs/MODELS.md); so do
    the quarters of the image, against its whole.
    """
    if pooling == TOKEN:
        vector = features[-1][1][:, 0]
    else:
        patches = features[1][0][:, 0]  # (1, n, C) or, for several views, (1, n, 2 C)
        channels = net.backbone.pretrained.embed_dim
        patches = patches[..., -channels:]  # the normalised half
        cells = patches.reshape(1, *grid, channels)
        rows, columns = halves(grid[0]), halves(grid[1])
        if pooling == MEAN:
            rows, columns = (slice(None),), (slice(None),)  # type: ignore[assignment]
        vector = torch.cat([cells[:, a, b].mean(dim=(1, 2)) for a in rows for b in columns], dim=-1)
    return vector / torch.sqrt((vector * vector).sum(dim=-1, keepdim=True))
