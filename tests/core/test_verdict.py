"""One sentence for each checkout: it fits, its PLY does, or never, and why."""

import pytest
from miniatures.skeletons import FLAGS, GROUPS, skeleton

from fragprune_graphdeco.photographs import NOT_FOUND
from fragprune_graphdeco.plain import read_plain
from fragprune_plugins.hosts.choosing import attempt
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.check.work import judge
from fragprune_plugins.workbench.run.unserved import unserved

MODEL = """
    def setup_functions(self):
        self.scaling_activation = torch.exp
        self.opacity_activation = torch.sigmoid

    @property
    def get_scaling(self):
        return self.scaling_activation(self._scaling)

    @property
    def get_xyz(self):
        return self._xyz

    @property
    def get_features(self):
        return torch.cat((self._features_dc, self._features_rest), dim=1)

    def create_from_pcd(self, pcd):
        scales = torch.log(distances)[..., None].repeat(1, 3)
        self._scaling = nn.Parameter(scales.requires_grad_(True))

    def construct_list_of_attributes(self):
        names = ["x", "y", "z", "nx", "ny", "nz", "opacity"]
        for i in range(3):
            names.append("f_dc_{}".format(i))
            names.append("f_rest_{}".format(i))
            names.append(f"scale_{i}")
            names.append("rot_" + str(i))
        return names

    def save_ply(self, path):
        opacities = self._opacity.detach().cpu().numpy()
        scale = self._scaling.detach().cpu().numpy()
"""
SAVED = "        scale = self._scaling.detach().cpu().numpy()\n"
RENDER = """
from diff_gaussian_rasterization import GaussianRasterizer


def render(viewpoint_camera, pc, pipe, bg_color, training=False, override_color=None):
    rasterizer = GaussianRasterizer(raster_settings=settings)
    means3D = pc.get_xyz
    opacity = pc.get_opacity
    if training:
        opacity = opacity * pc.dropout
    shs = None
    if override_color is None:
        shs = pc.get_features
    if pipe.compute_cov3D_python:
        cov3D = pc.get_covariance(1.0)
    else:
        scales, rotations = pc.get_scaling, pc.get_rotation
    image, radii, depth, used = rasterizer(
        means3D=means3D, opacities=opacity, shs=shs, scales=scales, rotations=rotations
    )
    return {"render": image}
"""
GROWS = """
    def grow(self, points):
        scales = scales.repeat(1, 2)

    def save_ply"""
CALLED = "rotations=rotations\n    )\n"
MEAN = """rotations=rotations
    )
    return {"render": image.mean(dim=0)}
"""
CLAMPED = """rotations=rotations
    )
    if training:
        image = image * pc.exposure
    image = torch.clamp(image, 0, 1) + (1 - alpha) * bg_color
    return {"render": image.contiguous()}
"""

EXPOSED = """rotations=rotations
    )
    if training and pc.exposure is not None:
        image = image * pc.exposure
    image = image + pc.net(t) * torch.zeros_like(image)
    return {"render": image}
"""
CALL = "    image, radii, depth, used = rasterizer(\n"
REUSED = f"""    seen = pc.get_features
    colours = torch.clamp_min(eval_sh(seen) + 0.5, 0)
    seen = pc.get_objects
{CALL}        colors_precomp=colours,
"""

JOINED = """    colours = torch.clamp_min(eval_sh(pc.get_features) + 0.5, 0)
    colours = torch.cat([colours, pc.net(depths)], dim=1)
    colours = torch.cat([colours, depths], dim=1)
    whole, radii = rasterizer(means3D=means3D, opacities=opacity, colors_precomp=colours)
    image = whole[:3]
    return {"render": image}
"""

COLOURS = """        shs = pc.get_features
        if dx is not None:
            shs = shs + dx
"""
MOVES = """    means3D = pc.get_xyz
    if opt is not None and opt.random_background:
        means3D = pc.get_xyz + pc.get_dx
    if dx is not None:
        means3D = pc.get_xyz + dx
"""
ASKED = """    opacity = pc.get_opacity
    if getattr(pc, "hidden", None) is not None:
        opacity = opacity * pc.hidden
"""
SHADOW = """    with torch.no_grad():
        _, shadow, _, _ = rasterizer(
            means3D=pc.get_xyz, opacities=pc.net(light), shs=None, colors_precomp=black
        )
    means3D = pc.get_xyz
"""
END = """rotations=rotations
    )
    return {"render": image}
"""
GSPLAT = """rotations=rotations
    )
    drawn, alpha, more = gsplat.rasterization(
        means3D, quats=rotations, scales=scales, opacities=opacity.squeeze(-1), colors={}
    )
    return {{"render": drawn[0].permute(2, 0, 1)}}
"""
CHOSEN = """rotations=rotations
    )
    raw = rasterizer(means3D=means3D, opacities=opacity, shs=shs)
    image, more = chosen(raw)
    return {"render": image}


def chosen(given):
    if len(given) == 2:
        first, second = given
        return first, second
    first, *others = given
    return first{}, others
"""


NO_MODEL = "no model of this family that saves a PLY was found"
BOXED = """
    if training:
        boxed, shades = pc.get_xyz[pc.box], pc.get_features[pc.box]
        image, radii, depth, used = rasterizer(
            means3D=boxed, opacities=faint, shs=shades, colors_precomp=lit
        )
        return {"render": image}
    means3D = pc.get_xyz
"""


SHAPES = """    def get_shapes(self):
        return {}, self.get_scaling

    def save_ply"""
SHAPED = """
    shapes = pc.get_shapes()
    opacity, _ = shapes
"""


@pytest.fixture
def fork(tmp_path):
    """A fork whose PLY is plain 3DGS and that no adapter fits; replaces text in its files."""

    def make(*changes: tuple[str, str], root=tmp_path) -> HostRepo:
        skeleton(root, groups=(*GROUPS, "exposure"))
        model = root / "scene/gaussian_model.py"
        texts = {
            model: model.read_text().replace("    def save_ply(self, path): ...\n", "") + MODEL,
            root / "gaussian_renderer/__init__.py": RENDER,
            root / "train.py": (root / "train.py").read_text(),
        }
        for old, new in changes:
            assert any(old in text for text in texts.values()), old
            texts = {path: text.replace(old, new) for path, text in texts.items()}
        for path, text in texts.items():
            path.write_text(text)
        return HostRepo(root)

    return make


def judged(repo):
    plugins = load_plugins()
    return judge(repo, attempt(repo, plugins.adapters), plugins.adapters, plugins)


def test_a_host_fits_and_what_reading_cannot_show_is_named(tmp_path):
    verdict = judged(skeleton(tmp_path))
    assert (verdict.kind, verdict.adapter) == ("fits", "vanilla-3dgs")
    assert "sources of diff_gaussian_rasterization are not in the checkout" in verdict.sentence


def test_a_fork_with_a_plain_ply_is_told_the_command(fork):
    verdict = judged(fork())
    assert verdict.kind == "finetune"
    assert "fragprune finetune" in verdict.sentence
    assert "fragprune run" in verdict.sentence
    assert "--self" in verdict.sentence  # its train.py is empty: no loss was found
    assert verdict.differs == ("no script that trains a GaussianModel (scripts: train.py)",)
    assert verdict.adapter == "3dgs-fork"


def test_the_nearest_host_is_of_this_family(fork):
    adapters = load_plugins().adapters
    tried = [*attempt(fork(), adapters).values()]
    assert [each.adapter for each in tried[:2]] == ["3dgs-fork", "vanilla-3dgs"]
    assert not any(each.held for each in tried[-2:])


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("means3D = pc.get_xyz", "means3D = pc.get_xyz + pc.net(t)", "means3D from pc.net"),
        (
            "    means3D = pc.get_xyz\n",
            "    means3D, opacity = made_for(viewpoint_camera, pc)\n    pc.get_xyz\n",
            "means3D from pc, not from its PLY",
        ),
        ("shs = pc.get_features", "shs = pc.network(view)", "colours from pc.network"),
        (
            "means3D = pc.get_xyz\n",
            "means3D = pc.get_xyz\n    for each in pc.nets: means3D = each(means3D, pc.feature)\n",
            "means3D from pc.feature",
        ),
        ("return self._xyz", "return self._xyz + self.moved", "get_xyz is computed"),
        ("return torch.cat((", "return self.net((", "get_features is computed"),
        ("shs=shs, scales", "dc=shs, shs=pc.net(view), scales", "colours from pc.net"),
        ("= self._opacity.detach()", "= self.get_opacity_now.detach()", "stores other values"),
        (
            SAVED,
            SAVED + "        PlyElement.describe(rows, f'vertex_{i}')\n",
            "f'vertex_{i}', no vertex",
        ),
        ("= self._opacity.detach()", "= to_numpy(2 * self._opacity)", "other numbers"),
        ("means3D=means3D, ", "means=means3D, ", "no function was found that calls"),
        ('"opacity"]', '"opacity", "binding_0"]', "binding, positions relative to the triangles"),
        ('names.append("f_dc_{}".format(i))', "...", "lacks the columns f_dc"),
        (".repeat(1, 3)", ".repeat(1, 2)", "flat, with two scales"),
        (
            ".repeat(1, 3)",
            ".repeat(1, 2) if flat else scales.repeat(1, 3)",
            "flat, with two scales",
        ),
        (".repeat(1, 3)", "", "its Gaussians are round, with one scale"),
        (".repeat(1, 3)", ".repeat(1, 1)", "its Gaussians are round, with one scale"),
        ("means3D=means3D, ", "means3D + pc.net(view), ", "makes means3D from pc.net"),
        ("    def save_ply", GROWS, "flat, with two scales"),
        ("= self._opacity.detach()", "= self.get_opacity.detach()", "stores activated values"),
        ("scaling_activation = torch.exp", "scaling_activation = softplus", "is softplus"),
        *(
            ("self.scaling_activation(self._scaling)", computed, "get_scaling is computed")
            for computed in (
                "self.net(self._xyz)",
                "self.scaling_activation(self._scaling) + self.least",
                "self.net(self._scaling)",
                "torch.clamp(self._scaling, 0, 1)",
                "self.scaling_activation(self._scaling).net(2)",
                "self.opacity_activation(self._scaling)",
                "self._scaling",
                "made\n        if self.still: made = self._scaling\n        return torch.exp(made)",
            )
        ),
        *(
            (
                "return self.scaling_activation(self._scaling)",
                f"made = self._scaling\n        if on: made = {k}\n        return torch.exp(made)",
                "get_scaling is computed",
            )
            for k in ("net(made)", "made[seen]", "self._scaling_quantised")
        ),
        (END, GSPLAT.format("pc.net(x)"), "colours from pc.net"),
        (END, GSPLAT.format("shs, rasterize_mode='soft'"), "rasterize_mode='soft', not 'classic'"),
        (END, GSPLAT.format("shs, eps2d=0.0"), "render draws with eps2d=0.0, not 0.3"),
        (END, CHOSEN.replace("{}", " / 2"), "is made into chosen(raw)"),
        ("image, radii, depth", "dark_image, image, radii", "another picture first, dark_image"),
        ("    opacity = pc.get_opacity\n", f"{ASKED}    pc.hidden = 0\n", "from pc.hidden"),
        (CALLED, MEAN, "its picture is made into image.mean(dim=0)"),
        ("shs=shs, scales", "mesh_color=mesh, shs=shs, scales", "rasterizer also takes mesh_color"),
        (
            "raster_settings=settings",
            "raster_settings=GaussianRasterizationSettings(depth=bg_depth)",
            "its rasterizer also takes bg_depth",
        ),
        ("{'params': [], 'name': 'f_dc'}", "{'params': [self._opacity]}", "not train positions"),
        ("shs=shs, scales", "colors_precomp=torch.exp(rgb), shs=shs, scales", "torch.exp(rgb)"),
        *(
            (
                "    opacity = pc.get_opacity\n",
                f"    opacity = {made}\n",
                "opacities otherwise than",
            )
            for made in (
                "pc.get_opacity * 0.9",
                "pc.get_opacity.clamp(max=0.5)",
                "(pc.get_opacity > 0.5).float()",
                "torch.tanh(pc._opacity)",
                "pc.get_opacity\n    opacity[seen] = 0",
                "pc.get_opacity\n    opacity.mul_(0.9)",
            )
        ),
        ("pc.get_scaling, pc", "pc.get_scaling[:, :1].repeat(1, 3), pc", "scales otherwise than"),
        (
            "    @property\n    def get_xyz",
            "    @property\n    @still\n    def get_xyz",
            "get_xyz is computed",
        ),
        (
            "    def construct",
            "    @property\n    def get_scaling(self): return self.net(x)\n\n    def construct",
            "get_scaling is computed",
        ),
        (
            "        opacities = self._opacity",
            "        opacities = 2 * self._opacity",
            "other numbers",
        ),
        ("self._scaling.detach().cpu().numpy()", "np.exp(self._scaling)", "other numbers, scale"),
        (CALLED, f"{CALLED}    image = image[:, 4:-4]\n", "is made into image[:, 4:-4]"),
        (CALLED, f"{CALLED}    image.mul_(gain)\n", "is made into image.mul_(gain)"),
        ("\n\ndef render", "\n\n@toned\ndef render", "render is wrapped by toned"),
        ("\n\ndef render", "\n\nrender = toned(render)\n\n\ndef render", "by toned(render)"),
        (
            SAVED,
            "        ...\n\n\nGaussianModel.get_opacity = other\n",
            "GaussianModel.get_opacity is replaced",
        ),
        ("shs=shs, scales", "colors_precomp=pc.net(view), shs=shs, scales", "colours from pc.net"),
        (CALL, f"    rgb = torch.sigmoid(pc.get_features)\n{CALL}colors_precomp=rgb,", "not max("),
        ("= self._opacity.detach()", "= self.baked(self._opacity).detach()", "other numbers"),
        (
            "raster_settings=settings",
            "raster_settings=GaussianRasterizationSettings(scale_modifier=0.5)",
            "draws with scale_modifier=0.5, not 1.0",
        ),
        ("shs = pc.get_features\n", "shs = pc._features_rest\n", "pc._features_rest alone"),
    ],
)
def test_one_whose_ply_is_not_the_picture_is_told_why(fork, old, new, reason):
    verdict = judged(fork((old, new)))
    assert verdict.kind == "never"
    assert reason in verdict.reason
    assert reason in verdict.sentence


DROPPED = (
    ("override_color=None):", "override_color=None, iteration=None):"),
    ("scene.save(", "render(training=True, iteration=iteration), scene.save("),
    ("* pc.dropout", "* dropped(iteration / 1000)"),
)
JOINED_DC = "    both = torch.cat([dc, shs], dim=1)\n    drawn"
GIVEN_DC = (
    ("override_color=None):", "override_color=None, dc=None):"),
    (END, GSPLAT.format("both").replace("    drawn", JOINED_DC)),
)
STILL = (
    ("{'params': [], 'name': 'f_dc'}", "{'params': [self._opacity]}"),
    (
        ".repeat(1, 3)\n",
        ".repeat(1, 3)\n        self._xyz = nn.Parameter(p.requires_grad_(False))\n",
    ),
)


@pytest.mark.parametrize(
    "changes",
    [
        DROPPED,
        GIVEN_DC,
        STILL,
        ("scene.save(", "scene_static.save("),
        ("means3D = pc.get_xyz", "means3D = moved(viewpoint_camera.pose, pc.get_xyz)"),
        ('"opacity"]', '"opacity", "obj_dc_0"]'),
        ("= self._opacity.detach()", "= self.inverse_activation(self.get_opacity)"),
        ("= self._opacity.detach()", "= to_numpy(self.rows['opacity'])"),
        (
            SAVED,
            SAVED
            + "        PlyElement.describe(rows, 'vertex'), PlyElement.describe(rows, 'code')\n",
        ),
        ("        scale = self._sc", "        m = self.get_opacity > 0\n        scale = self._sc"),
        ("shs = pc.get_features", "shs = cut(pc.get_features, pc.get_max_sh_channels)"),
        ("opacity = pc.get_opacity\n", "opacity = pc.opacity_activation(pc._opacity)\n"),
        ("activation(self._scaling)", "activation(self._scaling.repeat(1, 3))"),
        ("shs = pc.get_features", "shs = pc.get_features(training)"),
        ("shs = pc.get_features", "shs = getattr(pc, 'get_features', None)"),
        ("    means3D = pc.get_xyz\n", "    means3D = pc.net(t)\n    means3D = pc.get_xyz\n"),
        (CALLED, f"{CALLED}    opacity = pc.net(image)\n"),
        (CALLED, f"{CALLED}    image = image[:3]\n"),
        ("\n\ndef render", "\n\ndef l1(render):\n    render = clamp(render)\n\n\ndef render"),
        ("\n\ndef render", "\n\nrender = partial(render, pipe=None)\n\n\ndef render"),
        ("means3D=means3D, opacities=opacity, shs=shs,", "means3D, None, opacity, shs,"),
        (CALLED, CLAMPED),
        (END, EXPOSED),
        ("    opacity = pc.get_opacity\n", ASKED),
        ("torch.cat(", "jt.concat("),
        ("= torch.exp", "= jt.exp"),
        ("    image, radii, depth, used = ", "    counts, radii, image, used = "),
        ("    image, radii, depth, used = ", "    num_rendered, depth_image, image, used = "),
        (CALL, REUSED),
        (CALL, JOINED + CALL),
        (
            "class GaussianModel:",
            f"class GaussianModel2D:{GROWS}(self): ...\n\n\nclass GaussianModel:",
        ),
        ("\n    means3D = pc.get_xyz\n", BOXED),
        ("    means3D = pc.get_xyz\n", SHADOW),
        (END, GSPLAT.format("shs")),
        (END, GSPLAT.format("shs, rasterize_mode='classic', packed=False")),
        (END, CHOSEN.replace("{}", "")),
        (".repeat(1, 3)", "\n        scales = scales if self.round else scales.repeat(1, 3)"),
        (".repeat(1, 3)", ".repeat(1, 2)\n        scales = torch.cat([scales, thin], dim=-1)"),
    ],
)
def test_what_leaves_the_picture_alone_is_plain(fork, changes):
    assert read_plain(fork(*((changes,) if isinstance(changes[0], str) else changes)))


def test_gaussians_that_a_rasterizer_of_surfels_draws_are_flat(fork):
    made = ("settings=settings", "settings=GaussianRasterizationSettings(debug=False)")
    names = "GaussianRasterizationSettings, GaussianRasterizer\n"
    named = ("import GaussianRasterizer\n", f"import {names}")
    assert read_plain(fork(made, named))
    flat = ("diff_gaussian_rasterization", "diff_surfel_rasterization")
    reasons = read_plain(fork(made, named, flat)).reasons
    assert reasons == ("its Gaussians are flat, drawn by diff_surfel_rasterization",)


@pytest.mark.parametrize(
    ("drawn", "given", "kind"),
    [
        ("shs=shs, scales", "True", "never"),
        ("shs=shs, scales", "opt.apart", "never"),
        ("shs=shs, scales", "False", "finetune"),
        ("dc=dc, shs=shs, scales", "True", "finetune"),
    ],
)
def test_harmonics_without_the_first_are_others(fork, tmp_path, drawn, given, kind):
    apart = (
        "        shs = pc.get_features\n",
        (
            "        shs = pc.get_features\n"
            "        if apart:\n            dc, shs = pc.get_features_dc, pc.get_features_rest\n"
        ),
    )
    takes = ("override_color=None):", "override_color=None, apart=False):")
    repo = fork(apart, takes, ("shs=shs, scales", drawn))
    (tmp_path / "slam.py").write_text(f"package = render(camera, model, pipe, bg, apart={given})\n")
    assert judged(repo).kind == kind


def test_columns_may_be_listed_by_any_method_that_saves(fork):
    listed = ("def construct_list_of_attributes(", "def columns_of(")
    saves = (SAVED, SAVED + "        names = self.columns_of()\n")
    assert read_plain(fork(listed, saves))
    found = read_plain(fork(listed, saves, ('"opacity"]', '"opacity", "binding_0"]'))).reasons
    assert "its PLY also holds binding" in str(found)


@pytest.mark.parametrize("gives", ["result", "image, result[1]", "2 * image, result[1]"])
def test_a_picture_that_a_module_beside_unpacks_is_the_same(fork, tmp_path, gives):
    named = ("\n\ndef render", "\nfrom gaussian_renderer.compat import unpacked\n\n\ndef render")
    taken = (CALLED, f"{CALLED}    image, radii = unpacked((image, radii))\n")
    repo = fork(named, taken)
    made = f"def unpacked(result):\n    image, radii = result\n    return {gives}\n"
    (tmp_path / "gaussian_renderer/compat.py").write_text(made)
    assert bool(read_plain(repo)) == ("2 *" not in gives)


def test_values_in_further_columns_that_a_rasterizer_takes_make_another_picture(fork):
    taken = ("shs=shs, scales", "vi=pc.get_vi, sem=pc.get_vi, shs=shs, scales")
    assert read_plain(fork(taken))
    reasons = read_plain(fork(taken, ('"opacity"]', '"opacity", "f_do_0"]'))).reasons
    assert reasons == ("its rasterizer also takes vi",)


@pytest.mark.parametrize("seen", ["rendered_mask", "depth"])
def test_a_mask_of_which_a_rasterizer_gives_a_picture_scales_no_opacities(fork, seen):
    taken = ("shs=shs, scales", "mask=pc.get_mask, shs=shs, scales")
    given = ("image, radii, depth, used =", f"image, {seen}, radii, used =")
    reasons = read_plain(fork(taken, given, ('"opacity"]', '"opacity", "mask"]'))).reasons
    assert ("masks that scale the opacities" in str(reasons)) == bool(reasons) == (seen == "depth")


@pytest.mark.parametrize("usual", [1.0, 0.5, 2.0])
def test_scales_times_what_is_1_if_not_given_are_no_others(fork, usual):
    scaled = ("pc.get_scaling, pc", "pc.get_scaling * scaling_modifier, pc")
    given = ("override_color=None):", f"override_color=None, scaling_modifier={usual}):")
    reasons = read_plain(fork(scaled, given)).reasons
    assert ("scales otherwise than" in str(reasons)) == bool(reasons) == (usual != 1)


def test_covariances_to_which_something_is_added_are_others(fork):
    sized = "    def get_covariance(self, size):\n        return cov(size) + 0.1\n\n"
    changes = [
        ("if pipe.compute_cov3D_python", "if pipe.of_covariances"),
        ("shs=shs, scales", "cov3D_precomp=cov3D, shs=shs, scales"),
    ]
    assert read_plain(fork(*changes))
    found = read_plain(fork(*changes, ("    def construct", f"{sized}    def construct"))).reasons
    assert "get_covariance makes other covariances" in str(found)


@pytest.mark.parametrize("value", ["self.get_opacity", "self.get_opacity * self.rain"])
def test_a_method_that_gives_getters_alone_is_plain(fork, value):
    changes = (
        ("    def save_ply", SHAPES.format(value)),
        ("\n    opacity = pc.get_opacity\n", SHAPED),
    )
    reasons = read_plain(fork(*changes)).reasons
    assert ("makes opacities from pc.get_shapes" in str(reasons)) == ("rain" in value)


@pytest.mark.parametrize("asked", ["self.round", "self.args.round"])
def test_a_getter_may_compute_under_an_option_that_is_off(fork, tmp_path, asked):
    plain = "self.scaling_activation(self._scaling)"
    made = f"{plain} if not {asked} else {plain}[:, :1].repeat(1, 3)"
    changes = (
        (f"return {plain}", f"return {made}"),
        (
            "    def save_ply",
            "    def create(self, round):\n        self.round = round\n\n    def save_ply",
        ),
    )
    repo = fork(*changes)
    assert "get_scaling is computed" in read_plain(repo).reasons[0]

    def given(default, later):
        group = f"class Params:\n    def __init__(self):\n        self.round = {default}\n"
        (tmp_path / "arguments/__init__.py").write_text(group)
        own = asked.replace("self", "gaussians")
        (tmp_path / "train.py").write_text(f"{FLAGS}\n{own} = {later}\n")
        return judged(HostRepo(tmp_path))

    off = given(False, False)
    assert off.kind == "finetune"
    assert "get_scaling is computed" in str(off.differs)
    for default, later in ((False, True), (True, False)):
        assert "get_scaling is computed" in given(default, later).reason


def test_a_script_that_is_no_python_is_named(fork, tmp_path):
    repo = fork()
    (tmp_path / "train.py").write_text("for each in views:\nscene.save(3)\n")
    assert judged(repo).differs[0] == "train.py is no valid Python (scripts: train.py)"


def test_what_is_never_saved_is_not_plain(fork, tmp_path):
    repo = fork(("scene.save(", "scene.show("))
    assert "none of its scripts saves a PLY" in read_plain(repo).reasons
    loop = tmp_path / "scene/loop.py"
    loop.write_text("class Scene:\n    def save(self):\n        self.gaussians.save_ply(path)\n")
    assert "none of its scripts saves a PLY" in read_plain(HostRepo(tmp_path)).reasons
    loop.write_text("def run(scene):\n    scene.save(3)\n")
    assert "none of its scripts saves a PLY" not in read_plain(HostRepo(tmp_path)).reasons


@pytest.mark.parametrize(
    ("drawn", "kind", "reason"),
    [("pc.get_xyz", "finetune", ""), ("pc.net(t)", "never", "render makes means3D from pc.net")],
)
@pytest.mark.parametrize(
    ("setup", "name"),
    [("training_setup", "train"), ("by_another_name", "train"), ("training_setup", "slam")],
)
def test_model_and_drawing_may_lie_in_any_package(fork, tmp_path, drawn, kind, reason, setup, name):
    fork(("means3D = pc.get_xyz", f"means3D = {drawn}"), ("def training_setup(", f"def {setup}("))
    package = tmp_path / "splats/parts"
    package.mkdir(parents=True)
    (tmp_path / "scene/gaussian_model.py").rename(package / "model.py")
    (tmp_path / "gaussian_renderer/__init__.py").rename(package / "draw.py")
    (tmp_path / "gaussian_renderer").rmdir()
    (package / "unused.py").write_text(RENDER.replace("pc.get_xyz", "pc.other(t)"))
    script = tmp_path / "train.py"
    trains = script.read_text().replace("from gaussian_renderer", "from splats.parts.draw")
    script.unlink()
    (tmp_path / f"{name}.py").write_text(f"import splats.parts.model\n{trains}")
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == kind
    assert reason in verdict.reason


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        ("image = a + b * 0.5", "adds several pictures, a + b * 0.5"),
        ("loss = l1(a, photograph) + l1(b, photograph)", None),
        ("image = a + background", None),
        ("a.permute(1, 2, 0)[mirror] = photograph[mirror]", None),
        ("picture = a.clone()\n    picture[mirror] = a[mirror]", None),
        (
            "picture = a.permute(1, 2, 0)\n    picture[mirror] = b[mirror]",
            "puts a picture into another, picture[mirror] = b[mirror]",
        ),
    ],
)
def test_a_picture_of_several_models_is_not_that_of_one_ply(fork, made, reason):
    drawn = 'a, b = render(view, one)["render"], render(view, other)["render"]'
    train = f"\ndef train():\n    {drawn}\n    {made}\n\n\ndef report("
    reasons = read_plain(fork(("\ndef report(", train))).reasons
    assert (reason in reasons[0]) if reason else not reasons


def test_the_drawing_that_a_training_script_names_decides(fork):
    drawn = RENDER.replace("def render(", "def render_all(").replace("pc.get_xyz", "pc.net(t)")
    both = (RENDER, RENDER + drawn)
    assert read_plain(fork(both))
    reasons = read_plain(fork(both, ("import render\n", "import render_all\n"))).reasons
    assert "render_all makes means3D from pc.net" in reasons[0]


def test_the_drawing_that_returns_a_picture_decides(fork, tmp_path):
    renamed = RENDER.replace("def render(", "def splat(")
    counts = renamed.replace("splat", "count").replace('{"render": image}', "radii")
    repo = fork((RENDER, counts.replace("pc.get_xyz", "pc.net(t)") + renamed))
    assert read_plain(repo)


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("train.py", RENDER.replace("pc.get_xyz", "pc.net(t)"), NO_MODEL),  # it draws by itself
        (
            "scene/__init__.py",
            "class S:\n    def save_ply(self): self.model.save_ply()\n",
            NO_MODEL,
        ),
        (
            "scene/gaussian_model.py",
            "<<<<<<< HEAD\n",
            "its scene/gaussian_model.py is no valid Python",
        ),
    ],
)
def test_without_a_model_nothing_is_read(tmp_path, file, text, reason):
    (tmp_path / "scene").mkdir()
    (tmp_path / file).write_text(text)
    assert judged(HostRepo(tmp_path)).reason == reason


def test_of_several_folders_one_with_a_plain_ply_decides(fork, tmp_path):
    fork((".repeat(1, 3)", ".repeat(1, 2)"), root=tmp_path / "a_flat")
    assert judged(HostRepo(tmp_path)).reason.startswith("a_flat/: its Gaussians are flat")
    fork(root=tmp_path / "b_plain")
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == "finetune"
    assert "fragprune run" not in verdict.sentence  # which looks beside the script


def test_a_model_in_a_folder_may_be_saved_by_a_script_above(fork, tmp_path):
    fork(("scene.save(", "scene.show("), root=tmp_path / "inner")
    assert judged(HostRepo(tmp_path)).reason == "inner/: none of its scripts saves a PLY"
    (tmp_path / "slam.py").write_text("scene.save(3)\n")
    verdict = judged(HostRepo(tmp_path))
    assert (verdict.kind, verdict.reason) == ("finetune", NOT_FOUND)  # what trains it is not read


@pytest.mark.parametrize("inner", ["", "inner"])
def test_run_is_named_where_it_would_train(fork, tmp_path, inner):
    """``unserved`` takes what the codebase itself saves, not what a folder of it does."""
    fork(root=tmp_path / inner)
    (tmp_path / "train.py").write_text("scene.save(3)\n")
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == "finetune"
    named = "fragprune run in front of its training command" in verdict.sentence
    assert named == bool(unserved([str(tmp_path / "train.py")])) == (not inner)


@pytest.mark.parametrize(
    ("given", "kind"),
    [
        ("dx=None", "finetune"),
        ("dx=opt.random_background", "finetune"),
        ("opt=opt", "finetune"),
        ("dx=dx", "never"),
        ("False, None, dx", "never"),
    ],
)
@pytest.mark.parametrize("inner", ["", "inner"])
@pytest.mark.parametrize(
    "change",
    [
        ("    means3D = pc.get_xyz\n", MOVES),
        ("    means3D = pc.get_xyz\n", MOVES.replace("+ dx", "+ pc.get_dx")),
        ("        shs = pc.get_features\n", COLOURS),
    ],
)
def test_an_argument_that_moves_or_colours_them_is_off_if_no_file_gives_it(
    fork, tmp_path, change, inner, given, kind
):
    fork(
        ("override_color=None):", "override_color=None, dx=None, opt=None):"),
        change,
        root=tmp_path / inner,
    )
    (tmp_path / "slam.py").write_text(f"package = render(camera, model, pipe, bg, {given})\n")
    assert judged(HostRepo(tmp_path)).kind == kind


def test_a_model_beside_the_codebase_that_draws_does_not_count(fork, tmp_path):
    fork(root=tmp_path / "inner")
    fork(("return self._xyz", "return self.net()"))
    renderer = tmp_path / "gaussian_renderer/__init__.py"
    assert judged(HostRepo(tmp_path)).kind == "never"
    renderer.unlink()
    renderer.parent.rmdir()
    assert judged(HostRepo(tmp_path)).kind == "finetune"


def test_a_script_that_trains_another_model_fits_nothing(tmp_path):
    skeleton(tmp_path)
    script = tmp_path / "train.py"
    text = script.read_text()
    steps = "model = GaussianModel(3)\nmodel.update_learning_rate(1)\n"
    script.write_text(f"{text}\n{steps}model = DeformModel(3)\n")
    assert judged(HostRepo(tmp_path)).kind == "fits"
    for other in "MeshModel", "GaussianModelDyn":
        script.write_text(f"{text}\nfrom mesh import {other}\nmodel = {other}(3)\n")
        assert judged(HostRepo(tmp_path)).kind == "never"


def test_a_ply_of_a_model_that_was_not_read_is_not_plain(fork):
    trains = "\nfrom mesh import MeshModel\nmodel = MeshModel(3)\n\ndef report("
    found = "its PLY was not read: train.py trains MeshModel, not GaussianModel"
    assert judged(fork(("\ndef report(", trains))).reason == found


def test_a_model_that_is_not_in_the_checkout_is_looked_for_in_its_submodules(tmp_path):
    (tmp_path / ".gitmodules").write_text('[submodule "a"]\n\tpath = submodules/a\n')
    assert judged(HostRepo(tmp_path)).reason.endswith("not in the checkout: submodules/a")
    (tmp_path / "scene").mkdir()
    model = "class GaussianModel:\n    def __init__(self, sh_degree): ...\n"
    (tmp_path / "scene/gaussian_model.py").write_text(model)
    assert "GaussianModel has no save_ply" in judged(HostRepo(tmp_path)).reason
    (tmp_path / "gaussian_renderer.py").write_text(RENDER.replace("pc.get_xyz", "pc.net(t)"))
    assert "means3D from pc.net" in judged(HostRepo(tmp_path)).reason


def test_a_model_in_another_module_is_named(fork, tmp_path):
    fork()
    scene = tmp_path / "scene"
    (scene / "gaussian_model.py").rename(scene / "gaussian_model_other.py")
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == "finetune"
    assert "GaussianModel is in scene.gaussian_model_other" in verdict.differs


@pytest.mark.parametrize("folder", ["inner", "a/b/inner"])
def test_a_folder_that_fits_is_named_at_the_root(tmp_path, folder):
    skeleton(tmp_path / folder)
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == "inside"
    assert verdict.inside == ((folder, "vanilla-3dgs"),)
    assert f"fragprune check {tmp_path / folder}" in verdict.sentence


def test_a_folder_that_fits_is_named_beside_one_that_a_script_above_trains(fork, tmp_path):
    fork(root=tmp_path / "inner")
    skeleton(tmp_path / "other")
    modules = "inner.gaussian_renderer, inner.scene.gaussian_model"
    (tmp_path / "train.py").write_text(f"import {modules}\nscene.save(3)\n")
    assert judged(HostRepo(tmp_path)).inside == (("other", "vanilla-3dgs"),)


def test_a_picture_cut_out_of_further_channels_is_not_the_plys(fork):
    cut = (CALLED, f"{CALLED}    image, depth = out.split([3, 1], dim=0)\n")
    verdict = judged(fork(("image, radii, depth, used =", "out, radii ="), cut))
    assert verdict.kind == "never"
    assert "cut out of a tensor with further channels" in verdict.reason


def test_another_model_that_a_script_trains_counts_if_it_stores_something_else(fork, tmp_path):
    repo = fork()
    text = (tmp_path / "scene/gaussian_model.py").read_text()
    folded = text.replace("class GaussianModel", "class Folded").replace(
        "= self._scaling.detach()", "= (self._scaling * self.get_shape).detach()"
    )
    (tmp_path / "scene/folded_model.py").write_text(folded)
    assert read_plain(repo)
    (tmp_path / "train_folded.py").write_text("from scene import Folded\n")
    assert "Folded, which a script here trains: save_ply stores other numbers" in str(
        read_plain(HostRepo(tmp_path)).reasons
    )
    script = tmp_path / "train.py"
    script.write_text("from scene import GaussianModel\n" + script.read_text())
    assert read_plain(HostRepo(tmp_path))  # that script trains the plain model alone


def test_another_kernel_makes_another_picture_of_the_same_ply(fork, tmp_path):
    fork()
    project = tmp_path / "submodules/a"
    (project / "diff_gaussian_rasterization").mkdir(parents=True)
    (project / "diff_gaussian_rasterization/__init__.py").write_text("")
    (project / "forward.cu").write_text("float alpha = min(0.99f, o * area(d));")
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == "never"
    assert "no exp()" in verdict.reason


def test_a_script_that_compiles_its_training_fits_nothing(tmp_path):
    skeleton(tmp_path)
    script = tmp_path / "train.py"
    step = "\n\nimport torch\n%sdef step(loss):\n    loss.backward()\n"
    text = script.read_text()
    script.write_text(text + step % "")
    assert judged(HostRepo(tmp_path)).kind == "fits"
    script.write_text(text + step % "@torch.compile\n")
    verdict = judged(HostRepo(tmp_path))
    assert verdict.kind == "never"
    assert "train.py compiles step, which trains" in str(verdict.differs)
