"""`python -m splatpainter` is `splatpainter`."""

import sys

from splatpainter.cli import main

sys.exit(main())
