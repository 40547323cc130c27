"""A photograph and its camera."""

import numpy as np
import torch
from utils.graphics_utils import projection, world_to_view


class Camera:
    """A pinhole camera with its photograph on the device."""

    def __init__(self, uid, rotation, translation, fov_x, fov_y, image, image_name, data_device):
        self.uid, self.image_name = uid, image_name
        self.R, self.T = rotation, translation
        self.FoVx, self.FoVy = fov_x, fov_y
        self.original_image = torch.from_numpy(image).permute(2, 0, 1).float().to(data_device) / 255
        self.image_height, self.image_width = self.original_image.shape[1:]
        self.world_view_transform = world_to_view(rotation, translation).cuda()
        self.projection_matrix = projection(fov_x, fov_y).cuda()
        self.full_proj_transform = self.world_view_transform @ self.projection_matrix
        self.camera_center = self.world_view_transform.inverse()[3, :3]

    @property
    def position(self):
        """Position (3,) of the camera in the world."""
        return -self.R.T @ np.asarray(self.T)
