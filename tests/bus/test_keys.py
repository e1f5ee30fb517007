"""Keys, robot names, endpoints."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.bus.keys import alive_key, check_endpoint, check_robot_name, collide, key, ready_key
from prism_edge.errors import BusError, ConfigError
from prism_edge.topics import TOPICS


@pytest.mark.parametrize("name", ["robot", "r2-d2", "left arm", "Ändi", "a.b_c~1", "机器人"])
def test_a_name_becomes_one_chunk_of_a_key(name):
    assert check_robot_name(name) == name
    assert zenoh.KeyExpr("prism/*/odom").includes(zenoh.KeyExpr(key(name, TOPICS["odom"])))


@pytest.mark.parametrize(
    "name",
    ["", "a/b", "/", "*", "a*", "**", "$*", "a$", "a#b", "a?b", "@a", " a", "a ", "a\n", "a\0b", "\udc80"],
)
def test_a_name_that_is_no_chunk_is_refused(name):
    with pytest.raises(ConfigError, match="robot: "):
        check_robot_name(name)


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=8))
def test_whatever_is_accepted_is_a_valid_key_for_zenoh(name):
    try:
        check_robot_name(name)
    except ConfigError:
        return
    expression = zenoh.KeyExpr(key(name, TOPICS["odom"]))  # raises for what is not canonical
    assert zenoh.KeyExpr("prism/*/odom").includes(expression)


def test_keys_are_below_the_robot():
    assert key("r", TOPICS["odom"]) == "prism/r/odom"
    assert key("r", TOPICS["frame"]) == "prism/r/internal/frame"
    assert alive_key("r", "depth") == "prism/r/alive/depth"
    assert ready_key("r", "depth").startswith("prism/r/internal/")


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/bot.local:1", "tls/h:65535#a=b", "unixsock-stream//run/x"],
)
def test_endpoints_that_zenoh_can_use(endpoint):
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize(
    "endpoint",
    ["", "tcp", "tcp/", "127.0.0.1:7447", "http/h:1", "udp/h:1", "tcp/h", "tcp/h:", "tcp/:7447", "tcp/h:0"],
)
def test_a_mistyped_endpoint_is_named(endpoint):
    with pytest.raises(BusError, match="is no endpoint") as caught:
        check_endpoint(endpoint)
    assert repr(endpoint) in str(caught.value)


@pytest.mark.parametrize("endpoint", ["tcp/h:65536", "tcp/h:x", "tcp/h:-1", "tcp/a b:1", "unixsock-stream/"])
def test_an_address_out_of_range_is_no_endpoint(endpoint):
    with pytest.raises(BusError, match="is no endpoint"):
        check_endpoint(endpoint)


@pytest.mark.parametrize(("setting", "most"), [("bus.endpoint", 94), ("network.endpoint", 107)])
@pytest.mark.parametrize("letter", ["x", "ä"])
def test_a_sockets_path_leaves_room_for_those_beside_it(setting, most, letter):
    """107 bytes are what Linux takes; .PID.N of the processes' own, 13 at most, are behind the bus's path."""
    path = ("/run/" + letter * 40).encode().ljust(most, b"x").decode()
    longest = f"unixsock-stream/{path}"
    assert check_endpoint(longest, setting) == longest
    assert check_endpoint(f"{longest}#a=b", setting)
    with pytest.raises(BusError, match=rf"^{setting}: .* path has {most + 1} bytes, and {most} are the most"):
        check_endpoint(f"{longest}x", setting)


@pytest.mark.parametrize(
    ("bus", "network", "same"),
    [
        ("tcp/127.0.0.1:7447", "tcp/0.0.0.0:7447", True),
        ("tcp/localhost:7447", "tls/[::]:7447#x=y", True),
        ("tcp/127.0.0.1:7447", "ws/127.0.0.1:7447", True),
        ("tcp/[::1]:7447", "tcp/[::]:7447", True),
        ("tcp/[::1]:7447", "tcp/0.0.0.0:7447", False),
        ("tcp/127.0.0.1:7447", "tcp/0.0.0.0:7448", False),
        ("tcp/127.0.0.1:7447", "tls/192.168.1.7:7447", False),
        ("tcp/127.0.0.1:7447", "quic/0.0.0.0:7447", False),  # by UDP
        ("unixsock-stream//run/x", "tcp/0.0.0.0:7447", False),
    ],
)
def test_two_endpoints_on_one_port_are_told(bus, network, same):
    assert collide(bus, network) is same
