"""splatfacto with stage 2 as the last iterations of its training.

The class is named in a run's ``config.yml``, so every tool of nerfstudio loads it, and through it
the thresholds. It starts a session of fragprune, which does the rest: this module says when.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from copy import copy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from gsplat.strategy.base import Strategy
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch.overrides import TorchFunctionMode

import fragprune_plugins
from fragprune_nerfstudio import METHOD
from fragprune_nerfstudio.learning import Learning
from fragprune_plugins.adapting import (
    AlignmentError,
    Interrupted,
    SessionError,
    Terminated,
    UsageError,
)
from fragprune_plugins.injection.process import checkpoint_values
from fragprune_plugins.injection.session import Session, active_session
from fragprune_plugins.learning.deferred import between_steps
from fragprune_plugins.learning.interruption import EXIT_CODE, Terminate, sigterm_interrupts
from fragprune_plugins.learning.stage2 import stored_thresholds

PLAIN = 0.25  # gsplat's threshold of plain gradients over that of absolute ones, 0.0002 over 0.0008

# torch's loader is safe by default since 2.6, and nerfstudio's schedulers save NumPy scalars
if hasattr(torch.serialization, "add_safe_globals"):
    torch.serialization.add_safe_globals(checkpoint_values())


@dataclass
class FragpruneSplatfactoConfig(SplatfactoModelConfig):  # type: ignore[misc]
    """splatfacto's, and stage 2."""

    _target: type = field(default_factory=lambda: FragpruneSplatfacto)
    fragprune: Learning = field(default_factory=Learning)
    """Stage 2, the last iterations of the training, in which thresholds learn."""
    fragprune_from: int | None = None
    """Iteration at which stage 2 begins, instead of fragprune.iterations before the last one."""
    fragprune_engine: str = "auto"
    """Engine that draws with thresholds: auto, reference, cpu, cuda, or that of a plugin."""


class _NoCuda(TorchFunctionMode):
    """Inside, ``.cuda()`` returns its tensor: splatfacto calls it whatever the device is."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0] if func is torch.Tensor.cuda else func(*args, **(kwargs or {}))


class Still(Strategy):  # type: ignore[misc]
    """gsplat's strategy that changes nothing, for stage 2."""

    absgrad = False


class FragpruneSplatfacto(SplatfactoModel):  # type: ignore[misc]
    """splatfacto; from one iteration on its thresholds learn, and its Gaussians are frozen.

    ``config.fragprune.train`` says what moves beside the thresholds.
    """

    config: FragpruneSplatfactoConfig
    begin: int | None = None  # iteration at which stage 2 begins, once it is known
    saved: dict[str, Any] | None = None  # of the checkpoint
    checkpoints: Path | None = None  # their folder
    done: int | None = None  # the last iteration; None within the next one
    finished = False

    def populate_modules(self) -> None:
        """As splatfacto; on the CPU without CUDA."""
        expect_no_script()
        session = active_session()
        if session is None:  # it draws, with the thresholds of a checkpoint, and learns nothing
            engine = self.config.fragprune_engine
            fragprune_plugins.activate("nerfstudio", stage="off", engine=engine)
        elif (name := session.adapter.name) != "nerfstudio":
            raise SessionError(METHOD, f"a session of {name}", "none", "Deactivate it first.")
        cpu = torch.device(self.kwargs.get("device", "cpu")).type == "cpu"
        if cpu and self.config.use_absgrad:
            self.config = copy(self.config)
            self.config.use_absgrad = False
            self.config.densify_grad_thresh *= PLAIN
        with _on_cpu(cpu):
            super().populate_modules()

    def get_outputs(self, camera: Any) -> Any:
        """As splatfacto; only training asks for gradients."""
        wanted = torch.is_grad_enabled() and self.training
        with _on_cpu(self.device.type == "cpu"), torch.set_grad_enabled(wanted):
            return super().get_outputs(camera)

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """As splatfacto, once it is known when stage 2 begins; at the end the gain is said."""
        trainer = training_callback_attributes.trainer
        self.begin, self.checkpoints = self.beginning(trainer), trainer.checkpoint_dir
        self.follow_parameters(training_callback_attributes.optimizers)
        CONSOLE.log(f"fragprune: stage 2 begins at iteration {self.begin}")
        if self.config is not trainer.config.pipeline.model:
            CONSOLE.log(
                "fragprune: on a CPU densification follows plain gradients, not absolute ones, "
                f"above {self.config.densify_grad_thresh:g}"
            )
        self.holding = ExitStack()
        trainer.train = partial(self.train_until_interrupted, trainer, trainer.train)
        own: list[Any] = super().get_training_callbacks(training_callback_attributes)
        at = TrainingCallbackLocation
        return [
            TrainingCallback([at.BEFORE_TRAIN_ITERATION], self.hold),
            *own,
            TrainingCallback([at.AFTER_TRAIN_ITERATION], self.let_go),
            TrainingCallback([at.AFTER_TRAIN], self.tell),
        ]

    def hold(self, step: int) -> None:
        """From here on Ctrl-C and SIGTERM wait, so that a checkpoint is of whole iterations."""
        self.holding.enter_context(between_steps())
        self.done = None

    def let_go(self, step: int) -> None:
        """The iteration is over: a signal that waits acts here."""
        self.done = step
        self.holding.close()

    def train_until_interrupted(self, trainer: Any, train: Callable[[], None]) -> None:
        """Train; Ctrl-C and SIGTERM save a checkpoint and end with exit code 130 or 143.

        nerfstudio itself saves nothing then, and its exit code is 0.
        """
        try:
            with sigterm_interrupts(), self.holding:
                train()
        except KeyboardInterrupt as error:
            if self.finished:  # so nerfstudio's viewer is closed
                raise
            by_signal = isinstance(error, Terminate)
            stated, found = (Terminated, "SIGTERM") if by_signal else (Interrupted, "Ctrl-C")
            if self.done is None:  # before the first iteration, or the second signal in one
                saved = "nothing is saved"
                again = f"Run it again, or go on from a checkpoint in {trainer.checkpoint_dir}."
            else:
                with between_steps():
                    trainer.save_checkpoint(self.done)
                saved = f"iteration {self.done} is saved"
                path = trainer.checkpoint_dir / f"step-{self.done:09d}.ckpt"
                left = trainer._start_step + trainer.config.max_num_iterations - self.done - 1
                again = (
                    f"To go on, add to the same ns-train {METHOD} command: "
                    f"--load-checkpoint {path} --max-num-iterations {left}"
                )
            expected = "a training that reaches its end"
            told = stated(f"ns-train {METHOD}", f"{found}; {saved}", expected, again)
            CONSOLE.print(str(told), markup=False, soft_wrap=True)
            raise SystemExit(EXIT_CODE if by_signal else 130) from told

    def beginning(self, trainer: Any) -> int:
        """The iteration at which stage 2 begins, or a checkpoint's began, or UsageError."""
        settings, start = self.config.fragprune.settings(), trainer._start_step
        end = start + trainer.config.max_num_iterations
        if trainer.mixed_precision or trainer.use_grad_scaler:
            remedy = "Drop --mixed-precision, --use-grad-scaler."
            raise UsageError(METHOD, "mixed precision", "float32", remedy)
        if trainer.world_size > 1:
            raise UsageError(METHOD, "several GPUs", "one", "Set --machine.num-devices 1.")
        settings.goal.target()  # refuses what a training alone cannot meet
        if self.saved is not None:
            return int(self.saved["begin"])
        wanted = self.config.fragprune_from
        begin: int = max(start, end - settings.iterations if wanted is None else wanted)
        if begin == 0 or begin >= end:
            found = (
                f"stage 2 from iteration {begin} on in a training of iterations {start} to {end}"
            )
            expected = "some iterations that train, and some of stage 2 after them"
            remedy = "Change --max-num-iterations or --pipeline.model.fragprune.iterations."
            raise UsageError(METHOD, found, expected, remedy)
        return begin

    def follow_parameters(self, optimizers: Any) -> None:
        """Give the optimizers a checkpoint's parameters: nerfstudio makes them before it loads."""
        for name, parameter in self.gauss_params.items():
            (group,) = (optimizer := optimizers.optimizers[name]).param_groups
            (known,) = group["params"]
            if known is not parameter:
                group["params"] = optimizers.parameters[name] = [parameter]
                if known in optimizer.state:
                    optimizer.state[parameter] = optimizer.state.pop(known)

    def step_cb(self, optimizers: Any, step: int) -> None:
        """As splatfacto; stage 2 begins here."""
        learning = isinstance(self.strategy, Still)
        if self.begin is not None and step >= self.begin and not learning:
            fragprune_plugins.deactivate()
            settings, engine = self.config.fragprune.settings(), self.config.fragprune_engine
            session = fragprune_plugins.activate("nerfstudio", settings=settings, engine=engine)
            session.output = self.checkpoints
            if self.saved is not None:
                session.take_up(self, thresholds_of(self.saved))
            self.begin_stage2(optimizers)
            self.go_on(session)
        super().step_cb(optimizers, step)

    def begin_stage2(self, optimizers: Any) -> None:
        """Densification ends. The session attaches here."""
        self.strategy = Still()
        factor = self._get_downscale_factor()
        if factor > 1:
            CONSOLE.log(
                f"fragprune: stage 2 learns on photographs of 1/{factor} of their size; "
                "--pipeline.model.num-downscales 0 gives their own"
            )

    def go_on(self, session: Session) -> None:
        """Continue the stage 2 of a checkpoint where it was saved."""
        state = session.models[self]
        if self.saved is not None and state.stage is not None:
            plain = json.loads(self.saved["plain"])
            state.seen.update(dict.fromkeys(self.saved["views"]))
            state.stage.load_state_dict(self.saved["tensors"], plain, self.saved["views"])

    def tell(self, step: int) -> None:
        """Say what was gained, at the end of a training."""
        self.finished = True
        session = active_session()
        if session is None or session.store(self) is None:
            return
        session.expect_drawn()
        done = session.finish()
        if done.fragments_before is not None and done.fragments_after is not None:
            CONSOLE.print(
                f"fragprune: {done.steps} iterations of stage 2 ({done.engine} engine), "
                f"{done.gaussians} Gaussians; fragments per pixel over training views: "
                f"{done.fragments_before:.2f} -> {done.fragments_after:.2f}"
            )

    def get_extra_state(self) -> dict[str, Any]:
        """Thresholds and the state of their learning, for a checkpoint; empty before stage 2."""
        session = active_session()
        state = session.models.get(self) if session is not None else None
        if session is None or state is None:
            return {}
        session.expect_rows(self, state, "the checkpoint")
        if state.stage is None:
            return self.saved or {}
        state.stage.check()
        views = list(state.seen)
        tensors, plain = state.stage.state_dict(views)
        return {"begin": self.begin, "views": views, "tensors": tensors, "plain": json.dumps(plain)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Keep what a checkpoint holds until its Gaussians are there."""
        self.saved = state or None

    def load_state_dict(self, dict: Any, **kwargs: Any) -> Any:
        """As splatfacto; then the thresholds apply to what is drawn."""
        self.saved = None
        result = super().load_state_dict(dict, **kwargs)
        session = active_session()
        if self.saved is not None and session is not None:
            session.take_up(self, thresholds_of(self.saved))
        return result


def thresholds_of(saved: dict[str, Any]) -> dict[str, Any]:
    """The state of the store in what a checkpoint holds."""
    return stored_thresholds(saved["tensors"], json.loads(saved["plain"]))


def expect_no_script() -> None:
    """Refuse an exporter that runs as a script: its copy would export without thresholds."""
    import __main__

    own = getattr(__main__, "ExportGaussianSplat", None)
    if own is not None and own.__module__ == "__main__":
        found = "run as a script, where thresholds cannot follow its filter"
        remedy = "Run: ns-export gaussian-splat ..."
        raise AlignmentError("nerfstudio.scripts.exporter", found, "the command ns-export", remedy)


def _on_cpu(cpu: bool) -> AbstractContextManager[Any]:
    """Inside, nothing goes to a GPU where the model is on the CPU."""
    return _NoCuda() if cpu else nullcontext()
