"""A fork of the demo's host: other groups, optimizers, names and values back; depth in the loss."""

from pathlib import Path

from fragprune_plugins.testing import Host
from miniatures.forks import KERNEL
from miniatures.runs import edit

MODEL, RENDERER = "scene/gaussian_model.py", "gaussian_renderer/__init__.py"
GROUPS = """
        groups = [
            {"params": [self._opacity], "lr": training_args.opacity_lr, "name": "opacity"},
            {"params": [self._xyz], "lr": rates["xyz"][1], "name": "xyz"},
            {"params": [self._features_dc], "lr": training_args.feature_lr, "name": "f_dc"},
            {"params": [self._features_rest], "lr": rates["f_rest"][1], "name": "f_rest"},
            {"params": [self._scaling], "lr": training_args.scaling_lr, "name": "scaling"},
            {"params": [self._rotation], "lr": training_args.rotation_lr, "name": "rotation"},
        ]
        self.tone = torch.nn.Parameter(torch.zeros(1))
        self.tones = torch.optim.Adam([self.tone], lr=0.1)
"""
LOSS = "        loss = (1 - opt.lambda_dssim) * l1_loss(image, truth)\n"
SUMS = "D += depths[collected_id[j]] * alpha * T; out_depth[pix_id] = D;"
RETURNED = '        "radii": radii,\n        "depth": depth,\n        "touched": touched,\n'


class ForkHost(Host):
    """The fork, with a vendored kernel that says what depth is."""

    def write(self, root: Path) -> None:
        """Write the fork into an empty folder."""
        super().write(root)
        model, train = root / MODEL, root / "train.py"
        comprehension = next(x for x in model.read_text().splitlines() if "groups = [{" in x)
        edit(model, f"{comprehension}\n", GROUPS.removeprefix("\n"))
        edit(root / RENDERER, "image, radii = ", "image, depth, radii, touched = ")
        edit(root / RENDERER, '        "radii": radii,\n', RETURNED)
        edit(train, LOSS, f'{LOSS}        loss = loss + 0.01 * package["depth"].mean()\n')
        package = root / "submodules/a/diff_gaussian_rasterization"
        package.mkdir(parents=True)
        (package / "__init__.py").write_text("")
        (package.parent / "forward.cu").write_text(KERNEL.replace("SUMS", SUMS))
        train.rename(root / "train_scene.py")
