"""Pages link to pages that exist; what is read off the code names it all; so do adapters."""

import re
from pathlib import Path
from runpy import run_path

import pytest
from cli.commands import run_json, succeeds

import fragprune_plugins
from fragprune_plugins import errors
from fragprune_plugins.hosts.seams import Role
from fragprune_plugins.plugins import hookspecs
from fragprune_plugins.plugins.loading import load_plugins
from fragprune_plugins.workbench.commands import cli

DOCS = Path(__file__).parents[2] / "docs"
ADAPTERS = load_plugins().adapters
MADE = run_path(str(DOCS / "generate.py"))["PAGES"]


@pytest.mark.parametrize(
    ("name", "listed"),
    [
        ("hooks.md", [name for name in vars(hookspecs) if name.startswith("fragprune_")]),
        ("roles.md", [role.name for role in Role]),
        ("python.md", [name for name in fragprune_plugins.__all__ if name != "__version__"]),
        ("command-line.md", [f"fragprune {name}" for name in cli.list_commands(None)]),
        ("errors.md", [kind.__name__ for kind in errors.FragpruneError.__subclasses__()]),
        ("adapters.md", ["HostAdapter"]),
        ("support.md", [adapter.name for adapter in ADAPTERS]),
    ],
)
def test_a_page_made_from_the_code_names_all_of_it(name, listed):
    page = MADE[name]()
    assert listed
    assert not [each for each in listed if f"`{each}" not in page and f"## {each}" not in page]


@pytest.mark.parametrize("folder", [".", "how-to", "explanation", "reference", "experiments"])
def test_links_between_pages_lead_somewhere(folder):
    made = {(DOCS / "reference" / name).resolve() for name in MADE}
    pages = DOCS.glob("*.md") if folder == "." else (DOCS / folder).rglob("*.md")
    lost = []
    for page in pages:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            file = (page.parent / target).resolve()
            if "://" not in target and not file.exists() and file not in made:
                lost.append((page.name, target))
    assert not lost


def test_every_page_is_in_the_index():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"index.md"}
    pages |= {f"reference/{name}" for name in MADE}
    assert not [page for page in sorted(pages) if f"({page})" not in index]


@pytest.mark.parametrize("adapter", ADAPTERS, ids=lambda adapter: adapter.name)
def test_every_adapter_says_what_it_is_for(adapter):
    assert adapter.info.title
    assert adapter.info.repo.count("/") == 1
    assert adapter.info.states
    for limit in adapter.info.limits:
        assert limit.endswith(".")
        assert "\n" not in limit
    (told,) = (a for a in run_json("adapters")["adapters"] if a["name"] == adapter.name)
    assert told["limits"] == [*adapter.info.limits]
    assert adapter.name != "vanilla-3dgs" or told["scripts"] == ["train.py"]


def test_the_list_has_one_column_for_names():
    lines = succeeds("adapters").stdout.splitlines()
    starts = {line.index(f"{a.info.title}, ") for a, line in zip(ADAPTERS, lines, strict=True)}
    assert len(starts) == 1
