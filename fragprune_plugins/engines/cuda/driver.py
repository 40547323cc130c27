"""Runs kernels on a GPU: the only place that calls CUDA's driver.

Streams and contexts are torch's. A kernel goes to torch's current stream on the tensors' device,
which need not be torch's current device.
"""

from __future__ import annotations

import ctypes
import threading
from pathlib import Path
from typing import Any

import torch

from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.engines.cuda.frame import THREADS
from fragprune_plugins.errors import EngineError, KernelError


def missing() -> str | None:
    """The reason why kernels cannot be compiled and run here; None if they can."""
    try:
        kernels.compiler()
    except kernels.Unavailable as why:
        return str(why)
    if not torch.cuda.is_available():
        return "torch sees no CUDA device"
    return None


def remedy() -> str:
    """What the user can do if ``missing`` gives a reason."""
    cuda = torch.version.cuda
    if cuda is None:
        return "Install torch for CUDA."
    old = cuda.startswith("11.")  # brings no NVRTC that we can use
    extra = "[cuda12] and nvidia-cuda-nvrtc-cu12" if old else f"[cuda{cuda.split('.')[0]}]"
    return f"Install fragprune-plugins{extra}, for torch is for CUDA {cuda}."


def version() -> str:
    """The newest CUDA version that the driver supports, and on Linux the driver's version."""
    from cuda.bindings import driver

    _, newest = driver.cuDriverGetVersion()
    try:
        return f"{newest}; {Path('/proc/driver/nvidia/version').read_text()}"
    except OSError:
        return str(newest)


class Driver:
    """Compiles, loads and launches kernels; keeps the loaded kernels for each device.

    Raises:
        EngineError: there is no compiler or no GPU.
    """

    kind = "cuda"

    def __init__(self) -> None:
        if (why := missing()) is not None:
            expected = "a CUDA device, and NVRTC, through cuda-bindings"
            instead = f"{remedy()} Or use the engine 'reference'."
            raise EngineError("engine 'cuda'", why, expected, instead)
        from cuda.bindings import driver

        self._driver: Any = driver
        self._lock = threading.Lock()
        self._contexts: dict[int, Any] = {}
        self._modules: dict[tuple[Any, ...], Any] = {}
        self._functions: dict[tuple[Any, ...], Any] = {}

    def launch(
        self,
        where: torch.device,
        source: str,
        macros: dict[str, int],
        kernel: str,
        blocks: int,
        arguments: ctypes.Structure,
    ) -> None:
        """Run a kernel on the current stream of a device; see ``frame.Device``.

        Raises:
            KernelError: the kernel does not compile or load.
            EngineError: the kernel does not start, or an earlier kernel failed.
        """
        index = torch.cuda.current_device() if where.index is None else where.index
        self._call("cuCtxPushCurrent", self._context(index))
        try:
            function = self._function(index, source, macros, kernel)
            stream = torch.cuda.current_stream(index).cuda_stream
            parameters = (ctypes.c_void_p * 1)(ctypes.addressof(arguments))
            sizes = blocks, 1, 1, THREADS, 1, 1, 0
            self._call("cuLaunchKernel", function, *sizes, stream, ctypes.addressof(parameters), 0)
        finally:
            self._call("cuCtxPopCurrent")

    def _context(self, index: int) -> Any:
        """Make torch's context current in this thread, which may not have used it before."""
        with self._lock:
            if index not in self._contexts:
                torch.cuda.init()  # type: ignore[no-untyped-call]
                self._call("cuInit", 0)
                device = self._call("cuDeviceGet", index)
                self._contexts[index] = self._call("cuDevicePrimaryCtxRetain", device)
            return self._contexts[index]

    def _function(self, index: int, source: str, macros: dict[str, int], kernel: str) -> Any:
        module = (index, source, *sorted(macros.items()))
        with self._lock:
            if module not in self._modules:
                self._modules[module] = self._load(index, source, macros)
            if (kernel, module) not in self._functions:
                named = self._modules[module], kernel.encode()
                self._functions[kernel, module] = self._call("cuModuleGetFunction", *named)
            return self._functions[kernel, module]

    def _load(self, index: int, source: str, macros: dict[str, int]) -> Any:
        """Load machine code for this GPU, or PTX if its driver refuses the machine code."""
        self._call("cuCtxSynchronize")  # or a kernel that failed earlier would seem to be a refusal
        major, minor = torch.cuda.get_device_capability(index)
        compiler = kernels.compiler()
        try:
            target = kernels.target_of(10 * major + minor, compiler.architectures)
            failures = []
            for way in dict.fromkeys((target, target.replace("sm_", "compute_"))):
                image, _ = kernels.image_of(source, macros, way, compiler)
                try:
                    return self._call("cuModuleLoadData", image.code)
                except EngineError as error:
                    failures.append(f"{way}: {error.found}")
            why = "; ".join(failures)
        except kernels.Unavailable as error:
            why = str(error)
        expected = f"code for compute capability {major}.{minor}"
        instead = f"Match {compiler.name} {compiler.version} with the GPU's driver: update the "
        instead += "driver, or install an older toolkit."
        raise KernelError(f"kernels of {source}.cu", why, expected, instead)

    def _call(self, function: str, *arguments: Any) -> Any:
        """Call a function of the driver; returns its only result, if any."""
        status, *results = getattr(self._driver, function)(*arguments)
        if int(status) != 0:
            instead = "Run again with CUDA_LAUNCH_BLOCKING=1 to find the kernel that failed."
            raise EngineError(f"CUDA driver, {function}", status.name, "CUDA_SUCCESS", instead)
        return results[0] if results else None
