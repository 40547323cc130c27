"""The ledger over modules of this test's own making."""

import sys
from types import ModuleType

import pytest

from fragprune_plugins.errors import LateImportError, SeamError
from fragprune_plugins.hosts.seams import Role, Seam
from fragprune_plugins.injection.patching import PatchLedger

NAME = "a_host_of_the_ledgers_tests"
SOURCE = """
def render(view, model, scale=1.0):
    return ("drawn", view, model, scale)

class Base:
    def save(self, path):
        return ("saved", path)

class Model(Base):
    @property
    def size(self):
        return 3

    @staticmethod
    def fixed(path):
        return ("fixed", path)
"""


@pytest.fixture
def host(monkeypatch):
    module = ModuleType(NAME)
    exec(SOURCE, module.__dict__)
    monkeypatch.setitem(sys.modules, NAME, module)
    return module


def seam(attribute, *needs):
    return Seam(Role.VIEW, NAME, attribute, needs)


def noting(calls):
    def wrapper(wrapped, instance, args, kwargs):
        calls.append((args, kwargs))
        return wrapped(*args, **kwargs)

    return wrapper


def test_copies_made_while_we_were_there_are_restored_too(host, monkeypatch):
    original, ledger = host.render, PatchLedger()
    for _ in range(2):  # two seams on one function, as hosts without a renderer class have
        ledger.wrap(seam("render", "view"), noting([]))
    other = ModuleType("another_module_of_the_ledgers_tests")
    other.render, other.draw = host.render, host.render
    monkeypatch.setitem(sys.modules, other.__name__, other)
    assert ledger.undo() == []
    assert other.render is host.render is original
    assert other.draw("view", "model") == original("view", "model")  # by another name: inert


def test_an_inherited_method_leaves_no_copy_on_the_subclass(host):
    original, before = host.Base.save, dict(vars(host.Model))
    ledger, calls = PatchLedger(), []
    ledger.wrap(seam("Model.save", "path"), noting(calls))
    assert host.Model().save("x") == ("saved", "x")
    assert calls == [(("x",), {})]
    assert ledger.undo() == []
    assert dict(vars(host.Model)) == before
    assert host.Base.save is original
    assert host.Model.save is original


def test_several_wraps_of_one_function_come_off_in_reverse(host):
    original, order = host.render, []
    ledger = PatchLedger()
    for name in "ab":
        ledger.wrap(seam("render"), lambda w, i, a, k, n=name: (order.append(n), w(*a, **k))[1])
    host.render(1, 2)
    assert order == ["b", "a"]
    assert ledger.undo() == []
    assert host.render is original


@pytest.mark.parametrize("attribute", ["nothing", "Model.nothing", "Nobody.save"])
def test_a_missing_function_is_refused_by_name(host, attribute):
    with pytest.raises(SeamError, match=f"{NAME}:{attribute}: no such function"):
        PatchLedger().wrap(seam(attribute), noting([]))


def test_a_missing_parameter_is_refused_with_the_signature_found(host):
    original, ledger = host.render, PatchLedger()
    says = r": parameters \(view, model, scale\); expected also kernel_size\."
    with pytest.raises(SeamError, match=says):
        ledger.wrap(seam("render", "view", "kernel_size"), noting([]))
    assert host.render is original


def test_a_function_bound_by_name_elsewhere_is_refused_with_the_holder(host, monkeypatch):
    holder = ModuleType("a_script_that_came_first")
    holder.render = original = host.render
    monkeypatch.setitem(sys.modules, holder.__name__, holder)
    with pytest.raises(LateImportError, match=r"a_script_that_came_first;.*activate\(\)"):
        PatchLedger().wrap(seam("render"), noting([]))
    assert host.render is original


def test_a_class_bound_elsewhere_is_no_obstacle(host, monkeypatch):
    holder = ModuleType("a_script_that_came_first")
    holder.Model = host.Model
    monkeypatch.setitem(sys.modules, holder.__name__, holder)
    ledger, calls = PatchLedger(), []
    ledger.wrap(seam("Model.save"), noting(calls))
    holder.Model().save("x")
    assert len(calls) == 1
    assert ledger.undo() == []


def test_under_a_foreign_wrapper_we_stay_inert_and_say_so(host):
    ledger, calls = PatchLedger(), []
    ledger.wrap(seam("render"), noting(calls))
    ours = host.render

    def theirs(*args, **kwargs):
        return ("theirs", ours(*args, **kwargs))

    host.render = theirs
    (finding,) = ledger.undo()
    assert (finding.level, finding.code) == ("warning", "not-undone")
    assert finding.where == f"{NAME}:render"
    assert host.render is theirs
    assert host.render(1, 2) == ("theirs", ("drawn", 1, 2, 1.0))
    assert calls == []


def test_undo_twice_is_harmless_and_a_ledger_that_is_over_wraps_nothing_more(host):
    original, ledger = host.render, PatchLedger()
    ledger.wrap(seam("render"), noting([]))
    ledger.undo()
    assert ledger.undo() == []
    ledger.wrap(seam("render"), noting([]))
    assert host.render is original


def test_positional_keyword_and_static_calls_reach_the_wrapper_alike(host):
    ledger, calls = PatchLedger(), []
    ledger.wrap(seam("Model.fixed", "path"), noting(calls))
    assert host.Model.fixed("a") == host.Model.fixed(path="a") == ("fixed", "a")
    assert calls == [(("a",), {}), ((), {"path": "a"})]
    assert ledger.undo() == []
    assert isinstance(vars(host.Model)["fixed"], staticmethod)
