"""prism_edge: one RGB camera in, metric camera poses out, over Eclipse Zenoh."""

__version__ = "0.1.0"
