"""Whoever installed the package sees its types."""

from __future__ import annotations

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
fp.render_view("model.ply")
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


def test_a_script_of_a_user_is_checked_against_them(installed, tmp_path):
    pytest.importorskip("mypy")
    (tmp_path / "script.py").write_text(SCRIPT)
    words = ["--strict", "--python-executable", installed, "--cache-dir", tmp_path / "cache"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words, "script.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    said = done.stdout.splitlines()
    revealed = [line.split('Revealed type is "')[1] for line in said if "Revealed" in line]
    assert "fragprune_plugins.workbench.models.model.Model" in revealed[0], (
        done.stdout + done.stderr
    )
    assert revealed[1] == 'PIL.Image.Image"'
    assert revealed[2].startswith("def (alpha: float, opacities: ")
    (error,) = (line for line in said if " error: " in line)
    assert error.startswith("script.py:9: ")
    assert '"render_view" has incompatible type "str"' in error
