"""The kit finds what it is there to find, and says so."""

import os
import sys
import time
from importlib.metadata import entry_points

import pytest
from conformance import broken_adapters as broken
from conformance import test_hosts
from installed.gaussian_splatting_host import GaussianSplattingHost
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins import testing
from fragprune_plugins.adapting import HostRepo, Role
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.testing import Host, conformance, invariants
from fragprune_plugins.testing.fresh import FreshProcessError, NotApplicable, fresh
from fragprune_plugins.testing.plugin import NOT_APPLICABLE, WHAT, results_of, table
from fragprune_vanilla_3dgs import Vanilla3DGS


def case(adapter, **options):
    return invariants.Case(adapter, Host(), HOST, **options)


@pytest.mark.parametrize(
    ("check", "adapter", "words"),
    [
        (invariants.nothing_stays, broken.PatchesByHand, "could not be restored"),
        (invariants.neutral_is_the_host, broken.TakesRandomNumbers, "differ from the host's own"),
        (invariants.alignment, broken.LosesParents, "descends from"),
        (invariants.monotone, broken.LeavesATrace, "not close"),
        (invariants.monotone, broken.ForgetsTheBackground, "the background is off by 0.9"),
        (invariants.monotone, broken.GivesNoRadii, "no Gaussian has a radius"),
        (invariants.checkpoint, broken.LosesTheCheckpoint, "of a restored model differ"),
        (invariants.checkpoint, broken.LeavesParametersAsleep, "resumed, ['f_dc', 'opacity',"),
        (invariants.checkpoint, broken.LeavesItsRates, "resumed, rates are"),
        (invariants.freeze, broken.TrainsTooMuch, "moved ['opacity', 'scaling']"),
        (invariants.freeze, broken.LeavesParametersAsleep, "left other parameters asking"),
        (invariants.freeze, broken.LetsItGrow, "densify and prune made "),
        (invariants.freeze, broken.LetsItReset, "reset opacity changed opacity"),
        (invariants.model_file, broken.SavesNothing, "no sidecar was written"),
        (invariants.refuse, broken.FitsEverything, "still taken for the host"),
        (invariants.refuse, broken.ReadsNoSource, "takes one value more"),
        (invariants.same_picture, broken.DrawsOtherwiseEachTime, "other fragments drawn"),
    ],
    ids=lambda value: getattr(value, "__name__", "words"),
)
def test_each_fault_is_found_by_its_invariant(check, adapter, words):
    with pytest.raises(FreshProcessError) as caught:
        fresh(check, case(adapter(), examples=1))
    assert words in str(caught.value)


def test_a_checkout_may_be_named_from_where_pytest_runs(tmp_path, monkeypatch):
    Host().write(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    checkout = conformance._checkouts(".")[-1]
    fresh(invariants.monotone, invariants.Case(Vanilla3DGS(), Host(), checkout, examples=1))


def test_a_fault_is_found_on_the_package_that_shows_it():
    installed = HostRepo.installed(GaussianSplattingHost().package)
    if installed is None:
        pytest.skip("gaussian-splatting is not installed")
    case = broken.HoldsStepsBack(), GaussianSplattingHost(), installed.root
    with pytest.raises(FreshProcessError, match="0 threshold steps of 4"):
        fresh(invariants.freeze, invariants.Case(*case, examples=1))


def test_a_host_that_forgets_to_be_followed_is_found():
    """Rows that change without a seam: the driver's own action goes past the host's methods."""
    with pytest.raises(FreshProcessError, match="16 thresholds for 12 Gaussians"):
        fresh(invariants.alignment, invariants.Case(Vanilla3DGS(), Forgetful(), HOST, examples=3))


class Forgetful(Host):
    def actions(self):
        return {"behind the back": behind_the_back}


def behind_the_back(model, arguments, chance):
    for group in model.optimizer.param_groups:
        name = {"f_dc": "features_dc", "f_rest": "features_rest"}.get(group["name"], group["name"])
        setattr(model, f"_{name}", group["params"][0][:-4])


@pytest.mark.parametrize("longest", [1, 2, 3, 4])
def test_orders_have_one_import_and_end_anywhere(longest):
    found = invariants.orders(longest)
    assert len(found) == len(set(found)) == {1: 1, 2: 5, 3: 13, 4: 25}[longest]
    assert all(order.count("I") == 1 and order.count("A") <= 2 for order in found)


def raises():
    print("on the way")
    raise ValueError("a fault")


def skips():
    raise NotApplicable("nothing here")


def test_what_a_fresh_process_does_comes_back():
    assert fresh(os.path.join, "a", "b") == "a/b"
    assert fresh(os.getpid) != fresh(os.getpid) != os.getpid()
    with pytest.raises(FreshProcessError, match=r"on the way[\s\S]*ValueError: a fault"):
        fresh(raises)
    with pytest.raises(NotApplicable, match="nothing here"):
        fresh(skips)
    with pytest.raises(FreshProcessError, match="exit code 3"):
        fresh(os._exit, 3)
    with pytest.raises(FreshProcessError, match=r"longer than 0\.1 seconds"):
        fresh(time.sleep, 60, seconds=0.1)


def test_the_table_has_adapters_down_and_invariants_across():
    results = [
        {"adapter": a, "host": h, "invariant": i, "outcome": o}
        for a, h, i, o in [
            ("one", "miniature", "freeze", "passed"),
            ("one", "miniature", "alignment", "failed"),
            ("another", "checkout", "freeze", "skipped"),
            ("another", "checkout", "alignment", "n/a"),
        ]
    ]
    assert [line.split() for line in table(results)] == [
        ["adapter", "host", "freeze", "alignment"],
        ["one", "miniature", "ok", "FAILED"],
        ["another", "checkout", "skipped", "n/a"],
    ]


def test_the_tables_results_are_the_reports_of_the_kit_in_the_order_of_its_tests(request):
    def report(invariant, outcome, start, when="call", reason=None):
        about = [(WHAT, ["one", "miniature", invariant])] if invariant else []
        given = ("file::test", ("file", 1, "test"), {}, outcome, reason, when)
        return pytest.TestReport(*given, duration=1.25, start=start, user_properties=about)

    absent = ("file", 1, f"Skipped: {NOT_APPLICABLE}it has none")
    stats = {
        "": [report("freeze", "passed", 1.0, "setup")],
        "passed": [report("freeze", "passed", 2.0), report("", "passed", 0.0)],
        "skipped": [report("checkpoint", "skipped", 1.5, "setup", absent)],
        "failed": [report("refuse", "failed", 0.5, reason="E   it fits")],
        "deselected": [request.node],
    }
    found = [[each[k] for k in ("invariant", "outcome", "reason")] for each in results_of(stats)]
    assert found == [
        ["refuse", "failed", "E   it fits"],
        ["checkpoint", "n/a", "it has none"],
        ["freeze", "passed", ""],
    ]


def test_pytest_does_not_load_the_kits_plugin_by_itself():
    modules = [entry.module for entry in entry_points(group="pytest11")]
    assert not [module for module in modules if module.startswith("fragprune")]


def test_every_adapter_is_driven():
    said = {getattr(each, "adapter", "") for each in vars(test_hosts).values()} - {""}
    adapters = load_plugins().adapters
    # A method has its host's whole package under it, whose own tests are in tests/studio.
    assert said == {each.name for each in adapters if not each.info.usage}


class Unsaved(Host):
    lacks = {"model file": "nobody keeps it"}  # noqa: RUF012


@pytest.mark.parametrize("check", [invariants.model_file, invariants.checkpoint])
def test_a_promise_that_a_host_cannot_be_asked_needs_a_reason(check):
    class Seamless(Vanilla3DGS):
        seams = tuple(seam for seam in Vanilla3DGS.seams if seam.role in (Role.ATTACH, Role.STEP))

    unsaid = invariants.Case(Seamless(), Host(), HOST)
    with pytest.raises(AssertionError, match=r"no seam for (SAVE|CAPTURE and RESTORE)"):
        check(unsaid)


def test_a_reason_is_given_where_a_promise_cannot_be_asked():
    with pytest.raises(NotApplicable, match="nobody keeps it"):
        fresh(invariants.model_file, invariants.Case(Vanilla3DGS(), Unsaved(), HOST))


def test_without_its_packages_the_kit_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "fragprune_plugins.testing.conformance", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'fragprune-plugins\[test\]'"):
        _ = testing.AdapterConformance
