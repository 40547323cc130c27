"""What a host's script imports is found in its source, and only what it cannot do without."""

import pytest
from miniatures.vanilla_3dgs import HOST

from fragprune_plugins.hosts.preflight import Missing, install, missing_imports
from fragprune_plugins.hosts.source import HostRepo
from fragprune_plugins.plugins.loading import load_plugins

ADAPTERS = load_plugins().adapters


def missing(tmp_path, files, provided=(), script="train.py", package=""):
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    found = missing_imports(HostRepo(tmp_path, package), [tmp_path / script], provided)
    return [(each.module, each.at) for each in found]


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ("import absent_a", 1),
        ("import absent_a.core as a", 1),
        ("from absent_a.core import thing", 1),
        ("with open('x') as f:\n    import absent_a", 2),
        ("if __name__ == '__main__':\n    import absent_a", 2),
        ("try:\n    import absent_a\nexcept ImportError:\n    absent_a = None", None),
        ("def late():\n    import absent_a", None),
        ("if False:\n    import absent_a", None),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import absent_a", None),
        ("import json, torch, os.path", None),
        ("not python (", None),
    ],
)
def test_an_import_counts_that_the_script_cannot_do_without(tmp_path, code, line):
    expected = [] if line is None else [("absent_a", f"train.py:{line}")]
    assert missing(tmp_path, {"train.py": code}) == expected


def test_the_hosts_own_modules_are_followed_once_however_they_are_named(tmp_path):
    files = {
        "train.py": "from scene import Scene\nfrom utils.camera_utils import load\nimport other",
        "scene/__init__.py": "from scene.model import Model\nfrom .cameras import Camera",
        "scene/model.py": "import absent_model\nfrom scene import Scene",
        "scene/cameras.py": "from . import lenses",
        "scene/lenses.py": "import absent_lens",
        "utils/camera_utils.py": "import absent_utils",  # a folder without __init__.py
        "other.py": "if __name__ == '__main__':\n    import absent_other",
    }
    assert sorted(missing(tmp_path, files)) == [
        ("absent_lens", "scene/lenses.py:1"),
        ("absent_model", "scene/model.py:1"),
        ("absent_utils", "utils/camera_utils.py:1"),
    ]


def test_what_we_answer_counts_as_there_and_is_not_looked_into(tmp_path):
    files = {
        "train.py": "import compiled_x, renderer.compiled\nfrom renderer.compiled import draw",
        "renderer/__init__.py": "",
        "renderer/compiled.py": "import absent_compiler",
    }
    assert missing(tmp_path, files, ("compiled_x", "renderer.compiled")) == []


def test_what_the_checkout_holds_somewhere_is_the_hosts_to_find(tmp_path):
    """Hosts put folders of theirs on the path."""
    files = {
        "train.py": "import sys\nsys.path.append('extern/lib')\n"
        "import extern, vendored_a, vendored_b",
        "extern/lib/vendored_a.py": "",
        "extern/lib/vendored_b/__init__.py": "",
    }
    assert missing(tmp_path, files) == []


def test_scripts_in_a_folder_of_the_checkout_find_its_modules(tmp_path):
    files = {"ms/train.py": "import shared", "shared.py": "import absent_shared"}
    found = missing(tmp_path, files, script="ms/train.py")
    assert found == [("absent_shared", "shared.py:1")]


def test_an_installed_host_is_followed_and_its_neighbours_are_not(tmp_path):
    files = {f"{name}/__init__.py": f"import absent_{name}" for name in ("toyhost", "neighbour")}
    files["toyhost/train.py"] = "import neighbour\nfrom toyhost import model"
    found = missing(tmp_path, files, script="toyhost/train.py", package="toyhost")
    assert {module for module, _ in found} == {"neighbour", "absent_toyhost"}


def test_pip_is_told_its_own_names_and_not_those_that_it_may_have_for_something_else():
    named = [Missing(name, "a.py:1") for name in ("cv2", "clip", "PIL", "icecream", "tf")]
    assert install(named).splitlines() == [
        "Run: pip install opencv-python-headless pillow icecream",
        "Install as the host's own instructions say: clip, tf",
    ]
    assert install(named[1:2]) == "Install as the host's own instructions say: clip"


@pytest.mark.parametrize("adapter", ADAPTERS, ids=lambda adapter: adapter.name)
def test_the_names_that_an_adapter_says_it_answers_are_those_it_makes(adapter):
    dialect = adapter.dialect(HostRepo(HOST))
    assert dialect.names() == set(dialect.modules(lambda call: None))


def test_a_script_beside_the_package_it_uses_has_modules_of_its_own(tmp_path):
    """As in a checkout that is installed in place: its examples are no part of the package."""
    files = {"library/__init__.py": "", "examples/helper.py": ""}
    files["examples/train.py"] = "import helper, library, not_here_at_all"
    ((module, _),) = missing(tmp_path, files, script="examples/train.py", package="library")
    assert module == "not_here_at_all"
