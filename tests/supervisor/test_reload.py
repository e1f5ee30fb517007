"""Which changes of the configuration a running daemon takes up."""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter

import pytest

from prism_edge.config import Config, DepthConfig
from prism_edge.config_file import leaves
from prism_edge.processes import PROCESSES
from prism_edge.supervisor.reload import difference, put

RUNNING = Config(depth=DepthConfig(model="a.onnx"))


def test_nothing_changed() -> None:
    change = difference(RUNNING, RUNNING)
    assert (change.config, change.applied, change.refused, change.restart) == (RUNNING, (), (), frozenset())


@pytest.mark.parametrize(
    ("key", "value", "restart"),
    [
        ("depth.threads", 2, {"depth"}),
        ("depth.model", "b.onnx", {"depth", "scale"}),
        ("scale.gate_sigmas", 3.0, {"scale"}),
        ("backend.window", 9, {"backend"}),
        ("supervisor.max_restarts", 9, set()),
    ],
)
def test_what_can_change_is_taken_up(key: str, value: object, restart: set[str]) -> None:
    change = difference(RUNNING, put(RUNNING, key, value))
    assert attrgetter(key)(change.config) == value
    assert (change.applied, change.refused, change.restart) == ((key,), (), restart)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("robot", "other"),
        ("bus.endpoint", "tcp/127.0.0.1:1"),
        ("tracking.features", 500),
        ("depth.model", ""),
    ],
)
def test_what_can_not_change_is_refused_and_the_rest_taken_up(key: str, value: object) -> None:
    change = difference(RUNNING, put(put(RUNNING, key, value), "scale.min_points", 20))
    assert change.refused == (key,)
    assert change.config == replace(RUNNING, scale=replace(RUNNING.scale, min_points=20))


REMOTE = put(RUNNING, "network.remote", ("depth",))


def test_what_only_another_host_s_process_takes_up_is_refused() -> None:
    change = difference(REMOTE, put(put(REMOTE, "depth.threads", 2), "scale.min_points", 20))
    assert (change.applied, change.refused) == (("scale.min_points",), ())
    assert change.elsewhere == ("depth.threads",)
    assert change.config == put(REMOTE, "scale.min_points", 20)
    assert (change.restart, change.behind) == ({"scale"}, frozenset())


def test_what_processes_here_and_elsewhere_take_up_names_those_elsewhere() -> None:
    change = difference(REMOTE, put(REMOTE, "depth.model", "b.onnx"))
    assert (change.applied, change.elsewhere) == (("depth.model",), ())
    assert (change.restart, change.behind) == ({"scale"}, {"depth"})


def test_the_tree_names_processes_that_exist() -> None:
    for leaf in leaves():
        assert set(leaf.reload) <= PROCESSES.keys() | {"supervisor"}


def test_no_reload_starts_what_would_lose_the_map_or_the_subscribers() -> None:
    assert not any(set(leaf.reload) & {"tracker", "source"} for leaf in leaves())
