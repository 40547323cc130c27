"""Whoever installed the package sees its types."""

import re
import subprocess
import sys
from pathlib import Path

import PIL
import pytest

ROOT = Path(__file__).parents[2]

SCRIPT = """
import fragprune_plugins as fp

model = fp.load("model.ply")
view = fp.View.look_at((0, 0, -3), (0, 0, 0))
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


def checked(python: Path, folder: Path, script: str, *options: str) -> list[str]:
    """What mypy says about a script, line by line."""
    pytest.importorskip("mypy")
    (folder / "script.py").write_text(script)
    words = ["--python-executable", python, "--cache-dir", folder / "cache", *options]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words, "script.py"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert not done.stderr, done.stderr
    return done.stdout.splitlines()


def test_a_script_of_a_user_is_checked_against_them(installed, tmp_path):
    said = checked(installed, tmp_path, SCRIPT, "--strict")
    revealed = [line.split('Revealed type is "')[1] for line in said if "Revealed" in line]
    assert "fragprune_plugins.files.model.Model" in revealed[0], said
    assert revealed[1] == 'PIL.Image.Image"'
    assert revealed[2].startswith("def (alpha: float, opacities: ")
    assert revealed[3].startswith("dict[str, ")
    (error,) = (line for line in said if " error: " in line)
    assert error.startswith("script.py:13: ")
    assert 'No overload variant of "rasterize" matches argument type "Model"' in error


def test_the_lines_of_readme_and_the_how_to_are_right(installed, tmp_path):
    pages = [(ROOT / name).read_text() for name in ("README.md", "docs/how-to/python.md")]
    fenced = re.findall(r"```python\n(.*?)```", pages[0], re.DOTALL)
    indented = [line[4:] for line in pages[1].splitlines() if line.startswith("    ")]
    assert fenced
    assert len(indented) > 20
    script = "\n".join(["import torch", *fenced, *indented])
    options = ("--ignore-missing-imports", "--disable-error-code", "no-redef")
    said = checked(installed, tmp_path, script, *options)
    assert said[-1].startswith("Success"), said
