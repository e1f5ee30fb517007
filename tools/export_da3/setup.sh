#!/usr/bin/env bash
# Makes the export tool's own environment: tools/export_da3/setup.sh [FOLDER] [PIP OPTION...]
# FOLDER is .venv-export by default. Pip options go to the installation of the requirements, such as an
# index that has PyTorch without CUDA.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
folder="$here/../../.venv-export"
if [[ $# -gt 0 && $1 != -* ]]; then
    folder="$1"
    shift
fi
if ! "$folder/bin/python" -m pip --version >/dev/null 2>&1; then
    python=$("$here/../find_python.sh")
    "$python" -m venv --clear "$folder"
fi
pip=("$folder/bin/python" -m pip install --quiet --disable-pip-version-check)
"${pip[@]}" --requirement "$here/requirements.txt" "$@"
"${pip[@]}" --no-deps depth-anything-3==0.1.1
"$folder/bin/python" -W ignore -c "import torch, onnx, depth_anything_3.model.da3"
echo "ready: $folder/bin/python tools/export_da3 --help"
