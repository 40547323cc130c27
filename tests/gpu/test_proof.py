"""``fragprune doctor --prove`` holds the kernels, emulated: what is changed in their text shows."""

from pathlib import Path

import pytest

from fragprune_plugins.engines.cpu.engine import CpuEngine
from fragprune_plugins.engines.cuda import kernels
from fragprune_plugins.workbench.commands.command import Report
from fragprune_plugins.workbench.doctor import prove
from fragprune_plugins.workbench.doctor.emulated import EmulatedDevice


class Changed(EmulatedDevice):
    """Takes one of its sources from another folder."""

    def __init__(self, device: EmulatedDevice, source: Path) -> None:
        super().__init__(device.compiler, device.folder, (f"-I{kernels.SOURCES}",))
        self._changed = source

    def source(self, name: str) -> Path:
        return self._changed if self._changed.stem == name else super().source(name)


def proof(device: EmulatedDevice, monkeypatch: pytest.MonkeyPatch) -> Report:
    """Of one engine, and of the kernels on a device."""
    monkeypatch.setattr(prove, "EmulatedDevice", lambda compiler, folder: device)
    monkeypatch.setattr(prove, "SCENES", {"cpu": ((300, (48, 32)),)})
    monkeypatch.setattr(prove, "_ours", lambda kind: {"right": CpuEngine()})
    return prove.prove(repeats=2)


def test_kernels_that_agree_are_proved_and_not_timed(device, monkeypatch):
    report = proof(device, monkeypatch)
    emulation = report.data["emulation"]
    assert report.exit_code == 0, report.text
    assert "cuda kernels, emulated: agree with the oracle" in report.text
    assert (emulation["not_proved"], emulation["differences"]) == (None, [])
    for row in emulation["scenes"]:
        counted = row["fragments_per_pixel"]
        assert counted == pytest.approx(row["fragments_per_pixel_of_oracle"], rel=1e-3)
        assert not [name for name in row if "ms" in name]
    assert {row["engine"] for row in report.data["times"]} == {"right"}


@pytest.mark.parametrize(
    ("source", "text", "changed", "said"),
    [
        ("blend", "min(exp2(exponent), f", "min(1.001f * exp2(exponent), f", "cutoffs, picture: "),
        ("blend", "exponent >= b.cut", "exponent >= b.cut + 0.02f", "cutoffs, fragments: "),
        ("unblend", "* rim_density", "* 1.01f * rim_density", "cutoffs, gradient of thresholds: "),
        ("blend", "  __syncthreads();", "  __syncthreads()", "error: expected"),
    ],
    ids=["alpha", "cut", "rim", "no C++"],
)
def test_a_change_in_a_kernels_text_makes_the_proof_fail(
    device, tmp_path, monkeypatch, source, text, changed, said
):
    whole = (kernels.SOURCES / f"{source}.cu").read_text()
    assert text in whole
    copy = tmp_path / f"{source}.cu"
    copy.write_text(whole.replace(text, changed))
    report = proof(Changed(device, copy), monkeypatch)
    assert report.exit_code == 1
    assert said in "; ".join(report.data["emulation"]["differences"])
    assert said in report.text
