"""Generate a data set: the command line of datagen, from a checkout without installing it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from datagen.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
