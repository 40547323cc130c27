"""What nerfstudio's adapter promises where nerfstudio is not installed."""

import sys
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from core.sessions import state
from hypothesis import given
from hypothesis import strategies as st

from fragprune_nerfstudio import METHOD, Nerfstudio, exported
from fragprune_nerfstudio.command import rewritten
from fragprune_nerfstudio.exporting import COLUMNS, rows_among, rows_exported
from fragprune_plugins import Control, Settings, ThresholdStore
from fragprune_plugins.adapting import AlignmentError, HostRepo, UsageError
from fragprune_plugins.files import sidecar
from fragprune_plugins.hosts.choosing import usage
from fragprune_plugins.injection import command, saving, session

# -- what it costs whoever has no nerfstudio


LOADED = """
import json, sys
from fragprune_plugins.plugins.loading import load_plugins
names = [adapter.name for adapter in load_plugins().adapters]
loaded = {name.split(".")[0] for name in sys.modules} & {"nerfstudio", "gsplat", "torch"}
print(json.dumps(["nerfstudio" in names, [*loaded]]))
"""


def test_nerfstudio_finds_the_method_and_nobody_else_imports_it(python):
    (entry,) = entry_points(group="nerfstudio.method_configs", name=METHOD)
    assert entry.value == "fragprune_nerfstudio.method:splatfacto"
    assert python(LOADED) == [True, []]


def test_a_folder_is_no_nerfstudio(tmp_path):
    (finding,) = Nerfstudio().fingerprint(HostRepo(tmp_path))
    assert (finding.level, finding.found) == ("error", "a folder, not a package")
    assert METHOD in finding.remedy


# -- the command


def rewrite(*words, stage="auto", settings=None, from_iter=None, engine="auto", device="cuda"):
    settings = settings or Settings(iterations=100)
    options = {"stage": stage, "from_iter": from_iter, "engine": engine, "device": device}
    return rewritten(METHOD, list(words), settings, **options)


DATA = ["colmap", "--data", "scene"]
OWN = "--pipeline.model.fragprune"


@pytest.mark.parametrize(
    ("words", "options", "expected"),
    [
        ([], {}, {"--max-num-iterations": "30100", f"{OWN}.iterations": "100"}),
        (["--max-num-iterations", "50"], {}, {"--max-num-iterations": "150"}),
        (["--max_num_iterations=50"], {}, {"--max-num-iterations": "150"}),
        (["--load-dir", "x"], {"stage": "finetune"}, {"--max-num-iterations": "100"}),
        (
            ["--max-num-iterations", "50"],
            {"stage": "finetune", "from_iter": 30},
            {"--max-num-iterations": "50", f"{OWN}-from": "30", f"{OWN}.iterations": "20"},
        ),
        ([], {"device": "cuda:0"}, {"--machine.device-type": "cuda"}),
        ([], {"device": "cpu", "engine": "cpu"}, {f"{OWN}-engine": "cpu"}),
        ([], {"settings": Settings(train="opacity")}, {f"{OWN}.train": "opacity"}),
        ([], {"settings": Settings(goal=Control())}, {f"{OWN}.goal": "control"}),
    ],
)
def test_a_run_of_splatfacto_is_one_of_ours_that_is_longer_by_stage_two(words, options, expected):
    """Flags of the method go before the words of the data parser, which has its own."""
    got = rewrite("splatfacto", *words, *DATA, **options)
    end = got.index("colmap")
    flags = dict(zip(got[1:end:2], got[2:end:2], strict=True))
    assert got[0] == METHOD
    assert got[end:] == DATA
    assert expected.items() <= flags.items()
    assert sum("max" in word for word in got) == 1


def test_the_larger_splatfacto_is_one_with_other_defaults():
    """The user's own flags come behind them."""
    given = "--pipeline.model.cull-alpha-thresh"
    got = rewrite("splatfacto-big", given, "0.01")
    assert [got[at + 1] for at, word in enumerate(got) if word == given] == ["0.005", "0.01"]
    assert got[got.index("--pipeline.model.densify-grad-thresh") + 1] == "0.0005"
    assert got[0] == METHOD


@pytest.mark.parametrize(
    ("words", "options", "remedy"),
    [
        ([], {}, "splatfacto"),
        (["nerfacto"], {}, "splatfacto"),
        (["splatfacto", "--load-config", "x"], {}, "--load-dir"),
        (["splatfacto"], {"stage": "joint"}, "--stage"),
        (["splatfacto"], {"stage": "off"}, "ns-eval"),
        (["splatfacto"], {"stage": "finetune"}, "--load-dir"),
        (["splatfacto"], {"stage": "finetune", "from_iter": 30_000}, "--max-num-iterations"),
        (["splatfacto", "--max-num-iterations", "many"], {}, "Correct it"),
        (["splatfacto", "--max-num-iterations"], {}, "Correct it"),
        (["splatfacto"], {"device": "cuda:1"}, "CUDA_VISIBLE_DEVICES=1"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(words, options, remedy):
    with pytest.raises(UsageError) as error:
        rewrite(*words, **options)
    assert remedy in error.value.remedy


def test_a_command_that_pip_installed_is_run_as_its_module(monkeypatch):
    entry = SimpleNamespace(module="fragprune_plugins.injection.launch")
    installed = Mock(return_value=[entry])
    monkeypatch.setattr(command, "entry_points", installed)
    script, arguments, module = command.split(["ns-train", "splatfacto", "--x"])
    assert (arguments, module) == (["splatfacto", "--x"], "fragprune_plugins.injection.launch")
    assert script.parts[-2:] == ("injection", "launch.py")
    installed.assert_called_once_with(group="console_scripts", name="ns-train")
    installed.return_value = []
    with pytest.raises(UsageError, match="ns-nothing"):
        command.split(["ns-nothing", "splatfacto"])


# -- an exported file has some of the model's rows


def model(rows: int, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    widths = {name: len(columns) for name, columns in COLUMNS.items()}
    return {name: torch.randn(rows, width, generator=generator) for name, width in widths.items()}


def exporters(params, kept):
    """The exporter's columns: some (M,), some (M, 1)."""
    return {
        column: params[name][kept, place].numpy().reshape((-1,) if name == "means" else (-1, 1))
        for name, columns in COLUMNS.items()
        for place, column in enumerate(columns)
    }


@given(keys=st.lists(st.integers(0, 3), min_size=1, max_size=12), chosen=st.sets(st.integers(0, 3)))
def test_any_selection_by_values_is_followed_even_among_equal_rows(keys, chosen):
    """The exporter's filters look at values, so equal rows stay or go together; and NaN goes."""
    params = {name: each[keys] for name, each in model(4).items()}
    for row, key in enumerate(keys):
        if key not in chosen and key % 2:
            params["scales"][row, 1] = torch.nan
    kept = torch.tensor([key in chosen for key in keys]).nonzero()[:, 0]
    assert torch.equal(rows_exported(params, exporters(params, kept)), kept)


def shifted(columns):
    return columns | {"opacity": columns["opacity"] + 1e-3}


@pytest.mark.parametrize(
    ("of", "rows", "change", "said"),
    [
        *(([0, 1, 2], rows, dict, "in its order") for rows in ([1, 0, 2], [0, 0, 1], [2, 1])),
        ([0, 1, 2], [0, 1, 2], shifted, None),
        ([0, 0, 1], [0, 2], dict, None),  # which of two equal rows it is cannot be told
        *(
            ([0, 1, 2], [0, 1, 2], lambda c, name=name: {k: c[k] for k in c if k != name}, name)
            for name in ("x", "rot_3")
        ),
    ],
)
def test_another_order_other_values_and_a_missing_column_are_refused(of, rows, change, said):
    params = {name: each[of] for name, each in model(3).items()}
    with pytest.raises(AlignmentError, match=said):
        rows_exported(params, change(exporters(params, torch.tensor(rows))))


def test_of_a_model_without_thresholds_nothing_is_followed(monkeypatch):
    monkeypatch.setattr(session, "_active", SimpleNamespace(last=None))
    call = SimpleNamespace(arguments={"filename": "splat.ply", "map_to_tensors": {}})
    path, rows = exported(call)
    assert (path.name, len(rows)) == ("splat.ply", 0)


def test_a_file_of_other_gaussians_is_removed_before_anybody_takes_it(tmp_path, monkeypatch):
    file = tmp_path / "splat.ply"
    file.write_text("of another model")
    own = SimpleNamespace(gauss_params=model(3))
    monkeypatch.setattr(session, "_active", SimpleNamespace(last=lambda: own))
    columns = exporters(model(3, seed=1), torch.arange(3))
    call = SimpleNamespace(arguments={"filename": str(file), "map_to_tensors": columns})
    with pytest.raises(AlignmentError):
        exported(call)
    assert not file.exists()


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_an_export_says_that_its_picture_loses_the_antialiasing(
    tmp_path, monkeypatch, caplog, mode
):
    config = SimpleNamespace(rasterize_mode=mode)
    own = SimpleNamespace(gauss_params=model(3), config=config)
    monkeypatch.setattr(session, "_active", SimpleNamespace(last=lambda: own))
    columns = exporters(own.gauss_params, torch.arange(3))
    given = {"filename": str(tmp_path / "splat.ply"), "map_to_tensors": columns}
    assert len(exported(SimpleNamespace(arguments=given))[1]) == 3
    assert ("trained antialiased" in caplog.text) == (mode == "antialiased")


def test_the_crop_of_a_view_has_the_models_rows_by_position_and_rotation():
    params = {key: each for key, each in model(6).items() if key in ("means", "quats")}
    inside = torch.tensor([1, 2, 5])
    drawn = {key: each[inside] for key, each in params.items()}
    assert torch.equal(rows_among(params, drawn, "crop"), inside)


def test_the_sidecar_of_an_exported_file_has_the_thresholds_of_its_rows(tmp_path):
    """A host may say which rows a file has, where positions do not tell."""
    written = {}
    store = ThresholdStore.from_falloff(torch.tensor([0.1, 0.2, 0.3, 0.4]))
    models = SimpleNamespace(get=lambda model: SimpleNamespace(store=store))
    known = SimpleNamespace(last=SimpleNamespace, models=models, adapter=None)
    known.write_sidecar = lambda path, store: written.update({path: store})
    path, rows = tmp_path / "splat.ply", torch.tensor([0, 3])
    call = SimpleNamespace(run=lambda: "done", how=lambda: (path, rows), seam="exporter")
    assert saving.on_pack(known, call) == "done"
    torch.testing.assert_close(written[path].values.detach(), torch.tensor([0.1, 0.4]))


def test_an_export_without_thresholds_leaves_none_of_an_earlier_one(tmp_path):
    path = tmp_path / "splat.ply"
    sidecar.path_beside(path).write_text("of an earlier export")
    call = SimpleNamespace(run=lambda: None, how=lambda: (path, torch.arange(2)), seam="exporter")
    saving.on_pack(state(), call)
    assert not sidecar.path_beside(path).exists()


def test_only_ns_train_is_a_training_and_without_its_host_it_can_be_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "nerfstudio", None)
    adapter, repo = Nerfstudio(), HostRepo(Path("lib"), "nerfstudio")
    scripts = repo.root / "nerfstudio" / "scripts"
    assert adapter.trainer(repo, scripts / "train.py") is not None
    assert adapter.trainer(repo, scripts / "eval.py") is None
    assert METHOD in usage(adapter, repo)
