"""The oracle: 3D Gaussian splatting with per-Gaussian truncation, written to be read.

Plain torch, float32 or float64, gradients by autograd, any device; it imports nothing of ours, so
it is an independent test of our engines. The rules and the quirks are those of the vanilla CUDA
rasterizer, including the derivatives that it leaves out.

    covariance -> project -> (sh) -> fragment -> composite,  all called by ``render``.

``render_footprints`` starts after the projection, for hosts with their own projection.
``slice_gaussians`` comes first, for Gaussians in space and time. ``blended`` gives the fragments.
"""

from reference_renderer.project import Footprints
from reference_renderer.render import Blended, blended, render, render_footprints
from reference_renderer.scene import Camera, Gaussians, Options, Rendering
from reference_renderer.slice4d import SpacetimeGaussians, slice_gaussians

__all__ = [
    "Blended",
    "Camera",
    "Footprints",
    "Gaussians",
    "Options",
    "Rendering",
    "SpacetimeGaussians",
    "blended",
    "render",
    "render_footprints",
    "slice_gaussians",
]
