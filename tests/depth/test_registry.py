"""The registry: what is in it, what is refused, and that it is found from wherever the package runs."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from prism_edge.depth import cards, registry
from prism_edge.depth.cards import card_of
from prism_edge.depth.registry import (
    File,
    entries,
    find,
    is_non_commercial,
    read_registry,
    sha256_of,
)
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
    depth_anything_3 = {"da3_small", "da3_base", "da3_large", "da3_metric_large", "da3_mono_large"}
    for entry in exports:
        if entry.name in depth_anything_3 | {"da3_nested_giant_large"}:
            assert entry.can_be_pulled
            assert all(file.url.startswith(entry.source + "/") for file in entry.files)
    assert {entry.name for entry in exports} >= depth_anything_3


@pytest.mark.parametrize(
    ("licence", "forbids"),
    [
        ("CC-BY-NC-4.0", True),
        ("CC BY-NC 4.0", True),
        ("cc-by-nc-sa-4.0", True),
        ("Non-commercial, research use", True),
        ("Apache-2.0", False),
        ("MIT", False),
        ("CC-BY-4.0", False),
        ("NCSA", False),
        ("", False),
    ],
)
def test_a_licence_that_forbids_commercial_use_is_known_by_its_name(licence: str, forbids: bool):
    assert is_non_commercial(licence) is forbids


@pytest.mark.realdata
def test_the_files_at_hand_are_the_registered_ones(shared: Path):
    at_hand = {shared / "models" / entry.file: entry.card.sha256 for entry in entries() if entry.card}
    at_hand = {file: sha256 for file, sha256 in at_hand.items() if file.is_file()}
    assert at_hand
    assert {file: sha256_of(file) for file in at_hand} == at_hand


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
KIND = {"kind": "checkpoint", "depth_kind": "relative"}
EXPORT = {**KIND, "name": "later", "licence": "MIT", "export": "needs export"}
WEIGHTS = {"file": "x.onnx.data", "sha256": "1" * 64, "size": 5, "url": "https://example.org/x.onnx.data"}


@pytest.mark.parametrize(
    ("models", "says"),
    [
        ("no list", "no model registry"),
        ([3], "a table"),
        ([{**EXPORT, "licence": ""}], "licence: text"),
        ([{**EXPORT, "licence": None}], "licence: text"),
        ([{**EXPORT, "colour": "red"}], "unknown key 'colour'"),
        ([{**EXPORT, "depth_kind": "deep"}], "none of metric"),
        ([{**EXPORT, "file": "x.onnx"}], "unknown key 'file' of kind checkpoint"),
        ([{**EXPORT, "kind": "engine"}], "none of onnx, checkpoint"),
        ([{**EXPORT, "kind": ["onnx"]}], "none of onnx, checkpoint"),
        ([{**EXPORT, "name": "a/b"}], "is no name"),
        ([{**EXPORT, "files": "x"}], "a list of files"),
        ([{**EXPORT, "files": ["x"]}], "keys file, sha256, size, url"),
        ([{**EXPORT, "files": [{"file": "../x"}]}], "plain file name"),
        ([{**EXPORT, "files": [{"file": "x", "url": "ftp://example.org/x"}]}], "no http or https URL"),
        ([{**EXPORT, "files": [{"file": "x", "url": 3}]}], "url: text"),
        ([{**EXPORT, "files": [{"file": "x", "size": -1}]}], "size: a number of bytes"),
        ([{**EXPORT, "files": [{"file": "x", "sha256": "abc"}]}], "64 hexadecimal"),
        ([{**KIND, "name": "x"}], "'licence' is missing"),
        ([{"file": "x.onnx"}], "'card' is missing"),
        ([{"file": "x.onnx", "card": CARD, "data": [{"file": "x.data"}]}], "needs its sha256"),
        ([{"file": "x.onnx", "card": CARD, "url": "x"}], "no http or https URL"),
        ([EXPORT, EXPORT], "listed twice"),
        ([{"file": "x.onnx", "card": {**CARD, "name": "?"}}], "entry 1: name"),
        ([{"file": "../x.onnx", "card": CARD}], "plain file name"),
        ([{"card": CARD}], "plain file name"),
        ([{"file": "x.onnx", "card": {**CARD, "sha256": ""}}], "needs its sha256"),
        ([{"file": "x.onnx", "card": CARD, "export": "y"}], "unknown key 'export' of kind onnx"),
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
    whole = {"file": "x.onnx", "card": CARD, "data": [WEIGHTS], "url": "https://example.org/x.onnx"}
    path.write_text(yaml.safe_dump({"registry": 1, "models": [whole]}))
    (entry,) = read_registry(path)
    assert entry.files == (
        File("x.onnx", "0" * 64, 0, "https://example.org/x.onnx"),
        File("x.onnx.data", "1" * 64, 5, "https://example.org/x.onnx.data"),
    )
    assert entry.can_be_pulled
    assert entry.is_pinned
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


@pytest.mark.parametrize("registered", [False, True])
def test_a_file_that_nothing_describes_is_refused_in_a_sentence(tmp_path: Path, monkeypatch, registered):
    if registered:  # by its digest alone
        bare = replace(find("fastdepth_nyu"), card=None)
        monkeypatch.setattr(cards, "find_digest", lambda digest: bare)
    with pytest.raises(ModelError, match=r"does not say what it predicts; describe it in net\.onnx\.yaml"):
        card_of(tmp_path / "net.onnx", vetted("0" * 64, {}))


def test_a_sidecar_goes_before_the_files_own_metadata(tmp_path: Path):
    props = TinyNetwork(name="inner").card().to_metadata()
    assert card_of(tmp_path / "net.onnx", vetted("0" * 64, props)).name == "inner"
    write_sidecar(tmp_path / "net.onnx", TinyNetwork(name="outer").card())
    assert card_of(tmp_path / "net.onnx", vetted("0" * 64, props)).name == "outer"


def test_a_link_has_the_sidecar_beside_what_it_leads_to_or_one_of_its_own(tmp_path: Path):
    (tmp_path / "v3").mkdir()
    target, link = tmp_path / "v3" / "net.onnx", tmp_path / "current.onnx"
    target.write_bytes(b"")
    link.symlink_to("v3/net.onnx")
    props = TinyNetwork(name="inner").card().to_metadata()
    assert card_of(link, vetted("0" * 64, props)).name == "inner"
    write_sidecar(target, TinyNetwork(name="outer").card())
    assert card_of(link, vetted("0" * 64, props)).name == "outer"
    write_sidecar(link, TinyNetwork(name="links_own").card())
    assert card_of(link, vetted("0" * 64, props)).name == "links_own"
    top = tmp_path / "v3" / "top.onnx"
    top.symlink_to("../current.onnx")
    assert card_of(top, vetted("0" * 64, props)).name == "links_own", "each link on the way is asked"
    folder = tmp_path / "newest"
    folder.symlink_to("v3", target_is_directory=True)
    assert card_of(folder / "net.onnx", vetted("0" * 64, props)).name == "outer"


def test_a_sidecar_that_leads_nowhere_is_not_passed_over(tmp_path: Path):
    props = TinyNetwork(name="inner").card().to_metadata()
    (tmp_path / "net.onnx.yaml").symlink_to("gone.yaml")
    with pytest.raises(ModelError, match=r"net\.onnx\.yaml: describes net\.onnx, but is no file"):
        card_of(tmp_path / "net.onnx", vetted("0" * 64, props))


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
