"""Tools that need more than the package does, where that is not installed."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.mark.parametrize(
    ("tool", "package", "module"),
    [("measure_cloud", "scipy", "scipy.spatial"), ("expose_descriptor", "onnx", "onnx")],
)
def test_they_say_so_in_a_line(tool: str, package: str, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)  # as if it were not there
    with pytest.raises(SystemExit, match=f"^{tool}: error: needs {package}; the extra dev has it$"):
        runpy.run_path(str(TOOLS / f"{tool}.py"))


def test_the_export_tool_names_the_environment_that_has_what_it_lacks(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match=r"^export_da3: error: needs torch: .*\.venv-export"):
        runpy.run_path(str(TOOLS / "export_da3"))
