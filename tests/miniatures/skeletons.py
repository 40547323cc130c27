"""Hosts with nothing inside: signatures and the rasterizer call, written from their interfaces."""

from collections.abc import Sequence
from pathlib import Path

from fragprune_plugins.hosts.source import HostRepo

SETTINGS = [
    *("image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier"),
    *("viewmatrix", "projmatrix", "sh_degree", "campos", "prefiltered", "debug"),
]

GETTERS = {"get_xyz": "self._xyz", "get_opacity": "self.opacity_activation(self._opacity)"}

SIZED = "scale_modifier"  # 1 is its neutral value
FLAGS = """
def report(scene, iteration):
    scene.save(iteration)


def read_flags(parser):
    for name in "--model_path", "--checkpoint_iterations", "--start_checkpoint":
        parser.add_argument(name)
    return parser.parse_args()
"""
"""What a training script must have besides."""

MODEL = {
    "__init__": "sh_degree",
    "capture": "",
    "restore": "model_args, training_args",
    "training_setup": "training_args",
    "update_learning_rate": "iteration",
    "save_ply": "path",
    "load_ply": "path",
    "reset_opacity": "",
    "oneupSHdegree": "",
    "_prune_optimizer": "mask",
    "cat_tensors_to_optimizer": "tensors_dict",
    "densify_and_clone": "grads, grad_threshold, scene_extent",
    "densify_and_split": "grads, grad_threshold, scene_extent, N=2",
    "densify_and_prune": "max_grad, min_opacity, extent, max_screen_size",
}

STATES = ("mid-July 2023", "late July 2023", "October 2023", "August 2024", "October 2024")


GROUPS = ("xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation")


def skeleton(
    root: Path,
    state: str = "October 2023",
    *,
    settings: Sequence[str] = (),
    arguments: Sequence[str] = (),
    outputs: int | None = None,
    package: str = "diff_gaussian_rasterization",
    functions: Sequence[str] = ("render",),
    groups: Sequence[str] = GROUPS,
    **methods: str | None,
) -> HostRepo:
    """One public state of vanilla 3DGS, or what a host makes of it.

    Settings and arguments come after vanilla's; methods are added to the model's, changed or (None)
    dropped; ``functions`` draw, and so many ``outputs`` come back.
    """
    late, early = "2024" in state, state in STATES[:2]
    model = MODEL | {"load_ply": "path, use_train_test_exp=False"} if late else MODEL
    model = {name: args for name, args in (model | methods).items() if args is not None}
    passed = SETTINGS[: -1 if state == "mid-July 2023" else None] + ["antialiasing"] * late
    parameters = "viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0"
    if state == "October 2024":
        parameters += ", separate_sh=False"
    given = "".join(f", {name}=0" for name in arguments)
    values = ", ".join(f"value{n}" for n in range(outputs or 2 + late))
    bodies = {"training_setup": str([{"params": [], "name": name} for name in groups])}
    files = {
        "arguments/__init__.py": "class OptimizationParams:\n"
        "    def __init__(self, parser):\n        self.iterations = 12_345\n"
        + ("" if early else "        self.random_background = False\n"),
        "scene/__init__.py": "from scene.gaussian_model import GaussianModel\n\n\n"
        "class Scene:\n    def __init__(self, args, gaussians): ...\n\n"
        "    def save(self, iteration): ...\n",
        "scene/gaussian_model.py": "class GaussianModel:\n"
        + "\n".join(
            f"    def {name}({', '.join(filter(None, ['self', args]))}): {bodies.get(name, '...')}"
            for name, args in model.items()
        )
        + "".join(
            f"\n    @property\n    def {name}(self): return {value}"
            for name, value in GETTERS.items()
        ),
        "gaussian_renderer/__init__.py": f"from {package} import GaussianRasterizationSettings, "
        "GaussianRasterizer\n\n\n"
        + "".join(
            f"def {function}({parameters}, override_color=None):\n"
            "    s = GaussianRasterizationSettings("
            f"{', '.join(f'{name}={int(name == SIZED)}' for name in [*passed, *settings])})\n"
            "    rasterizer = GaussianRasterizer(raster_settings=s)\n"
            f"    {values} = rasterizer(means3D=1{given})\n"
            for function in functions
        ),
        "train.py": "from gaussian_renderer import render\n" + FLAGS,
    }
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return HostRepo(root)
