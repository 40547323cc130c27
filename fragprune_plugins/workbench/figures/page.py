"""The frame of every HTML page: one style, and the parts that pages are made of.

A page needs no network: its style and its few lines of script are inside, and its policy lets no
other script run and no other machine be asked. It has a dark layout and one for phones. All text is
escaped here; ``src`` values are given as they are to be written.
"""

from __future__ import annotations

import base64
import hashlib
import html
from collections.abc import Sequence
from pathlib import Path
from string import Template

from fragprune_plugins.workbench.figures.pictures import colour_stops

Size = tuple[int, int]
"""Width and height, pixels."""

_ROOM = (490, 640)
"""Pixels of the page up to which small pictures grow, in whole steps."""


def compose(*, title: str, quote: str, parts: Sequence[str]) -> str:
    """The whole page as HTML.

    Args:
        title: also its heading.
        quote: the outcome in a sentence, shown large.
        parts: of the page, HTML, in their order.
    """
    return _PAGE.substitute(
        allowed=allowed(_SCRIPT),
        script=_SCRIPT,
        title=html.escape(title),
        quote=html.escape(quote),
        body="\n".join(filter(None, parts)),
    )


def heading(text: str) -> str:
    """A heading of a part of the page."""
    return f"<h2>{html.escape(text)}</h2>"


def paragraph(text: str) -> str:
    """A paragraph of text; nothing where there is none."""
    return f"<p>{html.escape(text)}</p>" if text else ""


def code(text: str) -> str:
    """Commands to copy."""
    return f"<pre>{html.escape(text)}</pre>"


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "", words: int = 1
) -> str:
    """A table whose first columns are words and whose others are numbers.

    Args:
        head: names of the columns.
        rows: cells as they are to be read.
        caption: below the table.
        words: how many columns are words.
    """
    kinds = [' class="words"' if at < words else "" for at in range(len(head))]
    top = "".join(
        f'<th scope="col"{kind}>{html.escape(cell)}</th>'
        for kind, cell in zip(kinds, head, strict=True)
    )
    body = "\n".join(
        f'<tr><th scope="row">{html.escape(first)}</th>'
        + "".join(
            f"<td{kind}>{html.escape(cell)}</td>"
            for kind, cell in zip(kinds[1:], others, strict=True)
        )
        + "</tr>"
        for first, *others in rows
    )
    said = f'\n<p class="note">{html.escape(caption)}</p>' if caption else ""
    return (
        f'<div class="scroll"><table><thead><tr>{top}</tr></thead>'
        f"<tbody>\n{body}\n</tbody></table></div>{said}"
    )


def wide(source: str, alt: str) -> str:
    """A picture as wide as the page, such as a plot.

    Args:
        source: its ``src``.
        alt: what it shows, for who cannot see it.
    """
    return (
        f'<figure class="wide"><img src="{html.escape(source)}" alt="{html.escape(alt)}"></figure>'
    )


def picture(source: str, caption: str, size: Size) -> str:
    """A picture with a caption.

    Args:
        source: its ``src``.
        caption: below it.
        size: of the picture.
    """
    return (
        f'<figure{_sized(size)}><img src="{html.escape(source)}" alt="{html.escape(caption)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def split(before: str, after: str, caption: str, size: Size, names: tuple[str, str]) -> str:
    """Two pictures of one size under a divider that can be dragged.

    All dividers of one ``section`` move together.

    Args:
        before: ``src`` of the picture left of the divider.
        after: ``src`` of the one right of it.
        caption: below them.
        size: of each.
        names: of the two pictures.
    """
    left, right = map(html.escape, names)
    return _SPLIT.substitute(
        before=html.escape(before),
        after=html.escape(after),
        caption=html.escape(caption),
        sized=_sized(size),
        left=left,
        right=right,
    )


def section(name: str, *parts: str) -> str:
    """Pictures of one view, side by side where there is room."""
    title = f"<h3>{html.escape(name)}</h3>" if name else ""
    return f'<section>{title}<div class="grid">' + "\n".join(parts) + "</div></section>"


def legend(label: str, limit: float) -> str:
    """The colours of maps, from 0 to ``limit`` and more."""
    stops = ", ".join(colour_stops())
    ticks = "".join(
        f"<span>{limit * part / 4:.3g}{'+' if part == 4 else ''}</span>" for part in range(5)
    )
    return (
        f'<div class="legend"><b>{html.escape(label)}</b>'
        f'<i style="background:linear-gradient(90deg, {stops})"></i><div>{ticks}</div></div>'
    )


def embedded(file: Path) -> str:
    """A PNG as a data URL, for pages that refer to no other file."""
    return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"


def zoom(size: Size) -> int:
    """How many times as large a picture is shown at most: more than once if it is small."""
    return max(1, min(room // side for room, side in zip(_ROOM, size, strict=True)))


def allowed(text: str) -> str:
    """How a Content-Security-Policy allows one script or style that stands within a page."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _sized(size: Size) -> str:
    """Attributes of a figure: its width and shape, and whether single pixels are to be seen."""
    width, height = size
    pixels = ' class="pixels"' if zoom(size) > 1 else ""
    return f'{pixels} style="--width:{width * zoom(size)}px;--shape:{width / height:.4g}"'


_SPLIT = Template("""<figure$sized><div class="pair">
<img src="$after" alt="$caption: $right"><img class="top" src="$before" alt="$caption: $left">
<b></b><span class="left">$left</span><span class="right">$right</span>
<input type="range" min="0" max="100" step="any" value="50" aria-label="$left or $right">
</div><figcaption>$caption</figcaption></figure>""")

_SCRIPT = """addEventListener("input", ({ target }) =>
  target.closest("section").style.setProperty("--cut", target.value + "%"))"""

_PAGE = Template("""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src $allowed;
 style-src 'unsafe-inline'; img-src 'self' file: data:; base-uri 'none'; form-action 'none'">
<title>$title</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<style>
:root { --text: #222; --soft: #666; --page: #fcfbf9; --card: #f2efea; --line: #ddd8d0;
  --mark: #d2542c }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6e3de; --soft: #a5a099; --page: #181715; --card: #24221f; --line: #3b3833;
    --mark: #f0784f } }
* { box-sizing: border-box }
body { font: 16px/1.55 system-ui, sans-serif; max-width: 66rem; margin: 0 auto;
  padding: 1.5rem 1rem 4rem; color: var(--text); background: var(--page); overflow-wrap: anywhere }
h1 { font-size: 1.9rem; line-height: 1.2; margin: .5rem 0 1rem }
h2 { font-size: 1.3rem; margin: 2.5rem 0 .6rem; padding-top: .8rem;
  border-top: 1px solid var(--line) }
h3 { font-size: 1rem; margin: 1.5rem 0 .6rem }
.quote { font-size: 1.2rem; border-left: .3rem solid var(--mark); padding-left: 1rem;
  margin: 1rem 0 }
pre { background: var(--card); padding: .8rem 1rem; overflow-x: auto; border-radius: .4rem;
  font-size: .9rem }
.scroll { overflow-x: auto; margin: 1rem 0 }
table { border-collapse: collapse; font-size: .93rem; font-variant-numeric: tabular-nums;
  overflow-wrap: normal }
.note { color: var(--soft); font-size: .87rem; margin: -.5rem 0 1.5rem }
th, td { padding: .32rem .8rem; border-bottom: 1px solid var(--line); text-align: right;
  vertical-align: top }
tbody th { font-weight: 400; text-align: left; min-width: 9rem }
thead th { font-weight: 600; vertical-align: bottom }
.words { text-align: left }
tbody tr:hover { background: var(--card) }
section { margin: 1.2rem 0 2rem; --cut: 50% }
.grid { display: flex; flex-wrap: wrap; gap: 1.2rem }
figure { margin: 0; width: min(var(--width), 90vh * var(--shape)); max-width: 100% }
.wide { width: 100% }
.grid img, .wide img { display: block; width: 100%; border-radius: .35rem }
.pixels img { image-rendering: pixelated }
.wide img { background: #fff }
figcaption { color: var(--soft); font-size: .87rem; margin-top: .35rem }
.pair { position: relative; overflow: hidden; border-radius: .35rem }
.pair .top { position: absolute; inset: 0; clip-path: inset(0 calc(100% - var(--cut)) 0 0) }
.pair b { position: absolute; inset: 0 auto 0 var(--cut); width: 2px; margin-left: -1px;
  background: #fff; box-shadow: 0 0 3px #000; pointer-events: none }
.pair b::after { content: "◂▸"; position: absolute; top: 50%; left: 1px; padding: .1rem .3rem;
  transform: translate(-50%, -50%); border-radius: 1rem; background: #fff; color: #222;
  font: 11px/1.3 sans-serif; white-space: nowrap }
.pair input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0;
  cursor: ew-resize; touch-action: pan-y }
.pair:focus-within { outline: 2px solid var(--mark) }
.pair span { position: absolute; top: .5rem; padding: 0 .5rem; background: #000b; color: #fff;
  border-radius: .3rem; font-size: .78rem }
.left { left: .5rem } .right { right: .5rem }
.legend { max-width: 26rem; font-size: .87rem; margin: .8rem 0 }
.legend b { font-weight: 400; color: var(--soft) }
.legend i { display: block; height: .8rem; border-radius: .2rem; margin-top: .2rem }
.legend div { display: flex; justify-content: space-between }
@media (min-width: 60rem) { .grid figure { max-width: calc(50% - .6rem) } }
@media (max-width: 40rem) {
  body { padding: 1rem .8rem 3rem } h1 { font-size: 1.5rem } .quote { font-size: 1.05rem }
  th, td { padding: .3rem .5rem } tbody th { min-width: 7rem }
  .grid figure { width: 100% } }
</style></head><body>
<h1>$title</h1>
<p class="quote">$quote</p>
$body
<script>$script</script>
</body></html>
""")
