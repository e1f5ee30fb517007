"""Starts, watches and restarts the five processes; holds the bus's listener."""
