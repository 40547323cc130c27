import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fragprune_plugins.workbench.demo.scene import make_scene


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """A copy: hosts write into the data they are given."""
    given, target = os.environ.get("FRAGPRUNE_TEST_DATA"), tmp_path_factory.mktemp("data") / "scene"
    candidates = [Path(given) / "fox" / "colmap160", Path(given)] if given else []
    for candidate in candidates:
        if (candidate / "sparse").is_dir():
            shutil.copytree(candidate, target)
            return target
    make_scene(target, views=12, width=80, points=600)
    return target


@pytest.fixture
def recording(tmp_path):
    """A disc that moves, seen from eight places at eight times; two views are held out."""
    folder = tmp_path / "data"
    y, x = np.mgrid[:48, :48]
    for part, times in (("train", np.arange(8) / 8), ("test", (0.3, 0.7))):
        (folder / part).mkdir(parents=True)
        frames = []
        for number, time in enumerate(times):
            disc = ((x - 16 - 16 * time) ** 2 + (y - 24) ** 2 < 100) * 255
            picture = np.stack([disc, disc // 2, 255 - disc, 55 + disc * 200 // 255], axis=2)
            Image.fromarray(picture.astype(np.uint8)).save(folder / part / f"{number}.png")
            angle = 2 * np.pi * number / 10
            turn = np.array(
                [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
            )
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, turn @ [0, 0, 3.5]
            frames.append(
                {"file_path": f"./{part}/{number}", "time": time, "transform_matrix": pose.tolist()}
            )
        contents = {"camera_angle_x": 0.8, "frames": frames}
        (folder / f"transforms_{part}.json").write_text(json.dumps(contents, default=float))
    return folder
