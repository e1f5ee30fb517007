"""The global map and its optimisation; pure, on gtsam."""
