"""Reading and writing configuration: round trips, and one clear line for every mistake."""

from __future__ import annotations

import typing
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from prism_edge.config import Config
from prism_edge.config_file import Leaf, dump, leaves, load
from prism_edge.contradictions import NOT_ABOVE
from prism_edge.errors import ConfigError

LEAVES = {leaf.key: leaf for leaf in leaves()}
TEXT = st.text(st.characters(exclude_characters="\0"), max_size=12)


def value_of(kind: Any, leaf: Leaf) -> st.SearchStrategy[Any]:
    if typing.get_origin(kind) is tuple:
        item, size = value_of(typing.get_args(kind)[0], leaf), leaf.length
        if leaf.unit:
            return st.permutations([0.6, -0.8, *[0.0] * ((size or 2) - 2)]).map(tuple)
        return st.lists(item, min_size=size or 0, max_size=4 if size is None else size).map(tuple)
    if leaf.name:  # no two alike
        return TEXT.filter(str.isprintable).map(lambda text: leaf.key + text)
    if kind is str:
        return st.sampled_from(leaf.choices) if leaf.choices else TEXT
    if kind is int:
        return st.integers(leaf.low, leaf.high)
    if kind is float and leaf.least is not None:
        return st.just(0.0) | st.floats(leaf.least, leaf.high)
    if kind is float:
        return st.floats(leaf.low, leaf.high, allow_nan=False, allow_infinity=False)
    return st.booleans()


def agree(given: dict[str, Any]) -> bool:
    """Whether no two keys make each other void (contradictions.py)."""
    either = {key: given.get(key, leaf.default) for key, leaf in LEAVES.items()}
    return all(either[low] <= either[high] for low, high, _ in NOT_ABOVE)


OPTIONS = {key: value_of(leaf.type, leaf) for key, leaf in LEAVES.items()}
ANY_SETTINGS = st.fixed_dictionaries({}, optional=OPTIONS).filter(agree)
YAML_LIKE = st.text(alphabet="abc:[]{}-,&*!|>'\"%@#?<\n\t 01.", max_size=60)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "robot.yaml"


def refusal(file: Path, content: str | bytes) -> str:
    """The one line that loading ``content`` ends in."""
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ConfigError) as caught:
        load(file)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(str(file))
    return line[len(str(file)) :]


@given(ANY_SETTINGS, st.booleans())
@settings(max_examples=60, deadline=None)
def test_dump_loads_back_equal(
    tmp_path_factory: pytest.TempPathFactory, given: dict[str, Any], explain: bool
) -> None:
    config = load(None, given)
    file = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    file.write_text(dump(config, explain))
    assert load(file) == config


@given(ANY_SETTINGS)
@example({"robot": "\x85", "depth.providers": ("\u2028",)})
@settings(max_examples=30, deadline=None)
def test_dump_is_yaml_to_another_reader(given: dict[str, Any]) -> None:
    config = load(None, given)
    tree = yaml.safe_load(dump(config))
    assert tree["seed"] == config.seed
    assert tree["robot"] == config.robot
    assert tree["frames"]["base_from_camera_xyz"] == pytest.approx(config.frames.base_from_camera_xyz)
    assert tree["depth"]["providers"] == list(config.depth.providers)


@given(st.binary(max_size=60) | YAML_LIKE.map(str.encode))
@settings(max_examples=150, deadline=None)
def test_any_bytes_are_a_configuration_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    file = tmp_path_factory.getbasetemp() / "fuzz.yaml"
    file.write_bytes(content)
    message = ""
    try:
        load(file)
    except ConfigError as error:
        message = str(error)
    assert "\n" not in message


def test_no_file_is_the_defaults(file: Path) -> None:
    assert load() == Config()
    file.write_text("# nothing but a comment\n")
    assert load(file) == Config()
    file.write_text("source:\n  # uri: x\nrobot: r1\n")
    assert load(file) == Config(robot="r1")


def test_overrides_win_over_the_file(file: Path) -> None:
    file.write_text("robot: a\nseed: 1\nsource:\n  uri: here\n")
    config = load(file, {"robot": "b", "source.rate_hz": 5, "depth.providers": ["X", "Y"]})
    assert (config.robot, config.seed, config.source.uri) == ("b", 1, "here")
    assert (config.source.rate_hz, config.depth.providers) == (5.0, ("X", "Y"))


def test_overrides_given_as_text_are_read_as_the_key_asks() -> None:
    given = {"robot": "5", "seed": "5", "source.loop": "true", "ablate": "[wls]", "scale.frame_sigma": "1e-8"}
    config = load(None, given)
    assert (config.robot, config.seed, config.source.loop, config.ablate) == ("5", 5, True, ("wls",))
    assert config.scale.frame_sigma == 1e-8


@pytest.mark.parametrize("written", ["1e-8", "+1E-8", "1.0e-8", ".00000001"])
def test_scientific_notation_is_a_number(file: Path, written: str) -> None:
    file.write_text(f"scale:\n  frame_sigma: {written}\n")
    assert load(file).scale.frame_sigma == 1e-8


def test_unknown_key_names_line_and_nearest(file: Path) -> None:
    line = refusal(file, "robot: a\ntracking:\n  featurs: 500\n")
    assert line == ":3: tracking.featurs: unknown key; did you mean tracking.features?"


def test_right_name_in_the_wrong_section_is_pointed_out(file: Path) -> None:
    assert "did you mean source.rate_hz?" in refusal(file, "rate_hz: 3\n")


def test_dotted_key_in_a_file_is_explained(file: Path) -> None:
    assert "indent" in refusal(file, "source.uri: x\n")


def test_duplicate_key_names_both_lines(file: Path) -> None:
    assert refusal(file, "seed: 1\nrobot: a\nseed: 2\n") == ":3: seed: set twice; the first is on line 1"


@pytest.mark.parametrize(
    ("content", "line", "words"),
    [
        ("source:\n  rate_hz: fast\n", 2, ["source.rate_hz", "a number", "'fast'"]),
        ("source:\n  rate_hz: '5'\n", 2, ["source.rate_hz", "a number", "text '5'"]),
        ("source:\n  rate_hz: -1\n", 2, ["source.rate_hz", "0, or a number from 0.01 to 1000", "-1"]),
        ("source:\n  rate_hz: 1e-300\n", 2, ["source.rate_hz", "0, or a number from 0.01", "1e-300"]),
        ("source:\n  rate_hz: .nan\n", 2, ["source.rate_hz", ".nan"]),
        ("source:\n  rate_hz: .inf\n", 2, ["source.rate_hz", ".inf"]),
        ("source:\n  rate_hz: 1e999\n", 2, ["source.rate_hz", "1e999"]),
        ("source:\n  loop: 1\n", 2, ["source.loop", "true or false"]),
        ("source: 5\n", 1, ["source", "got 5"]),
        ("depth:\n  threads: true\n", 2, ["depth.threads", "a whole number", "true"]),
        ("depth:\n  threads: 1.5\n", 2, ["depth.threads", "a whole number", "1.5"]),
        ("depth:\n  threads: 010\n", 2, ["depth.threads", "a whole number", "010"]),
        ("depth:\n  threads: [1]\n", 2, ["depth.threads", "a list of 1"]),
        ("depth:\n  providers: CUDA\n", 2, ["depth.providers", "a list of words", "'CUDA'"]),
        ("seed: 1_\n", 1, ["seed", "a whole number", "1_"]),
        ("seed: 1__0\n", 1, ["seed", "a whole number", "1__0"]),
        ("seed: 1e-8\n", 1, ["seed", "a whole number", "1e-8"]),
        ("seed: " + "9" * 5000 + "\n", 1, ["seed", "a whole number", "..."]),
        ("robot: 5\n", 1, ["robot", "text", "got 5"]),
        ("robot:\n", 1, ["robot", "text", "nothing"]),
        ("robot: !!python/object/apply:os.getcwd []\n", 1, ["robot", "text"]),
        ("robot: !!python/name:os.system ''\n", 1, ["robot", "text"]),
        ('robot: "a\\0b"\n', 1, ["robot", "text"]),
        ("mode: fast\n", 1, ["mode", "realtime or lockstep", "'fast'"]),
        ("frames:\n  base_from_camera_xyz: [1, 2]\n", 2, ["a list of 3 numbers", "a list of 2"]),
        ("frames:\n  base_from_camera_xyz: [1, 2, x]\n", 2, ["a list of 3 numbers", "'x'"]),
        ("- robot\n", 1, ["key: value"]),
        ("just words\n", 1, ["key: value"]),
        ("? [a]\n: 3\n", 1, ["unknown key"]),
        ("robot: a\nsource: [\n", 3, ["not valid YAML"]),
        ("robot: a\n--- \nrobot: b\n", 2, ["not valid YAML"]),
        ("robot: *missing\n", 1, ["not valid YAML"]),
        ("source: &a\n  uri: *a\n", 2, ["source.uri", "a mapping"]),
    ],
)
def test_mistake_names_file_line_and_key(file: Path, content: str, line: int, words: list[str]) -> None:
    refused = refusal(file, content)
    assert refused.startswith(f":{line}: ")
    assert all(word in refused for word in words), refused


NO_YAML = [b"\x01", b"\xff\xfe\xff", b"robot: \xff\n", b"[" * 9000, b"#" * (2**20 + 1)]


@pytest.mark.parametrize("content", NO_YAML)
def test_file_that_is_no_yaml_is_one_line(file: Path, content: bytes) -> None:
    assert refusal(file, content)


def test_unreadable_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"missing\.yaml: can't read"):
        load(tmp_path / "missing.yaml")
    with pytest.raises(ConfigError, match="can't read"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("sorce.uri", "x", "did you mean source.uri?"),
        ("tracking.feature", "7", "did you mean tracking.features?"),
        ("tracking.threads", "7", "did you mean depth.threads?"),
        ("tracking.foo", "7", "unknown key; see docs/CONFIGURATION.md"),
        ("trackin", "7", "unknown key; see docs/CONFIGURATION.md"),
        ("source", "x", "section"),
        ("bus.retry_ms", 5001, "from 10 to 5000"),  # a listener is waited for no longer than seconds
        ("supervisor.start_s", 4.9, "from 5 to 600"),  # the libraries alone take one or two
        ("lockstep.depth_lag", 101, "from 0 to 100"),  # a map's first keyframe waits ten seconds
        ("tracking.proven_after_s", 1e-320, "0, or a number from 0.001 to 60"),
        ("seed", 5.0, "a whole number"),
        ("seed", True, "a whole number"),
        ("seed", "", "nothing"),
        ("seed", "'5'", "text '5'"),
        ("seed", "[", "not valid YAML"),
        ("robot", 5, "text"),
        ("robot", None, "text"),
        ("robot", "a\0b", "text"),
        ("source.rate_hz", float("nan"), "a number"),
        ("source.rate_hz", 10**400, "a number"),
        ("frames.base_from_camera_xyz", (1.0, 2.0), "3 numbers"),
        ("frames.base_from_camera_xyz", "[300, -100, 500]", "from -20 to 20 (metres), got 300"),
        ("frames.base_from_camera_xyz", (0.0, 0.0, -20.5), "(metres), got -20.5"),
        ("frames.base_from_camera_xyzw", (0.0, 0.0, 0.0, 0.0), "4 numbers of norm 1"),
        ("frames.base_from_camera_xyzw", "[0, 0, 0, 0.98]", "of norm 0.98"),
        ("frames.base_from_camera_xyzw", "[1e200, 0, 0, 1e200]", "of norm 1"),
        ("frames.base_from_camera_xyzw", "[1, 0, 0, .nan]", "a list of 4 numbers"),
        ("frames.odom", "", "expected a name, got ''"),
        ("frames.camera", " ", "expected a name"),
        ("frames.map", "a\nb", r"expected a name, got 'a\nb'"),
        ("frames.map", "/map", "tf2 takes no name with a slash in front; write 'map'"),
        ("depth.providers", "CPU", "expected a list of words, got the text 'CPU'; write [CPU]"),
        ("depth.providers", "cuda, cpu", "write [cuda, cpu]"),
        ("frames.base_from_camera_xyz", "1", "expected a list of 3 numbers from -20 to 20 (metres), got 1"),
        ("ablate", "[wls, wheels]", "got 'wheels'"),
    ],
)
def test_wrong_override_is_one_line(key: str, value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, {key: value})
    assert str(caught.value).startswith(f"setting {key}")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mount_is_a_rotation_and_frames_differ(file: Path) -> None:
    line = refusal(file, "frames:\n  odom: o\n  base_from_camera_xyzw: [0, 0, 0, 0]\n")
    assert line.startswith(":3: frames.base_from_camera_xyzw: expected a list of 4 numbers of norm 1")
    assert "frames.odom: is 'world' like frames.map" in refusal(file, "frames: {map: world, odom: world}\n")
    assert "frames.camera: is 'odom' like frames.odom" in refusal(file, "frames: {camera: odom}\n")
    assert refusal(file, "frames:\n  map: ''\n").startswith(":2: frames.map: expected a name")
    assert refusal(file, "frames:\n  odom: /a/b\n").startswith(":2: frames.odom: tf2 takes no name")
    file.write_text("frames: {odom: r1/odom}\n")
    assert load(file).frames.odom == "r1/odom"
    file.write_text("frames: {base_from_camera_xyzw: [-0.502, 0.5, -0.5, 0.5]}\n")  # rounded by hand
    assert load(file).frames.base_from_camera_xyzw[0] == -0.502


def test_where_0_says_something_of_its_own_the_least_beside_it_is_a_bound() -> None:
    assert [load(None, {"source.rate_hz": rate}).source.rate_hz for rate in (0, 0.01)] == [0.0, 0.01]
    with pytest.raises(ConfigError, match=r"expected 0, or a number from 0\.01 to 1000, got 0\.0099"):
        load(None, {"source.rate_hz": 0.0099})


def test_keys_that_make_each_other_void_are_named_with_the_file(file: Path) -> None:
    refused = refusal(file, "tracking: {min_matches: 700}\n")
    assert refused.startswith(": tracking.min_matches: 700 is more than tracking.features (600): ")
    file.write_text("tracking: {min_matches: 700}\n")
    assert load(file, {"tracking.features": 700}).tracking.min_matches == 700


def test_a_list_of_one_is_shown_and_a_section_of_a_file_is_suggested(file: Path) -> None:
    assert refusal(file, "depth:\n  providers: cpu\n").endswith("got the text 'cpu'; write [cpu]")
    assert refusal(file, "depth:\n  providers:\n").endswith("got nothing")
    assert refusal(file, "trackin: {features: 300}\n").endswith("did you mean tracking?")
