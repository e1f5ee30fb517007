"""Networks from a server on loopback: whole or not at all, licence and digest held to what is registered."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import onnx
import pytest

from prism_edge.config import DepthConfig
from prism_edge.depth import locate, open_onnx, pulled, pulling
from prism_edge.depth.download import Patience
from prism_edge.depth.pulled import (
    MANIFEST,
    Pulled,
    all_pulled,
    find_pulled,
    manifest_of,
    pulled_files,
    write_manifest,
)
from prism_edge.depth.pulling import from_entry, from_url
from prism_edge.depth.registry import File
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import ModelError
from tests.depth.pulled_networks import (
    Asked,
    checkpoint_item,
    digest,
    entry,
    get,
    only_parts,
    split_item,
    tiny_item,
)
from tests.depth.test_vetting import split
from tests.synthetic.network import TinyNetwork, write_sidecar, write_tiny_network

HASTY = Patience(stall_s=30.0, attempts=2, pause_s=0.0)  # only who stalls on purpose is held to less


def test_a_registered_network_is_pulled_and_opens_by_name(server, register, models: Path):
    register(tiny_item(server))
    asked = Asked()
    done = get(from_entry(entry("tiny_tint"), models), asked)
    assert asked == ["Apache-2.0"]
    assert sorted(os.listdir(models / "tiny_tint")) == [MANIFEST, "tiny.onnx"]
    assert done.path == locate("tiny_tint") == entry("tiny_tint").located()
    assert open_onnx("tiny_tint", DepthConfig()).name == "tiny_tint"
    assert get(from_entry(entry("tiny_tint"), models)) == done  # a second time nothing is fetched
    assert len(server.asked) == 1


def test_weights_beside_a_network_come_with_it(server, register, models: Path):
    register(split_item(server))
    get(from_entry(entry("split"), models))
    assert sorted(os.listdir(models / "split")) == [MANIFEST, "split.onnx", "split.onnx.data"]
    assert open_onnx("split", DepthConfig()).card.name == "split"
    spoilt = bytearray((models / "split" / "split.onnx.data").read_bytes())
    spoilt[7] ^= 1
    (models / "split" / "split.onnx.data").write_bytes(spoilt)
    with pytest.raises(ModelError, match=r"split.onnx.data: its SHA-256 is .* not the registered"):
        open_onnx("split", DepthConfig())


@pytest.mark.parametrize("how", ["truncate", "corrupt", "404", "stall"])
@pytest.mark.parametrize("which", [0, 1])
def test_half_a_network_is_none(server, register, models: Path, how: str, which: int):
    register(split_item(server))
    server.plan = ["right"] * which + [how]
    with pytest.raises(ModelError) as error:
        get(from_entry(entry("split"), models), patience=Patience(1.0 if how == "stall" else 30.0, 1))
    assert "\n" not in str(error.value)
    assert only_parts(models / "split")
    assert entry("split").located() is None
    get(from_entry(entry("split"), models), patience=HASTY)
    assert open_onnx("split", DepthConfig()).card.name == "split"


@pytest.mark.parametrize("stage", range(4))
def test_a_pull_that_is_killed_while_it_puts_files_in_place_is_ended_by_the_next(
    server, register, models: Path, monkeypatch, stage: int
):
    register(split_item(server))
    settled = []
    real = pulling.download.settle

    def killed(part: Path, file: Path) -> None:
        if len(settled) == stage:
            raise KeyboardInterrupt
        settled.append(file.name)
        real(part, file)

    with monkeypatch.context() as patch:
        patch.setattr(pulling.download, "settle", killed)
        if stage < 3:
            with pytest.raises(KeyboardInterrupt):
                get(from_entry(entry("split"), models))
            assert "split.onnx" not in settled  # the network itself comes last
        else:
            get(from_entry(entry("split"), models))
    fetched = len(server.asked)
    get(from_entry(entry("split"), models))
    assert open_onnx("split", DepthConfig()).card.name == "split"
    assert len(server.asked) == fetched  # nothing came twice


def test_a_checkpoint_without_digests_needs_a_word_and_is_remembered(server, register, models: Path):
    register(checkpoint_item(server))
    with pytest.raises(ModelError, match=r"no SHA-256 of config.json and model.safetensors is known"):
        get(from_entry(entry("later"), models))
    assert not server.asked
    assert not models.exists()
    asked = Asked()
    done = get(from_entry(entry("later"), models), asked, unverified=True)
    assert asked == ["CC-BY-NC-4.0"]
    assert done.path == models / "later" == entry("later").located()
    assert [file.sha256 for file in done.files] == [
        digest(server.files["/config.json"]),
        digest(server.files["/model.safetensors"]),
    ]
    assert manifest_of(models / "later") == done
    assert get(from_entry(entry("later"), models)) == done
    (models / "later" / "model.safetensors").write_bytes(b"spoilt")
    with pytest.raises(ModelError, match="is not the file it should be; `prism-edge models remove later`"):
        get(from_entry(entry("later"), models))


def test_a_licence_that_is_refused_leaves_nothing(server, register, models: Path):
    register(checkpoint_item(server))

    def refuse(licence: str) -> None:
        raise ModelError("not accepted")

    with pytest.raises(ModelError, match="not accepted"):
        get(from_entry(entry("later"), models), refuse, unverified=True)
    assert not server.asked
    assert not models.exists()


def test_a_file_that_states_another_licence_than_its_entry_is_refused(server, register, models: Path):
    register(tiny_item(server, licence="MIT"))
    with pytest.raises(ModelError, match=r"the file says licence Apache-2.0, but it is registered under MIT"):
        get(from_entry(entry("tiny_tint"), models))
    assert only_parts(models / "tiny_tint")


def test_a_file_with_another_digest_than_its_entry_is_refused(server, register, models: Path):
    register(tiny_item(server, sha256="0" * 64))
    with pytest.raises(ModelError, match="not the registered 000000000000"):
        get(from_entry(entry("tiny_tint"), models))
    assert not (models / "tiny_tint").exists()


def test_a_network_that_needs_more_than_is_registered_is_refused(server, register, models: Path):
    item = split_item(server)
    del item["data"]
    register(item)
    with pytest.raises(ModelError, match=r"needs 'split.onnx.data', which is not registered"):
        get(from_entry(entry("split"), models))
    assert only_parts(models / "split")


def test_an_entry_without_a_url_says_where_to_put_the_file(register, server, models: Path):
    item = tiny_item(server)
    del item["url"]
    register({**item, "obtain": "ask its author"})
    says = r"ask its author\); put tiny.onnx \(SHA-256 [0-9a-f]{64}\) into .*models"
    with pytest.raises(ModelError, match=says):
        from_entry(entry("tiny_tint"), models)


def test_a_network_from_anywhere_is_kept_under_its_name(server, models: Path):
    asked = Asked()
    plan = from_url(f"{server.url}/tiny.onnx?download=true", models)
    server.files["/tiny.onnx?download=true"] = server.files["/tiny.onnx"]
    with pytest.raises(ModelError, match=r"no SHA-256 of tiny.onnx is known"):
        get(plan, asked)
    get(plan, asked, unverified=True)
    assert asked == ["Apache-2.0"]  # as the file itself states
    assert open_onnx("tiny", DepthConfig()).name == "tiny_tint"
    assert [known.name for known in all_pulled()] == ["tiny"]
    write_tiny_network(models / "tiny" / "tiny.onnx", TinyNetwork(gain=2.0))
    with pytest.raises(ModelError, match="not the registered"):
        open_onnx("tiny", DepthConfig())


def test_a_url_with_its_digest_needs_no_word(server, models: Path):
    right = digest(server.files["/tiny.onnx"])
    get(from_url(f"{server.url}/tiny.onnx", models, right.upper(), "mine"))
    assert locate("mine") == models / "mine" / "mine.onnx"
    with pytest.raises(ModelError, match=r"was pulled from .*tiny.onnx; `prism-edge models remove mine`"):
        get(from_url(f"{server.url}/split.onnx", models, right, "mine"))
    with pytest.raises(ModelError, match="not the registered 0000"):
        get(from_url(f"{server.url}/tiny.onnx", models, "0" * 64))


def test_weights_beside_a_network_from_anywhere_come_with_it(server, models: Path):
    plan = from_url(f"{server.url}/split.onnx", models, name="mine")
    done = get(plan, unverified=True)
    assert [file.name for file in done.files] == ["mine.onnx", "split.onnx.data"]
    (models / "mine" / "mine.onnx.yaml").write_text("")  # what it predicts must be described by hand
    with pytest.raises(ModelError, match="table of keys"):
        open_onnx("mine", DepthConfig())
    # its own digest does not vouch for its weights
    write_sidecar(models / "mine" / "mine.onnx", TinyNetwork().card())
    assert open_onnx("mine", DepthConfig()).card.name == "tiny_tint"
    weights = models / "mine" / "split.onnx.data"
    weights.write_bytes(bytes(reversed(weights.read_bytes())))
    with pytest.raises(ModelError, match=r"split.onnx.data: its SHA-256 is .* not the pulled"):
        open_onnx("mine", DepthConfig())
    with pytest.raises(ModelError, match="not the pulled"):  # by its path as well, as a service has it
        open_onnx(str(models / "mine" / "mine.onnx"), DepthConfig())
    (models / "mine" / MANIFEST).unlink()  # a file that nobody pulled is taken at its word
    assert open_onnx(str(models / "mine" / "mine.onnx"), DepthConfig())
    pinned = from_url(f"{server.url}/split.onnx", models, digest(server.files["/split.onnx"]), "other")
    with pytest.raises(ModelError, match=r"no SHA-256 of split.onnx.data is known"):
        get(pinned)
    assert only_parts(models / "other")


ODD = ["../other.bin", "/etc/passwd", "a/b.bin", "mine.onnx", MANIFEST, "x.part"]


@pytest.mark.parametrize("location", ODD)
def test_a_network_from_anywhere_that_names_odd_weights_is_refused(server, models: Path, tmp_path, location):
    model = onnx.ModelProto.FromString(server.files["/split.onnx"])
    for tensor in model.graph.initializer:
        for item in tensor.external_data:
            if item.key == "location":
                item.value = location
    server.files["/split.onnx"] = model.SerializeToString()
    with pytest.raises(ModelError) as error:
        get(from_url(f"{server.url}/split.onnx", models, name="mine"), unverified=True)
    assert "\n" not in str(error.value)
    assert only_parts(models / "mine")
    assert len(server.asked) == 1


@pytest.mark.parametrize("content", [b"", b"<html>log in first</html>", b"\x08\x07"])
def test_what_is_no_network_is_not_kept(server, models: Path, content: bytes):
    server.files["/page.onnx"] = content
    with pytest.raises(ModelError, match="no ONNX model"):
        get(from_url(f"{server.url}/page.onnx", models), unverified=True)
    assert not (models / "page").exists()
    server.files["/page.onnx"] = server.files["/tiny.onnx"]
    get(from_url(f"{server.url}/page.onnx", models), unverified=True)
    assert open_onnx("page", DepthConfig()).card.name == "tiny_tint"


@pytest.mark.parametrize(
    ("url", "more", "says"),
    [
        ("https://example.org/net.pt", {}, "ends in .onnx"),
        ("https://example.org/.onnx", {}, "is no name"),
        ("https://example.org/a%2F..%2Fb.onnx", {"name": "../b"}, "is no name"),
        ("https://example.org/fastdepth_nyu.onnx", {}, "name of a registered network"),
        ("https://example.org/net.onnx", {"sha256": "abc"}, "64 hexadecimal digits"),
        ("file:///net.onnx", {}, "no http or https URL"),
    ],
)
def test_what_can_not_be_pulled_is_one_line(tmp_path: Path, url: str, more: dict, says: str):
    with pytest.raises(ModelError, match=says) as error:
        from_url(url, tmp_path, **more)
    assert "\n" not in str(error.value)


def test_two_pulls_of_one_network_do_not_meet(server, register, models: Path):
    register(tiny_item(server))
    plan = from_entry(entry("tiny_tint"), models)
    with pulling._locked(plan.folder):
        for _ in range(2):
            with pytest.raises(ModelError, match="another pull is at work"):
                get(plan)
        assert plan.folder.is_dir(), "it is the first one's, which has put nothing there yet"
    get(plan)


BROKEN = ["", "pulled: 1", "pulled: 2\nfiles: []", "[", "pulled: 1\nfiles: [{file: ../x}]"]
BROKEN.append(f"pulled: 2\nfiles: [{{file: x, sha256: {64 * '0'}}}]")  # of a build to come


@pytest.mark.parametrize("content", [*BROKEN, "pulled: 1\nfiles: [{file: x}]", "pulled: 1\nfiles: 3"])
def test_a_broken_manifest_is_one_line(models: Path, content: str):
    (models / "net").mkdir(parents=True)
    (models / "net" / MANIFEST).write_text(content)
    with pytest.raises(ModelError) as error:
        find_pulled("net")
    assert "\n" not in str(error.value)
    assert all_pulled() == []  # a list goes on without it


@pytest.mark.parametrize("name", ["", "..", "a/b", "../x", "."])
def test_a_path_is_no_pulled_name(name: str):
    assert find_pulled(name) is None


def test_registered_weights_must_be_the_only_ones(server, register, tmp_path: Path, models: Path):
    item = split_item(server)
    register(item)
    place = tmp_path / "elsewhere"
    place.mkdir()
    path = split(place / "split.onnx", "split.onnx.data")
    (place / "split.onnx.yaml").unlink()
    assert OnnxNetwork(path).name == "split"  # known by its digest, wherever it lies
    register({**item, "data": [{**item["data"][0], "file": "other.data"}]})
    with pytest.raises(ModelError, match="external data are not those registered for split"):
        OnnxNetwork(path)


def test_the_manifest_is_what_was_pulled(server, register, models: Path):
    register(tiny_item(server))
    done = get(from_entry(entry("tiny_tint"), models))
    assert manifest_of(done.folder) == done
    assert done == replace(done, licence="Apache-2.0", runnable=True)


def test_a_link_to_a_pulled_network_is_held_to_the_digests_that_came(server, models: Path, tmp_path: Path):
    done = get(from_url(f"{server.url}/tiny.onnx", models, name="mine"), unverified=True)
    link = tmp_path / "current.onnx"
    link.symlink_to(done.path)
    assert pulled_files(link) == done.files == pulled_files(done.path)
    link.unlink()
    link.symlink_to(tmp_path / "tiny.onnx")
    assert pulled_files(link) == ()


def test_a_manifest_of_as_many_files_as_a_network_may_have_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sixteenth of the files in a sixteenth of the room: reading YAML of them all takes seconds."""
    monkeypatch.setattr(pulled, "_LARGEST_MANIFEST", pulled._LARGEST_MANIFEST // 16)
    count = 4096 // 16
    url = f"https://hub.example/{'long' * 20}/resolve/main/"
    files = [File(f"tensor_{i:05d}.weight", "0" * 64, 4, f"{url}tensor_{i:05d}.weight") for i in range(count)]
    plan = Pulled("many", "MIT", True, tuple(files), tmp_path / "many")
    plan.folder.mkdir()
    write_manifest(plan)
    assert manifest_of(plan.folder) == plan
