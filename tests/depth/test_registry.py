"""The registry: what is in it, what is refused, and that it is found from wherever the package runs."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from prism_edge.depth import registry
from prism_edge.depth.cards import card_of
from prism_edge.depth.registry import entries, find, read_registry, sha256_of
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.vetting import Vetted
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, write_sidecar, write_tiny_network

CHECKOUT = Path(__file__).resolve().parents[2]


def test_the_networks_in_use_are_known():
    fastdepth = find("fastdepth_nyu")
    assert fastdepth is not None
    assert (fastdepth.licence, fastdepth.depth_kind) == ("MIT", "focal_normalised")
    assert fastdepth.card is not None
    assert fastdepth.card.canonical_focal_length == 229.7
    anything = find("depth_anything_v2_small")
    assert anything is not None
    assert anything.card is not None
    assert (anything.licence, anything.depth_kind) == ("Apache-2.0", "inverse_relative")
    assert find("nothing_of_the_kind") is None


def test_checkpoints_that_need_export_say_so_and_name_their_licence():
    exports = [entry for entry in entries() if entry.card is None]
    assert {entry.name for entry in exports} >= {"da3_small", "da3_metric_large", "da3_nested_giant_large"}
    assert all(entry.export and entry.licence for entry in exports)
    assert find("da3_large").licence.startswith("CC-BY-NC")


@pytest.mark.realdata
def test_the_files_at_hand_are_the_registered_ones(shared: Path):
    for entry in entries():
        if entry.card and (shared / "models" / entry.file).is_file():
            assert sha256_of(shared / "models" / entry.file) == entry.card.sha256


def vetted(sha256: str, metadata: dict[str, str]) -> Vetted:
    return Vetted(Path("net.onnx"), sha256, metadata, 13, ())


CARD = {
    "contract": 1,
    "name": "net",
    "revision": "1",
    "licence": "MIT",
    "depth_kind": "relative",
    "input_width": 64,
    "input_height": 64,
    "sha256": "0" * 64,
}
EXPORT = {"name": "later", "licence": "MIT", "depth_kind": "relative", "export": "needs export"}


@pytest.mark.parametrize(
    ("models", "says"),
    [
        ("no list", "no model registry"),
        ([3], "a table"),
        ([{**EXPORT, "licence": ""}], "licence: text"),
        ([{**EXPORT, "licence": None}], "licence: text"),
        ([{**EXPORT, "colour": "red"}], "unknown key 'colour'"),
        ([{**EXPORT, "depth_kind": "deep"}], "none of metric"),
        ([{**EXPORT, "file": "x.onnx"}], "has no file"),
        ([{"name": "x"}], "is missing"),
        ([EXPORT, EXPORT], "listed twice"),
        ([{"file": "x.onnx", "card": {**CARD, "name": "?"}}], "entry 1: name"),
        ([{"file": "../x.onnx", "card": CARD}], "plain file name"),
        ([{"card": CARD}], "plain file name"),
        ([{"file": "x.onnx", "card": {**CARD, "sha256": ""}}], "needs its sha256"),
        ([{"file": "x.onnx", "card": CARD, "export": "y"}], "does not stand beside a card"),
    ],
)
def test_a_broken_registry_is_one_line(tmp_path: Path, models, says):
    path = tmp_path / "registry.yaml"
    path.write_text(yaml.safe_dump({"registry": 1, "models": models}))
    with pytest.raises(ModelError, match=says) as error:
        read_registry(path)
    assert "\n" not in str(error.value)


def test_a_sound_registry_is_read(tmp_path: Path):
    path = tmp_path / "registry.yaml"
    path.write_text(yaml.safe_dump({"registry": 1, "models": [{"file": "x.onnx", "card": CARD}, EXPORT]}))
    assert [entry.name for entry in read_registry(path)] == ["net", "later"]
    path.write_text("registry: 2")
    with pytest.raises(ModelError, match="no model registry"):
        read_registry(path)


def test_a_file_that_bears_a_registered_name_must_be_that_file(tmp_path: Path):
    path = write_tiny_network(tmp_path / "net.onnx", TinyNetwork(name="fastdepth_nyu"))
    with pytest.raises(ModelError, match="calls itself fastdepth_nyu"):
        OnnxNetwork(path)


def test_a_pinned_digest_must_be_the_files(tmp_path: Path):
    path = write_tiny_network(tmp_path / "net.onnx", TinyNetwork(describes_itself=False))
    card = TinyNetwork().card()
    write_sidecar(path, replace(card, sha256="a" * 64))
    with pytest.raises(ModelError, match="its card says aaaaaaaaaaaa"):
        OnnxNetwork(path)
    write_sidecar(path, replace(card, sha256=sha256_of(path)))
    assert OnnxNetwork(path).name == card.name


def test_a_card_may_not_relicense_a_registered_file(tmp_path: Path):
    registered = find("fastdepth_nyu").card
    write_sidecar(tmp_path / "mine.onnx", replace(registered, name="mine", licence="Proprietary"))
    with pytest.raises(ModelError, match="registered under MIT"):
        card_of(tmp_path / "mine.onnx", vetted(registered.sha256, {}))


def test_a_sidecar_goes_before_the_files_own_metadata(tmp_path: Path):
    props = TinyNetwork(name="inner").card().to_metadata()
    assert card_of(tmp_path / "net.onnx", vetted("0" * 64, props)).name == "inner"
    write_sidecar(tmp_path / "net.onnx", TinyNetwork(name="outer").card())
    assert card_of(tmp_path / "net.onnx", vetted("0" * 64, props)).name == "outer"


def test_the_folder_named_by_the_environment_is_looked_in_first(tmp_path: Path, monkeypatch):
    entry = find("fastdepth_nyu")
    monkeypatch.setenv("PRISM_EDGE_MODELS", f"{tmp_path / 'none'}:{tmp_path}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert entry.located() is None
    (tmp_path / entry.file).write_bytes(b"x")
    assert entry.located() == tmp_path / entry.file


def test_the_built_package_carries_the_registry(tmp_path: Path):
    source, built = tmp_path / "source", tmp_path / "built"
    skip = shutil.ignore_patterns("__pycache__")
    for name in ("prism_edge", "models"):
        shutil.copytree(CHECKOUT / name, source / name, ignore=skip)
    for name in ("setup.py", "pyproject.toml"):
        shutil.copy(CHECKOUT / name, source / name)
    (source / "README.md").write_text("The one in the checkout is not needed here.\n")
    build = [sys.executable, "setup.py", "-q", "build", "--build-base", str(tmp_path / "work")]
    _output([*build, "--build-lib", str(built)], source)
    shutil.rmtree(source)
    script = "import prism_edge.depth.registry as r; print(r.data_folder(), *(e.name for e in r.entries()))"
    folder, names = _output([sys.executable, "-c", script], built).split(maxsplit=1)
    assert Path(folder) == built / "prism_edge" / "models"
    assert names.split() == [entry.name for entry in entries()]
    assert registry.data_folder() == CHECKOUT / "models"


def _output(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=120)
    return done.stdout
