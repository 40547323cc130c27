"""``fragprune check``: which adapter fits a codebase, from its source alone."""

from __future__ import annotations

from pathlib import Path

import click

from fragprune_plugins.cli.common import FILE, Command, Report


@click.command("check", cls=Command)
@click.argument("host", type=FILE)
@click.option("--adapter", help="Check this adapter only.")
def command(host: Path, adapter: str | None) -> Report:
    """Read HOST, a training repository, and say which adapter fits and what speaks against it.

    Nothing is imported or run; no GPU is needed. Exit code 0 when exactly one adapter fits.

    \b
    Example:
      fragprune check ~/code/gaussian-splatting
    """
    from fragprune_plugins.detect import HostRepo
    from fragprune_plugins.errors import UnknownHostError
    from fragprune_plugins.plugins import load_plugins

    if not host.is_dir():
        raise UnknownHostError(
            str(host), "no such folder", "a host's checkout", "Name the folder of train.py."
        )
    repo = HostRepo(host)
    adapters = load_plugins().adapters
    if adapter is not None:
        adapters = [a for a in adapters if a.name == adapter.replace("_", "-")]
        if not adapters:
            raise UnknownHostError(
                "--adapter", repr(adapter), "an installed adapter", "Run fragprune adapters."
            )
    lines, data, fitting = [], [], []
    for candidate in adapters:
        match = candidate.match(repo)
        fitting += [candidate] if match.fits else []
        lines.append(f"{candidate.name}: {'fits' if match.fits else 'does not fit'}")
        lines += [f"  {finding}" for finding in match.findings]
        places = []
        for seam in candidate.seams_for(repo):
            function = None if seam.external else repo.function(seam.module, seam.attribute)
            path = repo.path(seam.module)
            place = (
                f"{path.relative_to(repo.root)}:{function.lineno}" if function and path else None
            )
            status = "at import" if seam.external else (place or "missing")
            places.append({"role": seam.role.name, "seam": str(seam), "at": status})
            lines.append(f"  {seam.role.name.lower():<10} {seam!s:<62} {status}")
        data.append(
            {
                "adapter": candidate.name,
                "confidence": match.confidence,
                "findings": [finding.as_dict() for finding in match.findings],
                "seams": places,
            }
        )
    verdict = fitting[0].name if len(fitting) == 1 else None
    scripts = [host / fit.command_line(repo).scripts[0] for fit in fitting]
    lines.append(f"Use: fragprune run -- python {scripts[0]} ..." if verdict else "No fit.")
    report = {"host": str(host), "commit": repo.commit, "fits": verdict, "adapters": data}
    return Report(report, "\n".join(lines), exit_code=0 if verdict else 1)
