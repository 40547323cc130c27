"""What a checkout can do with fragprune, in one sentence: it fits, its PLY does, or never."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.choosing import Tried, attempt, closest
from fragprune_plugins.hosts.findings import Finding
from fragprune_plugins.hosts.kernels import vendored
from fragprune_plugins.hosts.plain import Plain, find_model, read_plain
from fragprune_plugins.hosts.source import HostRepo

_MODEL = "scene.gaussian_model"
_PLY = "OUTPUT/point_cloud/iteration_30000/point_cloud.ply"
_SHOWN = 8
_DEEPEST = 3
"""Folders below a checkout in which a host is looked for."""


@dataclass(frozen=True)
class Verdict:
    """What a checkout can do.

    Attributes:
        kind: "fits" (an adapter does), "several" (of them do), "inside" (one fits a folder of it),
            "finetune" (none does, but its PLY is plain 3DGS) or "never".
        sentence: the answer for people.
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


def judge(repo: HostRepo, tried: Sequence[Tried], adapters: Sequence[HostAdapter]) -> Verdict:
    """Judge a checkout.

    Args:
        repo: the checkout, or an installed package.
        tried: the result of each adapter on it, the nearest first.
        adapters: all adapters.
    """
    nearer = closest([each.adapter for each in tried if each.match.fits], adapters)
    fitting = [each for each in tried if each.adapter in nearer]
    if len(fitting) == 1:
        unproved = _unproved(repo, fitting[0])
        name = fitting[0].adapter.name
        return Verdict("fits", f"It fits {name}. Not proved: {unproved}.", unproved, name)
    if fitting:
        names = ", ".join(each.adapter.name for each in fitting)
        return Verdict("several", f"Several adapters fit: {names}. Name one with --adapter.")
    inside = _inside(repo, adapters)
    nearest = next((each for each in tried if each.held), None)
    name, differs = (nearest.adapter.name, differences(repo, nearest)) if nearest else ("", ())
    plain = read_plain(repo)
    if not plain.model and not inside:
        within = (_within(each) for each in _hosts(repo.root))
        plain = next((found for found in within if found is not None), plain)
    fitting_inside = " ".join(
        f"Its folder {folder}/ fits {fits}: fragprune check {repo.root / folder}"
        for folder, fits in inside
    )
    if plain:
        sentence = (
            "No adapter fits, but its PLY is plain 3DGS, and this prunes it: "
            f"fragprune finetune {_PLY} --data SCENE --out pruned.ply"
        )
        return Verdict("finetune", sentence, "", name, differs, inside)
    if inside:
        return Verdict("inside", fitting_inside, plain.reasons[0], name, differs, inside)
    reason = plain.reasons[0]
    if nearest and not plain.model:  # what the nearest adapter misses tells more
        reason += f"; {nearest.verdict()}"
    return Verdict("never", f"Not possible: {reason}.", reason, name, differs)


def _unproved(repo: HostRepo, fitting: Tried) -> str:
    """What reading cannot show about a host that fits."""
    warned = [each.found for each in fitting.match.findings if each.level == "warning"]
    if repo.package or not hasattr(fitting.adapter, "package"):
        return "; ".join(warned) or "the picture, until it is compared on the first run"
    package: str = getattr(fitting.adapter.dialect(repo), "package", "")
    if not vendored(repo, package):
        warned.append(f"its picture; the sources of {package} are not in the checkout")
    return "; ".join(warned) or "its picture; the rule in its vendored rasterizer is the known one"


def differences(repo: HostRepo, tried: Tried) -> tuple[str, ...]:
    """How a checkout differs from an adapter's host, in short lines."""
    lines: dict[str, None] = {}
    model = find_model(repo)
    elsewhere = model is not None and model[0] != _MODEL and repo.path(_MODEL) is None
    if elsewhere and model:
        lines[f"{model[1]} is in {model[0]}"] = None
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


def _inside(repo: HostRepo, adapters: Sequence[HostAdapter]) -> tuple[tuple[str, str], ...]:
    """Folders in a checkout that fit an adapter."""
    found = []
    for folder in _hosts(repo.root):
        inner = HostRepo(folder)
        nearer = closest(
            [each.adapter for each in attempt(inner, adapters) if each.match.fits], adapters
        )
        name = folder.relative_to(repo.root).as_posix()
        found += [(name, each.name) for each in nearer[:1]]
    return tuple(found)


def _within(folder: Path) -> Plain | None:
    """The reasons of a host in a folder of a checkout."""
    plain = read_plain(HostRepo(folder))
    reasons = tuple(f"{folder.name}/: {each}" for each in plain.reasons)
    return Plain(reasons, plain.model) if plain.model else None


def _hosts(root: Path) -> list[Path]:
    """Folders in a checkout that have a renderer of this family."""
    patterns = ("*/" * deep + "gaussian_renderer" for deep in range(1, _DEEPEST + 1))
    found = (path.parent for each in patterns for path in root.glob(each) if path.is_dir())
    return sorted(each for each in found if "/." not in f"/{each.relative_to(root).as_posix()}")
