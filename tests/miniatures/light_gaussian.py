"""A miniature LightGaussian: the demo's host with what the method adds, from its interface."""

import copy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from torch.optim.lr_scheduler import ExponentialLR

from fragprune_plugins.testing import Chance
from fragprune_plugins.testing.rewriting import changed
from miniatures.family import MODEL, PARSE, RADII, RENDERER, STEP, TRAIN, Derived, adding, parsing
from miniatures.speedy_splat import Pruning, prune_by_score

args = SimpleNamespace()  # the host's scripts hold their options under this name


class Added:
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


DENSIFY = (
    "            if iteration < opt.densify_until_iter:\n"
    "                densify(iteration, opt, dataset, gaussians, scene, package)\n"
)
PRUNING = (
    '"--prune_iterations", nargs="+", type=int, default=[16_000]',
    '"--prune_percent", type=float, default=0.5',
    '"--prune_decay", type=float, default=0.8',
)
TEACHING = parsing(
    '"--teacher_model"',
    '"--new_max_sh", type=int, default=2',
    '"--augmented_view", action="store_true"',
    '"--enable_opacity", action="store_true"',
)
BEGIN = (
    "    gaussians.training_setup(opt)\n    if checkpoint:\n"
    "        model_params, first_iter = torch.load(checkpoint)\n"
    "        gaussians.restore(model_params, opt)\n"
)
NO_START = '    args.start_pointcloud, args.must_start = "", False\n'


class LightGaussianHost(Derived):
    """Pruning by a score, and densification without it."""

    routine = (
        *("prune by score", "prune by opacity", "densify", "densify and prune", "reset opacity"),
        "another band",
    )
    changes = {
        RENDERER: [adding("debug=pipe.debug,\n", after="        f_count=False,\n")],
        MODEL: [("torch.optim.Adam(", "torch.optim.AdamW(")],
        TRAIN: [
            adding("import random\n", before="import copy\n"),
            adding("import torch\n", before="import numpy as np\n"),
            adding("gaussian_renderer import ", after="count_render, "),
            adding(
                "from tqdm import tqdm\n",
                before="from torch.optim.lr_scheduler import ExponentialLR\n",
            ),
            (BEGIN, "    first_iter = begin(gaussians, opt, checkpoint)\n"),
            adding(
                "        if not waiting:\n",
                before="        if iteration % 5 == 3:\n            gaussians.scheduler.step()\n",
            ),
            adding(
                STEP, before="            prune(iteration, gaussians, scene, pipe, background)\n"
            ),
            adding(
                "                torch.save((gaussians.capture(), iteration), path)\n",
                after="                ends = iteration, checkpoint_iterations\n"
                "                last_checkpoint(*ends, gaussians, scene, pipe, background)\n",
            ),
        ],
    }
    functions = (prune_list, prune, last_checkpoint, begin, distil)
    added = (Pruning, Added)

    def write(self, root: Path) -> None:
        super().write(root)
        renderer, train = root / RENDERER, root / TRAIN
        text = renderer.read_text()
        counting = changed(
            text[text.index("def render(") :],
            [
                ("def render(", "def count_render("),
                ("f_count=False", "f_count=True"),
                ("    image, radii =", "    count, score, image, radii ="),
                adding(
                    RADII,
                    after='        "gaussians_count": count,\n        "important_score": score,\n',
                ),
            ],
        )
        renderer.write_text(text + "\n\n" + counting)
        text = train.read_text()
        call = text[text.index("    training(\n        lp.extract") :]
        parts = ", ".join(f"{group}.extract(args)" for group in ("lp", "op", "pp"))
        own = [parsing('"--start_pointcloud"'), adding(PARSE, after="    args.must_start = True\n")]
        scripts = {
            "train_densify_prune.py": [parsing(*PRUNING), adding(PARSE, after=NO_START)],
            "prune_finetune.py": [parsing(*PRUNING), *own, (DENSIFY, "")],
            "distill_train.py": [TEACHING, (call, f"    distil({parts}, args.start_checkpoint)\n")],
        }
        for name, changes in scripts.items():
            (root / name).write_text(changed(text, changes))
        train.unlink()

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


def densify_alone(model, arguments, chance: Chance):
    n = len(model.get_xyz)
    model.xyz_gradient_accum = chance.uniform(n, 1)
    model.denom = chance.rows(n, 0.8)[:, None].float()
    model.densify(1 - chance.share, 3.0 if chance.heads else 100.0)
