"""An onnxruntime session on the first execution provider that really starts.

onnxruntime falls back to the CPU without a word where a provider's libraries are missing, and where a
provider takes none of a network's nodes; here either is noticed, and told.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import onnxruntime

from prism_edge.config import DepthConfig
from prism_edge.depth.folders import cache_home
from prism_edge.depth.inner_tensor import with_output
from prism_edge.depth.vetting import Vetted
from prism_edge.errors import ModelError, first_line
from prism_edge.named_path import named_path

log = logging.getLogger("prism_edge.depth")

CPU = "CPUExecutionProvider"
# Short names in the configuration. Any other provider goes by onnxruntime's name for it.
SHORT = {
    "cpu": CPU,
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "qnn": "QNNExecutionProvider",
}
# What onnxruntime says around the point: its code, the path, the place in its source. That is a path with a
# whole signature (in parentheses, three deep at most), or a file's name with a function's; CUDA's come after.
_ARGUMENTS = r"\((?:[^()]|\((?:[^()]|\([^()]*\))*\))*\)"
_AFTER = rf"(?:::<lambda{_ARGUMENTS}>)?(?: const)?(?: \[with [^]]*\])?"
_AROUND = (
    (re.compile(r"\[ONNXRuntimeError\] : \d+ : \w+ : "), ""),
    (re.compile(r"Load model from .*? failed: ?"), ""),
    (re.compile(r"Non-zero status code .*? running (\w+) node\. Name:'.*?' Status Message: "), r"\1: "),
    (re.compile(rf"/\S+\.(?:cc|h):\d+ [^(]*{_ARGUMENTS}{_AFTER} "), ""),
    (re.compile(r"(?<![\w/.])\w+\.(?:cc|h):\d+ \S+ "), ""),
    (re.compile(r" ; GPU=-?\d+ ; hostname=.*"), ""),
)
_DATA_FOLDER = "session.model_external_initializers_file_folder_path"
_FORMAT = ("session.load_model_format", "ONNX")  # else content or ending may make another of what was vetted
_ERRORS = 3  # of what belongs to no session: a line that names the library which is missing is worth having
_WHOLE_PRODUCTS = ("session.x64quantprecision", "1")
_WHOLE_SINCE = (1, 30)  # before, onnxruntime ends the process at a MatMulInteger without zero points
_QUIET = 4  # onnxruntime's severity "fatal": errors come as exceptions, once, and warnings are harmless


@dataclass(frozen=True)
class Started:
    """A session, the provider that runs most of it, and how many nodes each provider took."""

    session: Any
    provider: str
    nodes: dict[str, int]  # empty where this onnxruntime does not tell


def full_name(name: str, setting: str = "depth.providers") -> str:
    """onnxruntime's name of a provider. Raises ModelError for a name that none can have, in ``setting``."""
    if name.lower() in SHORT:
        return SHORT[name.lower()]
    if name.endswith("ExecutionProvider"):
        return name
    raise ModelError(
        f"{setting}: there is no execution provider {name!r}; take some of {', '.join(SHORT)}, "
        "or onnxruntime's name of another one"
    )


def short_name(name: str) -> str:
    """A provider's name as the configuration has it."""
    return next((short for short, full in SHORT.items() if full == name), name)


def check_names(config: DepthConfig) -> None:
    """Raises ModelError for what is wrong on any machine: names, and options of no such form."""
    asked = {full_name(name) for name in config.providers}
    required = _required(config)
    given_options(config)
    if required - asked:
        raise ModelError(f"depth.required: {_words(required - asked)} is not among depth.providers")


def _required(config: DepthConfig) -> set[str]:
    return {full_name(name, "depth.required") for name in config.required}


def idle_options(config: DepthConfig) -> list[str]:
    """A line where options are given to providers that nobody asks for. ModelError as check_names()."""
    idle = given_options(config).keys() - {full_name(name) for name in (*config.providers, "cpu")}
    return [f"depth.provider_options: {_words(idle)} is not among depth.providers"] if idle else []


def absent(config: DepthConfig) -> list[str]:
    """A line for each provider that must be there and that this onnxruntime lacks."""
    offered = onnxruntime.get_available_providers()
    return [
        f"{lacking(name, offered)}, which depth.required asks for (docs/MODELS.md: how to install it)"
        for name in (full_name(short, "depth.required") for short in config.required)
        if name not in offered
    ]


def lacking(name: str, offered: Sequence[str]) -> str:
    """A line for a provider that is not among those ``offered``."""
    return f"this onnxruntime has no {short_name(name)} provider (it has {_words(offered)})"


def start(
    vetted: Vetted, config: DepthConfig, first_image: Callable[[Started], str], inner: str = ""
) -> None:
    """Loads a vetted network on the first of ``depth.providers`` that runs it, the CPU after all.

    ``inner`` names an inner tensor that becomes one more output. Those behind the provider that starts get
    the nodes that it does not take. A GPU that is full fails at an image only: ``first_image`` takes the
    session for its owner's and says why its first inference fails, letting go of it and so of the GPU's
    memory; nothing where it doesn't. Raises ModelError where a provider that ``depth.required`` names is not
    there or does not run it, or where no provider takes the file.
    """
    failed: list[str] = []
    while True:
        started = _started(vetted, config, inner, failed)
        why, provider = first_image(started), started.provider
        if not why:
            return
        del started  # and with it what it holds of the GPU's memory
        if provider == CPU:  # which nothing stands behind
            raise ModelError(f"{vetted.path.name}: {why}")
        _pass_over(provider, vetted.path, why, _required(config))
        failed.append(provider)


def _started(vetted: Vetted, config: DepthConfig, inner: str, without: Collection[str]) -> Started:
    """Loaded on the first provider that starts; those in ``without`` aren't tried."""
    check_names(config)  # a wrong setting is no fault of the file
    onnxruntime.set_default_logger_severity(_ERRORS)
    names = tuple(dict.fromkeys(full_name(name) for name in (*config.providers, "cpu")))
    required = _required(config)
    if missing := absent(config):
        raise ModelError(missing[0])
    asked = {full_name(name) for name in config.providers}
    offered = onnxruntime.get_available_providers()
    wanted = []
    for name in names:
        if name in without:
            continue
        if name in offered:
            wanted.append(name)
        elif name in asked and not without:  # else that was said the first time
            log.warning("%s; trying the next", lacking(name, offered))
    if inner:
        return _with_inner(vetted, config, wanted, required, inner)
    return _first_that_starts(vetted, config, wanted, required)


def _with_inner(
    vetted: Vetted, config: DepthConfig, wanted: Sequence[str], required: set[str], inner: str
) -> Started:
    try:
        content = with_output(vetted.path.read_bytes(), inner)
        return _first_that_starts(vetted, config, wanted, required, content)
    except OSError as error:
        raise ModelError(f"{vetted.path}: can't be read ({error.strerror})") from None
    except ModelError:
        _first_that_starts(vetted, config, wanted, required)  # says what else may be wrong
        raise ModelError(f"{vetted.path.name}: has no inner tensor {inner!r} (descriptor_layer)") from None


def _first_that_starts(
    vetted: Vetted, config: DepthConfig, wanted: Sequence[str], required: set[str], content: bytes = b""
) -> Started:
    """``content`` stands for the file's own bytes; weights that it refers to stay in the file's folder."""
    path = vetted.path
    for index, name in enumerate(wanted):
        why = ""
        started = None
        try:
            started = _start(path, config, wanted[index:], content)
            why = "" if started.provider == name else "it did not start, or took none of the network"
        except Exception as error:  # onnxruntime's exceptions have no common root of their own
            why = native_line(error)
        if started is not None and not why:
            return started
        if name == CPU:  # what the CPU can't load is no network
            version = f"onnxruntime {onnxruntime.__version__}"
            raise ModelError(f"{path}: no ONNX model that {version} can load (opset {vetted.opset}; {why})")
        _pass_over(name, path, why, required)
    raise ModelError(f"{path}: this onnxruntime has not even a CPU provider")


def _pass_over(name: str, path: Path, why: str, required: set[str]) -> None:
    if name in required:
        raise ModelError(f"{short_name(name)} is required, but can't run {path.name}: {why}")
    log.warning("%s does not run %s: %s; trying the next", short_name(name), path.name, why)


def _start(path: Path, config: DepthConfig, names: Sequence[str], content: bytes) -> Started:
    if set(names) & {SHORT["cuda"], SHORT["tensorrt"]}:
        _preload()
    providers = [(name, provider_options(name, config)) for name in names]
    options = session_options(config)
    if content:
        options.add_session_config_entry(_DATA_FOLDER, str(path.parent))
    session = onnxruntime.InferenceSession(content or str(path), options, providers, enable_fallback=0)
    nodes = _nodes(session)
    running = session.get_providers()[0]
    if nodes and not nodes.get(running):
        running = max(nodes, key=lambda name: nodes[name])
    return Started(session, running, nodes)


@cache
def _preload() -> None:
    """Loads CUDA and cuDNN as pip installs them, which are on no library path."""
    preload = getattr(onnxruntime, "preload_dlls", None)  # not before 1.21
    if preload is not None:
        said = io.StringIO()  # it prints what it did not find
        with contextlib.redirect_stdout(said):
            preload()
        for line in said.getvalue().splitlines():
            log.debug("%s", line)


def ask_for_whole_products(options: Any) -> bool:
    """Else sums of int8 products overflow on x86 without VNNI; whether this onnxruntime may be asked.

    There it costs a tenth of the time, elsewhere none.
    """
    may_be = tuple(map(int, re.findall(r"[0-9]+", onnxruntime.__version__)[:2])) >= _WHOLE_SINCE
    if may_be:
        options.add_session_config_entry(*_WHOLE_PRODUCTS)
    return may_be


def session_options(config: DepthConfig) -> Any:
    """The session options that the configuration sets."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _QUIET
    options.add_session_config_entry(*_FORMAT)
    ask_for_whole_products(options)
    options.intra_op_num_threads = config.threads
    options.inter_op_num_threads = 1
    options.enable_cpu_mem_arena = config.arena
    # Idle threads that spin would take a core each between keyframes.
    spinning = "1" if config.spinning else "0"
    options.add_session_config_entry("session.intra_op.allow_spinning", spinning)
    options.add_session_config_entry("session.inter_op.allow_spinning", spinning)
    options.add_session_config_entry("session.record_ep_graph_assignment_info", "1")
    return options


def provider_options(name: str, config: DepthConfig) -> dict[str, str]:
    """Options of one provider: engine cache and threads, then what ``depth.provider_options`` sets.

    Raises ModelError as :func:`given_options` does.
    """
    options: dict[str, str] = {}
    if name == SHORT["tensorrt"]:
        cache = str(engine_cache(config))
        options = {"trt_engine_cache_enable": "1", "trt_engine_cache_path": cache}
        options |= {"trt_timing_cache_enable": "1", "trt_timing_cache_path": cache}
    elif name == SHORT["openvino"]:
        options = {"cache_dir": str(engine_cache(config)), "num_of_threads": str(config.threads)}
    elif name == SHORT["qnn"]:
        options = {"backend_path": "QnnHtp.dll" if os.name == "nt" else "libQnnHtp.so"}
    return options | given_options(config).get(name, {})


def given_options(config: DepthConfig) -> dict[str, dict[str, str]]:
    """What ``depth.provider_options`` sets, by provider; ModelError for one that is no PROVIDER.KEY=VALUE."""
    options: dict[str, dict[str, str]] = {}
    for item in config.provider_options:
        place, equals, value = item.partition("=")
        provider, dot, key = place.partition(".")
        if not (equals and dot and key.strip()):
            raise ModelError(f"depth.provider_options: {item!r} is not of the form PROVIDER.KEY=VALUE")
        name = full_name(provider.strip(), "depth.provider_options")
        options.setdefault(name, {})[key.strip()] = value.strip()
    return options


def with_own_engines(config: DepthConfig, fingerprint: str) -> DepthConfig:
    """The configuration with a folder of engines for one network alone.

    TensorRT's provider knows a network by the names of its file and nodes: it would run the engine of one
    with other weights, exported or trained anew under the same name.
    """
    return replace(config, engine_cache=str(_engines(config) / fingerprint))


def engine_cache(config: DepthConfig) -> Path:
    """The folder of engines that TensorRT and OpenVINO compile; made, for this user alone.

    Engines are machine code that is run unchecked: nobody else may write there, nor put another folder in its
    place. Raises ModelError where the folder can't be made.
    """
    folder = _engines(config)
    try:
        for made in (folder.parent, folder):
            made.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ModelError(f"depth.engine_cache: {folder} can't be made ({error.strerror})") from None
    return folder


def _engines(config: DepthConfig) -> Path:
    return named_path(config.engine_cache) if config.engine_cache else cache_home() / "engines"


def _nodes(session: Any) -> dict[str, int]:
    """How many nodes each provider runs; empty where this onnxruntime can't tell (before 1.24)."""
    tell = getattr(session, "get_provider_graph_assignment_info", None)
    if tell is None:
        return {}
    try:
        counts = Counter()  # type: Counter[str]
        for part in tell():
            counts[part.ep_name] += len(part.get_nodes())
    except Exception:  # a preview of onnxruntime's API: without it, nothing is lost but the count
        return {}
    return dict(counts)


def _words(names: Sequence[str] | set[str]) -> str:
    return ", ".join(short_name(name) for name in sorted(names))


def native_line(error: Exception) -> str:
    """An exception of native code in one line, without what onnxruntime says around it."""
    line = " ".join(first_line(error).split())
    for pattern, instead in _AROUND:
        line = pattern.sub(instead, line)
    return line[:200]
