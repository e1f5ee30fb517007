"""DA3-SMALL, real architecture and seeded weights: exported, compared with the package, run by the daemon."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest

from prism_edge.bus.pack import pack
from prism_edge.config import DepthConfig
from prism_edge.depth import open_network
from prism_edge.depth.session import OnnxNetwork
from prism_edge.messages import KeyframeImage
from prism_edge.workers.depth import answer
from tests.end_to_end.processes import prism_edge
from tests.synthetic.network import write_tiny_network
from tests.synthetic.sequence import synthetic_camera, write_sequence
from tests.tools.exporter import CHECKOUT, export, exporter_python, run

pytestmark = pytest.mark.timeout(900)  # five exports, which take two minutes where nothing else runs

PROCESS = CHECKOUT / "tests" / "tools" / "da3_process.py"
SIZES = {"published": (112, 154), "bare.pth": (168, 126)}  # landscape from a folder, portrait from a file
FOCAL = 525.0


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real image where there is one, else a simulated room's."""
    real = CHECKOUT.parent / "shared" / "data" / "7scenes_redkitchen" / "seq-01" / "frame-000200.color.jpg"
    if real.is_file():
        return real
    from prism_edge.sources.sim import SimSource

    path = tmp_path_factory.mktemp("image") / "room.png"
    with SimSource("sim:room?seed=2") as source:
        cv2.imwrite(str(path), source.read().pixels)
    return path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, image: Path) -> tuple[Path, dict]:
    """Folder with the checkpoints and the files, and what the tool printed of them."""
    exporter_python()
    folder = tmp_path_factory.mktemp("da3")
    run(PROCESS, "checkpoint", folder)
    errors = {}
    for i, (source, (height, width)) in enumerate(SIZES.items()):
        arguments = ["--height", height, "--width", width, "--rays", "--intrinsics"]
        arguments += ["--images", image, image, image]
        arguments += ["--precision", "fp32", "fp16", "int8"] if i == 0 else ["--external-data"]
        arguments += ["--model", "da3-small"] if source.endswith(".pth") else []
        errors |= export(folder / source, folder / f"small{i}.onnx", *arguments)
    return folder, errors


def _rgb(image: Path) -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(image))[:, :, ::-1])


@pytest.mark.parametrize("i", [0, 1])
def test_parity_is_printed_for_every_output_and_within_a_ten_thousandth(exported, i: int):
    folder, errors = exported
    graph = onnx.load(folder / f"small{i}.onnx", load_external_data=False).graph
    outputs = {output.name for output in graph.output}
    assert outputs == {"depth", "confidence", "descriptor", "rays", "intrinsics"}
    assert set(errors[f"small{i}.onnx"]) == outputs
    assert max(errors[f"small{i}.onnx"].values()) <= 1e-4


@pytest.mark.parametrize("i", [0, 1])
def test_the_daemons_session_says_what_the_packages_forward_pass_says(exported, image, tmp_path, i: int):
    folder, _ = exported
    height, width = list(SIZES.values())[i]
    run(PROCESS, "reference", folder / "bare.pth", height, width, image, tmp_path / "truth.npz")
    truth = np.load(tmp_path / "truth.npz")
    network = OnnxNetwork(folder / f"small{i}.onnx")
    said, _ = network.raw(_rgb(image))
    assert np.ptp(truth["depth"]) > 0.05 * truth["depth"].mean()  # not a map that any network would give
    assert said.depth == pytest.approx(truth["depth"][0], rel=1e-4)
    assert said.confidence == pytest.approx(truth["confidence"][0], rel=1e-4)
    assert np.linalg.norm(said.descriptor) == pytest.approx(1.0, abs=1e-4)
    seen = network.intrinsics(_rgb(image))
    shape = cv2.imread(str(image)).shape
    expected = truth["intrinsics"][0][[0, 1], [0, 1]] * [shape[1] / width, shape[0] / height]
    assert seen[:2] == pytest.approx(expected, rel=1e-4)
    # As large on the left of the principal point as on the right, pixels counted from their centres.
    assert seen[2:] == pytest.approx([(shape[1] - 1) / 2, (shape[0] - 1) / 2], abs=1e-3)


def test_the_card_says_what_the_file_is(exported):
    folder, _ = exported
    card = OnnxNetwork(folder / "small0.onnx").card
    assert (card.name, card.licence, card.depth_kind) == ("da3_small_112x154", "Apache-2.0", "relative")
    assert card.revision.startswith("sha256:")
    assert (card.rays_output, card.intrinsics_output) == ("rays", "intrinsics")
    assert card.descriptor_pooling == "grid"
    assert card.dsug == (0.07, 0.02)


def test_weights_may_lie_beside_the_graph(exported):
    folder, _ = exported
    assert (folder / "small1.onnx.data").stat().st_size > 50e6
    assert (folder / "small1.onnx").stat().st_size < 5e6
    # whoever may read the one may read the other
    assert (folder / "small1.onnx.data").stat().st_mode == (folder / "small1.onnx").stat().st_mode


@pytest.mark.parametrize(("precision", "bound", "smaller"), [("fp16", 2e-2, 0.55), ("int8", 5e-2, 0.55)])
def test_smaller_files_load_and_agree(exported, image, precision: str, bound: float, smaller: float):
    folder, errors = exported
    path = folder / f"small0_{precision}.onnx"
    assert set(errors[path.name]) == set(errors["small0.onnx"])
    full, less = (OnnxNetwork(file).raw(_rgb(image))[0] for file in (folder / "small0.onnx", path))
    assert less.depth == pytest.approx(full.depth, rel=bound)
    assert less.confidence == pytest.approx(full.confidence, rel=bound)
    assert float(less.descriptor @ full.descriptor) > 0.99
    assert not np.array_equal(less.depth, full.depth)
    assert path.stat().st_size < smaller * (folder / "small0.onnx").stat().st_size


def test_the_worker_answers_a_keyframe_with_it(exported, image, tmp_path):
    """DA3-SMALL has no metres, so it runs in a pair; the descriptor in the message is its own."""
    folder, _ = exported
    metric = write_tiny_network(tmp_path / "metric.onnx")
    spec = f"nested:{folder / 'small0.onnx'},{metric}"
    network = open_network(spec, DepthConfig(model=spec))
    camera = synthetic_camera()
    packed, colour = pack(cv2.resize(cv2.imread(str(image)), (camera.width, camera.height)))
    depth = answer(network, KeyframeImage(3, 9, 10, 0, colour, camera.model, camera.to_array(), packed))
    assert depth.valid, depth.reason
    assert depth.descriptor.shape == (4 * 384,)
    assert np.linalg.norm(depth.descriptor) == pytest.approx(1.0, abs=1e-4)


def test_the_whole_daemon_runs_with_it(exported, tmp_path):
    """Random depths fit no metric ones, so the pair falls back on those; all else is as with true weights."""
    folder, _ = exported
    (tmp_path / "room").mkdir()
    room = write_sequence(tmp_path / "room", 40, 320, 240)
    pair = f"nested:{folder / 'small0.onnx'},{write_tiny_network(tmp_path / 'metric.onnx')}"
    options = ("--lockstep", "--camera", room / "camera.yaml", "--out", tmp_path / "out")
    done = prism_edge("eval", room, "--model", pair, *options, timeout_s=600)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert report["tracked"] >= 35
    assert report["final"]["ate_se3_m"] < 0.05
    assert report["config"]["depth"]["model"] == pair


def test_geometry_is_the_packages_own(exported):
    errors = json.loads(run(PROCESS, "geometry"))
    assert max(errors.values()) < 2e-5, errors


def test_what_is_too_large_for_one_file_becomes_two_in_every_precision(image, tmp_path):
    said = run(PROCESS, "large", tmp_path / "large.onnx", image).splitlines()
    assert said[-1] == "0"
    for name in ("large.onnx", "large_fp16.onnx", "large_int8.onnx"):
        assert (tmp_path / name).stat().st_size < 3e6
        assert (tmp_path / f"{name}.data").stat().st_size > 20e6
        assert OnnxNetwork(tmp_path / name).card.descriptor_output == "descriptor"


def test_what_cannot_be_exported_is_refused_in_one_line_and_leaves_no_file(exported):
    folder, _ = exported
    says = {
        "size": "multiple of 14",
        "no checkpoint": "a checkpoint is needed",
        "no model": "name it with --model",
        "no such file": "there is no such checkpoint",
        "wrong weights": "weights are missing",
        "wrong model": "is not da3-base",
        "another": "is da3-small by its config.json, not da3-base",
        "no metric": "is da3mono-large by its folder's name, not da3metric-large",
        "nested already": "leave --metric out",
        "name": "is no name",
        "sigma": "scale_bias_sigma",
        "no weights": "can't be read as weights",
        "extension": "ending in .onnx",
        "views": "1 to 64",
        "no descriptor": "leave --descriptor out",
        "no intrinsics": "leave --intrinsics out",
        "another's name": "is that of a registered file",
        "two weights": "takes no checkpoint",
        "no metres": "leave --scale-bias-sigma out",
        "images first": "no such file or folder",
        "images": "images are needed",
        "no folder to write to": "/proc",
        "full disk": "File too large",
        "parity": "the file is not kept",
    }
    said = json.loads(run(PROCESS, "refusals", folder))
    assert set(said) == set(says)
    for what, (code, line, left) in said.items():
        assert code != 0, what
        assert says[what] in line, what
        assert "\n" not in line, what
        assert left == 0, what
