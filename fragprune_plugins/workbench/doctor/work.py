"""Examines this installation, and compiles kernels in advance."""

from __future__ import annotations

import contextlib
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

import torch

from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.engines.cuda import driver, kernels, self_check
from fragprune_plugins.engines.cuda.frame import MACROS, blend_macros, unblend_macros
from fragprune_plugins.errors import EngineError, UsageError
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.commands.command import Report, expect_numpy

_PACKAGES = ("fragprune-plugins", "torch", "numpy", "pluggy", "wrapt", "plyfile", "scikit-image")
_AGREES = {"agrees": True, "fails": False, "could not run": None}


def examine() -> Report:
    """What is installed, and what is wrong with it."""
    packages = {name: package_version(name) for name in _PACKAGES}
    native = _cpu_engine()
    # This comes first, because a GPU may allow only one process.
    verdict = self_check.check_in_subprocess("cuda") if driver.missing() is None else None
    gpu = _cuda_engine()
    gpu["agrees"] = None if verdict is None else _AGREES[verdict.outcome]
    gpu["check"] = None if verdict is None else str(verdict)
    plugins = load_plugins()
    data: dict[str, Any] = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": packages,
        "cuda": torch.cuda.is_available(),
        "threads": torch.get_num_threads(),
        "native": native,
        "gpu": gpu,
        "engines": ["reference"] + ["cpu"] * native["available"] + ["cuda"] * gpu["available"],
        "adapters": [adapter.name for adapter in plugins.adapters],
        "findings": [finding.as_dict() for finding in plugins.findings],
    }
    of_cpu = f"its {native['build']} build, {native['path']}"
    if not native["available"]:
        of_cpu = f"missing, {native['reason']}"
    lines = [
        f"python {data['python']} on {data['platform']}",
        ", ".join(f"{name} {found or 'missing'}" for name, found in packages.items()),
        f"CUDA {'yes' if data['cuda'] else 'no'}; {data['threads']} threads",
        f"cpu engine: {of_cpu}",
        _of_cuda(gpu),
        f"engines: {', '.join(data['engines'])}",
        f"adapters: {', '.join(data['adapters']) or 'none'}",
        *(str(finding) for finding in plugins.findings),
    ]
    wrong = not native["available"] or any(f.level == "error" for f in plugins.findings)
    if not native["available"]:
        lines.append(
            "The cpu engine is missing, so the slow reference engine draws on the CPU. "
            "Install a C++17 compiler and install fragprune-plugins again."
        )
    try:
        expect_numpy()
    except EngineError as error:
        wrong = True
        lines.append(str(error))
    if verdict is not None and verdict.outcome != "agrees":
        wrong = True
        lines.append(f"{verdict}. Until then, --engine auto does not use it. {verdict.remedy}")
    return Report(data, "\n".join(lines), exit_code=1 if wrong else 0)


def build(architectures: str) -> Report:
    """Compile the kernels for a comma-separated list of architectures into the cache."""
    try:
        codes = [int(code.strip().removeprefix("sm_")) for code in architectures.split(",")]
    except ValueError:
        expected = "compute capabilities like 80,90"
        raise UsageError("--build-cuda", architectures, expected, "List numbers.") from None
    built: list[dict[str, Any]] = []
    try:
        compiler = kernels.compiler()
        for code in codes:
            target = kernels.target_of(code, compiler.architectures)
            for source, macros in VARIANTS:
                image, had = kernels.image_of(source, {**MACROS, **macros}, target, compiler)
                for name, needs in resources(image.log).items():
                    built.append({"target": target, "kernel": name, "kept": had, **needs})
    except kernels.Unavailable as why:
        remedy = "Install fragprune-plugins[cuda12] or [cuda13], and torch or nvidia-cuda-nvrtc."
        raise EngineError("--build-cuda", str(why), "NVRTC, through cuda-bindings", remedy) from why
    folder = str(kernels.cache_folder())
    data = {"compiler": f"{compiler.name} {compiler.version}", "kept": folder, "kernels": built}
    lines = [f"{data['compiler']}, kept in {folder}"]
    lines += [
        f"{k['target']} {k['kernel']}: {k['registers']} registers, {k['shared']} bytes shared, "
        f"{k['spills']} spilled{', already there' if k['kept'] else ''}"
        for k in built
    ]
    return Report(data, "\n".join(lines))


def _of_cuda(gpu: dict[str, Any]) -> str:
    if not gpu["available"]:
        return f"cuda engine: none, {gpu['reason']}. For an NVIDIA GPU: {driver.remedy()}"
    return (
        f"cuda engine: {gpu['device']}, compute capability {gpu['capability']}, "
        f"kernels by {gpu['compiler']}, kept in {gpu['kept']}: {gpu['check']}"
    )


def package_version(package: str) -> str | None:
    """The version of a package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu_engine() -> dict[str, Any]:
    """The build in use, or the reason why there is none."""
    answer = binding.chosen()
    known = isinstance(answer, binding.Library)
    facts = {name: getattr(answer, name, None) for name in ("build", "lanes", "path")}
    usable = binding.usable_builds() if known else []
    return {"available": known, **facts, "usable": usable, "reason": None if known else answer}


def _cuda_engine() -> dict[str, Any]:
    """How kernels reach the GPU, or why they cannot."""
    route = None
    with contextlib.suppress(kernels.Unavailable):
        found = kernels.compiler()
        route = f"{found.name} {found.version}"
    seen = torch.cuda.is_available()
    return {
        "available": driver.missing() is None,
        "compiler": route,
        "device": torch.cuda.get_device_name() if seen else None,
        "capability": ".".join(map(str, torch.cuda.get_device_capability())) if seen else None,
        "kept": str(kernels.cache_folder()),
        "reason": driver.missing(),
    }


_TRAINED: Final = frozenset(("means", "hook", "opacities", "scales", "rotations", "sh"))

VARIANTS: Final[tuple[tuple[str, dict[str, int]], ...]] = (
    ("scene", {}),
    ("blend", blend_macros()),
    ("blend", blend_macros(counts=True)),
    ("blend", blend_macros(stop=True)),
    *(
        ("unblend", unblend_macros(frozenset(wanted), sh_turns=True, invdepth=invdepth))
        for wanted in (_TRAINED, _TRAINED | {"thresholds"}, {"opacities", "thresholds"})
        for invdepth in (False, True)
    ),
)
"""Sources with macros that training and fine-tuning usually ask for, to be built beforehand."""


def resources(log: str) -> dict[str, dict[str, int]]:
    """The resources of each kernel, from the report of ptxas -v.

    registers, of a thread; stack, its bytes of local memory for what did not fit into them; spills,
    bytes stored there and loaded again; shared, bytes of shared memory of a block.
    """
    found = {}
    for part in log.split("Compiling entry function '")[1:]:
        stack, stores, loads = map(int, re.findall(r"(\d+) bytes (?:stack|spill)", part)[:3])
        (registers,) = re.findall(r"Used (\d+) registers", part)[:1] or (0,)
        (shared,) = re.findall(r"(\d+) bytes smem", part)[:1] or (0,)
        needs = {"registers": int(registers), "stack": stack, "spills": stores + loads}
        found[part.split("'", 1)[0]] = needs | {"shared": int(shared)}
    return found
