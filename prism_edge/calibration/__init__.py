"""Intrinsics from views of a board (docs/CAMERAS.md); pure."""
