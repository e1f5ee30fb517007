"""The global map and its optimisation; on gtsam; pure, but for map_file.py and journal.py."""
