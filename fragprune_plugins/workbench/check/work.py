"""Reads a host's source, and says what fragprune can do with it."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from fragprune_plugins.errors import UnknownHostError
from fragprune_plugins.hosts.adapter import HostAdapter, ScriptAdapter
from fragprune_plugins.hosts.choosing import attempt, closest, folder_above, locate, usage
from fragprune_plugins.hosts.dialect import Dialect, Proof
from fragprune_plugins.hosts.findings import Finding, Match, Plain
from fragprune_plugins.hosts.preflight import Missing, install, missing_imports
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection import proofs
from fragprune_plugins.plugins.loading import Plugins, load_plugins
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.figures.wording import quoted
from fragprune_plugins.workbench.saved import models_of
from fragprune_plugins.workbench.scenes.output import ARGUMENTS


def check(*, hosts: tuple[Path, ...], adapter: str | None) -> Report:
    """Do what ``fragprune check`` promises; its options are the arguments."""
    for host in hosts:
        if not host.is_dir() and HostRepo.installed(str(host)) is None:
            found = "neither a folder nor an installed package"
            expected = "a host's checkout, or the import name of an installed host"
            raise UnknownHostError(str(host), found, expected, "Name the folder of train.py.")
        if (host / ARGUMENTS).is_file() and not any(host.glob("*.py")):
            found = "the output folder of a training"
            remedy = f"Name the folder of train.py. For the model: fragprune audit {quoted(host)}"
            raise UnknownHostError(str(host), found, "a host's checkout", remedy)
    plugins = load_plugins()
    adapters = plugins.adapters
    if adapter is not None:
        adapters = [a for a in adapters if a.name == adapter.replace("_", "-")]
        if not adapters:
            expected, remedy = "an installed adapter", "Run fragprune adapters."
            raise UnknownHostError("--adapter", repr(adapter), expected, remedy)
    if len(hosts) > 1:
        return _table(hosts, adapters, plugins)
    return _single(hosts[0], adapters, adapter, plugins)


def _single(
    host: Path, adapters: list[HostAdapter], adapter: str | None, plugins: Plugins
) -> Report:
    """Everything about one checkout; the exit code is 0 if one adapter fits."""
    repo = _repository(host, adapters, adapter)
    tried = attempt(repo, adapters)
    fitting = closest(tried, adapters)
    fits = next(iter(fitting)) if len(fitting) == 1 else None
    judged = judge(repo, tried, adapters, plugins)
    kept = _kept(repo, fits.dialect(repo)) if fits else []
    proved = [str(proof) for proof in kept if not proof.failed]
    failed = [str(proof) for proof in kept if proof.failed]
    if failed:
        sentence = f"It fits {judged.adapter} by its source, but its rasterizer draws otherwise."
        judged = replace(judged, sentence=sentence, reason="; ".join(failed))
    elif proved:
        sentence = f"It fits {judged.adapter}, and its rasterizer was proved on this machine."
        judged = replace(judged, sentence=sentence, reason="")
    elif above := "" if fitting else _above(repo, adapters, plugins):
        judged = replace(judged, sentence=above)
    missing = _missing(repo, fits) if isinstance(fits, ScriptAdapter) else []
    lines = [f"{repo.root}" + (f", commit {repo.commit}" if repo.commit else "")]
    lines += ["", judged.sentence]
    lines += [f"  {proof}" for proof in failed or proved]
    if adapter:
        lines += ["", *_in_full(tried, fitting)]
    elif judged.kind != "inside":  # its sentence is the command to go on with
        lines += ["", *_in_short([*tried.values()], [*fitting.values()], judged.differs)]
    if missing:
        lines += ["", f"Not installed, but imported: {', '.join(map(str, missing))}"]
        lines += [f"  {way}" for way in install(missing).splitlines()]
    if "fragprune check" not in judged.sentence:
        lines += ["", _conclusion(repo, fitting)]
    data = {
        "host": str(host),
        "commit": repo.commit,
        **judged.as_dict(),
        "fits": fits.name if fits else None,
        "proved": proved,
        "failed": failed,
        "missing": [vars(each) | {"distribution": each.distribution} for each in missing],
        "adapters": [_as_dict(*each) for each in tried.items()],
    }
    return Report(data, "\n".join(lines), exit_code=0 if fits and not failed else 1)


def _table(hosts: tuple[Path, ...], adapters: list[HostAdapter], plugins: Plugins) -> Report:
    """A row for each checkout."""
    rows = []
    for each in tqdm(hosts, "reading", unit="checkout", leave=False, disable=None):
        repo = _repository(each, adapters, None)
        judged = judge(repo, attempt(repo, adapters), adapters, plugins)
        rows.append({"host": each.name, "commit": repo.commit, **judged.as_dict()})
    titles = ("checkout", "verdict", "nearest", "reason", "differs")
    lines = [f"| {' | '.join(titles)} |", "|---|---|---|---|---|"]
    for row in rows:
        inside = [f"{name}/ fits {fits}" for name, fits in row["inside"].items()]
        cells = [row["host"], row["verdict"], row["nearest"], row["reason"]]
        cells.append("; ".join([*inside, *row["differs"]]))
        lines.append(f"| {' | '.join(cell.replace('|', '/') or '-' for cell in cells)} |")
    counts = {kind: sum(row["verdict"] == kind for row in rows) for kind in _KINDS}
    lines += ["", ", ".join(f"{kind}: {number}" for kind, number in counts.items())]
    return Report({"hosts": rows, "counts": counts}, "\n".join(lines))


_NEAREST = 3  # adapters that are named where none fits
_KINDS = ("fits", "several", "inside", "finetune", "never")


def _in_short(tried: list[Match], fitting: list[Match], differs: Sequence[str]) -> list[str]:
    """A line for each adapter that fits; else how the nearest differs, and the next reasons."""
    reasons = {m.errors[0].found: m for m in reversed(tried) if m.held and m.errors}
    nearest = [each for each in tried if each in reasons.values()]  # of one reason the first
    shown = fitting or nearest[:_NEAREST]
    if not shown:
        return [f"None of {len(tried)} adapters knows anything of it."]
    ancestors = [each for each in tried if each.fits and each not in shown]
    others = len(tried) - len(shown) - len(ancestors)
    lines = [] if fitting else [f"{shown[0]}:", *(f"  {each}" for each in differs)]
    lines += [each.brief() for each in (shown if fitting else shown[1:])]
    lines += [_beside(each, fitting) for each in ancestors]
    return lines + ([f"{others} others do not fit (--adapter NAME says why)."] if others else [])


def _beside(match: Match, fitting: Iterable[Match]) -> str:
    """A line for an adapter that is not among the best fits, with the reason."""
    nearer = ", ".join(each.adapter for each in fitting)
    return f"{match}; {match.errors[0] if match.errors else f'{nearer} descends from it'}"


_SIGNS = {"missing": "MISSING in", "changed": "CHANGED at", "at import": "(checked at import)"}


def _in_full(tried: Mapping[HostAdapter, Match], fitting: Mapping[HostAdapter, Match]) -> list[str]:
    """All seams of the adapters that fit, or of the nearest; the first error of each other one."""
    shown = fitting or dict([*tried.items()][:1])
    lines = []
    for adapter, match in shown.items():
        info, of_seams = adapter.info, [state.finding for state in match.seams]
        lines += ["", f"{match} ({info.title}, {info.repo})"]
        lines += [f"  {finding}" for finding in match.findings if finding not in of_seams]
        for state in match.seams:
            at = state.at if state.status == "found" else f"{_SIGNS[state.status]} {state.at}"
            if state.finding and state.status == "changed":
                at += f": {state.finding.found}; expected {state.finding.expected}"
            lines.append(f"  {state.seam.role.name.lower():<10} {state.seam!s:<62} {at.strip()}")
        if match.fits and info.limits:
            lines += ["  What does not work:", *(f"  - {limit}" for limit in info.limits)]
    others = [match for each, match in tried.items() if each not in shown]
    lines += ["", "Others:"] if others else []
    return [*lines, *(f"  {_beside(each, fitting.values())}" for each in others)]


def _as_dict(adapter: HostAdapter, match: Match) -> dict[str, Any]:
    """All findings and seams of one adapter, for --json."""
    return {
        "adapter": adapter.name,
        "fits": match.fits,
        "seams_held": match.held,
        "seams_looked_up": match.looked_up,
        "findings": [finding.as_dict() for finding in match.findings],
        "limits": list(adapter.info.limits),
        "seams": [
            {"role": s.seam.role.name, "seam": str(s.seam), "status": s.status, "at": s.at}
            for s in match.seams
        ],
    }


def _missing(repo: HostRepo, adapter: ScriptAdapter) -> list[Missing]:
    """Packages that the training scripts import and that are not installed."""
    scripts, dialect = adapter.command_line(repo).scripts, adapter.dialect(repo)
    answered = {*dialect.names(), *dialect.unneeded}
    return missing_imports(repo, [repo.root / name for name in scripts], answered)


def _kept(repo: HostRepo, dialect: Dialect) -> list[Proof]:
    """The kept proofs of a host's compiled packages as they are installed or vendored now."""
    found: dict[str, Proof] = {}
    for name in sorted(dialect.names()):
        file = repo.path(name)
        if file is None and "." not in name and name not in sys.modules:
            spec = find_spec(name)
            file = Path(spec.origin) if spec and spec.origin else None
        pattern = proofs.file_of(proofs.digest_of(file), "*") if file else None
        for path in sorted(pattern.parent.glob(pattern.name)) if pattern else ():
            proof = proofs.read(path)
            excused = proof and proof.failed and dialect.prover and dialect.prover.otherwise
            if proof is not None and not excused:  # a host that is known to draw otherwise
                found[str(proof)] = proof
    return list(found.values())


def _repository(host: Path, adapters: list[HostAdapter], name: str | None) -> HostRepo:
    """The installed package, if that is meant or used; else the folder, and nothing outside it."""
    if not host.is_dir() and (package := HostRepo.installed(str(host))) is not None:
        return package
    repo = HostRepo(host)  # read once, also by the table
    try:
        return locate(repo, adapters, name, above=False)[0]
    except UnknownHostError:
        return repo


def _above(repo: HostRepo, adapters: list[HostAdapter], plugins: Plugins) -> str:
    """That run serves the folder above, if scripts of this one use it; else ""."""
    for above in folder_above(repo):
        fits = next(iter(closest(attempt(above, adapters), adapters)), None)
        if fits or models_of(above, plugins)[0]:
            which = f"fits {fits.name}" if fits else "saves plain 3DGS"
            found = f"Its scripts use the folder above, which {which}, as run finds"
            return f"{found}: fragprune check {quoted(above.root)}"
    return ""


def _conclusion(repo: HostRepo, fitting: Collection[HostAdapter]) -> str:
    if len(fitting) == 1:
        return f"Use: {usage(next(iter(fitting)), repo)}"
    if fitting:
        names = ", ".join(each.name for each in fitting)
        return f"Several adapters fit: {names}. Name one with fragprune run --adapter."
    return (
        "To write an adapter: the documentation's page Write an adapter in 30 minutes, or "
        "python -m pydoc fragprune_plugins.adapting"
    )


_PLAIN = "No adapter fits, but its PLY is plain 3DGS, and this prunes it:"
_BY_RUN = "fragprune run in front of its training command does both"
_PLY = "OUTPUT/point_cloud/iteration_30000/point_cloud.ply"
_SHOWN = 8


@dataclass(frozen=True)
class Verdict:
    """What a checkout can do: an adapter fits, several do, one fits a folder inside of it, none but
    its PLY is plain 3DGS and can be fine-tuned, or never.
    """

    kind: Literal["fits", "several", "inside", "finetune", "never"]
    sentence: str
    reason: str = ""  # what speaks against the better answer
    adapter: str = ""  # that fits, or the nearest, if one finds a seam
    differs: tuple[str, ...] = ()  # the differences from its host
    inside: tuple[tuple[str, str], ...] = ()  # folders of the checkout that fit, and their adapter

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for ``--json``."""
        known = vars(self) | {"differs": list(self.differs), "inside": dict(self.inside)}
        named = {"kind": "verdict", "adapter": "nearest"}
        return {named.get(name, name): each for name, each in known.items()}


def judge(
    repo: HostRepo,
    tried: Mapping[HostAdapter, Match],
    adapters: Sequence[HostAdapter],
    plugins: Plugins,
) -> Verdict:
    """Judge a checkout by the matches of adapters with it, the nearest first.

    Plugins tell which models it saves, where no adapter fits.
    """
    fitting = closest(tried, adapters)
    if len(fitting) == 1:
        ((adapter, match),) = fitting.items()
        warned = [each.found for each in match.findings if each.level == "warning"]
        told = "; ".join(filter(None, [*warned, adapter.dialect(repo).unproved(repo)]))
        unproved = told or "its picture; the rule in its vendored rasterizer is the known one"
        sentence = f"It fits {adapter.name}. Not proved: {unproved}."
        return Verdict("fits", sentence, unproved, adapter.name)
    if fitting:
        names = ", ".join(each.name for each in fitting)
        return Verdict("several", f"Several adapters fit: {names}. Name one with --adapter.")
    own, *others = models_of(repo, plugins)
    inside = _inside(repo, others, adapters)
    nearest = next((each for each, match in tried.items() if match.held), None)
    name = nearest.name if nearest else ""
    differs = differences(repo, tried[nearest], own.elsewhere) if nearest else ()
    plain = own
    if not own.model and not inside:
        found = [each for each in others if each.model]
        plain = next(filter(None, found), next(iter(found), own))
    if plain:
        shown = "--self" if plain.unlike else "--data SCENE"
        sentence = f"{_PLAIN} fragprune finetune {_PLY} {shown} --out pruned.ply"
        if plain is own:  # what a folder saves, run does not look for
            sentence += f" ({_BY_RUN}: it trains as it is, then that follows)"
        if plain.unlike:
            sentence += f". Photographs are left out: {plain.unlike}"
        return Verdict("finetune", sentence, plain.unlike, name, differs, inside)
    if inside:
        sentence = " ".join(
            f"Its folder {folder}/ fits {fits}: fragprune check {quoted(repo.root / folder)}"
            for folder, fits in inside
        )
        return Verdict("inside", sentence, own.reasons[0], name, differs, inside)
    if nearest and nearest.installed and tried[nearest].held == tried[nearest].looked_up:
        package = nearest.installed[0]
        reason = f"it is the source of {package}, which is served once it is installed"
        sentence = f"Not here: {reason}. pip install {quoted(repo.root)}; fragprune check {package}"
        return Verdict("never", sentence, reason, name, differs)
    reason = f"{plain.folder}/: {plain.reasons[0]}" if plain.folder else plain.reasons[0]
    return Verdict("never", f"Not possible: {reason}.", reason, name, differs)


def differences(repo: HostRepo, match: Match, elsewhere: str) -> tuple[str, ...]:
    """How a checkout differs from an adapter's host, whose model may be ``elsewhere``, in lines."""
    lines: dict[str, None] = {elsewhere: None} if elsewhere else {}
    missing: list[str] = []
    for finding in match.errors:
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
        if fits := next(iter(closest(tried, adapters)), None):
            found.append((each.folder, fits.name))
    return tuple(found)
