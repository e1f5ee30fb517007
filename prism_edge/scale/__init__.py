"""Metres per map unit: depth samples, least squares over one keyframe, filter over time; pure numpy."""
