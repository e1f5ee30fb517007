#!/bin/bash
# Runs the tests with the oldest release of everything that pyproject.toml allows, in .venv-oldest: a lower bound
# that nobody has tried is a guess. Use: oldest.sh [OPTION OF PYTEST...]
set -euo pipefail
cd "$(dirname "$0")/.."
environment=.venv-oldest
# The oldest Python too: of some of these releases there are no wheels for a newer one, and they don't build there.
python="$(PYTHON="${PYTHON:-python3.11}" tools/find_python.sh)"
"$python" -m venv --clear "$environment"
# What only developers have is as new as it likes, but for onnx: the tests' networks are for that onnxruntime.
"$environment/bin/python" - > "$environment/oldest.txt" << 'END'
import tomllib

with open("pyproject.toml", "rb") as file:
    project = tomllib.load(file)["project"]
extras = project["optional-dependencies"]
wanted = project["dependencies"] + extras["metrics"] + extras["streams"] + extras["oak"]
wanted += [one for one in extras["dev"] if one.startswith("onnx")]
print("\n".join(one.replace(">=", "==") for one in wanted))
END
cat "$environment/oldest.txt"
"$environment/bin/python" -m pip install --quiet --disable-pip-version-check \
    --constraint "$environment/oldest.txt" --editable '.[dev,metrics,streams,oak]'
exec "$environment/bin/python" -m pytest -m "not slow" --numprocesses 2 "$@"
