"""graphdeco-inria/gaussian-splatting and its forks: the adapter of forks that have no other one.

What it needs it reads from the checkout (``read``). It serves a fork whose model is plain 3DGS: the
parameters' own activations are drawn, by the known kernel. Values that a rasterizer returns besides
are made if their kernel was read; those that nobody reads raise if they are read after all.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

import fragprune_graphdeco as graphdeco
from fragprune_3dgs_fork.draws import HANDED
from fragprune_3dgs_fork.fork import CHECKPOINT, CLASS, MODEL, RENDERER, Fork
from fragprune_3dgs_fork.methods import plain_distances, read_getters, rests_after_densification
from fragprune_3dgs_fork.rasterizer import POSES, Output
from fragprune_3dgs_fork.read import read_fork
from fragprune_graphdeco import (
    SCREEN,
    GraphdecoAdapter,
    GraphdecoDialect,
    kernels,
    plain,
    reading,
    warn_once,
)
from fragprune_plugins.adapting import (
    NEAR,
    CommandLine,
    EngineError,
    Finding,
    HostCall,
    HostInfo,
    HostRepo,
    RasterInputs,
    RasterOutputs,
    Role,
    Seam,
    SeamCall,
    UsageError,
)

if TYPE_CHECKING:
    from torch import Tensor

CHANNELS = 7
"""That are blended beside the colours in one rasterization: engines blend 8, a proof adds one."""


class Unread:
    """In place of a value that the host was seen not to read, or that a proof must tell.

    A proof may let one be that is not read, whatever it is.
    """

    def __init__(self, name: str, unread: bool = True) -> None:
        self.__dict__ |= {"name": name, "unread": unread}

    def _raise(self, *_: Any, **__: Any) -> NoReturn:
        raise EngineError(
            f"the rasterizer's value {self.__dict__['name']}",
            "read by the host, and its meaning is unknown",
            "a picture, radii, and values whose kernel was read or whose numbers were proved",
            "Train where the host's own rasterizer is compiled, or prune its PLY: "
            "fragprune finetune.",
        )

    def __getattr__(self, name: str) -> Any:
        return (lambda *_: self) if name in HANDED else self._raise()

    __getitem__ = __len__ = __iter__ = __bool__ = __float__ = __array__ = _raise
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = _raise
    __rtruediv__ = __lt__ = __le__ = __gt__ = __ge__ = __neg__ = __pow__ = __matmul__ = _raise

    @classmethod
    def __torch_function__(
        cls, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> NoReturn:
        named = (each for each in args if isinstance(each, cls))
        next(named, cls("in a list of tensors"))._raise()


def plane_depth(channels: Tensor, settings: Any) -> Tensor:
    """(1, H, W) depth at which each pixel's ray meets its plane, 0 where nothing is drawn.

    There, the gradient of PGSR's kernel is infinite. No fragment of its own reads it, but
    fragments just beyond a threshold would. Of the channels (5 or more, H, W) the first three are
    the normal in view space, the fifth is the distance.
    """
    import torch

    (height, width), like = channels.shape[1:], channels.device
    x = (torch.arange(width, device=like) - width / 2) * (2 * settings.tanfovx / width)
    y = (torch.arange(height, device=like) - height / 2) * (2 * settings.tanfovy / height)
    facing = channels[0] * x + channels[1] * y[:, None] + channels[2] + 1e-8
    drawn = (channels != 0).any(0)
    return torch.where(drawn, channels[4] / -torch.where(drawn, facing, 1.0), 0.0)[None]


@dataclass(frozen=True)
class ForkDialect(GraphdecoDialect):
    """The calls of a fork, with the values back that its source names."""

    fork: Fork = field(kw_only=True)

    def unpack(self, call: HostCall) -> RasterInputs:
        """Translate the call; depth and objects are further channels, with their gradients.

        Raises:
            EngineError: a setting is not neutral, or the host reads gradients that our engines do
                not compute.
        """
        import torch

        if not call.still and call["means2D"].shape[1] > SCREEN:
            self._refuse("means2D", "absolute screen gradients", "three columns, or stage 2")
        fork, near = self.fork, kernels.near(self.fork.repo, call.entry.split(":")[0])
        inputs = replace(super().unpack(call), near=NEAR if near is None else near)
        confidence = getattr(call.settings, "confidence", None)
        if confidence is not None and not bool((confidence == 1).all()):
            self._refuse("confidence", "values other than 1", "1 everywhere, which changes nothing")
        self.expect_off(call)
        trained = not call.still and torch.is_grad_enabled()
        for name, value in ((each, call.get(each)) for each in sorted(POSES)):
            if value is not None and (value.any() or (trained and value.requires_grad)):
                self._refuse(name, "a camera's gradients", "cameras that stand still, or stage 2")
        if call.still:
            return inputs
        if fork.scaled:
            warn_once(
                f"{', '.join(sorted(fork.scaled))}: the gradient on the screen is not changed by "
                "it here, so other Gaussians are densified than by the host's own rasterizer"
            )
        if fork.screens:
            warn_once(
                f"{', '.join(sorted(fork.screens))}: gets no gradient here, and a densification "
                "that reads it fails; only the host's own rasterizer computes it"
            )
        return inputs

    def expect_off(self, call: HostCall) -> None:
        """Refuse a call with a value where the source has None or False by default."""
        for name in sorted(self.fork.off):
            value = getattr(call.settings, name, call.arguments.get(name))
            empty = getattr(value, "shape", ())[:1] == (0,)
            if not (value is None or value is False or empty):
                self._refuse(name, "a value", "None or False, which changes nothing")

    def features(self, call: HostCall) -> Tensor | None:
        """(N, F) the first of the channels that are blended beside the colours."""
        return self._channels(call)[0]

    def _channels(self, call: HostCall) -> tuple[Tensor | None, Tensor | None]:
        """(N, F) depth and objects, as far as they are drawn with the picture, and the others."""
        import torch

        depth, package = super().features(call), call.entry.split(":")[0]
        objects = call.get(self.fork.blended.get(package, ""))
        asked = all(getattr(call.settings, each, True) for each in self.fork.asking)
        if "objects" not in self.values(call) or objects is None or not asked:
            return depth, None
        objects = objects.flatten(1)
        if self._detached(call):
            return depth, objects
        channels = objects if depth is None else torch.cat([depth, objects], dim=1)
        others = channels[:, CHANNELS:]
        return channels[:, :CHANNELS], others if others.shape[1] else None

    def _detached(self, call: HostCall) -> bool:
        return any(each.detached and each.role == "objects" for each in self._outputs(call))

    def answer(
        self, call: HostCall, inputs: RasterInputs, draw: Callable[..., RasterOutputs]
    ) -> Any:
        """Draw and pack; several times if there are more channels than an engine blends.

        Channels that move no Gaussian may still move its threshold, which cuts them, too.
        """
        import torch

        outputs, (_, others) = draw(inputs), self._channels(call)
        if others is not None:
            splats: Any = inputs.splats
            if self._detached(call):
                still = {k: v.detach() for k, v in vars(splats).items() if hasattr(v, "detach")}
                inputs, splats = replace(inputs, means2d_hook=None), replace(splats, **still)
            parts = torch.split(others, CHANNELS, dim=1)
            further = (replace(splats, features=each) for each in parts)
            drawn = [outputs, *(draw(replace(inputs, splats=each)) for each in further)]
            blended = [each.features for each in drawn if each.features is not None]
            outputs = replace(outputs, features=torch.cat(blended))
        return self.pack(outputs, call)

    def _refuse(self, what: str, found: str, expected: str) -> NoReturn:
        raise EngineError(
            f"the rasterizer's {what}",
            found,
            expected,
            "Train stage 1 with the host's own rasterizer, or prune its PLY: fragprune finetune.",
        )

    def _outputs(self, call: HostCall) -> tuple[Output, ...]:
        package = call.entry.split(":")[0]
        if package not in self.fork.outputs:
            self._refuse(package, "a function that no training script calls", "a known call")
        return self.fork.outputs[package]

    def values(self, call: HostCall) -> tuple[str, ...]:
        """What the source says that a call returns."""
        return tuple(each.role for each in self._outputs(call))

    def made(self, outputs: RasterOutputs, call: HostCall) -> dict[str, Any]:
        """Depth, objects and the depth of a plane have gradients."""
        made, blended, values = super().made(outputs, call), outputs.features, self.values(call)
        if blended is not None:
            made |= {"depth": blended[:1], "objects": blended[int("depth" in values) :]}
            if "plane" in values:
                made["plane"] = plane_depth(made["objects"], call.settings)
        return made

    def pack(self, outputs: RasterOutputs, call: HostCall) -> tuple[Any, ...]:
        """The host's values in its order, with the shape and the type of its sums."""

        def packed(value: Output, made: Any) -> Any:
            if value.role in ("unread", "unproved") or made is None:  # or it was not asked for
                return Unread(value.name, unread=value.role != "unproved")
            if value.role not in ("count", "weight"):
                return made.detach() if value.detached and value.role != "objects" else made
            made = made[:, None] if value.column else made
            return made.int() if value.integer else made.float()

        return tuple(map(packed, self._outputs(call), super().pack(outputs, call)))

    def names(self) -> frozenset[str]:
        """The import names of the rasterizers and simple_knn."""
        ours = plain_distances(self.fork.repo)
        distances = frozenset() if ours else {"simple_knn", "simple_knn._C"}
        return (super().names() | self.fork.settings.keys()) - distances

    def modules(self, draw: Callable[[HostCall], Any]) -> dict[str, ModuleType]:
        """Stand-ins for the rasterizers and simple_knn."""
        from fragprune_graphdeco import stand_ins

        made = super().modules(draw)
        for package, names in self.fork.settings.items():
            made[package] = stand_ins.rasterizer(package, names, draw)
        return {name: module for name, module in made.items() if name in self.names()}


def no_result(call: SeamCall) -> NoReturn:
    """In place of a densification whose result the host reads, where the model stands still."""
    raise EngineError(
        f"{call.seam.attribute}, whose result the host reads",
        "called in stage 2, where no Gaussian is added or removed",
        "a densification that ends before",
        "Lower --densify_until_iter.",
    )


class ForkAdapter(GraphdecoAdapter):
    """The adapter of forks that no other adapter knows."""

    name = "3dgs-fork"
    info = HostInfo(
        "a fork of 3D Gaussian Splatting",
        repo="graphdeco-inria/gaussian-splatting",
        states="any whose model is plain 3DGS",
        limits=(
            "What reading cannot prove is named by fragprune check.",
            "Stage 2 starts from a checkpoint, not from a PLY. Where a script cannot resume its "
            "own training, stage 2 follows in the same run.",
        ),
    )
    dialect_type = ForkDialect
    steps_by_rendering = True
    checkpoints = CHECKPOINT
    resumes_ply = False  # a checkpoint may hold more than its PLY

    def fingerprint(self, repo: HostRepo) -> list[Finding]:
        """Whether the model is plain, and what was read of its scripts, rows and calls."""
        if repo.tree(MODEL) is None or repo.package:
            return self.other_host(repo, [f"no {MODEL}"])
        model = plain.read_plain(repo)
        others = [each for each in model.reasons if each not in model.moved]
        if others or not model.model:
            return [Finding.error("not-plain", MODEL, others[0], "a plain 3DGS model")]
        fork = read_fork(repo)
        served = replace(self.command_line(repo), scripts=fork.scripts)
        kernel = partial(kernels.read_kernels, repo, kernel=kernels.SPLAT)
        several = any(kernels.near(repo, each) is None for each in fork.outputs)
        codes = {kernels.ORDER, kernels.DISTANCE} if several else {kernels.ORDER}
        return [
            *fork.findings,
            *(f for found in map(kernel, fork.outputs) for f in found if f.code in codes),
            *read_getters(fork),
            *(reading.read_flags(repo, served) if fork.scripts else ()),
            *self._groups(repo),
        ]

    def _groups(self, repo: HostRepo) -> list[Finding]:
        """An error if a group of 3DGS is missing; others are followed, and stand still."""
        setup = f"{CLASS}.training_setup"
        found, at = graphdeco.group_names(repo.function(MODEL, setup)), repo.place(MODEL, setup)
        return [
            Finding.error("param-groups", at, f"no group {each.name}", "the groups of 3DGS")
            for each in self.groups
            if each.name not in found
        ]

    def drawing(self, repo: HostRepo, arguments: list[str]) -> dict[str, Any]:
        """Likewise, from the distance on from which its rasterizer draws."""
        call = self._first_call(repo)
        near = kernels.near(repo, call.package) if call else None
        return super().drawing(repo, arguments) | ({} if near in (None, NEAR) else {"near": near})

    def seams_for(self, repo: HostRepo) -> tuple[Seam, ...]:
        """The seams at what the checkout has."""
        fork = read_fork(repo)

        def of(role: Role, method: str, how: Any = None) -> Seam:
            named = (repo.parameters(MODEL, f"{CLASS}.{method}") or ())[:1]
            return Seam(role, MODEL, f"{CLASS}.{method}", named, how=how)

        rate, noise = "update_learning_rate", graphdeco.no_noise if fork.noisy else None
        setups = dict.fromkeys(["training_setup", *fork.setups])
        return (
            Seam(Role.SCENE, "scene", "Scene.__init__"),
            *(of(Role.ATTACH, name, graphdeco.optimizers) for name in setups),
            *([of(Role.STEP, rate, noise)] if repo.function(MODEL, f"{CLASS}.{rate}") else []),
            of(Role.KEEP, "_prune_optimizer"),
            of(Role.APPEND, "cat_tensors_to_optimizer"),
            *(
                of(Role.STILL, each, no_result if each in fork.answering else None)
                for each in fork.still
                if each not in fork.relocating
            ),
            *(of(Role.REARRANGE, each) for each in fork.still if each in fork.relocating),
            of(Role.SAVE, "save_ply"),
            of(Role.LOAD, "load_ply"),
            *(() if fork.one_run else (of(Role.CAPTURE, "capture"), of(Role.RESTORE, "restore"))),
            Seam(Role.LOSS, "torch", "Tensor.backward", external=True),
            *(
                Seam(Role.VIEW, RENDERER, draw.function, (draw.camera, draw.model))
                for draw in fork.draws
            ),
            *map(graphdeco.rasterizer_seam, fork.outputs),
        )

    def dialect(self, repo: HostRepo) -> ForkDialect:
        """The dialect of the calls that were read."""
        fork = read_fork(repo)
        return ForkDialect(
            package=next(iter(fork.outputs), self.package),
            settings=next(iter(fork.settings.values()), ()),
            outputs=2,
            fork=fork,
        )

    def command_line(self, repo: HostRepo) -> CommandLine:
        """The flags of 3DGS, for the training scripts that were read, the served ones first.

        Where one of these cannot resume its own training, stage 2 follows in the same run.
        """
        fork = read_fork(repo)
        scripts = (*fork.scripts, *fork.unserved) or self.scripts
        line = replace(super().command_line(repo), scripts=scripts)
        if not fork.one_run:
            return line
        return replace(line, one_run=True, save_checkpoints="--save_iterations", resume=())

    def lengthened(self, arguments: list[str], first: int, last: int) -> list[str]:
        """The same for ``last`` iterations, with a model saved at ``first`` too."""
        parser = ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("--save_iterations", type=int, nargs="+", default=[])
        stated = parser.parse_known_args(arguments)[0].save_iterations
        saved = map(str, sorted({first, last, *stated}))
        return [*arguments, "--iterations", str(last), "--save_iterations", *saved]

    def unserved(self, repo: HostRepo) -> dict[str, str]:
        """Those that were read."""
        return read_fork(repo).unserved

    def options(self, repo: HostRepo) -> frozenset[str]:
        """Those that were read."""
        return read_fork(repo).options

    def refuse(self, repo: HostRepo, arguments: list[str], *, stage: str, device: str) -> None:
        """Refuse trained exposures, which checkpoints of 3DGS lack, and joint learning where our
        gradient on the screen is another.

        Raises:
            UsageError: these, or an option under which it draws or changes its model otherwise.
        """
        super().refuse(repo, arguments, stage=stage, device=device)
        fork = read_fork(repo)
        if stage == "joint" and fork.scaled:
            raise UsageError(
                "--stage joint",
                f"{', '.join(sorted(fork.scaled))}, which changes the gradient that densifies",
                "a host that densifies by the gradient itself",
                "Leave it out: thresholds then learn after the host's own training.",
            )
        if "--train_test_exp" in arguments:
            raise UsageError(
                "--train_test_exp",
                "exposures, which a resumed fork would begin anew",
                "a training without them",
                "Leave it out, or prune its PLY: fragprune finetune.",
            )

    def not_drawn(self, repo: HostRepo, arguments: list[str]) -> list[str]:
        """Also what makes a picture beside the PLY: a network that moves or colours Gaussians."""
        by = [f"--{name}" for name in read_fork(repo).colours if f"--{name}" in arguments]
        why = [*by, *sorted(plain.read_plain(repo).moved)]
        beside = [f"a PLY is not all that it draws: {each}" for each in why]
        return beside + super().not_drawn(repo, arguments)

    def densified(self, repo: HostRepo, script: Path, arguments: list[str]) -> int | None:
        """As 3DGS tells, if scripts change the model only until then; else unknown."""
        known = rests_after_densification(read_fork(repo))
        return super().densified(repo, script, arguments) if known else None

    def model_file(self, output: Path, iteration: int) -> Path:
        """As 3DGS names it, or the only PLY of a point cloud there: forks put words before."""
        usual = super().model_file(output, iteration)
        others = [] if usual.exists() else sorted(usual.parent.glob("*point_cloud*.ply"))
        return others[0] if len(others) == 1 else usual
