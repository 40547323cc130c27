"""What the upper end of the default pressure changes where the loss is large.

python large_losses.py scene DATA OUT [--noise 0.1] [--exposure 0.25] [--every 3] [--moments 24]
python large_losses.py compare MODEL.ply DATA [--seed 0] [--white-background] [--pressure 1e-4]

The first copies a Blender scene and changes its training pictures; held-out ones stay. The second
trains the control, without and with the upper end, and each fixed pressure, 1,000 iterations each.
Frames are the least of nine, in turns, of this thread's own time, which load disturbs less.
"""

from __future__ import annotations

import json
import shutil
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from full_size import frames
from PIL import Image

from fragprune_plugins.engines import create_engine
from fragprune_plugins.learning.goals import Control, Pressure
from fragprune_plugins.learning.pressure import ElasticPressure, PressureRule
from fragprune_plugins.learning.schedule import Schedule, Settings
from fragprune_plugins.workbench.figures.evaluate import Candidate, enlarged, measure_all
from fragprune_plugins.workbench.finetune.api import finetune
from fragprune_plugins.workbench.models import model as models
from fragprune_plugins.workbench.scenes.dataset import Dataset, load_dataset


def scene(args: Namespace) -> None:
    """Write a copy of a Blender scene whose training pictures are changed, seeded."""
    stream = np.random.default_rng(args.seed)
    args.out.mkdir()
    shutil.copy(args.data / "points3d.ply", args.out)
    for split in ("train", "test"):
        written = json.loads((args.data / f"transforms_{split}.json").read_text())
        frames = [f for f in written["frames"] if round(23 * f.get("time", 0)) % args.moments == 0]
        train = split == "train"
        written["frames"] = frames = frames[:: args.every] if train else frames
        gains = np.exp(stream.normal(0, args.exposure, len(frames)) if args.exposure else [0.0])
        gains = np.resize(gains / np.exp(np.log(gains).mean()), len(frames))
        for frame, gain in zip(frames, gains, strict=True):
            name = frame["file_path"].removeprefix("./") + ".png"
            pixels = np.asarray(Image.open(args.data / name)).astype(float)
            if train:
                pixels[..., :3] *= gain
                if args.noise:
                    pixels[..., :3] += stream.normal(0, 255 * args.noise, pixels[..., :3].shape)
            (args.out / name).parent.mkdir(exist_ok=True)
            Image.fromarray(pixels.clip(0, 255).round().astype(np.uint8)).save(args.out / name)
        for each in (split,) if train else ("test", "val"):
            (args.out / f"transforms_{each}.json").write_text(json.dumps(written))


class Unbounded(Schedule):
    """The default schedule under the default pressure without its upper end."""

    def make_pressure(self) -> PressureRule:
        """The pressure of a run."""
        default = self.settings.make_pressure()
        assert isinstance(default, ElasticPressure)
        return replace(default, most=1.0)


def compare(args: Namespace) -> None:
    """Train the arms, and print them as a table in Markdown."""
    torch.set_num_threads(1)
    splat = models.load(args.model, truncation=False)
    dataset: Dataset = load_dataset(args.data, white_background=args.white_background)
    usual = Settings(iterations=1000, seed=args.seed)
    arms: dict[str, tuple[Settings, Schedule | None]] = {
        "control": (replace(usual, goal=Control()), None),
        "no upper end": (usual, Unbounded(usual)),
        "default": (usual, None),
    }
    arms |= {f"λ {p:g}": (replace(usual, goal=Pressure(p)), None) for p in args.pressure}
    drawn = {"as it came | - | -": splat}
    for label, (settings, schedule) in arms.items():
        result = finetune(splat, dataset, settings, schedule=schedule, progress=True)
        last = result.curves[-len(dataset.train) :]
        loss = sum(step.loss for step in last) / len(last)
        drawn[f"{label} | {loss:.4f} | {result.curves[-1].pressure:.1e}"] = result.model
    rows = measure_all([*map(Candidate, drawn.values())], dataset.test, engine="cpu", repeats=1)
    engine, taken = create_engine("cpu"), []
    for larger in (1, 4):
        views = [enlarged(shot.view, larger) for shot in dataset.test[:4]]
        with torch.no_grad():
            seconds = frames(engine, drawn, views, rounds=9).values()
        taken.append([1e3 * each / len(views) for each in seconds])
    print("| arm | loss | λ | fragments | PSNR, dB | SSIM | frame, ms | frame at 4x, ms |")
    print("|---|---|---|---|---|---|---|---|")
    for label, row, small, large in zip(drawn, rows, *taken, strict=True):
        print(
            f"| {label} | {row['fragments_per_pixel']:.1f} | {row['psnr']:.2f} | "
            f"{row['ssim']:.4f} | {small:.2f} | {large:.2f} |"
        )


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    change = commands.add_parser("scene", help="copy a scene and change its training pictures")
    change.add_argument("data", type=Path, help="with transforms_train.json")
    change.add_argument("out", type=Path)
    change.add_argument("--noise", type=float, default=0.0, help="standard deviation; white is 1")
    change.add_argument("--exposure", type=float, default=0.0, help="of ln(gain) between pictures")
    change.add_argument("--every", type=int, default=1, help="keep one training picture in so many")
    change.add_argument("--moments", type=int, default=1, help="keep one moment of 24 in so many")
    change.add_argument("--seed", type=int, default=0)
    change.set_defaults(run=scene)
    arms = commands.add_parser("compare", help="train and measure the arms")
    arms.add_argument("model", type=Path)
    arms.add_argument("data", type=Path)
    arms.add_argument("--seed", type=int, default=0)
    arms.add_argument("--white-background", action="store_true")
    arms.add_argument("--pressure", type=float, nargs="*", default=[])
    arms.set_defaults(run=compare)
    args = parser.parse_args()
    args.run(args)
