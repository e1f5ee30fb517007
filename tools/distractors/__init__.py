"""Moving objects for recordings in which nothing moves (tools/make_distractors.py)."""
