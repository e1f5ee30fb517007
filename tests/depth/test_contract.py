"""Model cards: read from every form, and refused in one line for every defect."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.depth.contract import (
    ModelCard,
    card_from_mapping,
    card_from_metadata,
    card_from_sidecar,
)
from prism_edge.depth.onnx_file import CARD_PREFIX
from prism_edge.errors import ModelError
from tests.synthetic.network import TinyNetwork, write_sidecar

GOOD = {
    "contract": 1,
    "name": "some_net",
    "revision": 2,
    "licence": "MIT",
    "depth_kind": "focal_normalised",
    "canonical_focal_length": 300,
    "input_width": 336,
    "input_height": 252,
    "mean": [0.485, 0.456, 0.406],
    "std": [0.229, 0.224, 0.225],
    "scale_bias_sigma": 0.1,
}


def test_a_complete_card_is_read_with_its_types():
    card = card_from_mapping(GOOD, "here")
    assert card.revision == "2"
    assert card.canonical_focal_length == 300.0
    assert card.std == (0.229, 0.224, 0.225)
    assert card.pixel_scale == pytest.approx(1 / 255)
    assert card.confidence_output == ""


def test_a_line_may_have_five_hundred_characters():
    assert card_from_mapping({**GOOD, "licence": "x" * 500}, "here").licence == "x" * 500


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"name": None}, "name"),
        ({"name": "../etc"}, "no name"),
        ({"contract": 2}, "contract is 2"),
        ({"contract": None}, "contract"),
        ({"confidence_output": "c", "confidence_kind": "percent"}, "none of probability, open"),
        ({"confidence_kind": "open"}, "needs a confidence_output"),
        ({"sky_limit": 0.5}, "needs a sky_output"),
        ({"surprise": 1}, "unknown key 'surprise'"),
        ({"depth_kind": "metres"}, "none of metric"),
        ({"canonical_focal_length": "long"}, "a number is needed"),
        ({"canonical_focal_length": -1}, "not within"),
        ({"canonical_focal_length": float("nan")}, "not within"),
        ({"input_width": 224.5}, "whole number"),
        ({"input_width": 0}, "not within"),
        ({"input_width": True}, "a number is needed"),
        ({"mean": [0.1, 0.2]}, "three numbers"),
        ({"mean": "grey"}, "three numbers"),
        ({"std": [1, 0, 1]}, "not within"),
        ({"layout": "NHWC"}, "none of NCHW"),
        ({"resize": "letterbox"}, "none of stretch, crop"),
        ({"levels": "auto"}, "none of spread, kept"),
        ({"colours": ["rgb"]}, "none of rgb"),
        ({"sha256": "abc"}, "64 hexadecimal"),
        ({"licence": "a\nb"}, "one line"),
        ({"licence": "x" * 501}, "at most 500 characters"),
        ({"licence": ["MIT"]}, "text is needed"),
        ({"scale_bias_sigma": 10**400}, "too large"),
        ({"dsug_tau": 0.1}, "come together"),
        ({"dsug_tau": 0.1, "dsug_temperature": 0}, "not within"),
        ({"dsug_tau": 0, "dsug_temperature": 0.1}, "not within"),
        ({"descriptor_layer": "276"}, "needs descriptor_pooling"),
        ({"descriptor_pooling": "mean"}, "needs a descriptor_output or a descriptor_layer"),
        ({"descriptor_output": "d", "descriptor_pooling": "sum"}, "none of token, mean, max, gem, grid"),
        ({"views": 0}, "not within"),
        ({"depth_scale": 0}, "not within"),
        ({"depth_scale": -0.001}, "not within"),
        ({"depth_scale": "mm"}, "a number is needed"),
        ({"depth_scale": 0.001, "depth_kind": "relative"}, "to depth_kind metric and focal_normalised"),
        ({"rays_output": ["a"]}, "text is needed"),
        ({"depth_kind": "metric"}, "belongs to depth_kind focal_normalised"),
    ],
)
def test_each_defect_is_one_line_that_names_it(change, says):
    with pytest.raises(ModelError, match=says) as error:
        card_from_mapping({**GOOD, **change}, "here")
    assert str(error.value).startswith("here: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("key", ["name", "revision", "licence", "depth_kind", "input_width", "input_height"])
def test_a_missing_key_is_named(key):
    with pytest.raises(ModelError, match=f"'{key}' is missing"):
        card_from_mapping({k: v for k, v in GOOD.items() if k != key}, "here")


@pytest.mark.parametrize("key", ["canonical_focal_length", "scale_bias_sigma"])
def test_a_focal_normalised_network_needs_its_focal_length_and_bias(key):
    with pytest.raises(ModelError, match=key):
        card_from_mapping({k: v for k, v in GOOD.items() if k != key}, "here")


@pytest.mark.parametrize("thing", [None, 3, "text", [1], []])
def test_what_is_no_table_is_refused(thing):
    with pytest.raises(ModelError, match="table of keys"):
        card_from_mapping(thing, "here")


def test_yaml_writes_small_numbers_that_pyyaml_reads_as_text(tmp_path: Path):
    path = tmp_path / "net.onnx.yaml"
    path.write_text("\n".join(f"{k}: {v}" for k, v in {**GOOD, "pixel_scale": "1e-2"}.items()))
    assert card_from_sidecar(path).pixel_scale == 0.01


BROKEN = [b"a: [1", b"\xff\xfe\x00", b"[" * 1500, b"x" * 70_000, b"a: 2020-99-99", b"", b"!!map [a, b]"]
BROKEN += [b'a: !!int ""', b'a: !!bool ""', b'a: !!timestamp ""', b"? [a, b]\n: c"]


@pytest.mark.parametrize(
    ("key", "written"),
    [
        ("revision", "1.10"),
        ("revision", "2024-01-01"),
        ("revision", "1e3"),
        ("revision", "12:30:00"),
        ("source", "on"),
        ("descriptor_layer", "0276"),
        ("depth_output", "1_000"),
        ("depth_output", "007"),
        ("name", "0x10"),
        ("sha256", "1" * 64),
        ("sha256", "0" * 63 + "1"),
        ("sha256", "1e" + "2" * 62),
    ],
)
def test_text_in_a_sidecar_is_as_written_though_yaml_has_another_name_for_it(tmp_path, key, written):
    lines = {"contract": "1", "name": "net", "revision": "1", "licence": "MIT", "depth_kind": "metric"}
    lines |= {"scale_bias_sigma": "0.1", "input_width": "64", "input_height": "48"}
    lines |= {"descriptor_output": "d", key: written}
    path = tmp_path / "net.onnx.yaml"
    path.write_text("".join(f"{name}: {value}\n" for name, value in lines.items()))
    assert getattr(card_from_sidecar(path), key) == written


@pytest.mark.parametrize("line", ["source:", "source: ~", "source: [a]", "source: {a: 1}"])
def test_what_is_no_text_in_a_sidecar_is_refused_still(tmp_path: Path, line: str):
    path = write_sidecar(tmp_path / "net.onnx", TinyNetwork().card())
    path.write_text(path.read_text().replace("source: made by the project's tests", line))
    with pytest.raises(ModelError, match=r"net.onnx.yaml: source: text is needed"):
        card_from_sidecar(path)


def test_what_a_sidecar_gives_twice_is_refused(tmp_path: Path):
    """The last of two scales would count, and the metres be off without a word."""
    path = write_sidecar(tmp_path / "net.onnx", TinyNetwork().card())
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, "depth_scale: 0.5"]) + "\n")
    said = rf"net.onnx.yaml line {len(lines) + 1}: no valid YAML: 'depth_scale' is given twice"
    with pytest.raises(ModelError, match=said):
        card_from_sidecar(path)


@pytest.mark.parametrize("content", BROKEN)
def test_a_broken_sidecar_is_one_line(tmp_path: Path, content: bytes):
    path = tmp_path / "net.onnx.yaml"
    path.write_bytes(content)
    with pytest.raises(ModelError) as error:
        card_from_sidecar(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"mean": [123.675, 116.28, 103.53], "std": [58.395, 57.12, 57.375]}, "make -2.118 of black"),
        ({"pixel_scale": 1.0}, "and 1111 of white"),  # with the mean and std of 0 to 1
        ({"mean": [123.0, 117.0, 104.0], "std": [1.0, 1.0, 1.0]}, "make -123 of black and -122 of white"),
    ],
)
def test_normalisation_of_pixels_of_another_range_is_refused(change: dict, says: str):
    with pytest.raises(ModelError, match=says):
        card_from_mapping({**GOOD, **change}, "here")


@pytest.mark.parametrize(
    "change",
    [
        {"pixel_scale": 1.0, "mean": [123.675, 116.28, 103.53], "std": [58.395, 57.12, 57.375]},
        {"pixel_scale": 1.0},
        {"mean": [0.5, 0.5, 0.5], "std": [0.5, 0.5, 0.5]},
        {"pixel_scale": 1.0, "mean": [103.939, 116.779, 123.68]},
    ],
)
def test_normalisation_as_networks_have_it_is_taken(change: dict):
    assert card_from_mapping({**GOOD, "mean": [0, 0, 0], "std": [1, 1, 1], **change}, "here")


@pytest.mark.parametrize("write", [yaml.safe_dump, json.dumps, str, lambda text: f"'{text}'"])
@pytest.mark.parametrize("key", ["name", "revision", "licence", "source"])
def test_text_in_metadata_may_be_as_a_yaml_writer_has_it(write, key: str):
    values = {**TinyNetwork().card().to_metadata(), CARD_PREFIX + key: write("mine-1.10")}
    assert getattr(card_from_metadata(values, "here"), key) == "mine-1.10"


def test_text_in_metadata_that_begins_with_a_quoted_word_is_as_it_is():
    values = {**TinyNetwork().card().to_metadata(), CARD_PREFIX + "source": '"Rooms", a dataset'}
    assert card_from_metadata(values, "here").source == '"Rooms", a dataset'


def test_metadata_of_a_foreign_file_is_no_card():
    assert card_from_metadata({"onnx.infer": "quant", "author": "somebody"}, "here") is None


def test_a_half_written_card_in_metadata_is_refused():
    with pytest.raises(ModelError, match="contract"):
        card_from_metadata({CARD_PREFIX + "name": "x"}, "here")


@pytest.mark.parametrize("kind", ["metric", "focal_normalised", "relative", "inverse_relative"])
@pytest.mark.parametrize("outputs", [False, True])
def test_metadata_gives_the_card_back(kind: str, outputs: bool):
    card = TinyNetwork(depth_kind=kind, confidence=outputs, descriptor=outputs).card()
    assert card_from_metadata({**card.to_metadata(), "onnx.infer": "quant"}, "here") == card


def test_every_key_comes_back_from_metadata_and_from_yaml(tmp_path: Path):
    full = {
        **GOOD,
        "source": "a: page # of its own",
        "sha256": "ab" * 32,
        "input_name": "0",
        "colours": "bgr",
        "pixel_scale": 0.004,
        "resize": "crop",
        "levels": "kept",
        "depth_output": "350",
        "depth_scale": 0.001,
        "confidence_output": "confidence",
        "descriptor_output": "descriptor",
        "descriptor_layer": "camera token of the last block",
        "descriptor_pooling": "token",
        "sky_output": "sky",
        "sky_limit": 0.25,
        "rays_output": "rays",
        "intrinsics_output": "intrinsics",
        "views": 5,
        "dsug_tau": 0.07,
        "dsug_temperature": 0.02,
        "layout": "NCHW",
        "confidence_kind": "open",
    }
    assert set(full) - {"contract"} == {field.name for field in fields(ModelCard)}
    card = card_from_mapping(full, "here")
    for key, value in full.items():
        if key != "contract":
            given = getattr(card, key)
            assert (list(given) if isinstance(given, tuple) else given) in (value, str(value)), key
    assert card.dsug == (0.07, 0.02)
    assert card_from_metadata(card.to_metadata(), "here") == card
    write_sidecar(tmp_path / "net.onnx", card)
    assert card_from_sidecar(tmp_path / "net.onnx.yaml") == card


def test_the_page_lists_every_key():
    page = (Path(__file__).resolve().parents[2] / "docs" / "MODELS.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    missing = [f.name for f in fields(ModelCard) if not any(f"`{f.name}`" in row for row in rows)]
    assert not missing


def test_a_gate_that_was_not_fitted_is_not_a_number():
    assert np.isnan(card_from_mapping(GOOD, "here").dsug).all()


NUMBERS = st.booleans() | st.floats() | st.integers()
ANYTHING = st.none() | NUMBERS | st.text(max_size=20) | st.lists(st.integers())


@settings(max_examples=100, deadline=None)
@given(
    st.dictionaries(st.sampled_from(sorted(GOOD)), ANYTHING),
    st.dictionaries(st.sampled_from([CARD_PREFIX + key for key in GOOD]), st.text(max_size=30)),
)
def test_anything_else_is_a_model_error_or_a_card(values: dict, props: dict):
    for read in (
        lambda: card_from_mapping({**GOOD, **values}, "here"),
        lambda: card_from_metadata({**TinyNetwork().card().to_metadata(), **props}, "here"),
    ):
        try:
            card = read()
        except ModelError as error:
            lines = str(error).count("\n")
        else:
            lines = 0 if card and card.input_width > 0 else -1
        assert lines == 0
