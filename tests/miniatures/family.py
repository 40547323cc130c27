"""What miniatures of the family share: the demo's host, otherwise where a descendant says so."""

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch

from fragprune_plugins.testing.host import Host
from fragprune_plugins.testing.rewriting import Changes, changed, rewrite, without

RENDERER, MODEL = "gaussian_renderer/__init__.py", "scene/gaussian_model.py"
TRAIN, OPTIONS, SCENE = "train.py", "arguments/__init__.py", "scene/__init__.py"
DRAWN = "    image, radii = GaussianRasterizer(raster_settings=settings)(\n"
PARSE = "    args = parser.parse_args()\n"
BACKWARD = "        loss.backward()\n"
STEP = "            if iteration < opt.iterations:\n"
RADII = '        "radii": radii,\n'
NEW_ROWS = "new_scaling, new_rotation\n    ):\n"
ANEW = """        self._reset_statistics()
        self.max_radii2D = torch.zeros(self.get_xyz.shape[0], device="cuda")
"""


def adding(passage: str, *, before: str = "", after: str = "") -> tuple[str, str]:
    """The change that keeps a passage, and puts text before or after it."""
    return passage, before + passage + after


def parsing(*flags: str) -> tuple[str, str]:
    """The change of a script that adds flags, given as ``add_argument`` takes them."""
    return adding(PARSE, before="".join(f"    parser.add_argument({flag})\n" for flag in flags))


class Timed:
    """A view and its moment, by the name that the host has for it; every use may be a copy."""

    def __init__(self, camera, **moment):
        vars(self).update(vars(camera) | moment)

    def cuda(self):
        return copy.deepcopy(self)


class Growth:
    """Density control of models with other tensors than vanilla: rows of all in the optimizer."""

    def _children(self, chosen, copies):
        rows = chosen.nonzero()[:, 0].repeat(copies)
        groups = [group for group in self.optimizer.param_groups if len(group["params"]) == 1]
        return {group["name"]: group["params"][0][rows] for group in groups}

    def _append(self, new):
        self._adopt(self.cat_tensors_to_optimizer(new))
        self._reset_statistics()
        self.max_radii2D = torch.zeros(len(self.get_xyz))

    def densify_and_clone(self, grads, grad_threshold, scene_extent, *_):
        chosen = self._needy(grads, grad_threshold, scene_extent, large=False)
        self._append(self._children(chosen, 1))

    def densify_and_split(self, grads, grad_threshold, scene_extent, N=2):
        chosen = self._needy(grads, grad_threshold, scene_extent, large=True)
        new = self._children(chosen, N)
        spread = new["scaling"].exp()
        new["xyz"] = new["xyz"] + torch.normal(torch.zeros_like(spread), spread)
        new["scaling"] = new["scaling"] - 0.47
        self._append(new)
        children = torch.zeros(len(spread), dtype=torch.bool)
        self.prune_points(torch.cat((chosen, children)))


class Derived(Host):
    """A host written from its differences.

    Attributes:
        options: further options, by the title of their group.
        flags: further flags of ``train.py``, as ``add_argument`` takes them.
        settings: names of what ``render`` takes besides, and passes to the rasterizer's settings.
        values: names of what the rasterizer returns after the radii; ``render`` hands them on.
        cuts: the text of a file from one passage up to another (or its end), and what replaces it.
        changes: passages of files, and what replaces them.
        functions: put into ``train.py``, where changes call them.
        added: methods of GaussianModel, as ``rewrite`` takes them, one class after another.
        files: whole files by their paths.
        gone: names of functions and methods that the host does not have, by file.
    """

    options: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    flags: ClassVar[Sequence[str]] = ()
    settings: ClassVar[Mapping[str, Any]] = {}
    values: ClassVar[Sequence[str]] = ()
    cuts: ClassVar[Mapping[str, tuple[str, str, str]]] = {}
    changes: ClassVar[Mapping[str, Changes]] = {}
    functions: ClassVar[Sequence[Callable[..., Any]]] = ()
    added: ClassVar[Sequence[type]] = ()
    files: ClassVar[Mapping[str, str]] = {}
    gone: ClassVar[Mapping[str, Sequence[str]]] = {}

    def write(self, root: Path) -> None:
        """The demo's host, changed."""
        super().write(root)
        for name, functions in self.gone.items():
            (root / name).write_text(without((root / name).read_text(), functions))
        for name, (first, next_, new) in self.cuts.items():
            text = (root / name).read_text()
            begin, end = text.index(first), text.index(next_) if next_ else len(text)
            (root / name).write_text(text[:begin] + new + text[end:])
        rewrite(root, self._usual())
        rewrite(root, self.changes)
        for each in self.added:
            rewrite(root, {}, each)
        insert(root / TRAIN, *self.functions)
        for name, text in self.files.items():
            file = root / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)

    def _usual(self) -> dict[str, Changes]:
        """The changes that most descendants make, by file."""
        options = [
            adding(
                f'        super().__init__(parser, "{title}"',
                before="".join(f"        self.{name} = {value!r}\n" for name, value in own.items()),
            )
            for title, own in self.options.items()
        ]
        taken = "".join(f"    {name}={value!r},\n" for name, value in self.settings.items())
        passed = "".join(f"        {name}={name},\n" for name in self.settings)
        renderer = [
            adding("    override_color=None,\n", after=taken),
            adding("debug=pipe.debug,\n", after=passed),
        ]
        if self.values:
            call = (
                "    rasterizer = GaussianRasterizer(raster_settings=settings)\n"
                f"    image, radii, {', '.join(self.values)} = rasterizer(\n"
            )
            returned = "".join(f'        "{name}": {name},\n' for name in self.values)
            renderer += [(DRAWN, call), adding(RADII, after=returned)]
        return {OPTIONS: options, TRAIN: [parsing(*self.flags)], RENDERER: renderer}


def insert(script: Path, *functions: Callable[..., Any]) -> None:
    """Put functions before a script's main part."""
    own = "".join(inspect.getsource(each) + "\n\n" for each in functions)
    script.write_text(changed(script.read_text(), [adding("if __name__", before=own)]))
