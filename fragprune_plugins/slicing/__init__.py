"""Gaussians in space and time become 3D Gaussians at a moment, for RT-4DGS.

``splats`` holds the values, ``cutting`` the function ``slice_at``.
"""
