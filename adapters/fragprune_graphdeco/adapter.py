"""The base adapter: model seams, param groups, row order, files, rasterizer call."""

from __future__ import annotations

import ast
import contextlib
import logging
import re
from argparse import ArgumentParser
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from fragprune_graphdeco import failing, photographs, reading
from fragprune_graphdeco.call import CallInSource, RasterizerCall, drawing_functions, read_calls
from fragprune_graphdeco.drawing import Drawing, arguments, given_to, pictures
from fragprune_graphdeco.kernels import SPLAT, Kernel, read_kernels, vendored
from fragprune_graphdeco.reading import mentions, module_of
from fragprune_graphdeco.syntax import assigned, entries, every, skipped, text_of
from fragprune_plugins.adapting import (
    CHECKPOINT_KEY,
    GROUPS,
    WIDEST,
    CommandLine,
    Dialect,
    Finding,
    Function,
    HostCall,
    HostRepo,
    NotComparedError,
    Photographs,
    Prover,
    RasterInputs,
    Resolution,
    Role,
    ScriptAdapter,
    Seam,
    SeamCall,
    Splats,
    UsageError,
    View,
    replacing,
)

if TYPE_CHECKING:
    from torch import Tensor

    from fragprune_plugins.adapting import Model, RasterOutputs

MODEL, RENDERER = reading.MODEL, "gaussian_renderer"
CAMERAS = "utils.camera_utils"


def optimizers(call: SeamCall) -> list[Any]:
    """All of the model's, the main one first."""
    main = call.model.optimizer
    own = [each for each in vars(call.model).values() if hasattr(each, "param_groups")]
    return [main, *(each for each in own if each is not main)]


def no_noise(call: SeamCall) -> float:
    """A rate of 0: hosts multiply the noise that they add to positions by it."""
    return 0.0


def completed(call: SeamCall) -> Any:
    """Add the scene's extent, from the new model, to a checkpoint made from a PLY."""
    *rest, spatial_lr_scale = call.first
    return (*rest, spatial_lr_scale or call.model.spatial_lr_scale)


def model_seam(
    role: Role, method: str, *needs: str, how: Callable[[SeamCall], Any] | None = None
) -> Seam:
    """The seam at a method of the model."""
    return Seam(role, MODEL, f"GaussianModel.{method}", needs, how=how)


def rasterizer_seam(package: str, method: str = "forward") -> Seam:
    """The seam at a rasterizer of this family, or at another of its methods that draw."""
    needs = ("means3D", "means2D", "opacities")
    return Seam(Role.RASTERIZE, package, f"GaussianRasterizer.{method}", needs, external=True)


MODEL_SEAMS: tuple[Seam, ...] = (
    Seam(Role.SCENE, "scene", "Scene.__init__", ("args", "gaussians")),
    model_seam(Role.ATTACH, "training_setup", "training_args", how=optimizers),
    model_seam(Role.STEP, "update_learning_rate", "iteration"),
    model_seam(Role.KEEP, "_prune_optimizer", "mask"),
    model_seam(Role.APPEND, "cat_tensors_to_optimizer", "tensors_dict"),
    model_seam(Role.STILL, "densify_and_prune"),
    model_seam(Role.STILL, "reset_opacity"),
    model_seam(Role.STILL, "oneupSHdegree"),
    model_seam(Role.SAVE, "save_ply", "path"),
    model_seam(Role.LOAD, "load_ply", "path"),
    model_seam(Role.CAPTURE, "capture"),
    model_seam(Role.RESTORE, "restore", "model_args", "training_args", how=completed),
)


Value = TypeVar("Value", float, str)

SCREEN = 3  # columns of the tensor that gets the gradient on the screen


@cache
def warn_once(what: str) -> None:
    """Warn of something once."""
    logging.getLogger("fragprune").warning("%s", what)


@dataclass(frozen=True)
class GraphdecoDialect(Dialect):
    """The call of diff_gaussian_rasterization and its forks.

    Attributes:
        settings: field names of GaussianRasterizationSettings, as this revision passes them.
        outputs: number of values that the host unpacks.
    """

    otherwise: ClassVar[str] = ""
    """How the host's own rasterizer is known to draw otherwise than our engines."""
    returned: ClassVar[tuple[str, ...]] = ("image", "radii", "invdepth")
    """What the rasterizer returns, in order; for a name that ``made`` lacks it is None."""

    package: str
    settings: tuple[str, ...]
    outputs: int

    @property
    def prover(self) -> Prover:
        """Compares any rasterizer that takes these calls."""
        from fragprune_graphdeco.proof import RasterizerProver

        return RasterizerProver(self, self.otherwise)

    def unproved(self, repo: HostRepo) -> str:
        """Its picture, if the sources of the rasterizer are not vendored."""
        if repo.package:
            return super().unproved(repo)
        absent = f"its picture; the sources of {self.package} are not in the checkout"
        return "" if vendored(repo, self.package) else absent

    def values(self, call: HostCall) -> tuple[str, ...]:
        """What a call returns, by the names of ``returned``."""
        return self.returned[: self.outputs]

    def features(self, call: HostCall) -> Tensor | None:
        """(N, F) what is blended beside the colours: depth, if the call returns it."""
        view = call.settings.viewmatrix if "depth" in self.values(call) else None
        if view is None:
            return None
        z = call["means3D"] * view[:3, 2]  # no product of matrices, as in likeness
        depth: Tensor = z.sum(1, keepdim=True) + view[3, 2]
        return depth

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call. The host's matrices are already transposed for row vectors."""
        import torch

        s, values = call.settings, self.values(call)
        screen = call.get("means2D")
        if screen is not None and screen.shape[1] > SCREEN and not call.still:
            warn_once(
                f"means2D has {screen.shape[1]} columns: our engines give a gradient to its first "
                "two, so a densification that reads the others adds no Gaussian; only the host's "
                "own rasterizer computes them"
            )
        sh, dc = call.get("shs"), call.get("dc")
        if dc is not None:  # the accelerated rasterizer takes the constant band on its own
            sh = dc if sh is None else torch.cat([dc, sh], dim=1)
        return RasterInputs(
            view=View(
                width=int(s.image_width),
                height=int(s.image_height),
                tan_fov_x=float(s.tanfovx),
                tan_fov_y=float(s.tanfovy),
                viewmatrix=s.viewmatrix,
                projmatrix=s.projmatrix,
                campos=s.campos,
                background=s.bg,
            ),
            splats=Splats(
                means=call["means3D"],
                opacities=call["opacities"].reshape(-1),
                scales=call.get("scales"),
                rotations=call.get("rotations"),
                cov3d=call.get("cov3D_precomp"),
                sh=sh,
                colors=call.get("colors_precomp"),
                sh_degree=0 if sh is None else int(s.sh_degree),
                features=self.features(call),
            ),
            means2d_hook=screen,
            scale_modifier=float(s.scale_modifier),
            compensation="antialiasing" if getattr(s, "antialiasing", False) else "none",
            planes=tuple(name for name in ("invdepth", "alpha") if name in values),
            counts="count" in values,
            scores="weight" in values,
        )

    def made(self, outputs: RasterOutputs, call: HostCall) -> dict[str, Any]:
        """The values that a call may return, by name; numbers of each Gaussian are (P,).

        Depth is the sum of z alpha T, invdepth that of alpha T / z. Without gradients are depth,
        count (int32, drawn fragments), weight (sum of alpha T) and wins (pixels where it is
        largest).
        """
        depth, wins = outputs.features, outputs.wins_per_gaussian
        return {
            "image": outputs.image,
            "radii": outputs.radii,
            "invdepth": outputs.invdepth,
            "alpha": outputs.alpha,
            "depth": None if depth is None else depth[:1].detach(),
            "count": outputs.fragments_per_gaussian,
            "weight": outputs.weights_per_gaussian,
            "wins": None if wins is None else wins.float(),
        }

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Any, ...]:
        """The values that the call returns: colour (3, H, W), radii (P,) int32, and others."""
        made = self.made(outputs, call)
        return tuple(made.get(name) for name in self.values(call))

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs]
    ) -> Any:
        """Draw and pack."""
        return self.pack(draw(inputs), call)

    def names(self) -> frozenset[str]:
        """The import names of the rasterizer and simple_knn, without an import of torch."""
        return frozenset((self.package, "simple_knn", "simple_knn._C"))

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the rasterizer and simple_knn."""
        from fragprune_graphdeco import stand_ins

        rasterizer = stand_ins.rasterizer(self.package, self.settings, draw)
        return {self.package: rasterizer, **stand_ins.simple_knn()}


class GraphdecoAdapter(ScriptAdapter):
    """Base of these adapters; a subclass adds its name and the differences of its host.

    Attributes:
        package: import name of the rasterizer.
        calls: calls of the rasterizer that the dialect answers; each function makes one of them.
            The functions are those of the module that the first VIEW seam names.
        dialect_type: the dialect that answers them.
        drawn_from: attributes of the model, and arguments, from which its functions draw, besides
            those of 3DGS.
        own_names: names that only this host's source mentions, not its ancestors': "module:name",
            or a name in the module of the model.
        scripts: paths of training scripts in the checkout, the usual one first.
        optimizer: the host's, by its name in ``torch.optim``.
        beside: further optimizers that its scripts make, and whose values it restores.
        undrawn_flags: flags with which our readers draw other pictures.
        resumes_ply: a checkpoint that it can resume can be made from its PLY.
        flags: fields of ``CommandLine`` that differ from those of vanilla.
        checkpoints: how names of checkpoints begin, before the iteration; a regular expression.
        densifies_until: arguments with the iterations after which the host adds, relocates, prunes
            and resets no Gaussian; () if it does so to its end.
        filtered: its PLYs have a 3D filter, or flat Gaussians, by whose rules it draws them.
        undrawn: its models, if our readers cannot draw them, and how a user can; () if they can.
    """

    package = "diff_gaussian_rasterization"
    kernel: ClassVar[Kernel] = SPLAT
    """How the host's rasterizer draws; the sources of a vendored one are compared with it."""
    calls: tuple[RasterizerCall, ...] = (RasterizerCall(),)
    dialect_type: type[GraphdecoDialect] = GraphdecoDialect
    drawn_from: tuple[str, ...] = ()
    own_names: tuple[str, ...] = ()
    scripts: tuple[str, ...] = ("train.py",)
    optimizer = "Adam"
    beside: tuple[str, ...] = ()
    densifies_until: tuple[str, ...] = ("densify_until_iter",)
    filtered = False
    resumes_ply = True
    undrawn: tuple[str, ...] = ()
    undrawn_flags: tuple[str, ...] = ("--train_test_exp",)
    flags: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    checkpoints = "chkpnt"
    seams = (
        *MODEL_SEAMS,
        Seam(Role.LOSS, "torch", "Tensor.backward", external=True),
        Seam(Role.VIEW, RENDERER, "render", ("viewpoint_camera", "pc")),
        rasterizer_seam(package),
    )

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Check scripts and flags, the host's own names, the model, and the rasterizer."""
        missing = []
        for script in self.scripts_of(repo):
            missing += [] if (repo.root / script).is_file() else [f"no {script}"]
            made = reading.made_models(repo, module_of(script))
            if made and "GaussianModel" not in made:
                missing.append(f"{script} makes {', '.join(dict.fromkeys(made))}")
            rate = [] if self.steps_by_rendering or not made else ["update_learning_rate"]
            called = mentions(repo, [module_of(script)], rate)
            missing += [f"{script} calls no {each}" for each in rate if each not in called]
            own = [name for name, asked in self._optimizers(repo, script) if not asked]
            missing += [f"{script} does not resume what {each} trains" for each in own]
        both = (repo.function(MODEL, f"GaussianModel.{name}") for name in ("capture", "restore"))
        missing += filter(None, [reading.uneven(*both)])
        for module, _, name in (each.rpartition(":") for each in self.own_names):
            module = module or MODEL
            missing += [] if mentions(repo, [module], [name]) else [f"no {name} in {module}"]
        missing += failing.reasons(repo, self.scripts_of(repo))
        packages = dict.fromkeys([self.package, *(c.package for c in self.calls if c.package)])
        return [
            *self.other_host(repo, missing),
            *(each for name in packages for each in read_kernels(repo, name, self.kernel)),
            *reading.read_getters(repo),
            *(reading.read_flags(repo, self.command_line(repo)) if repo.tree(MODEL) else ()),
            *self._groups(repo),
            *self._calls(repo),
            *self._drawn(repo),
            *(
                Finding("warning", "script", name, f"{name}, which is not served: {why}")
                for name, why in self.unserved(repo).items()
            ),
        ]

    def unserved(self, repo: HostRepo) -> dict[str, str]:
        """Scripts of a checkout that train and are not served, with the reason for each."""
        trains = () if self.installed else reading.training_scripts(repo)
        others = [each for each in trains if each not in self.command_line(repo).scripts]
        return dict.fromkeys(others, f"{self.info.title} has no such script")

    def trainer(self, repo: HostRepo, script: Path) -> GraphdecoAdapter:
        """This adapter.

        Raises:
            UsageError: the script trains and is not served.
        """
        others = self.unserved(repo)
        for name, why in others.items():
            if script.resolve() == (repo.root / name).resolve():
                usual = (each for each in self.command_line(repo).scripts if each not in others)
                served = f"a script that is served: {', '.join(usual)}"
                raise UsageError(name, why, served, "Prune its PLY: fragprune finetune.")
        return self

    def _optimizers(self, repo: HostRepo, script: str) -> Iterator[tuple[str, frozenset[str]]]:
        """Further optimizers that a script makes, and the options, if any, that ask for each."""
        tree, modules = repo.tree(module_of(script)), ("arguments", module_of(script))
        known = reading.as_options(repo, modules)
        gone = skipped(tree, known)
        for name, value in ((text_of(to), value) for to, value in assigned(tree)):
            found = reading.OPTIMIZER.match(text_of(value)) and name not in self.beside
            if found and name.isidentifier():
                asked = reading.options_of(gone[value], known) if value in gone else frozenset()
                yield name, asked

    def _drawn(self, repo: HostRepo) -> list[Finding]:
        """An error for each input of the rasterizer that is made of other values."""
        module, accepted = self._accepted()
        values = ", ".join(("the values of 3DGS", *self.drawn_from))
        found, scripts = [], map(module_of, self.scripts_of(repo))
        trees = reading.reached(repo, scripts, RENDERER).values()
        calls = [each for tree in trees for each in every(tree, ast.Call)]
        names = dict.fromkeys(each.function for each in accepted)
        for name, body in ((name, repo.function(module, name)) for name in names):
            if body is None:
                continue
            on = given_to(body, calls) if self.dialect_type.rows_drawn is Dialect.rows_drawn else ()
            for call in (each for each in every(body, ast.Call) if on and arguments(each)):
                chosen = Drawing(repo, module, body, self.drawn_from, call, on).selected()
                found += [(name, each, "all rows") for each in chosen]
            drawn = Drawing(repo, module, body, self.drawn_from)
            found += [(name, reason, f"a drawing of {values}") for reason, _ in drawn.inputs()]
            cuts = [f"a picture of more channels, {text_of(each)}" for each in drawn.cuts()]
            found += [(name, each, "a picture") for each in cuts[:1]]
            returned = (each.value for each in every(body, ast.Return))
            if any(isinstance(each, ast.Dict) and not pictures(each) for each in returned):
                found.append((name, "it returns no render", "the picture under this name"))
        return [Finding.error("drawn-values", f"{module}:{name}", *each) for name, *each in found]

    def _groups(self, repo: HostRepo) -> list[Finding]:
        """An error if the source spells out other param groups."""
        setup = "GaussianModel.training_setup"
        found = group_names(repo.function(MODEL, setup))
        known = tuple(group.name for group in self.groups if group.named)
        if found in ((), known):
            return []
        at, expected = f"{MODEL}:{setup} ({repo.place(MODEL, setup)})", ", ".join(known)
        return [Finding.error("param-groups", at, ", ".join(found), expected)]

    def _calls(self, repo: HostRepo) -> list[Finding]:
        """An error for each call of the rasterizer that is not in ``calls``."""
        renderer, accepted = self._accepted()
        functions = dict.fromkeys(each.function for each in accepted)
        there = [each for each in functions if repo.function(renderer, each)]  # or no seam
        found = []
        for name in dict.fromkeys([*there, *drawing_functions(repo, renderer)]):
            known = [str(each) for each in accepted if each.function == name]
            expected = " or ".join(known) or f"a rasterizer in {', '.join(functions)} alone"
            calls, others = read_calls(repo, renderer, name), []
            for each in calls:
                own = each.package == self.package
                call = replace(each, package="") if own else each
                if call.other_matrix or not any(known.answers(call) for known in accepted):
                    others.append((repo.at(renderer, each.line), str(call)))
            if not calls:
                nothing = "no settings passed by keyword, or they are made elsewhere"
                others.append((repo.place(renderer, name), nothing))
            for at, what in others:
                place = f"{renderer}:{name} ({at})"
                found.append(Finding.error("rasterizer-call", place, what, expected))
        return found

    def _accepted(self) -> tuple[str, list[RasterizerCall]]:
        """The module whose functions draw, and ``calls`` with the function that makes each.

        The first VIEW seam names the module, and the function of calls that name none.
        """
        view = next(seam for seam in self.seams if seam.role is Role.VIEW)
        calls = [replace(each, function=each.function or view.attribute) for each in self.calls]
        return view.module, calls

    def other_host(self, repo: HostRepo, found: list[str]) -> list[Finding]:
        """One error with all differences from this host, if there are any."""
        at, expected = str(repo.root), f"a {self.info.title} checkout"
        return [Finding.error("other-host", at, ", ".join(found), expected)] if found else []

    def dialect(self, repo: HostRepo) -> GraphdecoDialect:
        """The dialect for the arguments and outputs of the first of ``calls`` in the source."""
        call = self._first_call(repo)
        settings, outputs = (call.settings, call.outputs) if call else ((), None)
        return self.dialect_type(self.package, settings, outputs or 2)

    def _first_call(self, repo: HostRepo) -> CallInSource | None:
        """The first of ``calls`` in the source."""
        renderer, accepted = self._accepted()
        return next(iter(read_calls(repo, renderer, accepted[0].function)), None)

    def scripts_of(self, repo: HostRepo) -> tuple[str, ...]:
        """``scripts``; where a checkout has none of them, its own that train one GaussianModel."""
        if any((repo.root / name).is_file() for name in self.scripts):
            return self.scripts
        trains = reading.training_scripts(repo)
        one = (each for each in trains if len(repo.calls(module_of(each), "GaussianModel")) == 1)
        return tuple(one) or self.scripts

    def command_line(self, repo: HostRepo) -> CommandLine:
        """The flags of ``train.py``, with the source's default of iterations."""
        line = CommandLine(
            scripts=self.scripts_of(repo),
            iterations="--iterations",
            output=("-m", "--model_path"),
            source=("-s", "--source_path"),
            save_checkpoints="--checkpoint_iterations",
            resume="--start_checkpoint",
            default_iterations=int(default(repo, "iterations", 30_000)),
            skipped=1,
            resolution=("-r", "--resolution"),
            images=("-i", "--images"),
            white_background=("-w", "--white_background"),
            hold_out=("--eval",),
            in_full=partial(reading.in_full, repo),
        )
        return replace(line, **self.flags)

    def options(self, repo: HostRepo) -> frozenset[str]:
        """Options, off by default, under which its scripts do otherwise than was read, but for
        that of a file which is read too.
        """
        line = self.command_line(repo)
        further = [asked for each in line.scripts for _, asked in self._optimizers(repo, each)]
        sets = (failing.overruling(repo, module_of(each)) for each in line.scripts)
        known = {line.config.flag.strip("-")} if line.config else set()
        return frozenset().union(*sets, *further) - known

    def refuse(self, repo: HostRepo, arguments: list[str], *, stage: str, device: str) -> None:
        """Refuse an option under which scripts do otherwise than was read, by UsageError."""
        parser = ArgumentParser(add_help=False, allow_abbrev=False)
        for name in self.options(repo):
            parser.add_argument(f"--{name}", nargs="?", const="", action="append")
        given, scripts = (
            vars(parser.parse_known_args(arguments)[0]),
            self.command_line(repo).scripts,
        )
        modules = ("arguments", *map(module_of, scripts))
        for name, values in ((name, values) for name, values in given.items() if values):
            known = reading.by_default_of(repo, modules, name)
            if any([value] != [*map(str, known)] for value in values):
                raise UsageError(
                    f"--{name}",
                    "other draws, values of the rasterizer, changes of the model, or options",
                    f"what was read of {', '.join(scripts)}, without it",
                    "Leave it out, or prune its PLY: fragprune finetune.",
                )

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """The latest of those of ``densifies_until`` that the source has, with its defaults."""
        values = self.numbers(repo, script, arguments, self.densifies_until)
        return max(map(max, values.values())) if values else None

    def numbers(
        self, repo: HostRepo, script: Path, arguments: list[str], names: Iterable[str]
    ) -> dict[str, list[int]]:
        """Numbers of a command, of those arguments that the source has, or UsageError."""
        defaults = {name: numbers(repo, script, name) for name in names}
        known = {name: default for name, default in defaults.items() if default}
        options = {name: {"type": int, "nargs": "+", "default": known[name]} for name in known}
        flags = {name: ((f"--{name}",), options[name]) for name in known}
        found = self.command_line(repo).parsed(arguments, flags)
        lists = ((name, found[name]) for name in known)
        return {name: each if isinstance(each, list) else [each] for name, each in lists}

    def means(self, model: Any) -> Tensor:
        """``get_xyz`` returns the parameter object itself."""
        means: Tensor = model.get_xyz
        return means

    def opacities(self, model: Any) -> Tensor:
        """(N,) after the sigmoid."""
        opacities: Tensor = model.get_opacity
        return opacities.detach().reshape(-1)

    def view(self, camera: Any) -> Hashable:
        """Number, name and width, because some hosts make or copy cameras for every step."""
        known = [getattr(camera, each, None) for each in ("uid", "image_name", "image_width")]
        return super().view(camera) if None in known else " ".join(map(str, known))

    def read_model(self, ply: Path) -> Model:
        """The host's own PLY."""
        from fragprune_plugins.adapting import read_ply

        return read_ply(ply, filtered=self.filtered)

    def checkpoint_from_ply(self, ply: Path, iteration: int, target: Path) -> None:
        """Write the tuple of ``captured``."""
        import torch

        if not self.resumes_ply:
            return super().checkpoint_from_ply(ply, iteration, target)
        capture = self.captured(ply)
        with replacing(target) as temporary:
            torch.save((capture, iteration), temporary)

    def captured(self, ply: Path) -> tuple[Any, ...]:
        """The host's ``capture`` of a PLY: fresh moments, and the file's thresholds."""
        import torch

        from fragprune_plugins.adapting import thresholds_of

        m = self.read_model(ply)
        rows, names = len(m.xyz), [group.name for group in GROUPS]
        values = (m.xyz, m.f_dc, m.f_rest, m.opacity, m.scaling, m.rotation)
        parameters = {k: torch.nn.Parameter(v) for k, v in zip(names, values, strict=True)}
        groups = [{"params": [p], "lr": 0.0, "name": name} for name, p in parameters.items()]
        optimizer = getattr(torch.optim, self.optimizer)(groups, lr=0.0, eps=1e-15)
        state: dict[str, Any] = optimizer.state_dict()
        if (store := thresholds_of(ply, rows)) is not None:
            state[CHECKPOINT_KEY] = store.state_dict()
        return (
            m.sh_degree,
            *(parameters[k] for k in ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")),
            torch.zeros(rows),
            torch.zeros(rows, 1),
            torch.zeros(rows, 1),
            state,
            0.0,
        )

    def photographs(self, repo: HostRepo, arguments: list[str]) -> Photographs:
        """The command's photographs, some of which it holds out with ``--eval``."""
        line = self.command_line(repo)
        flags = line.read(arguments)
        source = Path(flags.source or "")
        return Photographs(
            source,
            resolution(repo, flags.resolution),
            bool(flags.white_background or default(repo, "_white_background", False)),
            flags.images or default(repo, "_images", "images"),
            centred=_centred(repo) or None,
            opaque=_opaque(repo, source),
            held_out=bool(flags.hold_out or default(repo, "eval", False)) or not line.hold_out,
        )

    def not_drawn(self, repo: HostRepo, arguments: list[str]) -> list[str]:
        """What of a command our readers would draw otherwise, or compare with photographs."""
        flags = (flag for flag in self.undrawn_flags if flag in arguments)
        projection = repo.function("utils.graphics_utils", "getProjectionMatrix")
        pinhole = projection is None or "[3, 2]" in text_of(projection)
        other = [] if pinhole else ["its getProjectionMatrix, which is no pinhole camera's"]
        if not self.installed:  # whose folder holds all other packages
            why = photographs.unlike(repo, map(module_of, self.scripts_of(repo)))
            other += [why] * (why not in ("", photographs.NOT_FOUND))
        return [f"{flag}, which our readers do not support" for flag in flags] + other

    def drawing(self, repo: HostRepo, arguments: list[str]) -> dict[str, Any]:
        """Vanilla's rules, with the compensation for antialiasing if the command asks for it."""
        if self.undrawn:
            found, remedy = self.undrawn
            raise NotComparedError(self.info.title, found, "models that we can draw", remedy)
        for found in self.not_drawn(repo, arguments):
            expected = "pictures as the host draws them"
            remedy = "Draw and measure with the host's render.py and metrics.py."
            raise NotComparedError("the host's command", found, expected, remedy)
        return {"compensation": "antialiasing"} if self._compensated(repo, arguments) else {}

    def _compensated(self, repo: HostRepo, arguments: list[str]) -> bool:
        """Whether the rasterizer is told to compensate, by an option or always."""
        call = self._first_call(repo)
        told = call.given.get("antialiasing") if call else None
        if isinstance(told, ast.Attribute):
            return f"--{told.attr}" in arguments or bool(default(repo, told.attr, False))
        return bool(getattr(told, "value", False))

    def model_file(self, output: Path, iteration: int) -> Path:
        """The path to which ``scene.save`` writes."""
        return output / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"

    def saved_iterations(self, output: Path) -> list[tuple[int, Path]]:
        """Checkpoints and PLYs. A host writes a checkpoint after the PLY of its iteration."""
        plys = output.glob("point_cloud/iteration_*/point_cloud.ply")
        names = {path: ("iteration_", path.parent.name) for path in plys}
        names |= {path: (self.checkpoints, path.stem) for path in output.glob("*.pth")}
        found = [
            (path.stat().st_mtime_ns, int(number[1]), path.suffix == ".pth", path)
            for path, (begins, name) in names.items()
            if (number := re.fullmatch(rf"(?:{begins})(\d+)", name))
        ]
        return [(iteration, path) for _, iteration, _, path in sorted(found)]


def _centred(repo: HostRepo) -> bool:
    """Whether cameras get their projection of two planes and two angles, around the middle."""
    usual, calls = "getProjectionMatrix", every(repo.tree("scene.cameras"), ast.Call)
    made = [each for each in calls if getattr(each.func, "id", "").startswith(usual)]
    return all(text_of(c.func) == usual and len(c.args) + len(c.keywords) == 4 for c in made)


def _opaque(repo: HostRepo, scene: Path) -> bool:
    """Whether alpha channels are dropped: of COLMAP's images; of Blender's if loadCam opens them.

    Readers of Blender's scenes composite images, but not those that loadCam opens once more.
    """
    code = text_of(repo.tree(CAMERAS))
    read = "Image.open(" in code or not (scene / "transforms_train.json").exists()
    return read and "shape[0] == 4" not in code


def group_names(function: Function | None) -> tuple[str, ...]:
    """Names of the param groups that a function spells out as dicts, in source order."""
    named = (each for each in entries(function, "name") if isinstance(each, ast.Constant))
    ordered = sorted(named, key=lambda each: (each.lineno, each.col_offset))
    return tuple(str(each.value) for each in ordered)


def resolution(repo: HostRepo, asked: int | None) -> Resolution:
    """The resolution for the host's ``-r``: a divisor, at most 1,600 pixels, or a width.

    NotComparedError if the host chooses sizes in another way.
    """
    tree = repo.tree(CAMERAS)
    divisors = {
        element.value
        for node in every(tree, ast.Compare)
        if isinstance(node.ops[0], ast.In)
        and isinstance(node.left, ast.Attribute)
        and node.left.attr == "resolution"
        and isinstance(node.comparators[0], ast.List | ast.Tuple)
        for element in node.comparators[0].elts
        if isinstance(element, ast.Constant) and isinstance(element.value, int)
    }
    capped = any(node.value == WIDEST for node in every(tree, ast.Constant))
    value = int(default(repo, "_resolution", -1)) if asked is None else asked
    if not divisors or not capped or (value < 1 and value != -1):
        where = f"-r {value}" if divisors and capped else repo.place(CAMERAS, "loadCam")
        found = "an image size that our readers cannot reproduce"
        expected = f"a divisor, a width, or -1: at most {WIDEST} pixels wide, as vanilla has it"
        remedy = "Measure with fragprune compare --resolution, or with the host's own metrics.py."
        raise NotComparedError(where, found, expected, remedy)
    return Resolution.asked(value, divisors)


def default(repo: HostRepo, name: str, otherwise: Value) -> Value:
    """A number or text that an argument group assigns to ``self.name``; else ``otherwise``."""
    kinds = (str,) if isinstance(otherwise, str) else (int, float)
    values = (getattr(each, "value", None) for each in reading.defaults(repo, "arguments", name))
    return next((each for each in values if isinstance(each, kinds)), otherwise)


def numbers(repo: HostRepo, script: Path, name: str) -> list[int]:
    """The default of an argument, of an argument group or of the script; [] without one."""
    module = ".".join(script.relative_to(repo.root).with_suffix("").parts)
    read: list[list[int]] = []
    for each in (*reading.defaults(repo, "arguments", name), *reading.defaults(repo, module, name)):
        with contextlib.suppress(ValueError, TypeError):
            value = ast.literal_eval(each)
            read.append([int(each) for each in (value if isinstance(value, list) else [value])])
    return next(filter(any, read), read[0] if read else [])  # a group's 0 leaves it to the script
