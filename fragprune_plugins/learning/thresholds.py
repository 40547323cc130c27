"""The threshold store: one truncation threshold per Gaussian of one model, and its optimizer.

Hosts' optimizers fail on a foreign group, so the store owns its own Adam. Row operations mirror
what hosts do to theirs, moments included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from fragprune_plugins.constants import ALPHA_MIN, LOGIT_MAX, LOGIT_MIN, NEUTRAL_LOGIT
from fragprune_plugins.errors import AlignmentError, InputError, SidecarError
from fragprune_plugins.learning.adam import EPSILON
from fragprune_plugins.types import Rim, is_rim, is_stop, short

_START_MARGIN = 1e-4  # thresholds start this far (relative) below the 1/255 skip: nothing changes
_START_MAX = 0.99
MOMENTS = {"exp_avg": "their moments", "exp_avg_sq": "their second moments"}  # Adam's
_MIXING = 0x9E3779B97F4A7C15  # odd, with bits in no order
_ROUNDING = 1e-4  # relative: sigmoid of logit loses less, unless the logit had to be clamped

Known = TypeVar("Known")

_Noted = tuple[Tensor, int, Known]  # logits, their version, what is known of them


class ThresholdStore:
    """Truncation thresholds tau = sigmoid(logit) of N Gaussians, in falloff, each in (0, 1).

    A new store is neutral: the host's own 1/255 skip decides everywhere, exactly, and gradients
    cannot move it. ``open`` starts learning.

    Args:
        count: N, number of Gaussians.
        device: where the model lives.
        lr: initial learning rate on the logits (0.05 to 0.1 works; a much smaller one
            has no visible effect).

    Attributes:
        stop: the model's, as ``RasterInputs`` has it; None for the hosts' rule. It is not learned.
        rim: the model's, as ``RasterInputs`` has it. It is not learned.
        adam: the state of Adam that the logits have, by its names; {} before the first step.
    """

    def __init__(self, count: int, device: torch.device | str = "cpu", lr: float = 0.05) -> None:
        self.steps = 0
        self.stop: float | None = None
        self.rim: Rim = "hard"
        self.lr = lr
        self._bind(torch.full((count,), NEUTRAL_LOGIT, device=device))

    def _bind(self, logits: Tensor, adam: dict[str, Any] | None = None) -> None:
        self.logits = logits.detach().to(torch.float32, copy=True).requires_grad_(True)
        self.adam = adam or {}
        # known of the logits: whether all are neutral, and whether none is; thresholds as given
        self._seen: _Noted[tuple[bool, bool]] | None = None
        self._given: _Noted[Tensor] | None = None

    def __len__(self) -> int:
        return len(self.logits)

    def __repr__(self) -> str:
        stop = "" if self.stop is None else f", stop={self.stop:g}"
        rim = "" if self.rim == "hard" else f", rim={self.rim!r}"
        return f"ThresholdStore(logits={short(self.logits)}, steps={self.steps}{stop}{rim})"

    @classmethod
    def from_falloff(cls, thresholds: Tensor, lr: float = 0.05) -> ThresholdStore:
        """A store that holds given thresholds, on their device.

        Args:
            thresholds: (N,) falloff in (0, 1): fragments with exp(-q / 2) below it are not drawn, q
                being the squared Mahalanobis distance.
            lr: initial learning rate on the logits.

        Raises:
            InputError: they are not (N,) floating-point numbers in (0, 1).
        """
        inside = isinstance(thresholds, Tensor) and thresholds.ndim == 1
        inside = inside and thresholds.is_floating_point()
        if not inside or not bool(((thresholds > 0) & (thresholds < 1)).all()):
            found = short(thresholds) + (", some outside (0, 1)" if inside else "")
            remedy = "Correct them; ThresholdStore.from_alpha takes a limit of alpha."
            raise InputError("thresholds", found, "a tensor (N,), falloff in (0, 1)", remedy)
        store, values = cls(len(thresholds), thresholds.device, lr), thresholds.detach().float()
        neutral = torch.sigmoid(torch.full_like(values, NEUTRAL_LOGIT))
        logits = torch.logit(values)
        store.place(torch.where(values <= neutral, logits.clamp_max(NEUTRAL_LOGIT), logits))
        near = store.logits.detach().sigmoid()  # not rounded back: files get the bits they gave
        same = (values - near).abs() <= _ROUNDING * near
        store._given = store._note(torch.where(same, values, near))
        return store

    @classmethod
    def from_alpha(cls, alpha: float, opacities: Tensor, lr: float = 0.05) -> ThresholdStore:
        """A store that draws no fragment whose alpha is below a limit, one for all Gaussians.

        In falloff a Gaussian's threshold is the limit over its opacity. Of a Gaussian that is not
        as opaque as the limit no more than its very centre is left.

        Args:
            alpha: in (0, 1); nothing changes up to the hosts' own 1/255.
            opacities: (N,) or (N, 1), activated.
            lr: initial learning rate on the logits.

        Raises:
            InputError: the limit is not in (0, 1), or an opacity not in [0, 1].
        """
        if not 0 < alpha < 1:
            raise InputError("alpha", f"{alpha:g}", "in (0, 1)", "Choose one, such as 4 / 255.")
        opacities = opacities.detach().reshape(-1)
        if not bool(((opacities >= 0) & (opacities <= 1)).all()):
            remedy = "Pass model.splats().opacities."
            raise InputError("opacities", "some outside [0, 1]", "activated ones", remedy)
        store = cls(len(opacities), opacities.device, lr)
        store.place(torch.logit((alpha / opacities).clamp_max(1.0)))
        return store

    @property
    def values(self) -> Tensor:
        """(N,) thresholds in (0, 1), float32; differentiable with respect to the logits.

        Those of ``from_falloff`` come back to the bit for as long as they do not change.
        """
        values = torch.sigmoid(self.logits.clamp(LOGIT_MIN, LOGIT_MAX))
        if (given := self._known(self._given)) is None:
            return values
        return values + (given - values).detach()  # exact: they are neighbours

    def _note(self, known: Known) -> _Noted[Known] | None:
        """Note something of the logits as they are; in inference mode they have no version."""
        return None if self.logits.is_inference() else (self.logits, self.logits._version, known)

    def _known(self, noted: _Noted[Known] | None) -> Known | None:
        """What was noted, unless the logits have changed since."""
        if noted is None or noted[0] is not self.logits or noted[1] != self.logits._version:
            return None
        return noted[2]

    @property
    def neutral(self) -> bool:
        """True while no threshold decides anything. Rows are read once after each change."""
        return self._look()[0]

    def _look(self) -> tuple[bool, bool]:
        if (seen := self._known(self._seen)) is None:
            seen = bool((self.logits <= NEUTRAL_LOGIT).all()), False
            self._seen = self._note(seen)
        return seen

    @property
    def rules(self) -> dict[str, Any]:
        """The model's words for drawing beside its thresholds, as ``RasterInputs`` takes them."""
        return {"stop": self.stop, "rim": self.rim}

    def ruled(self, *, stop: float | None = None, rim: Rim | None = None) -> ThresholdStore:
        """This store, with those of the ``rules`` that are given.

        Raises:
            InputError: the stop is not 1e-4 to 1, or the rim neither hard nor soft.
        """
        if not is_stop(stop):
            raise InputError("stop", f"{stop:g}", "1e-4 to 1, a share of light", "Choose another.")
        if rim is not None and not is_rim(rim):
            raise InputError("rim", f"{rim!r:.40}", "hard or soft", "Choose one of the two.")
        self.stop = self.stop if stop is None else stop
        self.rim = self.rim if rim is None else rim
        return self

    @property
    def cuts(self) -> bool:
        """True if thresholds or the stop decide anything."""
        return self.stop is not None or not self.neutral

    @property
    def opened(self) -> bool:
        """True if ``open`` would change nothing, because it was called and no row is neutral."""
        return self._look()[1]

    def open(self, opacities: Tensor) -> None:
        """Start learning: neutral rows move to just below the skip limit 1/(255 o).

        There the image is still the host's, and the rim's gradient reaches the threshold. A soft
        rim covers the outermost pixels in part at once.

        Args:
            opacities: (N,) or (N, 1), activated.
        """
        opacities = opacities.detach().reshape(-1).to(self.logits)
        self._expect(len(opacities), "open")
        if self.opened:
            return
        limit = (ALPHA_MIN / opacities.clamp_min(1e-12)).clamp_max(_START_MAX)
        start = torch.logit(limit * (1 - _START_MARGIN))
        with torch.no_grad():
            neutral = self.logits <= NEUTRAL_LOGIT
            self.logits.copy_(torch.where(neutral, start, self.logits))
        self._seen = self._note((not len(self), True))

    def step(self, lr: float | None = None) -> None:
        """Make one optimizer step with the gradient gathered since the last one, and clear it."""
        self.lr = self.lr if lr is None else lr
        neutral, opened = self._look()
        # Made only here: for the first one torch takes a second, and drawing needs none.
        optimizer = torch.optim.Adam([self.logits], lr=self.lr, eps=EPSILON)
        optimizer.state[self.logits] = self.adam
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        self.place(self.logits)
        self.steps += 1
        if not neutral:  # no step comes near the 24 logits from the skip limit down to neutral
            self._seen = self._note((False, opened))

    @torch.no_grad()
    def place(self, logits: Tensor) -> None:
        """Set the logits (N,), clamped to where float32 thresholds differ from 0 and from 1."""
        self.logits.copy_(logits.clamp(LOGIT_MIN, LOGIT_MAX))

    def clone(self, device: torch.device | str | None = None) -> ThresholdStore:
        """A copy with its moments, on a device; on its own when None."""
        device = self.logits.device if device is None else device
        other = ThresholdStore(0, device, self.lr)
        other.load_state_dict(self.state_dict())
        if (given := self._known(self._given)) is not None:
            other._given = other._note(given.to(other.logits.device))
        return other

    def __deepcopy__(self, memo: object) -> ThresholdStore:
        return self.clone()

    def keep(self, mask: Tensor) -> None:
        """Keep the rows where mask (N,) bool is True, in their order, with their moments."""
        mask = torch.as_tensor(mask, device=self.logits.device)
        if mask.dtype != torch.bool or mask.ndim != 1:
            found = f"a {mask.dtype} mask of shape {tuple(mask.shape)}"
            expected = f"a bool mask ({len(self)},)"
            remedy = "Pass the rows to keep as booleans."
            raise AlignmentError("ThresholdStore.keep", found, expected, remedy)
        self._expect(len(mask), "keep")
        self._resize(lambda rows: rows[mask])

    def append(self, count: int, parents: Tensor | None = None) -> None:
        """Append rows at the end.

        Args:
            parents: (count,) int64, the rows whose thresholds the new ones inherit; neutral when
                None, and where -1. Moments of new rows are zero, as the hosts' are.
        """
        new = torch.full((count,), NEUTRAL_LOGIT, device=self.logits.device)
        if parents is not None:
            parents = self._rows(parents, count, "append", least=-1)
            new[parents >= 0] = self.logits.detach()[parents[parents >= 0]]
        self._resize(lambda rows: torch.cat([rows, rows.new_zeros(count)]))
        with torch.no_grad():
            self.logits[len(self) - count :] = new

    def rearrange(self, origins: Tensor, fresh: Tensor) -> None:
        """Keep, copy and append rows at once: row i takes the values of row ``origins[i]``.

        Args:
            origins: (M,) int64, for each of the M new rows the old one it descends from, or -1.
            fresh: (M,) bool, True where the row is a new Gaussian: its moments are zero.
        """
        origins = self._rows(origins, len(fresh), "rearrange", least=-1)
        self._resize(lambda rows: rows[origins])
        self.logits.detach()[origins < 0] = NEUTRAL_LOGIT
        for name in MOMENTS.keys() & self.adam:
            self.adam[name][fresh] = 0

    def replace(self, count: int) -> None:
        """Start over for another population: ``count`` neutral rows with zero moments."""
        self._bind(torch.full((count,), NEUTRAL_LOGIT, device=self.logits.device))

    @property
    def numbers(self) -> dict[str, Tensor]:
        """All learned tensors, each (N,), by a name for messages."""
        named = {said: self.adam[name] for name, said in MOMENTS.items() if name in self.adam}
        return {"thresholds": self.logits.detach(), **named}

    def state_dict(self) -> dict[str, Any]:
        """Copies of logits, moments and counters, and the ``rules``, for ``load_state_dict``."""
        zeros = torch.zeros_like(self.logits)
        return {
            "logits": self.logits.detach().clone(),
            **{name: self.adam.get(name, zeros).detach().clone() for name in MOMENTS},
            "adam_step": float(self.adam.get("step", 0.0)),
            "steps": self.steps,
            **({} if self.stop is None else {"stop": self.stop}),
            **({} if self.rim == "hard" else {"rim": self.rim}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` gave, bit for bit.

        Raises:
            SidecarError: the state's parts do not fit together, or are no numbers that learning
                can have left.
        """
        rows = {name: state[name] for name in ("logits", *MOMENTS)}
        stop, rim = state.get("stop"), state.get("rim", "hard")  # absent before there were any
        kinds = [(tuple(t.shape), t.dtype) for t in rows.values()]
        if set(kinds) != {((rows["logits"].numel(),), torch.float32)}:
            raise _misfit(f"shapes {kinds}", "three (N,) float32")
        for name, tensor in rows.items():
            wrong = ~tensor.isfinite()
            if name == "exp_avg_sq":
                wrong |= tensor < 0
            if wrong.any():
                found = f"{name} that cannot be in {int(wrong.sum())} of {len(tensor)} rows"
                raise _misfit(found, "finite numbers, and second moments that are not negative")
        if not is_stop(stop):
            raise _misfit(f"a stop of {stop}", "1e-4 to 1")
        if not is_rim(rim):
            raise _misfit(f"a rim {rim!r:.40}", "hard or soft")
        self.stop, self.rim = stop, rim
        device = self.logits.device
        self._bind(rows["logits"].to(device))
        self.steps = int(state["steps"])
        if state["adam_step"] > 0:
            step = torch.tensor(float(state["adam_step"]), dtype=torch.float32)
            self.adam = {"step": step} | {n: rows[n].to(device).clone() for n in MOMENTS}

    def _resize(self, change: Callable[[Tensor], Tensor]) -> None:
        """Apply a row operation to logits and moments alike."""
        given = self._known(self._given)
        moments = {name: change(self.adam[name]) for name in MOMENTS.keys() & self.adam}
        self._bind(change(self.logits.detach()), self.adam | moments)
        if given is not None:
            self._given = self._note(change(given))

    def _rows(self, rows: Tensor, count: int, operation: str, least: int = 0) -> Tensor:
        rows = torch.as_tensor(rows, dtype=torch.int64, device=self.logits.device)
        inside = rows.ndim == 1 and bool(((rows >= least) & (rows < len(self))).all())
        if not inside or len(rows) != count:
            found = f"{len(rows)} row indices for {count} rows"
            expected = f"{count} indices in [{least}, {len(self)})"
            why = "Report this with the host's name: its rows changed in a way the adapter misread."
            raise AlignmentError(f"ThresholdStore.{operation}", found, expected, why)
        return rows

    def _expect(self, count: int, operation: str) -> None:
        if count != len(self):
            found, expected = f"{count} Gaussians", f"{len(self)}, one per threshold"
            why = "Report this with the host's name: its rows changed, and the store was not told."
            raise AlignmentError(f"ThresholdStore.{operation}", found, expected, why)


def _misfit(found: str, expected: str) -> SidecarError:
    """The error of a state that no store can have had."""
    return SidecarError("threshold state", found, expected, "Use a sidecar written by fragprune.")


def copies(known: Sequence[Tensor], new: Sequence[Tensor]) -> Tensor:
    """(M,) int64 for each new row the first that has its values bit for bit, -1 for none.

    A row is the values at its place in all tensors: (N, ...) the known ones, (M, ...) the new ones.
    """
    tables = ([each.detach()[..., None].flatten(1) for each in rows] for rows in (known, new))
    bits = torch.cat([torch.cat(each, 1) for each in tables]).float().view(torch.int32)
    weights = [pow(_MIXING, 1 + column, 1 << 63) for column in range(bits.shape[1])]
    sums = (bits * torch.tensor(weights, device=bits.device)).sum(1)  # sorted faster than rows
    kinds: Tensor = torch.unique(sums, return_inverse=True)[1]
    first, numbers = torch.full_like(kinds, -1), torch.arange(len(known[0]), device=bits.device)
    first.scatter_reduce_(0, kinds[: len(numbers)], numbers, "amin", include_self=False)
    found = first[kinds[len(numbers) :]]
    return found.where((bits[found] == bits[len(numbers) :]).all(1), -1)
