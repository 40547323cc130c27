"""graphdeco-inria/gaussian-splatting: what adapters of this code of 2023 and its descendants share.

adapter       the base of their adapters: seams, names, files
call          the rasterizer's call in their source
proof         proves their rasterizers: it draws by both, and ``likeness`` compares
stand_ins     modules of ours for their compiled packages

What is read in a checkout, each built on those below it:

plain         whether the PLY that a codebase saves is plain 3DGS
drawing       what a drawing function makes the rasterizer's inputs and its picture of
saved         what a model saves
failing       what makes a training script fail, or pass all seams by
photographs   whether a training makes the drawn picture itself like its photographs
kernels       the rule in the CUDA sources of a vendored rasterizer
reading       the model, the scripts and their options
syntax        code as such

Every name here is imported as itself: that is how Python says that a module passes it on.
Importing this package imports no torch; ``proof``, ``likeness`` and ``stand_ins`` do.
"""

from __future__ import annotations

from collections.abc import Sequence

from fragprune_graphdeco.adapter import MODEL as MODEL
from fragprune_graphdeco.adapter import SCREEN as SCREEN
from fragprune_graphdeco.adapter import GraphdecoAdapter as GraphdecoAdapter
from fragprune_graphdeco.adapter import GraphdecoDialect as GraphdecoDialect
from fragprune_graphdeco.adapter import default as default
from fragprune_graphdeco.adapter import group_names as group_names
from fragprune_graphdeco.adapter import model_seam as model_seam
from fragprune_graphdeco.adapter import no_noise as no_noise
from fragprune_graphdeco.adapter import optimizers as optimizers
from fragprune_graphdeco.adapter import rasterizer_seam as rasterizer_seam
from fragprune_graphdeco.adapter import warn_once as warn_once
from fragprune_graphdeco.call import CallInSource as CallInSource
from fragprune_graphdeco.call import RasterizerCall as RasterizerCall
from fragprune_graphdeco.call import drawing_functions as drawing_functions
from fragprune_graphdeco.call import read_calls as read_calls
from fragprune_graphdeco.drawing import Drawing as Drawing
from fragprune_graphdeco.drawing import arguments as arguments
from fragprune_graphdeco.drawing import given_to as given_to
from fragprune_graphdeco.kernels import SURFEL as SURFEL
from fragprune_graphdeco.plain import read_models
from fragprune_graphdeco.syntax import assigned as assigned
from fragprune_graphdeco.syntax import every as every
from fragprune_graphdeco.syntax import is_off as is_off
from fragprune_graphdeco.syntax import mentioned as mentioned
from fragprune_graphdeco.syntax import off_by_default as off_by_default
from fragprune_graphdeco.syntax import text_of as text_of
from fragprune_plugins.adapting import HostRepo, Plain, hookimpl


@hookimpl
def fragprune_read_models(repo: HostRepo) -> Sequence[Plain]:
    """The models of codebases of this family."""
    return read_models(repo)
