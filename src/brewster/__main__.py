"""Makes `python -m brewster` run the command line."""

import sys

from brewster.cli import main

if __name__ == "__main__":
    sys.exit(main())
