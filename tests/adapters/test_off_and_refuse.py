"""Invariants 1 and 7: off is off, and what is unknown is refused whole."""

import sys
from importlib import import_module

import pytest
from miniatures.vanilla_3dgs import HOST, imported

from fragprune_plugins.adapting import HostRepo, Role, Seam
from fragprune_plugins.errors import LateImportError, SeamError
from fragprune_plugins.injection import session as sessions
from fragprune_plugins.injection.session import Session
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_vanilla_3dgs import Vanilla3DGS

STAND_INS = ("diff_gaussian_rasterization", "simple_knn", "simple_knn._C")


def session(adapter=None, **options):
    options = {"drop_in": True} | options
    return Session(adapter or Vanilla3DGS(), HostRepo(HOST), load_plugins(), **options)


class Newer(Vanilla3DGS):
    """Expects a parameter that the host does not have."""

    seams = (*Vanilla3DGS.seams, Seam(Role.STEP, "utils.loss_utils", "l1_loss", ("kernel_size",)))


def test_a_changed_host_that_is_imported_already_leaves_nothing_patched():
    with imported(HOST):
        loss = import_module("utils.loss_utils").l1_loss
        with pytest.raises(SeamError, match="kernel_size"):
            session(Newer()).activate()
        assert import_module("utils.loss_utils").l1_loss is loss
        assert not [name for name in STAND_INS if name in sys.modules]
        assert sessions.active_session() is None
        with session():  # nothing of the refused one is in the way
            import_module("scene")


def test_a_rasterizer_that_was_imported_before_us_is_refused():
    with session():
        kept = sys.modules["diff_gaussian_rasterization"]
    sys.modules["diff_gaussian_rasterization"] = kept
    try:
        with pytest.raises(LateImportError, match="already imported"):
            session().activate()
        assert sys.modules["diff_gaussian_rasterization"] is kept
        assert "simple_knn" not in sys.modules
        assert sessions.active_session() is None
    finally:
        del sys.modules["diff_gaussian_rasterization"]


def test_a_host_that_holds_an_earlier_sessions_rasterizer_is_refused_by_another():
    """It would be drawn by that one's classes, which nothing of ours is wrapped around."""
    with imported(HOST):
        with session():
            import_module("gaussian_renderer")
        with pytest.raises(LateImportError, match="bound in gaussian_renderer since an earlier"):
            session().activate()
        assert not [name for name in STAND_INS if name in sys.modules]
        assert sessions.active_session() is None
