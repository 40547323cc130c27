"""Columns of a PLY beyond those of 3DGS: which are ignored, and which change the picture."""

from __future__ import annotations

import re

_CHANGES = {
    r"binding\w*": "positions relative to the triangles of a mesh",
    r"refl\w*|ori_color\w*|ref_\w+|specular_\w+|diffuse_tint\w*|ind_\w+": "reflections",
    r"text_(dc|rest|opacity)\w*": "textures",
    r"masks?(_\d+)?": "masks that scale the opacities",
    r"f_offset\w*|f_anchor\w*|anchor\w*": "anchors, from which Gaussians are made for each view",
    r"(phase|amp)_\w+|f_(dc|rest)_color\w*": "phasors",
    r"t|t_\w+|scaling_t|scale_t|trbf\w*|motion\w*|omega\w*|rot_r_?\d|rotation_r\w*": "motion",
    r"filter_3D": "a 3D filter",
    r"shape\w*|betas?(_\d+)?": "another falloff",
}
_PLAIN = re.compile(
    r"[xyz]|n[xyz]|(f_dc|f_rest|scale|rot)_\d+|opacity|trunc_threshold|red|green|blue"
)


def change_of(name: str) -> str:
    """How a column changes what a plain drawing shows, as text; "" if we know of no way.

    Args:
        name: of the column, with or without its number.
    """
    return next((says for known, says in _CHANGES.items() if re.fullmatch(known, name)), "")


def is_plain(name: str) -> bool:
    """Whether a column is one of 3DGS or of ours."""
    return bool(_PLAIN.fullmatch(name))
