"""A generated sequence with exact truth, and a tiny network that reads depth from its colours."""
