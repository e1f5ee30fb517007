"""One export: network, files of each precision, their cards, their parity."""

from __future__ import annotations

import shutil
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from prism_edge.depth.contract import FOCAL_NORMALISED, ModelCard, card_from_mapping
from prism_edge.depth.prediction import OPEN
from prism_edge.depth.registry import find
from prism_edge.errors import ModelError
from tools.export_da3 import convert, parity
from tools.export_da3.checkpoints import METRIC_FOCAL_LENGTH, Checkpoint
from tools.export_da3.nested import SKY_LIMIT
from tools.export_da3.networks import (
    PATCH,
    Nested,
    SeveralViews,
    SingleView,
    Wanted,
    descriptor_layer,
)
from tools.export_da3.pictures import MEAN, STD, pictures, tensor
from tools.export_da3.variants import NON_COMMERCIAL, Variant

_IMAGES = 3  # on which parity is checked
# DSUG as the paper gives it; its figures are for this network.
_TAU, _TEMPERATURE = 0.07, 0.02


@dataclass(frozen=True)
class Job:
    """What to export. Two checkpoints, a relative and a metric one, are nested."""

    checkpoints: list[Checkpoint]
    out: Path
    height: int
    width: int
    views: int = 1
    wanted: Wanted = field(default_factory=Wanted)
    precisions: list[str] = field(default_factory=lambda: [convert.FP32])
    name: str = ""
    scale_bias_sigma: float = 0.1
    external: bool = False
    images: list[Path] = field(default_factory=list)


def export(job: Job) -> list[Path]:
    """Writes and checks the files of all precisions; returns them. ModelError leaves none that misses."""
    check(job, [checkpoint.variant for checkpoint in job.checkpoints])
    images = [tensor(image, job.height, job.width) for image in pictures(job.images, max(_IMAGES, job.views))]
    if job.views > 1:
        network, inputs, truths = _several_views(job, images)
    else:
        network, inputs, truths = _single_view(job, images)
    names = list(inputs[0])
    example = [torch.from_numpy(inputs[0][name]) for name in names]
    written = []
    with tempfile.TemporaryDirectory(dir=job.out.parent) as folder:
        started = time.perf_counter()
        base = convert.trace(network, example, names, Path(folder) / "base.onnx")
        print(f"traced at {job.height}x{job.width} in {time.perf_counter() - started:.0f} s", flush=True)
        for precision in dict.fromkeys(job.precisions):
            made = Path(folder) / precision / out_of(job.out, precision).name
            made.parent.mkdir()
            network_card = card(job, network, precision)
            convert.save(convert.in_precision(base, precision), network_card, made, job.external)
            _check_parity(made, precision, inputs, truths)
            convert.remove(out_of(job.out, precision))
            for file in (convert.weights_of(made), made):  # the graph last: it is what is looked for
                if file.exists():
                    file.chmod(base.stat().st_mode)  # weights are written for their owner alone
                    shutil.move(file, job.out.parent / file.name)
            written.append(out_of(job.out, precision))
    for path in written:
        print(f"written: {path}")
    return written


def check(job: Job, variants: list[Variant]) -> None:
    """Raises ModelError for what can't be exported; ``variants`` are the checkpoints', loaded or not."""
    if job.out.suffix != ".onnx" or not job.out.parent.is_dir():
        raise ModelError(f"{job.out}: a file ending in .onnx in a folder that exists is needed")
    for what, size in (("height", job.height), ("width", job.width)):
        if size % PATCH or not 3 * PATCH <= size <= 4096:
            raise ModelError(f"{what} {size}: a multiple of {PATCH} from {3 * PATCH} to 4096 is needed")
    first, nested = variants[0], len(variants) > 1
    if nested and not first.several_views:
        raise ModelError(f"{first.name} gives no confidence, by which nested depths are compared")
    if job.views < 1 or job.views > 64:
        raise ModelError(f"{job.views} views: 1 to 64 can be exported")
    if job.views > 1 and (nested or not first.several_views):
        raise ModelError(f"{first.name}: takes one view, alone or nested; it has no poses to be given")
    if (job.wanted.rays or job.wanted.intrinsics) and not first.several_views:
        raise ModelError(f"{first.name}: predicts neither rays nor intrinsics")
    if job.views > 1 and job.wanted.intrinsics:
        raise ModelError("a network of several views puts out predicted_intrinsics: leave --intrinsics out")
    for precision in job.precisions:
        namesake = find(_card(job, variants, precision, {}).name)
        if namesake and namesake.card:
            raise ModelError(f"--name {namesake.name}: is that of a registered file, which this is not")
    if job.images:  # those of a simulated room are always there
        pictures(job.images, max(_IMAGES, job.views))


def out_of(path: Path, precision: str) -> Path:
    """The file of a precision: fp32's is ``path`` itself."""
    return path if precision == convert.FP32 else path.with_name(f"{path.stem}_{precision}.onnx")


def card(job: Job, network: torch.nn.Module, precision: str) -> ModelCard:
    """The model card of one file, checked as the daemon will check it."""
    outputs = set(network.output_names)  # type: ignore[arg-type]
    more: dict[str, object] = {
        "revision": " ".join(checkpoint.revision for checkpoint in job.checkpoints) + f" {precision}"
    }
    if "confidence" in outputs:
        more |= {"confidence_output": "confidence", "confidence_kind": OPEN}
        more |= {"dsug_tau": _TAU, "dsug_temperature": _TEMPERATURE}
    if "sky" in outputs:
        more |= {"sky_output": "sky", "sky_limit": SKY_LIMIT}
    if "descriptor" in outputs:
        layer = descriptor_layer(job.checkpoints[0].net, job.wanted.descriptor)
        more |= {"descriptor_output": "descriptor", "descriptor_layer": layer}
        more |= {"descriptor_pooling": job.wanted.descriptor}
    for role in ("rays", "intrinsics"):
        if role in outputs:
            more[f"{role}_output"] = role
    return _card(job, [checkpoint.variant for checkpoint in job.checkpoints], precision, more)


def _card(job: Job, variants: list[Variant], precision: str, more: dict[str, object]) -> ModelCard:
    """The card with what is known before anything is loaded, and ``more``. Raises ModelError."""
    stem = "_".join(["nested", *(v.name for v in variants)] if len(variants) > 1 else [variants[0].name])
    stem = stem.replace("-", "_") + (f"_{job.views}views" if job.views > 1 else "")
    suffix = "" if precision == convert.FP32 else f"_{precision}"
    kind = variants[-1].depth_kind
    values = {
        "contract": 1,
        "name": (job.name or f"{stem}_{job.height}x{job.width}")[:59] + suffix,
        "revision": precision,
        "licence": next((v.licence for v in variants if v.licence == NON_COMMERCIAL), variants[0].licence),
        "source": "Depth Anything 3 " + " scaled by ".join(v.title for v in variants) + " (Lin et al. 2025)",
        "depth_kind": kind,
        "input_name": "image",
        "input_height": job.height,
        "input_width": job.width,
        "mean": list(MEAN),
        "std": list(STD),
        "depth_output": "depth",
        "views": job.views,
    }
    if kind == FOCAL_NORMALISED:
        values |= {"canonical_focal_length": METRIC_FOCAL_LENGTH, "scale_bias_sigma": job.scale_bias_sigma}
    return card_from_mapping(values | more, job.out.name)


def _single_view(
    job: Job, images: list[torch.Tensor]
) -> tuple[torch.nn.Module, list[dict[str, np.ndarray]], list[parity.Outputs]]:
    nets = [checkpoint.net for checkpoint in job.checkpoints]
    inputs = [{"image": image.numpy()} for image in images]
    if len(nets) == 1:
        truths = [parity.reference(nets[0], image, job.wanted) for image in images]
        return SingleView(nets[0], job.wanted).eval(), inputs, truths
    truths = [
        parity.nested_reference(
            parity.reference(nets[0], image, job.wanted), parity.reference(nets[1], image, Wanted(""))
        )
        for image in images
    ]
    return Nested(*nets, job.wanted).eval(), inputs, truths


def _several_views(
    job: Job, images: list[torch.Tensor]
) -> tuple[torch.nn.Module, list[dict[str, np.ndarray]], list[parity.Outputs]]:
    """With cameras that step and turn about all axes, as no symmetry may hide an error."""
    net = job.checkpoints[0].net
    stacked = torch.cat(images[: job.views])
    rng = np.random.default_rng(0)
    extrinsics = np.tile(np.eye(4, dtype=np.float32), (job.views, 1, 1))
    for i in range(1, job.views):
        turn, _ = np.linalg.qr(np.eye(3) + 0.3 * rng.normal(size=(3, 3)))
        extrinsics[i, :3, :3] = turn * np.sign(np.linalg.det(turn))
        extrinsics[i, :3, 3] = rng.normal(size=3)
    focal = 0.8 * job.width
    matrix = [[focal, 0, job.width / 2], [0, 1.05 * focal, job.height / 2], [0, 0, 1]]
    intrinsics = np.tile(np.array(matrix, np.float32), (job.views, 1, 1))
    feed = {"image": stacked.numpy(), "extrinsics": extrinsics, "intrinsics": intrinsics}
    given = [torch.from_numpy(value) for value in feed.values()]
    truth = parity.several_views_reference(net, *given)
    return SeveralViews(net, job.wanted).eval(), [feed], [truth]


def _check_parity(
    path: Path, precision: str, inputs: list[dict[str, np.ndarray]], truths: list[parity.Outputs]
) -> None:
    bound = parity.BOUNDS[precision]
    found = parity.compare(path, inputs, truths)
    measure = "mean" if precision == convert.INT8 else "largest"
    print(f"{path.name}: relative error against PyTorch on {len(inputs)} inputs, {measure} at most {bound:g}")
    for item in found:
        print(f"  {item.output:22} largest {item.largest:.1e}  mean {item.mean:.1e}", flush=True)
    missed = parity.missed(found, precision, bound)
    if missed:
        raise ModelError(f"{path.name}: {', '.join(missed)} miss {bound:g}; the file is not kept")
