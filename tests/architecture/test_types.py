"""Whoever installed the package sees its types."""

import subprocess
import sys
from pathlib import Path

import PIL
import pytest

ROOT = Path(__file__).parents[2]

SCRIPT = """
import fragprune_plugins as fp

model = fp.load("model.ply")
view = fp.look_at((0, 0, -3), (0, 0, 0))
reveal_type(model)
reveal_type(fp.render_view(model, view))
reveal_type(fp.ThresholdStore.from_alpha)
reveal_type(fp.measure("model.ply", fp.load_dataset("scene")))
fp.render_view("model.ply")
fp.render_view(fp.finetune(model, fp.load_dataset("scene")))
fp.rasterize(model, view)
fp.rasterize(model)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """An environment with what a wheel holds of Python, and with Pillow; its interpreter."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    python = folder / "venv" / "bin" / "python"
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = subprocess.check_output([python, "-c", where], text=True).strip()
    build = ["egg_info", "--egg-base", folder, "build_py", "--build-lib", packages]
    done = subprocess.run(
        [sys.executable, "setup.py", *build], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (Path(packages) / "PIL").symlink_to(Path(PIL.__file__).parent)
    return python


@pytest.fixture(scope="module")
def said(installed, tmp_path_factory) -> list[str]:
    """What mypy says about a user's script, and about the lines that our pages show."""
    pytest.importorskip("mypy")
    folder = tmp_path_factory.mktemp("scripts")
    page = (ROOT / "docs/how-to/python.md").read_text()
    indented = [line[4:] for line in page.splitlines() if line.startswith("    ")]
    assert len(indented) > 20
    (folder / "shown.py").write_text("\n".join(["import torch", *indented]))
    (folder / "script.py").write_text(SCRIPT)
    words = ["--python-executable", installed, "--cache-dir", folder / "cache", "--strict"]
    words += ["--ignore-missing-imports", "--allow-untyped-defs"]
    words += ["--disable-error-code", "no-redef"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words, "script.py", "shown.py"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert not done.stderr, done.stderr
    return done.stdout.splitlines()


def test_a_script_of_a_user_is_checked_against_them(said):
    revealed = [line.split('Revealed type is "')[1] for line in said if "Revealed" in line]
    assert "fragprune_plugins.files.model.Model" in revealed[0], said
    assert revealed[1] == 'PIL.Image.Image"'
    assert revealed[2].startswith("def (alpha: float, opacities: ")
    assert revealed[3].startswith("dict[str, ")
    (error,) = (line for line in said if line.startswith("script.py") and " error: " in line)
    assert error.startswith("script.py:13: ")
    assert 'No overload variant of "rasterize" matches argument type "Model"' in error


def test_the_lines_of_readme_and_the_how_to_are_right(said):
    assert not [line for line in said if line.startswith("shown.py") and " error: " in line]
    assert said[-1] == "Found 1 error in 1 file (checked 2 source files)"
