"""Makes the pictures of docs/gallery.md and README: ``python docs/gallery.py DEMO``.

    fragprune demo --out DEMO
    python docs/gallery.py DEMO

It audits the demo's original, and puts what both commands wrote side by side.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

GALLERY = Path(__file__).parent / "gallery"
TILE = (320, 240)


def main(demo: Path) -> None:
    """All pictures."""
    with tempfile.TemporaryDirectory() as folder:
        audit = Path(folder)
        trained = next((demo / "model").rglob("iteration_1000/point_cloud.ply"))
        fragprune("audit", trained, "--data", demo / "scene", "--out", audit)
        for view in ("view_032", "view_024"):
            shown = [demo / "pictures" / f"{view}_{what}.png" for what in ("original", "pruned")]
            maps = [path.with_stem(f"{path.stem}_fragments") for path in shown]
            errors = [path.with_stem(f"{path.stem}_error") for path in shown]
            side_by_side(f"{view}.jpg", [shown, maps, errors])
        (drawn,) = sorted(audit.glob("*_overdraw.png"))[:1]
        names = (drawn.stem.removesuffix("_overdraw") + end for end in ("", "_fragments"))
        side_by_side("audit.jpg", [[*(drawn.with_stem(name) for name in names), drawn]])
        shutil.copyfile(demo / "pictures" / "learning.png", GALLERY / "learning.png")
        shutil.copyfile(demo / "pictures" / "banner.jpg", GALLERY.with_name("demo.jpg"))


def fragprune(*arguments: object) -> None:
    """One command."""
    command = [sys.executable, "-m", "fragprune_plugins", *map(str, arguments)]
    subprocess.run(command, check=True)


def side_by_side(name: str, rows: list[list[Path]]) -> None:
    """Pictures in rows, a little apart."""
    gap, (width, height) = 6, TILE
    size = len(rows[0]) * (width + gap) - gap, len(rows) * (height + gap) - gap
    sheet = Image.new("RGB", size, "white")
    for y, row in enumerate(rows):
        for x, path in enumerate(row):
            picture = Image.open(path).convert("RGB").resize(TILE)
            sheet.paste(picture, (x * (width + gap), y * (height + gap)))
    sheet.save(GALLERY / name, quality=78, optimize=True)


if __name__ == "__main__":
    GALLERY.mkdir(exist_ok=True)
    main(Path(sys.argv[1]))
