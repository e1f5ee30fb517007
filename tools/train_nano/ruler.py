"""What a picture is to prism-nano: its size, the focal length that depth is told for, and its values."""

from __future__ import annotations

WIDTH, HEIGHT = 128, 96  # of the input
CANONICAL_FOCAL = 104.57  # pixels of the input: what 640x480 with 525 pixels of focal length shrinks to
MEAN, STD = (0.45, 0.45, 0.45), (0.25, 0.25, 0.25)
