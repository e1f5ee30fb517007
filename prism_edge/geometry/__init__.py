"""Rigid-body poses, camera models and alignment; pure numpy."""
