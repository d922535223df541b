"""`python -m nexwarp` does what `nexwarp` does."""

import sys

from nexwarp.cli.main import main

sys.exit(main())
