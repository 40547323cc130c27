"""sparkjsdev/spark: cutoffs in Spark on three.js, by one JavaScript module.

``MODULE`` is its path. The folder is an npm package:
``npm install "$(fragprune bridge spark)"``.
"""

from pathlib import Path

MODULE = Path(__file__).with_name("fragprune-spark.mjs")
"""The bridge, for a page beside Spark; docs/how-to/spark.md."""
