"""What the site has beside the pages of this folder; a hook of mkdocs, named in mkdocs.yml.

The changelog and its neighbours become pages, and so does what ``generate.py`` reads off the code.
The tutorial is run, and becomes a page with what it printed and drew. The navigation is read off
index.md, which lists every page.
"""

from __future__ import annotations

import base64
import logging
import posixpath
import re
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from runpy import run_path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

log = logging.getLogger("mkdocs.hooks.site")
DOCS = Path(__file__).parent
OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
LINK = re.compile(r"(?<=\]\()([^)#\s:]+)")
MOVED = {**OUTSIDE, "tutorial.ipynb": "tutorial.md"}
Nav = list[Any]


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The navigation: the index's headings, and below each the pages that it links to."""
    nav: Nav = [{"Home": "index.md"}]
    _, *sections = re.split(r"^## ", (DOCS / "index.md").read_text("utf-8"), flags=re.MULTILINE)
    seen: set[str] = set()
    for section in sections:
        title, _, text = section.partition("\n")
        pages: Nav = []
        for line in text.splitlines():
            links = re.findall(r"\[([^]]+)\]\(([^)#]+)\)", line)
            links = [(words, at) for words, link in links if (at := page_of(link)) not in seen]
            seen.update(at for _, at in links)
            if len(links) > 1 and links[0][1].startswith("experiments/"):
                # under the words of their links: tables of one experiment share a title
                tables = [{words: at} for words, at in links]
                question = line.split("|")[1].strip()
                pages.append({question[0].upper() + question[1:]: tables})
            else:
                pages += [at for _, at in links]
        nav.append({title.replace("`", ""): pages})
    config.nav = nav
    return config


def page_of(link: str) -> str:
    """The page that a link of index.md leads to."""
    name = link.removeprefix("../")
    return MOVED.get(name, name)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are made."""
    for name, page in OUTSIDE.items():
        text = (DOCS.parent / name).read_text("utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    for name, make in generated().items():
        files.append(File.generated(config, f"reference/{name}", content=make()))
    log.info("Running the tutorial, which trains: about a minute")
    text, pictures = run((DOCS / "tutorial.ipynb").read_text("utf-8"))
    files.append(File.generated(config, "tutorial.md", content=text))
    for name, picture in pictures.items():
        files.append(File.generated(config, name, content=picture))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Turns links to files that became pages."""
    folder = posixpath.dirname(page.file.src_uri)

    def turned(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[1]))
        page = MOVED.get(target.removeprefix("../"))
        return posixpath.relpath(page, folder or ".") if page else link[1]

    return LINK.sub(turned, markdown)


def generated() -> dict[str, Callable[[], str]]:
    """The pages of generate.py: by name, a function that makes the text."""
    pages: dict[str, Callable[[], str]] = run_path(str(DOCS / "generate.py"))["PAGES"]
    return pages


@lru_cache
def run(notebook: str) -> tuple[str, dict[str, bytes]]:
    """A notebook, run, as Markdown; and its pictures by name."""
    import nbformat
    from nbclient import NotebookClient

    cells = nbformat.reads(notebook, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(cells, timeout=600, resources={"metadata": {"path": folder}}).execute()
    parts, pictures = [], {}
    for cell in cells.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"tutorial-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                parts.append(f"![What this cell draws]({name})")
            elif output.get("name") != "stderr":
                shown = output.get("text") or data.get("text/plain", "")
                parts.append(f"```text\n{shown.rstrip()}\n```")
    parts.append('<a href="tutorial.ipynb" download>This page as a notebook</a>')
    return "\n\n".join(parts) + "\n", pictures
