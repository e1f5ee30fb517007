"""Which checkpoint a folder or file is taken for, and which are refused; nothing of it needs PyTorch."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from prism_edge.errors import ModelError
from tools.export_da3.variants import MODEL_NAMES, variant_of, weights_file

REVISION = "0123456789abcdef0123456789abcdef01234567"


def checkpoint(folder: Path, stated: str = "", files: tuple[str, ...] = ("model.safetensors",)) -> Path:
    folder.mkdir(parents=True)
    for name in files:
        (folder / name).write_bytes(b"weights")
    if stated:
        (folder / "config.json").write_text(json.dumps({"model_name": stated}))
    return folder


@pytest.mark.parametrize(
    ("folder", "stated", "named", "expected"),
    [
        ("DA3-SMALL", "", "", "da3-small"),
        ("da3_metric_large", "", "", "da3metric-large"),
        ("DA3MONO-LARGE", "", "", "da3mono-large"),
        ("da3_nested_giant_large", "", "", "da3nested-giant-large"),
        ("DA3-LARGE-1.1", "", "", "da3-large"),
        ("DA3NESTED-GIANT-LARGE-1.1", "", "", "da3nested-giant-large"),
        ("weights", "da3-giant-1.1", "", "da3-giant"),
        ("DA3-LARGE-1.1", "da3-large", "da3-large", "da3-large"),
        (f"models--depth-anything--DA3-BASE/snapshots/{REVISION}", "", "", "da3-base"),
        (f"models--depth-anything--DA3-LARGE-1.1/snapshots/{REVISION}", "", "", "da3-large"),
        ("weights", "", "da3-base", "da3-base"),
        ("weights", "my-own-tuning", "da3-base", "da3-base"),
    ],
)
def test_a_checkpoint_is_what_it_says(tmp_path: Path, folder: str, stated: str, named: str, expected: str):
    path = checkpoint(tmp_path / folder, stated)
    assert variant_of(path, named) == expected
    assert variant_of(path / "model.safetensors", named) == expected


def test_links_of_a_cache_are_not_followed_to_its_blobs(tmp_path: Path):
    cache = tmp_path / "models--depth-anything--DA3-SMALL"
    folder = checkpoint(cache / "snapshots" / REVISION, files=())
    (cache / "blobs").mkdir()
    for name, blob in (("model.safetensors", b"weights"), ("config.json", b"{}")):
        (cache / "blobs" / name[:2]).write_bytes(blob)
        (folder / name).symlink_to(Path("../../blobs") / name[:2])
    assert variant_of(folder, "") == "da3-small"
    assert variant_of(folder / "model.safetensors", "") == "da3-small"


@pytest.mark.parametrize(
    ("folder", "stated", "named", "says"),
    [
        ("weights", "da3mono-large", "da3metric-large", "is da3mono-large by its config.json, not"),
        ("DA3MONO-LARGE", "", "da3metric-large", "is da3mono-large by its folder's name, not"),
        ("DA3METRIC-LARGE", "da3mono-large", "", "by its config.json, da3metric-large by its folder"),
        ("DA3METRIC-LARGE", "da3mono-large", "da3metric-large", "name the folder by what is in it"),
        ("weights", "", "", "does not say which checkpoint it is"),
        ("weights", "da3-huge", "", "does not say which checkpoint it is"),
    ],
)
def test_a_checkpoint_that_says_otherwise_is_refused(tmp_path: Path, folder, stated, named, says):
    with pytest.raises(ModelError, match=says) as error:
        variant_of(checkpoint(tmp_path / folder, stated), named)
    assert "\n" not in str(error.value)
    if says.startswith("does not"):
        assert ", ".join(MODEL_NAMES) in str(error.value)


def test_shards_must_be_joined_first(tmp_path: Path):
    shards = tuple(f"model-0000{i}-of-00002.safetensors" for i in (1, 2))
    folder = checkpoint(tmp_path / "da3-giant", files=(*shards, "model.safetensors.index.json"))
    for path in (folder, folder / shards[0]):
        with pytest.raises(ModelError, match="its weights are in 2 shards, which must be joined"):
            weights_file(path)


def test_one_weights_file_is_found_and_any_other_number_refused(tmp_path: Path):
    one, two = checkpoint(tmp_path / "one"), checkpoint(tmp_path / "two", files=("a.pth", "b.safetensors"))
    assert weights_file(one) == weights_file(one / "model.safetensors") == one / "model.safetensors"
    for path, says in (
        (two, "several weight files: name one"),
        (checkpoint(tmp_path / "none", files=()), "no .safetensors or .pth file"),
        (tmp_path / "absent", "there is no such checkpoint"),
    ):
        with pytest.raises(ModelError, match=says):
            weights_file(path)
