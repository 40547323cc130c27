"""The photographs, and the model's folder."""

import json
import random
from pathlib import Path

import numpy as np
from utils.graphics_utils import fov2focal

from scene.dataset_readers import read_cameras, read_points
from scene.gaussian_model import GaussianModel


class Scene:
    """Cameras, split into training and test views, and one model."""

    gaussians: GaussianModel

    def __init__(
        self, args, gaussians, load_iteration=None, shuffle=True, resolution_scales=(1.0,)
    ):
        self.model_path, self.gaussians = args.model_path, gaussians
        self.loaded_iter = load_iteration
        if load_iteration == -1:
            folders = (Path(self.model_path) / "point_cloud").iterdir()
            self.loaded_iter = max(int(folder.name.rsplit("_", 1)[1]) for folder in folders)
        cameras = read_cameras(args)
        train = [c for i, c in enumerate(cameras) if i % 8 or not args.eval]
        test = [c for i, c in enumerate(cameras) if i % 8 == 0 and args.eval]
        centres = np.array([camera.position for camera in train])
        reach = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
        self.cameras_extent = 1.1 * float(reach)
        if not self.loaded_iter:
            self._write_cameras(test + train)
        if shuffle:
            random.shuffle(train)
            random.shuffle(test)
        self.train_cameras = dict.fromkeys(resolution_scales, train)
        self.test_cameras = dict.fromkeys(resolution_scales, test)
        if self.loaded_iter:
            gaussians.load_ply(self._ply(self.loaded_iter))
        else:
            gaussians.create_from_pcd(read_points(args), self.cameras_extent)

    def save(self, iteration):
        """Write the model to point_cloud/iteration_N/point_cloud.ply."""
        self.gaussians.save_ply(self._ply(iteration))

    def getTrainCameras(self, scale=1.0):  # noqa: N802 - the name callers use
        """The training views."""
        return self.train_cameras[scale]

    def getTestCameras(self, scale=1.0):  # noqa: N802 - the name callers use
        """The held-out views: every eighth with ``--eval``, else none."""
        return self.test_cameras[scale]

    def _ply(self, iteration):
        folder = Path(self.model_path) / "point_cloud" / f"iteration_{iteration}"
        return str(folder / "point_cloud.ply")

    def _write_cameras(self, cameras):
        rows = [
            {
                "id": camera.uid,
                "img_name": camera.image_name,
                "width": camera.image_width,
                "height": camera.image_height,
                "position": camera.position.tolist(),
                "rotation": camera.R.T.tolist(),
                "fx": fov2focal(camera.FoVx, camera.image_width),
                "fy": fov2focal(camera.FoVy, camera.image_height),
            }
            for camera in cameras
        ]
        (Path(self.model_path) / "cameras.json").write_text(json.dumps(rows))
