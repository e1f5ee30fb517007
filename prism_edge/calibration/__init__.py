"""Intrinsics from views of a calibration board (docs/CAMERAS.md); pure: images in, a camera out."""
