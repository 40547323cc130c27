"""The demo's host is a checkout like any other."""

from fragprune_plugins.workbench.demo.demo import HOST

ROOT = HOST.parent


def test_it_is_a_checkout_not_a_package_of_ours():
    assert not (ROOT / "__init__.py").exists()
    for file in ROOT.rglob("*.py"):
        assert "fragprune" not in file.read_text(), file
