"""fragprune profile."""

from cli.commands import run, run_json
from finetune import tiny

from fragprune_plugins.files.ply import write_ply


def test_with_and_without_thresholds(tmp_path):
    data, path, model = tiny.scene(tmp_path)
    plain = run_json("profile", path, "--data", data)
    assert plain["truncated"] is False
    assert list(plain["columns"]) == ["untruncated"]
    write_ply(path, tiny.cut(model, 0.3))
    report = run_json("profile", path, "--data", data, "--out", tmp_path / "pictures")
    assert list(report["columns"]) == ["untruncated", "truncated"]
    assert report["fragments_per_pixel"] == report["columns"]["truncated"]["fragments_per_pixel"]
    assert report["fragments_per_pixel"] < plain["fragments_per_pixel"]
    assert len(report["threshold_quantiles"]) == 5
    assert len(list((tmp_path / "pictures").glob("*.png"))) == len(report["files"]) == 2


def test_table(tmp_path):
    data, path, _ = tiny.scene(tmp_path)
    result = run("profile", path, "--data", data, "--views", "train")
    assert result.exit_code == 0
    assert "7 views" in result.stdout
    assert "fragments per pixel" in result.stdout
