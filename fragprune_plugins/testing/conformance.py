"""The class from which an adapter's tests inherit: a test for each invariant, on every host."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import pytest

from fragprune_plugins.hosts.adapter import HostAdapter
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.testing import invariants
from fragprune_plugins.testing.fresh import FreshProcessError, NotApplicable, fresh
from fragprune_plugins.testing.host import Host
from fragprune_plugins.testing.invariants import Case

MINIATURE, INSTALLED = "miniature", "installed"


class AdapterConformance:
    """Inherit from this class and name the adapter and its host: each invariant is then a test.

    Each test runs in its own process: on the miniature that ``host`` writes or the installed
    package that it names, and on every folder in the folder ``FRAGPRUNE_HOSTS`` that holds a
    checkout that the adapter fits, or another release of the package.

    Attributes:
        adapter: the name of an installed adapter, or the adapter itself.
        host: how to drive its host.
        examples: number of sequences of row operations to try.
        longest_order: longest sequence of import, activation and deactivation, 1 to 5.
    """

    adapter: ClassVar[str | HostAdapter]
    host: ClassVar[type[Host]] = Host
    examples: ClassVar[int] = 10
    longest_order: ClassVar[int] = 3

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrise the tests: one set for each host."""
        if "place" in metafunc.fixturenames:
            found = _checkouts(os.environ.get("FRAGPRUNE_HOSTS", ""))
            adapter, package = found_adapter(self.adapter), self.host.package
            fitting = [path for path in found if adapter.match(HostRepo(path, package)).fits]
            first = INSTALLED if self.host.package else MINIATURE
            names = [first, *(path.name for path in fitting)]
            variant = f" {self.host.variant}" if self.host.variant else ""
            ids = [name + variant for name in names]
            metafunc.parametrize("place", [None, *fitting], ids=ids)

    @pytest.fixture
    def case(self, place: Path | None, tmp_path: Path) -> Case:
        """The adapter and its host. Each test writes a new miniature."""
        driver, root = self.host(), place or tmp_path
        if place is None and driver.package:
            installed = HostRepo.installed(driver.package)
            if installed is None:
                pytest.skip(f"{driver.package} is not installed")
            root = installed.root
        elif place is None:
            driver.write(tmp_path)
        return Case(found_adapter(self.adapter), driver, root, self.examples, self.longest_order)

    @pytest.fixture
    def check(self) -> Callable[..., None]:
        """Run checks in fresh processes."""

        def run(*calls: tuple[Any, ...]) -> None:
            failure = ""
            for call in calls:
                try:
                    fresh(*call)
                except NotApplicable as reason:
                    pytest.skip(str(reason))
                except FreshProcessError as error:
                    failure = str(error)
                if failure:  # here, or pytest would print it twice
                    pytest.fail(failure, pytrace=False)

        return run

    def test_off_is_off(self, case: Case, check: Any) -> None:
        """While inactive, the host's own objects are in place, in every order of import."""
        each = [(invariants.off_is_off, case, order) for order in invariants.orders(case.longest)]
        check(*each, (invariants.nothing_stays, case))

    def test_neutral_is_the_host(self, case: Case, check: Any) -> None:
        """Neutral thresholds leave parameters, random streams and pictures the same, to the bit."""
        check((invariants.neutral_is_the_host, case))

    def test_alignment(self, case: Case, check: Any) -> None:
        """Thresholds follow their rows through any sequence of row operations."""
        check((invariants.alignment, case))

    def test_monotone(self, case: Case, check: Any) -> None:
        """A higher threshold never adds fragments, and can remove a Gaussian completely."""
        check((invariants.monotone, case))

    def test_model_file(self, case: Case, check: Any) -> None:
        """A saved model is loaded with its thresholds."""
        check((invariants.model_file, case))

    def test_checkpoint(self, case: Case, check: Any) -> None:
        """A checkpoint restores the model and its thresholds."""
        check((invariants.checkpoint, case))

    def test_freeze(self, case: Case, check: Any) -> None:
        """Stage 2 moves exactly the parameters that ``--train`` names."""
        check((invariants.freeze, case))

    def test_refuse(self, case: Case, check: Any) -> None:
        """A changed host is refused, and the error names the change."""
        check((invariants.refuse, case))

    def test_same_picture(self, case: Case, check: Any) -> None:
        """Every engine draws the same picture, with the same gradients."""
        check((invariants.same_picture, case))


def found_adapter(adapter: str | HostAdapter) -> HostAdapter:
    """The adapter of this name, or itself; LookupError if none is installed."""
    if isinstance(adapter, HostAdapter):
        return adapter
    if adapter not in _installed():
        known = ", ".join(_installed()) or "no adapters"
        raise LookupError(f"adapter {adapter!r}: none of {known}")
    return _installed()[adapter]


@cache
def _installed() -> dict[str, HostAdapter]:
    return {each.name: each for each in load_plugins().adapters}


@cache
def _checkouts(folder: str) -> list[Path]:
    """Folders that may be checkouts of hosts: the given folder and its subfolders."""
    if not folder:
        return []
    root = Path(folder).resolve()
    return [path for path in (root, *sorted(root.iterdir())) if path.is_dir()]
