"""Reads what a fork's rasterizer returns, and what its settings do, from the sources beside it."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import fragprune_graphdeco as graphdeco
from fragprune_graphdeco import assigned, every, is_off, kernels, text_of
from fragprune_plugins.adapting import HostRepo

Sum = Literal["count", "weight"]
Role = (
    Sum
    | Literal["image", "radii", "depth", "invdepth", "alpha", "objects", "plane"]
    | Literal["unproved", "unread"]
)

POSES = {"theta", "rho"}
"""Arguments that only get a camera's gradients: how it turns and moves, 0 at every call."""
SERVED = {"dc", *POSES}  # further arguments that the engines know
SCREEN = re.compile(r"means2D_\w+")
"""Further tensors that get a gradient on the screen, by which Gaussians are densified."""

_Z = r"depths\[collected_id\[j\]\]"
_DECLARED = re.compile(r"(?:float|auto)(\w+)=([^;]+);")
_FACTOR = re.compile(rf"{_Z}|alpha\*T")
_DEPTH = re.compile(rf"(\w+)\+=(?:{_Z}\*alpha\*T|alpha\*T\*{_Z});")
_INVERSE = re.compile(r"(\w+)\+=\(1/depths\[collected_id\[j\]\]\)\*alpha\*T;")
_WEIGHT = re.compile(r"(\w+)\+=alpha\*T;")
_BLENDED = re.compile(r"(\w+)\[ch\]\+=\w+\[collected_id\[j\]\*\w+\+ch\]\*alpha\*T;")
"""A sum over the ray for each channel."""
_PULLED = re.compile(r"dL_dalpha\+=\(?\([\w.]+-accum_\w+(\[ch\])?\)\*")
"""What a sum adds to the gradient of alpha: one over channels, as that of colours, or another."""
_PLANE = re.compile(
    r"\bout_(\w+)\[pix_id\]=(\w+)\[4\]/-\(\2\[0\]\*ray\.x\+\2\[1\]\*ray\.y\+\2\[2\]\+1\.0e-8\);"
)
"""Depth at which a pixel's ray meets a plane: channels 1 to 3 are its normal, 5 its distance."""
_RAY = ("ray={(pixf.x-cx)/focal_x,(pixf.y-cy)/focal_y};", "float(width*0.5),float(height*0.5)")
"""Of the pixel, through a camera whose axis is the picture's middle."""
_ADDED = re.compile(r"([{;])atomicAdd\(&\(?(\w+)\[collected_id\[j\]\]\)?,(alpha\*T|1\.?0?)\);")
"""A sum for each Gaussian over its fragments, in a statement of its own."""
_BLOCK = r"\{(?:[^{}]|" * 4 + r"\{[^{}]*\}" + r")*\}" * 4
"""Code between braces, with further ones inside."""
_OPACITY = re.compile(r"alpha|acc(?!.*count)|opac")
"""In the name of the sum of a ray's weights."""
_DRAWN = re.compile(r"if\(test_T<0\.0001\)\{done=true;continue;\}")
"""Behind it, a fragment is one that is drawn."""


@dataclass(frozen=True)
class Output:
    """A value that a rasterizer returns, by the name that the source gives it.

    Its role "count" is the number of a Gaussian's drawn fragments, "weight" their sum of alpha T;
    "unread" is one that nobody reads, "unproved" one that only the numbers of the host's own
    rasterizer can tell.
    """

    name: str
    role: Role
    column: bool = False  # of one number per Gaussian: (P, 1), not (P,)
    integer: bool = False  # likewise: int32
    detached: bool = False  # no gradient of it moves a Gaussian


def meaning(repo: HostRepo, call: graphdeco.CallInSource, name: str) -> Output:
    """What a further value is, by its name and by the vendored kernel that makes it."""
    late = "antialiasing" in call.settings and len(call.names) == 3
    if late and call.package == "diff_gaussian_rasterization":
        return Output(name, "invdepth")  # the rasterizer since August 2024
    text = _inlined("".join(kernels.normal_sources(repo, call.package)))
    if role := _sum_for_gaussians(text, name):
        made = re.search(rf"{name}=torch::\w+\(\{{\w+(,1)?\}}[^;]*;", text)
        whole = made is not None and "kInt" in made[0]
        return Output(name, role, column=bool(made and made[1]), integer=whole)
    blended, (moved, flat) = blended_argument(repo, call), _moving(repo, call.package)
    depths, weights = set(_DEPTH.findall(text)), set(_WEIGHT.findall(text))
    shares = {f"{depth}/{weight}" for depth in depths for weight in weights}
    if "T=test_T;" in text:
        weights.add("1-T")
    planes = {match[1]: match[2] for match in _PLANE.finditer(text)}
    if planes.get(name) in _sums(text) and all(each in text for each in _RAY):
        return Output(name, "plane")
    if "depth" in name:
        inverse = set(_INVERSE.findall(text))
        known = {"depth": depths, "invdepth": inverse, "unproved": shares}
        for each, sums in known.items():
            if _written(text, name, "depth", sums):
                return Output(name, each, detached=flat)  # type: ignore[arg-type]
    elif re.search(r"alpha|acc(?!.*count)|opac", name) and _written(
        text, name, "alpha|opac", weights
    ):
        return Output(name, "alpha", detached=flat)
    elif blended and moved is not None:
        images = set(re.findall(r"\bout_(\w+)\[[^]]*\]=", text))
        alone = len(call.names) == 3 and images <= {"color", _blended(text)}
        if alone or _words(name) & _words(_blended(text)):
            return Output(name, "objects", detached=not moved)
    return Output(name, "unread")


def _moving(repo: HostRepo, package: str) -> tuple[bool | None, bool]:
    """Whether blended channels move Gaussians, None if unknown; whether no other sum does."""
    text = kernels.backward_sources(repo, package)
    pulled = {match[0]: match[1] for match in _PULLED.finditer(text)}
    colours = sum(each is not None for each in pulled.values())
    moved = not text or (colours > 1 if colours else None)
    return moved, bool(colours) and colours == len(pulled)


def _inlined(text: str) -> str:
    """Sources in which a fragment's depth and weight have no other names."""
    declared: dict[str, set[str]] = {}
    for name, value in _DECLARED.findall(text):
        declared.setdefault(name, set()).add(value)
    for name, values in declared.items():
        value = values.pop()
        changed = re.search(rf"(?<![\w.]){name}[-+*/]?=", text)
        if not values and not changed and _FACTOR.fullmatch(value):
            text = re.sub(rf"(?<![\w.]){name}\b", value, text)
    return text


def _written(text: str, name: str, buffer: str, sums: set[str]) -> bool:
    """Whether sums, and nothing else, go into the buffer that is called most like a value."""
    stored: dict[str, set[str]] = {}
    for own, value in re.findall(rf"\b(?:out_)?(\w*(?:{buffer})\w*)\[pix_id\]=([^;]+);", text):
        stored.setdefault(own, set()).add(value)
    named = [each for each in stored if _words(each) <= _words(name)]
    values = set().union(*(stored[each] for each in named or stored))
    return bool(values) and values <= sums


def blended_argument(repo: HostRepo, call: graphdeco.CallInSource) -> str:
    """The argument with channels that are blended beside the colours, without a background.

    "" if there is none, or if several could be it.
    """
    further = [each for each in call.arguments - SERVED if not SCREEN.fullmatch(each)]
    text = "".join(kernels.normal_sources(repo, call.package))
    return further[0] if len(further) == 1 and _blended(text) else ""


def _blended(text: str) -> str:
    """What a kernel calls the picture of the channels that it blends; "" unless there is one."""
    stored = re.findall(r"\bout_(\w+)\[ch\*H\*W\+pix_id\]=(\w+)\[ch\];", text)
    found = {out for out, value in stored if value in _sums(text)}
    return found.pop() if len(found) == 1 else ""


def _sums(text: str) -> set[str]:
    return {match[1] for match in _BLENDED.finditer(text)}


def _words(name: str) -> set[str]:
    return {word.rstrip("s") for word in name.split("_")}


def _sum_for_gaussians(text: str, name: str) -> Sum | None:
    """Whether a buffer of this name counts a Gaussian's drawn fragments, or sums their weights."""
    added = [match for match in _ADDED.finditer(text) if match[2] == name]
    if len(added) != 1 or len(re.findall(rf"atomic\w+\(&\(?{name}\[", text)) != 1:
        return None
    (found,) = added
    behind = [match.end() for match in _DRAWN.finditer(text, 0, found.start())]
    between = text[behind[-1] : found.end(1)] if behind else ""
    if not behind or between.count("{") != between.count("}"):  # in a block: only some of them
        return None
    if found[3] != "alpha*T":
        return "count"
    return None if "T=test_T" in between else "weight"


# -- settings --------------------------------------------------------------------------------------


def only_asks(repo: HostRepo, package: str, setting: str) -> bool:
    """Whether a setting only asks for the channels that are blended beside the colours.

    Kernels then name it where they hand it on, and before blocks that make these sums alone.
    """
    text = "".join(kernels.normal_sources(repo, package))
    blocks = re.findall(rf"if\({setting}\)\{{([^{{}}]*)\}}", text)
    for each in blocks:
        text = text.replace(f"if({setting}){{{each}}}", "")
    made = "".join(blocks)
    targets = set(re.findall(r"(\w+)(?:\[[^]=]*\])?[-+*/]?=(?!=)", made)) - _sums(made)
    more = re.search(r"\b(atomic|continue|return|break)|trap\(", made)
    return (
        all(re.match(r"out_(?!color)|int", each) for each in targets)
        and bool(blocks and not more)
        and _handed_on(text, setting)
    )


def rests(repo: HostRepo, package: str, setting: str, off: Collection[str]) -> bool:
    """Whether kernels read a setting in blocks alone that need one of those that are off."""
    text = "".join(kernels.normal_sources(repo, package))
    given = rf"\b({'|'.join(sorted(off)) or '-'})!=nullptr"
    blocks = re.finditer(rf"if\((\w+!=nullptr&&)*{given}(&&\w+!=nullptr)*\){_BLOCK}", text)
    reading = [each[0] for each in blocks if re.search(rf"\b{setting}\b", each[0])]
    others = text + kernels.backward_sources(repo, package)
    for each in reading:
        others = others.replace(each, "")
    return bool(reading) and _handed_on(others, setting)


def _handed_on(text: str, setting: str) -> bool:
    """Whether sources name a setting only where functions take it and hand it on."""
    handed = re.sub(rf"(?<=[,(])(?<!if\(){setting}(?=[,)])", "", text)
    return not re.search(rf"(?<!\w){setting}\b", handed)


def changed_gradients(repo: HostRepo, package: str, setting: str) -> frozenset[str] | None:
    """The arguments whose gradients a setting changes, if the forward pass never gets it.

    None where the picture may depend on it, or nothing was read. The Python of a vendored package
    says it: ``forward`` lists what the kernels get, ``backward`` what becomes of their gradients.
    """
    name = package.rpartition(".")[2]
    for folder in kernels.vendored(repo, package):
        with suppress(SyntaxError):
            tree = ast.parse(repo.read(folder / name / "__init__.py"))
            for node in every(tree, ast.ClassDef):
                made = {each.name: each for each in node.body if isinstance(each, ast.FunctionDef)}
                if {"forward", "backward"} <= made.keys():
                    forward, backward = made["forward"], made["backward"]
                    read, changing = (
                        any(each.attr == setting for each in every(part, ast.Attribute))
                        for part in (forward, backward)
                    )
                    return _changed(forward, backward) if changing and not read else None
    return None


def _changed(forward: ast.FunctionDef, backward: ast.FunctionDef) -> frozenset[str] | None:
    """Parameters of ``forward`` whose gradients are not what the kernels gave."""
    made = {to: value for to, value in assigned(backward) if "_backward(" in text_of(value)}
    given = {getattr(each, "id", "") for to in made for each in getattr(to, "elts", [to])}
    changed = [to for to, _ in assigned(backward) if to not in made]
    changed += [each.target for each in every(backward, ast.AugAssign)]
    given -= {text_of(each).split("[")[0] for each in changed}
    last = backward.body[-1]
    returned = last.value if isinstance(last, ast.Return) else None
    if isinstance(returned, ast.Name):
        values = (value for to, value in assigned(backward) if text_of(to) == returned.id)
        returned = next(values, None)
    if not isinstance(returned, ast.Tuple):
        return None
    names = [each.arg for each in forward.args.args[1:]]
    return frozenset(
        name
        for name, each in zip(names, returned.elts, strict=False)
        if not is_off(each) and getattr(each, "id", "") not in given
    )
