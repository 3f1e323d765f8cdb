"""python -m fitting train | evaluate | relight | inspect"""

import sys

from fitting.cli import main

if __name__ == "__main__":
    sys.exit(main())
