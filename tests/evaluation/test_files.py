"""The files that a run's figures hang on, and what tells that others are in their place."""

from __future__ import annotations

import hashlib
from pathlib import Path

from prism_edge.config import Config, DepthConfig, SourceConfig
from prism_edge.evaluation.files import digests_of, files_of
from tests.sources import tiny_datasets as tiny


def test_a_file_goes_by_the_sha_256_of_what_it_holds_now(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    for text in ("fx: 1\n", "fx: 2\n", "fx: 30\n"):
        file.write_text(text)
        assert digests_of([file]) == {str(file): hashlib.sha256(text.encode()).hexdigest()}


def test_a_folder_of_truth_goes_by_its_poses_alone(tmp_path: Path) -> None:
    folder = tiny.write_seven_scenes(tmp_path)
    before = digests_of([folder])
    (folder / "frame-000001.color.png").unlink()
    assert digests_of([folder]) == before
    pose = folder / "frame-000001.pose.txt"
    pose.write_text(pose.read_text().replace("1", "2", 1))
    assert digests_of([folder]) != before


def test_a_file_that_has_gone_is_unreadable_and_the_others_are_told(tmp_path: Path) -> None:
    gone, there = tmp_path / "gone.tum", tmp_path / "mask.png"
    there.write_bytes(b"")
    found = digests_of([gone, there])
    assert found == {str(gone): "unreadable", str(there): hashlib.sha256(b"").hexdigest()}


def test_what_is_given_and_there_is_listed_with_each_network_its_card(tmp_path: Path) -> None:
    names = ("camera.yaml", "net.onnx", "net.onnx.yaml", "other.onnx", "true.tum")
    for name in names:
        (tmp_path / name).write_text("")
    config = Config(
        source=SourceConfig(camera=str(tmp_path / "camera.yaml"), mask=str(tmp_path / "no.png")),
        depth=DepthConfig(model=f"nested:{tmp_path}/net.onnx,{tmp_path}/other.onnx"),
    )
    assert sorted(files_of(config, tmp_path / "true.tum")) == [tmp_path / name for name in names]


def test_of_a_link_the_card_beside_what_it_leads_to_is_listed(tmp_path: Path) -> None:
    (tmp_path / "v3").mkdir()
    for name in ("net.onnx", "net.onnx.yaml"):
        (tmp_path / "v3" / name).write_text("")
    (tmp_path / "current.onnx").symlink_to("v3/net.onnx")
    config = Config(depth=DepthConfig(model=str(tmp_path / "current.onnx")))
    assert files_of(config, None) == [tmp_path / "current.onnx", tmp_path / "v3" / "net.onnx.yaml"]


def test_the_way_that_a_simulated_camera_goes_is_listed(tmp_path: Path) -> None:
    (tmp_path / "way.tum").write_text("")
    config = Config(source=SourceConfig(uri=f"sim:room?follow={tmp_path}/way.tum&speed=1"))
    assert files_of(config, None) == [tmp_path / "way.tum"]


def test_a_network_that_is_not_there_or_no_pair_leaves_the_rest(tmp_path: Path) -> None:
    (tmp_path / "true.tum").write_text("")
    for model in (str(tmp_path / "gone.onnx"), "nested:one"):
        config = Config(depth=DepthConfig(model=model))
        assert files_of(config, tmp_path / "true.tum") == [tmp_path / "true.tum"]


def test_of_a_pair_the_network_that_is_there_is_listed(tmp_path: Path) -> None:
    (tmp_path / "there.onnx").write_text("")
    config = Config(depth=DepthConfig(model=f"nested:{tmp_path}/gone.onnx,{tmp_path}/there.onnx"))
    assert files_of(config, None) == [tmp_path / "there.onnx"]
