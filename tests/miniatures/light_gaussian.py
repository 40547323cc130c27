"""A miniature LightGaussian: the demo's host with what the method adds, from its interface."""

import copy
import inspect
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from torch.optim.lr_scheduler import ExponentialLR

from fragprune_plugins.testing import Chance, Host
from fragprune_plugins.testing.rewriting import changed

args = SimpleNamespace()  # the host's scripts hold their options under this name


class Added:
    """Methods of GaussianModel that vanilla does not have."""

    def onedownSHdegree(self):  # noqa: N802 - the name callers use
        if self.active_sh_degree > self.max_sh_degree:
            self.active_sh_degree -= 1
            kept = (self.active_sh_degree + 1) ** 2 - 1
        self._features_rest = self._features_rest.detach().clone()[:, :kept]
        self._features_rest.requires_grad = True

    def load_ply_sh(self, path, new_sh):
        self.load_ply(path)
        self._features_rest = nn.Parameter(  # noqa: F821 - imported where this is put
            self._features_rest.detach()[:, : (new_sh + 1) ** 2 - 1]
        )
        self.active_sh_degree = new_sh

    def densify(self, max_grad, extent):
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0.0)
        self.densify_and_clone(grads, max_grad, extent)
        self.densify_and_split(grads, max_grad, extent)

    def prune_opacity(self, percent):
        self.prune_gaussians(percent, self.get_opacity)

    def prune_gaussians(self, percent, import_score):
        lowest = import_score.sort(dim=0).values[int(percent * (len(import_score) - 1))]
        self.prune_points((import_score <= lowest).squeeze())


def prune_list(gaussians, scene, pipe, background):
    """Counts and scores of every Gaussian, summed over the training views, from the last on."""
    cameras = scene.getTrainCameras().copy()
    package = count_render(cameras.pop(), gaussians, pipe, background)  # noqa: F821
    counts, scores = package["gaussians_count"], package["important_score"]
    while cameras:
        package = count_render(cameras.pop(), gaussians, pipe, background)  # noqa: F821
        counts += package["gaussians_count"].detach()
        scores += package["important_score"].detach()
    return counts, scores


def prune(iteration, gaussians, scene, pipe, background):
    """At the named iterations, a share of the Gaussians goes."""
    if iteration in args.prune_iterations:
        _, scores = prune_list(gaussians, scene, pipe, background)
        later = args.prune_iterations.index(iteration)
        gaussians.prune_gaussians(args.prune_decay**later * args.prune_percent, scores)


def last_checkpoint(iteration, iterations, gaussians, scene, pipe, background):
    """Scores go beside the last checkpoint."""
    if iteration == iterations[-1]:
        _, scores = prune_list(gaussians, scene, pipe, background)
        np.savez(Path(scene.model_path) / "imp_score", scores.cpu().numpy())


def begin(gaussians, opt, checkpoint):
    """From a checkpoint or a point cloud; from nothing only where that is allowed."""
    first_iter = 0
    if checkpoint:
        gaussians.training_setup(opt)
        model_params, first_iter = torch.load(checkpoint)
        gaussians.restore(model_params, opt)
    elif args.start_pointcloud:
        gaussians.load_ply(args.start_pointcloud)
        gaussians.training_setup(opt)
        gaussians.max_radii2D = torch.zeros(gaussians.get_xyz.shape[0], device="cuda")
    elif args.must_start:
        raise ValueError("a checkpoint or a point cloud is needed")
    else:
        gaussians.training_setup(opt)
    gaussians.scheduler = ExponentialLR(gaussians.optimizer, gamma=0.9)
    return first_iter


def distil(dataset, opt, pipe, checkpoint):
    """A student with fewer bands learns its teacher's pictures."""
    degree, dataset.sh_degree = dataset.sh_degree, args.new_max_sh
    prepare_output_and_logger(dataset)  # noqa: F821
    with torch.no_grad():
        teacher = GaussianModel(degree)  # noqa: F821
    student = GaussianModel(degree)  # noqa: F821
    scene, first_iter = Scene(dataset, student), 0  # noqa: F821
    if checkpoint:
        taught, _ = torch.load(args.teacher_model)
        model_params, first_iter = torch.load(checkpoint)
        teacher.restore(taught, copy.deepcopy(opt))
        student.restore(model_params, opt)
        student.max_sh_degree = args.new_max_sh
        student.onedownSHdegree()
    student.training_setup(opt)
    student.scheduler = ExponentialLR(student.optimizer, gamma=0.9)
    if not args.enable_opacity:
        student._opacity.requires_grad = False
    teacher.optimizer = None
    background = torch.zeros(3, device="cuda")
    for iteration in range(first_iter + 1, opt.iterations + 1):
        student.update_learning_rate(iteration)
        cameras = scene.getTrainCameras()
        camera = copy.deepcopy(cameras[iteration % len(cameras)])
        image = render(camera, student, pipe, background)["render"]  # noqa: F821
        truth = render(camera, teacher, pipe, background)["render"].detach()  # noqa: F821
        l1_loss(image, truth).backward()  # noqa: F821
        with torch.no_grad():
            if iteration in args.save_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                student.optimizer.step()
                student.optimizer.zero_grad(set_to_none=True)
            if iteration in args.checkpoint_iterations:
                path = Path(scene.model_path) / f"chkpnt{iteration}.pth"
                torch.save((student.capture(), iteration), path)


FLAGS = """    parser.add_argument("--prune_iterations", nargs="+", type=int, default=[16_000])
    parser.add_argument("--prune_percent", type=float, default=0.5)
    parser.add_argument("--prune_decay", type=float, default=0.8)
"""
TEACHING = """    parser.add_argument("--teacher_model")
    parser.add_argument("--new_max_sh", type=int, default=2)
    parser.add_argument("--augmented_view", action="store_true")
    parser.add_argument("--enable_opacity", action="store_true")
"""
DENSIFY = (
    "            if iteration < opt.densify_until_iter:\n"
    "                densify(iteration, opt, dataset, gaussians, scene, package)\n"
)
STEP = "            if iteration < opt.iterations:\n"
CHECKPOINT = "                torch.save((gaussians.capture(), iteration), path)\n"
BEGIN = (
    "    gaussians.training_setup(opt)\n    if checkpoint:\n"
    "        model_params, first_iter = torch.load(checkpoint)\n"
    "        gaussians.restore(model_params, opt)\n"
)
SCRIPT = [
    ("import random\n", "import copy\nimport random\n"),
    ("import torch\n", "import numpy as np\nimport torch\n"),
    (
        "from gaussian_renderer import render\n",
        "from gaussian_renderer import count_render, render\n",
    ),
    (
        "from tqdm import tqdm\n",
        "from torch.optim.lr_scheduler import ExponentialLR\nfrom tqdm import tqdm\n",
    ),
    (BEGIN, "    first_iter = begin(gaussians, opt, checkpoint)\n"),
    (
        "        if not waiting:\n",
        "        if iteration % 5 == 3:\n            gaussians.scheduler.step()\n"
        "        if not waiting:\n",
    ),
    (STEP, "            prune(iteration, gaussians, scene, pipe, background)\n" + STEP),
    (
        CHECKPOINT,
        CHECKPOINT + "                last_checkpoint(\n"
        "                    iteration, checkpoint_iterations, gaussians, scene, pipe, background\n"
        "                )\n",
    ),
]
NO_START = '    args.start_pointcloud, args.must_start = "", False\n'
START = (
    '    parser.add_argument("--start_pointcloud")\n    args = parser.parse_args()\n'
    "    args.must_start = True\n"
)
PARSE = "    args = parser.parse_args()\n"


class LightGaussianHost(Host):
    """Pruning by a score, and densification without it."""

    routine = (
        "prune by score",
        "prune by opacity",
        "densify",
        "densify and prune",
        "reset opacity",
        "another band",
    )

    def write(self, root: Path) -> None:
        super().write(root)
        renderer, model = root / "gaussian_renderer/__init__.py", root / "scene/gaussian_model.py"
        text = changed(
            renderer.read_text(),
            [("debug=pipe.debug,\n", "debug=pipe.debug,\n        f_count=False,\n")],
        )
        counting = changed(
            text[text.index("def render(") :],
            [
                ("def render(", "def count_render("),
                ("f_count=False", "f_count=True"),
                ("    image, radii =", "    count, score, image, radii ="),
                (
                    '        "radii": radii,\n',
                    '        "radii": radii,\n        "gaussians_count": count,\n'
                    '        "important_score": score,\n',
                ),
            ],
        )
        renderer.write_text(text + "\n\n" + counting)
        methods = "".join(inspect.getsourcelines(Added)[0][2:])
        text = changed(model.read_text(), [("torch.optim.Adam(", "torch.optim.AdamW(")])
        model.write_text(text + "\n" + methods)
        functions = (prune_list, prune, last_checkpoint, begin, distil)
        own = "\n\n".join(inspect.getsource(f) for f in functions)
        text = changed((root / "train.py").read_text(), SCRIPT)
        text = text.replace("if __name__", own + "\n\nif __name__")
        train = changed(text, [(PARSE, FLAGS + PARSE + NO_START)])
        finetune = changed(text, [(PARSE, FLAGS + START), (DENSIFY, "")])
        call = text[text.index("    training(\n        lp.extract") :]
        parse = TEACHING + PARSE
        groups = ", ".join(f"{group}.extract(args)" for group in ("lp", "op", "pp"))
        new_call = f"    distil({groups}, args.start_checkpoint)\n"
        distilling = changed(text, [(PARSE, parse), (call, new_call)])
        (root / "train_densify_prune.py").write_text(train)
        (root / "prune_finetune.py").write_text(finetune)
        (root / "distill_train.py").write_text(distilling)
        (root / "train.py").unlink()

    def model(self, arguments, count, *, seed, degree, setup):
        model = super().model(arguments, count, seed=seed, degree=degree, setup=setup)
        if setup:
            model.scheduler = ExponentialLR(model.optimizer, gamma=0.9)
        return model

    def descend(self, model):
        """The loop's own scheduler changes every rate."""
        super().descend(model)
        model.scheduler.step()

    def actions(self):
        return {
            **super().actions(),
            "prune by score": prune_by_score,
            "prune by opacity": lambda m, arguments, chance: m.prune_opacity(chance.share),
            "densify": densify_alone,
        }


def prune_by_score(model, arguments, chance: Chance):
    model.prune_gaussians(chance.share, chance.uniform(len(model.get_xyz)))


def densify_alone(model, arguments, chance: Chance):
    n = len(model.get_xyz)
    model.xyz_gradient_accum = chance.uniform(n, 1)
    model.denom = chance.rows(n, 0.8)[:, None].float()
    model.densify(1 - chance.share, 3.0 if chance.heads else 100.0)
