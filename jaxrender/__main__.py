"""`python -m jaxrender`: the `jaxrender` command where its script is not on the path."""

import sys

from jaxrender.cli import main

if __name__ == "__main__":
    sys.exit(main())
