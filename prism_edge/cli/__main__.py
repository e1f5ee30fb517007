"""``python -m prism_edge.cli``."""

import sys

from prism_edge.cli.main import main

sys.exit(main())
