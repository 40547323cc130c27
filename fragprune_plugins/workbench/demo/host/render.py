"""Write a trained model's pictures next to the photographs."""

from argparse import ArgumentParser
from pathlib import Path

import torch
from arguments import ModelParams, PipelineParams, get_combined_args
from gaussian_renderer import render
from PIL import Image
from scene import GaussianModel, Scene
from tqdm import tqdm
from utils.general_utils import safe_state


def render_set(model_path, name, iteration, views, gaussians, pipeline, background):
    """Write a folder of renders and a folder of photographs, with the same numbers."""
    folder = Path(model_path) / name / f"ours_{iteration}"
    for index, view in enumerate(tqdm(views, desc=f"Rendering {name}")):
        image = render(view, gaussians, pipeline, background)["render"]
        write(image, folder / "renders" / f"{index:05d}.png")
        write(view.original_image, folder / "gt" / f"{index:05d}.png")


def render_sets(dataset, iteration, pipeline, skip_train, skip_test):
    """Render the training views and the test views."""
    with torch.no_grad():
        gaussians = GaussianModel(dataset.sh_degree)
        scene = Scene(dataset, gaussians, load_iteration=iteration, shuffle=False)
        background = torch.tensor([float(dataset.white_background)] * 3, device="cuda")
        sets = {"train": scene.getTrainCameras(), "test": scene.getTestCameras()}
        for name, skipped in (("train", skip_train), ("test", skip_test)):
            if not skipped:
                place = dataset.model_path, name, scene.loaded_iter
                render_set(*place, sets[name], gaussians, pipeline, background)


def write(image, path):
    """Save an image (3, H, W) with values in [0, 1]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = (image.clamp(0, 1) * 255 + 0.5).byte().permute(1, 2, 0)
    Image.fromarray(pixels.cpu().numpy()).save(path)


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__)
    model, pipeline = ModelParams(parser, sentinel=True), PipelineParams(parser)
    parser.add_argument("--iteration", type=int, default=-1)
    parser.add_argument("--skip_train", action="store_true")
    parser.add_argument("--skip_test", action="store_true")
    args = get_combined_args(parser)
    safe_state(0)
    render_sets(
        model.extract(args), args.iteration, pipeline.extract(args), args.skip_train, args.skip_test
    )
