"""A checkpoint of prism-nano as the ONNX file that the daemon runs, with its model card inside.

    python -m tools.train_nano.export CHECKPOINT FILE.onnx --learned DATA --held-out DATA [--revision TEXT]

Sets the level of depth by whole pictures of the worlds learned from, since training saw crops. Measures on
the held-out worlds what the card must say (the bias of a world's scale; the gate's threshold and softness),
writes depth, confidence = 1 / expected relative error, and descriptor, and compares the file's answers with
PyTorch's on rendered pictures: where they differ, nothing is left behind.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import onnx
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from prism_edge.depth.contract import FOCAL_NORMALISED, ModelCard
from prism_edge.depth.prediction import OPEN
from tools.train_nano.judge import Verdict, judge
from tools.train_nano.network import Exported, Nano
from tools.train_nano.parity import relative_difference
from tools.train_nano.pictures import Views
from tools.train_nano.ruler import CANONICAL_FOCAL, HEIGHT, MEAN, STD, WIDTH

# isort: split
import onnxruntime  # after prism_edge, which keeps it from reporting to its makers

TOLERANCE = 1e-3  # largest relative difference from PyTorch
LEAST_BIAS = 0.05  # simulated rooms are more alike than real ones: never claim less
OUTPUTS = ("depth", "confidence", "descriptor")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("--learned", type=Path, required=True, help="folder of the worlds learned from")
    parser.add_argument("--held-out", type=Path, required=True, help="folder of the worlds judged on")
    parser.add_argument("--revision", default="1")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network = Nano()
    network.load_state_dict(torch.load(arguments.checkpoint, weights_only=True)["mean"])
    network.eval()
    set_level(network, judge(network, Views(arguments.learned), WIDTH, HEIGHT).scale_mean)
    views = Views(arguments.held_out)
    verdict = judge(network, views, WIDTH, HEIGHT)
    print(verdict.words())
    write(network, views, card(verdict, arguments.revision), arguments.file)
    print(f"{arguments.file}: {arguments.file.stat().st_size / 1e6:.2f} MB")


@torch.no_grad()
def set_level(network: Nano, log_ratio: float) -> None:
    """Adds to log depth what was missing: the mean log of true over predicted."""
    print(f"log depth: {log_ratio:+.3f}")
    last = network.head[-1]
    last.bias[: last.out_channels // 2] += log_ratio


def card(verdict: Verdict, revision: str) -> ModelCard:
    """The model card for a network so judged."""
    return ModelCard(
        name="prism_nano",
        revision=revision,
        licence="Apache-2.0",
        depth_kind=FOCAL_NORMALISED,
        input_width=WIDTH,
        input_height=HEIGHT,
        source="trained by prism_edge on pictures of its own simulator: for simulated rooms",
        input_name="image",
        mean=MEAN,
        std=STD,
        depth_output=OUTPUTS[0],
        confidence_output=OUTPUTS[1],
        confidence_kind=OPEN,
        descriptor_output=OUTPUTS[2],
        canonical_focal_length=CANONICAL_FOCAL,
        scale_bias_sigma=round(max(LEAST_BIAS, verdict.world_spread), 3),
        dsug_tau=round(verdict.error_median, 3),
        dsug_temperature=round(0.3 * verdict.error_median, 3),
    )


def write(network: Nano, views: Views, described: ModelCard, file: Path) -> None:
    """Exports and compares. Raises SystemExit, and leaves no file, where the answers differ."""
    part = file.with_suffix(".part")
    example = torch.zeros(1, 3, HEIGHT, WIDTH)
    exported = Exported(network.to(memory_format=torch.contiguous_format)).eval()
    torch.onnx.export(
        exported, (example,), str(part), input_names=["image"], output_names=list(OUTPUTS), dynamo=False
    )
    model = onnx.load(str(part))
    used = {name for node in model.graph.node for name in node.input}
    kept = [weights for weights in model.graph.initializer if weights.name in used]
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)
    for node in model.graph.node:
        node.ClearField("doc_string")
    for key, value in described.to_metadata().items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.checker.check_model(model)
    onnx.save(model, str(part))
    worst = difference(exported, part, views.whole(np.arange(0, views.pose_count, 97), WIDTH, HEIGHT).image)
    if worst > TOLERANCE:
        part.unlink()
        raise SystemExit(f"the file differs from PyTorch by {worst:.1e}: not kept")
    print(f"largest relative difference from PyTorch: {worst:.1e}")
    part.replace(file)


@torch.no_grad()
def difference(exported: Exported, file: Path, images: np.ndarray) -> float:
    """The largest difference of any output from PyTorch's, relative to that output's largest value."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    worst = 0.0
    for image in images:
        expected = exported(torch.from_numpy(image[None]))
        answer = session.run(list(OUTPUTS), {"image": image[None]})
        for a, b in zip(answer, expected, strict=True):
            worst = max(worst, relative_difference(a, b.numpy()))
    return worst


if __name__ == "__main__":
    main()
