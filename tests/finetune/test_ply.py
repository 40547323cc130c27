"""The PLY of a trained splat: round trips, refusals."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from finetune import tiny
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from fragprune_plugins.adapting import InputError, Model, ModelFileError, read_ply
from fragprune_plugins.constants import NEUTRAL_LOGIT
from fragprune_plugins.workbench.models.formats.ply import write_ply


def same(a: Model, b: Model) -> bool:
    return all(
        torch.equal(one, other) if torch.is_tensor(one) else one is other
        for f in fields(a)
        if f.name != "thresholds"
        for one, other in [(getattr(a, f.name), getattr(b, f.name))]
    )


@given(
    n=st.integers(1, 40), degree=st.integers(0, 3), seed=st.integers(0, 10**6), cut=st.booleans()
)
def test_round_trip_is_bit_exact(tmp_path, n, degree, seed, cut):
    model = tiny.random_model(n, degree, seed)
    thresholds = torch.rand(n) * 0.98 + 0.01 if cut else None
    write_ply(tmp_path / "m.ply", model if thresholds is None else tiny.cut(model, thresholds))
    read = read_ply(tmp_path / "m.ply")
    assert same(model, read)
    assert read.sh_degree == degree
    if cut:
        assert torch.equal(read.falloff, thresholds)
    else:
        assert read.thresholds is None


def test_columns_are_the_hosts(tmp_path):
    model = tiny.random_model(3, degree=2)
    write_ply(tmp_path / "m.ply", tiny.cut(model, 0.25))
    vertex = columns(tmp_path / "m.ply")
    rest = " ".join(f"f_rest_{i}" for i in range(24))
    assert " ".join(vertex) == (
        f"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 {rest} opacity scale_0 scale_1 scale_2 "
        "rot_0 rot_1 rot_2 rot_3 trunc_threshold"
    )
    # Channel-major: the first eight are red's.
    assert vertex["f_rest_1"][2] == model.f_rest[2, 1, 0]
    assert vertex["f_rest_8"][2] == model.f_rest[2, 0, 1]


def columns(path):
    """The columns of a file by name, in their order."""
    rows = PlyData.read(path, mmap=False)["vertex"].data
    return {name: rows[name] for name in rows.dtype.names}


def write_columns(path, given, kind="f4", *elements, text=False):
    rows = np.zeros(len(next(iter(given.values()))), dtype=[(name, kind) for name in given])
    for name, each in given.items():
        rows[name] = each
    PlyData([PlyElement.describe(rows, "vertex"), *elements], text=text).write(path)


FACES = PlyElement.describe(np.array([([0, 1, 2],)], dtype=[("vertex_index", "i4", (3,))]), "face")


def test_ascii_doubles_and_unknown_elements(tmp_path):
    model = tiny.random_model(4, degree=1)
    write_ply(tmp_path / "m.ply", model)
    given = dict(reversed(columns(tmp_path / "m.ply").items())) | {"mood": np.zeros(4)}
    write_columns(tmp_path / "foreign.ply", given, "f8", FACES, text=True)
    assert same(model, read_ply(tmp_path / "foreign.ply"))


def changed(change):
    """Writes a file again with other columns."""
    return lambda path: write_columns(path, change(columns(path)))


def with_column(path: Path, name: str) -> Path:
    write_ply(path, tiny.random_model(4, degree=1))
    changed(lambda given: given | {name: np.zeros(4)})(path)
    return path


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("binding_0", "triangles of a mesh"),
        ("refl_strength", "reflections"),
        ("text_dc_0", "textures"),
        ("masks_0", "masks"),
        ("f_offset_3", "anchors"),
        ("trbf_scale", "motion"),
    ],
)
def test_a_column_that_changes_the_picture_is_refused(tmp_path, name, says):
    path = with_column(tmp_path / "m.ply", name)
    with pytest.raises(ModelFileError, match=says) as caught:
        read_ply(path)
    assert name in caught.value.found


@pytest.mark.parametrize("name", ["obj_dc_0", "roughness", "confidence"])
def test_a_column_that_is_ignored_is_named_once(tmp_path, name, caplog):
    path = with_column(tmp_path / "m.ply", name)
    for _ in range(2):
        read_ply(path)
    assert [name in record.message for record in caplog.records] == [True]


@pytest.mark.parametrize(
    ("change", "said", "last"),
    [
        ({"scaling": torch.zeros(4, 2)}, r"two scales.*2D Gaussian Splatting", "scale_1"),
        ({"filter_3d": torch.rand(4, 1)}, "Mip-Splatting model", "filter_3D"),
    ],
)
def test_what_is_drawn_otherwise_is_read_by_who_asks_for_it_and_written_as_it_was(
    tmp_path, change, said, last
):
    model = replace(tiny.random_model(4, degree=1), **change)
    write_ply(tmp_path / "m.ply", model)
    names = [name for name in columns(tmp_path / "m.ply") if not name.startswith("rot")]
    assert names[-1] == last
    with pytest.raises(ModelFileError, match=said):
        read_ply(tmp_path / "m.ply")
    read = read_ply(tmp_path / "m.ply", filtered=True)
    assert same(model, read)
    assert read.splats().flat == ("scaling" in change)


def test_a_3d_filter_widens_every_axis_and_keeps_what_the_gaussian_covers(tmp_path):
    model = tiny.random_model(6, degree=0)
    filtered = replace(model, filter_3d=torch.linspace(0, 3, 6)[:, None])
    plain, wide = model.splats(), filtered.splats()
    assert torch.equal(wide.scales[0], plain.scales[0])
    expected = torch.hypot(plain.scales, filtered.filter_3d)
    torch.testing.assert_close(wide.scales, expected, rtol=1e-5, atol=0)
    # The integral over space, opacity times the product of widths, is what it was.
    mass = [each.opacities * each.scales.prod(dim=1) for each in (plain, wide)]
    torch.testing.assert_close(*mass, rtol=1e-5, atol=0)


def test_activation(tmp_path):
    model = tiny.random_model(5, degree=3)
    splats = model.splats()
    assert torch.equal(splats.opacities, torch.sigmoid(model.opacity[:, 0]))
    assert torch.equal(splats.scales, torch.exp(model.scaling))
    torch.testing.assert_close(splats.rotations.norm(dim=1), torch.ones(5))
    assert splats.sh.shape == (5, 16, 3)
    assert splats.sh_degree == 3


@pytest.mark.parametrize("name", ["opacity", "scale_1"])
@pytest.mark.parametrize("value", [-np.inf, np.inf])
def test_opacities_of_0_and_1_and_scales_of_0_are_read_as_such(tmp_path, name, value):
    """Editors write them; SuperSplat's splat-transform lets exactly these pass."""
    model = tiny.random_model(4)
    write_ply(tmp_path / "m.ply", model)
    given = columns(tmp_path / "m.ply")
    given[name][2] = value
    write_columns(tmp_path / "m.ply", given)
    if (name, value) == ("scale_1", np.inf):
        with pytest.raises(ModelFileError, match="scales that nothing can be drawn with"):
            read_ply(tmp_path / "m.ply")
        return
    read = read_ply(tmp_path / "m.ply").splats()
    drawn = read.opacities[2] if name == "opacity" else read.scales[2, 1]
    assert float(drawn) == pytest.approx(float(value > 0), abs=1e-30)


def test_rows_of_an_unpruned_model_that_were_merged_in_are_not_cut(tmp_path):
    """Whoever merges two PLYs fills a column that one of them lacks with 0."""
    write_ply(tmp_path / "m.ply", tiny.cut(tiny.random_model(4), 0.3))
    column = np.array([0.3, 0.3, 0, 0])
    changed(lambda given: given | {"trunc_threshold": column})(tmp_path / "m.ply")
    read = read_ply(tmp_path / "m.ply")
    assert read.falloff[:2].tolist() == pytest.approx([0.3, 0.3])
    assert (read.thresholds.logits[2:] <= NEUTRAL_LOGIT).all()


def test_colours_without_sh_are_named_with_who_writes_them(tmp_path):
    write_ply(tmp_path / "m.ply", tiny.random_model(4, degree=0))
    given = {n: each for n, each in columns(tmp_path / "m.ply").items() if "f_dc" not in n}
    write_columns(tmp_path / "m.ply", given | dict.fromkeys(("red", "green", "blue"), np.ones(4)))
    with pytest.raises(ModelFileError, match=r"without f_dc_0.*--ply-color-mode sh_coeffs"):
        read_ply(tmp_path / "m.ply")


def without(*names):
    return changed(lambda given: {n: each for n, each in given.items() if n not in names})


BAD = {
    "cut off": (lambda path: path.write_bytes(path.read_bytes()[:-100]), "not readable as PLY"),
    "points": (without("f_dc_0", "opacity", "rot_3"), "without f_dc_0, opacity, rot_3"),
    "compact": (without("f_dc_0", "f_dc_1", "f_dc_2"), "keeps colours in a network"),
    "odd sh": (without("f_rest_8"), "8 f_rest columns"),
    "faces": (lambda path: PlyData([FACES]).write(path), "without a vertex"),
    "empty": (changed(lambda given: {n: each[:0] for n, each in given.items()}), "0 Gaussians"),
    "no numbers": (
        changed(lambda given: given | {"x": np.full(8, np.nan)}),
        "NaN .* in 8 of 8 rows",
    ),
    "thresholds": (
        changed(lambda given: given | {"trunc_threshold": np.linspace(0.5, 1.2, 8)}),
        "trunc_threshold outside",
    ),
}


@pytest.mark.parametrize("how", BAD)
def test_bad_files_are_refused_by_name(tmp_path, how):
    path, (spoil, words) = tmp_path / "bad.ply", BAD[how]
    write_ply(path, tiny.random_model(8, degree=1))
    spoil(path)
    with pytest.raises(ModelFileError, match=words) as error:
        read_ply(path)
    assert error.value.where == str(path)


@pytest.mark.parametrize(
    ("name", "shape"), [("opacity", (4,)), ("filter_3d", (3, 1)), ("f_rest", (4, 5, 3))]
)
def test_shapes_are_checked(name, shape):
    with pytest.raises(InputError, match=name):
        replace(tiny.random_model(4), **{name: torch.full(shape, 0.5)})


def test_kept_rows_stay_in_their_order_with_all_that_they_have():
    model = tiny.cut(
        replace(tiny.random_model(6), filter_3d=torch.rand(6, 1)), torch.linspace(0.1, 0.6, 6)
    )
    mask = torch.tensor([True, False, True, True, False, False])
    kept = model.keep(mask)
    assert len(kept) == 3
    for name, each in model.tensors.items():
        assert torch.equal(getattr(kept, name), each[mask])
    assert torch.equal(kept.falloff, model.falloff[mask])
    assert tiny.random_model(6).keep(mask).thresholds is None
