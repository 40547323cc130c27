"""Pages as HTML, from jinja2 templates; ``templates/`` has the frame, the style and the parts.

A page needs no network: its style and its few lines of script are inside, and its policy lets no
other script run and no other machine be asked. It has a dark layout and one for phones. The
templates escape every text that is put into them.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from fragprune_plugins.workbench.figures.pictures import colour_stops

TEMPLATES = Path(__file__).with_name("templates")
Size = tuple[int, int]  # width and height, pixels


@dataclass(frozen=True)
class Table:
    """A table whose first columns are words and whose others are numbers."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]  # cells as they are to be read
    caption: str = ""
    words: int = 1  # how many columns are words


def render(template: Path, *others: Path, **values: Any) -> str:
    """A page of a template, which may use those in other folders; "title" is also its heading."""
    environment = Environment(
        loader=FileSystemLoader([template.parent, *others, TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["colours"] = colour_stops
    files = (TEMPLATES / name for name in ("page.css", "page.js"))
    style, script = (Markup(file.read_text(encoding="utf-8")) for file in files)
    frame = {"style": style, "script": script, "allowed": Markup(allowed(script))}
    return environment.get_template(template.name).render(frame | values)


def embedded(file: Path) -> str:
    """A PNG as a data URL, for pages that refer to no other file."""
    return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"


def allowed(text: str) -> str:
    """How a Content-Security-Policy allows one script or style that stands within a page."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
