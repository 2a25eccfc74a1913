"""`python -m torchkcreg`."""

import sys

from torchkcreg.cli import main

if __name__ == "__main__":
    sys.exit(main())
