"""`python -m splatpainter` is `splatpainter`."""

import sys

from splatpainter.cli import main

if __name__ == "__main__":
    sys.exit(main())
