"""`python -m univoxel.cli`."""

import sys

from univoxel.cli import main

if __name__ == "__main__":
    sys.exit(main())
