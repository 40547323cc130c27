"""The field's constants and ours, each once, with its reason.

The native headers hold the same numbers (``native/include/fragprune.h``); a test compares the two.
"""

from typing import Final

ALPHA_MIN: Final = 1.0 / 255.0
"""A fragment fainter than one 8-bit step is skipped (forward.cu, renderCUDA)."""

ALPHA_MAX: Final = 0.99
"""Alpha is capped here, so that one fragment never ends a pixel's transmittance by division."""

TRANSMITTANCE_MIN: Final = 1e-4
"""A pixel stops before the fragment that would leave less light than (1 - ALPHA_MAX)^2."""

STOPPED_ALPHA_MAX: Final = 0.999
"""Highest cap on alpha with a stop, whose last fragment is drawn: 1 - alpha divides backwards."""

NEAR: Final = 0.2
"""View-space depth at or below which a Gaussian is culled; the host's only frustum test."""

TILE: Final = 16
"""Side of a tile in pixels."""

DILATION: Final = 0.3
"""What vanilla 3DGS adds to the 2D covariance's diagonal, pixels^2."""

FRUSTUM_MARGIN: Final = 1.3
"""The Jacobian is evaluated with x/z, y/z clamped to this many times the half field of view."""

ANTIALIASING_FLOOR: Final = 2.5e-5
"""Least ratio of determinants under the square root of the antialiasing compensation."""

MIP_FLOOR: Final = 1e-6
"""Mip-Splatting draws no Gaussian whose 2D covariance has a determinant this small, pixels^4."""

FEATURES_MAX: Final = 8
"""Most channels that one rasterization blends beside colour."""

COEFFICIENTS_MAX: Final = 1024
"""Most spherical-harmonic coefficients of one Gaussian; more is an array read the wrong way."""

THREADS_MAX: Final = 1024
"""Most threads of one call of the cpu engine; results do not depend on their number."""

SIDE_MAX: Final = 1 << 16
"""Most pixels of a side of a picture."""

FOCAL_MIN: Final = 1e-3
FOCAL_MAX: Final = 1e4
"""Focal lengths, in sides of the picture: fields of view from 179.9 to 0.006 degrees."""

RIM_WIDTH: Final = 0.01
"""Width w, in falloff, of the surrogate s((g - tau)/w) at the rim; results are flat .003 to .03."""

RIM_REACH: Final = 4.6
"""The backward pass visits fragments down to tau - RIM_REACH * RIM_WIDTH: there s(1-s) is 0.01."""

FALLOFF_MIN: Final = 1e-4
"""Least falloff the widened backward bound may take: keeps the cutoff -2 ln(.) finite."""

NEUTRAL_LOGIT: Final = -30.0
"""The neutral threshold's logit. Its cutoff Q = 60 exceeds 2 ln 255 = 11.08, the largest radius
that the 1/255 skip leaves any Gaussian, so a neutral threshold decides nothing, exactly."""

LOGIT_MIN: Final = -80.0
LOGIT_MAX: Final = 16.0
"""Ends of a threshold's logit: float32 tells sigmoid(-80) from 0 and sigmoid(16) from 1; from 16.7
on it would round to 1."""

VERSION: Final = "0.1.0"
"""Of the package; pyproject.toml has the same."""
