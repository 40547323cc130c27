"""The part of gsplat's reader of scenes that tells how it turned and scaled the world."""

import numpy as np

WORLD = np.array([[0.0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, -3], [0, 0, 0, 1]])


class Parser:
    def __init__(self, data_dir, normalize):
        self.data_dir = data_dir
        self.transform = WORLD if normalize else np.eye(4)
