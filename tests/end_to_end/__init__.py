"""The whole daemon as a user runs it: real processes, a generated recording, a tiny network."""
