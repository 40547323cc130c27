"""What pages tell to type exists: commands with their options, names in Python, files of ours.

Left out are docs/experiments: they tell what was run then.
"""

import json
import re
import shlex
from pathlib import Path
from pkgutil import resolve_name

import click
import pytest

import fragprune_plugins as fp
from fragprune_plugins.workbench.commands import cli

ROOT = Path(__file__).parents[2]
DOCS = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")]
DOCS += [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")]
PAGES = [page for page in sorted(DOCS) if "experiments" not in page.parts]
CODE = re.compile(r"^```.*?^```|^ {4}.*?$|`[^`]+`", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?<![\w/.-])fragprune(?:_plugins)? +(?!as |stop |rim )([a-z][^\n;&|>()`]*)")


def words(page: Path) -> str:
    """The text of a page, or the code of a notebook; lines that go on are joined."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = [c["source"] for c in json.loads(text)["cells"] if c["cell_type"] == "code"]
        text = "".join(f"```\n{''.join(cell)}\n```\n" for cell in cells)
    return re.sub(r"\\\n\s*", "", text)


def refused(line: str) -> str:
    """What click says against a command, if anything; what is behind ``--`` belongs to a host."""
    ours = re.sub(r"[][]", " ", f"{line} ".partition(" -- ")[0])  # brackets: may be left out
    name, *given = shlex.split(ours, comments=True)
    command = cli.get_command(click.Context(cli), name)
    if command is None:
        return f"{line}: no such command"
    try:
        values = command.make_parser(click.Context(command)).parse_args(given)[0]
    except click.UsageError as error:
        return f"{line}: {error.format_message()}"
    choices = {p.name: p.type.choices for p in command.params if isinstance(p.type, click.Choice)}
    return "".join(f"{line}: {v}" for n, v in values.items() if v not in choices.get(n, [v]))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_tells_to_type_exists(page):
    text = words(page)
    code = [c if c[:3] == "```" else c.replace("\n", " ") for c in CODE.findall(text)]
    lost = [refused(line) for piece in code for line in COMMAND.findall(piece)]
    names = re.findall(r"fragprune_plugins(?:\.[A-Za-z]\w*)+", text)
    for module, some in re.findall(r"from (fragprune_plugins[\w.]*) import ([\w, ]+)", text):
        names += [f"{module}.{name}" for name in some.split(", ")]
    for name in (name for name in names if "mutmut" not in name):
        try:
            resolve_name(name)
        except (ImportError, AttributeError) as error:
            lost.append(f"{name}: {error}")
    lost += [f"fp.{name}" for name in re.findall(r"\bfp\.(\w+)", text) if not hasattr(fp, name)]
    files = re.findall(r"`((?:fragprune_plugins|adapters|tests|docs)/[a-z\d_./-]+)`", text)
    assert [*filter(None, lost), *(file for file in files if not (ROOT / file).exists())] == []
