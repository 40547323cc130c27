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
ours = [name for name in sys.modules if name.startswith("fragprune_plugins.workbench")]
print(json.dumps([ours, sorted(sys.modules), summary.steps]))
"""


def test_a_host_run_loads_no_module_of_the_workbench(tmp_path, photographs, python):
    ours, loaded, steps = python(PROGRAM, HOST, photographs, tmp_path / "out")
    assert steps == 4
    assert ours == []
    assert not [name for name in OTHERS if name in loaded]


def test_the_command_run_loads_of_the_workbench_what_measures_and_tries(python):
    """Of the slices its own, and finetune: tried before stage 2, or what follows a host alone."""
    ours = python(
        "import json, sys\n"
        "import fragprune_plugins.workbench.run.work\n"
        "start = 'fragprune_plugins.workbench.'\n"
        "names = {m[len(start):].split('.')[0] for m in sys.modules if m.startswith(start)}\n"
        "print(json.dumps(sorted(names)))"
    )
    measures = {"run", "commands", "figures", "goals", "models", "scenes", "ranks"}
    assert set(ours) <= measures | {"finetune", "pruning", "distributed", "saved"}
