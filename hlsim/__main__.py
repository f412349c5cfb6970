"""``python -m hlsim`` is the program ``hlsim``."""

import sys

from hlsim.cli.main import main

sys.exit(main())
