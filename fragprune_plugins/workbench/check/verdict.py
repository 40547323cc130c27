"""What a checkout can do with fragprune, in one sentence: it fits, its PLY does, or never."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.choosing import Tried, attempt, closest
from fragprune_plugins.hosts.findings import Finding, Plain
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.loading import Plugins, Wrong

_PLY = "OUTPUT/point_cloud/iteration_30000/point_cloud.ply"
_SHOWN = 8


@dataclass(frozen=True)
class Verdict:
    """What a checkout can do.

    Attributes:
        kind: "fits" (an adapter does), "several" (of them do), "inside" (one fits a folder of it),
            "finetune" (none does, but its PLY is plain 3DGS) or "never".
        reason: what speaks against the better answer; "" if nothing does.
        adapter: name of the adapter that fits, or of the nearest; "" if none finds a seam.
        differs: the differences from the nearest adapter's host.
        inside: folders of the checkout that fit, with their adapter.
    """

    kind: Literal["fits", "several", "inside", "finetune", "never"]
    sentence: str
    reason: str = ""
    adapter: str = ""
    differs: tuple[str, ...] = ()
    inside: tuple[tuple[str, str], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for ``--json``."""
        return {
            "verdict": self.kind,
            "sentence": self.sentence,
            "reason": self.reason,
            "nearest": self.adapter,
            "differs": list(self.differs),
            "inside": dict(self.inside),
        }


def judge(
    repo: HostRepo,
    tried: Sequence[Tried],
    adapters: Sequence[HostAdapter],
    plugins: Plugins,
) -> Verdict:
    """Judge a checkout.

    Args:
        tried: the result of each adapter on it, the nearest first.
        plugins: tell which models it saves, where no adapter fits.
    """
    fitting = closest(tried, adapters)
    if len(fitting) == 1:
        unproved = _unproved(repo, fitting[0])
        name = fitting[0].adapter.name
        return Verdict("fits", f"It fits {name}. Not proved: {unproved}.", unproved, name)
    if fitting:
        names = ", ".join(each.adapter.name for each in fitting)
        return Verdict("several", f"Several adapters fit: {names}. Name one with --adapter.")
    own, *others = models_of(repo, plugins)
    inside = _inside(repo, others, adapters)
    nearest = next((each for each in tried if each.held), None)
    name = nearest.adapter.name if nearest else ""
    differs = differences(repo, nearest, own.elsewhere) if nearest else ()
    plain = own
    if not own.model and not inside:
        found = [each for each in others if each.model]
        plain = next(filter(None, found), next(iter(found), own))
    if plain:
        sentence = (
            "No adapter fits, but its PLY is plain 3DGS, and this prunes it: "
            f"fragprune finetune {_PLY} --data SCENE --out pruned.ply"
        )
        return Verdict("finetune", sentence, "", name, differs, inside)
    if inside:
        sentence = " ".join(
            f"Its folder {folder}/ fits {fits}: fragprune check {repo.root / folder}"
            for folder, fits in inside
        )
        return Verdict("inside", sentence, own.reasons[0], name, differs, inside)
    reason = f"{plain.folder}/: {plain.reasons[0]}" if plain.folder else plain.reasons[0]
    return Verdict("never", f"Not possible: {reason}.", reason, name, differs)


def models_of(repo: HostRepo, plugins: Plugins) -> Sequence[Plain]:
    """The models that a codebase saves as PLYs, its own first; one without a name if none is known.

    Raises:
        PluginError: a plugin raised, or answered something else.
    """

    def wrong(answer: Any) -> Wrong | None:
        fits = isinstance(answer, list | tuple) and all(isinstance(p, Plain) for p in answer)
        return None if answer and fits else (repr(answer), "a list of at least one Plain")

    found = plugins.ask(hookspecs.fragprune_read_models, wrong, repo=repo)
    return found or [Plain(("no plugin reads what it saves",))]


def _unproved(repo: HostRepo, fitting: Tried) -> str:
    """What reading cannot show about a host that fits."""
    warned = [each.found for each in fitting.match.findings if each.level == "warning"]
    told = "; ".join(filter(None, [*warned, fitting.adapter.dialect(repo).unproved(repo)]))
    return told or "its picture; the rule in its vendored rasterizer is the known one"


def differences(repo: HostRepo, tried: Tried, elsewhere: str) -> tuple[str, ...]:
    """How a checkout differs from an adapter's host, in short lines.

    Args:
        elsewhere: where the model is, as text; "" if it is where the adapter looks.
    """
    lines: dict[str, None] = {elsewhere: None} if elsewhere else {}
    missing: list[str] = []
    for finding in tried.errors:
        if finding.code == "seam-missing":
            missing.append(finding.where.split(" (")[0].split(":")[-1])
        else:
            lines[_line(repo, finding)] = None
    if missing and not elsewhere:
        more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        lines[f"missing: {', '.join(missing[:_SHOWN])}{more}"] = None
    return tuple(lines)


def _line(repo: HostRepo, finding: Finding) -> str:
    if finding.code == "param-groups":
        found, expected = finding.found.split(", "), finding.expected.split(", ")
        more = [each for each in found if each not in expected]
        less = [each for each in expected if each not in found]
        parts = [f"further groups of the optimizer: {', '.join(more)}"] if more else []
        parts += [f"groups that the optimizer lacks: {', '.join(less)}"] if less else []
        return "; ".join(parts) or f"the optimizer's groups in another order: {finding.found}"
    if finding.code == "other-host":
        scripts = sorted(each.name for each in repo.root.glob("*train*.py"))
        there = f" (scripts: {', '.join(scripts[:_SHOWN])})" if scripts else ""
        return finding.found + (there if "train" in finding.found else "")
    return f"{finding.where}: {finding.found}"


def _inside(
    repo: HostRepo, others: Sequence[Plain], adapters: Sequence[HostAdapter]
) -> tuple[tuple[str, str], ...]:
    """Folders in a checkout that fit an adapter."""
    found = []
    for each in others:
        tried = attempt(HostRepo(repo.root / each.folder), adapters)
        found += [(each.folder, one.adapter.name) for one in closest(tried, adapters)[:1]]
    return tuple(found)
