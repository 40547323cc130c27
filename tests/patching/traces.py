"""What a session could leave behind in a process: a snapshot, and what differs from it later."""

import atexit
import io
import locale
import logging
import os
import random
import signal
import sys
import tempfile
import threading
import warnings
from collections import OrderedDict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageMode

Place = tuple[str, str]
"""Name of a module, and of an attribute or of a member of a class that the module defines."""

EXCLUDED: dict[Place, str] = {
    ("sys", "modules"): "modules that are imported stay; the host's own are looked for by name",
    ("sys", "path_importer_cache"): "Python's cache of folders",
    ("sys", "meta_path"): "wrapt adds one finder for its life; nothing else may (see settings)",
    ("wrapt.importer", "_post_import_hooks_init"): "that wrapt has added its finder",
    ("wrapt.importer", "_post_import_hooks"): "no way to unregister; ours hold and do nothing",
    ("re", "_cache"): "a cache",
    ("re", "_cache2"): "a cache",
    ("triton.language.extra", "modules"): "sys.modules by another name",
    ("ctypes", "_pointer_type_cache"): "a cache",
    ("_ctypes", "_pointer_type_cache"): "a cache",
    ("linecache", "cache"): "a cache of source lines, filled by tracebacks",
    ("torch.utils.hooks", "RemovableHandle.next_id"): "torch's counter of hooks ever made",
}


def warm_up() -> None:
    """Use what a host uses, without fragprune: libraries change themselves at first use."""
    from tqdm import tqdm

    Image.init()
    ImageMode.getmode("L")
    weight = torch.ones(3, requires_grad=True)
    optimizer = torch.optim.Adam([weight])
    for _ in tqdm(range(1), file=io.StringIO()):
        weight.sum().backward()
        optimizer.step()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "state")
        torch.save(optimizer.state_dict(), file)
        torch.load(file, weights_only=True)


def random_streams() -> list[str]:
    """The states of the random streams of Python, NumPy and torch."""
    kind, keys, *more = np.random.get_state()
    numpy = (kind, keys.tolist(), *more)
    return [str(each) for each in (random.getstate(), numpy, torch.get_rng_state().tolist())]


def objects() -> dict[Place, Any]:
    """All attributes of imported modules, and members of the classes that these define."""
    found: dict[Place, Any] = {}
    for name, module in list(sys.modules.items()):
        if not isinstance(module, ModuleType):
            continue
        for attribute, value in list(vars(module).items()):
            found[name, attribute] = value
            if issubclass(type(value), type) and value.__module__ == name:
                for member, part in list(vars(value).items()):
                    if member != "__slotnames__":  # a cache of copyreg
                        found[name, f"{attribute}.{member}"] = part
    return found


def contents(value: Any) -> list[Any] | None:
    """The members of a container, as objects; None for another object."""
    if type(value) in (dict, OrderedDict):
        return [*value.keys(), *value.values()]
    return list(value) if type(value) in (list, set) else None


def settings() -> dict[str, Any]:
    """What belongs to the process and is no attribute of a module."""
    loggers = {"root": logging.getLogger(), **logging.Logger.manager.loggerDict}
    umask = os.umask(0)
    os.umask(umask)
    return {
        "random streams": random_streams(),
        "environment": dict(os.environ),
        "working folder": os.getcwd(),
        "umask": umask,
        "locale": locale.setlocale(locale.LC_ALL),
        "sys.path": list(sys.path),
        "sys.argv": list(sys.argv),
        "finders": [each for each in sys.meta_path if "wrapt" not in type(each).__module__],
        "warnings": list(warnings.filters),
        "handlers of logging": {
            name: (list(each.handlers), list(each.filters), each.level, each.disabled)
            for name, each in loggers.items()
            if isinstance(each, logging.Logger)
        },
        "signals": {each: signal.getsignal(each) for each in sorted(signal.valid_signals())},
        "streams": (sys.stdin, sys.stdout, sys.stderr),
        "tracing": (sys.gettrace(), sys.getprofile()),
        "functions at exit": atexit._ncallbacks(),
        "threads": sorted(each.name for each in threading.enumerate()),
        "dtype": torch.get_default_dtype(),
        "device": torch.empty(0).device,
        "function modes": list(torch.overrides._get_current_function_mode_stack()),
        "gradients": (torch.is_grad_enabled(), torch.is_inference_mode_enabled()),
        "anomalies": torch.is_anomaly_enabled(),
        "torch threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "determinism": (
            torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(),
            torch.backends.cudnn.deterministic,
            torch.backends.cudnn.benchmark,
            torch.get_float32_matmul_precision(),
        ),
        "safe globals": set(getattr(torch.serialization, "get_safe_globals", list)()),
    }


class Snapshot:
    """A process at one moment: its objects by place, kept so that none takes their identity."""

    def __init__(self) -> None:
        self.objects, self._settings = objects(), settings()
        self._modules = dict(sys.modules)
        kept = {place: contents(value) for place, value in self.objects.items()}
        self._contents = {place: value for place, value in kept.items() if value is not None}

    def differences(self, streams: list[str] | None = None) -> list[str]:
        """What is not as it was, one line each; random streams as expected, or as they were."""
        now, gone = objects(), object()
        said = []
        for place, value in self.objects.items():
            if place in EXCLUDED:
                continue
            found = now.get(place, gone)
            same_set = type(value) is set and type(found) is set and found == value
            if found is not value and not same_set:
                said.append(f"{'.'.join(place)} was {value!r:.90}, is {found!r:.90}")
        for place in now.keys() - self.objects.keys():
            if place[0] in self._modules and not isinstance(now[place], ModuleType):
                said.append(f"{'.'.join(place)} is new: {now[place]!r:.90}")
        for place, members in self._contents.items():
            new = contents(self.objects[place]) or []
            same = len(new) == len(members) and all(map(lambda a, b: a is b, members, new))
            if not same and place not in EXCLUDED:
                said.append(f"{'.'.join(place)} had {len(members)} members, has {len(new)}")
        said += [f"{name} is gone" for name in self._modules.keys() - sys.modules.keys()]
        expected = {**self._settings, "random streams": streams or self._settings["random streams"]}
        for name, value in settings().items():
            if name == "handlers of logging":  # modules that were imported may have made loggers
                value = {key: each for key, each in value.items() if key in expected[name]}
            if value != expected[name]:
                said.append(f"{name}: was {expected[name]!r:.200}, is {value!r:.200}")
        return said
