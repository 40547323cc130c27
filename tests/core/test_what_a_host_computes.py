"""A checkout may have every name and shape of vanilla 3DGS and still compute something else."""

import pytest
from miniatures.runs import edit
from miniatures.skeletons import skeleton

from fragprune_2dgs import SurfelSplatting
from fragprune_gaussian_splatting import GaussianSplatting
from fragprune_graphdeco.kernels import SPLAT, read_kernels, vendored
from fragprune_plugins.adapting import Role, UsageError
from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.hosts.choosing import locate
from fragprune_plugins.hosts.source import HostRepo
from fragprune_vanilla_3dgs import Vanilla3DGS

PACKAGE = "diff_gaussian_rasterization"

PROJECTION = """
__device__ float3 spread(float3 m, float fx, float fy, float* cov3, float* view) {
    float3 p = to_view(m, view);
    if (p_view.z <= 0.2f) return;
    %s
    glm::mat3 M = W * J;
    glm::mat3 cov = glm::transpose(M) * V * M;
    %s
    return {cov[0][0], cov[0][1], cov[1][1]};
}
"""
EWA = """glm::mat3 J = glm::mat3(
        fx / p.z, 0.0f, -(fx * p.x) / (p.z * p.z),   // by rows
        0.0f, fy / p.z, -(fy * p.y) / (p.z * p.z),
        0, 0, 0);"""
TANGENT = """/* EWA was: glm::mat3 J = glm::mat3(fx / p.z, 0, 0, 0, fy / p.z, 0, 0, 0, 0); */
    glm::mat3 J = glm::mat3(fx * p.z * s, 0.0f, -fx * p.x * s, 0.0f, fy, -fy * p.y, 0, 0, 0);"""
WIDENED = "cov[0][0] += 0.3f;\n    cov[1][1] += 0.3f;"
BLEND = """
__global__ void draw(float4* conics, float2* at) {
    for (int k = 0; k < n; k++) {
        float2 d = {at[k].x - x, at[k].y - y};
        float4 c = conics[k];
        %s
        if (alpha < 1.0f / 255.0f) continue;
        if (test_T < 0.0001f) { done = true; continue; }
    }
}
void launch() { draw <<<grid, block>>>(conics, at); }
"""
QUADRATIC = "float power = -0.5f * (c.x * d.x * d.x + c.z * d.y * d.y) - c.y * d.x * d.y;"
EXPONENTIAL = f"{QUADRATIC}\n        float alpha = min(0.99f, c.w * exp(power));"


def vendor(root, projection=EWA, widened=WIDENED, blend=EXPONENTIAL, folder="a", package=PACKAGE):
    project = root / "submodules" / folder
    (project / package).mkdir(parents=True)
    (project / package / "__init__.py").write_text("from . import _C\n")
    (project / "cuda").mkdir()
    (project / "cuda" / "forward.cu").write_text(PROJECTION % (projection, widened) + BLEND % blend)


def errors(repo, adapter=Vanilla3DGS):
    return [str(f) for f in adapter().match(repo).findings if f.level == "error"]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("p_view.z <= 0.2f", "p_view.z <= NEAREST", ""),
        ("1.0f / 255.0f", "FAINTEST", "fragments fainter than 1.0/2.0"),
        ("glm::mat3 J = glm::mat3", "mat3 J = mat3", ""),
        ("float power =", "S[0][0] = scale.x; float power =", ""),
        ("float power =", "S[0][0] = wide.x; float power =", "S[0][0]=wide.x"),
        ("if (alpha < 1.0f / 255.0f) continue;", "", "no test for fragments fainter than"),
        ("if (test_T < 0.0001f) { done = true; continue; }", "", "no test for no light below"),
        ("if (p_view.z <= 0.2f) return;", "", "no test for Gaussians nearer than"),
    ],
)
def test_a_rule_may_be_written_in_other_words_but_not_be_left_out(tmp_path, old, new, says):
    vendor(tmp_path)
    edit(tmp_path / "submodules/a/cuda/forward.cu", old, new)
    constants = "#define NEAREST 0.2f  // to eyes\n#define FAINTEST (1.0f / 2.0f)\n"
    (tmp_path / "submodules/a/cuda/config.h").write_text(constants)
    found = "; ".join(errors(skeleton(tmp_path)))
    assert says in found
    assert bool(found) == bool(says)


@pytest.mark.parametrize("projection", [EWA, TANGENT], ids=["known", "another"])
def test_sources_that_a_file_compiles_at_import_are_read_too(tmp_path, projection):
    vendor(tmp_path, projection, folder="kernels", package="of_another_name")
    repo = skeleton(tmp_path)
    (tmp_path / f"{PACKAGE}.py").write_text(
        "folder = os.path.join(here, 'submodules', 'kernels')\n"
        "GaussianRasterizationSettings = GaussianRasterizer = object\n"
        "_C = load(name='drawing', sources=[os.path.join(folder, 'cuda/forward.cu')])\n"
    )
    assert bool(errors(repo)) == (projection == TANGENT)
    assert bool(read_kernels(repo, PACKAGE, SPLAT)) == (projection == TANGENT)
    assert vendored(repo, PACKAGE) == [tmp_path / "submodules/kernels"]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"projection": TANGENT}, "forward.cu:6): another projection, J = (fx*p.z*s"),
        ({"blend": "float alpha = min(0.99f, c.w * area(d));"}, "c.w*area(d)): no exp()"),
        (
            {"blend": "float power = -0.5f * nearest;\n float alpha = min(0.99f, exp(power));"},
            "the exponent of alpha is -0.5*nearest",
        ),
        ({"widened": "cov[0][0] += 0.1f;"}, "a low-pass filter of 0.1"),
        ({"widened": ""}, "no low-pass filter"),
        (
            {"widened": f"{WIDENED} float blur = r * r; return {{ cov[0][0] + blur }};"},
            "Gaussians widened by blur",
        ),
        ({"blend": f"{QUADRATIC} float alpha = c.w * exp(power);"}, "not capped at 0.99"),
        ({"widened": "cov[0][0] += 0.3f; cov[1][1] += 0.1f;"}, "a low-pass filter of 0.1"),
        *(
            ({"blend": f"{EXPONENTIAL} {code}"}, says)
            for code, says in (
                ("if (alpha < 0.05f) continue;", "fragments fainter than 0.05"),
                ("if (test_T < 0.01f) done = true;", "no light below 0.01"),
                ("if (p_view.z <= 1.0f) return;", "Gaussians nearer than 1.0"),
                ("if (p_view.z <= 0.0f) return;", "Gaussians nearer than 0.0"),
                ("if (power < -4.5f) continue;", "it draws otherwise, power<-4.5"),
                ("S[2][2] = 1e-4f;", "it draws otherwise, S[2][2]="),
                ("const float SH_C0 = 0.3f;", "it draws otherwise, SH_C0=0.3;"),
                ("r = ceil(2.f * sqrt(l));", "their deviation: 2."),
                ("alpha = alpha * 0.5f;", "it draws otherwise, alpha=alpha*0.5;"),
                ("float test_T = T * (1 - alpha * alpha);", "it draws otherwise, test_T="),
                ("out_color[i] = C[ch] / (1.f - T);", "it draws otherwise, out_color[i]="),
                ("vec3 computeColorFromSH(int i) { r += 0.5f; return r; }", "harmonics are r"),
            )
        ),
        (
            {"blend": "float own = min(0.99f, x); float alpha; alpha = a * own + b; alpha = own;"},
            "alpha = a*own+b: no exp()",
        ),
    ],
)
def test_one_that_draws_by_another_is_refused_by_line(tmp_path, changed, says):
    vendor(tmp_path, **changed)
    found = errors(skeleton(tmp_path))
    assert any(says in error for error in found), found


@pytest.mark.parametrize(
    "blend",
    [
        EXPONENTIAL,
        f"{QUADRATIC} const float g = __expf(power); const float alpha = fminf(0.99f, c.w * g);",
        f"{QUADRATIC} float alpha = 0.0f; {{ float alpha = min(0.99f, c.w * exp(power)); }}",
        f"{EXPONENTIAL} float own_alpha = alpha; float test_T = T * (1 - own_alpha);",
        f"{EXPONENTIAL} if (test_T < 0.0001f) {{ done = true; continue; }}",
        f"{EXPONENTIAL} if (T > 0.5f && test_T < 0.5) median = depth;",
    ],
)
@pytest.mark.parametrize("depth", ["0, 0, 0);", "p.x / l, p.y / l, p.z / l);"])
def test_the_rule_is_known_in_other_spellings(tmp_path, blend, depth):
    vendor(tmp_path, EWA.replace("0, 0, 0);", depth), blend=blend)
    assert not errors(skeleton(tmp_path))


def test_a_known_kernel_that_is_never_launched_proves_nothing(tmp_path):
    vendor(tmp_path)
    source = tmp_path / "submodules/a/cuda/forward.cu"
    text = source.read_text().replace("void launch() { draw", "void launch() { rays")
    source.write_text(
        text
        + "__global__ void rays(float* q) { float e = -0.5f * q[0];\n"
        + "float alpha = min(0.99f, o * exp(e)); }\n"
    )
    assert any("exponent of alpha is -0.5*q[0]" in error for error in errors(skeleton(tmp_path)))


def test_an_alpha_that_nothing_is_blended_by_is_of_another_kind(tmp_path):
    vendor(tmp_path)
    source = tmp_path / "submodules/a/cuda/triangles.cu"
    source.write_text("float alpha = 1.0f - beta - gamma; float z = alpha * a + beta * b;\n")
    assert not errors(skeleton(tmp_path))
    source.write_text(f"{source.read_text()} T *= 1.0f - alpha;\n")
    assert any("alpha = 1.0-beta-gamma: no exp()" in each for each in errors(HostRepo(tmp_path)))


def test_a_form_multiplied_out_fits_and_is_named(tmp_path):
    """It may be the same quadratic form; only a picture tells."""
    vendor(
        tmp_path,
        blend="float power = A * xx + B * xy + C * yy + (u.x * x + u.y * y) + w;\n"
        "float alpha = min(0.99f, exp(power));",
    )
    findings = Vanilla3DGS().match(skeleton(tmp_path)).findings
    assert [f.level for f in findings if f.code == "kernel"] == ["warning"]
    assert Vanilla3DGS().match(skeleton(tmp_path)).fits
    (tmp_path / "train_more.py").write_text(MORE)  # it is read as a fork all the same
    assert not Vanilla3DGS().match(HostRepo(tmp_path)).fits


MORE = "gaussians.training_setup(opt)\nloss.backward()\n"


def test_a_further_training_script_of_a_named_host_is_not_served(tmp_path):
    repo, adapter = skeleton(tmp_path), SurfelSplatting()
    (tmp_path / "train_more.py").write_text(MORE)
    (tmp_path / "render_more.py").write_text("loss.backward()\n")
    assert adapter.trainer(repo, tmp_path / "train.py") is adapter
    assert adapter.trainer(repo, tmp_path / "render_more.py") is adapter
    with pytest.raises(UsageError, match=r"train_more\.py"):
        adapter.trainer(repo, tmp_path / "train_more.py")
    said = [each.found for each in adapter.match(repo).findings if each.level == "warning"]
    assert said == [f"train_more.py, which is not served: {adapter.info.title} has no such script"]


def test_every_rasterizer_of_the_name_counts(tmp_path):
    vendor(tmp_path, folder="a")
    vendor(tmp_path, folder="b", projection=TANGENT)
    vendor(tmp_path, folder="c", projection=TANGENT, package="another_rasterizer")
    found = errors(skeleton(tmp_path))
    assert ["submodules/b/cuda" in error for error in found] == [True]


def test_a_source_that_is_not_compiled_is_not_read(tmp_path):
    vendor(tmp_path)
    project = tmp_path / "submodules/a"
    other = "float alpha = min(0.99f, c.w * area(d));"
    (project / "cuda/trials").mkdir()
    (project / "cuda/trials/forward.cu").write_text(PROJECTION % (EWA, WIDENED) + BLEND % other)
    setup = 'setup(ext_modules=[CUDAExtension("_C", ["cuda/forward.cu", "ext.cpp"])])'
    (project / "setup.py").write_text(setup)
    assert not errors(skeleton(tmp_path))
    (project / "cuda/ext.h").write_text('#include "trials/forward.cu"\n')
    assert "no exp()" in errors(HostRepo(tmp_path))[0]
    (project / "cuda/ext.h").unlink()
    (project / "setup.py").write_text("setup(ext_modules=[CUDAExtension('_C', glob('cuda/*'))])")
    assert "no exp()" in errors(HostRepo(tmp_path))[0]


def test_modules_that_are_imported_under_other_names_are_refused(tmp_path):
    """Those are other modules, which no seam reaches."""
    skeleton(tmp_path)
    renderer = tmp_path / "gaussian_renderer/__init__.py"
    text = renderer.read_text()
    inside = "try:\n    import scene\nexcept ImportError:\n    import src.scene.gaussian_model\n"
    renderer.write_text(inside + text)
    assert not errors(HostRepo(tmp_path))
    renderer.write_text("from splatting.scene.gaussian_model import GaussianModel\n" + text)
    assert "splatting.scene.gaussian_model" in errors(HostRepo(tmp_path))[0]
    (tmp_path / "splatting").mkdir()  # a package, though it has no __init__.py
    assert not errors(HostRepo(tmp_path))


def test_surfels_have_a_rule_of_their_own(tmp_path):
    """A rasterizer of surfels has no projection of covariances."""
    surfel = "diff_surfel_rasterization"
    splats = skeleton(tmp_path, package=surfel, outputs=3)
    vendor(
        tmp_path,
        projection="",
        widened="",
        blend="float power = -0.5f * rho; float alpha = min(0.99f, o * exp(power));",
        package=surfel,
    )
    assert not any("[kernel]" in error for error in errors(splats, SurfelSplatting))


def rewritten(repo: HostRepo, file: str, old: str, new: str) -> HostRepo:
    edit(repo.root / file, old, new)
    return HostRepo(repo.root)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "return self._xyz",
            "\n        return self._xyz if self.mesh is None else self.mesh.place(self._xyz)",
            "get_xyz (scene/gaussian_model.py:",
        ),
        (
            "return self._xyz",
            "\n        moved = self.activation(self._xyz)\n        return moved",
            "computed, it returns moved",
        ),
        ("@property\n    def get_xyz", "def get_xyz", "a method"),
        ("@property\n    def get_opacity", "def get_opacity", "a method"),
        ("def get_opacity", "def opacities", "no such property"),
        ("return self._xyz", "\n        means = self._xyz\n        return means", None),
    ],
)
def test_positions_that_are_not_the_parameter_are_refused(tmp_path, old, new, says):
    repo = rewritten(skeleton(tmp_path), "scene/gaussian_model.py", old, new)
    found = errors(repo)
    expected = [True] if says else []  # a getter may name the parameter first
    assert ["[model-getter]" in error and says in error for error in found] == expected


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("import hydra\n@hydra.main()\ndef main(cfg): ...\n", "it reads its settings with hydra"),
        ("args = parser.parse_args()\n", "--start_checkpoint; expected the flags"),
    ],
)
def test_a_script_without_our_flags_is_refused(tmp_path, text, says):
    repo = skeleton(tmp_path)
    (tmp_path / "train.py").write_text(text)
    assert any("[flags]" in error and says in error for error in errors(repo))


def test_a_drawing_function_of_a_host_returns_its_picture_as_render(tmp_path):
    repo = skeleton(tmp_path)
    render = tmp_path / "gaussian_renderer/__init__.py"
    returns = '\n    return {{"{}": image, "radii": radii}}\n'.format
    drawn = render.read_text().rstrip().replace("value0", "image")
    render.write_text(drawn + returns("render"))
    assert not errors(repo)
    for old, new, says in (
        ('"render": image', '"render": image[:3]', "a picture of more channels, image[:3]"),
        ('"render": image[:3]', '"foreground": image', "returns no render"),
    ):
        edit(render, old, new)
        assert says in errors(HostRepo(tmp_path))[0]


@pytest.mark.parametrize(
    ("old", "new", "says", "more"),
    [
        (
            *("parser.parse_args(", "merged_args(parser, ", "no argparse"),
            "def merged_args(parser, line):\n    return parser.parse_args(line)\n",
        ),
        ('"--model_path", ', "", "no --model_path", "        self._model_path = ''\n"),
    ],
)
def test_a_module_of_argument_groups_may_read_flags_and_makes_some(tmp_path, old, new, says, more):
    repo = rewritten(skeleton(tmp_path), "train.py", old, new)
    assert any(says in error for error in errors(repo))
    with (tmp_path / "arguments/__init__.py").open("a") as groups:
        groups.write(more)
    assert not errors(HostRepo(tmp_path))


def test_a_folder_of_the_same_name_as_an_installed_host_is_not_that_host(tmp_path, monkeypatch):
    installed = type("Installed", (Vanilla3DGS,), {"installed": ("sharedname",)})()
    (tmp_path / "sharedname").mkdir()
    (tmp_path / "train.py").write_text("from sharedname.scene import Scene\n")
    looked_at = []
    monkeypatch.setattr(HostRepo, "installed", looked_at.append)
    with pytest.raises(UnknownHostError):
        locate(HostRepo(tmp_path), [installed], above=False)
    assert not looked_at
    (tmp_path / "sharedname").rmdir()
    with pytest.raises(UnknownHostError):
        locate(HostRepo(tmp_path), [installed], above=False)
    assert looked_at == ["sharedname"]


@pytest.mark.parametrize(
    ("name", "meant"), [("trainer.base", True), ("scene.gaussian_model", False)]
)
def test_a_package_without_the_modules_that_a_script_imports_is_not_meant(
    tmp_path, monkeypatch, name, meant
):
    base = tmp_path / "site/gaussian_splatting/trainer/base.py"
    base.parent.mkdir(parents=True)
    base.touch()
    monkeypatch.setattr(HostRepo, "installed", lambda each: HostRepo(tmp_path / "site", each))
    (tmp_path / "slam.py").write_text(f"from gaussian_splatting.{name} import Base\n")
    found = {each.code for each in GaussianSplatting().match(HostRepo(tmp_path)).errors}
    assert ("own-host" not in found) == meant


def test_a_drawing_of_other_values_than_the_adapter_states_is_refused(tmp_path):
    root = tmp_path / "posed"
    posed = rewritten(
        skeleton(root), "gaussian_renderer/__init__.py", "means3D=1", "means3D=pc.posed(pc.get_xyz)"
    )
    assert "[drawn-values]" in "".join(errors(posed))
    assert "render makes means3D from pc.posed, not from its PLY alone" in errors(posed)[0]
    stated = type("Posed", (Vanilla3DGS,), {"drawn_from": ("posed",)})
    assert not errors(posed, stated)


def test_rows_that_a_named_host_picks_where_its_scripts_ask_for_it_are_refused(tmp_path):
    picks = "means3D=pc.get_xyz[override_color]"
    repo = rewritten(skeleton(tmp_path), "gaussian_renderer/__init__.py", "means3D=1", picks)
    assert not any("selection" in each for each in errors(repo, SurfelSplatting))
    repo = rewritten(
        repo, "train.py", "import render\n", "import render\nrender(1, pc=2, override_color=3)\n"
    )
    assert "draws a selection, pc.get_xyz[override_color]" in str(errors(repo, SurfelSplatting))


FADES = """
def training(args):
    gaussians = GaussianModel(3)
    for iteration in range(9):
        gaussians.fade()
        loss.backward()
        {}
            gaussians._xyz.add_(1)
"""


def test_what_a_fork_of_a_named_host_changes_stands_still(tmp_path):
    noisy = "parser.add_argument('--noisy', action='store_true')\n"
    repo = rewritten(skeleton(tmp_path), "train.py", "\ndef report", f"{noisy}{FADES}\ndef report")
    model = tmp_path / "scene/gaussian_model.py"
    model.write_text(f"{model.read_text()}\n    def fade(self): self._opacity = 0\n")
    asked = rewritten(repo, "train.py", "        {}", "        if args.noisy:")
    still = [
        each.attribute for each in SurfelSplatting().seams_for(asked) if each.role is Role.STILL
    ]
    assert still[-1] == "GaussianModel.fade"
    assert not any("changes _xyz" in each for each in errors(asked, SurfelSplatting))
    with pytest.raises(UsageError, match="--noisy"):
        SurfelSplatting().refuse(asked, ["--noisy"], stage="auto", device="cpu")
    always = rewritten(repo, "train.py", "if args.noisy:", "if True:")
    assert any("changes _xyz outside" in each for each in errors(always, SurfelSplatting))


@pytest.mark.parametrize("kind", ["scaling", "rotation"])
def test_every_value_that_a_named_host_draws_is_its_parameter_activated(tmp_path, kind):
    repo = skeleton(tmp_path, **{"other": ""})
    getter = f"    @property\n    def get_{kind}(self): return %s\n\n    def other"
    activated = f"self.{kind}_activation(self._{kind})"
    path = "scene/gaussian_model.py"
    assert not errors(rewritten(repo, path, "    def other", getter % activated))
    moved = rewritten(repo, path, f"return {activated}", f"return {activated} * self.spread")
    assert f"get_{kind} is computed" in errors(moved)[0]
