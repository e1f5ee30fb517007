"""Execution providers, by fakes at onnxruntime's border that fail as the real ones were seen to fail."""

from __future__ import annotations

import logging
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from prism_edge.config import DepthConfig
from prism_edge.depth import providers
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, write_sidecar, write_tiny_network

CPU, CUDA, TENSORRT = "CPUExecutionProvider", "CUDAExecutionProvider", "TensorrtExecutionProvider"
OPENVINO, QNN = "OpenVINOExecutionProvider", "QNNExecutionProvider"
Real = onnxruntime.InferenceSession
# What a GPU said that had 700 MB left when the network was loaded.
NO_MEMORY = (
    "[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : Non-zero status code returned while running Clip node. "
    "Name:'clip_7' Status Message: Failed to allocate memory for requested buffer of size 451584"
)
FAINTED = "the first inference failed (Clip: Failed to allocate memory for requested buffer of size 451584)"


class Border:
    """An onnxruntime that offers more providers than this one has; what they run, the CPU really runs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **behaviour: str) -> None:
        """Each of ``behaviour`` is there: it starts, raises, is silent (falls back), is idle, or faints."""
        self.behaviour = {providers.SHORT[name]: how for name, how in behaviour.items()}
        self.asked: list[list[str]] = []
        self.options: dict[str, dict[str, str]] = {}
        offered = [*self.behaviour, CPU]
        monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: offered)
        monkeypatch.setattr(onnxruntime, "InferenceSession", self.open)
        monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: None, raising=False)

    def open(self, path: str, options: object, given: list[tuple[str, dict[str, str]]], **more: object):
        names = [name for name, _ in given]
        assert set(names) <= {*self.behaviour, CPU}, "onnxruntime refuses a provider that it does not have"
        self.asked.append(names)
        self.options.update(dict(given))
        if self.behaviour.get(names[0]) == "raises":
            raise RuntimeError("Please install TensorRT libraries as mentioned\nand more")
        real = Real(path, options, [CPU])
        running = [name for name in names if self.behaviour.get(name) != "silent"]
        taking = [name for name in running if self.behaviour.get(name) != "idle"]
        tell = getattr(real, "get_provider_graph_assignment_info", None)  # not before 1.24
        nodes = sum(len(part.get_nodes()) for part in tell()) if tell is not None else 4
        split = {taking[0]: nodes - 1, CPU: 1} if taking[0] != CPU else {CPU: nodes}
        parts = [SimpleNamespace(ep_name=n, get_nodes=lambda c=c: [None] * c) for n, c in split.items()]
        return SimpleNamespace(
            get_providers=lambda: running,
            get_provider_graph_assignment_info=lambda: parts,
            get_inputs=real.get_inputs,
            get_outputs=real.get_outputs,
            run=self.faint if self.behaviour.get(names[0]) == "faints" else real.run,
        )

    def faint(self, *of_whatever: object) -> None:
        raise RuntimeError(NO_MEMORY)


@pytest.fixture
def network(tmp_path: Path) -> Path:
    return write_tiny_network(tmp_path / "tiny.onnx")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "prism-edge" / "engines"


@pytest.mark.parametrize(
    ("there", "expected"),
    [
        ({"tensorrt": "starts", "cuda": "starts"}, TENSORRT),
        ({"tensorrt": "raises", "cuda": "starts"}, CUDA),
        ({"tensorrt": "silent", "cuda": "starts"}, CUDA),
        ({"tensorrt": "idle", "cuda": "starts"}, CUDA),
        ({"tensorrt": "raises", "cuda": "silent"}, CPU),
        ({"tensorrt": "faints", "cuda": "starts"}, CUDA),
        ({"tensorrt": "faints", "cuda": "faints"}, CPU),
        ({"cuda": "starts"}, CUDA),
        ({}, CPU),
    ],
)
def test_they_are_tried_in_order_and_the_one_really_used_is_named(network, monkeypatch, there, expected):
    Border(monkeypatch, **there)
    opened = OnnxNetwork(network, DepthConfig(providers=("tensorrt", "cuda", "cpu")))
    assert opened.provider == expected
    assert opened.nodes[expected] == max(opened.nodes.values())
    assert opened.counters == ({"nodes_elsewhere": 1} if expected != CPU else {})


def test_the_configured_order_is_the_order(network, monkeypatch):
    border = Border(monkeypatch, cuda="starts", openvino="starts")
    assert OnnxNetwork(network, DepthConfig(providers=("openvino", "cuda"))).provider == OPENVINO
    # those behind it get the nodes that it does not take
    assert border.asked == [[OPENVINO, CUDA, CPU]]


def test_one_that_is_not_there_is_passed_over_with_a_warning(network, monkeypatch, caplog):
    Border(monkeypatch, openvino="silent")
    with caplog.at_level(logging.WARNING, "prism_edge.depth"):
        assert OnnxNetwork(network, DepthConfig(providers=("qnn", "openvino"))).provider == CPU
    assert [record.getMessage().split(";")[0] for record in caplog.records] == [
        "this onnxruntime has no qnn provider (it has cpu, openvino)",
        "openvino does not run tiny.onnx: it did not start, or took none of the network",
    ]


def test_one_that_starts_and_fails_at_an_image_is_passed_over_with_a_warning(network, monkeypatch, caplog):
    border = Border(monkeypatch, cuda="faints", openvino="starts")
    with caplog.at_level(logging.WARNING, "prism_edge.depth"):
        opened = OnnxNetwork(network, DepthConfig(providers=("qnn", "cuda", "openvino")))
    assert opened.provider == OPENVINO
    assert border.asked == [[CUDA, OPENVINO, CPU], [OPENVINO, CPU]]
    assert [record.getMessage() for record in caplog.records] == [
        "this onnxruntime has no qnn provider (it has cpu, cuda, openvino); trying the next",
        f"cuda does not run tiny.onnx: {FAINTED}; trying the next",
    ]


@pytest.mark.parametrize(
    ("there", "says"),
    [
        ({}, "has no cuda provider .* depth.required asks for"),
        ({"cuda": "raises"}, "cuda is required, but can't run tiny.onnx: Please install TensorRT libraries"),
        ({"cuda": "silent"}, "cuda is required, but can't run tiny.onnx: it did not start"),
        ({"cuda": "idle"}, "cuda is required, but .* took none of the network"),
        ({"cuda": "faints"}, f"^cuda is required, but can't run tiny.onnx: {re.escape(FAINTED)}$"),
    ],
)
def test_a_required_one_that_is_not_there_is_an_error(network, monkeypatch, there, says):
    Border(monkeypatch, **there)
    with pytest.raises(ModelError, match=says) as error:
        OnnxNetwork(network, DepthConfig(providers=("cuda", "cpu"), required=("cuda",)))
    assert "\n" not in str(error.value)


def test_a_required_one_that_starts_is_no_error(network, monkeypatch):
    Border(monkeypatch, cuda="starts")
    config = DepthConfig(providers=("tensorrt", "cuda"), required=("CUDAExecutionProvider",))
    assert OnnxNetwork(network, config).provider == CUDA


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (DepthConfig(providers=("abacus",)), "no execution provider 'abacus'; take some of cpu, cuda"),
        (DepthConfig(required=("cuda",)), "cuda is not among depth.providers"),
        (DepthConfig(provider_options=("cpu",)), "^depth.provider_options: 'cpu' is not .* PROVIDER.KEY"),
        (DepthConfig(provider_options=("cpu.=1",)), "PROVIDER.KEY=VALUE"),
        (DepthConfig(provider_options=("abacus.rods=9",)), "^depth.provider_options: .* provider 'abacus'"),
        (DepthConfig(required=("abacus",)), "^depth.required: there is no execution provider 'abacus'"),
    ],
)
def test_a_wrong_setting_is_one_line(network, config, says):
    with pytest.raises(ModelError, match=says) as error:
        OnnxNetwork(network, config)
    assert "\n" not in str(error.value)


def test_the_real_cpu_is_there_whatever_is_asked_for(network):
    lacking = {name: providers.SHORT[name] for name in ("cuda", "qnn")}.items()
    absent = [name for name, full in lacking if full not in onnxruntime.get_available_providers()]
    for wanted in ((), ("cpu",), (*absent, "MIGraphXExecutionProvider")):
        opened = OnnxNetwork(network, DepthConfig(providers=wanted))
        assert opened.provider == CPU
        assert set(opened.nodes) <= {CPU}


def test_engines_are_kept_where_the_configuration_says(network, monkeypatch, cache: Path, tmp_path: Path):
    border = Border(monkeypatch, tensorrt="starts", openvino="starts")
    own = OnnxNetwork(network, DepthConfig(providers=("tensorrt", "openvino"), threads=3)).fingerprint
    assert border.options[TENSORRT]["trt_engine_cache_path"] == str(cache / own)
    assert border.options[OPENVINO] == {"cache_dir": str(cache / own), "num_of_threads": "3"}
    for folder in (cache, cache / own):
        assert folder.stat().st_mode & 0o777 == 0o700
    OnnxNetwork(network, DepthConfig(providers=("tensorrt",), engine_cache=str(tmp_path / "mine")))
    assert border.options[TENSORRT]["trt_engine_cache_path"] == str(tmp_path / "mine" / own)
    (tmp_path / "file").write_text("")
    with pytest.raises(ModelError, match="can't be made"):
        providers.engine_cache(DepthConfig(engine_cache=str(tmp_path / "file" / "below")))


def test_no_engine_is_taken_of_another_network_of_the_same_name(monkeypatch, tmp_path: Path):
    """TensorRT's provider tells them by the names of the file and its nodes; weights may differ."""
    border, folders = Border(monkeypatch, tensorrt="starts"), []
    for gain, layer in ((1.0, ""), (1.3, ""), (1.3, "small"), (1.3, "log_depth")):
        what = TinyNetwork(gain=gain)
        path = write_tiny_network(tmp_path / "net.onnx", what)
        if layer:
            write_sidecar(path, replace(what.card(), descriptor_layer=layer, descriptor_pooling="mean"))
        OnnxNetwork(path, DepthConfig(providers=("tensorrt",)))
        folders.append(border.options[TENSORRT]["trt_engine_cache_path"])
    assert len(set(folders)) == 4


def test_no_folder_is_made_that_nobody_needs(network, cache: Path):
    OnnxNetwork(network)
    assert not cache.exists()


def test_options_reach_their_provider_alone(network, monkeypatch):
    border = Border(monkeypatch, cuda="starts", qnn="silent")
    options = ("cuda.device_id=1", "qnn.backend_path=/opt/qnn/lib.so", "cuda.gpu_mem_limit = 5")
    OnnxNetwork(network, DepthConfig(providers=("qnn", "cuda"), provider_options=options))
    assert border.options[CUDA] == {"device_id": "1", "gpu_mem_limit": "5"}
    assert border.options[QNN] == {"backend_path": "/opt/qnn/lib.so"}
    assert border.options[CPU] == {}


def test_qualcomm_s_library_is_that_of_this_system(network, monkeypatch):
    border = Border(monkeypatch, qnn="starts")
    OnnxNetwork(network, DepthConfig(providers=("qnn",)))
    assert border.options[QNN] == {"backend_path": "libQnnHtp.so"}, "and on Windows it is a DLL"


def test_options_of_a_provider_that_is_not_asked_for_are_told():
    options = ("cuda.device_id=1", "cpu.x=1")
    (said,) = providers.idle_options(DepthConfig(provider_options=options))
    assert said == "depth.provider_options: cuda is not among depth.providers"
    assert not providers.idle_options(DepthConfig(provider_options=options, providers=("cuda",)))


def test_session_options_are_the_configured_ones():
    options = providers.session_options(DepthConfig(threads=3, spinning=True, arena=False))
    assert (options.intra_op_num_threads, options.enable_cpu_mem_arena) == (3, False)
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "1"
    default = providers.session_options(DepthConfig())
    assert (default.intra_op_num_threads, default.enable_cpu_mem_arena) == (1, True)
    assert default.get_session_config_entry("session.intra_op.allow_spinning") == "0"


def test_int8_products_do_not_overflow_whatever_the_cpu():
    """Two products of bytes are more than the 16 bits that x86 without VNNI has for their sum."""
    weights = numpy_helper.from_array(np.full((64, 8), 127, np.int8), "weights")
    node = helper.make_node("MatMulInteger", ["image", "weights"], ["sums"])
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, [4, 64])
    sums = helper.make_tensor_value_info("sums", TensorProto.INT32, [4, 8])
    graph = helper.make_graph([node], "sums", [image], [sums], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    options = providers.session_options(DepthConfig())
    if not providers.ask_for_whole_products(options):
        pytest.skip("an onnxruntime that ends the process where it is asked for whole products")
    session = Real(model.SerializeToString(), options, providers=[CPU])
    (found,) = session.run(None, {"image": np.full((4, 64), 255, np.uint8)})
    assert (found == 64 * 255 * 127).all()


@pytest.mark.parametrize(
    ("version", "asked"), [("1.20.0", False), ("1.29.9", False), ("1.30.0", True), ("2.0.0.dev1", True)]
)
def test_an_onnxruntime_that_whole_products_would_end_is_not_asked_for_them(version, asked, monkeypatch):
    monkeypatch.setattr(providers.onnxruntime, "__version__", version)
    entries = {}
    options = SimpleNamespace(add_session_config_entry=entries.__setitem__)
    assert providers.ask_for_whole_products(options) == asked
    assert entries == ({"session.x64quantprecision": "1"} if asked else {})


def test_an_onnxruntime_that_can_not_count_nodes_is_used_all_the_same(network, monkeypatch):
    border = Border(monkeypatch, cuda="starts")
    opened = border.open

    def older(*arguments: object, **more: object):
        session = opened(*arguments, **more)
        del session.get_provider_graph_assignment_info
        return session

    monkeypatch.setattr(onnxruntime, "InferenceSession", older)
    network_opened = OnnxNetwork(network, DepthConfig(providers=("cuda",)))
    assert (network_opened.provider, network_opened.nodes) == (CUDA, {})


def test_every_node_of_a_real_network_is_counted(network):
    import onnx

    if not hasattr(Real, "get_provider_graph_assignment_info"):
        pytest.skip(f"onnxruntime {onnxruntime.__version__} does not tell")
    graph = Counter(node.op_type for node in onnx.load(network).graph.node)
    assert 0 < OnnxNetwork(network).nodes[CPU] <= graph.total()  # nodes are fused when loading


CODE = "[ONNXRuntimeError] : 1 : FAIL : "
SOURCE = "/onnxruntime_src/onnxruntime/core"
TABLE = "const std::unordered_map<std::__cxx11::basic_string<char>, int>&"
NODES = "const std::vector<const Node*>&, const std::function<bool(const std::basic_string<char>&)>&"


@pytest.mark.parametrize(
    ("said", "line"),
    [
        (
            f"{CODE}Load model from /a/b c.onnx failed:{SOURCE}/graph/model.cc:256 onnxruntime::Model::Model("
            "onnx::ModelProto&&, const ModelOptions&) Unsupported model IR version: 99\n",
            "Unsupported model IR version: 99",
        ),
        (
            f"{CODE}Load model from /a/b.onnx failed:{SOURCE}/graph/graph.cc:1421 onnxruntime::Graph::Graph("
            f"const onnxruntime::Model&, {TABLE}, bool) !utils::InMemory(tensor) was false. It is not.",
            "!utils::InMemory(tensor) was false. It is not.",
        ),
        (
            f"{CODE}Exception during initialization: {SOURCE}/optimizer/frame.cc:74 Info::Info({NODES}) "
            f"{CODE}env.cc:538 OpenRandomAccessFile Random-access reads require a file (not a pipe)",
            "Exception during initialization: Random-access reads require a file (not a pipe)",
        ),
        (f"{CODE}tensorprotoutils.cc:2276 ToTensorProto Constant node ''", "Constant node ''"),
        (f"{CODE}External: big. Error: utils.cc:434 Validate Absolute", "External: big. Error: Absolute"),
        (f"{CODE}inference_session.cc:2226 operator() ORT model failed.", "ORT model failed."),
        (
            f"{CODE}Non-zero status code returned while running Add node. Name:'x' Status Message: "
            f"{SOURCE}/a/b.h:9 T onnxruntime::f(int) const [with T = int; U = bool] axis == 1 fails. (no)",
            "Add: axis == 1 fails. (no)",
        ),
        (f"{CODE}{SOURCE}/a/b.cc:9 onnxruntime::f(int)::<lambda(const A&, B)> no", "no"),
        (
            f"{CODE}CUDA failure 100: no CUDA-capable device is detected ; GPU=-1 ; hostname=vm ; "
            f"file={SOURCE}/providers/cuda/cuda.cc ; line=355 ; expr=cudaSetDevice(info_.device_id);",
            "CUDA failure 100: no CUDA-capable device is detected",
        ),
        (
            f"Exception during initialization: CUBLAS failure 3: no ; GPU=0 ; hostname=vm ; file={SOURCE} ; ",
            "Exception during initialization: CUBLAS failure 3: no",
        ),
        ("Conv (node) has (a shape) that /is/not.h so", "Conv (node) has (a shape) that /is/not.h so"),
        ("/a/b.cc:9 f" + "(x" * 5000, "/a/b.cc:9 f" + ("(x" * 5000)[:189]),
    ],
)
def test_an_error_is_one_line_without_onnxruntimes_own_source(said: str, line: str):
    assert providers.native_line(RuntimeError(said)) == line


def test_what_pip_installed_for_cuda_is_loaded_and_what_that_prints_stays_away(monkeypatch, capsys):
    loaded = []

    def preload() -> None:
        loaded.append(1)
        print("no cuDNN")

    monkeypatch.setattr(onnxruntime, "preload_dlls", preload, raising=False)
    providers._preload.__wrapped__()
    assert loaded == [1]
    assert capsys.readouterr().out == ""
    monkeypatch.delattr(onnxruntime, "preload_dlls")
    providers._preload.__wrapped__()  # an older onnxruntime has no such thing
