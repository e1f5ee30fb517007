"""What the daemon runs reports to nobody."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.synthetic.network import write_tiny_network

RUN = """
import sys
from pathlib import Path
from prism_edge.depth.session import OnnxNetwork
print(OnnxNetwork(Path(sys.argv[1])).card.name)
"""
# With these set onnxruntime is silent anyway; and those say where it would keep what it has to report.
LEFT_OUT = {"CI", "ORT_DISABLE_TELEMETRY", "ORT_RUNNING_UNIT_TESTS", "XDG_CACHE_HOME", "XDG_DATA_HOME"}


def test_onnxruntime_keeps_no_reports_for_its_makers(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    network = write_tiny_network(tmp_path / "tiny.onnx")
    environment = {name: value for name, value in os.environ.items() if name not in LEFT_OUT}
    environment["HOME"] = str(home)
    command = [sys.executable, "-c", RUN, str(network)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "tiny_tint\n"), done.stderr
    assert [path.name for path in home.rglob("*") if path.is_file() and "onnxruntime" in str(path)] == []


def test_who_wants_the_reports_may_have_them() -> None:
    environment = os.environ | {"ORT_DISABLE_TELEMETRY": "0"}
    show = "import os, prism_edge; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    command = [sys.executable, "-c", show]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout == "0\n"
