"""prism_edge: one RGB camera in, metric camera poses out, over Eclipse Zenoh."""

import os

__version__ = "0.1.0"

# From 1.29 on onnxruntime reports to its makers which models it runs, unless this is set before it loads.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
