"""Every order of import, activate and deactivate, for adapters whose hosts have no miniature.

Modules are made from the adapter's seams and nothing else, so an adapter that declares a new seam
is tested in every order without a line here. Each order has its own process. The other adapters go
through all orders with their hosts, in tests/conformance.
"""

from __future__ import annotations

from itertools import product

import pytest

from fragprune_plugins.hosts.seams import Seam
from fragprune_plugins.plugins.loading import load_plugins

WITHOUT_A_MINIATURE = ("compact-3dgs", "gaussian-splatting", "gsplat")
ADAPTERS = {
    adapter.name: adapter
    for adapter in load_plugins().adapters
    if adapter.name in WITHOUT_A_MINIATURE
}

ORDERS = [
    "".join(order)
    for length in range(1, 6)
    for order in product("IAD", repeat=length)
    if order.count("I") == 1 and order.count("A") <= 2
]
"""I imports every module, A activates, D deactivates; one import, at any point."""

PROGRAM = """
import json, sys
from importlib import import_module
from fragprune_plugins.injection.patching import PatchLedger
from fragprune_plugins.plugins.loading import load_plugins

adapter, = (a for a in load_plugins().adapters if a.name == sys.argv[1])
modules = list(dict.fromkeys(seam.module for seam in adapter.seams))
ledger, calls, originals, findings = None, [], None, []

def find(seam):
    value = import_module(seam.module)
    for name in seam.attribute.split("."):
        value = value.__dict__[name] if isinstance(value, type) else getattr(value, name)
    return value

def pure(seam):
    return import_module(seam.module).PURE[seam.attribute]

def check():
    if originals is None:
        return
    for seam in adapter.seams:
        assert (find(seam) is pure(seam)) == (ledger is None), (seam, order)

def wrapper(wrapped, instance, args, kwargs):
    calls.append(wrapped)
    return wrapped(*args, **kwargs)

for order in sys.argv[2]:
    if order == "I":
        for module in modules:
            import_module(module)
        originals = True
    elif order == "A" and ledger is None:
        ledger = PatchLedger()
        for seam in adapter.seams:
            ledger.wrap(seam, wrapper)
    elif order == "D" and ledger is not None:
        findings += ledger.undo()
        ledger = None
    check()
assert not findings, findings
real_torch = hasattr(sys.modules.get("torch"), "__version__")
assert not real_torch
print(json.dumps(real_torch))
"""


def write_modules(folder, seams: tuple[Seam, ...]) -> None:
    """Packages with one function or method a seam; ``PURE`` keeps what each was born with."""
    modules: dict[str, dict[str, tuple[str, ...]]] = {}
    for seam in seams:
        attributes = modules.setdefault(seam.module, {})  # one function may have several roles
        needs = (*attributes.get(seam.attribute, ()), *seam.needs)
        attributes[seam.attribute] = tuple(dict.fromkeys(needs))
    for name, attributes in modules.items():
        classes: dict[str, list[str]] = {}
        lines, pure = [], []
        for attribute, needs in attributes.items():
            head, _, method = attribute.partition(".")
            if method:
                body = f"    def {method}(self{''.join(', ' + n for n in needs)}): ..."
                classes.setdefault(head, []).append(body)
                pure.append(f"{attribute!r}: vars({head})[{method!r}]")
            else:
                lines.append(f"def {head}({', '.join(needs)}): ...")
                pure.append(f"{attribute!r}: {head}")
        for head, bodies in classes.items():
            lines += [f"class {head}:", *bodies]
        lines.append(f"PURE = {{{', '.join(pure)}}}")
        path = folder.joinpath(*name.split("."))
        path.mkdir(parents=True, exist_ok=True)
        (path / "__init__.py").write_text("\n".join(lines) + "\n")
    for name in modules:  # packages, or an installed host of that name would come first
        for parent in folder.joinpath(*name.split(".")).relative_to(folder).parents[:-1]:
            (folder / parent / "__init__.py").touch()


@pytest.mark.parametrize("order", [o for o in ORDERS if len(o) <= 3])
@pytest.mark.parametrize("name", ADAPTERS)
def test_originals_are_in_place_whenever_we_are_not_active(tmp_path, python, name, order):
    write_modules(tmp_path / "host", ADAPTERS[name].seams)
    assert python(PROGRAM, name, order, path=tmp_path / "host") is False


@pytest.mark.slow
@pytest.mark.parametrize("order", [o for o in ORDERS if len(o) > 3])
@pytest.mark.parametrize("name", ADAPTERS)
def test_originals_are_in_place_in_longer_orders_too(tmp_path, python, name, order):
    write_modules(tmp_path / "host", ADAPTERS[name].seams)
    assert python(PROGRAM, name, order, path=tmp_path / "host") is False


LATER = """
import json, sys
from importlib import import_module
from fragprune_plugins.errors import SeamError
from fragprune_plugins.injection.patching import PatchLedger
from fragprune_plugins.plugins.loading import load_plugins
adapter, = (a for a in load_plugins().adapters if a.name == sys.argv[1])
ledger = PatchLedger()
for seam in adapter.seams:
    ledger.wrap(seam, lambda wrapped, instance, args, kwargs: wrapped(*args, **kwargs))
refused = []
for seam in adapter.seams:
    try:
        import_module(seam.module)
    except SeamError as error:
        refused.append(str(error))
        assert seam.module not in sys.modules
assert ledger.undo() == []
print(json.dumps(refused))
"""


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_host_that_changed_cannot_even_be_imported(tmp_path, python, name):
    changed = next(s for s in ADAPTERS[name].seams if s.needs)
    seams = tuple(
        Seam(s.role, s.module, s.attribute, s.needs[1:]) if s is changed else s
        for s in ADAPTERS[name].seams
    )
    write_modules(tmp_path / "host", seams)
    refused = python(LATER, name, path=tmp_path / "host")
    assert refused
    assert all(str(changed) in text and changed.needs[0] in text for text in refused)
