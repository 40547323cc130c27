"""A fork is served if reading shows that its model is plain, and refused by name if not."""

from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import pytest
from core.test_verdict import judged
from miniatures.forks import RENDER, fork
from miniatures.runs import edit

from fragprune_3dgs_fork import ForkAdapter, Unread
from fragprune_3dgs_fork.read import read_fork
from fragprune_graphdeco import plain
from fragprune_plugins.adapting import EngineError, HostCall, NotComparedError, Role, UsageError
from fragprune_plugins.hosts.choosing import choose
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.plugins.loading import load_plugins


def errors(repo):
    return [str(each) for each in ForkAdapter().match(repo).findings if each.level == "error"]


def warnings(repo):
    return [each.found for each in ForkAdapter().match(repo).findings if each.level == "warning"]


def why(root, *changes, files=(), **given):
    """Why a fork is refused, "" if it is served; texts of these files are added to its own."""
    fork(root, *changes, **given)
    for name, text in dict(files).items():
        (root / name).parent.mkdir(exist_ok=True)
        with (root / name).open("a") as file:
            file.write(text)
    return "; ".join(errors(HostRepo(root)))


def takes(repo, *words, stage="auto"):
    """Whether a command may be run, as far as its words and the stage say; else it raises."""
    ForkAdapter().refuse(repo, [*words], stage=stage, device="cuda")
    return True


def refuses(repo, *words, says, stage="auto"):
    with pytest.raises(UsageError, match=says):
        takes(repo, *words, stage=stage)


PACKAGE, RENDERER = "diff_gaussian_rasterization", "gaussian_renderer/__init__.py"
LOOP, PARSES = "    for iteration in range(opt.iterations):\n", "\ndef read_flags"
DEPTH = "D += depths[collected_id[j]] * alpha * T; out_depth[pix_id] = D;"
WEIGHT = "weight += alpha * T; out_alpha[pix_id] = weight;"
INVERSE = "E += (1 / depths[collected_id[j]]) * alpha * T; out_invdepth[pix_id] = E;"
OBJECTS = """
O[ch] += obj_features[collected_id[j] * OBJECTS + ch] * alpha * T;
out_objects[ch * H * W + pix_id] = O[ch];
"""


def reading(root, value, *changes, **given):
    """A fork whose loss also reads what its rasterizer returns third, by its name."""
    used = ('package["render"]', f'package["render"] + package["{value}"]')
    return fork(root, used, *changes, **{"values": f"image, radii, {value}"} | given)


def third(root, value, backward="", **given):
    """What is known of that value, or the error; ``backward`` is the rasterizer's backward pass."""
    repo = reading(root, value, **given)
    if backward:
        (root / "submodules/a/backward.cu").write_text(backward)
    found = errors(repo)
    return found[0] if found else read_fork(repo).outputs[PACKAGE][2]


PLAIN = {
    "an extra group": {},
    "another script": {"script": "train_scene.py"},
    "a script that no module may be": {"script": "train-scene.py"},
    "another package": {"package": "a_rasterizer"},
    "a value that nobody reads": {"values": "image, radii, touched"},
    "a value without a name": {"values": "image, radii, _"},
    "confidence": {"settings": ", confidence=pc.confidence"},
    "a script that only its text tells": {"script": "optimize.py"},
    "a camera that is trained": {
        "settings": ", projmatrix_raw=viewpoint_camera.projection_matrix",
        "arguments": ", theta=viewpoint_camera.turned, rho=viewpoint_camera.moved",
    },
}


@pytest.mark.parametrize("what", PLAIN)
def test_a_plain_fork_fits_and_is_to_be_proved(tmp_path, what):
    repo = fork(tmp_path, **PLAIN[what])
    assert errors(repo) == []
    assert choose(repo, load_plugins().adapters).name == "3dgs-fork"
    verdict = judged(repo)
    assert verdict.kind == "fits"
    assert "Not proved" in verdict.sentence


MEANINGS = {"depth": DEPTH, "alpha": WEIGHT, "invdepth": INVERSE}


@pytest.mark.parametrize("value", MEANINGS)
def test_a_value_that_is_read_needs_a_kernel_that_tells_what_it_is(tmp_path, value):
    assert third(tmp_path / "known", value, kernel=MEANINGS[value]).role == value
    assert third(tmp_path / "absent", value).role == "unproved"
    warned = warnings(HostRepo(tmp_path / "absent"))
    assert any(each.startswith(f"what {PACKAGE} returns as {value}") for each in warned)
    scaled = MEANINGS[value].replace("] = ", "] = 2 * ")
    assert "whose meaning is unknown" in third(tmp_path / "scaled", value, kernel=scaled)
    of_count = third(tmp_path / "counted", "accum_count", kernel=MEANINGS[value])
    assert "whose meaning is unknown" in of_count


W, Z = "float w = alpha * T;", "const float z = depths[collected_id[j]];"
STORED = "{} D += {}; out_depth[pix_id] = D;"
SAME = {
    "by other names": ("depth", STORED.format(W + Z, "w * z; a.w = 1")),
    "half by another name": ("depth", STORED.format(Z, "z * alpha * T")),
    "by a name of two values": (None, STORED.format(W + Z + "float w = alpha;", "w * z")),
    "by a name that changes": (None, STORED.format(W + Z + "w *= 2;", "w * z")),
    "in the buffer of the newer rasterizer": ("invdepth", INVERSE.replace("out_inv", "inv")),
    "beside another depth": ("depth", DEPTH + "out_median_depth[pix_id] = M;"),
    "over the weight": ("unproved", DEPTH.replace("= D", "= D / A") + "A += alpha * T;"),
    "over something else": (None, DEPTH.replace("= D", "= D / B") + "A += alpha * T;"),
    "what light is left": ("alpha", "T = test_T; out_alpha[pix_id] = 1 - T;"),
    "what light another left": (None, "T = test_T * x; out_alpha[pix_id] = 1 - T;"),
}


@pytest.mark.parametrize("what", SAME)
def test_a_sum_is_known_in_any_spelling(tmp_path, what):
    role, kernel = SAME[what]
    name = "rendered_alpha" if "out_alpha" in kernel else "rendered_depth"
    value = third(tmp_path, name, kernel=kernel)
    assert value.role == role if role else "whose meaning is unknown" in value


def test_gaussians_in_another_order_are_another_picture_of_a_plain_ply(tmp_path):
    assert errors(fork(tmp_path / "z", kernel="depths[idx] = p_view.z;")) == []
    repo = fork(tmp_path / "distance", kernel="depths[idx] = sqrt(norm(p_view));")
    assert "Gaussians sorted by sqrt(norm(p_view))" in errors(repo)[0]
    assert judged(repo).kind == "finetune"


def test_gaussians_are_drawn_from_the_distance_on_that_its_kernel_says(tmp_path):
    def drawn_from(near, *more):
        repo = fork(tmp_path / near, kernel="".join(more) or " ")
        source = tmp_path / near / "submodules/a/forward.cu"
        source.write_text(source.read_text().replace("z <= 0.2f", f"z <= {near}f"))
        return repo

    assert errors(drawn_from("0.001")) == errors(drawn_from("0.2")) == []
    assert ForkAdapter().drawing(HostRepo(tmp_path / "0.001"), []) == {"near": 0.001}
    assert ForkAdapter().drawing(HostRepo(tmp_path / "0.2"), []) == {}
    several = drawn_from("0.01", "if (p_view.z <= 0.3f) return;")
    assert "Gaussians nearer than 0.01" in "; ".join(errors(several))
    assert judged(several).kind == "finetune"


BACK = "        loss.backward()\n"
ONE_PASS = {
    "branches": (BACK, f"        if opt.smooth:\n    {BACK}        else:\n    {BACK}"),
    "another training instead": (
        PARSES,
        "\ndef refine(opt):\n    loss.backward()\n\n"
        f"if opt.refined:\n    refine(opt)\nelse:\n    training(opt, 0)\n{PARSES}",
    ),
}


@pytest.mark.parametrize("what", ONE_PASS)
def test_of_two_ways_back_one_is_taken(tmp_path, what):
    old, new = ONE_PASS[what]
    assert not why(tmp_path / "one", (old, new))
    both = why(tmp_path / "both", (old, new.replace("else:", "if opt.both:")))
    assert "places that go backward" in both


def test_a_value_that_is_only_handed_on_or_named_is_not_read(tmp_path):
    handed = ('"touched": touched', '"touched": touched.detach()')
    named = ("        loss =", '        touched, more = package["touched"], 0\n        loss =')
    repo = fork(tmp_path / "handed", handed, named, values="image, radii, touched")
    assert errors(repo) == []
    (value,) = (each.name for each in read_fork(repo).outputs[PACKAGE] if each.role == "unread")
    assert Unread(value).detach().squeeze(0).unread
    read = (named[0], named[1].replace("        loss =", "        print(touched)\n        loss ="))
    found = why(tmp_path / "read", handed, read, values="image, radii, touched")
    assert "touched, read in train.py" in found


def test_a_value_that_only_an_option_reads_is_not_read_without_it(tmp_path):
    reads = '        if opt.sparse and iteration > 100:\n            loss += package["touched"]\n'
    on, off = (
        (PARSES, f"\nparser.add_argument('--sparse'{default})\n{PARSES}")
        for default in (", default=True", "")
    )
    repo = fork(tmp_path / "off", off, (BACK, reads + BACK), values="image, radii, touched")
    assert errors(repo) == []
    refuses(repo, "--sparse", says="--sparse")
    found = why(tmp_path / "on", on, (BACK, reads + BACK), values="image, radii, touched")
    assert "touched, read in train.py" in found


def test_a_drawing_function_that_is_only_imported_may_draw_others(tmp_path):
    other = RENDER.format(package=PACKAGE, settings="bg=0", values="a, b", arguments="", keys="")
    other = other.split("\n\n\n")[1].replace("def render(", "def shadow(")
    other = other.replace("opacities=pc.get_opacity", "opacities=pc.net(1)")
    named, files = ("import render\n", "import render, shadow\n"), {RENDERER: f"\n\n{other}"}
    assert not why(tmp_path / "imported", named, files=files)
    files["train.py"] = "\nshadow(view, gaussians, pipe, background)\n"
    assert "makes opacities from pc.net" in why(tmp_path / "called", named, files=files)


@pytest.mark.parametrize("name", ["sh_objs", "semantics"])
def test_blended_channels_are_known_by_argument_and_kernel(tmp_path, name):
    def found(case, value, kernel=OBJECTS, given="pc.get_objects", changes=(), **more):
        more |= {"arguments": f", {name}={given}", "kernel": kernel}
        return errors(reading(tmp_path / case, value, *changes, **more))

    assert found("known", "objects") == []
    assert read_fork(HostRepo(tmp_path / "known")).blended == {PACKAGE: name}
    assert found("unknown", "objects", kernel="")
    assert found("alone", "features") == []
    assert found("two", "features", kernel=f"{OBJECTS} out_depth[pix_id] = D;")
    assert found("more", "features", values="image, radii, features, touched")
    assert found("lit", "objects", kernel=OBJECTS.replace("= O[ch]", "= O[ch] + T * bg[ch]"))
    made = "    objects = pc.get_objects if pipe.seen else torch.zeros((1,))\n    rasterizer ="
    (empty, *_) = found("empty", "objects", given="objects", changes=[("    rasterizer =", made)])
    assert "objects, which is empty unless asked for" in empty


RAY = """
renderCUDA(ranges, float(width * 0.5f), float(height * 0.5f), maps, with_maps);
const float2 ray = { (pixf.x - cx) / focal_x, (pixf.y - cy) / focal_y };
"""
MAPS = """
if (with_maps) {
    for (int ch = 0; ch < MAPS; ch++)
        M[ch] += maps[collected_id[j] * MAPS + ch] * alpha * T;
}
"""
PLANE = """
if (with_maps) {
    for (int ch = 0; ch < MAPS; ch++)
        out_maps[ch * H * W + pix_id] = M[ch];
    out_meeting[pix_id] = M[4] / -(M[0] * ray.x + M[1] * ray.y + M[2] + 1.0e-8);
}
"""
PLANES = {
    "as PGSR's": ("", "", ""),
    "a nested block": ("{\n    for", "{ if (near) { }\n    for", "with_maps, unknown"),
    "one nested": ("        M[ch] +=", "        if (near) { } M[ch] +=", "with_maps, unknown"),
    "a block that skips": ("{\n    for", "{ continue;\n    for", "with_maps, unknown"),
    "a block that dims": ("{\n    for", "{ T = 0;\n    for", "with_maps, unknown"),
    "a block that paints": ("{\n    for", "{ out_color[0] = 1;\n    for", "with_maps, unknown"),
    "a choice": ("RAY", "float s = with_maps ? 1 : 2;", "with_maps, unknown"),
    "a block that counts": ("{\n    for", "{ atomicAdd(&hits, 1);\n    for", "with_maps, unknown"),
    "another depth": ("M[2] + ", "M[2] * M[3] + ", "meeting, read in train.py"),
    "another middle": ("width * 0.5f", "width * 0.4f", "meeting, read in train.py"),
    "of another sum": ("M[4] / ", "N[4] / ", "meeting, read in train.py"),
}


@pytest.mark.parametrize("what", PLANES)
def test_channels_and_their_planes_depth_may_be_asked_for_by_a_setting(tmp_path, what):
    old, new, why = PLANES[what]
    filled = "    maps = torch.zeros((9, 5))\n    maps[:, 4] = pc.get_distance\n    rasterizer ="
    repo = reading(
        tmp_path,
        "meeting",
        ("    rasterizer =", filled),
        values="image, radii, out_maps, meeting",
        settings=", with_maps=pipe.maps",
        arguments=", all=maps, means2D_abs=pc.get_xyz",
        kernel=f"RAY{RAY}{MAPS}{PLANE}".replace(old or "RAY", new).replace("RAY", ""),
    )
    if why:
        assert why in errors(repo)[0]
        return
    assert errors(repo) == []
    read = read_fork(repo)
    assert [each.role for each in read.outputs[PACKAGE]] == ["image", "radii", "objects", "plane"]
    assert (read.asking, read.screens) == ({"with_maps"}, {"means2D_abs"})
    assert read.blended == {PACKAGE: "all"}


STEPS = "        gaussians.optimizer.step()\n"
THINS = "            gaussians.thin_out(mask)\n"
START = "\n\ndef training("
SCORES = '\n\ndef scores():\n    return render(view, gaussians, pipe, background)["hits"]\n'
EARLY = {
    "in the branch": [(THINS, f'            mask = package["hits"] > 0\n{THINS}')],
    "in a function": [(START, SCORES + START), (THINS, f"            mask = scores()\n{THINS}")],
    "by a name": [
        ("        loss.back", '        hits, loss = package["hits"], loss\n        loss.back'),
        (THINS, f"            mask = hits > 0\n{THINS}"),
    ],
    "without a checkpoint": [
        (LOOP, f'    else:\n        seen = render(view, gaussians, pipe, bg)["hits"] > 0\n{LOOP}'),
        (LOOP, f"        print(seen)\n{LOOP}"),
    ],
}
READ = {"in a function": "scores()", "by a name": "print(hits)"}


@pytest.mark.parametrize("where", EARLY)
def test_a_value_by_which_a_host_densifies_is_not_read_in_stage_2(tmp_path, where):
    repo = fork(tmp_path / "early", *EARLY[where], values="image, radii, hits", kernel=";")
    assert errors(repo) == []
    found = "hits, by which it densifies and which only its own rasterizer gives"
    assert found in warnings(repo)
    assert read_fork(repo).outputs[PACKAGE][2].role == "unread"
    use = READ.get(where, 'print(package["hits"])')
    later = (STEPS, f"        {use}\n{STEPS}")
    read = why(tmp_path / "later", *EARLY[where], later, values="image, radii, hits", kernel=";")
    assert "hits, read in train.py" in read


PULL = "dL_dalpha += ({} - accum_{}[ch]) * dL_{};"
COLOURS, OTHERS = PULL.format("c", "rec", "dchannel"), PULL.format("f", "rec_F", "dF")
OF_DEPTH = "dL_dalpha += (z - accum_depth) * dL_ddepth;"
BACKWARD = {
    "both": ("objects", COLOURS + OTHERS, False),
    "colours": ("objects", f"{COLOURS}// {OTHERS}", True),
    "neither": ("objects", "dL_dalpha += all;", None),
    "a depth": ("depth", COLOURS + OF_DEPTH, False),
    "no depth": ("depth", COLOURS, True),
}


@pytest.mark.parametrize("what", BACKWARD)
def test_the_backward_pass_says_whether_values_move_gaussians(tmp_path, what):
    name, backward, detached = BACKWARD[what]
    of_objects = {"arguments": ", sh_objs=pc.get_objects", "kernel": OBJECTS}
    value = third(tmp_path, name, backward, **{"depth": {"kernel": DEPTH}}.get(name, of_objects))
    if detached is None:
        assert "objects, read in train.py" in value
    else:
        assert (value.role, value.detached) == (name, detached)


DRAWN = "if (test_T < 0.0001f) { done = true; continue; }"
SUM = "{drawn} C[ch] += c * alpha * T; {before} T = test_T; {behind}"
ADDED = "atomicAdd(&(hits[collected_id[j]]), {});"
MADE = "torch::Tensor hits = torch::zeros({{P{}}}, means3D.options(){});"
SUMS = {
    "fragments": (("", ADDED.format("1.0f"), MADE.format(", 1", "")), ("count", True, False)),
    "as integers": (
        ("", ADDED.format("1"), MADE.format("", ".dtype(torch::kInt32)")),
        ("count", False, True),
    ),
    "weights": ((ADDED.format("alpha * T"), "", MADE.format("", "")), ("weight", False, False)),
    "weights of the next": ((("", ADDED.format("alpha * T"), "")), None),
    "of some": (("", f"if (T > 0.5f) {{ {ADDED.format('1')} }}", ""), None),
    "of others": (("", ADDED.format("2"), ""), None),
    "twice": ((ADDED.format("1"), ADDED.format("1"), ""), None),
}


@pytest.mark.parametrize("what", SUMS)
def test_a_sum_for_each_gaussian_is_known_by_its_kernel(tmp_path, what):
    (before, behind, made), expected = SUMS[what]
    kernel = SUM.format(drawn=DRAWN, before=before, behind=behind) + made
    value = third(tmp_path, "hits", kernel=kernel)
    if expected is None:
        assert "hits, read in train.py" in value
    else:
        assert (value.role, value.column, value.integer) == expected


OFF = {
    "None": (", mult=None", []),
    "False": (", mult=False", []),
    "a parameter": (", mult=mult", [("chosen=None", "chosen=None, mult=None")]),
    "an option": (", mult=pipe.mult", []),
    "of the rasterizer itself": ("", [("settings=s)", "settings=s, mult=pipe.mult)")]),
}
OPTIONS = """
class PipelineParams:
    def __init__(self):
        self.mult = False
        self.iterations = 9
"""


@pytest.mark.parametrize("what", OFF)
def test_a_setting_that_is_off_is_served_as_long_as_it_is_off(tmp_path, what):
    settings, changes = OFF[what]
    repo = fork(tmp_path, *changes, settings=settings)
    (tmp_path / "arguments/__init__.py").write_text(OPTIONS)
    assert errors(repo) == []
    dialect = ForkAdapter().dialect(repo)
    assert dialect.fork.off == {"mult"}
    with pytest.raises(EngineError, match="None or False"):
        dialect.expect_off(HostCall(SimpleNamespace(mult=0.5), {}))
    dialect.expect_off(HostCall(SimpleNamespace(mult=None), {}))


BINDING = """
class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means3D, means2D, opacities, raster_settings):
        return _C.rasterize(means3D, opacities, {forward})

    @staticmethod
    def backward(ctx, *grads):
        grad2, grad1, grad3, z = _C.rasterize_gaussians_backward(*ctx.saved)
        factor = torch.minimum(z, raster_settings.reach)
        scaled = {backward} * factor
        grads = (grad1, {means2D}, {opacities}, None)
        return grads
"""
GRADIENTS = {
    "on the screen": ({"means2D": "scaled"}, True),
    "of opacities": ({"opacities": "scaled"}, False),
    "and the picture": ({"forward": "raster_settings.reach"}, False),
}


@pytest.mark.parametrize("what", GRADIENTS)
def test_a_setting_of_the_backward_pass_is_served_after_densification(tmp_path, what):
    given, fits = GRADIENTS[what]
    plain = {"forward": "0", "backward": "grad2", "means2D": "grad2", "opacities": "grad3"}
    binding = BINDING.format_map(plain | given)
    repo = fork(tmp_path, settings=", reach=opt.reach", kernel=";", binding=binding)
    if not fits:
        assert "reach, unknown" in errors(repo)[0]
        return
    assert errors(repo) == []
    assert "the gradient on the screen, which reach changes" in str(warnings(repo))
    assert takes(repo)
    refuses(repo, says="joint", stage="joint")


POSED = """

def render_posed(viewpoint_camera, pc, pipe, bg_color):
    s = GaussianRasterizationSettings(theta=viewpoint_camera.theta)
    rasterizer = GaussianRasterizer(raster_settings=s)
    image, radii, touched = rasterizer(means3D=pc.get_xyz)
    return {"render": image, "radii": radii}
"""
CHOICE = """
    if args.posed:
        from gaussian_renderer import render_posed as render
    for iteration in"""


@pytest.mark.parametrize("switch", [True, False])
def test_a_drawing_function_for_an_option_that_is_off_is_not_reached(tmp_path, switch):
    flag = 'parser.add_argument("--posed", ' + ('action="store_true")' if switch else "default=1)")
    repo = fork(
        tmp_path,
        ('"radii": radii}', '"radii": radii}' + POSED),
        ("\n    for iteration in", CHOICE),
        ("    for name in ", f"    {flag}\n    for name in "),
    )
    if not switch:
        assert "theta, unknown" in errors(repo)[0]
        return
    assert errors(repo) == []
    assert takes(repo, "--eval")
    for word in ("--posed", "--posed=1"):
        refuses(repo, word, says="other draws")


def test_an_option_under_which_a_drawing_function_draws_more_gaussians_is_refused(tmp_path):
    grows = "    if grown:\n        means3D = torch.cat((means3D, pc.get_children))\n    shs ="
    flag = 'parser.add_argument("--{}", action="store_true")\n    '
    repo = fork(
        tmp_path,
        ("chosen=None):", "chosen=None, grown=False, told=False):"),
        ("    shs =", grows),
        ("pipe, background)", "pipe, background, grown=opt.grown, told=opt.told)"),
        ("    for name in ", f"    {flag.format('grown')}{flag.format('told')}for name in "),
    )
    assert errors(repo) == []
    assert takes(repo, "--told")
    refuses(repo, "--grown", says="other draws")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("loss.backward()", "loss.backward() + more.backward()", "2 places"),
        ("scene.save(iteration)", "show(iteration)", "it saves no PLY"),
    ],
)
def test_of_several_scripts_those_are_served_that_can_be(tmp_path, old, new, says):
    fork(tmp_path, script="training/train.py")
    text = (tmp_path / "training/train.py").read_text()
    other = text.replace(old, new)
    (tmp_path / "training/train_more.py").write_text(other)
    repo = HostRepo(tmp_path)
    assert errors(repo) == []
    scripts = [tmp_path / each for each in ForkAdapter().command_line(repo).scripts]
    assert [each.name for each in scripts] == ["train.py", "train_more.py"]
    assert ForkAdapter().trainer(repo, scripts[0])
    with pytest.raises(UsageError, match=says):
        ForkAdapter().trainer(repo, scripts[1])
    assert warnings(repo)[0].startswith(f"training/train_more.py, which is not served: {says}")


def test_a_script_of_another_model_is_named_and_not_served(tmp_path):
    repo = fork(tmp_path)
    other = (tmp_path / "train.py").read_text().replace("GaussianModel(", "GaussianModelOfTime(")
    (tmp_path / "train_time.py").write_text(other)
    assert errors(repo) == []
    assert read_fork(repo).unserved == {"train_time.py": "makes GaussianModelOfTime"}
    with pytest.raises(UsageError, match="train_time"):
        ForkAdapter().trainer(repo, tmp_path / "train_time.py")


def test_the_camera_is_found_by_its_name(tmp_path):
    changes = [("def render(viewpoint_camera", "def render(iteration, viewpoint_camera")]
    repo = fork(tmp_path, *changes, ("render(view,", "render(iteration, view,"))
    assert errors(repo) == []
    (view,) = [each for each in ForkAdapter().seams_for(repo) if each.role is Role.VIEW]
    assert view.needs == ("viewpoint_camera", "pc")


def test_checkpoints_have_other_names_too(tmp_path):
    assert errors(fork(tmp_path, ("chkpnt", "ckpt"))) == []
    for name in ("ckpt7.pth", "chkpnt9.pth", "cls8.pth"):
        (tmp_path / name).touch()
    assert {number for number, _ in ForkAdapter().saved_iterations(tmp_path)} == {7, 9}


GETTER = "        if self._new is not None:\n            return self._new\n{}"
SETS = "    def warp(self):\n        self._new = self.net()\n\n    def capture"


@pytest.mark.parametrize(("called", "first"), [(False, None), (True, None), (False, False)])
@pytest.mark.parametrize("value", ["self._xyz", "self.opacity_activation(self._opacity)"])
def test_values_may_be_others_where_no_script_sets_them(tmp_path, value, called, first):
    returned = f"        return {value}\n"
    repo = fork(
        tmp_path,
        (returned, GETTER.format(returned)),
        ("sh_degree): ...", f"sh_degree):\n        self._new = {first}"),
        ("    def capture", SETS),
        (STATEMENT, "gaussians.warp()" if called else STATEMENT),
    )
    assert ("computed" in str(errors(repo))) == (called or first is not None)


@pytest.mark.parametrize(("before", "model"), [("    rasterizer = ", "pc"), (LOOP, "gaussians")])
def test_values_are_others_where_something_beside_the_model_sets_them(tmp_path, before, model):
    returned = "        return self._xyz\n"
    changes = [
        (returned, GETTER.format(returned)),
        ("sh_degree): ...", "sh_degree):\n        self._new = None"),
    ]
    assert not why(tmp_path / "unset", *changes)
    made = (before, f"    {model}._new = made\n{before}")
    assert "computed" in why(tmp_path / "set", *changes, made)


SETUP = "gaussians.training_setup(opt)\n"
ADAM = "    optim = torch.optim.Adam(net.parameters())\n"
NOT_RESUMED = {
    "no restore": ("gaussians.restore(", "gaussians.load("),
    "no capture": ("def capture(", "def other("),
    "another name": ("chkpnt", "state"),
    "more in its name": ("chkpnt{iteration}", "chkpnt{iteration}_of_{views}"),
    "a count that begins anew": (
        "gaussians.restore(torch.load(checkpoint), opt)",
        "state, at = torch.load(checkpoint)\n        gaussians.restore(state)\n        at = 0",
    ),
    "a lost parameter": ("self.ground)", "self.masks)"),
    "more than is taken back": (
        "training_setup(training_args)\n\n    def construct",
        "training_setup(training_args)\n        self._xyz, rest = model_args\n\n    def construct",
    ),
    "a set": (
        "(self._xyz, self._scaling, *values, self.optimizer.state_dict(), self.ground)",
        "{self._xyz, self._scaling, *values, self.optimizer.state_dict(), self.ground}",
    ),
    "a dict": ("((gaussians.capture(), iteration)", '({"model": gaussians.capture(), "at": 1}'),
    "a removed folder": ("scene = Scene(", "shutil.rmtree(opt.model_path); scene = Scene("),
    "a lost state": ("self.optimizer.state_dict()", "None"),
    "a network beside": (SETUP, SETUP + ADAM),
    "a network of other weights": (SETUP, f"{SETUP}    net.load_state_dict(weights)\n{ADAM}"),
    "a call that fails": ("setup(training_args)", "setup(training_args, 1)"),
    "a lost network": ('"params": [self.ground]', '"params": self.net.parameters()'),
    "a whole network": ('"params": [self.ground]', '"params": self.ground.parameters()'),
    "an import in its first iterations": (
        "\n        loss.backward()",
        "\n        if iteration < 4:\n            import cv2\n        loss.backward()"
        "\n        cv2.imwrite(name, image)",
    ),
    "a view of its first iterations": (
        "\n        loss.backward()",
        "\n        if iteration > 1:\n            if iteration > 1 and iteration <= 4:"
        "\n                other = views[0]\n            elif iteration <= 9:"
        "\n                other = views[1]\n            print(other)\n        loss.backward()",
    ),
    "several models": ("gaussians = ", "other = GaussianModel(3)\n    gaussians = "),
    "as many as asked for": (
        "    gaussians = GaussianModel(3)\n",
        "    for k in range(opt.models):\n        models[k] = GaussianModel(3)\n",
    ),
    "pictures of sizes that change": (
        ("chosen=None", "chosen=None, size=None"),
        ("image_height=0", "image_height=size[0] if size else 0"),
        ("pipe, background)", "pipe, background, size=photograph.shape[1:])"),
    ),
}


@pytest.mark.parametrize("what", NOT_RESUMED)
def test_stage_two_follows_in_one_run_where_a_script_cannot_resume(tmp_path, what):
    saves = ("--start_checkpoint", "--save_iterations")
    changes = NOT_RESUMED[what]
    several = (changes,) if isinstance(changes[0], str) else changes
    repo, adapter = fork(tmp_path, *several, saves), ForkAdapter()
    assert errors(repo) == []
    line = adapter.command_line(repo)
    assert line.one_run
    assert not line.resume
    assert not {Role.CAPTURE, Role.RESTORE} & {each.role for each in adapter.seams_for(repo)}
    longer = adapter.lengthened(["--save_iterations", "5", "7"], 7, 9)
    assert longer[3:] == ["--iterations", "9", "--save_iterations", "5", "7", "9"]


def test_a_script_that_can_resume_does(tmp_path):
    early = "\n        if iteration < 4:\n            import cv2\n            cv2.imwrite(n, image)"
    both = f"{early}\n        import cv2\n        loss.backward()\n        cv2.imwrite(name, image)"
    assert not ForkAdapter().command_line(fork(tmp_path)).one_run
    for inside in (f"{early}\n        loss.backward()", both):
        repo = fork(tmp_path, ("\n        loss.backward()", inside))
        assert not ForkAdapter().command_line(repo).one_run


OVERRULES = {
    "a folder of its own": ("args.source_path = '/data/mine'", False),
    "a folder by a name of its own": ("args.model_path = os.path.join('out', now())", False),
    "the same, whole": ("args.source_path = os.path.abspath(args.source_path)", True),
    "a folder of its own where Python debugs": (
        "if __debug__:\n        args.source_path = '/data/mine'",
        False,
    ),
    "another option": ("args.images = 'images_4'", True),
    "the length": ("args.iterations = 7000", False),
    "more to save": ("args.checkpoint_iterations = args.checkpoint_iterations + [7]", True),
    "options of a file, one by one": (
        "for key, value in read(args).items():\n        setattr(args, key, value)",
        False,
    ),
    "those of a file before the command's": ("args = merged(args, read(args))", False),
    "options of a file": ("args = overruled(args, read(args.config))", False),
    "options of a file that is named": ("args = asked(args, read)", True),
    "where none is given": ("if not args.model_path:\n        args.model_path = 'out'", True),
}


def overruled(tmp_path, sets):
    rules = "\n\ndef overruled(args, options):\n    setattr(args, *options)\n    return args\n"
    rules += "\n\ndef merged(args, read):\n    return Namespace(**(vars(args) | read))\n"
    rules += "\n\nparser.add_argument('--config', default='')\n\n\ndef asked(args, read):\n"
    rules += "    if args.config:\n        setattr(args, *read(args.config))\n    return args\n"
    main = f"{rules}\nif __name__ == '__main__':\n    {sets}\n{PARSES}"
    return fork(tmp_path, (PARSES, main))


@pytest.mark.parametrize("what", OVERRULES)
def test_a_script_that_overrules_its_command_is_refused(tmp_path, what):
    sets, served = OVERRULES[what]
    found = errors(overruled(tmp_path, sets))
    assert found == [] if served else "whatever its command says" in found[0]


def test_a_command_that_names_a_file_which_overrules_it_is_refused(tmp_path):
    by_merge = "if args.config:\n        args = overruled(args, read(args.config))"
    asked = "\nparser.add_argument('--config', default='')\nearly, _ = parser.parse_known_args()\n"
    asked += "if early.config:\n    parser.set_defaults(**read(early.config))\n"
    by_default = fork(tmp_path / "defaults", (PARSES, asked + PARSES))
    both = enumerate(("args = asked(args, read)", by_merge))
    for repo in (by_default, *(overruled(tmp_path / str(each), sets) for each, sets in both)):
        assert takes(repo, "--iterations", "9")
        refuses(repo, "--config", "a.json", says="--config")


PATIENT = "\n        if {}:\n            break\n        loss.backward()"
PRESET = (
    "\n\ndef preset(args):\n    if not args.patience:\n        return\n    args.iterations = 9\n\n"
)
IMPATIENT = {
    "that it measures": (PATIENT.format("opt.patience and worse > opt.patience"), ""),
    "given by another name": (PATIENT.format("most > 0 and worse > most"), ""),
    "of something made by it": (
        PATIENT.format("stops.now(loss)"),
        "    stops = Stops(opt.patience)\n",
    ),
    "by which another checkpoint is resumed": (
        "\n        loss.backward()",
        "    if most:\n        checkpoint = most\n",
    ),
    "by a length of its own": ("\n        loss.backward()", PRESET),
}


@pytest.mark.parametrize("what", IMPATIENT)
def test_an_option_by_which_a_training_ends_early_is_refused(tmp_path, what):
    ends, before = IMPATIENT[what]
    flags = "\nparser.add_argument('--patience', default=0)\ntraining(opt, None, opt.patience)\n"
    repo = fork(
        tmp_path,
        ("\n        loss.backward()", ends),
        ("(opt, checkpoint):", "(opt, checkpoint, most):"),
        (PARSES, f"{before if before == PRESET else ''}{flags}{PARSES}"),
        (LOOP, f"{'' if before == PRESET else before}{LOOP}"),
    )
    assert errors(repo) == []
    assert takes(repo, "--patience", "0")
    refuses(repo, "--patience", "7", says="--patience")


MOVED = [
    ("pc, pipe, bg_color", "pc, pipe, bg_color, d_xyz, d_scaling"),
    ("pipe, background)", "pipe, background, d_xyz, d_scaling)"),
    ("means3D = pc.get_xyz", "means3D = pc.get_xyz + d_xyz"),
    ("opacities=pc.get_opacity", "opacities=pc.get_opacity, scales=pc.get_scaling + d_scaling"),
    ("gaussians = GaussianModel(3)", "gaussians = GaussianModel(3)\n    deform = DeformModel()"),
    ("gaussians.optimizer.step()", "gaussians.optimizer.step()\n        deform.optimizer.step()"),
    ("from scene import", "from scene.deform_model import DeformModel\nfrom scene import"),
]


def test_gaussians_that_a_network_beside_them_moves_keep_their_rows(tmp_path):
    saves = ("--start_checkpoint", "--save_iterations")
    network = {"scene/deform_model.py": "class DeformModel:\n    def step(self, xyz, t): ...\n"}
    given = {"arguments": ", means2D_densify=pc.points", "files": network}
    assert not why(tmp_path, *MOVED, saves, **given)
    repo = HostRepo(tmp_path)
    assert "deform.optimizer" in str(ForkAdapter().match(repo).findings)
    with pytest.raises(NotComparedError, match="d_xyz"):
        ForkAdapter().drawing(repo, [])


COLOURED = """    if pipe.network:
        colors_precomp = pipe.net(pc)
    shs = pc.get_features
"""


def test_pictures_of_a_network_are_not_compared(tmp_path):
    repo = fork(tmp_path, ("    shs = pc.get_features\n", COLOURED))
    (tmp_path / "arguments/__init__.py").write_text(OPTIONS.replace("mult", "network"))
    assert errors(repo) == []
    assert ForkAdapter().drawing(repo, []) == {}
    with pytest.raises(NotComparedError, match="--network"):
        ForkAdapter().drawing(repo, ["--network"])


@pytest.mark.parametrize(("shown", "compared"), [("", True), ("water * ", False)])
def test_pictures_that_are_not_to_be_like_photographs_are_not_compared(tmp_path, shown, compared):
    loss = f"        loss = ssim({shown}package['render'], camera.original_image)\n"
    repo = fork(tmp_path, (BACK, loss + BACK))
    assert errors(repo) == []
    with nullcontext() if compared else pytest.raises(NotComparedError, match="compares water"):
        ForkAdapter().drawing(repo, [])


KEYS = '    return {"render"'
WHOLE = {
    "unpacked later": "image, radii = whole",
    "in one of two lengths": (
        "if len(whole) == 3:\n        image, radii, more = whole\n"
        "    else:\n        image, radii = whole"
    ),
    "by numbers": "image = whole[0]\n    radii = whole[1]",
}


@pytest.mark.parametrize("how", WHOLE)
def test_a_result_may_be_unpacked_after_the_call(tmp_path, how):
    later = (KEYS, f"    {WHOLE[how]}\n{KEYS}")
    repo = fork(tmp_path, ("image, radii = rasterizer(", "whole = rasterizer("), later)
    assert errors(repo) == []
    (names,) = read_fork(repo).outputs.values()
    assert [each.name for each in names] == ["image", "radii", "more"][: len(names)]
    assert len(names) == (3 if "more" in WHOLE[how] else 2)


STATEMENT = "gaussians.thin_out(mask)"
MORE = ('package["render"]', 'package["render"] + package["more"]')
CLAMPS = "gaussians._opacity.data.clamp_(0)"
OF_SOME = "    a, b = rasterizer(means3D=pc.get_xyz[big], opacities=pc.get_opacity[big], shs=shs)\n"
REFUSED = [
    (*MORE, "reads more of what it drew"),
    ('l1_loss(package["render"]', 'l1_loss(package["radii"]', "learns nothing of its picture"),
    ("pipe, background)", "pipe, background, chosen=seen)", "draws a selection"),
    ("=pc.get_opacity", "=getattr(pc, 'faint', 0) or pc.get_opacity", "opacities from pc.faint"),
    ("    if chosen is not None:\n        means3D", "    means3D", "draws a selection"),
    ('"render": image', '"render": image[:3]', "a picture of more channels, image[:3]"),
    ("GaussianModel(3)", "DeformModel(3)", "makes DeformModel"),
    ("gaussians.restore(", "gaussians.load(", "no --save_iterations"),
    ("loss.backward()", "loss.backward(), other.backward()", "2 places that go backward"),
    (LOOP, f"    for scan in scans:\n {LOOP}", "a training in a loop"),
    ("    loss.back", "    for each in losses:\n            each.back", "backward several times"),
    (PARSES, f"\ntraining(opt, 0)\ntraining(opt, 1)\n{PARSES}", "several calls of training"),
    (PARSES, f"\nfor scan in scans:\n    training(opt, 0)\n{PARSES}", "several calls of training"),
    ("step()", "step(pose())", "another optimizer, gaussians.optimizer.step(pose())"),
    ("sh_degree):", "sh_degree, device, rate=1):", "its call of GaussianModel lacks device"),
    ("GaussianModel(3)", "GaussianModel(3, 4)", "GaussianModel gives 2 values of 1, which fails"),
    ("background)", "background, depth=1)", "its call of render gives depth, which fails"),
    ("pipe, background)", "pipe)", "its call of render lacks bg_color, which fails"),
    ("= pc.get_xyz", "= pc.deform(pc.get_anchor, t)", "means3D from pc.deform, pc.get_anchor"),
    ("= pc.get_xyz", "= pc.get_xyz + made(pc)", "means3D from pc, not"),
    (
        KEYS,
        f"    a, b = rasterizer(means3D=means3D, opacities=pc.net(1))\n{KEYS}",
        "makes opacities from pc.net",
    ),
    (KEYS, f"{OF_SOME}{KEYS}", "draws a selection, pc.get_xyz[big]"),
    (LOOP, f"    best = deepcopy(gaussians)\n{LOOP}", "copies its model, deepcopy(gaussians)"),
    (LOOP, f"    ddp = DDP(gaussians)\n{LOOP}", "processes of its own"),
    (LOOP, f"    mp.Process(name=n, target=train).start()\n{LOOP}", "processes of its own"),
    ("from scene", "import jittor\nfrom scene", "train.py trains by jittor"),
    ("gaussians.oneupSHdegree()", CLAMPS, "changes _opacity outside"),
    (STEPS, f"        if iteration < 9:\n    {STEPS}", "optimizer steps only where iteration < 9"),
    (
        PARSES,
        f'\nmakedirs("net_7000")\ntorch.save(net, "net_{{}}".format(opt.iterations))\n{PARSES}',
        "saves into net_{}, a folder that it makes for iterations of its own alone (train.py:",
    ),
    (
        PARSES,
        f'\nopt.iterations = read(path).get("iterations", opt.iterations)\n{PARSES}',
        "sets iterations itself, whatever its command says (train.py:",
    ),
    (
        STEPS,
        f'{STEPS}        at = os.path.join("/home/me/kept", name)\n        torch.save(kept, at)\n',
        "saves into /home/me/kept, a folder of its author's (train.py:",
    ),
    (STEPS, f'{STEPS}        save_image(image, f"{{scene.model_path}}/seen/1")\n', "into seen, a"),
    ("projmatrix=0", "projmatrix=view.intrinsics", "is view.intrinsics"),
    (STATEMENT, "gaussians.prune(mask)", "calls prune, which GaussianModel lacks (train.py:"),
    (STATEMENT, "scene.shuffle()", "calls shuffle, which Scene lacks (train.py:"),
    ("if iteration < opt", f"rows = {STATEMENT}\n        if opt", "reads what thin_out"),
    ('"name": "scaling"', '"name": "size"', "no group scaling"),
    ("(viewpoint_camera, pc,", "(viewpoint_camera, xyz,", "a camera and a model"),
    ("pipe, background)", "pipe, background, chosen=mask)", "selection, means3D[chosen]"),
    (LOOP, f"    opt.iterations = 1000\n{LOOP}", "train.py: sets iterations itself"),
    (
        BACK,
        f"{BACK}        if worse > 3:\n            break\n",
        "train.py may end before its last iteration, where worse > 3 (train.py:",
    ),
    ("image, radii = rasterizer(", "both = rasterizer(", "not unpacked"),
    ("image, radii = rasterizer(", "return rasterizer(", "not unpacked"),
    ("return self._xyz\n", "return self.net()\n", "computed"),
]
GIVES = "    def posed(self):\n        return self.x, self.y\n\n    def capture"
NET = "class Net(torch.nn.Module):\n    def forward(self):\n        return x, y, z\n\n\nclass Gauss"
TURNED = "        self.net = Net().cuda()\n\n    def posed(self):\n        return self.net()\n"
RESTS = "    def rest(self):\n        self._xyz.grad[0] = 0\n\n    def capture"
LATE = "\nparser.add_argument('--late', default=None)\n"
COUNTS = """
class Window:
    def __init__(self):
        self.shown = 0

    def show(self):
        self.shown += 1
"""
REFUSED_TOGETHER = [
    (
        {},
        [("    def capture", RESTS), ("gaussians.oneupSHdegree()", "gaussians.rest()")],
        "rest reads gradients of the model",
    ),
    (
        {},
        [(BACK, f"        if opt.late:\n    {BACK}"), (PARSES, f"{LATE}{PARSES}")],
        "it trains only with --late",
    ),
    (
        {},
        [
            (PARSES, f"{COUNTS}{PARSES}"),
            (STATEMENT, "if window.shown > 9:\n                gaussians.prune(mask)"),
        ],
        "calls prune, which GaussianModel lacks (train.py:",
    ),
    (
        {},
        [("    def capture", GIVES), (STATEMENT, "a, b, c = gaussians.posed()")],
        "takes 3 values of posed, which gives 2 (train.py:",
    ),
    (
        {},
        [
            ("class Gauss", NET),
            ("sh_degree): ...\n", f"sh_degree):\n{TURNED}"),
            (STATEMENT, "a, b = gaussians.posed()"),
        ],
        "takes 2 values of posed, which gives 3 (train.py:",
    ),
    (
        {},
        [("import *", "import view, opt"), (PARSES, f"\ndef f(pipe, loss): ...\n{PARSES}")],
        "reads pipe, which nothing defines (train.py:",
    ),
    ({"settings": ", mult=0.5"}, [], "mult, unknown"),
    (
        {"settings": ", mult=mult"},
        [("chosen=None", "chosen=None, mult=None"), ("kground)", "kground, mult=opt.extent)")],
        "mult, unknown",
    ),
    ({"arguments": ", turned=pose"}, [], "turned, unknown"),
    ({"values": "image, radii, radii"}, [], "the radii once"),
    (
        {"values": "image, radii, more"},
        [(KEYS, f"    image = image + more\n{KEYS}")],
        "more, read in gaussian_renderer",
    ),
    (
        {},
        [("means3D=means3D", "means3D=xyz"), ("    shs =", "    xyz = means3D[rows]\n    shs =")],
        "draws a selection, means3D[rows]",
    ),
    (
        {},
        [("image, radii =", "both ="), (KEYS, f"    image, radii = cut(both), both[1]\n{KEYS}")],
        "not unpacked",
    ),
    (
        {},
        [
            ("image, radii =", "all ="),
            (KEYS, f'    image, radii, more = all\n{KEYS[:-8]}"more": more, "render"'),
            MORE,
        ],
        "more, read in train.py",
    ),
    (
        {"values": "image, radii, median_depth"},
        [('package["render"]', 'package["render"] + package["median_depth"]')],
        "median_depth, read in train.py:",
    ),
    (
        {"files": {"scene/deform_model.py": "class DeformModel:\n    def save_ply(self): ...\n"}},
        MOVED,
        "makes GaussianModel, DeformModel",
    ),
]


@pytest.mark.parametrize(
    ("given", "changes", "expected"),
    [*(({}, [(old, new)], says) for old, new, says in REFUSED), *REFUSED_TOGETHER],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_reading_cannot_follow_is_refused_by_name(tmp_path, given, changes, expected):
    assert expected in why(tmp_path, *changes, **given)


CALLED = {
    "tried": (STATEMENT, "try:\n                gaussians.prune(mask)\n            except E: ..."),
    "where a checkpoint is given": ("if checkpoint:", "if checkpoint:\n        gaussians.prune(1)"),
    "an optimizer that rests last": (STEPS, f"        if iteration < opt.iterations:\n    {STEPS}"),
    "by an option that is off": (
        STATEMENT,
        "if opt.thin == 2 or opt.rate > 0:\n                gaussians.prune(mask)",
    ),
    "of a class that inherits": (STATEMENT, "gaussians.cuda()"),
    "of a dict that holds a model": (
        "    for iteration in",
        '    of = {}\n    of["a"] = gaussians\n    of["b"] = GaussianModel(3)\n    of.keys()\n'
        "    for iteration in",
    ),
    "where it is asked for": (
        STATEMENT,
        'if hasattr(gaussians, "prune"):\n                gaussians.prune(mask)',
    ),
    "of a variable with models of two classes": (
        "\n\ndef training(",
        "\n\ndef start():\n    gaussians = Bound()\n    gaussians.bind()\n\n\ndef training(",
    ),
    "of a value that a script adds": (
        '        loss = l1_loss(package["render"]',
        "        package.update(extra)\n"
        '        loss = l1_loss(package["render"] + package["extra"]',
    ),
    "of another function of this name": (
        "    for iteration in",
        "    def l1_loss(a): ...\n    l1_loss(1, 2)\n    for iteration in",
    ),
    "that sets gradients": (STATEMENT, f"{STATEMENT}\n            gaussians._xyz.grad[rows] = 0"),
    "that stops them": (STATEMENT, f"{STATEMENT}\n            gaussians._xyz.requires_grad = 0"),
    "that draws some rows if asked": (KEYS, f"    if chosen is not None:\n    {OF_SOME}{KEYS}"),
    "that moves rows by a network": ("= pc.get_xyz", "= pc.get_xyz + pc.deform(pc.get_xyz, t)"),
}


@pytest.mark.parametrize("what", CALLED)
def test_a_call_that_may_not_be_reached_or_does_no_harm_is_no_failure(tmp_path, what):
    given = "\n".join(
        f"parser.add_argument('--{name}', default={value})"
        for name, value in (("rate", 0.0), ("thin", 1), ("save_iterations", []))
    )
    flags = (PARSES, f"\n{given}\n{PARSES}")
    inherits = ("class GaussianModel:", "class GaussianModel(nn.Module):")
    changes = [inherits] if "inherits" in what else []
    assert not why(tmp_path, CALLED[what], flags, *changes)


ASKS = "\n        if {}:\n            {}\n        loss.backward()"
CHANGES = {
    "a change": CLAMPS,
    "a step of its own": "gaussians.optimizer.step(seen)",
    "a result": "kept = gaussians.thin_out(mask)",
    "another step": "loss.backward()",
    "another training": "refine(gaussians)",
}
REFINES = "\n\ndef refine(gaussians):\n    for i in range(9):\n        loss.backward()\n"
GROWN = "    def __init__(self, sh_degree):\n        self.grown = False"
MORE_FLAGS = (
    "\nparser.add_argument('--late', default=0.0)\nparser.add_argument('--end', default=9)"
    "\nparser.add_argument('--start_checkpoint', default=None)\n"
)
TESTS = {
    "off": ("opt.late > 0 and iteration < opt.end", "", True),
    "asked for in another way": ('getattr(opt, "late", 0.0)', "", True),
    "on": ("opt.end > 0", "", False),
    "of the model": ("gaussians.grown", "", False),
    "off by a name": ("thins", "\nthins = opt.late > 0 and HAS_IT\n", True),
    "by a name of two values": ("thins", "\nthins = opt.late > 0\nthins = 1\n", False),
    "set by a run": ("opt.start_checkpoint", "", False),
    "set by the script": ("opt.late > 0", "\nopt.late = 1\n", False),
    "set from a file": ("opt.late > 0", "\nsetattr(opt, name, value)\n", False),
}


@pytest.mark.parametrize("what", CHANGES)
@pytest.mark.parametrize("test", TESTS)
def test_what_an_option_changes_is_not_changed_without_it(tmp_path, test, what):
    condition, beside, served = TESTS[test]
    repo = fork(
        tmp_path,
        ("\n        loss.backward()", ASKS.format(condition, CHANGES[what])),
        (PARSES, f"{MORE_FLAGS}{beside}{REFINES}{PARSES}"),
        ("    def __init__(self, sh_degree): ...", GROWN),
    )
    if not served:
        assert errors(repo)
        return
    assert errors(repo) == []
    assert takes(repo, "--end", "5")
    assert takes(repo, "--late", "0.0")
    for words in (["--late", "1"], ["--late=1"], ["--late"], ["--lat", "1"], ["--lat=1"]):
        with pytest.raises(UsageError, match="--late"):
            run([str(tmp_path / "train.py"), *words], RunOptions(device="cpu"))


NEAR = """if (near_map != nullptr && far_map != nullptr) {
    if (near_map[id] > 0) { if (p_view.z < near_map[id] - slack) return; }
}"""
GIVES_NEAR = "\n        chosen = None\n        if {}:\n            chosen = maps_of(view)\n"
DRAWN_NEAR = (
    "    s = Gauss",
    "    near = torch.empty(0, device=here)\n    if maps is not None:\n        near = load(maps)\n"
    "    s = Gauss",
)
NEARBY = {
    "an option": (NEAR, "opt.maps", True),
    "a switch that is on": (NEAR, "opt.end", False),
    "another part of the kernel": (f"{NEAR} if (slack) return;", "opt.maps", False),
    "the other map alone": (NEAR.replace("near_map != nullptr && ", ""), "opt.maps", False),
}


@pytest.mark.parametrize("what", NEARBY)
def test_a_setting_may_rest_where_another_is_empty(tmp_path, what):
    kernel, asked, served = NEARBY[what]
    repo = fork(
        tmp_path,
        ("chosen=None):", "chosen=None, maps=None):"),
        DRAWN_NEAR,
        ("        package = render(", f"{GIVES_NEAR.format(asked)}        package = render("),
        ("pipe, background)", "pipe, background, maps=chosen)"),
        (PARSES, f"{MORE_FLAGS}parser.add_argument('--maps', default=None)\n{PARSES}"),
        settings=", near_map=near, slack=1.0",
        kernel=kernel,
    )
    assert (errors(repo) == []) == served
    if served:
        assert read_fork(repo).off == {"near_map"}
        refuses(repo, "--maps", "here", says="--maps")


BEGINNINGS = {
    ("--iter", "7", "-m", "out"): ["--iterations", "7", "-m", "out"],
    ("--iter=7", "--", "--lat"): ["--iterations=7", "--", "--late"],
    ("--model", "gs", "--other=1"): ["--model", "gs", "--other=1"],
}


@pytest.mark.parametrize("words", BEGINNINGS)
def test_flags_are_written_out_as_argparse_completes_them(tmp_path, words):
    (tmp_path / "beside.py").write_text("def own(parser):\n    parser.add_argument('--model')\n")
    given = f"import beside{MORE_FLAGS}parser.add_argument('--iterations')\n"
    given += "parser.add_argument('--sparse')"
    fork(tmp_path, (PARSES, f"\n{given}\n{PARSES}"))
    line = ForkAdapter().command_line(HostRepo(tmp_path))
    in_full = partial(line.in_full, tmp_path / "train.py")
    assert in_full([*words]) == BEGINNINGS[words]
    assert line.read(["--model", "gs"]).output is None
    with pytest.raises(UsageError, match="--sparse, --start_checkpoint"):
        in_full(["--s"])


def test_the_model_that_the_scene_exports_is_the_one_that_is_read(tmp_path):
    fork(tmp_path)
    model = (tmp_path / "scene/gaussian_model.py").read_text()
    other = model.replace("torch.sigmoid", "torch.tanh")
    (tmp_path / "scene/late_model.py").write_text(other)
    scene = tmp_path / "scene/__init__.py"
    scene.write_text(f"from scene.late_model import GaussianModel\n{scene.read_text()}")
    repo = HostRepo(tmp_path)
    assert "its opacity_activation is torch.tanh (scene/late_model.py" in errors(repo)[0]
    assert plain.read_plain(repo).elsewhere == "GaussianModel is in scene.late_model"
    (tmp_path / "scene/late_model.py").write_text(other.replace("torch.tanh", "torch.sigmoid"))
    assert "train.py trains the GaussianModel of scene.late_model" in errors(HostRepo(tmp_path))[0]


SAVED = "    def save_ply(self, path): ..."
WRITES = "    def save_ply(self, path): write(path, self._xyz[{}])"
CHOSEN = """    def save_ply(self, path, kept=None):
        xyz, opacities = self._xyz.detach().cpu(), self._opacity.detach().cpu()
        if kept is not None:
            xyz, opacities = xyz[kept], opacities[kept]
        write(path, xyz, opacities)"""
ROW_BY_ROW = """    def save_ply(self, path):
        for row in range(len(self._xyz)):
            write(path, self._xyz[row])"""
LEFT_OUT = {
    "where a script names them": (
        CHOSEN,
        "scene.save(iteration), gaussians.save_ply(path, kept=bright)",
        True,
    ),
    "in place": (CHOSEN, "gaussians.save_ply(path, bright)", True),
    "always": (WRITES.format("self.kept"), "scene.save(9)", True),
    "of whole rows": (WRITES.format("self.kept, :"), "scene.save(9)", True),
    "where nobody names them": (CHOSEN, "gaussians.save_ply(path)", False),
    "where they are None": (CHOSEN, "gaussians.save_ply(path, kept=None)", False),
    "not at all": (WRITES.format(":, 0"), "scene.save(9)", False),
    "where they are written one by one": (ROW_BY_ROW, "scene.save(9)", False),
}


@pytest.mark.parametrize("what", LEFT_OUT)
def test_a_ply_of_other_rows_than_the_models_has_no_thresholds(tmp_path, what):
    save, call, refused = LEFT_OUT[what]
    found = why(tmp_path, (SAVED, save), ("scene.save(iteration)", call))
    assert ("save_ply leaves out rows" in found) == refused
    assert bool(found) == refused


ELSEWHERE = ("from gaussian_renderer import", "from gaussian_renderer.mine import")


@pytest.mark.parametrize("again", [False, True])
def test_a_script_draws_by_a_function_that_has_a_seam(tmp_path, again):
    repo = fork(tmp_path, ELSEWHERE)
    usual = tmp_path / RENDERER
    usual.with_name("mine.py").write_text(usual.read_text())
    if again:
        usual.write_text("from gaussian_renderer.mine import render\n")
    found = "; ".join(errors(repo))
    assert ("train.py draws by render of gaussian_renderer.mine" in found) == (not again)


@pytest.mark.parametrize("used", ["paint(view, gaussians)", "log(paint)"])
def test_a_script_that_draws_by_a_function_of_its_own_is_refused(tmp_path, used):
    paints = "\ndef paint(view, pc):\n    return GaussianRasterizer(view)(pc.get_xyz)\n"
    found = why(tmp_path, (BACK, f"        loss += {used}\n{BACK}"), files={"train.py": paints})
    assert ("train.py draws by paint of its own" in found) == used.startswith("paint")


@pytest.mark.parametrize(("given", "runs"), [("", False), (", 30_000", True), (", steps=9", True)])
def test_a_script_whose_length_has_no_type_is_refused(tmp_path, given, runs):
    repo = fork(tmp_path, (PARSES, f"\nOptimizationParams(parser{given})\n{PARSES}"))
    made = "def __init__(self, parser, steps=None):\n        self.iterations = steps\n"
    (tmp_path / "arguments/__init__.py").write_text(f"class OptimizationParams:\n    {made}")
    assert ("cannot take --iterations" in str(errors(repo))) == (not runs)


LOADS = "if not self.loaded_iter:"


@pytest.mark.parametrize(
    ("body", "found"),
    [
        (f"{LOADS} self.gaussians.create_from_mesh()", "its scene calls create_from_mesh, which G"),
        (f"{LOADS} self.gaussians.training_setup(a, b)", "its scene's call of training_setup give"),
        (f"{LOADS} self.gaussians.training_setup(args)", ""),
        ("if args.mesh: self.gaussians.create_from_mesh()", ""),
        ("self.cameras.sort()", ""),
        ("start = '/content/mine/start.ply'", "its scene loads /content/mine/start.ply"),
        ("start = args.start", ""),
    ],
)
def test_a_scene_that_makes_its_model_in_vain_is_refused(tmp_path, body, found):
    repo = fork(tmp_path)
    made = f" args, gaussians):\n        {body}\n"
    edit(tmp_path / "scene/__init__.py", " args, gaussians): ...\n", made)
    assert found in str(errors(repo))
    assert bool(errors(repo)) == bool(found)
    assert not found or "(scene/__init__.py:6)" in str(errors(repo))


@pytest.mark.parametrize(
    ("called", "loaded", "runs"),
    [
        ("self.sized()", "np.load('C:/mine/sizes.npy')", False),
        ("self.sized()", "np.load(self.path + '/sizes.npy')", True),
        ("self.sized()", "np.load('sizes.npy')", True),
        ("if self.path: self.sized()", "np.load('C:/mine/sizes.npy')", True),
    ],
)
def test_a_model_that_loads_a_file_of_its_authors_as_it_is_made_is_refused(
    tmp_path, called, loaded, runs
):
    made = f"    def create_from_pcd(self, pcd):\n        {called}\n\n"
    made += f"    def sized(self):\n        sizes = {loaded}\n\n    def training_setup"
    found = errors(fork(tmp_path, ("    def training_setup", made)))
    said = "its model loads C:/mine/sizes.npy (scene/gaussian_model.py:"
    assert (said in str(found)) == bool(found) == (not runs)


@pytest.mark.parametrize(
    ("asked", "runs"), [("PRETRAINED", False), ("not PRETRAINED", True), ("self.pretrained", True)]
)
def test_what_else_a_script_makes_may_load_a_file_of_its_authors(tmp_path, asked, runs):
    named = (
        "from scene import GaussianModel",
        "from scene.net import Net\nfrom scene import GaussianModel",
    )
    repo = fork(tmp_path, named, ("    scene = Scene(", "    net = Net()\n    scene = Scene("))
    made = f"    def __init__(self):\n        if {asked}:\n            load('/media/me/net.pth')\n"
    (tmp_path / "scene/net.py").write_text(f"PRETRAINED = True\n\n\nclass Net:\n{made}")
    said = "its Net loads /media/me/net.pth (scene/net.py:7)"
    assert errors(repo) == [] if runs else said in str(errors(repo))


@pytest.mark.parametrize(
    ("taken", "given", "runs"),
    [
        ("views[1.0]", "scene_info.train_cameras", False),
        ("views[1.0]", "self.train_cameras", True),
        ("views[0]", "scene_info.train_cameras", True),
    ],
)
def test_a_list_has_no_items_between_its_items(tmp_path, taken, given, runs):
    made = f"    def create_from_pcd(self, views):\n        first = {taken}\n\n    def capture"
    repo = fork(tmp_path, ("    def capture", made))
    scene = tmp_path / "scene/__init__.py"
    made = "def __init__(self, args, gaussians):\n        self.gaussians.create_from_pcd({})\n"
    text = scene.read_text().replace("def __init__(self, args, gaussians): ...\n", made)
    scene.write_text(text.format(given))
    said = f"its model takes {taken} of a list (scene/__init__.py:6)"
    assert errors(repo) == [] if runs else said in str(errors(repo))


GROUP = """class ParamGroup:
    def extract(self, args):
        group = GroupParams()
        for arg in vars(args).items():
            if arg[0] in vars(self) or ("_" + arg[0]) in vars(self):
                setattr(group, arg[0], arg[1])
        return group


class OptimizationParams(ParamGroup):
    def __init__(self, parser):
        self.iterations = 30
        self._rate = 1.0

    def extract(self, args):
        g = super().extract(args)
        g.densify_until_iter = 15
        return g
"""


@pytest.mark.parametrize(
    ("read", "runs"),
    [
        ("opt.folder", False),
        ("opt.rate", True),
        ("opt.densify_until_iter", True),
        ("getattr(opt, 'folder', None)", True),
        ("len(opt.__dict__)", True),
        ("opt.__dict__.update(opt.folder)", True),
        ("opt.folder if hasattr(opt, 'folder') else 0", True),
        ("1\n    opt.folder = place\n    used = opt.folder", True),
    ],
)
@pytest.mark.parametrize("extracted", [True, False])
def test_a_group_of_options_has_no_others(tmp_path, read, runs, extracted):
    uses = (
        "    gaussians = GaussianModel(3)\n",
        f"    used = {read}\n    gaussians = GaussianModel(3)\n",
    )
    given = "op.extract(args)" if extracted else "args"
    starts = f"\nop = OptimizationParams(parser)\ntraining({given}, args.start)\n{PARSES}"
    repo = fork(tmp_path, uses, (PARSES, starts))
    (tmp_path / "arguments/__init__.py").write_text(GROUP)
    found = "reads opt.folder, and OptimizationParams has no such option (train.py:"
    assert errors(repo) == [] if runs or not extracted else found in str(errors(repo))


@pytest.mark.parametrize(
    ("made", "runs"),
    [
        ("def __init__(self, args, gaussians): ...", False),
        ("def __init__(self, *args):\n        super().__init__(*args)", True),
        ("def views(self): ...", True),
    ],
)
def test_a_scene_of_its_own_is_none_that_seams_hear(tmp_path, made, runs):
    changes = ("GaussianModel, Scene", "GaussianModel, Wide"), ("Scene(opt", "Wide(opt")
    repo = fork(tmp_path, *changes)
    with (tmp_path / "scene/__init__.py").open("a") as scene:
        scene.write(f"\n\nclass Wide(Scene):\n    {made}\n")
    assert errors(repo) == [] if runs else "makes Wide, no Scene (train.py:" in str(errors(repo))


@pytest.mark.parametrize("channels", [3, 4])
def test_a_model_of_four_channels_is_refused(tmp_path, channels):
    reads = f"    def load_ply(self, path):\n        ply['f_dc_0'], ply['f_dc_{channels - 1}']"
    found = errors(fork(tmp_path, ("    def load_ply(self, path): ...", reads)))
    said = "its PLY may have a further channel, f_dc_3 (scene/gaussian_model.py:"
    assert (said in str(found)) == bool(found) == (channels == 4)


CAMERA = """class Camera(nn.Module):
    def __init__(self, image):
        self.{}image = image

    @property
    def width(self): return 1


class Posed(Camera):
    def __init__(self, image):
        self.turned = True


class Raw(nn.Module):
    def __init__(self, image):
        self.raw = image
"""


@pytest.mark.parametrize(
    ("read", "private", "runs"),
    [
        ("viewpoint_cam.image", "", True),
        ("viewpoint_cam.image", "__", False),
        ("viewpoint_cam.turned", "", False),
        ("viewpoint_cam.turned if hasattr(viewpoint_cam, 'turned') else 0", "", True),
        ("viewpoint_cam.width", "", True),
        ("viewpoint_cam.raw", "", True),
        ("viewpoint_cam.cpu()", "", True),
        ("1\n        viewpoint_cam.seen = viewpoint_cam.seen + 1", "", True),
    ],
)
def test_a_script_that_reads_what_its_cameras_lack_is_refused(tmp_path, read, private, runs):
    pops = f"viewpoint_cam = views.pop()\n        shown = {read}\n        package = render("
    files = {"utils/camera_utils.py": "def loadCam(args):\n    return Camera(args)\n"}
    files["scene/cameras.py"] = CAMERA.format(private)
    found = why(tmp_path, ("package = render(", pops), files=files)
    name = read.split(".")[-1]
    assert not found if runs else f"reads {name} of a camera, which has none (train.py:" in found


@pytest.mark.parametrize("asked", ["fast", "pipe.fast"])
def test_a_function_without_a_rasterizer_draws_in_the_place_of_no_other(tmp_path, asked):
    quick = "    s = Gaussian", f"    if {asked}:\n        return quick(pc)\n    s = Gaussian"
    flags = PARSES, f"\nparser.add_argument('--fast', default=False)\n{PARSES}"
    draws = "def quick(pc):\n    return {'render': backend(pc.get_xyz), 'seen': pc.get_xyz}\n"
    seen = ('package["render"]', 'package["seen"]')
    found = why(tmp_path, quick, flags, seen, files={RENDERER: draws})
    assert ("draws by quick, which calls no rasterizer of 3DGS" in found) == (asked == "fast")
    assert "which has no such value" not in found


@pytest.mark.parametrize(
    ("end", "given"),
    [
        ("args.steps + 1", ""),
        ("steps", "    steps = args.steps\n"),
        ("steps", "    steps = opt.iterations if opt.iterations else args.steps\n"),
        ("args.steps + opt.iterations", ""),
        ("args.unknown", ""),
    ],
)
def test_a_training_is_as_long_as_the_option_of_its_length_says(tmp_path, end, given):
    loop = LOOP, f"{given}    for iteration in range(1, {end}):\n"
    flags = PARSES, f"\nparser.add_argument('--steps', type=int, default=7)\n{PARSES}"
    found = why(tmp_path, loop, flags)
    said = "train.py trains as long as --steps says, not --iterations (train.py:"
    assert (said in found) == ("steps" in end + given and "iterations" not in end + given)


@pytest.mark.parametrize("draws", ["backend(pc)", "settings(GaussianRasterizer)", "made(pc)"])
def test_a_function_that_is_imported_under_the_usual_name_draws_by_a_rasterizer(tmp_path, draws):
    other = f"def quick(cam, pc, p, b):\n    image = {draws}\n    return {{'render': image}}\n"
    other += "def made(pc):\n    return GaussianRasterizer(pc)\n"
    quick = "from gaussian_renderer import render", "from gaussian_renderer import quick as render"
    found = why(tmp_path, quick, files={RENDERER: other})
    said = "draws by quick, which calls no rasterizer of 3DGS"
    assert (said in found) == (draws == "backend(pc)")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("helpers", "def f():\n", "imports helpers, which is no valid Python (scene/tools.py:1)"),
        ("helpers", "def f(): ...\n", ""),
        ("helpers", "\ufeffdef f(): ...\n", ""),
        ("helpers", "f = g = None\n", ""),
        ("helpers", "from elsewhere import *\n", ""),
        ("helpers", "def __getattr__(name): ...\n", ""),
        ("helpers", "def g(): ...\n", "imports f, which helpers lacks (scene/tools.py:1)"),
        ("helpers", None, ""),  # an installed package
        ("train", None, "imports train, which is not there (scene/tools.py:1)"),
        ("scene.helpers", None, "imports scene.helpers, which is not there (scene/tools.py:1)"),
    ],
)
def test_a_script_that_cannot_import_its_own_modules_is_refused(tmp_path, name, text, said):
    tools = ("from scene import GaussianModel", "from scene import tools, GaussianModel")
    files = {"scene/tools.py": f"from {name} import f\n"} | ({f"{name}.py": text} if text else {})
    found = why(tmp_path, tools, files=files, script="train_scene.py")
    assert (f"train_scene.py: {said}" in found) if said else not found


@pytest.mark.parametrize(("before", "after"), [("try:", "except E: ...\n"), ("def later():", "")])
def test_a_module_that_is_imported_only_where_it_is_there_may_be_broken(tmp_path, before, after):
    imports = f"{before}\n    import scene.viewer\n{after}from scene import"
    files = {"scene/viewer.py": "from scene.gone import f\n"}
    assert not why(tmp_path, ("from scene import", imports), files=files)


def test_a_script_in_a_folder_imports_what_lies_beside_it(tmp_path):
    repo = fork(tmp_path, ("from scene", "from train import f\nfrom scene"), script="train_a.py")
    (tmp_path / "apps").mkdir()
    (tmp_path / "train_a.py").rename(tmp_path / "apps/train_a.py")
    (tmp_path / "apps/train.py").write_text("def f(): ...\n")
    assert not any("which is not there" in each for each in errors(repo))


def test_a_function_that_hands_a_picture_on_draws_none(tmp_path):
    keys = 'return {"render": image, "radii": radii}', "return packed(image, radii)"
    packs = "def packed(image, radii):\n    return {'render': image, 'radii': radii}\n"
    assert "which calls no rasterizer of 3DGS" not in why(tmp_path, keys, files={RENDERER: packs})


def test_what_a_script_changes_until_densification_ends_ends_before_stage_2(tmp_path):
    repo = fork(tmp_path, (STATEMENT, CLAMPS))
    assert errors(repo) == []
    (warned,) = (each.found for each in read_fork(repo).findings if each.code == "row-change")
    assert "which changes _opacity, ends before stage 2" in warned


RATE = (
    "        gaussians.update_learning_rate(iteration)",
    "        rate = gaussians.update_learning_rate(iteration)",
)
NOISE = {
    "by the rate": ("noise = torch.randn(9, 3) * rate * 9\n        noise = spread @ noise", True),
    "the rate itself": ("noise = rate * torch.randn(9, 3)", True),
    "with an offset": ("noise = rate + torch.randn(9, 3)", False),
    "of another rate": ("noise = torch.randn(9, 3) * opt.rate", False),
    "or new": ("noise = rate * a\n        noise = b if late else noise\n        noise = b", False),
}


@pytest.mark.parametrize("what", NOISE)
def test_noise_is_as_large_as_the_rate_which_is_zero_in_stage_2(tmp_path, what):
    made, served = NOISE[what]
    moved = f"{STEPS}        {made}\n        gaussians._xyz.add_(noise)\n"
    repo = fork(tmp_path, RATE, (STEPS, moved))
    if not served:
        assert "changes _xyz outside" in errors(repo)[0]
        return
    assert errors(repo) == []
    (stepping,) = (each for each in ForkAdapter().seams_for(repo) if each.role == Role.STEP)
    assert stepping.how(SimpleNamespace()) == 0


def test_what_a_densification_returns_may_be_read_where_it_ends_before_stage_2(tmp_path):
    repo = fork(tmp_path, (STATEMENT, f"pruned = {STATEMENT}"))
    assert errors(repo) == []
    (held,) = (x for x in ForkAdapter().seams_for(repo) if x.attribute.endswith("thin_out"))
    with pytest.raises(EngineError, match="thin_out, whose result the host reads"):
        held.how(SimpleNamespace(seam=held))


def test_rows_and_values_stand_still_by_what_methods_do_not_by_their_names(tmp_path):
    seams = ForkAdapter().seams_for(fork(tmp_path))
    still = [each.attribute.split(".")[1] for each in seams if each.role is Role.STILL]
    assert still == ["oneupSHdegree", "thin_out", "spread"]


def test_a_method_that_makes_a_model_changes_it_where_it_is_called_in_training(tmp_path):
    body = "    def set_rows(self, rows):\n        self._xyz = rows\n\n    def capture"
    changes = ("    def capture", body), ("gaussians.oneupSHdegree()", "gaussians.set_rows(means)")
    assert read_fork(fork(tmp_path / "in", *changes)).still == ("set_rows", "thin_out", "spread")
    before = (changes[0], ("    scene = Scene(", "    gaussians.set_rows(1)\n    scene = Scene("))
    assert "set_rows" not in read_fork(fork(tmp_path / "before", *before)).still


def test_joint_learning_needs_to_know_where_the_model_comes_to_rest(tmp_path):
    repo = fork(tmp_path / "known")
    (tmp_path / "known/arguments/__init__.py").write_text(
        "class OptimizationParams:\n    def __init__(self):\n        self.densify_until_iter = 15\n"
    )
    assert ForkAdapter().densified(repo, tmp_path / "known/train.py", []) == 15
    later = fork(tmp_path / "later", ("if iteration < opt.densify_until_iter:", "if True:"))
    assert ForkAdapter().densified(later, tmp_path / "later/train.py", []) is None


@pytest.mark.parametrize("taken", ["distCUDA2(points)", "distCUDA2(points)[0]"])
def test_neighbours_of_its_own_have_no_stand_in(tmp_path, taken):
    scales = f"    def create_from_pcd(self, pcd):\n        scales = {taken}\n\n    def capture"
    dialect = ForkAdapter().dialect(fork(tmp_path, ("    def capture", scales)))
    assert ("simple_knn" in dialect.names()) == (not taken.endswith("]"))
    assert dialect.modules(lambda call: None).keys() == dialect.names()


def test_no_checkpoint_is_made_from_a_forks_ply(tmp_path):
    with pytest.raises(UsageError, match="cannot resume"):
        ForkAdapter().checkpoint_from_ply(tmp_path / "a.ply", 7, tmp_path / "made.pth")
    assert not (tmp_path / "made.pth").exists()


def test_a_model_is_found_under_another_name_if_it_is_the_only_one(tmp_path):
    usual = ForkAdapter().model_file(tmp_path, 7)
    assert usual == tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    usual.parent.mkdir(parents=True)
    scene = usual.with_name("scene_point_cloud.ply")
    scene.touch()
    assert ForkAdapter().model_file(tmp_path, 7) == scene
    usual.with_name("part_point_cloud.ply").touch()
    assert ForkAdapter().model_file(tmp_path, 7) == usual


def test_exposures_that_a_resumed_fork_would_lose_are_refused(tmp_path):
    refuses(fork(tmp_path), "--train_test_exp", says="exposures")
    assert takes(HostRepo(tmp_path), "--eval")


@pytest.mark.parametrize("through", [True, False])
def test_a_scene_that_another_method_saves_keeps_thresholds_if_it_goes_through_save_ply(
    tmp_path, through
):
    saver = "    def save_fused_ply(self, path):\n        "
    saver += "self.save_ply(path)" if through else "PlyData(self._xyz).write(path)"
    save = "\n    def save(self, i):\n        self.gaussians.save_fused_ply(i)\n"
    files = {"scene/__init__.py": save}
    found = why(tmp_path, (SAVED, f"{saver}\n\n{SAVED}"), files=files)
    assert ("by save_fused_ply, which saves no thresholds" in found) == (not through)


@pytest.mark.parametrize(
    ("angle", "runs"), [("360", False), ("np.pi", True), ("fov", True), ("1.5", True)]
)
def test_cameras_that_see_all_around_are_refused(tmp_path, angle, runs):
    made = {"scene/dataset_readers.py": f"info = CameraInfo(uid=1, FovX={angle})\n"}
    found = f"its cameras are no pinholes, FovX={angle} (scene/dataset_readers.py:1)"
    assert (found in why(tmp_path, files=made)) == (not runs)
    assert (found in plain.read_plain(HostRepo(tmp_path)).reasons) == (not runs)
