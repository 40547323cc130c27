"""Stage 2 of a host, as lively as a fine-tuning: at its rates, and with Gaussians that move.

A host's stage 2 takes its own steps. Those of a model whose PLY shows all that its host draws are
larger here, as ``fragprune finetune`` has them, and Gaussians move between some of them. Until all
have moved, area has a price: that of training views in turn, beside the host's last loss.
"""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fragprune_plugins.injection.rasterizing import directly
from fragprune_plugins.injection.session import active_session
from fragprune_plugins.injection.state import SessionState
from fragprune_plugins.learning.area import area_per_pixel
from fragprune_plugins.learning.events import StepStats
from fragprune_plugins.learning.stage2 import Stage2
from fragprune_plugins.learning.thresholds import ThresholdStore
from fragprune_plugins.plugins.hookspecs import hookimpl
from fragprune_plugins.types import RasterInputs, Splats, View, one_line
from fragprune_plugins.workbench.finetune.loop import LIVELY
from fragprune_plugins.workbench.finetune.relocation import Relocation, deepen, price

_NAMES = {"xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"}
_POSITIONS = 0.1  # of a host's first rate, at which those of a trained model still find better ones
_STATISTICS = ("max_radii", "grad", "denom")  # in names of what densification alone reads


@dataclass(eq=False)
class Lively:
    """A plugin for one run, which does nothing unless ``on``.

    Attributes:
        on: whether stage 2 learns at the rates of a fine-tuning.
        rows: (M,) int64, the Gaussians that may move, see ``Relocation``; None for none.
        views: of the training, to price area in; empty for no price.
        loss: () the host's, of the step before; None before the first.
        relocated: Gaussians that have moved.
    """

    on: bool = False
    rows: Tensor | None = None
    views: Sequence[View] = ()
    loss: Tensor | None = None
    relocated: int = 0

    __repr__ = one_line

    @hookimpl
    def fragprune_attached(self, model: Any, store: ThresholdStore) -> None:
        """Follow the optimizers of a model that trains, from its first step on."""
        session = active_session()
        state = session.models.get(model) if session and session.learn else None
        if session is None or state is None or state.stage is None:
            return
        if {name for name, _ in session.groups(model)} >= _NAMES:
            lively = _Steps(self, session, weakref.ref(model))
            for optimizer in filter(None, (known() for known in session.optimizers[model])):
                state.hooks.append(optimizer.register_step_pre_hook(lively.before))
                state.hooks.append(optimizer.register_step_post_hook(lively.after))

    @hookimpl
    def fragprune_step(self, stats: StepStats) -> None:
        """Note the loss."""
        self.loss = torch.tensor(stats.loss)


class _Steps:
    """The steps of a model's optimizers: the host's own, but for their rates, and for what moves.

    Gaussians move with the step of the optimizer that has their positions.
    """

    def __init__(self, of: Lively, session: SessionState, model: Any) -> None:
        self.of, self.session, self.model = of, session, model
        self.rates: dict[str, float] | None = None  # at first; not known before the first step
        self.relocation: Relocation | None = None
        self.after_it = contextlib.ExitStack()

    def before(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        """Lend the rates of this step, and look where the Gaussians are."""
        model = self.model()
        if model is None or not self.of.on or (stage := self.stage).plan is None:
            return
        if self.rates is None:
            self.rates = self._begin(model)
        lent = self.session.models[model].lent[-1]  # what the session takes back after the step
        known = {id(group) for group, _ in lent}
        mine = [(self.session.adapter.group_name(model, g), g) for g in optimizer.param_groups]
        for name, group in mine:
            if name in self.rates:
                lent += [(group, group["lr"])] * (id(group) not in known)
                group["lr"] = stage.rate(name, self.rates[name])
        if self.relocation is not None and "xyz" in dict(mine):
            optimizers = (each() for each in self.session.optimizers[model])
            moments = {k: each for o in optimizers if o is not None for k, each in o.state.items()}
            of = self._rows(model), stage.store, moments
            self._compact(of[0])
            self.after_it.enter_context(self.relocation.stepping(stage.steps, *of))

    @property
    def stage(self) -> Stage2:
        """The model's; one that follows in one run is another after a look at the model."""
        stage = self.session.models[self.model()].stage
        assert stage is not None
        return stage

    def _begin(self, model: Any) -> dict[str, float]:
        """The rates of stage 2 at its first step, by name; none where the host's own stay."""
        rows, moving = self._rows(model), self.of.rows
        rates = {name: LIVELY * self.session.rates[model][name] for name in _NAMES - {"opacity"}}
        rates["xyz"] *= _POSITIONS
        if moving is not None:
            pull = rows["xyz"].grad
            if not _is_all(model, rows) or (pull is not None and pull.is_sparse):
                return {}
            moving = moving.to(self.stage.store.logits.device)
            steps = self.session.settings.iterations
            self.relocation = Relocation(moving, rows["scaling"], steps)
            rates["xyz"] = self.relocation.rate
            deepen(self.stage.pressure)
        return rates

    def _compact(self, rows: Mapping[str, Tensor]) -> None:
        """Add the gradient of area's price, in a view of the training, to those of shapes."""
        of, step = self.of, self.stage.steps
        assert self.relocation is not None
        flat = rows["scaling"].shape[1] == 2
        if of.loss is None or not of.views or flat or self.relocation.over(step):
            return
        shapes = {name: rows[name].detach().requires_grad_() for name in ("scaling", "rotation")}
        with directly(rows["xyz"].device), torch.enable_grad():
            splats = Splats(
                rows["xyz"].detach(),
                rows["opacity"].detach().reshape(-1),
                scales=shapes["scaling"].exp(),
                rotations=torch.nn.functional.normalize(shapes["rotation"]),
                colors=rows["f_dc"].detach().reshape(-1, 3),
            )
            view = of.views[step % len(of.views)].to(splats.means.device)
            inputs = RasterInputs(view, splats, planes=())
            torch.autograd.backward(price(of.loss, area_per_pixel(inputs)))
        for name, shape in shapes.items():
            if (grad := rows[name].grad) is not None and shape.grad is not None:
                grad += shape.grad

    def _rows(self, model: Any) -> dict[str, Tensor]:
        """What has a row for each Gaussian, of the parameters, by name or number."""
        groups = enumerate(self.session.groups(model))
        known = {name or f"{number}": group["params"][0] for number, (name, group) in groups}
        count = (len(self.stage.store),)
        return {name: each for name, each in known.items() if each.shape[:1] == count}

    def after(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        """Some Gaussians move."""
        self.after_it.close()
        if self.relocation is not None:
            self.of.relocated = self.relocation.moved(self.stage.steps)


def _is_all(model: Any, rows: Mapping[str, Tensor]) -> bool:
    """Whether these are all that a model holds for each Gaussian, but for statistics.

    What else it holds, such as a label, would stay with the row from which a Gaussian moved.
    """
    known, count = {id(each) for each in rows.values()}, len(rows["xyz"])
    held = ((name, each) for name, each in vars(model).items() if isinstance(each, Tensor))
    further = [name for name, each in held if each.shape[:1] == (count,) and id(each) not in known]
    return all(any(word in name for word in _STATISTICS) for name in further)
