"""Whether a training makes the drawn picture itself like its photographs."""

import pytest

from fragprune_graphdeco.photographs import NOT_FOUND, unlike
from fragprune_plugins.hosts.source import HostRepo

SCRIPT = """
def training(dataset, opt):
    for iteration in range(opt.iterations):
        {drawn}
        gt_image = viewpoint_cam.original_image.cuda()
        {between}
        loss = {loss}
        loss.backward()


def training_report(renders):
    for image, medium in renders:
        ssim(water(image["render"]), camera.original_image)
"""
DRAWN = 'image = render(viewpoint_cam, gaussians)["render"]'
LOSS = "0.8 * l1_loss(image, gt_image) + 0.2 * (1.0 - ssim(image, gt_image))"


def why(root, drawn=DRAWN, between="pass", loss=LOSS):
    text = SCRIPT.format(drawn=drawn, between=between.replace("\n", "\n        "), loss=loss)
    (root / "train.py").write_text(text)
    return unlike(HostRepo(root), ["train"])


@pytest.mark.parametrize(
    "written",
    [
        {},
        {"drawn": 'image, seen = package["render"], package["radii"]'},
        {"loss": "torch.abs(image - gt_image).mean()"},
        {"loss": "config.lambda_l1 * l1_loss(image, gt_image)"},
        {"loss": "F.mse_loss(torch.clamp(image, 0, 1).unsqueeze(0), gt_image.unsqueeze(0))"},
        {"loss": f"{LOSS} + l1_loss(depth, viewpoint_cam.invdepthmap)"},
        {"loss": f"{LOSS} + l1_loss(package['app_image'], gt_image)"},
        {"between": "image *= viewpoint_cam.alpha_mask.cuda()"},
        {"between": "image = image[..., image.shape[-1] // 2:]"},
        {"between": "gt_image = gt_image * gt_alpha_mask + (1 - gt_alpha_mask) * background"},
        {"between": "gt_image, grey = viewpoint_cam.get_image()"},
    ],
    ids=str,
)
def test_the_drawn_picture_is_compared_with_the_photograph(tmp_path, written):
    assert why(tmp_path, **written) == ""


@pytest.mark.parametrize(
    ("written", "compared"),
    [
        ({"between": "image = water(image, depth) + image"}, "image with gt_image"),
        ({"between": "behind, image = gaussians.adjusted(image)"}, "image with gt_image"),
        ({"between": "image = image * torch.exp(gain)"}, "image with gt_image"),
        ({"loss": "ssim(image * exposure, gt_image)"}, "image * exposure with gt_image"),
        ({"loss": "l1_loss(image * mask, gt_image * mask)"}, "image * mask with gt_image * mask"),
        ({"between": "gt_image = styled.pop(0)"}, "image with gt_image"),
        ({"between": "gt_image = gt_image ** 2.2"}, "image with gt_image"),
        ({"between": "image[:, seen] = 0"}, "image with gt_image"),
        ({"between": "image.mul_(exposure(camera))"}, "image with gt_image"),
        ({"loss": "l1_loss(blurred(image), gt_image)"}, "blurred(image) with gt_image"),
    ],
    ids=str,
)
def test_another_picture_is_compared(tmp_path, written, compared):
    assert why(tmp_path, **written).startswith(f"its training compares {compared} (train.py:")


@pytest.mark.parametrize("mask", ["static_mask", "(1.0 - mask)"])
def test_a_mask_beside_the_comparison_leaves_parts_of_photographs_out(tmp_path, mask):
    found = why(tmp_path, loss=f"({mask} * torch.abs(image - gt_image)).mean()")
    weight = mask.strip("()")
    assert found.startswith(f"its training weighs what it compares, {weight} (train.py:")


@pytest.mark.parametrize(("default", "compared"), [("False", ""), ("True", "image with gt_image")])
def test_what_an_option_switches_on_does_not_count_while_it_is_off(tmp_path, default, compared):
    (tmp_path / "arguments").mkdir()
    options = f"class Options:\n    def __init__(self):\n        self.water = {default}\n"
    (tmp_path / "arguments/__init__.py").write_text(options)
    found = why(tmp_path, between="if opt.water:\n    image = water(image) + image")
    assert bool(found) == bool(compared)
    assert compared in found


def test_each_script_that_learns_is_to_compare_them(tmp_path):
    assert why(tmp_path) == ""
    (tmp_path / "train_viewer.py").write_text("def training(): show()\n")
    assert unlike(HostRepo(tmp_path), ["train", "train_viewer"]) == ""
    (tmp_path / "train_style.py").write_text("def training(): styled(image).backward()\n")
    assert unlike(HostRepo(tmp_path), ["train", "train_style"]) == NOT_FOUND


@pytest.mark.parametrize("loss", ["score_distillation(image)", "l1_loss(depth, seen_depth)"])
def test_no_comparison_is_found(tmp_path, loss):
    assert why(tmp_path, loss=loss) == NOT_FOUND


@pytest.mark.parametrize("change", ["FoVx *= 1.1", "original_image = image.clamp(0, 1) ** 2.2"])
def test_a_camera_may_change_what_it_sees(tmp_path, change):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/cameras.py").write_text(
        f"class Camera:\n    def __init__(self):\n        self.{change}\n"
    )
    assert why(tmp_path).startswith("its cameras change what they see")


@pytest.mark.parametrize(
    "group",
    [
        *(
            f"'params': [self.P], 'name': {n}"
            for n in ("'pose'", "'cam_' + str(u)", "f'camera_{u}'")
        ),
        "'params': [viewpoint.turned], 'lr': 0.1, 'name': f'turn_{u}'",
    ],
)
def test_cameras_that_a_training_moves_see_other_pictures(tmp_path, group):
    why(tmp_path)
    text = (tmp_path / "train.py").read_text()
    (tmp_path / "train.py").write_text(f"{text}\nadam = Adam([{{{group}}}])\n")
    found = unlike(HostRepo(tmp_path), ["train"])
    assert found.startswith("its training may move its cameras, the group ")
