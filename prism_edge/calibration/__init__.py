"""Intrinsics from views of a board, and a rolling shutter's readout (docs/CAMERAS.md); pure."""
