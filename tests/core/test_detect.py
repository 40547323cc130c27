"""Detection reads source: every tree here is a skeleton written from the hosts' interfaces."""

import pytest
from miniatures.skeletons import FLAGS, GROUPS, SETTINGS, STATES, skeleton

from fragprune_2dgs import SurfelSplatting
from fragprune_graphdeco.call import drawing_functions, read_calls
from fragprune_gsplat import Gsplat
from fragprune_plugins.adapting import HostRepo, Role, Seam, revised
from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.hosts.choosing import choose, locate
from fragprune_plugins.hosts.findings import Match
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_vanilla_3dgs import Vanilla3DGS


def named(name, *ancestors, **members):
    """Vanilla's adapter by another name."""
    return type(name, (Vanilla3DGS,), {"name": name, "descends_from": ancestors} | members)()


def errors(repo):
    return [f for f in Vanilla3DGS().match(repo).findings if f.level == "error"]


@pytest.mark.parametrize("state", STATES)
def test_each_public_state_is_recognised_and_its_dialect_read(tmp_path, state):
    repo = skeleton(tmp_path, state)
    adapter = Vanilla3DGS()
    assert adapter.match(repo).fits, errors(repo)
    assert adapter.revision(repo) == state
    dialect = adapter.dialect(repo)
    assert dialect.outputs == (3 if "2024" in state else 2)
    assert dialect.settings[:12] == tuple(SETTINGS[: 11 if state == "mid-July 2023" else 12])
    assert ("antialiasing" in dialect.settings) == ("2024" in state)
    assert adapter.command_line(repo).default_iterations == 12_345
    assert choose(repo, [adapter]) is adapter


def test_a_state_from_before_there_were_checkpoints_is_refused_by_its_date(tmp_path):
    repo = skeleton(tmp_path, "mid-July 2023", capture=None, restore=None)
    first, *seams = errors(repo)
    assert first.code == "revision"
    assert "until 14 July 2023" in first.found
    assert "fragprune finetune" in first.remedy
    assert [finding.code for finding in seams] == ["seam-missing"] * 2
    with pytest.raises(UnknownHostError, match="until 14 July 2023"):
        choose(repo, [Vanilla3DGS()])


COUSINS = {
    "3DGS-MCMC": {"outputs": 3},
    "4DGaussians": {"outputs": 3, "groups": ("xyz", "deformation", "grid", *GROUPS[1:])},
    "c3dgs": {"settings": ["clamp_color"]},
    "Compact-3DGS": {"groups": ("xyz", "opacity", "scaling", "rotation", "mask")},
    "Mini-Splatting": {"functions": ["render", "render_imp", "render_depth"]},
    "Mip-Splatting": {"settings": ["kernel_size", "subpixel_offset"]},
    "RAIN-GS": {
        "package": "submodules.diff_gaussian_rasterization.diff_gaussian_rasterization",
        "settings": ["low_pass"],
        "outputs": 3,
    },
    "RT-4DGS": {"package": ".diff_gaussian_rasterization", "settings": ["timestamp"]},
    "a rasterizer of its own and nothing else": {"package": "my_rasterization"},
    "an argument and nothing else": {"arguments": ["pixel_weights"]},
}
"""What vanilla's seams are not to be found without: hosts in which all of them hold, one for each
difference and form of it.
"""


@pytest.mark.parametrize("cousin", COUSINS)
def test_what_draws_or_trains_otherwise_is_not_vanilla(tmp_path, cousin):
    repo = skeleton(tmp_path, **COUSINS[cousin])
    assert {f.code for f in errors(repo)} <= {"rasterizer-call", "param-groups"}
    for adapters in ([Vanilla3DGS()], load_plugins().adapters):
        with pytest.raises(UnknownHostError, match="no adapter fits"):
            choose(repo, adapters)


@pytest.mark.parametrize("models", [1, 2])
def test_scripts_have_any_names_if_they_train_one_model(tmp_path, models):
    repo = skeleton(tmp_path)
    made = "gaussians = GaussianModel(3)\n" * models
    trains = "gaussians.training_setup(opt)\nloss.backward()\n"
    (tmp_path / "train_it.py").write_text(f"{made}{trains}{FLAGS}")
    (tmp_path / "train.py").unlink()
    assert ("no train.py" in [error.found for error in errors(repo)]) == (models == 2)
    assert Vanilla3DGS().command_line(repo).scripts == (
        ("train.py",) if models == 2 else ("train_it.py",)
    )


def test_a_renamed_renderer_is_read_where_its_seam_says(tmp_path):
    repo = skeleton(tmp_path, functions=["draw"])
    (tmp_path / "gaussian_renderer").rename(tmp_path / "splat")
    draws = {"render": {"module": "splat", "attribute": "draw"}}
    adapter = named("renamed", seams=revised(Vanilla3DGS.seams, draws))
    assert adapter.match(repo).fits
    assert adapter.dialect(repo).settings == tuple(SETTINGS)
    (tmp_path / "splat/__init__.py").write_text(
        "def draw(viewpoint_camera, pc):\n    return blobs(pc)\n"
    )
    (error,) = [f for f in adapter.match(HostRepo(tmp_path)).findings if f.level == "error"]
    assert (error.code, error.where.split()[0]) == ("rasterizer-call", "splat:draw")


def test_both_calls_of_a_late_state_are_vanillas_own(tmp_path):
    repo = skeleton(tmp_path, "October 2024", arguments=["dc"])
    assert Vanilla3DGS().match(repo).fits
    assert not Vanilla3DGS().match(skeleton(tmp_path / "early", arguments=["dc"])).fits


def test_a_folder_that_is_no_host_is_refused_with_a_reason_and_a_remedy(tmp_path):
    (tmp_path / "train.py").write_text("print('another project')")
    says = r"no adapter fits.*no file scene\.py.*; expected.*fragprune check"
    with pytest.raises(UnknownHostError, match=says):
        choose(HostRepo(tmp_path), [Vanilla3DGS()])


def test_names_of_adapters_are_checked_and_either_spelling_is_taken(tmp_path):
    repo, adapter = skeleton(tmp_path), Vanilla3DGS()
    assert choose(repo, [adapter], "vanilla_3dgs") is adapter
    with pytest.raises(UnknownHostError, match="vanilla-3dgs"):
        choose(repo, [adapter], "mip-splatting")
    with pytest.raises(UnknownHostError, match="none is installed"):
        choose(repo, [])


FADES = (*Vanilla3DGS.seams, Seam(Role.STILL, "scene.gaussian_model", "GaussianModel.fade"))
VANILLA, FORK = Vanilla3DGS(), named("fork", "vanilla-3dgs", seams=FADES)
FORK_OF_FORK = named("fork-of-fork", "fork", seams=FADES)
STRANGER = named("stranger", "vanilla-3dgs", seams=FADES)


@pytest.mark.parametrize(
    ("adapters", "chosen"),
    [
        ([VANILLA, FORK], "fork"),
        ([FORK_OF_FORK, VANILLA, FORK], "fork-of-fork"),
        ([VANILLA, FORK_OF_FORK], None),  # the one between is not there to say so
        ([VANILLA, FORK, STRANGER], None),
    ],
)
def test_where_a_host_and_its_ancestor_fit_it_is_the_host(tmp_path, adapters, chosen):
    fork = skeleton(tmp_path / "fork", fade="")
    if chosen:
        assert choose(fork, adapters).name == chosen
    else:
        with pytest.raises(UnknownHostError, match="several adapters fit"):
            choose(fork, adapters)
    assert choose(fork, adapters, "vanilla-3dgs").name == "vanilla-3dgs"  # who asks for it has it
    assert choose(skeleton(tmp_path / "original"), adapters).name == "vanilla-3dgs"


def test_ancestors_in_a_circle_are_a_tie(tmp_path):
    hen, egg = named("hen", "egg"), named("egg", "hen")
    repo = skeleton(tmp_path)
    assert choose(repo, [hen]) is hen
    with pytest.raises(UnknownHostError, match="several adapters fit: hen, egg"):
        choose(repo, [hen, egg])


def test_an_adapter_that_was_asked_for_in_vain_names_the_one_that_fits(tmp_path):
    says = r"no ms/train\.py.*; expected.*\. Choose vanilla-3dgs, which fits\.$"
    with pytest.raises(UnknownHostError, match=says):
        choose(skeleton(tmp_path), load_plugins().adapters, "mini-splatting")


def test_a_tie_is_not_guessed_but_a_plugin_may_break_it(tmp_path):
    repo, adapters = skeleton(tmp_path), [VANILLA, named("twin")]
    with pytest.raises(UnknownHostError, match="several adapters fit: vanilla-3dgs, twin"):
        choose(repo, adapters)
    seen = []

    def select(repo, matches):
        seen.extend(match.adapter for match in matches)
        return "twin"

    assert choose(repo, adapters, select=select) is adapters[1]
    assert seen == ["vanilla-3dgs", "twin"]
    with pytest.raises(UnknownHostError, match="several"):
        choose(repo, adapters, select=lambda repo, matches: "unheard of")


def test_the_commit_is_read_without_git(tmp_path):
    assert HostRepo(tmp_path).commit == ""
    git = tmp_path / ".git"
    (git / "refs" / "heads").mkdir(parents=True)
    (git / "HEAD").write_text("0123abcd\n")
    assert HostRepo(tmp_path).commit == "0123abcd"
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    assert HostRepo(tmp_path).commit == ""
    (git / "packed-refs").write_text("# pack\ncafe refs/heads/main\n")
    assert HostRepo(tmp_path).commit == "cafe"
    (git / "refs" / "heads" / "main").write_text("beef\n")
    assert HostRepo(tmp_path).commit == "beef"


class Installed(Vanilla3DGS):
    """A host that is a package; whatever bears its name fits."""

    name = "toy-host"
    installed = ("toyhost_of_tests",)

    def match(self, repo):
        return Match(self.name, repo.package in self.installed)


@pytest.fixture
def package(tmp_path, monkeypatch):
    folder = tmp_path / "packages" / "toyhost_of_tests"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(folder.parent)
    return folder


def test_an_installed_package_is_read_where_it_lies_and_not_imported(package):
    repo = HostRepo.installed("toyhost_of_tests")
    assert (repo.root, repo.package) == (package.parent, "toyhost_of_tests")
    assert repo.path("toyhost_of_tests") == package / "__init__.py"
    assert HostRepo.installed("nothing_of_this_name") is None
    assert HostRepo.installed("numpy").commit.startswith("numpy ")


@pytest.mark.parametrize(
    ("code", "name", "found"),
    [
        ("import toyhost_of_tests.train", None, True),
        ("from toyhost_of_tests import train", None, True),
        ("import numpy", None, False),
        ("import numpy", "toy_host", True),
    ],
)
def test_a_script_importing_an_installed_host_is_its_script(tmp_path, package, code, name, found):
    scripts = tmp_path / "own"
    scripts.mkdir()
    (scripts / "mine.py").write_text(code)
    adapters = [Vanilla3DGS(), Installed()]
    if found:
        repo, adapter = locate(HostRepo(scripts), adapters, name)
        assert (repo.root, adapter.name) == (package.parent, "toy-host")
    else:
        with pytest.raises(UnknownHostError):
            locate(HostRepo(scripts), adapters, name)


def test_a_host_whose_scripts_import_an_installed_one_is_not_that_host(tmp_path, package):
    own = skeleton(tmp_path / "own", groups=(*GROUPS, "exposure"))
    (own.root / "convert.py").write_text("import toyhost_of_tests")
    with pytest.raises(UnknownHostError, match="no adapter fits"):
        locate(own, [Vanilla3DGS(), Installed()])


@pytest.mark.parametrize(
    ("line", "installed", "found"),
    [
        ("from scene import Scene", "readme", True),
        ("from scene import Scene", "tqdm-4.67.dist-info", False),
        ("import os", "readme", False),
    ],
)
def test_the_folder_above_is_read_if_a_script_uses_it_but_not_where_packages_are_installed(
    tmp_path, line, installed, found
):
    host = skeleton(tmp_path)
    (tmp_path / installed).mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "train.py").write_text(line)
    inner, adapters = HostRepo(tmp_path / "mine"), load_plugins().adapters
    if found:
        assert locate(inner, adapters)[0].root == host.root
        return
    with pytest.raises(UnknownHostError):
        locate(inner, adapters)


@pytest.mark.parametrize("more", ["", "from gsplat.strategy import MCMCStrategy\n"])
def test_scripts_that_draw_by_gsplat_and_attach_no_model_are_a_host_of_their_own(
    tmp_path, monkeypatch, more
):
    (tmp_path / "mine.py").write_text("from gsplat import rasterization\nimport loop\n")
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop/__init__.py").write_text(more)
    looked_at = []
    monkeypatch.setattr(HostRepo, "installed", looked_at.append)
    with pytest.raises(UnknownHostError):
        locate(HostRepo(tmp_path), [Gsplat()])
    assert looked_at == ["gsplat"] * bool(more)


@pytest.mark.parametrize(
    "script",
    [
        "made = torch.optim.Adam([])",
        "gaussians.own = Adam([])",
        "if opt.water:\n        made = torch.optim.Adam([])",
    ],
)
def test_another_optimizer_of_its_script_begins_anew_where_it_resumes(tmp_path, script):
    repo = skeleton(tmp_path)
    flag = "parser.add_argument('--water', action='store_true')\n"
    with (tmp_path / "train.py").open("a") as train:
        train.write(f"\n\ndef water(opt):\n    {script}\n\n{flag}")
    found = [each.found for each in Vanilla3DGS().match(repo).findings]
    lost = ["train.py does not resume what made trains"] if script.startswith("made") else []
    assert [each for each in found if "does not resume" in each] == lost
    assert ("water" in SurfelSplatting().options(repo)) == script.startswith("if")


RENDERER = "gaussian_renderer"
NAMED = ", ".join(f"{name}=0" for name in SETTINGS)
SPELLINGS = {
    "an alias": (
        "from a_rasterizer import GaussianRasterizationSettings as S, GaussianRasterizer as R",
        f"S({NAMED})",
        "R",
    ),
    "a module": (
        "import a_rasterizer as dgr",
        f"dgr.GaussianRasterizationSettings({NAMED})",
        "dgr.GaussianRasterizer",
    ),
    "positions": (
        "from a_rasterizer import GaussianRasterizationSettings, GaussianRasterizer",
        f"GaussianRasterizationSettings({', '.join('0' * len(SETTINGS))})",
        "GaussianRasterizer",
    ),
    "another rasterizer's settings": (
        "from b import GaussianRasterizationSettings as S, GaussianRasterizer\n"
        "from a_rasterizer import GaussianRasterizer as Modified",
        f"S({NAMED})",
        "Modified",
    ),
}


@pytest.mark.parametrize("how", SPELLINGS)
def test_a_rasterizer_is_read_however_it_is_spelled(tmp_path, how):
    imports, settings, rasterizer = SPELLINGS[how]
    repo = skeleton(tmp_path)
    (tmp_path / RENDERER / "__init__.py").write_text(
        f"{imports}\n\n\ndef render(viewpoint_camera, pc):\n    s = {settings}\n"
        f"    r = {rasterizer}(raster_settings=s)\n"
        "    image, radii, depth = r(means3D=pc.get_xyz, means2D=0, opacities=0)\n"
    )
    assert drawing_functions(repo, RENDERER) == ["render"]
    (found,) = read_calls(repo, RENDERER, "render")
    assert (found.package, found.settings) == ("a_rasterizer", tuple(SETTINGS))
    assert found.names == ("image", "radii", "depth")
    assert set(found.given) == {"means3D", "means2D", "opacities", *SETTINGS}
