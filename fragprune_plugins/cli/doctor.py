"""``fragprune doctor``: what this installation has, lacks, and lost."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import click

from fragprune_plugins.cli.common import Command, Report

_PACKAGES = ("fragprune-plugins", "torch", "numpy", "pluggy", "wrapt", "plyfile", "scikit-image")


@click.command("doctor", cls=Command)
def command() -> Report:
    """Report versions, engines, the native build and plugins; paste it into a bug report.

    Exit code 1 when something is wrong that has a remedy.

    \b
    Example:
      fragprune doctor --json
    """
    import torch

    from fragprune_plugins.native import loader
    from fragprune_plugins.plugins import load_plugins

    packages = {name: _version(name) for name in _PACKAGES}
    native = loader.describe()
    plugins = load_plugins()
    data: dict[str, Any] = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
        "cuda": torch.cuda.is_available(),
        "threads": torch.get_num_threads(),
        "native": native,
        "engines": ["reference", *(["cpu"] if loader.available() else [])],
        "adapters": [adapter.name for adapter in plugins.adapters],
        "findings": [finding.as_dict() for finding in plugins.findings],
    }
    lines = [
        f"python {data['python']} on {data['platform']}",
        ", ".join(f"{name} {found or 'missing'}" for name, found in packages.items()),
        f"CUDA {'yes' if data['cuda'] else 'no'}; {data['threads']} threads",
        "native engine: " + ", ".join(f"{key} {value}" for key, value in native.items()),
        f"engines: {', '.join(data['engines'])}",
        f"adapters: {', '.join(data['adapters']) or 'none'}",
        *(str(finding) for finding in plugins.findings),
    ]
    wrong = not loader.available() or any(f.level == "error" for f in plugins.findings)
    if not loader.available():
        lines.append(
            "The cpu engine is missing: rasterization on the CPU uses the slow reference engine. "
            "Install a C++17 compiler and install fragprune-plugins again."
        )
    return Report(data, "\n".join(lines), exit_code=1 if wrong else 0)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
