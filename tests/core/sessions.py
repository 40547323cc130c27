"""A session's state over a host that is three lines long, to call its handlers by hand."""

import inspect
import weakref
from pathlib import Path
from types import SimpleNamespace

import torch

from fragprune_plugins import Settings, ThresholdStore
from fragprune_plugins.adapting import ParamGroup, Role, Seam, SeamCall
from fragprune_plugins.injection.state import ModelState, SessionState


class Model:
    """Rows of one number each, in one optimizer."""

    def __init__(self, count: int) -> None:
        self.xyz = torch.nn.Parameter(torch.arange(count * 3.0).reshape(count, 3))
        self.opacity = torch.nn.Parameter(torch.arange(float(count))[:, None])
        groups = [{"params": [self.xyz], "name": "xyz"}, {"params": [self.opacity], "name": "o"}]
        self.optimizer = torch.optim.SGD(groups, lr=1.0)

    def rows(self) -> dict[str, torch.Tensor]:
        return {"xyz": self.xyz.detach(), "o": self.opacity.detach()}


class Adapter:
    """Describes it."""

    name, groups = "three-lines", (ParamGroup("xyz", copied=True), ParamGroup("o", copied=True))

    def dialect(self, repo):
        return f"dialect of {repo.root}"

    def means(self, model):
        return model.xyz

    def model_of(self, call):
        return call.instance

    def group_name(self, model, group):
        return group["name"]


class Plugins:
    """Notes what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, dict]] = []

    def tell(self, hook, **about) -> None:
        self.told.append((hook.__name__, about))


def state(*, learn=True, **options) -> SessionState:
    repo = SimpleNamespace(root=Path("host"), commit="abc")
    options = {"schedule": SimpleNamespace(), "settings": Settings()} | options
    return SessionState(Adapter(), repo, Plugins(), learn=learn, **options)


def follow(session: SessionState) -> tuple[Model, ModelState]:
    """Six rows that the session knows, each with a threshold and moments of its own."""
    model, store = Model(6), ThresholdStore(6)
    numbers = torch.arange(6.0)
    moments = {"exp_avg": 1 + numbers, "exp_avg_sq": 1 + numbers}
    store.load_state_dict({"logits": -3 + numbers / 8, **moments, "adam_step": 2.0, "steps": 2})
    known = session.models[model] = ModelState(store)
    session.optimizers[model] = [weakref.ref(model.optimizer)]
    return model, known


def call(model, role, function, *args, how=None) -> SeamCall:
    """A call of a host's function, with its first parameter as what the seam needs."""
    needs = tuple(inspect.signature(function).parameters)
    how = how or (lambda call: None)
    return SeamCall(Seam(role, "host", "f", needs, how=how), function, model, args, {}, model=model)


__all__ = ["Model", "Role", "call", "follow", "state"]
