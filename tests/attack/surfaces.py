"""Attacks on what reads no model: settings, logs, the viewer's server, and the process around."""

from __future__ import annotations

import gzip
import json
import os
import resource
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from attack.hostile import GOOD
from attack.running import Outcome, Result, command, in_child, judged, raised
from finetune import tiny

from fragprune_plugins.workbench.finetune import checkpoints
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.view.server import open_server

ROOT = Path(__file__).parents[2]

SETTINGS = {
    GOOD + "as a line": 'iters = 1\nimages = "images"\nwhite-background = true\nlog = []',
    "a list": "iters = [1]",
    "a table": "iters = {a = 1}",
    "a date": "iters = 1979-05-27",
    "infinity": "iters = inf",
    "400 digits": "iters = " + "9" * 400,
    "not a number": "max-drop = nan",
    "an endless pause": "checkpoint-every = inf",
    "a flag of words": 'self = "maybe"',
    "a flag of a list": "self = []",
    "a flag of a number": "white-background = 3",
    "a log that is no list": 'log = "csv:a.csv"',
    "logs of lists": 'log = [["csv:a.csv"]]',
    "a log of no kind": 'log = ["shell:a"]',
    "a name with a NUL": 'images = "\\u0000"',
    "itself": 'config = "a.toml"',
    "an unknown name": '"\\u001b[2J" = 1',
    "nested 100,000 deep": "a = " + "[" * 100_000,
    "twice": "iters = 1\niters = 2",
    "not UTF-8": b"iters = 1 # \xff",
    "2 MiB": "#" * (2 << 20),
    "a folder that climbs": 'images = "../../../../../../etc"',
}
"""TOML files for ``finetune --config``."""

ARGUMENTS = {
    GOOD + "as a host writes it": "Namespace(source_path={data!r}, eval=True)",
    "a call that runs": "Namespace(source_path=__import__('os').system('touch {out}'))",
    "another call": "print(source_path={data!r})",
    "a function": "(lambda source_path: 1)(source_path={data!r})",
    "a text as long as memory": "Namespace(source_path='x' * 10**10)",
    "words in a dict": "Namespace(**{{'source_path': {data!r}}})",
    "a resolution of infinity": "Namespace(source_path={data!r}, resolution=1e999)",
    "a resolution of words": "Namespace(source_path={data!r}, resolution='full')",
    "images that climb": "Namespace(source_path={data!r}, images='../../../../../etc')",
    "images from the root": "Namespace(source_path={data!r}, images='/etc')",
    "a NUL": "Namespace(source_path='a\\x00b')",
    "an escape": "Namespace(source_path='\\x1b[2J')",
    "brackets 5,000 deep": "Namespace(source_path=" + "(" * 5000 + ")" * 5001,
    "nothing": "",
    "2 MiB": "Namespace(source_path='" + "x" * (2 << 20) + "')",
}
"""Texts for the cfg_args of an output folder."""


def settings(options: Any, fresh: Any, words: Any) -> Result:
    """``finetune --config``."""

    def put(at: Any, text: Any) -> None:
        content = text if isinstance(text, bytes) else text.encode()
        (at.folder / "a.toml").write_bytes(content)

    def ask(at: Any) -> tuple[object, ...]:
        given = ("finetune", at.model, "--data", at.data, "--out", at.out / "o.ply")
        return (*given, "--config", at.folder / "a.toml", "--threads", 1)

    del words
    return _each(options, fresh, SETTINGS, put, ask)


def arguments(options: Any, fresh: Any, words: Any) -> Result:
    """The output folder of a training as a model, with the arguments that it says it had."""

    def put(at: Any, text: str) -> None:
        folder = at.folder / "run" / "point_cloud" / "iteration_7"
        folder.mkdir(parents=True)
        shutil.copy(at.model, folder / "point_cloud.ply")
        ran = at.folder / "executed"
        said = text.format(data=str(at.data), out=ran) if len(text) < 1000 else text
        (at.folder / "run" / "cfg_args").write_text(said)

    def ask(at: Any) -> tuple[object, ...]:
        return ("profile", at.folder / "run", "--threads", 1)

    del words
    return _each(options, fresh, ARGUMENTS, put, ask, forbidden="executed")


def paths(options: Any, fresh: Any, words: Any) -> Result:
    """Photographs and masks of a transforms file that lie elsewhere, or are nothing to look at."""
    places: tuple[Any, ...] = ("../../../../etc/passwd", "/dev/zero", "file:///etc/passwd", 5, [5])
    places += ("\0", "//server/share/x.png", "\\\\server\\x.png", "x" * 300, "pipe", "wide.png")
    cases = {f"{key} {str(place)[:30]!r}": (key, place) for key in ("file_path", "mask_path")
             for place in places}  # fmt: skip

    def put(at: Any, case: tuple[str, Any]) -> None:
        shutil.rmtree(at.data / "sparse")
        names = sorted(path.name for path in (at.data / "images").iterdir())
        frames = tiny.transforms([f"images/{name}" for name in names], tiny.cameras(len(names)))
        frames["frames"][1][case[0]] = case[1]
        (at.data / "transforms.json").write_text(json.dumps(frames | {"w": 32, "h": 32}))
        os.mkfifo(at.data / "pipe")
        tiny.save_png(at.data / "wide.png", torch.zeros(3, 8, 32))

    def ask(at: Any) -> tuple[object, ...]:
        return (*words(at, "finetune")["finetune"], "--iters", 9)

    return _each(options, fresh, cases, put, ask)


def bombs(options: Any, fresh: Any, words: Any) -> Result:
    """Small files that unpack into gigabytes: refused before they do."""
    result = Result()

    def sog(path: Path, how: int) -> None:
        with zipfile.ZipFile(path.with_name("good.sog")) as good, zipfile.ZipFile(
            path, "w", how
        ) as bomb:  # fmt: skip
            for each in good.namelist():
                data = bytes(200 << 20) if each == "means_l.webp" else good.read(each)
                bomb.writestr(each, data)

    def spz(path: Path, count: int) -> None:
        head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0)
        with gzip.open(path, "wb", compresslevel=1) as file:
            file.write(head)
            for _ in range(65):
                file.write(bytes(count))

    cases: dict[str, tuple[str, Callable[[Path], None]]] = {
        "200 MiB in a deflated .sog": ("b.sog", lambda path: sog(path, zipfile.ZIP_DEFLATED)),
        "200 MiB in a .sog of bzip2": ("b.sog", lambda path: sog(path, zipfile.ZIP_BZIP2)),
        "200 MiB in a .sog of LZMA": ("b.sog", lambda path: sog(path, zipfile.ZIP_LZMA)),
        "3 million Gaussians in 200 KB of .spz": ("b.spz", lambda path: spz(path, 3_000_000)),
    }
    del words
    for name, (file, make) in cases.items():
        with fresh(options) as at:
            models.save(at.folder / "good.sog", models.load(at.model))
            bomb = at.folder / file
            make(bomb)

            def act(bomb: Path = bomb, at: Any = at) -> Outcome:
                before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                out = command("export", bomb, "--no-truncation", "--out", at.folder / "x.ply")
                grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
                return out if grown < 200 else ("crash", f"{grown} MiB more, then {out}")

            result.note(name, judged(name, in_child(act)))
    return result


def forged(options: Any, fresh: Any, words: Any) -> Result:
    """Checkpoints of an unfinished ``finetune`` whose parts were changed."""
    result, folder = Result(), options.folder / "unfinished"
    name = "o.fragprune-unfinished"

    def ask(at: Any) -> tuple[object, ...]:
        return (*words(at, "finetune")["finetune"], "--iters", 6)

    def begin(at: Any) -> Outcome:
        from fragprune_plugins.workbench.finetune import resuming

        save = resuming.Checkpoints.save

        def once(kept: Any, *parts: Any) -> None:
            save(kept, *parts)
            os._exit(0)

        resuming.Checkpoints.due = lambda self, step: step == 3  # type: ignore[method-assign]
        resuming.Checkpoints.save = once  # type: ignore[method-assign]
        return command(*ask(at))

    with fresh(options) as at:
        in_child(lambda: begin(at))  # it ends without an answer
        shutil.copytree(at.out, folder)
    tensors, values = checkpoints.load(folder / name)

    def other(**changed: torch.Tensor | None) -> tuple[Any, Any]:
        return {k: v for k, v in (tensors | changed).items() if v is not None}, values

    def said(key: str, value: Any) -> tuple[Any, Any]:
        return tensors, values | {key: value}

    cases: dict[str, Any] = {GOOD + "as it is": (tensors, values)}
    for key, tensor in tensors.items():
        if key != "curves" and tensor.ndim:
            cases[f"no {key}"] = other(**{key: None})
            cases[f"half of {key}"] = other(**{key: tensor[: len(tensor) // 2].clone()})
    for key in ("logits", "exp_avg", "exp_avg_sq"):
        cases[f"doubles of {key}"] = other(**{key: tensors[key].double()})
    for key in ("steps", "done", "_open", "pressure", "store", "seconds", "adam_step"):
        for value in (None, "x", [], {}, -1):
            if not (key == "pressure" and value == {}):
                cases[f"{key} {value!r}"] = said(key, value)
    for case, (changed, plain) in cases.items():
        with fresh(options) as at:
            at.out.mkdir()
            checkpoints.save(at.out / name, changed, plain)
            result.note(case, judged(case, in_child(lambda at=at: command(*ask(at)))))
    return result


def requests(options: Any, fresh: Any, words: Any) -> Result:
    """What another page, or a person with a socket, may send to the viewer's server."""
    del options, fresh, words
    host = "Host: localhost:PORT\r\nConnection: close\r\n"
    cases = {
        GOOD + "its page": f"GET / HTTP/1.1\r\n{host}\r\n",
        "another host": "GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        "another port": "GET / HTTP/1.1\r\nHost: localhost:1\r\n\r\n",
        "no host": "GET / HTTP/1.1\r\n\r\n",
        "two hosts": f"GET / HTTP/1.1\r\nHost: evil.example\r\n{host}\r\n",
        "up": f"GET /../../../../etc/passwd HTTP/1.1\r\n{host}\r\n",
        "up in codes": f"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\n{host}\r\n",
        "a drive": f"GET /C:/Windows/win.ini HTTP/1.1\r\n{host}\r\n",
        "an address that is none": f"GET http://[ HTTP/1.1\r\n{host}\r\n",
        "another scheme": f"GET file:///etc/passwd HTTP/1.1\r\n{host}\r\n",
        "a proxy's": f"CONNECT evil.example:443 HTTP/1.1\r\n{host}\r\n",
        "to write": f"PUT /index.html HTTP/1.1\r\n{host}Content-Length: 9\r\n\r\n",
        "to delete": f"DELETE / HTTP/1.1\r\n{host}\r\n",
        "a line of 70,000 letters": f"GET /{'x' * 70_000} HTTP/1.1\r\n{host}\r\n",
        "300 headers": f"GET / HTTP/1.1\r\n{host}" + "A: b\r\n" * 300 + "\r\n",
        "no letters": "\0\xff\r\n\r\n",
        "a version of its own": f"GET / HTTP/9.9\r\n{host}\r\n",
    }

    def serve(request: str) -> Outcome:
        told: list[BaseException | None] = []
        with open_server({"index.html": b"<p>ours", "a": bytes(64 << 20)}) as server:
            server.handle_error = lambda *_: told.append(sys.exc_info()[1])  # type: ignore[method-assign]
            threading.Thread(target=server.serve_forever, daemon=True).start()
            with socket.create_connection(server.server_address[:2], timeout=10) as to:
                to.sendall(request.replace("PORT", str(server.server_port)).encode("latin-1"))
                answer = b"".join(iter(lambda: to.recv(1 << 16), b""))  # to the end
            server.shutdown()
        if told:
            return "traceback", repr(told[0])
        if b"root:" in answer:
            return "nonsense", "a file of this machine"
        return ("fine" if b"<p>ours" in answer else "stated"), ""

    result = Result()
    for name, request in cases.items():
        result.note(name, judged(name, in_child(lambda request=request: serve(request))))
    return result


def logs(options: Any, fresh: Any, words: Any) -> Result:
    """``--log`` at a place where something is: a model, a pipe, a folder, a full device."""
    places = {
        GOOD + "a new file": "csv:{folder}/new.csv",
        GOOD + "a full device": "csv:/dev/full",
        "the model": "csv:{folder}/model.ply",
        "a pipe that nobody reads": "csv:{folder}/pipe",
        "a folder": "csv:{folder}/data",
        "no folder": "csv:{folder}/none/a.csv",
        "a name of 300 letters": "csv:{folder}/" + "x" * 300,
    }

    def put(at: Any, _: str) -> None:
        os.mkfifo(at.folder / "pipe")

    result = Result()
    for name, place in places.items():
        with fresh(options) as at:
            put(at, place)
            before = at.model.read_bytes()
            given = (*words(at, "finetune")["finetune"], "--log", place.format(folder=at.folder))
            outcome = judged(name, in_child(lambda given=given: command(*given)))
            lost = at.model.read_bytes() != before
            result.note(name, ("nonsense", "the model is lost") if lost else outcome)
    return result


def surroundings(options: Any, fresh: Any, words: Any) -> Result:
    """Real processes without streams, home, locale, folder, or space."""
    bare = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}

    def full(size: int) -> Callable[[], None]:
        return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    def closed(*numbers: int) -> Callable[[], None]:
        return lambda: [os.close(number) for number in numbers] and None

    cases: dict[str, tuple[str, dict[str, str | None], Callable[[], Any] | None]] = {
        GOOD + "locale C": ("render", bare, None),
        GOOD + "an output of Latin 1": ("render", {"PYTHONIOENCODING": "latin-1"}, None),
        GOOD + "no home": ("finetune", {"HOME": None, "XDG_CACHE_HOME": None}, None),
        GOOD + "no folder for temporary files": ("finetune", {"TMPDIR": "/nonexistent"}, None),
        GOOD + "stdin closed": ("finetune", {}, closed(0)),
        GOOD + "stdout closed": ("finetune", {}, closed(1)),
        GOOD + "stderr closed": ("finetune", {}, closed(2)),
        GOOD + "all closed": ("finetune", {}, closed(0, 1, 2)),
        "the folder gone": ("finetune", {}, lambda: os.rmdir(os.getcwd())),
        "no space at all": ("export", {}, full(0)),
        "a full disk": ("finetune", {}, full(1000)),
        "a full disk, export": ("export", {}, full(1000)),
    }
    result = Result()
    for name, (which, changed, before) in cases.items():
        with fresh(options) as at:
            (at.folder / "cwd").mkdir()
            out = at.out / ("\u2192.ply" if which != "render" else "\u2192")
            given = list(words(at, which)[which])
            given[given.index("--out") + 1] = out
            given += ["--no-truncation"] if which == "export" else []
            here = {
                key: value for key, value in (os.environ | changed).items() if value is not None
            }
            here["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), here.get("PYTHONPATH")]))
            done = subprocess.run(
                [sys.executable, "-m", "fragprune_plugins", *map(str, given)],
                cwd=at.folder / "cwd",
                env=here,
                preexec_fn=before,
                capture_output=True,
                timeout=300,
            )
            result.note(name, judged(name, _ended(done, out)))
    return result


def _ended(done: subprocess.CompletedProcess[bytes], out: Path) -> Outcome:
    said = (done.stdout + done.stderr).decode(errors="replace")
    if "Traceback" in said:
        return "traceback", said[-300:]
    if done.returncode < 0:
        return "crash", f"signal {-done.returncode}"
    if done.returncode == 0:
        return ("fine", "") if out.exists() else ("nonsense", "no output")
    left = list(out.parent.glob("*")) if out.parent.exists() else []
    if left:
        return "nonsense", f"left {left}"
    return ("stated", "") if said.lstrip().startswith("[") or "\n[" in said else ("nonsense", said)


def two_at_once(options: Any, fresh: Any, words: Any) -> Result:
    """Two fine-tunings of other lengths into one file, and a reader: whole pairs only."""
    result = Result()
    for number in range(max(2, options.inputs // 100)):
        with fresh(options) as at:
            children = []
            for iterations in (2, 3):
                given = (*words(at, "finetune")["finetune"], "--iters", iterations, "--again")
                child = os.fork()
                if child == 0:
                    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                    kind, _ = command(*given)
                    os._exit(0 if kind in ("fine", "stated", "warned") else 1)
                children.append(child)
            codes = []
            while children:
                ended, status = os.waitpid(children[0], os.WNOHANG)
                if ended:
                    codes.append(os.waitstatus_to_exitcode(status))
                    children.pop(0)
                if (at.out / "o.ply").exists():
                    outcome = raised(lambda at=at: models.load(at.out / "o.ply"))
                    if outcome[0] != "fine":
                        result.note("a reader", ("nonsense", outcome[1]))
                time.sleep(0.01)
            whole = raised(lambda at=at: models.load(at.out / "o.ply"))
            left = [p.name for p in at.out.iterdir() if p.name.startswith(".")]
            fine = codes == [0, 0] and whole[0] == "fine" and not left
            result.note(f"pair {number}", ("fine", "") if fine else ("nonsense", f"{codes} {left}"))
    return result


def _each(
    options: Any,
    fresh: Any,
    cases: dict[str, Any],
    put: Callable[[Any, Any], None],
    ask: Callable[[Any], tuple[object, ...]],
    forbidden: str = "",
) -> Result:
    """Run one command on every case, in a scene of its own."""
    result = Result()
    for name, case in cases.items():
        with fresh(options) as at:
            put(at, case)
            outcome = judged(name, in_child(lambda at=at: command(*ask(at))))
            if forbidden and (at.folder / forbidden).exists():
                outcome = "nonsense", "it was executed"
            result.note(name, outcome)
    return result


SURFACES = {
    "hostile settings through finetune --config": settings,
    "hostile cfg_args through profile": arguments,
    "photographs and masks that lie elsewhere, through finetune": paths,
    "small files that unpack into gigabytes": bombs,
    "forged checkpoints of finetune": forged,
    "requests to the viewer's server": requests,
    "logs over what is there": logs,
    "processes without streams, home, locale, folder or space": surroundings,
    "two fine-tunings into one file, and a reader": two_at_once,
}
"""Functions of options, ``fresh`` and ``commands`` by name."""
