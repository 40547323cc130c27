"""Drawing functions: what the inputs of their rasterizer and their pictures are made of."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterable, Iterator, Mapping

from fragprune_graphdeco import reading
from fragprune_graphdeco.call import ARGUMENTS, read_calls
from fragprune_graphdeco.reading import ModelClass
from fragprune_graphdeco.saved import PLAIN, SAME, columns
from fragprune_graphdeco.syntax import (
    Known,
    assigned,
    chosen,
    decided,
    entries,
    every,
    first_of,
    is_off,
    off_by_default,
    passed,
    skipped,
    text_of,
)
from fragprune_plugins.adapting import Function, HostRepo, change_of, nodes

_OF_MODEL = re.compile(
    r"get_(xyz|opacity|scaling|rotation|features\w*|covariance)|_(xyz|opacity|scaling|rotation|"
    r"features_dc|features_rest)|\w+_activation|\w*sh_degree|get_max_sh_channels|screenspace_points"
)
"""Attributes of the model that a plain drawing reads."""
_OF_CALL = re.compile(
    r"view\w*|cam\w*|\w*pose\w*|pipe\w*|scal\w*|override_color|\w*mask\w*|bg\w*|xyz|means3D|"
    r"opacity|opacities|features|shs|dc|rotations?|\w*sh\w*|iteration|drop\w*"
)
"""Parameters of a drawing function that move or select Gaussians, are their values, or say how far
training is, as where it leaves some out."""
_KEEPS = {*SAME, "clamp", "clamp_"}
"""Methods that keep the numbers of a picture."""
_ACTIVATING = {each for names in reading.ACTIVATIONS.values() for each in names}
_ADDED = re.compile(r"bg_color|zeros_like\(\w+\)$|\* 0\.0$")
"""What is added to a picture and leaves its Gaussians alone: a background, or zeros."""
_PICTURES = re.compile(r"mesh_\w+|(?!clamp|use)\w+_(rgb|colou?rs?)")
"""Arguments of a rasterizer that are pictures to blend with its own."""
_BEHIND = re.compile(r"(bg|background)_depth\w*")
"""What is given to a rasterizer that draws Gaussians in front of a picture alone."""
_CHANNELS = re.compile(r"feat|sem|lang|obj|mask|label|normal")
"""In names of values that a rasterizer blends beside the colours."""
_OTHERS = re.compile(r"^(?!num_|.*(depth|normal|alpha)).*(image|render|rgb|colou?r)")
"""Names of other pictures that a rasterizer may return before its own."""
_RASTERIZER = re.compile(r"(self\.)?\w*rasterizer")
"""What drawing functions call a rasterizer that they made."""
_GSPLAT = {
    **{"means": "means3D", "quats": "rotations", "scales": "scales"},
    **{"opacities": "opacities", "colors": "colors_precomp"},
}
"""Arguments of gsplat's ``rasterization`` in order, by their names in 3DGS."""
_CLAMPED = re.compile(
    r"(?:(?:torch|F)\.(?:clamp|clamp_min|relu))?\((.+) \+ 0\.5"
    r"(?:, |\)\.(?:clamp|clamp_min|relu)\()?(?:min=)?(?:0|0\.0)?\)"
)
"""How harmonics become colours."""
_USUAL = {
    **{"rasterize_mode": "classic", "camera_model": "pinhole", "eps2d": 0.3},
    "scale_modifier": 1.0,  # a setting of the rasterizers of 3DGS
}
"""Arguments of it that change the picture, and the values with which it draws as 3DGS does."""


def _of_covariances(model: ModelClass) -> Iterator[str]:
    """Covariances to which something is added."""
    for each in every(model.repo.definition(model.module, model.name), ast.FunctionDef):
        added = re.search(r".* [+-]=? .*", text_of(each))
        if added and re.fullmatch(r"(get|build)_covariance(_from\w+)?", each.name):
            at = model.repo.at(model.module, each.lineno)
            yield f"{each.name} makes other covariances, {added[0].strip()[:60]} ({at})"


def drawing_in(repo: HostRepo, module: str) -> list[ast.FunctionDef]:
    """The functions of a module that draw, ``render`` first, then those that return a picture."""
    body = getattr(repo.tree(module), "body", ())
    last = {each.name: each for each in body if isinstance(each, ast.FunctionDef)}
    found = [each for each in last.values() if _call(each)]
    return sorted(found, key=lambda each: (each.name != "render", not pictures(each)))


def given_to(function: Function, calls: Iterable[ast.Call]) -> dict[str, ast.expr]:
    """What calls of a drawing function, also by the name that 3DGS has for it in a test, give it by
    its parameters, without what is off.
    """
    takes, given = [each.arg for each in function.args.args], dict[str, ast.expr]()
    for call in (n for n in calls if text_of(n.func) in (function.name, "renderFunc")):
        several = any(isinstance(each, ast.Starred) for each in call.args)
        values = passed(call, () if several else takes).items()
        given |= {key: value for key, value in values if not is_off(value)}
    return given


def _call(function: ast.AST, known: Known = lambda _: []) -> ast.Call | None:
    """The call that draws, of several one whose picture is returned, and that is made by the values
    that are known.
    """
    shown, gone = _shown(function), skipped(function, known)
    calls = [node for node in every(function, ast.Call) if "means3D" in arguments(node)]
    order = {each: (each not in shown, each in gone, each.lineno) for each in calls}
    return min(order, key=order.__getitem__, default=None)


def arguments(call: ast.AST | None) -> dict[str, ast.expr]:
    """The arguments of a call, by their names in a rasterizer of 3DGS."""
    if not isinstance(call, ast.Call):
        return {}
    given = passed(call, ())
    if text_of(call.func).split(".")[-1] == "rasterization":
        return {_GSPLAT.get(name, name): value for name, value in passed(call, _GSPLAT).items()}
    drawn = "opacities" in given or _RASTERIZER.fullmatch(text_of(call.func))
    return passed(call, ARGUMENTS) if drawn else given


def pictures(function: ast.AST) -> list[ast.expr]:
    """What a function returns as ``render``."""
    later = (v for to, v in assigned(function) if text_of(getattr(to, "slice", None)) == "'render'")
    return [*entries(function, "render"), *later]


def _shown(function: ast.AST) -> list[ast.AST]:
    """The code that makes what a function returns as ``render``."""
    made: dict[str, list[ast.expr]] = {}
    for target, value in assigned(function):
        made.setdefault(getattr(first_of(target), "id", ""), []).append(value)
    found: list[ast.AST] = [*pictures(function)]
    for each in found:  # it grows
        if isinstance(each, ast.Name):
            found += made.pop(each.id, [])
        elif "means3D" not in arguments(each):
            found += ast.iter_child_nodes(each)
    return found


def _cuts(node: ast.Subscript) -> bool:
    """Whether code takes some or reorders some of what it reads, but for the first 3 channels."""
    parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    cut = [each for each in parts if text_of(each) not in (":", ":3", "0:3")]
    return any(isinstance(each, ast.Slice | ast.List) for each in cut)


def _never_set(repo: HostRepo, value: str) -> bool:
    """Whether a value is an attribute that may be missing, and that no file sets."""
    asked = re.fullmatch(r"getattr\(\w+, '(\w+)', None\)", value)
    if asked is None:
        return False
    model = (repo.read(each) for each in (repo.root / "scene").glob("*.py"))
    text = "".join((*model, *reading.texts_of(repo).values()))
    text = re.sub(rf"getattr\(\w+,\s*['\"]{asked[1]}['\"]", "", text)
    return not re.search(rf"['\"]{asked[1]}['\"]|\.{asked[1]}\s*(:[^=\n]+)?=(?!=)", text)


class Drawing:
    """A drawing function: where the inputs of its rasterizer come from."""

    def __init__(
        self,
        repo: HostRepo,
        module: str,
        function: Function,
        drawn_from: Collection[str] = (),  # what it may draw besides the values of plain 3DGS
        call: ast.Call | None = None,  # that draws; by default that whose picture it returns
        on: Collection[str] = (),  # arguments that are given, though they are off by default
    ) -> None:
        self.repo, self.module, self.function = repo, module, function
        self.drawn_from = drawn_from
        taken = function.args
        named = (*taken.posonlyargs, *taken.args, *taken.kwonlyargs)
        self.parameters = {each.arg for each in named}
        read = every(function, ast.Attribute)
        groups = {text_of(n.value) for n in read if reading.defaults(repo, "arguments", n.attr)}
        self.off = off_by_default(function) - ({*on} - groups)  # a group's options are off, too
        given = [*zip(reversed(taken.args), reversed(taken.defaults), strict=False)]
        self.defaults = {a.arg: v for a, v in given}
        self.switches = {a.arg for a, v in given if isinstance(getattr(v, "value", None), bool)}
        self.values: dict[str, list[ast.expr]] = {}
        self.unasked = skipped(function, reading.as_options(repo, ("arguments",)))
        xyz = (each.value for each in read if each.attr.startswith("get_xyz"))
        models = [each.id for each in xyz if isinstance(each, ast.Name)]
        self.model = models[0] if models else "pc"
        self.call = call or _call(function, self._known)
        self.arguments = arguments(self.call)
        self.colours = set[str]()  # options, off by default, by which something else colours
        self.made: dict[str, tuple[str, ...]] = {
            each: (each,) for each in (*self.parameters, self.model)
        }
        self.drawn = self.made
        self._collect(function.body)
        self.made = self.drawn

    def _known(self, node: ast.AST) -> list[None]:
        """None for arguments that are off, and for attributes that nobody sets."""
        off = isinstance(node, ast.Name) and node.id in self.off
        return [None] if off or _never_set(self.repo, text_of(node)) else []

    def _collect(self, body: list[ast.stmt]) -> None:
        """Note what every name is made of, except where an argument is needed that is off."""
        for node in body:
            if any(each is self.call for each in nodes(node)):
                self.drawn = self.made
            before = self.made
            if isinstance(node, ast.If):
                coloured = self._is_colour_option(node)
                taken = False if coloured else decided(node.test, self._known)
                self._collect([] if taken is False else node.body)
                if not taken:
                    then, self.made = self.made, before
                    self._collect(node.orelse)
                    self._join({} if taken is False else then)
            elif isinstance(node, ast.Assign):
                for target in node.targets:
                    self._assign(target, node.value)
            elif isinstance(node, ast.AnnAssign | ast.AugAssign):
                if node.value:
                    self._assign(node.target, node.value)
                    self._join(before if isinstance(node, ast.AugAssign) else {})
            elif isinstance(node, ast.Expr) and re.match(r"\w+\.\w+[^_]_\(", text_of(node)):
                self._assign(node.value.func.value, node.value)  # type: ignore[attr-defined]
                self._join(before)
            else:
                for field in ("body", "body", "orelse", "finalbody"):  # a loop's, twice
                    self._collect(getattr(node, field, []))
                    self._join(before)

    def _join(self, other: Mapping[str, tuple[str, ...]]) -> None:
        """Names may also be made as they are elsewhere."""
        joined = {each: (*self.made.get(each, ()), *made) for each, made in other.items()}
        self.made = self.made | {each: tuple(dict.fromkeys(made)) for each, made in joined.items()}

    def _is_colour_option(self, node: ast.If) -> bool:
        """Whether a branch makes colours if an option asks for it that is off by default."""
        option = node.test.attr if isinstance(node.test, ast.Attribute) else ""
        if option in ("", "convert_SHs_python"):
            return False
        made = any(text_of(each).startswith("colors_precomp = ") for each in node.body)
        if made and reading.off_in(self.repo, ("arguments",), option):
            self.colours.add(option)
        return option in self.colours

    def _assign(self, target: ast.expr, value: ast.expr) -> None:
        if isinstance(target, ast.Tuple):
            several = isinstance(value, ast.Tuple) and len(value.elts) == len(target.elts)
            for index, each in enumerate(target.elts):
                self._assign(each, value.elts[index] if several else value)  # type: ignore[attr-defined]
        elif isinstance(target, ast.Subscript):
            before = self.made
            self._assign(target.value, value)
            self._join(before)
        elif isinstance(target, ast.Name):
            self.values.setdefault(target.id, []).append(value)
            self.made = self.made | {target.id: tuple(dict.fromkeys(self._roots(value)))}

    def _roots(self, node: ast.expr | None) -> Iterator[str]:
        """What an expression is made of: "model.x", parameters, and "model" itself."""
        if node is None:
            return
        called = text_of(getattr(node, "func", None)) == "getattr"
        if called and re.match(r"getattr\(\w+, '", text_of(node)):
            of, name, *others = node.args  # type: ignore[attr-defined]
            yield from (root for each in others for root in self._roots(each))  # without it
            node = ast.Attribute(of, name.value)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if self.made.get(node.value.id) == (self.model,):
                yield from (f"{self.model}.{each}" for each in self._given_by(node.attr))
                return
            yield from self._roots(node.value)
        elif isinstance(node, ast.Name):
            yield from self.made.get(node.id, ())
        elif isinstance(node, ast.Subscript):
            yield from self._roots(node.value)
        elif isinstance(node, ast.ListComp | ast.GeneratorExp):
            for each in node.generators:
                self._assign(each.target, each.iter)
            yield from self._roots(node.elt)
        elif isinstance(node, ast.Lambda | ast.Dict):
            return
        else:
            for child in ast.iter_child_nodes(node):
                part = child.value if isinstance(child, ast.keyword) else child
                if isinstance(part, ast.expr):
                    yield from self._roots(part)

    def _model(self) -> ModelClass:
        return ModelClass(self.repo, reading.home_of(self.repo, "scene") or reading.MODEL)

    def _given_by(self, name: str) -> list[str]:
        """The attributes of the model that an attribute gives: itself, or what its method does."""
        method = self._model().method(name)
        body = method.body[-1] if method and len(method.body) == 1 else None
        value = body.value if isinstance(body, ast.Return) else None
        given = value.elts if isinstance(value, ast.Tuple) else []
        own = [each.attr for each in given if re.fullmatch(r"self\.\w+", text_of(each))]  # type: ignore[attr-defined]
        return own if own and len(own) == len(given) else [name]

    def selected(self) -> list[str]:
        """That it draws a selection, with the code that picks rows first, as ``means3D[mask]``."""
        gone = skipped(self.function, self._known)  # by what is off
        given = {} if self.call in gone else self.arguments
        own, seen = f"{self.model}.get_xyz", set()
        waiting = [value for name, value in given.items() if name == "means3D"]
        while waiting:
            for node in ast.walk(waiting.pop()):
                if isinstance(node, ast.Name) and node.id not in seen:
                    seen.add(node.id)
                    waiting += self.values.get(node.id, [])
                elif (of := chosen(node)) and own in self._roots(of):
                    return [f"draws a selection, {text_of(node)[:60]}"]
        return []

    def reasons(self) -> Iterator[tuple[str, bool]]:
        """Why the picture is not that of the PLY, and whether its rows are drawn all the same."""
        cuts = list(self.cuts())
        if cuts and not any(re.search(r"\[0?:3[,\]]", text_of(each)) for each in cuts):
            at = self._at(cuts[0])
            yield f"its picture is cut out of a tensor with further channels ({at})", False
        yield from self._others_first()
        yield from self.inputs()
        calls = read_calls(self.repo, self.module, self.function.name)
        names = dict.fromkeys([*self.arguments, *(n for each in calls for n in each.given)])
        given = dict.fromkeys(text_of(value) for each in calls for value in each.given.values())
        blended = [each for each in names if _PICTURES.fullmatch(each)]
        blended += filter(_BEHIND.fullmatch, given)
        blended = blended or [*self._of_columns()]
        if blended:
            yield f"its rasterizer also takes {', '.join(blended)}", False
        for each in calls:
            if "surfel" in each.package:
                yield f"its Gaussians are flat, drawn by {each.package}", False
            if each.package == "an unknown package":
                yield f"its rasterizer was not read ({each})", False
            grounds = [e for e in self._roots(each.given.get("bg")) if f"{self.model}." in e]
            if grounds:
                yield f"its background is made of {', '.join(grounds)}", True
        for wrap in self._wraps():
            yield f"its {self.function.name} is wrapped by {wrap[:60]}", True
        for made in filter(None, map(self._made_into, pictures(self.function))):
            yield f"its picture is made into {text_of(made)[:60]} ({self._at(made)})", True

    def _wraps(self) -> Iterator[str]:
        """What decorates the function, or takes it and is then called by its name."""
        name, found = self.function.name, list(map(text_of, self.function.decorator_list))
        for module in (self.module, *reading.training_modules(self.repo)):
            for node in getattr(self.repo.tree(module), "body", ()):
                again = isinstance(node, ast.Assign) and text_of(node.targets[0]) == name
                if again and name in map(text_of, getattr(node.value, "args", ())):
                    found.append(text_of(node.value))
        harmless = r"torch\.(no_grad|compile)|(functools\.)?partial\("
        yield from (each for each in found if not re.match(harmless, each))

    def _of_columns(self) -> Iterator[str]:
        """Arguments that further columns of the PLY may be, without channels beside the colours."""
        names = {*columns(self._model())[1]} - PLAIN
        further = {each for each in names if not change_of(each)}
        for name, value in self.arguments.items() if further else ():
            known = name in {*ARGUMENTS, *further} or _CHANNELS.search(name)
            others = [] if known else self._others(value)
            if any(each.startswith(f"{self.model}.") for each in others):
                yield name

    def _others_first(self) -> Iterator[tuple[str, bool]]:
        """Another picture that the rasterizer returns before the one that counts."""
        targets = [target for target, value in assigned(self.function) if value is self.call]
        names = [getattr(e, "id", "") for t in targets for e in getattr(t, "elts", ())]
        shown = {getattr(each, "id", "") for each in pictures(self.function)} & {*names}
        before = names[: min(map(names.index, shown), default=0)]
        if others := [each for each in before if _OTHERS.search(each)]:
            yield f"its rasterizer returns another picture first, {others[0]}", False

    def _made_into(
        self, value: ast.expr, seen: tuple[str, ...] = (), own: bool = False
    ) -> ast.expr | None:
        """The code that makes something else of the picture than its clamped numbers, or other
        numbers of the model's ``own`` values.
        """
        whole, of_model = value, f"{self.model}."
        while isinstance(value, ast.Call | ast.Subscript) and _call(value) is None:
            if isinstance(value, ast.Subscript):
                if isinstance(getattr(value.slice, "value", None), str):
                    return None
                if _cuts(value):
                    return whole
                value = value.value
                continue
            method = value.func
            named = text_of(method)
            if own and (named.rpartition(".")[0] == self.model or named in _ACTIVATING):
                return None
            if self._gives_back(getattr(method, "id", "")) and value.args:
                value = value.args[0]
                continue
            if getattr(method, "attr", "") not in (SAME if own else _KEEPS):
                return None if text_of(method).startswith("bg_color.") else whole
            of: ast.expr = method.value  # type: ignore[attr-defined]
            value = value.args[0] if text_of(of) == "torch" else of
        if isinstance(value, ast.Compare | ast.UnaryOp):
            return whole
        if isinstance(value, ast.BinOp):
            factor = getattr(self.defaults.get(text_of(value.right)), "value", None)
            same = {ast.Add: _ADDED.search(text_of(value.right)), ast.Mult: factor == 1}
            return self._made_into(value.left, seen, own) if same.get(type(value.op)) else whole
        if seen and isinstance(value, ast.Constant) and value.value is not None:
            return whole
        if own and text_of(value) in (f"{of_model}_scaling", f"{of_model}_opacity"):
            return whole
        name = getattr(value, "id", "")
        others = self.values.get(name, []) if name not in seen else []
        if own and self.call:  # what is neither of the model nor a number is unknown
            before = [each for each in others if each.lineno <= self.call.lineno]
            others = [e for e in before if isinstance(e, ast.Constant) or any(self._roots(e))]
        made = (self._made_into(e, (*seen, name), own) for e in others if self._counts(e))
        return next((each for each in made if each is not None), None)

    def _counts(self, value: ast.expr) -> bool:
        """Whether a value is given by default."""
        return value not in self.unasked

    def _gives_back(self, name: str) -> bool:
        """Whether a function returns first what its first argument is, or begins with."""
        function = reading.definition_of(self.repo, self.module, name)[1] if name else None
        plain = isinstance(function, ast.FunctionDef)
        kept = {each.arg for each in function.args.args[:1]} if plain else set()  # type: ignore[union-attr]
        for target, value in assigned(function):
            if getattr(value, "id", "") in kept and isinstance(target, ast.Tuple):
                kept |= {getattr(target.elts[0], "id", "")}
        given = [node.value for node in every(function, ast.Return)]
        return bool(given) and all(getattr(first_of(each), "id", "") in kept for each in given)

    def inputs(self) -> Iterator[tuple[str, bool]]:
        """Inputs of its call that a plain drawing does not have, and whether arguments of
        the function make them from the model's own.
        """
        yield from self.shapes()
        given, name, at = self.arguments, self.function.name, self._at(self.function)
        if others := self._others(given.get("shs")):
            yield f"{name} makes colours from {', '.join(others[:4])} ({at})", False
        kinds = re.findall(r"features_(dc|rest)", " ".join(self._roots(given.get("shs"))))
        if {*kinds} == {"rest"} and "dc" not in given:
            rest = next(each for each in self._roots(given["shs"]) if "features_rest" in each)
            yield f"{name} makes harmonics from {rest} alone ({at})", False
        for each in (*(e.given for e in read_calls(self.repo, self.module, name)), given):
            for argument, usual in _USUAL.items():
                value = each.get(argument)
                value = self.defaults.get(getattr(value, "id", ""), value)
                if not isinstance(value, ast.Name | None) and getattr(value, "value", 0) != usual:
                    how = f"{argument}={text_of(value)}, not {usual!r}"
                    yield f"{name} draws with {how} ({at})", True
        if value := given.get("colors_precomp"):
            channels = list(self._channels(value))
            others = [text_of(value)] if isinstance(value, ast.Call) else self._others(*channels)
            if others:
                roots = (root for each in channels for root in self._roots(each))
                own = any(each.startswith(f"{self.model}.get_features") for each in roots)
                what = f"makes colours from {', '.join(others[:4])} ({self._at(value)})"
                yield f"{name} {what}", own and self._beside(others)
            elif not self.drawn_from and (
                made := next(filter(None, map(self._other_colours, channels)), None)
            ):
                what = f"colours that are not max(harmonics + 0.5, 0), {text_of(made)[:60]}"
                yield f"{name} makes {what} ({self._at(made)})", True

    def _other_colours(self, value: ast.expr, seen: tuple[str, ...] = ()) -> ast.expr | None:
        """The code that makes colours of the model's features in another way than 3DGS."""
        name = getattr(value, "id", "")
        if name:
            others = self.values.get(name, []) if name not in seen else []
            made = (self._other_colours(e, (*seen, name)) for e in others if self._counts(e))
            return next(filter(None, made), None)
        drawn = text_of(getattr(self.call, "func", None))
        own = any("features" in e for e in self._roots(value)) and "rasterization" not in drawn
        clamped = _CLAMPED.fullmatch(text_of(value))
        texts = [clamped[1], *map(text_of, self.values.get(clamped[1], []))] if clamped else []
        return value if own and not any(each.startswith("eval_sh(") for each in texts) else None

    def shapes(self) -> Iterator[tuple[str, bool]]:
        """Likewise where its Gaussians are, and how large and opaque."""
        own = {"means3D": "get_xyz", "scales": "get_scaling", "rotations": "get_rotation"}
        own["cov3D_precomp"] = "get_covariance"
        for argument in ("means3D", "opacities", "scales", "rotations", "cov3D_precomp"):
            value = self.arguments.get(argument)
            named = self.values.get(getattr(value, "id", ""), [])
            if argument == "cov3D_precomp":
                if not any(self._counts(each) and not is_off(each) for each in named):
                    continue
                if not self.drawn_from:
                    yield from ((each, True) for each in _of_covariances(self._model()))
            if others := self._others(value):
                what = f"makes {argument} from {', '.join(others[:4])}, not from its PLY alone"
                kept = f"{self.model}.{own.get(argument)}" in self._roots(value)
                said = f"{self.function.name} {what} ({self._at(self.function)})"
                yield said, kept and self._beside(others)
                continue
            roots = {*self._roots(value)} if value and not self.drawn_from else set()
            alone = roots and all("." in e or e.startswith("scal") for e in roots)
            if alone and (made := self._made_into(value, own=True)):  # type: ignore[arg-type]
                what = f"makes {argument} otherwise than its PLY has them, {text_of(made)[:60]}"
                yield f"{self.function.name} {what} ({self._at(made)})", False

    def _others(self, *values: ast.expr | None) -> list[str]:
        """What values are made of that a plain drawing does not read, each once."""
        roots = dict.fromkeys(root for each in values for root in self._roots(each))
        return [each for each in roots if not self._plain(each)]

    def _at(self, node: ast.expr | Function) -> str:
        return self.repo.at(self.module, node.lineno)

    def _channels(self, value: ast.expr) -> Iterator[ast.expr]:
        """What the first channels are, where the picture is cut out of more."""
        name = getattr(value, "id", "")
        for each in self.values.get(name, [value]) if any(self.cuts()) else [value]:
            parts = each.args[:1] if isinstance(each, ast.Call) else []
            listed = parts and isinstance(parts[0], ast.Tuple | ast.List)
            first = parts[0].elts[0] if listed else each  # type: ignore[attr-defined]
            if not listed or getattr(first, "id", "") != name:  # else it is joined to itself
                yield first

    def _beside(self, roots: list[str]) -> bool:
        """Whether these are neither the model as a whole nor other values of its rows."""
        return not any(re.match(rf"{self.model}($|\.get_)", each) for each in roots)

    def cuts(self) -> Iterator[ast.expr]:
        """What takes channels out of the picture that the rasterizer returns."""
        whole = {
            getattr(first_of(target), "id", "")
            for target, value in assigned(self.function)
            if value is self.call
        } - {""}
        for node in nodes(self.function):
            if isinstance(node, ast.Attribute) and node.attr in ("split", "chunk", "unbind"):
                inner = node.value
                while isinstance(inner, ast.Subscript):
                    inner = inner.value
            elif isinstance(node, ast.Subscript):
                first, inner = first_of(node.slice), node.value
                if not isinstance(first, ast.Slice) or not (first.lower or first.upper):
                    continue
            else:
                continue
            if getattr(inner, "id", "") in whole:
                yield node

    def _plain(self, root: str) -> bool:
        _, dot, attribute = root.partition(".")
        if (attribute or root) in self.drawn_from:
            return True
        if dot:
            return bool(_OF_MODEL.fullmatch(attribute))
        return root in self.switches or (root != self.model and bool(_OF_CALL.fullmatch(root)))
