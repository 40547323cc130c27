"""The demo deletes what its marker says is its own, and nothing else."""

import json

import pytest
from cli.commands import run

from fragprune_plugins.errors import OutputError
from fragprune_plugins.workbench.demo import folder, work


def contents(path):
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def write(path, text="x"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.fixture
def made(tmp_path):
    """A folder as a demo leaves it."""
    out = tmp_path / "out"
    folder.clear(out)
    with folder.claiming(out, "model", "report.json"):
        write(out / "model" / "point_cloud" / "point_cloud.ply")
        write(out / "report.json")
    return out


def test_a_folder_with_our_names_is_not_ours(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "make_scene", None)  # never called
    keep = tmp_path / "keep"
    (keep / "scene").mkdir(parents=True)
    write(keep / "model" / "precious.txt")
    before = contents(keep)
    result = run("demo", "--out", keep)
    assert result.exit_code == 1
    assert result.stderr.startswith("[output] ")
    assert "model/precious.txt" in result.stderr
    assert contents(keep) == before


def interrupted(out):
    with folder.claiming(out, "pictures"):
        write(out / "pictures" / "half.png")
        raise KeyboardInterrupt


def test_an_earlier_demo_is_emptied_though_it_failed(made):
    with pytest.raises(KeyboardInterrupt):
        interrupted(made)
    folder.clear(made)
    assert [p.name for p in made.iterdir()] == [folder.MARKER]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        *((name, "x", name) for name in ("thesis.tex", "model/notes.txt", "model/point_cloud/a")),
        ("model/point_cloud/point_cloud.ply", "trained on", r"point_cloud\.ply', changed since"),
        *(
            (folder.MARKER, text, "no demo wrote")
            for text in ("", "[]", '{"files": 3}', '{"files": {"../a.txt": "x"}}')
        ),
    ],
)
def test_what_is_not_as_the_demo_left_it_keeps_all(made, name, text, says):
    write(made.parent / "a.txt")
    write(made / name, text)
    before = contents(made.parent)
    with pytest.raises(OutputError, match=says):
        folder.clear(made)
    assert contents(made.parent) == before


def test_what_is_written_outside_the_claim_is_not_ours(made):
    with folder.claiming(made, "pictures"):
        write(made / "model" / "mine.txt")
        write(made / "pictures" / "a.png")
    with pytest.raises(OutputError, match=r"model/mine\.txt"):
        folder.clear(made)


def test_hidden_files_neither_count_nor_go(made):
    write(made / "model" / ".DS_Store")
    folder.clear(made)
    assert sorted(contents(made)) == [folder.MARKER, "model/.DS_Store"]


def test_a_link_is_not_followed(made, tmp_path):
    write(tmp_path / "elsewhere" / "a.txt")
    (made / "scene").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="scene"):
        folder.clear(made)
    assert (tmp_path / "elsewhere" / "a.txt").exists()


def test_the_marker_lists_files_by_digest(made):
    listed = json.loads((made / folder.MARKER).read_text())["files"]
    assert sorted(listed) == ["model/point_cloud/point_cloud.ply", "report.json"]
    assert all(len(sha) == 64 for sha in listed.values())
