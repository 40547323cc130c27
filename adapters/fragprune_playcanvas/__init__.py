"""playcanvas/engine: cutoffs in PlayCanvas, by one JavaScript module.

``MODULE`` is its path. The folder is an npm package:
``npm install "$(fragprune bridge playcanvas)"``.
"""

from pathlib import Path

MODULE = Path(__file__).with_name("fragprune-playcanvas.mjs")
"""The bridge, for a page beside PlayCanvas; docs/how-to/playcanvas.md."""
