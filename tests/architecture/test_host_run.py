"""What a host's training loads of ours and of others, in a fresh process."""

from pathlib import Path

HOST = Path(__file__).parents[2] / "fragprune_plugins" / "workbench" / "demo" / "host"
# scipy is there on the CPU: it stands in for the host's compiled nearest neighbours
OTHERS = ("matplotlib", "skimage", "backports.zstd", "tomli", "cv2", "jinja2")

PROGRAM = """
import json, sys
from fragprune_plugins.injection.launch import RunOptions, run
from fragprune_plugins.learning.schedule import Settings
host, scene, out = sys.argv[1:]
sys.path.insert(0, host)
words = ["--iterations", "4", "--save_iterations", "4", "--test_iterations", "-1"]
command = [host + "/train.py", "-s", scene, "-m", out, *words]
summary = run(command, RunOptions(device="cpu", settings=Settings(iterations=4)))
first = list(sys.modules)
import fragprune_plugins.workbench.run.work
print(json.dumps([first, list(sys.modules), summary.steps]))
"""


START = "fragprune_plugins.workbench."


def test_a_host_run_loads_no_module_of_the_workbench(tmp_path, photographs, python):
    """And the command of it what measures and tries, and finetune: it may follow a host alone."""
    trained, commanded, steps = python(PROGRAM, HOST, photographs, tmp_path / "out")
    assert steps == 4
    assert not [name for name in trained if name.startswith(START[:-1])]
    assert not [name for name in OTHERS if name in trained]
    ours = {name.split(".")[2] for name in commanded if name.startswith(START)}
    measures = {"run", "commands", "figures", "goals", "models", "scenes", "ranks"}
    assert ours <= measures | {"finetune", "pruning", "distributed", "saved"}
