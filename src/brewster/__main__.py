"""`python -m brewster` is `brewster`."""

import sys

from brewster.cli import main

if __name__ == "__main__":
    sys.exit(main())
