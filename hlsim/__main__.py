"""``python -m hlsim`` is the program ``hlsim``."""

import sys

from hlsim.cli import main

sys.exit(main())
