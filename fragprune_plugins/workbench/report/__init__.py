"""``fragprune report``: writes an HTML page of the results in a folder."""

from __future__ import annotations

from typing import Any

import click

from fragprune_plugins.workbench.commands.command import Command, Report, work_of
from fragprune_plugins.workbench.commands.options import FILE, OutFile, engine_options


@click.command("report", cls=Command)
@click.argument("folder", metavar="DIR", type=FILE)
@click.option("--out", type=OutFile(".html"), help="HTML file to write; default: DIR/report.html.")
@click.option("--data", type=FILE, help="Scene folder: show some of its held-out views.")
@engine_options()
def command(**options: Any) -> Report:
    """Make an HTML page of the results in DIR: a sentence, tables, sliders over views, curves.

    DIR is the folder where run or finetune wrote models, or where compare or profile wrote pictures
    (--out). The page is a single file without references to other files, so it can be mailed. The
    newest run or fine-tuning that is no control comes first.

    Only DIR is read, because its records may be somebody else's. With --data the page shows some
    held-out views, too: then the photographs there are read, and the models that the record names.

    \b
    Example:
      fragprune report out --data scene
    """
    return work_of(__name__, **options)
