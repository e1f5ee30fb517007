"""The types of the bus are those of the ROS 2 releases, field by field."""

from __future__ import annotations

import subprocess
import sys

import pytest
from rosbags.typesys import Stores, get_typestore

from prism_edge.bus.ros_types import STANDARD, type_store


@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
@pytest.mark.parametrize("name", STANDARD)
def test_a_standard_type_is_the_releases(name: str, release: Stores) -> None:
    # constants are left out: they are on no wire
    assert type_store().fielddefs[name][1] == get_typestore(release).fielddefs[name][1]


@pytest.mark.parametrize("name", STANDARD)
def test_a_standard_type_has_the_releases_hash(name: str) -> None:
    assert type_store().hash_rihs01(name) == get_typestore(Stores.ROS2_JAZZY).hash_rihs01(name)


def test_no_release_is_loaded_for_it() -> None:
    loaded = "[name for name in sys.modules if name.startswith('rosbags.typesys.stores.')]"
    script = f"import sys, prism_edge.bus.ros; print({loaded})"
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert said == "[]\n"
