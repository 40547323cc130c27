"""The PLY of a trained splat: round trips, refusals."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from finetune import tiny
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from fragprune_plugins.adapting import InputError, Model, ModelFileError
from fragprune_plugins.files.ply import expect_drawable, read_ply
from fragprune_plugins.workbench.models.formats.ply import write_ply


def same(a: Model, b: Model) -> bool:
    return all(
        torch.equal(one, other) if torch.is_tensor(one) else one is other
        for f in fields(a)
        if f.name != "thresholds"
        for one, other in [(getattr(a, f.name), getattr(b, f.name))]
    )


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    count=st.integers(1, 40),
    degree=st.integers(0, 3),
    seed=st.integers(0, 10**6),
    exported=st.booleans(),
)
def test_round_trip_is_bit_exact(tmp_path, count, degree, seed, exported):
    model = tiny.random_model(count, degree, seed)
    thresholds = torch.rand(count) * 0.98 + 0.01 if exported else None
    write_ply(tmp_path / "m.ply", model if thresholds is None else tiny.cut(model, thresholds))
    read = read_ply(tmp_path / "m.ply")
    assert same(model, read)
    assert read.sh_degree == degree
    if exported:
        assert torch.equal(read.falloff, thresholds)
    else:
        assert read.thresholds is None


def test_columns_are_the_hosts(tmp_path):
    model = tiny.random_model(3, degree=2)
    write_ply(tmp_path / "m.ply", tiny.cut(model, 0.25))
    vertex = PlyData.read(tmp_path / "m.ply")["vertex"]
    names = [p.name for p in vertex.properties]
    rest = " ".join(f"f_rest_{i}" for i in range(24))
    assert " ".join(names) == (
        f"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 {rest} opacity scale_0 scale_1 scale_2 "
        "rot_0 rot_1 rot_2 rot_3 trunc_threshold"
    )
    # Channel-major: the first eight are red's.
    assert vertex["f_rest_1"][2] == model.f_rest[2, 1, 0]
    assert vertex["f_rest_8"][2] == model.f_rest[2, 0, 1]


def test_ascii_doubles_and_unknown_columns(tmp_path):
    model = tiny.random_model(4, degree=1)
    write_ply(tmp_path / "m.ply", model)
    rows = PlyData.read(tmp_path / "m.ply")["vertex"].data
    wide = np.zeros(4, dtype=[*((n, "f8") for n in reversed(rows.dtype.names)), ("mood", "u1")])
    for name in rows.dtype.names:
        wide[name] = rows[name]
    faces = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(wide, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=True).write(tmp_path / "foreign.ply")
    assert same(model, read_ply(tmp_path / "foreign.ply"))


def with_column(model: Model, path: Path, name: str) -> Path:
    write_ply(path, model)
    rows = PlyData.read(path)["vertex"].data
    wide = np.zeros(len(rows), dtype=[*rows.dtype.descr, (name, "f4")])
    for each in rows.dtype.names:
        wide[each] = rows[each]
    PlyData([PlyElement.describe(wide, "vertex")]).write(path)
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
    path = with_column(tiny.random_model(4, degree=1), tmp_path / "m.ply", name)
    with pytest.raises(ModelFileError, match=says) as caught:
        read_ply(path)
    assert name in caught.value.found


@pytest.mark.parametrize("name", ["obj_dc_0", "roughness", "confidence"])
def test_a_column_that_is_ignored_is_named_once(tmp_path, name, caplog):
    path = with_column(tiny.random_model(4, degree=1), tmp_path / "m.ply", name)
    for _ in range(2):
        read_ply(path)
    assert [name in record.message for record in caplog.records] == [True]


def test_a_model_of_surfels_is_read_only_by_who_asks_for_it_and_written_as_it_was(tmp_path):
    round_ones = tiny.random_model(4, degree=1)
    model = replace(round_ones, scaling=round_ones.scaling[:, :2])
    write_ply(tmp_path / "m.ply", model)
    names = [p.name for p in PlyData.read(tmp_path / "m.ply")["vertex"].properties]
    assert [name for name in names if name.startswith("scale")] == ["scale_0", "scale_1"]
    with pytest.raises(ModelFileError, match=r"two scales.*2D Gaussian Splatting"):
        read_ply(tmp_path / "m.ply")
    read = read_ply(tmp_path / "m.ply", filtered=True)
    assert same(model, read)
    assert read.splats().flat
    assert not round_ones.splats().flat


def test_a_filtered_model_is_read_only_by_who_asks_for_it_and_written_as_it_was(tmp_path):
    model = tiny.random_model(4, degree=1)
    model = replace(model, filter_3d=torch.rand(4, 1))
    write_ply(tmp_path / "m.ply", model)
    with pytest.raises(ModelFileError, match="Mip-Splatting model"):
        read_ply(tmp_path / "m.ply")
    assert same(model, read_ply(tmp_path / "m.ply", filtered=True))
    names = [p.name for p in PlyData.read(tmp_path / "m.ply")["vertex"].properties]
    assert names[-1] == "filter_3D"


def test_a_3d_filter_widens_every_axis_and_keeps_what_the_gaussian_covers(tmp_path):
    model = tiny.random_model(6, degree=0)
    filtered = replace(model, filter_3d=torch.linspace(0, 3, 6)[:, None])
    plain, wide = model.splats(), filtered.splats()
    assert torch.equal(wide.scales[0], plain.scales[0])
    for row in range(1, 6):
        for axis in range(3):
            s, f = plain.scales[row, axis].item(), filtered.filter_3d[row, 0].item()
            assert wide.scales[row, axis].item() == pytest.approx((s * s + f * f) ** 0.5, rel=1e-5)
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


def without(path: Path, *names: str) -> None:
    rows = PlyData.read(path)["vertex"].data
    kept = [n for n in rows.dtype.names if n not in names]
    table = np.empty(len(rows), dtype=[(n, "f4") for n in kept])
    for name in kept:
        table[name] = rows[name]
    PlyData([PlyElement.describe(table, "vertex")]).write(path)


def rewritten(change):
    """Break a PLY by its table."""

    def act(path):
        rows = change(PlyData.read(path)["vertex"].data)
        kind = "face" if rows.dtype.names == ("a",) else "vertex"
        PlyData([PlyElement.describe(rows, kind)]).write(path)

    return act


def outside(path):
    """Put thresholds into a column, one of them above 1."""
    write_ply(path, tiny.cut(tiny.random_model(8, degree=1), 0.5))
    content = PlyData.read(path, mmap=False)
    content["vertex"]["trunc_threshold"][:] = np.linspace(0.5, 1.2, 8)
    content.write(path)


BAD = {
    "cut off": (lambda path: path.write_bytes(path.read_bytes()[:-100]), "not readable as PLY"),
    "cut in its header": (lambda p: p.write_bytes(p.read_bytes()[:90]), "not readable as PLY"),
    "a picture": (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n"), "not readable as PLY"),
    "points": (
        lambda path: without(path, "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "rot_3"),
        "without f_dc_0, f_dc_1, f_dc_2, opacity, rot_3",
    ),
    "compact": (
        lambda path: without(path, "f_dc_0", "f_dc_1", "f_dc_2"),
        "keeps colours in a network",
    ),
    "odd sh": (lambda path: without(path, "f_rest_8"), "8 f_rest columns"),
    "faces": (rewritten(lambda _: np.array([(1,)], dtype=[("a", "i4")])), "without a vertex"),
    "empty": (rewritten(lambda rows: rows[:0]), "0 Gaussians"),
    "thresholds": (outside, "trunc_threshold outside"),
}


@pytest.mark.parametrize("how", BAD)
def test_bad_files_are_refused_by_name(tmp_path, how):
    path, (spoil, words) = tmp_path / "bad.ply", BAD[how]
    write_ply(path, tiny.random_model(8, degree=1))
    spoil(path)
    with pytest.raises(ModelFileError, match=words) as error:
        read_ply(path)
    assert error.value.where == str(path)


def test_shapes_are_checked():
    model = tiny.random_model(4)
    with pytest.raises(InputError, match="opacity"):
        replace(model, opacity=model.opacity[:, 0])
    with pytest.raises(InputError, match="filter_3d"):
        replace(model, filter_3d=torch.full((3, 1), 0.5))
    with pytest.raises(InputError, match="f_rest"):
        replace(model, f_rest=torch.zeros(4, 5, 3))


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


def test_a_value_that_cannot_be_drawn_names_the_file(tmp_path):
    model = tiny.random_model(4)
    model.opacity[2] = torch.nan
    with pytest.raises(ModelFileError, match="opacity") as stated:
        expect_drawable(tmp_path / "a.spz", model)
    assert stated.value.where == str(tmp_path / "a.spz")
