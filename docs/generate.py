"""The pages of docs/reference that are read off the code; ``site.py`` adds them to the site.

Each page has a function that returns its Markdown.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import click


def hooks() -> str:
    """What plugins may answer or be told."""
    from fragprune_plugins.plugins import hookspecs

    intro = """A plugin is the class of an adapter, or a module or an object with hooks, under the
entry-point group `fragprune`. It marks functions with `hookimpl` and takes only the arguments it
wants. Argument names are checked when it is registered, and an unknown hook name is an error. A
plugin that fails is named and left out, and the others go on. `FRAGPRUNE_BLOCK` and
`FRAGPRUNE_ONLY` take comma-separated entry-point names.

Every command asks these hooks, and so does a host under `fragprune run`. If a hook says that
the first answer counts, `None` leaves the answer to the next plugin. Our own answer comes last."""
    parts = []
    for name, hook in _functions(hookspecs):
        if not name.startswith("fragprune_"):
            continue
        text = _parameters(inspect.getdoc(hook) or "")
        first = (
            "\n\nThe first answer counts."
            if inspect.signature(hook).return_annotation != "None"
            else ""
        )
        names = ", ".join(inspect.signature(hook).parameters)
        parts.append(f"## `{name}({names})`\n\n{text}{first}")
    return _page("Hooks", intro, *parts)


def roles() -> str:
    """What happens at a seam."""
    from fragprune_plugins.hosts.seams import Role, Seam, SeamCall

    intro = """A *seam* is one function of a host that is wrapped while fragprune is active. An
adapter lists a host's seams and gives each a role. In most roles the host's function runs
unchanged, and fragprune follows. RASTERIZE, SIMILARITY and ANSWER answer in its place; STILL and
REARRANGE leave it out in stage 2. `fragprune check DIR --adapter NAME` prints the seams of a
checkout with file and line.

A seam's `how` is a function of the adapter for things that only this host does in its own way. It
takes the `SeamCall`, and is called before, around, after or instead of the host's function.
Brackets show the default of a seam without a `how`. Without brackets a `how` is required."""
    cells = [(role.name, _sentence(role.does), role.how and _sentence(role.how)) for role in Role]
    rows = "\n".join(f"| `{name}` | {does} | {_fields(how)} |" for name, does, how in cells)
    table = f"| role | what fragprune does there | `how` |\n|---|---|---|\n{rows}"
    kinds = map(_class, (Seam, SeamCall))
    return _page("Roles of seams", intro, table, *kinds)


def adapters() -> str:
    """What an adapter may say."""
    import fragprune_graphdeco
    from fragprune_plugins import adapting

    head, names, *rest = (inspect.getdoc(adapting) or "").split("\n\n")
    intro = f"""An adapter is a class that describes one host. Required methods have no default. See
[how to write one](../how-to/write-an-adapter.md), and [roles](roles.md) for the roles of seams.

{_fields(head)}

```text
{names}
```

{" ".join(rest)}"""
    kinds = {
        kind
        for kind in (*vars(adapting).values(), *vars(fragprune_graphdeco).values())
        if inspect.isclass(kind)
        and kind.__module__.startswith(("fragprune_plugins.hosts", "fragprune_graphdeco"))
        and not kind.__module__.endswith(".seams")
    }
    ordered = sorted(kinds, key=lambda each: (each.__module__, inspect.getsourcelines(each)[1]))
    return _page("Adapters", intro, *map(_class, ordered))


def python() -> str:
    """The names of the package."""
    import fragprune_plugins

    intro = "Import these names from `fragprune_plugins`. Only these names are stable."
    parts = []
    for name in fragprune_plugins.__all__:
        thing = getattr(fragprune_plugins, name)
        if inspect.isclass(thing):
            parts.append(_class(thing))
        elif callable(thing):
            parts.append(
                f"## `{name}{_signature(thing)}`\n\n{_fields(inspect.getdoc(thing) or '')}"
            )
    return _page("Python", intro, *parts)


def command_line() -> str:
    """Every command's help."""
    from fragprune_plugins.workbench.commands import cli

    intro = """The output of `fragprune COMMAND --help`. Every command takes `--json`: it
prints one object on stdout, and progress on stderr. [Errors](errors.md) lists the exit codes."""
    context = cli.make_context("fragprune", [], resilient_parsing=True)
    context.terminal_width = context.max_content_width = 96
    return _page("Command line", intro, *_commands(cli, context))


def support() -> str:
    """What the installed adapters serve."""
    from fragprune_plugins.engines import ENGINES
    from fragprune_plugins.plugins.loading import load_plugins
    from fragprune_plugins.workbench.adapters import scripts as training_scripts

    adapters = load_plugins().adapters
    head = ["host", "adapter", "states", "scripts that train"]
    rows = [head, ["---"] * len(head)]
    limits = []
    for adapter in adapters:
        info = adapter.info
        host = f"[{info.title}](https://github.com/{info.repo})"
        scripts = ", ".join(f"`{script}`" for script in training_scripts(adapter)) or "your own"
        rows.append([host, f"`{adapter.name}`", info.states, scripts])
        limits += [f"* `{adapter.name}`: {limit}" for limit in info.limits]
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in rows)
    installed = " and ".join(f"`{a.name}`" for a in adapters if a.installed and not a.info.usage)
    methods = " and ".join(f"`{a.name}`" for a in adapters if a.info.usage)
    on_cpu = " and ".join(f"`{a.name}`" for a in adapters if not a.on_gpu)
    intro = f"""Scripts that do not train (render, evaluate) also run under `fragprune run`, with
the thresholds beside their models. Every adapter draws with every engine ({
        ", ".join(f"`{name}`" for name in ENGINES)
    }), but {on_cpu} not with `cuda`.
`fragprune check DIR` says which adapter fits a checkout, and why others do not. Our adapters
pass the [conformance kit](conformance.md): {installed} on the installed packages, the others on
miniatures of their hosts. {methods} is a method of its host, with
[tests of its own](../how-to/nerfstudio.md#test-it)."""
    refused = "\n".join(["## What does not work or is refused", "", *limits])
    return _page("What is supported", intro, table, refused)


def errors() -> str:
    """Every stated failure."""
    from fragprune_plugins import errors

    intro = """Every error below prints `[code] where: found; expected. remedy` and leaves existing
files as they were. Exit codes: 1 for such an error, 2 for usage, 130 for Ctrl-C, 143 for SIGTERM
during learning. With `--json` the error is
`{"error": {"code", "where", "found", "expected", "remedy"}}`."""
    base = errors.FragpruneError
    kinds = [kind for kind in vars(errors).values() if inspect.isclass(kind) and kind is not base]
    rows = [f"| `{kind.code}` | `{kind.__name__}` | {inspect.getdoc(kind)} |" for kind in kinds]
    table = "\n".join(["| code | exception | when |", "|---|---|---|", *rows])
    return _page("Errors", intro, table)


PAGES: dict[str, Callable[[], str]] = {
    "hooks.md": hooks,
    "roles.md": roles,
    "adapters.md": adapters,
    "python.md": python,
    "command-line.md": command_line,
    "errors.md": errors,
    "support.md": support,
}


def _commands(group: click.Group, context: click.Context) -> Iterator[str]:
    """The help of every command of a group."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        inner = click.Context(
            command, parent=context, info_name=name, terminal_width=96, max_content_width=96
        )
        yield f"## {inner.command_path}\n\n```text\n{command.get_help(inner)}\n```"


def _page(title: str, intro: str, *parts: str) -> str:
    return "\n\n".join([f"# {title}", intro, *parts]) + "\n"


def _functions(module: Any) -> Iterator[tuple[str, Any]]:
    found = inspect.getmembers(module, inspect.isfunction)
    yield from sorted(found, key=lambda pair: inspect.getsourcelines(pair[1])[1])


def _class(kind: type) -> str:
    lines = [f"## `{kind.__name__}`", _fields(inspect.getdoc(kind) or "")]
    for name, member in vars(kind).items():
        function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        wrapped = inspect.unwrap(function) if callable(function) else None
        text = inspect.getdoc(wrapped or member) or ""
        if name.startswith("_") or not text:
            continue
        if inspect.isfunction(wrapped):
            needed = " **Required.**" if getattr(function, "__isabstractmethod__", False) else ""
            lines.append(f"### `{name}{_signature(wrapped)}`\n\n{_fields(text)}{needed}")
        elif isinstance(member, property):
            lines.append(f"### `{name}`\n\n{_fields(text)}")
    return "\n\n".join(lines)


def _signature(function: Any) -> str:
    """Without annotations: the text says what each argument is."""
    signature = inspect.signature(function)
    plain = [
        parameter.replace(annotation=inspect.Parameter.empty)
        for parameter in signature.parameters.values()
        if parameter.name not in ("self", "cls")
    ]
    return str(signature.replace(parameters=plain, return_annotation=inspect.Signature.empty))


def _parameters(text: str) -> str:
    """A docstring with ``:param x:`` as a list."""
    text = re.sub(r"\n\s+", " ", text) if ":param" in text else text
    head, *given = re.split(r"\s*:param (\w+):\s*", text)
    pairs = zip(given[::2], given[1::2], strict=True)
    listed = "\n".join(f"* `{name}`: {_sentence(what)}" for name, what in pairs)
    return f"{head.strip()}\n\n{listed}" if listed else head.strip()


def _fields(text: str) -> str:
    """A docstring with its sections of names as lists, and double backticks as single ones."""
    out: list[str] = []
    section = ""
    for line in text.splitlines():
        heading = re.fullmatch(r"(Args|Attributes|Raises|Returns|Yields):", line)
        entry = re.fullmatch(r"    ([\w.*, ]+): (.*)", line) if section else None
        if heading:
            section = heading[1]
            out.append(f"{section}:\n")
        elif entry:
            out.append(f"* `{entry[1]}`: {entry[2]}")
        elif section and line.startswith("    "):
            out.append(
                f"  {line.strip()}" if out[-1].startswith(("*", " ")) else f"* {line.strip()}"
            )
        else:
            section = "" if line.strip() else section
            out.append(line)
    return re.sub(r"``(.+?)``", r"`\1`", "\n".join(out))


def _sentence(text: str) -> str:
    text = text.strip()
    return text if text.endswith(".") else f"{text}."
