"""What the compiler makes of a step of the inner loops: how many instructions, and of what kind.

A step is one Gaussian on the pixels of one warp. Read off the machine code by nvdisasm (the wheel
nvidia-cuda-nvdisasm); nothing runs, and nothing is timed.
"""

import re
import shutil
import subprocess
import sysconfig
from collections import Counter
from pathlib import Path

import pytest
from gpu.test_compile import ARCHITECTURES, TRAINED

from fragprune_plugins.engines.cuda.frame import MACROS

STEPS = {
    "fp_blend": (37, {"special": 1, "shared": 3}),
    "fp_unblend": (77, {"special": 4, "shared": 8}),
}
"""Instructions at most, by NVRTC 13.5 on the eight architectures; of these, exactly."""

SLACK = 1.1
"""For other versions of NVRTC."""

SOURCES = {"blend": {}, "unblend": TRAINED}

KINDS = {"MUFU": "special", "LDS": "shared", "STS": "shared", "LDL": "local", "STL": "local"}

Code = list[str]


@pytest.fixture(scope="module")
def nvdisasm() -> str:
    wheels = sorted(Path(sysconfig.get_path("purelib"), "nvidia").glob("*/bin/nvdisasm"))
    return (
        shutil.which("nvdisasm")
        or next(map(str, wheels), None)
        or pytest.skip("pip install nvidia-cuda-nvdisasm")
    )


def kernels_of(nvdisasm: str, cubin: Path) -> dict[str, Code]:
    """Labels, with a colon at their ends, and instructions of every kernel, in order."""
    words = [nvdisasm, "-c", str(cubin)]
    listing = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found: dict[str, Code] = {}
    for part in re.split(r"^\s*\.section\s+\.text\.", listing, flags=re.MULTILINE)[1:]:
        name, _, text = part.partition(",")
        lines = re.findall(r"^(\.L\w+:)|^\s*/\*\w+\*/\s+(.*?)\s*;", text, re.MULTILINE)
        found[name] = [label or re.sub(r"^@\S+\s+", "", op) for label, op in lines]
    return found


def step_of(code: Code) -> Code:
    """The shortest loop that takes an exponential: instructions between a label and its branch."""
    at, instructions, loops = {}, [], []
    for line in code:
        if line.endswith(":"):
            at[line[:-1]] = len(instructions)
            continue
        instructions.append(line)
        target = re.match(r"BRA.*`\((\S+)\)", line)
        if target and target[1] in at:
            loops.append(instructions[at[target[1]] :])
    return min((each for each in loops if "MUFU.EX2" in " ".join(each)), key=len)


def kind(instruction: str) -> str:
    name = re.search(r"[A-Z]\w*", instruction)  # a brace may precede it
    return KINDS.get(name[0] if name else "", "other")


def test_a_loop_is_what_lies_between_a_label_and_a_branch_back():
    code = [".L1:", "MOV R1, R2", ".L2:", "MUFU.EX2 R1, R1", "BRA `(.L2)", "BRA `(.L1)", "EXIT"]
    assert step_of(code) == ["MUFU.EX2 R1, R1", "BRA `(.L2)"]


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("source", SOURCES)
def test_a_step_takes_no_more_instructions_now(nvrtc, nvdisasm, tmp_path, source, architecture):
    image = nvrtc.compile(source, {**MACROS, **SOURCES[source]}, f"sm_{architecture}")
    (tmp_path / "kernels.cubin").write_bytes(image.code)
    found = kernels_of(nvdisasm, tmp_path / "kernels.cubin")
    most, exactly = STEPS[f"fp_{source}"]
    step = step_of(found[f"fp_{source}"])
    mix = Counter(map(kind, step))
    assert len(step) <= SLACK * most, mix
    assert {name: mix[name] for name in exactly} == exactly
    assert not any(kind(each) == "local" for code in found.values() for each in code)
