"""Exports a Depth Anything 3 checkpoint to ONNX files that prism_edge runs.

    python tools/export_da3 CHECKPOINT OUT.onnx [--model NAME] [--height H --width W] [--precision ...]

CHECKPOINT is a folder or file (.safetensors, .pth). Each file is compared with PyTorch on images, output by
output, and deleted where it misses the bound: 1e-4 for fp32, as printed for the others. docs/EXPORT.md.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from prism_edge.depth.contract import FOCAL_NORMALISED
from prism_edge.depth.inner_tensor import GRID
from prism_edge.errors import FAILING_FILE, ModelError, PrismError, in_words

try:
    import onnx  # noqa: F401
    import torch  # noqa: F401
except ImportError as missing:
    needs = "`make exporter` makes .venv-export, whose bin/python runs this (docs/EXPORT.md)"
    sys.exit(f"export_da3: error: needs {missing.name}: {needs}")
# isort: split
from tools.export_da3 import checkpoints
from tools.export_da3.convert import FP32, PRECISIONS
from tools.export_da3.export import Job, check, export
from tools.export_da3.networks import DESCRIPTORS, PATCH, Wanted
from tools.export_da3.variants import (
    METRIC,
    MODEL_NAMES,
    NESTED,
    VARIANTS,
    parts_of,
    variant_of,
    weights_file,
)

HEIGHT, WIDTH = 252, 336  # of a camera of 4:3
BIAS_SIGMA = 0.1  # FastDepth's


def main(arguments: list[str] | None = None) -> int:
    args = _parser().parse_intermixed_args(arguments)  # options may stand between CHECKPOINT and OUT
    try:
        names = _names(args)
        job = Job(
            checkpoints=[],
            out=args.out,
            height=args.height,
            width=args.width,
            views=args.views,
            wanted=Wanted(
                _descriptor(args),
                args.rays,
                args.intrinsics,
            ),
            precisions=args.precision or [FP32],
            name=args.name,
            scale_bias_sigma=BIAS_SIGMA if args.scale_bias_sigma is None else args.scale_bias_sigma,
            external=args.external_data,
            images=args.images or [],
        )
        variants = [VARIANTS[part] for name in names for part in parts_of(name)]
        if args.scale_bias_sigma is not None and variants[-1].depth_kind != FOCAL_NORMALISED:
            raise ModelError(f"{names[0]} has no metres: leave --scale-bias-sigma out")
        check(job, variants)
        export(replace(job, checkpoints=_loaded(args, names)))
    except (PrismError, OSError) as error:
        print(f"export_da3: error: {in_words(error)}", file=sys.stderr)
        return error.exit_code if isinstance(error, PrismError) else FAILING_FILE
    return 0


def _descriptor(args: argparse.Namespace) -> str:
    """Of places; empty for none. Raises ModelError where there can't be one."""
    if args.views > 1:
        if args.descriptor not in (None, "none"):
            raise ModelError("a network of several views has no descriptor: leave --descriptor out")
        return ""
    return "" if args.descriptor == "none" else args.descriptor or GRID


def _names(args: argparse.Namespace) -> list[str]:
    """Which checkpoint it is, and which the one to be nested with; nothing is loaded. Raises ModelError."""
    if args.random_weights is not None:
        if not args.model:
            raise ModelError("--random-weights needs --model")
        if args.checkpoint is not None:
            raise ModelError("--random-weights takes no checkpoint, and one is named")
        names = [args.model]
    elif args.checkpoint is None:
        raise ModelError("a checkpoint is needed: a folder or a file, or --random-weights SEED")
    else:
        weights_file(args.checkpoint)
        names = [variant_of(args.checkpoint, args.model)]
    if args.metric and names[0] == NESTED:
        raise ModelError(f"{NESTED} holds a metric network of its own: leave --metric out")
    if args.metric and args.random_weights is None:
        weights_file(args.metric)
        variant_of(args.metric, METRIC)
    return [*names, METRIC] if args.metric else names


def _loaded(args: argparse.Namespace, names: list[str]) -> list[checkpoints.Checkpoint]:
    """One checkpoint, or a relative and a metric one to be nested."""
    given: list[checkpoints.Checkpoint] = []
    for i, (name, path) in enumerate(zip(names, (args.checkpoint, args.metric), strict=False)):
        if args.random_weights is None:
            given += checkpoints.load(path, name)
        else:
            given += checkpoints.random(name, args.random_weights + i)
    return given


def _parser() -> argparse.ArgumentParser:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="export_da3", description=__doc__, formatter_class=form)
    add = parser.add_argument
    add("checkpoint", metavar="CHECKPOINT", type=Path, nargs="?")
    add("out", metavar="OUT.onnx", type=Path)
    add("--model", choices=MODEL_NAMES, default="", help="default: what its config.json says")
    add("--metric", metavar="CHECKPOINT", type=Path, help="nest it with this da3metric-large: metric depth")
    add("--random-weights", metavar="SEED", type=int, help="no checkpoint: a test of the export")
    add("--height", type=int, default=HEIGHT, metavar="H", help=f"a multiple of {PATCH} (default {HEIGHT})")
    add("--width", type=int, default=WIDTH, metavar="W", help=f"a multiple of {PATCH} (default {WIDTH})")
    add("--views", type=int, default=1, metavar="N", help="images at once, with their poses (default 1)")
    add("--precision", nargs="+", choices=PRECISIONS, help="fp16 and int8 go beside OUT (default fp32)")
    add("--descriptor", choices=(*DESCRIPTORS, "none"), help="of places (default grid)")
    add("--rays", action="store_true", help="put out each pixel's ray (networks of several views)")
    add("--intrinsics", action="store_true", help="put out the camera matrix (networks of several views)")
    add("--name", default="", help="in the model card (default: model and size)")
    add("--scale-bias-sigma", type=float, metavar="S", help=f"of one with metres (default {BIAS_SIGMA})")
    add("--external-data", action="store_true", help="weights in OUT.onnx.data (always so beyond 2 GB)")
    add("--images", nargs="+", type=Path, metavar="PATH", help="files or folders (default: a simulated room)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
