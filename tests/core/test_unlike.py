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


COMPARES, WEIGHS = "compares image with gt_image", "weighs what it compares,"


@pytest.mark.parametrize(
    ("written", "does"),
    [
        ({"between": "image = water(image, depth) + image"}, COMPARES),
        ({"between": "behind, image = gaussians.adjusted(image)"}, COMPARES),
        ({"between": "image = image * torch.exp(gain)"}, COMPARES),
        ({"loss": "ssim(image * exposure, gt_image)"}, "compares image * exposure with gt_image"),
        ({"loss": "l1_loss(image * mask, gt_image)"}, "compares image * mask with gt_image"),
        ({"between": "gt_image = styled.pop(0)"}, COMPARES),
        ({"between": "gt_image = gt_image ** 2.2"}, COMPARES),
        ({"between": "image[:, seen] = 0"}, COMPARES),
        ({"between": "image.mul_(exposure(camera))"}, COMPARES),
        ({"loss": "l1_loss(blurred(image), gt_image)"}, "compares blurred(image) with gt_image"),
        # a mask beside the comparison leaves parts of photographs out
        ({"loss": "(static_mask * abs(image - gt_image)).mean()"}, f"{WEIGHS} static_mask"),
        ({"loss": "((1.0 - mask) * abs(image - gt_image)).mean()"}, f"{WEIGHS} 1.0 - mask"),
    ],
    ids=str,
)
def test_another_picture_is_compared(tmp_path, written, does):
    assert why(tmp_path, **written).startswith(f"its training {does} (train.py:")


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
    ("file", "text", "changes"),
    [
        ("utils/general_utils", "def PILtoTorch(a):\n    return colour.RGB_to_RGB(a)", True),
        ("utils/general_utils", "def PILtoTorch(a):\n    return torch.pow(a, 2.2)", True),
        ("utils/general_utils", "def PILtoTorch(a):\n    return a.resize(3).permute(2)", False),
        ("utils/camera_utils", "def loadCam(a):\n    return to_linear(PILtoTorch(a))", True),
        ("utils/camera_utils", "def other(a):\n    return to_linear(PILtoTorch(a))", False),
        ("scene/dataset_readers", "if model == 'SIMPLE' or 'RADIAL': one()", True),
        ("scene/dataset_readers", "if model == 'SIMPLE' or model == 'RADIAL': one()", False),
        ("scene/dataset_readers", "folder = images or 'images'", False),
    ],
)
def test_readers_may_change_what_a_camera_sees(tmp_path, file, text, changes):
    (tmp_path / file).parent.mkdir()
    (tmp_path / f"{file}.py").write_text(text)
    assert why(tmp_path).startswith("its cameras change what they see") == changes


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
