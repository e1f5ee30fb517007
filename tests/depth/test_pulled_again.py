"""A network of which a file is missing again: what comes must be what came before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from prism_edge.depth.pulled import manifest_of
from prism_edge.depth.pulling import from_entry, from_url
from prism_edge.errors import ModelError
from tests.depth.pulled_networks import checkpoint_item, entry, get


def test_what_is_missing_of_a_checkpoint_without_digests_must_be_what_came_before(
    server, register, models: Path
):
    register(checkpoint_item(server))
    done = get(from_entry(entry("later"), models), unverified=True)
    folder, real = models / "later", server.files["/model.safetensors"]
    server.files["/model.safetensors"] = b"somebody else's"
    (folder / "config.json").unlink()
    server.asked.clear()
    assert get(from_entry(entry("later"), models)).files == done.files
    assert not any("safetensors" in str(asked) for asked in server.asked)  # what is sound stays
    (folder / "model.safetensors").unlink()
    for unverified in (False, True):
        with pytest.raises(ModelError, match="not the registered"):
            get(from_entry(entry("later"), models), unverified=unverified)
        assert not (folder / "model.safetensors").exists()
        assert manifest_of(folder) == done
    server.files["/model.safetensors"] = real
    assert get(from_entry(entry("later"), models)) == done
    assert done.given is False


def test_what_is_missing_comes_from_where_the_rest_came_from(server, models: Path):
    get(from_url(f"{server.url}/tiny.onnx", models, name="mine"), unverified=True)
    (models / "mine" / "mine.onnx").unlink()
    server.files["/other/tiny.onnx"] = server.files["/tiny.onnx"]
    says = r"was pulled from .*/tiny.onnx; `prism-edge models remove mine` first"
    with pytest.raises(ModelError, match=says):
        get(from_url(f"{server.url}/other/tiny.onnx", models, name="mine"), unverified=True)


def test_a_digest_that_is_given_later_is_remembered_as_given(server, models: Path):
    url = f"{server.url}/tiny.onnx"
    done = get(from_url(url, models, name="mine"), unverified=True)
    assert done.given is False
    with pytest.raises(ModelError):
        get(from_url(url, models, "0" * 64, name="mine"))
    assert manifest_of(done.folder) == done
    assert get(from_url(url, models, name="mine"), unverified=True) == done, "without one it stays as it was"
    confirmed = get(from_url(url, models, done.files[0].sha256, name="mine"))
    assert confirmed == manifest_of(done.folder) == replace(done, given=True)
    assert get(from_url(url, models, name="mine"), unverified=True) == confirmed


def test_a_digest_of_one_file_of_two_leaves_the_other_as_unverified_as_it_came(server, models: Path):
    plan = from_url(f"{server.url}/split.onnx", models, name="mine")
    done = get(plan, unverified=True)
    assert len(done.files) == 2
    known = from_url(f"{server.url}/split.onnx", models, done.files[0].sha256, name="mine")
    assert get(known, unverified=True) == done
    assert manifest_of(done.folder).given is False
