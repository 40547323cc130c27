"""The files by which a folder is known to have Blender's or nerfstudio's layout."""

from pathlib import Path

PAIR, SINGLE = ("transforms_train.json", "transforms_test.json"), "transforms.json"


def has_transforms(folder: Path) -> bool:
    """Whether a folder has one of the two."""
    return (folder / PAIR[0]).exists() or (folder / SINGLE).exists()
