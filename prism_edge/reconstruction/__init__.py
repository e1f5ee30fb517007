"""Offline dense reconstruction: a finished map, its pictures and a depth network make one metric cloud.

Paper, section 3.6 (Offline Global Metric Reconstruction): keyframes are where the last adjustment put them,
their depth maps are brought into agreement with the map and with each other, what the gate takes for moving
is left out, and what remains is one cloud of points with normals and colours. Nothing here reads or writes.
"""
