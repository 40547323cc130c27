"""The inputs and outputs of one rasterization. Frozen; construction checks shapes."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from fragprune_plugins.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    COEFFICIENTS_MAX,
    DILATION,
    FEATURES_MAX,
    FOCAL_MAX,
    FOCAL_MIN,
    NEAR,
    SIDE_MAX,
    STOPPED_ALPHA_MAX,
    TRANSMITTANCE_MIN,
)
from fragprune_plugins.errors import InputError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Compensation = Literal["none", "antialiasing", "mip"]
"""What keeps a dilated Gaussian's weight, by name; ``RasterInputs`` has the formulas."""

Rim = Literal["hard", "soft"]
"""How thresholds cut, by name; ``RasterInputs`` has the formula."""

Plane = Literal["invdepth", "alpha", "surface"]
"""What is drawn beside the image, by its name in ``RasterOutputs``."""


def one_line(thing: Any) -> str:
    """The ``__repr__`` of a dataclass with tensors; fields that are None are left out."""
    held = {each.name: getattr(thing, each.name) for each in fields(thing)}
    inside = [f"{name}={short(value)}" for name, value in held.items() if value is not None]
    return f"{type(thing).__name__}({', '.join(inside)})"


def short(value: Any) -> str:
    """A tensor as ``float32[9, 3]``, with its device unless it is the CPU; a list as its length.

    Of a tensor that holds one number without an axis, that number.
    """
    if getattr(value, "ndim", None) == 0:
        return f"{value.item():.6g}"
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = str(value.dtype).removeprefix("torch.")
        device = str(getattr(value, "device", "cpu"))
        return f"{kind}{list(value.shape)}" + ("" if device == "cpu" else f" on {device}")
    if isinstance(value, list | tuple | dict):
        return f"[{len(value)} items]"
    return repr(value)


def check_tensor(
    name: str, tensor: Any, *shape: int | None, whole: bool = False, needed: bool = False
) -> None:
    """Raise InputError unless tensor is None and not needed, or holds real numbers in the shape.

    Args:
        tensor: the value to check; only a dense tensor with its data in memory passes.
        shape: lengths; None stands for any.
        whole: require an integer type instead of a floating one.
    """
    if tensor is None and not needed:
        return
    import torch

    found = expected = ""
    if not isinstance(tensor, torch.Tensor):
        found = "None" if tensor is None else f"a {type(tensor).__name__}"
        expected = "a torch.Tensor"
    elif tensor.is_meta or tensor.layout is not torch.strided:
        found, expected = f"{tensor.layout} on {tensor.device}", "a dense tensor with its numbers"
    elif tensor.dtype is torch.bool or tensor.is_complex() or tensor.is_floating_point() is whole:
        found = str(tensor.dtype)
        expected = "integers" if whole else "floating-point numbers"
    elif tensor.ndim != len(shape) or any(
        want not in (None, have) for want, have in zip(shape, tensor.shape, strict=True)
    ):
        lengths = ["any" if want is None else str(want) for want in shape]
        found = f"shape {tuple(tensor.shape)}"
        expected = f"shape ({', '.join(lengths)}{',' * (len(lengths) == 1)})"
    if found:
        raise InputError(name, found, expected, "Check the call's arguments.")


def check_fields(thing: Any, **shapes: tuple[int | None, ...]) -> None:
    """Check a dataclass's tensors, as ``check_tensor`` does; those without a default must be there.

    Args:
        shapes: by a field's name.
    """
    own, kind = thing.__dataclass_fields__, type(thing).__name__
    for name, shape in shapes.items():
        needed = own[name].default is MISSING
        check_tensor(f"{kind}.{name}", getattr(thing, name), *shape, needed=needed)


def check_values(thing: Any, **checks: tuple[bool, object]) -> None:
    """Check a dataclass's plain values.

    Args:
        checks: by a field's name, whether its value is right, and what is expected.
    """
    for name, (right, expected) in checks.items():
        if not right:
            where, found = f"{type(thing).__name__}.{name}", repr(getattr(thing, name))
            raise InputError(where, found, str(expected), "Check the call's arguments.")


def check_lens(
    width: int, height: int, fx: float, fy: float, cx: float | None, cy: float | None
) -> None:
    """Check that numbers are those of a lens: arguments of ``View.pinhole``.

    Raises:
        InputError: the picture has no pixel or more than engines draw, or a focal length or the
            principal point is not finite or out of proportion to the picture.
    """
    if not (1 <= width <= SIDE_MAX and 1 <= height <= SIDE_MAX):
        expected = f"at least 1x1, and sides up to {SIDE_MAX}"
        raise InputError("View", f"{width}x{height} pixels", expected, "Check the camera.")
    for name, focal, side in (("fx", fx, width), ("fy", fy, height)):
        if not FOCAL_MIN * side <= focal <= FOCAL_MAX * side:
            expected = f"a focal length of {FOCAL_MIN:g} to {FOCAL_MAX:g} times {side} pixels"
            raise InputError(name, f"{focal:g}", expected, "Check the camera.")
    for name, centre, side in (("cx", cx, width), ("cy", cy, height)):
        if centre is not None and not abs(centre) <= FOCAL_MAX * side:
            expected = f"a place near {side} pixels"
            raise InputError(name, f"{centre:g}", expected, "Check the camera.")


def _check_features(name: str, tensor: Tensor | None, n: int) -> None:
    """Raise InputError unless tensor is None or (n, F) with F in 1 to FEATURES_MAX."""
    check_tensor(name, tensor, n, None)
    if tensor is not None and not 1 <= (count := tensor.shape[1]) <= FEATURES_MAX:
        remedy = "Blend more in several rasterizations."
        raise InputError(name, f"{count} channels", f"1 to {FEATURES_MAX}", remedy)


def check_degree(name: str, sh: Tensor | None, degree: int, sh_rest: Tensor | None = None) -> None:
    """Raise InputError unless the degree is 0 to 3, and has as many coefficients as it takes."""
    if not 0 <= degree <= 3:
        raise InputError(f"{name}.sh_degree", str(degree), "0 to 3", "Lower the SH degree.")
    if sh is None:
        return
    count = sh.shape[1] + (0 if sh_rest is None else sh_rest.shape[1])
    expected, remedy = f"at most {COEFFICIENTS_MAX}", "Pass (N, coefficients, 3)."
    if count < (least := (degree + 1) ** 2):
        expected = f"at least {least} for degree {degree}"
        remedy = "Lower the SH degree or pass all coefficients."
    if not least <= count <= COEFFICIENTS_MAX:
        raise InputError(f"{name}.sh", f"{count} coefficients", expected, remedy)


@dataclass(frozen=True)
class View:
    """One camera at one moment, in the hosts' convention.

    Matrices act on row vectors (the hosts keep them transposed): ``p_view = [p, 1] @ viewmatrix``.

    Attributes:
        width: pixels.
        height: pixels.
        tan_fov_x: tangent of half the horizontal field of view.
        tan_fov_y: tangent of half the vertical field of view.
        viewmatrix: (4, 4) world to camera, x right, y down, z forward.
        projmatrix: (4, 4) world to clip; it alone decides where means land on the image.
        campos: (3,) camera centre in the world, for view-dependent colour.
        background: (3,) RGB.
    """

    width: int
    height: int
    tan_fov_x: float
    tan_fov_y: float
    viewmatrix: Tensor
    projmatrix: Tensor
    campos: Tensor
    background: Tensor

    __repr__ = one_line

    def __post_init__(self) -> None:
        least = "at least 1 pixel"
        check_values(self, width=(self.width > 0, least), height=(self.height > 0, least))
        check_fields(self, viewmatrix=(4, 4), projmatrix=(4, 4), campos=(3,), background=(3,))

    def to(self, device: torch.device | str) -> View:
        """The same camera with its tensors on a device."""
        tensors = ("viewmatrix", "projmatrix", "campos", "background")
        return replace(self, **{name: getattr(self, name).to(device) for name in tensors})

    @classmethod
    def pinhole(
        cls,
        rotation: Tensor,
        translation: Tensor,
        *,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float | None = None,
        cy: float | None = None,
        background: Tensor | None = None,
    ) -> View:
        """A pinhole camera; the principal point may be off centre (the hosts ignore theirs).

        Args:
            rotation: (3, 3) world to camera, ``p_cam = rotation @ p_world + translation``.
            translation: (3,).
            width: pixels.
            height: pixels.
            fx: focal length, pixels.
            fy: focal length, pixels.
            cx: principal point, pixels, COLMAP convention (centre of the image = width / 2).
            cy: principal point, pixels.
            background: (3,) RGB; black when None.

        Raises:
            InputError: invalid intrinsics, see ``check_lens``.
        """
        import torch

        check_lens(width, height, fx, fy, cx, cy)
        tan_x, tan_y = width / (2 * fx), height / (2 * fy)
        view = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
        view[:3, :3] = rotation.T
        view[3, :3] = translation
        # 3DGS's getProjectionMatrix (znear .01, zfar 100), plus the principal point's offset.
        near, far = 0.01, 100.0
        clip = torch.zeros_like(view)
        clip[0, 0] = 1 / tan_x
        clip[1, 1] = 1 / tan_y
        clip[2, 0] = 0.0 if cx is None else 2 * cx / width - 1
        clip[2, 1] = 0.0 if cy is None else 2 * cy / height - 1
        clip[2, 2] = far / (far - near)
        clip[2, 3] = 1.0
        clip[3, 2] = -(far * near) / (far - near)
        return cls(
            width=width,
            height=height,
            tan_fov_x=tan_x,
            tan_fov_y=tan_y,
            viewmatrix=view,
            projmatrix=view @ clip,
            campos=-rotation.T @ translation,
            background=view.new_zeros(3) if background is None else background,
        )


@dataclass(frozen=True)
class Splats:
    """N Gaussians, activated. Either scales and rotations or cov3d; either sh or colors.

    Attributes:
        means: (N, 3) world.
        opacities: (N,) in (0, 1).
        scales: (N, 3) standard deviations, world units; (N, 2) of surfels, see ``flat``.
        rotations: (N, 4) quaternions w, x, y, z; used as given, the host normalises.
        cov3d: (N, 6) upper triangle xx, xy, xz, yy, yz, zz; scale_modifier does not apply.
        sh: (N, K, 3), K = (degree + 1)^2 or more; (N, 1, 3) with ``sh_rest``.
        colors: (N, 3) RGB, used as given.
        sh_degree: 0 to 3, how many bands of ``sh`` are used.
        features: (N, F), F in 1 to 8: more channels, blended as colour is, without background.
        sh_rest: (N, K - 1, 3) coefficients behind the first, for an engine whose ``sh_apart`` is
            True.
    """

    means: Tensor
    opacities: Tensor
    scales: Tensor | None = None
    rotations: Tensor | None = None
    cov3d: Tensor | None = None
    sh: Tensor | None = None
    colors: Tensor | None = None
    sh_degree: int = 0
    features: Tensor | None = None
    sh_rest: Tensor | None = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self, means=(None, 3))
        n, first = len(self.means), None if self.sh_rest is None else 1
        check_fields(self, opacities=(n,), scales=(n, 2 if self.flat else 3), rotations=(n, 4))
        check_fields(self, cov3d=(n, 6), sh=(n, first, 3), sh_rest=(n, None, 3), colors=(n, 3))
        _check_features("Splats.features", self.features, n)
        remedy, turned = "Pass one of the two.", self.rotations is not None
        if (self.scales is not None) != turned or turned == (self.cov3d is not None):
            expected = "exactly one of (scales and rotations) or cov3d"
            raise InputError("Splats", "scales, rotations and cov3d as given", expected, remedy)
        if (self.sh is None) == (self.colors is None):
            found = "both or neither of sh and colors"
            raise InputError("Splats", found, "exactly one of them", remedy)
        check_degree("Splats", self.sh, self.sh_degree, self.sh_rest)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def flat(self) -> bool:
        """Whether they are surfels: two scales each, drawn by the rules of 2D Gaussian Splatting.

        A pixel's ray meets a surfel in the plane of the first two axes of its rotation. A threshold
        acts on the falloff there.
        """
        return getattr(self.scales, "ndim", 0) == 2 and self.scales.shape[1] == 2  # type: ignore[union-attr]

    @property
    def device(self) -> torch.device:
        """The device of the Gaussians."""
        return self.means.device


@dataclass(frozen=True)
class Footprints:
    """N Gaussians that are already projected, for dialects with their own projection.

    A Gaussian draws nothing if it has no tiles, its depth is not positive, or its conic is not
    positive definite. Everything but ``tiles`` is differentiable.

    Attributes:
        means2d: (N, 2) pixels; (0, 0) is the centre of the first pixel.
        conics: (N, 3) inverse covariances xx, xy, yy, pixels^-2.
        depths: (N,) the order of blending, ties by row; 1 / depth feeds ``invdepth``.
        opacities: (N,) in (0, 1), used as given.
        colors: (N, 3) RGB, used as given.
        tiles: (N, 4) integers x0, y0, x1, y1, half open: the 16x16 tiles it may draw in.
        features: as in ``Splats``.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    tiles: Tensor
    features: Tensor | None = None
    flat: ClassVar[bool] = False  # none is a surfel

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self, means2d=(None, 2))
        n = len(self.means2d)
        check_fields(self, conics=(n, 3), depths=(n,), opacities=(n,), colors=(n, 3))
        check_tensor("Footprints.tiles", self.tiles, n, 4, whole=True)
        _check_features("Footprints.features", self.features, n)

    def __len__(self) -> int:
        return len(self.means2d)

    @property
    def device(self) -> torch.device:
        """The device of the Gaussians."""
        return self.means2d.device


def is_rim(value: object) -> bool:
    """Whether a value can be the ``rim`` of ``RasterInputs``."""
    return value in get_args(Rim)


def is_stop(value: object) -> bool:
    """Whether a value can be the ``stop`` of ``RasterInputs``."""
    if value is None or isinstance(value, bool):
        return value is None
    return isinstance(value, float | int) and TRANSMITTANCE_MIN <= value <= 1


@dataclass(frozen=True)
class RasterInputs:
    """The inputs of one rasterization, for any dialect that the engines support.

    With ``Footprints``, only the size and background of the view are used; scale_modifier,
    dilation, compensation and near are ignored. Surfels (``Splats.flat``) ignore dilation, and take
    no features, compensation, sample_offsets or absolute_gradient.

    Attributes:
        view: the camera.
        splats: the Gaussians, in the world or on the image.
        means2d_hook: (N, 3) or None; values unused, its gradient is the host's NDC-scaled screen
            gradient (x0.5 W, x0.5 H) in [:, :2]; see ``absolute_gradient`` for [:, 2].
        scale_modifier: factor on the scales.
        dilation: pixels^2 added to the 2D covariance's diagonal.
        compensation: factor on opacity by the determinants d0, d1 of the 2D covariance before and
            after dilation. "antialiasing": sqrt(max(2.5e-5, d0 / d1)). "mip", Mip-Splatting's:
            sqrt(d0 / (d1 + 1e-6) + 1e-6), and 0 where either is at most 1e-6.
        counts: also count drawn fragments per pixel and per Gaussian.
        near: view depth at or below which a Gaussian is culled; 0 or more.
        sample_offsets: (H, W, 2) or None; pixel (x, y) is sampled at (x, y) + its offset, finite,
            in pixels. Not differentiable.
        absolute_gradient: the hook's gradient in [:, 2] is the sum over pixels of |gx| + |gy|,
            (gx, gy) being the pixel's share of [:, :2]; else 0.
        scores: also give each Gaussian's weights and wins, and the pixels' winners.
        alpha_max: alpha is capped here; 1/255 to 1.
        cap_gradient: the gradient passes through the cap; else it is 0 where alpha was capped.
        stop: a share of a pixel's light, 1e-4 to 1; ``alpha_max`` is then at most 0.999. The pixel
            draws the fragment that leaves less of its light, and stops behind it. Gradients take
            what it leaves out to look like that fragment. None for the hosts' rule: the pixel stops
            before the fragment that would leave less than 1e-4.
        rim: how a threshold cuts. "hard": a pixel whose centre lies outside draws no fragment, and
            the threshold's gradient is a surrogate. "soft": alpha is times the share of the pixel
            that is covered, clamp(1/2 + d, 0, 1), d being the distance of its centre to the rim
            in pixels, to first order; every gradient is the true one. Surfels have a hard rim.
        planes: those beside the image that somebody will look at, by their names in
            ``RasterOutputs``. An engine may spare itself the others, or draw them all the same.
    """

    view: View
    splats: Splats | Footprints
    means2d_hook: Tensor | None = None
    scale_modifier: float = 1.0
    dilation: float = DILATION
    compensation: Compensation = "none"
    counts: bool = False
    near: float = NEAR
    sample_offsets: Tensor | None = None
    absolute_gradient: bool = False
    scores: bool = False
    alpha_max: float = ALPHA_MAX
    cap_gradient: bool = True
    stop: float | None = None
    rim: Rim = "hard"
    planes: tuple[Plane, ...] = get_args(Plane)

    __repr__ = one_line

    def __post_init__(self) -> None:
        highest = 1 if self.stop is None else STOPPED_ALPHA_MAX
        check_values(
            self,
            view=(isinstance(self.view, View), "a View, such as the .view of a photograph"),
            compensation=(self.compensation in get_args(Compensation), get_args(Compensation)),
            near=(self.near >= 0, "0 or more"),
            stop=(is_stop(self.stop), "None, or 1e-4 to 1"),
            rim=(is_rim(self.rim), get_args(Rim)),
            alpha_max=(ALPHA_MIN <= self.alpha_max <= highest, f"1/255 to {highest}"),
            planes=(set(self.planes) <= set(get_args(Plane)), f"of {get_args(Plane)}"),
        )
        size = self.view.height, self.view.width
        check_fields(self, means2d_hook=(len(self.splats), None), sample_offsets=(*size, 2))
        self._check_surfels()
        hook = self.means2d_hook
        if self.absolute_gradient and hook is not None and hook.shape[1] < 3:
            found, expected = f"{hook.shape[1]} columns", "3 or more with absolute_gradient"
            raise InputError("RasterInputs.means2d_hook", found, expected, "Pass a wider hook.")

    def _check_surfels(self) -> None:
        """Raise InputError if surfels come with what their rasterizer does not know."""
        if not self.splats.flat:
            return
        given = {
            "features": self.splats.features is not None,
            "compensation": self.compensation != "none",
            "sample_offsets": self.sample_offsets is not None,
            "absolute_gradient": self.absolute_gradient,
            "a soft rim": self.rim != "hard",
        }
        if any(given.values()):
            found = f"surfels (2 scales each) with {', '.join(k for k, v in given.items() if v)}"
            raise InputError("RasterInputs", found, "surfels without them", "Leave them out.")

    def check_thresholds(self, thresholds: Tensor | None) -> None:
        """Raise InputError unless there is one threshold per Gaussian, or None.

        Args:
            thresholds: (N,) falloff in (0, 1), of any floating type; None for no truncation.
        """
        check_tensor("thresholds", thresholds, len(self.splats))


@dataclass(frozen=True)
class RasterOutputs:
    """The outputs of one rasterization; an adapter passes its host the ones that it expects.

    Attributes:
        image: (3, H, W) RGB with background, not clamped.
        radii: (N,) int32, the HOST's rule: ceil(3 sigma), 0 when culled by the host, thresholds
            never change it; 0 for ``Footprints``.
        invdepth: (1, H, W) sum of alpha T / z, no background term; or (0, H, W) where ``planes``
            did not ask for it. z is that of the mean, also of a surfel.
        alpha: (1, H, W) 1 - final transmittance; likewise.
        fragments_per_pixel: scalar, drawn fragments over pixels; differentiable in the thresholds
            through the rim surrogate, or the covered area of soft rims, so
            ``loss + pressure * fragments_per_pixel`` is the fragment pressure.
        evaluated_per_pixel: (Gaussian, pixel) pairs that the engine tested, per pixel.
        fragments: (H, W) int32 drawn fragments per pixel, when counts were asked for.
        fragments_per_gaussian: (N,) int32 drawn fragments, when counts were asked for.
        stages: milliseconds of the forward pass by stage, from engines that keep time.
        features: (F, H, W) sum of alpha T feature, when features were given.
        weights_per_gaussian: (N,) float32 sum of alpha T over its drawn fragments, when scores
            were asked for; as the other scores without gradient, and the same for any number of
            threads.
        wins_per_gaussian: (N,) int32 pixels in which its weight alpha T is the largest.
        winners: (H, W) int32 row of the Gaussian of largest weight, the first in depth order of
            equal ones; -1 where nothing is drawn.
        entries_per_pixel: (Gaussian, tile) pairs in the engine's lists, per pixel. The cpu engine
            counts those that it blends, which leaves out what lies behind a tile that is opaque.
            NaN from engines that do not count.
        surface: (6, H, W) of surfels: sum of alpha T depth, of alpha T normal (3, view space), the
            median depth and the depth distortion of 2D Gaussian Splatting. None of other
            Gaussians, and where ``planes`` did not ask for it.
    """

    image: Tensor
    radii: Tensor
    invdepth: Tensor
    alpha: Tensor
    fragments_per_pixel: Tensor
    evaluated_per_pixel: float
    fragments: Tensor | None = None
    fragments_per_gaussian: Tensor | None = None
    stages: dict[str, float] | None = None
    features: Tensor | None = None
    weights_per_gaussian: Tensor | None = None
    wins_per_gaussian: Tensor | None = None
    winners: Tensor | None = None
    entries_per_pixel: float = math.nan
    surface: Tensor | None = None

    __repr__ = one_line
