"""``python -m reproduction ID``: the command line of this folder."""

import sys

from reproduction.command import main

if __name__ == "__main__":
    sys.exit(main())
