"""``--config``: a command's options from a TOML file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from fragprune_plugins.errors import UsageError
from fragprune_plugins.files.reading import MEBIBYTE, UntrustedFile
from fragprune_plugins.workbench.commands.options import FILE

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def _read_config(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """Make a TOML file's values the defaults of the command's options."""
    if value is None:
        return None
    remedy = "Write one option a line, such as target-speedup = 2."
    kind = UntrustedFile(UsageError, "not readable as TOML", "a TOML file", remedy, limit=MEBIBYTE)
    try:
        with kind.reading(value) as reading:
            values = tomllib.loads(reading.text())
    except UsageError as error:
        raise click.BadParameter(str(error), ctx, param) from error
    options = [each for each in ctx.command.params if isinstance(each, click.Option)]
    names: dict[str, Any] = {}
    for key, setting in values.items():
        word = f"--{key.replace('_', '-')}"
        option = next((each for each in options if word in each.opts and each is not param), None)
        if option is None:
            said = f"{value}: {key!r} is no option of {ctx.command_path}."
            raise click.BadParameter(said, ctx, param)
        try:
            names[str(option.name)] = _as_words(option, setting)
        except ValueError as error:
            raise click.BadParameter(f"{value}: {key}: {error}", ctx, param) from error
    ctx.default_map = {**(ctx.default_map or {}), **names}
    return value


def _as_words(option: click.Option, setting: Any) -> Any:
    """What a line would say in place of a TOML value, so that both are read alike."""
    if setting is True and isinstance(option.flag_value, str):  # its value may be left out
        return option.flag_value
    if isinstance(setting, bool) != option.is_flag or isinstance(setting, list) != option.multiple:
        kind = "true or false" if option.is_flag else "a list" if option.multiple else "one value"
        raise ValueError(f"{setting!r:.80}, where {kind} belongs")
    if option.is_flag:
        return setting
    words = setting if option.multiple else [setting]
    if not all(isinstance(word, str | int | float) and "\0" not in str(word) for word in words):
        raise ValueError(f"{setting!r:.80}, where text or a number belongs")
    return [str(word) for word in words] if option.multiple else str(setting)


config_option = click.option(
    "--config",
    type=FILE,
    is_eager=True,
    expose_value=False,
    callback=_read_config,
    help="TOML file with options of this command, such as target-speedup = 2; the command "
    "line takes precedence.",
)
