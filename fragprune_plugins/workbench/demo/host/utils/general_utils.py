"""Inverse activations, schedules, rotations and seeds."""

import math
import random

import numpy as np
import torch


def inverse_sigmoid(x):
    """The logit of x, the inverse of the sigmoid."""
    return torch.log(x / (1 - x))


def get_expon_lr_func(lr_init, lr_final, max_steps):
    """A function step -> learning rate: geometric from lr_init to lr_final, then constant."""

    def rate(step):
        if lr_init == 0:
            return 0.0
        part = min(max(step / max_steps, 0.0), 1.0)
        return math.exp((1 - part) * math.log(lr_init) + part * math.log(lr_final))

    return rate


def build_rotation(quaternions):
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), w first, of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def build_covariance(scaling, modifier, quaternions):
    """Upper triangles (N, 6) of the covariances of scales (N, 3) and quaternions (N, 4)."""
    axes = build_rotation(quaternions) * (modifier * scaling)[:, None, :]
    full = axes @ axes.transpose(1, 2)
    row, column = torch.triu_indices(3, 3, device=full.device)
    return full[:, row, column]


def safe_state(seed):
    """Seed all random generators and choose the device."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.cuda.set_device(torch.device("cuda:0"))
