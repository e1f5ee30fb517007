"""The ORB tracker: features, matching, pose refinement, local map; pure, no I/O."""
