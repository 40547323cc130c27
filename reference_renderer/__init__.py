"""The oracle: 3D Gaussian splatting with per-Gaussian truncation, written to be read.

Plain torch, float32 or float64, gradients by autograd, any device; it imports nothing of ours, so
that what it says about our engines is an independent statement. The rules and the quirks are those
of the vanilla CUDA rasterizer, down to which derivatives that rasterizer leaves out.

    covariance -> project -> (sh) -> fragment -> composite,  all called by ``render``.
"""

from reference_renderer.render import render
from reference_renderer.scene import Camera, Gaussians, Options, Rendering

__all__ = ["Camera", "Gaussians", "Options", "Rendering", "render"]
