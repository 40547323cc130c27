"""Makes the photographs: ``cd docs/experiments; python -m lab.room FOLDER``."""

import sys
from pathlib import Path

from lab.room.photographs import make_scene

if __name__ == "__main__":
    make_scene(Path(sys.argv[1]))
