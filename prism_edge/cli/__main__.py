"""``python -m prism_edge.cli``."""

import sys

from prism_edge.cli.main import script
from prism_edge.cli.own_release import go_to_own_release

if sys.argv[1:2] == ["run"]:  # it stays for weeks, and starts processes all that time
    go_to_own_release(sys.orig_argv[1:])
sys.exit(script())
