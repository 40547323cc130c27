"""Untrusted files: what is opened, what it says, and every reader behind it."""

import ast
import errno
import io
import json
import math
import os
import signal
import struct
import tracemalloc
import zlib
from pathlib import Path

import pytest
import torch
from finetune import tiny
from PIL import Image

import fragprune_plugins
from fragprune_plugins import View, load_cameras
from fragprune_plugins.errors import (
    DatasetError,
    InputError,
    ModelFileError,
    OutputError,
    RecordError,
    SidecarError,
    UsageError,
)
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply, read_thresholds
from fragprune_plugins.files.reading import NESTING, UntrustedFile, lies_in
from fragprune_plugins.hosts.adapter import ConfigFile, read_config
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.injection.starting import _SAFELY, _read_checkpoint
from fragprune_plugins.workbench.figures import records
from fragprune_plugins.workbench.models.formats.ply import write_ply
from fragprune_plugins.workbench.scenes import colmap
from fragprune_plugins.workbench.scenes.dataset import Photograph
from fragprune_plugins.workbench.scenes.pinhole import Camera

NAN, INF = math.nan, math.inf

EYE = torch.eye(4).tolist()


def header(*lines, start="ply\nformat binary_little_endian 1.0\n"):
    return (start + "\n".join(lines) + "\nend_header\n").encode()


GEOMETRY = {
    "fx": [0.0, NAN, INF, 1e-9, 1e12, [36.0]],
    "fy": [-36.0],
    "width": [0, -32, 10**9, 10**400, INF, "wide"],
    "rotation": [
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, NAN, 0], [0, 0, 1]],
        [[2, 0, 0], [0, 2, 0], [0, 0, 2]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -1]],  # a mirror
        [[1, 0, 0], [0, 1], [0, 0, 1]],
        [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "identity",
    ],
    "position": [[0, NAN, 0], [1e30, 0, 0], [0, 0], None],
}
"""Numbers that no camera has."""


def png(width, height):
    """A PNG of some 70 bytes that says that it is so large."""
    out = io.BytesIO()
    Image.new("RGB", (1, 1)).save(out, format="PNG")
    content = bytearray(out.getvalue())
    content[16:24] = struct.pack(">II", width, height)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    return bytes(content)


SPECIAL = {
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "loop": lambda path: path.symlink_to(path),
    "dangling": lambda path: path.symlink_to(path.with_name("nowhere")),
}
"""What is no regular file."""

SMALL = UntrustedFile(RecordError, "broken", "a file", "Write it again.", limit=100)


@pytest.fixture(autouse=True)
def no_waiting():
    """A reader that waits for a pipe ends the test, not the suite."""

    def late(*_):
        raise AssertionError("waited")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def read_colmap(path):
    tiny.write_colmap(path.parent / "scene", [torch.zeros(3, 4, 4)] * 9)
    target = path.parent / "scene" / "sparse" / "0" / "cameras.txt"
    target.unlink()
    path.rename(target)
    colmap.read(path.parent / "scene")


def read_sidecar(path):
    model = path.with_name("m.ply")
    model.write_bytes(b"ply\n")
    path.rename(sidecar.path_beside(model))
    sidecar.load(model)


def use(path, act, kind=None):
    with (kind or SMALL).reading(path) as reading:
        reading.place = "line 3"
        return act(reading)


def raising(error):
    def act(reading):
        raise error

    return act


READERS = {
    "ply": (read_ply, ModelFileError),
    "sidecar": (read_sidecar, SidecarError),
    "cameras": (load_cameras, DatasetError),
    "colmap": (read_colmap, DatasetError),
    "image": (lambda path: Photograph("a", tiny.cameras(1)[0].view(), path).image, DatasetError),
    "record": (records._read, RecordError),
    "checkpoint": (_read_checkpoint, (ModelFileError, UsageError)),
    "config": (lambda path: read_config(ConfigFile("--config"), path), UsageError),
}


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_regular_file_is_stated_at_once(tmp_path, reader, kind):
    read, error = READERS[reader]
    path = tmp_path / "file"
    SPECIAL[kind](path)
    with pytest.raises(error) as stated:
        read(path)
    assert stated.value.remedy


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "\udcff"])
@pytest.mark.parametrize("reader", ["ply", "cameras", "image", "record", "config"])
def test_names_that_no_file_has(tmp_path, reader, name):
    read, error = READERS[reader]
    with pytest.raises(error) as stated:
        read(tmp_path / name)
    assert str(stated.value).isprintable()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (KeyError("logits"), "no 'logits'"),
        (struct.error("unpack requires"), "unpack requires"),
        (RecursionError("deep"), "nested too deeply"),
        (MemoryError(), "it takes more memory than there is"),
        (OverflowError("int too large"), "int too large"),
        (ValueError("a\n\x1b[2J" + 1000 * "b"), "a"),
        (AssertionError(), "AssertionError"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_whatever_a_parser_raises_is_one_line_with_path_and_place(tmp_path, error, words):
    path = tmp_path / "a"
    path.write_bytes(b"x")
    with pytest.raises(RecordError) as stated:
        use(path, raising(error))
    assert stated.value.where == str(path)
    assert stated.value.found.startswith(f"broken at line 3 ({words}")
    assert str(stated.value).isprintable()
    assert len(str(stated.value)) < 700
    assert stated.value.__cause__ is error


def test_errors_of_ours_pass_but_one_about_a_value_becomes_the_files(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"x")
    with pytest.raises(OutputError):
        use(path, raising(OutputError("a", "b", "c", "d")))
    with pytest.raises(RecordError, match=r"a: line 3: fx: -1; expected positive"):
        use(path, raising(InputError("fx", "-1", "positive", "Check it.")))
    with pytest.raises(KeyboardInterrupt):
        use(path, raising(KeyboardInterrupt()))


def test_a_file_is_bounded_and_so_is_what_it_announces(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(101))
    with pytest.raises(RecordError, match=r"101 bytes.*at most 100"):
        use(path, lambda reading: None)
    path.write_bytes(bytes(100))
    with SMALL.reading(path) as reading:
        assert reading.take(60) == bytes(60)
        reading.skip(30)
        assert reading.left == 10
    for name in ("take", "skip"):
        with pytest.raises(RecordError, match=f"{1 << 62} bytes announced at byte 0, where 100"):
            use(path, lambda reading, name=name: getattr(reading, name)(1 << 62))


@pytest.mark.parametrize("ends", [('{"a":', "}"), ("[", "]")])
@pytest.mark.parametrize("depth", [NESTING - 1, NESTING, 100_000])
def test_json_is_bounded_in_depth(tmp_path, depth, ends):
    kind = UntrustedFile(RecordError, "broken", "a file", "Write it again.")
    path = tmp_path / "a.json"
    path.write_text(ends[0] * depth + "1" + ends[1] * depth)
    if depth < NESTING:
        assert use(path, lambda reading: reading.json(), kind)
    else:
        with pytest.raises(RecordError, match=rf"more than {NESTING} levels|deeply"):
            use(path, lambda reading: reading.json(), kind)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header(f"element vertex {2**63}", "property float x"), "cut off|line 3"),
        (header(f"element vertex {2**40}", "property float x"), f"cut off in row 0 of {2**40}"),
        (
            header("element vertex 2", "property float x", start="ply\nformat ascii 1.0\n")
            + b"1 two",
            "not readable as PLY",
        ),
        (b"ply\n" + b"comment " + b"x" * 30_000_000, "no end_header in the first 1048576 bytes"),
        (b"ply\n" + b"comment a\n" * 3_000_000, "no end_header in the first 1048576 bytes"),
    ],
)
def test_a_header_is_checked_against_the_file(tmp_path, content, words):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=words):
        read_ply(path)
    assert read_thresholds(path) is None


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        ("scaling", 31.0, "scales.* 2 of 8 rows: 1, 6; expected logarithms"),
        ("rotation", 0.0, "quaternions of length 0.* 2 of 8 rows: 1, 6"),
        ("rotation", 1e-30, "quaternions of length 0"),
        ("rotation", 1e25, "quaternions too long"),
        ("xyz", torch.nan, r"2 of 8 rows \(x, y, z\): 1, 6"),
        ("f_dc", torch.inf, r"NaN or infinity in 2 of 8 rows"),
    ],
)
def test_gaussians_that_cannot_be_drawn_are_refused_with_their_rows(tmp_path, part, value, words):
    model = tiny.random_model(8)
    getattr(model, part)[[1, 6]] = value
    write_ply(tmp_path / "a.ply", model)
    with pytest.raises(ModelFileError, match=words):
        read_ply(tmp_path / "a.ply")


def write_cameras(path, **changed):
    entry = tiny.host_cameras(tiny.cameras(1))[0]
    path.write_text(json.dumps([entry, entry | changed]))
    return path


@pytest.mark.parametrize(
    ("name", "value"), [(name, each) for name, wrong in GEOMETRY.items() for each in wrong]
)
def test_a_camera_that_is_none_is_refused_with_its_place(tmp_path, name, value):
    path = write_cameras(tmp_path / "cameras.json", **{name: value})
    with pytest.raises(DatasetError, match=r"\[1\]") as stated:
        load_cameras(path)
    assert stated.value.where == str(path)


@pytest.mark.parametrize(
    ("matrix", "changed"),
    [
        (EYE[:2], {}),
        ([EYE], {}),
        (torch.full((4, 4), NAN).tolist(), {}),
        (torch.zeros(4, 4).tolist(), {}),
        (EYE, {"w": float("inf")}),
        (EYE, {"camera_angle_x": 0.0}),
        (EYE, {"fl_x": -5}),
        (EYE, {"cx": NAN}),
        (EYE, {"frames": [3]}),
        (EYE, {"frames": 3}),
        (EYE, {"k1": 1e30}),
    ],
)
def test_transforms_that_are_none_are_refused(tmp_path, matrix, changed):
    frames = [{"file_path": "a", "transform_matrix": matrix}]
    content = {"camera_angle_x": 0.8, "w": 32, "h": 32, "frames": frames} | changed
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError):
        load_cameras(tmp_path / "transforms_train.json")


@pytest.mark.parametrize("rounded", [6, 3])
def test_rounded_matrices_are_accepted(tmp_path, rounded):
    turn = tiny.cameras(7)[3].rotation.T.numpy().round(rounded).tolist()
    assert len(load_cameras(write_cameras(tmp_path / "cameras.json", rotation=turn))) == 2


@pytest.mark.parametrize("number", [0.0, -1.0, NAN, float("inf")])
def test_a_lens_that_is_none_is_refused_in_python_too(number):
    with pytest.raises(InputError, match="fx"):
        View.pinhole(torch.eye(3), torch.zeros(3), width=4, height=4, fx=number, fy=4.0)
    with pytest.raises(InputError, match="fy"):
        Camera(torch.eye(3), torch.zeros(3), 4, 4, 4.0, number, 2.0, 2.0)


@pytest.mark.parametrize("size", [(20_000, 8_001), (60_000, 60_000), (2**31 - 1, 1)])
def test_an_image_that_unpacks_into_gigabytes_is_refused(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(*size))
    with pytest.raises(DatasetError):
        READERS["image"][0](tmp_path / "a.png")


def test_no_other_program_opens_an_image(tmp_path):
    """Pillow hands PostScript to Ghostscript."""
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EOF\n")
    with pytest.raises(DatasetError, match="no PNG"):
        READERS["image"][0](tmp_path / "a.png")


class Evil:
    def __reduce__(self):
        return os.system, ("touch executed",)


@pytest.mark.skipif(torch.__version__ < "2.5", reason="loaded as hosts load it")
def test_nothing_in_a_checkpoint_is_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save((Evil(), 7), tmp_path / "chkpnt7.pth")
    with pytest.raises(ModelFileError, match="not readable as a checkpoint"):
        _read_checkpoint(tmp_path / "chkpnt7.pth")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("reference", ["../secret", "refs/../../secret", "/etc/passwd", "refs/out"])
def test_a_reference_out_of_git_is_not_followed(tmp_path, reference):
    (tmp_path / "secret").write_text("cafe cafe")
    git = tmp_path / "host" / ".git"
    (git / "refs").mkdir(parents=True)
    (git / "refs" / "out").symlink_to(tmp_path / "secret")
    (git / "HEAD").write_text(f"ref: {reference}\n")
    assert HostRepo(tmp_path / "host").commit == ""
    (git / "HEAD").write_bytes(b"\xff\xfe root:x:0:0")
    assert HostRepo(tmp_path / "host").commit == ""


def test_a_checkout_is_read_inside_of_it(tmp_path):
    (tmp_path / "secret.py").write_text("def train(): ...\n")
    host = tmp_path / "host"
    host.mkdir()
    (host / "train.py").symlink_to(tmp_path / "secret.py")
    (host / "own.py").symlink_to(host / "real.py")
    (host / "real.py").write_text(r'def train(): return "\d"')  # hosts have such: no warning
    (host / "round.py").symlink_to(host / "round.py")
    repo = HostRepo(host)
    assert repo.path("train") is None
    assert repo.path("round") is None
    assert repo.path("x" * 300) is None
    assert repo.function("own", "train") is not None


@pytest.mark.parametrize(
    "text",
    [b"(" * 5000 + b")" * 5000, b"x = " + b"-" * 200_000 + b"1", b"\0", b"\\", b"\xff\xfe", b"if:"],
    ids=lambda text: repr(text[:9]),
)
def test_source_that_python_cannot_parse_is_no_source(tmp_path, text):
    (tmp_path / "train.py").write_bytes(text)
    assert HostRepo(tmp_path).tree("train") is None


def test_checkpoints_are_loaded_by_the_safe_loader_alone():
    """The conformance kit is left out: it opens checkpoints that it wrote itself."""
    root = Path(fragprune_plugins.__file__).parent
    loads = [
        (path.name, {f"{each.arg}={ast.unparse(each.value)}" for each in node.keywords})
        for folder in (root, root.parent / "adapters", root.parent / "reference_renderer")
        for path in folder.rglob("*.py")
        if not {"testing", "host"} & set(path.relative_to(folder).parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("torch.load", "pickle.load")
    ]
    assert loads
    assert all({"weights_only=True", "None=_SAFELY"} & words for _, words in loads), loads
    assert _SAFELY["weights_only"] == (torch.__version__ >= "2.5")


@pytest.mark.parametrize(("asked", "given"), [(1 << 62, 3), (2 << 20, 2), (-1, 3), (None, 3)])
def test_a_read_takes_no_more_memory_than_the_file_has_bytes_left(tmp_path, asked, given):
    (tmp_path / "a").write_bytes(bytes(4 << 20))
    with UntrustedFile(RecordError, "broken", "a file", "Write it again.").reading(
        tmp_path / "a"
    ) as reading:
        reading.skip(1 << 20)
        tracemalloc.start()
        content = reading.file.read(asked)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert len(content) == given << 20
    assert peak < len(content) + (1 << 20)


def test_a_pipe_that_takes_a_files_place_meanwhile_is_not_waited_for(tmp_path, monkeypatch):
    pipe = tmp_path / "a"
    os.mkfifo(pipe)
    before = Path(__file__).stat()
    monkeypatch.setattr(Path, "stat", lambda path, **_: before)  # as it was when it was looked at
    with pytest.raises(RecordError, match=f"{pipe}: no regular file"), SMALL.reading(pipe):
        pass


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), "Permission denied"),
        (ValueError("embedded null byte"), "embedded null byte"),
    ],
)
def test_a_file_that_cannot_be_opened_is_named_with_the_reason(tmp_path, monkeypatch, error, why):
    def refused(*_):
        raise error

    (tmp_path / "a").touch()
    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(RecordError) as caught, SMALL.reading(tmp_path / "a"):
        pass
    assert caught.value.where == str(tmp_path / "a")
    assert caught.value.found == f"cannot be opened ({why})"


def test_what_git_lfs_left_in_a_files_place_is_told(tmp_path):
    path = tmp_path / "model.ply"
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 9\n")
    with pytest.raises(ModelFileError, match=r"git's pointer; .* Run: git lfs pull"):
        read_ply(path)


def test_a_name_that_no_file_has_lies_nowhere(tmp_path):
    assert lies_in(tmp_path / "a", tmp_path)
    assert not lies_in(tmp_path / ".." / "a", tmp_path)
    assert not lies_in(tmp_path / "a\0b", tmp_path)
