"""`python -m nexwarp` does what `nexwarp` does."""

import sys

from nexwarp.cli import main

sys.exit(main())
