"""Every format: what is written comes back within its own quantisation."""

import gzip
import math
import struct
import zipfile
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import torch
from cli.commands import run, run_json
from finetune import tiny
from formats.scenes import apart, random_splat, splats
from hypothesis import given, settings

from fragprune_plugins import ThresholdStore, load, load_dataset, measure, rasterize, save
from fragprune_plugins.errors import ModelFileError, OutputError, PluginError
from fragprune_plugins.files import sidecar
from fragprune_plugins.files.ply import read_ply
from fragprune_plugins.workbench.models import cutoffs, formats
from fragprune_plugins.workbench.models.formats.arrays import morton_order, ordered, turned
from fragprune_plugins.workbench.models.formats.ply import write_ply

# Half a step of each format's own quantisation, with the values that ``random_splat`` has.
# xyz lie within 8 (16 across), colours within 0.5 +- 0.43, log scales within -7 to 1.
# SPZ rounds rest to one of 256 levels, then to every 16th; its scales differ by 3 % each, so
# variances by 6 %. SOG: d x / d log(1 + x) is at most 9; so few values have codebooks of their own.
KINDS = ("xyz", "colour", "rest", "opacity", "scaling", "shape")
BOUNDS = {
    ".spz": (0.5 / 4096, 0.28209479 * 0.5 / 255 / 0.15, 8.5 / 128, 0.5 / 255, 1 / 32, 0.13),
    ".glb": (0, 0, 0, 1e-6, 1e-5, 1e-4),
    ".sog": (9 * 2 * math.log(9) / 65535 / 2 * 1.01, 1e-6, 0.02, 0.5 / 255, 1e-6, 0.02),
    ".compressed.ply": (
        16 / 1023 / 2,
        0.86 / 255 / 2,
        8 / 256 * 1.01,
        0.5 / 255,
        8 / 1023 / 2,
        0.03,
    ),
    ".splat": (0, 0.51 / 255, 0, 0.51 / 255, 1e-5, 0.03),
}
SORTED = (".sog", ".compressed.ply")
CARRIERS = (".spz", ".sog", ".glb")
few = settings(max_examples=12)


def through(suffix, model):
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"model{suffix}"
        save(path, model)
        return load(path)


@pytest.mark.parametrize("suffix", BOUNDS)
@few
@given(splat=splats)
def test_what_is_written_comes_back(suffix, splat):
    back = through(suffix, splat)
    if suffix in SORTED:
        splat = ordered(splat, morton_order(splat))
    if suffix == ".splat":
        splat = replace(splat, f_rest=splat.f_rest[:, :0])
    found, bounds = apart(splat, back), dict(zip(KINDS, BOUNDS[suffix], strict=True))
    assert all(found[name] <= bounds[name] + 2e-6 for name in found), (found, bounds)  # float32
    assert back.rotation.is_contiguous()  # else each frame copies it, and its time is no file's


@pytest.mark.parametrize("suffix", CARRIERS)
@few
@given(splat=splats)
def test_thresholds_come_back_with_their_rows(suffix, splat):
    tau = torch.linspace(0.004, 0.97, len(splat))
    back = through(suffix, tiny.cut(splat, tau)).thresholds
    wanted = cutoffs.encode(tau if suffix not in SORTED else tau[morton_order(splat)])
    if back is None:  # a row alone may have been rounded to 1/255
        assert not wanted.any()
    else:
        assert cutoffs.encode(back.values.detach()).tolist() == wanted.tolist()


@pytest.mark.parametrize("suffix", CARRIERS)
def test_neutral_rows_stay_neutral_and_a_neutral_store_is_not_written(suffix, tmp_path):
    splat = random_splat(9, 0, 3)
    store = ThresholdStore(9)
    path = tmp_path / f"a{suffix}"
    save(path, replace(splat, thresholds=store))
    without = path.read_bytes()
    save(path, splat)
    assert path.read_bytes() == without
    assert load(path).thresholds is None
    with torch.no_grad():
        store.logits[4] = 0.0
    save(path, replace(splat, thresholds=store))
    values = load(path).thresholds.values.detach()
    assert sorted((values < 1e-9).tolist()) == [False] + [True] * 8
    assert load(path, truncation=False).thresholds is None


@pytest.mark.parametrize("suffix", BOUNDS)
def test_the_same_model_gives_the_same_bytes(suffix, tmp_path):
    one, other = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    for path in (one, other):
        save(path, random_splat(40, 2, 1))
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("suffix", [".splat", ".compressed.ply"])
def test_a_format_without_thresholds_refuses_them(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    said = rf"\[output\] {path}: a .*cannot hold cutoffs.*--no-truncation"
    with pytest.raises(OutputError, match=said):
        save(path, tiny.cut(random_splat(5, 0, 0), 0.4))
    assert list(tmp_path.iterdir()) == []


def test_a_ply_beside_other_formats_keeps_its_sidecar(tmp_path):
    splat, store = random_splat(5, 0, 0), ThresholdStore.from_falloff(torch.full((5,), 0.4))
    save(tmp_path / "a.ply", splat)
    sidecar.save(tmp_path / "a.ply", store)
    for suffix in BOUNDS:
        save(tmp_path / f"a{suffix}", splat)
        assert load(tmp_path / f"a{suffix}").thresholds is None
    assert torch.equal(load(tmp_path / "a.ply").thresholds.logits, store.logits)


@pytest.mark.parametrize(("rim", "truncated"), [("hard", False), ("hard", True), ("soft", True)])
@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".glb"])
def test_a_stop_and_a_soft_rim_come_back(suffix, rim, truncated, tmp_path):
    splat, path = random_splat(50, 1, 0), tmp_path / f"model{suffix}"
    splat = tiny.cut(splat, 0.3) if truncated else splat
    for stop in (0.01, 1e-4, 1.0, *([None] if truncated else ())):
        rules = {"stop": stop, "rim": rim}
        formats.write(formats.named(path), path, splat.with_rules(**rules))
        again = load(path)
        assert again.rules == rules
        assert (again.falloff is not None) == truncated
    plain = load(path, truncation=False)
    assert (plain.stop, plain.rim) == (None, "hard")


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        (b"rim wet!", r"rim: 'wet!'; expected hard or soft"),
        *((rule, "stop|float") for rule in (b"stop 0", b"stop 2", b"stop nan", b"stop much")),
    ],
)
def test_rules_that_cannot_be_are_refused(rule, said, tmp_path):
    splat = tiny.cut(random_splat(5, 1, 0), 0.3).with_rules(rim="soft", stop=0.25)
    write_ply(path := tmp_path / "model.ply", splat)
    known = b"comment fragprune " + (b"rim soft" if b"rim" in rule else b"stop 0.25") + b"\n"
    assert path.read_bytes().count(known) == 1
    path.write_bytes(path.read_bytes().replace(known, b"comment fragprune " + rule + b"\n"))
    with pytest.raises(ModelFileError, match=said):
        load(path)


@pytest.mark.parametrize("signs", [(-1, -1, 1), (1, -1, -1)])
def test_a_turned_scene_looks_the_same_from_a_turned_camera(signs):
    """The SH signs, against an evaluation of the basis at turned directions."""
    splat, camera = tiny.random_model(degree=3), tiny.cameras(9)[2]
    flip = torch.diag(torch.tensor(signs, dtype=torch.float64))
    moved = replace(camera, rotation=camera.rotation @ flip)
    with torch.no_grad():
        one = rasterize(splat, camera.view()).image
        other = rasterize(turned(splat, signs), moved.view()).image
    assert float((one - other).abs().max()) < 1e-4


def test_sog_beside_its_images(tmp_path):
    save(tmp_path / "a.sog", tiny.cut(random_splat(60, 1, 0), torch.linspace(0.01, 0.9, 60)))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "folder")
    one, other = load(tmp_path / "a.sog"), load(tmp_path / "folder" / "meta.json")
    assert max(apart(one, other).values()) == 0
    assert torch.equal(one.thresholds.logits, other.thresholds.logits)
    meta = tmp_path / "folder" / "meta.json"
    meta.write_text(meta.read_text().replace("quats.webp", "../a.sog"))
    with pytest.raises(ModelFileError, match=r"an image at '\.\./a\.sog'"):
        load(meta)


@pytest.fixture
def spz(tmp_path):
    """Reads an SPZ with a record between its head and its table, and flags that say so."""
    path = tmp_path / "a.spz"
    save(path, random_splat(5, 1, 0))
    content = path.read_bytes()

    def reread(flags, record):
        start = struct.pack("<I", 32 + len(record)) + content[20:32] + record + content[32:]
        path.write_bytes(content[:14] + bytes([flags]) + content[15:16] + start)
        return load(path)

    return reread


def test_spz_names_its_axes(spz, tmp_path):
    """The record that says RUB turns y and z; one that exchanges axes is refused."""
    plain = load(tmp_path / "a.spz")

    def axes(system):
        return spz(2, struct.pack("<III", 0xADBE0003, 4, system))

    assert torch.equal(axes(6).xyz, plain.xyz)
    assert torch.equal(axes(4).xyz, plain.xyz * torch.tensor([1.0, -1.0, -1.0]))
    with pytest.raises(ModelFileError, match="coordinate system 12"):
        axes(12)


def test_what_is_not_followed_is_named(spz, tmp_path, caplog):
    load(tmp_path / "a.spz")
    assert not caplog.messages
    spz(3, struct.pack("<II", 0xADBE0002, 12) + bytes(12))
    assert "antialiasing" in caplog.messages[0]
    assert "0xadbe0002" in caplog.messages[1]


def test_more_gaussians_than_a_file_can_hold_are_not_allocated(tmp_path):
    from fragprune_plugins.workbench.models.formats.spz import zstd

    path, count = tmp_path / "a.spz", 100_000_000
    save(path, random_splat(5, 0, 0))
    bomb = zstd.compress(bytes(9 * 1000))
    head = struct.pack("<IIIBBBBI", 0x5053474E, 4, count, 0, 12, 0, 5, 32) + bytes(12)
    table = b"".join(struct.pack("<QQ", len(bomb), count * width) for width in (9, 1, 3, 3, 4))
    path.write_bytes(head + table + 5 * bomb)
    with pytest.raises(ModelFileError, match="100000000 Gaussians in"):
        load(path)


def test_spz_of_a_scene_wider_than_its_usual_bits(tmp_path):
    splat = random_splat(5, 0, 0)
    wide = replace(splat, xyz=splat.xyz * 5000)
    save(tmp_path / "a.spz", wide)
    assert float((load(tmp_path / "a.spz").xyz - wide.xyz).abs().max()) <= 1 / 128
    far = replace(splat, xyz=splat.xyz * 1e7)
    with pytest.raises(OutputError, match="24 bits"):
        save(tmp_path / "b.spz", far)
    assert not (tmp_path / "b.spz").exists()


def test_a_missing_file_names_what_is_read(tmp_path):
    with pytest.raises(ModelFileError, match=r"\.sog"):
        load(tmp_path / "a.spz")


def test_every_suffix_has_a_format_and_others_none():
    for suffix in formats.SUFFIXES:
        assert formats.named(Path(f"a{suffix.upper()}")).suffix == suffix
    with pytest.raises(OutputError):
        formats.named(Path("a.obj"))


def raising(*_):
    raise AttributeError("colours")


@pytest.mark.parametrize("fault", ["read", "write", "claims"])
def test_a_plugins_format_that_fails_is_named(fault, tmp_path, monkeypatch):
    path, known = tmp_path / "a.mine.ply", formats.of_suffix(".spz")
    point = EntryPoint("mine.ply", "a_module", formats.GROUP)
    known = replace(known, claims=lambda path: True)
    broken = replace(known, **{fault: raising})
    monkeypatch.setattr(formats, "offered", lambda group: {"mine.ply": point})
    monkeypatch.setattr(formats, "SUFFIXES", (".ply", ".mine.ply"))
    monkeypatch.setattr(EntryPoint, "load", lambda point: broken)
    formats.of_suffix.cache_clear()
    try:
        path.write_bytes(b"")
        with pytest.raises(PluginError, match=r"mine\.ply: AttributeError: colours.*a_module"):
            save(path, random_splat(5, 1, 0)) if fault == "write" else load(path)
        path.write_bytes(b"of another kind")
        formats.of_suffix.cache_clear()
        broken = known
        with pytest.raises(ModelFileError, match="not readable"):
            load(path)
    finally:
        monkeypatch.undo()
        formats.of_suffix.cache_clear()


@pytest.mark.parametrize("suffix", formats.SUFFIXES)
def test_commands_convert(suffix, tmp_path):
    _, path, model = tiny.scene(tmp_path)
    write_ply(path, tiny.cut(model, torch.linspace(0.1, 0.9, len(model))))
    form = formats.named(tmp_path / f"out{suffix}")
    out, back = tmp_path / f"out{suffix}", tmp_path / "back.ply"
    flag = () if form.thresholds else ("--no-truncation",)
    report = run_json("export", path, "--out", out, *flag)
    assert (report["format"], report["thresholds"]) == (form.name, bool(form.thresholds))
    assert report["keeps"] == (form.keeps or None)
    assert report["column"] == ("trunc_threshold" if suffix == ".ply" else None)
    text = run("export", path, "--out", out, *flag).stdout
    assert form.keeps in text
    run_json("export", out, "--out", back, *flag)
    assert len(read_ply(back)) == len(model)
    assert (read_ply(back).thresholds is None) == (not form.thresholds)


def test_finetune_reads_and_writes_spz(tmp_path):
    data, _, model = tiny.scene(tmp_path)
    start, out = tmp_path / "start.spz", tmp_path / "pruned.spz"
    save(start, model)
    words = ("finetune", start, "--data", data, "--out", out, "--iters", 10)
    report = run_json(*words)
    assert report["out"] == str(out)
    assert load(out).thresholds is not None
    assert not sidecar.path_beside(out).exists()
    assert run_json(*words)["already_finished"]
    assert report["after"]["psnr"] == measure(out, load_dataset(data), repeats=1)["psnr"]
    ply = (*words[:-3], tmp_path / "pruned.ply", *words[-2:])
    assert not run_json(*ply)["already_finished"]  # its record has the same name
    refused = run(*words[:-3], tmp_path / "pruned.splat", *words[-2:])
    assert refused.exit_code == 1
    assert "cannot hold cutoffs" in refused.stderr


def test_values_that_cannot_be_drawn_are_refused(tmp_path):
    save(tmp_path / "a.splat", random_splat(3, 0, 0))
    content = (tmp_path / "a.splat").read_bytes()
    (tmp_path / "a.splat").write_bytes(b"\xff\xff\xff\x7f" + content[4:])  # NaN
    with pytest.raises(ModelFileError, match="NaN") as stated:
        load(tmp_path / "a.splat")
    assert stated.value.where == str(tmp_path / "a.splat")


@pytest.mark.parametrize(
    ("how", "words"),
    [(zipfile.ZIP_BZIP2, "compression 12"), (zipfile.ZIP_DEFLATED, "64000000 bytes")],
)
def test_a_sog_that_unpacks_into_much_more_is_refused(tmp_path, how, words):
    """Python's zipfile unpacks bzip2 at once, whatever size is asked for."""
    save(tmp_path / "good.sog", tiny.random_model(40))
    path = tmp_path / "bomb.sog"
    with zipfile.ZipFile(tmp_path / "good.sog") as good, zipfile.ZipFile(path, "w", how) as bomb:
        for name in good.namelist():
            bomb.writestr(name, bytes(64_000_000) if name == "means_l.webp" else good.read(name))
    assert path.stat().st_size < 100_000
    with pytest.raises(ModelFileError, match=words):
        load(path)


def test_an_spz_that_unpacks_into_much_more_is_refused(tmp_path):
    """190 KB of zeros would be 3,000,000 Gaussians of degree 3."""
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, 300_000, 3, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(300_000 * 65)))
    with pytest.raises(ModelFileError, match="300000 Gaussians in"):
        load(tmp_path / "a.spz")


def test_a_glb_that_counts_from_the_end_is_refused(tmp_path):
    save(tmp_path / "a.glb", tiny.random_model(3))
    content = (tmp_path / "a.glb").read_bytes()
    opacity = b'"KHR_gaussian_splatting:OPACITY":4'
    assert content.count(opacity) == 1
    there = content.replace(opacity, opacity[:-1] + b"-5")  # one byte more, for one blank less
    at = there.index(b"BIN\0") - 4
    (tmp_path / "a.glb").write_bytes(there[: at - 1] + there[at:])
    with pytest.raises(ModelFileError, match="negative numbers"):
        load(tmp_path / "a.glb")
