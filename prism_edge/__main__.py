"""``python -m prism_edge``: what ``prism-edge`` does."""

import sys

from prism_edge.cli.main import script

sys.exit(script())
