"""Train a model of a photographed scene."""

import random
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

import torch
from arguments import ModelParams, OptimizationParams, PipelineParams
from gaussian_renderer import render
from scene import GaussianModel, Scene
from tqdm import tqdm
from utils.general_utils import safe_state
from utils.loss_utils import l1_loss, psnr, ssim


def training(
    dataset,
    opt,
    pipe,
    testing_iterations,
    saving_iterations,
    checkpoint_iterations,
    checkpoint,
    debug_from,
):
    """Run the training loop. Iterations count from 1, and the last one takes no step."""
    first_iter = 0
    prepare_output_and_logger(dataset)
    gaussians = GaussianModel(dataset.sh_degree)
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = torch.load(checkpoint)
        gaussians.restore(model_params, opt)
    background = torch.tensor([float(dataset.white_background)] * 3, device="cuda")
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    waiting, smooth = [], 0.0
    bar = tqdm(range(first_iter, opt.iterations), desc="Training")
    for iteration in range(first_iter + 1, opt.iterations + 1):
        start.record()
        gaussians.update_learning_rate(iteration)
        if iteration % 1000 == 0:
            gaussians.oneupSHdegree()
        if not waiting:
            waiting = scene.getTrainCameras().copy()
        camera = waiting.pop(random.randrange(len(waiting)))
        if iteration - 1 == debug_from:
            pipe.debug = True
        bg = torch.rand(3, device="cuda") if opt.random_background else background
        package = render(camera, gaussians, pipe, bg)
        image, truth = package["render"], camera.original_image.cuda()
        loss = (1 - opt.lambda_dssim) * l1_loss(image, truth)
        loss = loss + opt.lambda_dssim * (1 - ssim(image, truth))
        loss.backward()
        end.record()
        with torch.no_grad():
            smooth = 0.4 * loss.item() + 0.6 * smooth
            if iteration % 10 == 0 or iteration == opt.iterations:
                bar.set_postfix(loss=f"{smooth:.4f}", gaussians=gaussians.get_xyz.shape[0])
                bar.update(iteration - first_iter - bar.n)
            training_report(iteration, testing_iterations, scene, render, (pipe, background))
            if iteration in saving_iterations:
                scene.save(iteration)
            if iteration < opt.densify_until_iter:
                densify(iteration, opt, dataset, gaussians, scene, package)
            if iteration < opt.iterations:
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            if iteration in checkpoint_iterations:
                path = Path(scene.model_path) / f"chkpnt{iteration}.pth"
                torch.save((gaussians.capture(), iteration), path)
    bar.close()


def densify(iteration, opt, dataset, gaussians, scene, package):
    """Gather statistics, and at intervals clone, split, prune, or reset opacities."""
    seen, radii = package["visibility_filter"], package["radii"]
    gaussians.max_radii2D[seen] = torch.max(gaussians.max_radii2D[seen], radii[seen])
    gaussians.add_densification_stats(package["viewspace_points"], seen)
    if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
        largest = 20 if iteration > opt.opacity_reset_interval else None
        threshold = opt.densify_grad_threshold
        gaussians.densify_and_prune(threshold, 0.005, scene.cameras_extent, largest)
    at_start = dataset.white_background and iteration == opt.densify_from_iter
    if iteration % opt.opacity_reset_interval == 0 or at_start:
        gaussians.reset_opacity()


def prepare_output_and_logger(args):
    """Make the model's folder and write the options into it."""
    args.model_path = args.model_path or "output"
    Path(args.model_path).mkdir(parents=True, exist_ok=True)
    (Path(args.model_path) / "cfg_args").write_text(str(Namespace(**vars(args))))


def training_report(iteration, testing_iterations, scene, renderFunc, renderArgs):
    """At the testing iterations, print the PSNR of the held-out views."""
    cameras = scene.getTestCameras()
    if iteration not in testing_iterations or not cameras:
        return
    total = 0.0
    for camera in cameras:
        image = renderFunc(camera, scene.gaussians, *renderArgs)["render"].clamp(0, 1)
        total += psnr(image, camera.original_image.cuda()).item()
    tqdm.write(f"[ITER {iteration}] test PSNR {total / len(cameras):.2f} dB", file=sys.stderr)


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__)
    lp, op, pp = ModelParams(parser), OptimizationParams(parser), PipelineParams(parser)
    parser.add_argument("--debug_from", type=int, default=-1)
    parser.add_argument("--detect_anomaly", action="store_true")
    parser.add_argument("--test_iterations", nargs="+", type=int, default=[7_000, 30_000])
    parser.add_argument("--save_iterations", nargs="+", type=int, default=[7_000, 30_000])
    parser.add_argument("--checkpoint_iterations", nargs="+", type=int, default=[])
    parser.add_argument("--start_checkpoint", type=str, default=None)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.save_iterations.append(args.iterations)
    safe_state(args.seed)
    torch.autograd.set_detect_anomaly(args.detect_anomaly)
    training(
        lp.extract(args),
        op.extract(args),
        pp.extract(args),
        args.test_iterations,
        args.save_iterations,
        args.checkpoint_iterations,
        args.start_checkpoint,
        args.debug_from,
    )
