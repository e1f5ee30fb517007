"""Depth Anything 3 checkpoints as ONNX files that prism_edge runs (docs/EXPORT.md)."""

import os
import warnings

# Before the package is imported: it logs each layer it makes, and uses a deprecated call.
os.environ.setdefault("DA3_LOG_LEVEL", "ERROR")
warnings.filterwarnings("ignore", message="register_new_resolver")
