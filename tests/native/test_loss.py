"""The photometric loss, compiled and in torch, against 121 taps written out in double precision."""

import math
import sys
from functools import partial
from importlib.machinery import ModuleSpec
from types import ModuleType

import pytest
import torch
from skimage.metrics import structural_similarity
from torch.nn.functional import conv2d

from fragprune_plugins.engines import losses
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.errors import EngineError, InputError
from fragprune_plugins.learning.losses import SSIM_WEIGHT, ssim_map
from fragprune_plugins.workbench.finetune import losses as trained
from fragprune_plugins.workbench.finetune.losses import photometric_loss

SIZES = [(1, 1), (1, 7), (5, 3), (11, 11), (26, 246), (9, 600), (129, 257)]
"""Smaller than the window, a panel to the pixel, and more than one panel and strip."""


compiled_loss = partial(losses.compiled_loss, ssim_weight=SSIM_WEIGHT)


def plain_ssim(x, y):
    """The 121 taps written out."""
    offsets = torch.arange(11).double() - 5
    line = torch.exp(-(offsets**2) / 4.5)
    window = torch.outer(line, line)
    window = (window / window.sum())[None, None]

    def blur(z):
        return conv2d(z[:, None], window, padding=5)[:, 0]

    mx, my = blur(x), blur(y)
    vx, vy, c = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    below = (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
    return ((2 * mx * my + 1e-4) * (2 * c + 9e-4) / below).mean()


def oracle(image, target, ssim_weight=0.2):
    """The hosts' formula in float64: the value, and the gradient by the image."""
    x, y = image.double().detach().requires_grad_(), target.double()
    loss = (1 - ssim_weight) * (x - y).abs().mean() + ssim_weight * (1 - plain_ssim(x, y))
    return loss.detach(), *torch.autograd.grad(loss, x)


def pair(kind, height=70, width=90, channels=3):
    stream = torch.Generator().manual_seed(0)
    noise = torch.randn(channels, height, width, generator=stream)
    busy = torch.rand(channels, height, width, generator=stream)
    down, across = torch.meshgrid(
        torch.arange(float(height)), torch.arange(float(width)), indexing="ij"
    )
    waves = (0.5 + 0.25 * torch.sin(across / 9) + 0.25 * torch.cos(down / 7)).expand_as(busy)
    white = torch.where(waves > 0.6, torch.ones(()), busy)
    return {
        "strangers": (busy, 1 - busy.roll(1, 2)),
        "smooth": (waves + 0.05 * noise, waves),
        "on white": (white + 0.001 * noise, white),
        "flat": (torch.full_like(busy, 0.9) + 1e-4 * noise, torch.full_like(busy, 0.88)),
        "nearly equal": (waves + 1e-5 * noise, waves),
        "out of range": (3 * busy - 1, waves),
        "black": (0.01 * busy, torch.zeros_like(busy)),
    }[kind]


def agrees(library, image, target, **weight):
    image = image.detach().clone().requires_grad_()
    loss = compiled_loss(image, target, library=library, **weight)
    (gradient,) = torch.autograd.grad(loss, image)
    value, by_image = oracle(image, target, **weight)
    assert float(loss.detach()) == pytest.approx(float(value), abs=1e-7)
    largest = float(by_image.abs().max())
    torch.testing.assert_close(gradient.double(), by_image, rtol=0, atol=1e-5 * largest)


@pytest.mark.parametrize(
    ("kind", "shape", "weight"),
    [
        *(("strangers", (*size, 2), {}) for size in SIZES),
        *(("strangers", (20, 30, channels), {}) for channels in (1, 4)),
        *((kind, (), {}) for kind in ("smooth", "on white", "flat", "nearly equal", "black")),
        ("out of range", (), {}),
        *(("smooth", (), {"ssim_weight": weight}) for weight in (0.0, 1.0, 0.7)),
    ],
)
def test_value_and_gradient_are_the_oracles(library, kind, shape, weight):
    agrees(library, *pair(kind, *shape), **weight)


def test_equal_pictures_lose_nothing_and_pull_nowhere(library):
    _, target = pair("strangers")
    image = target.clone().requires_grad_()
    loss = compiled_loss(image, target, library=library)
    loss.backward()
    assert loss == 0
    assert not image.grad.any()


def test_the_value_is_the_same_without_a_gradient(library):
    image, target = pair("strangers", *SIZES[-1])
    plain = compiled_loss(image, target, library=library)
    assert plain == compiled_loss(image.requires_grad_(), target, library=library).detach()


def test_the_same_to_the_bit_with_any_number_of_threads(library, monkeypatch):
    image, target = pair("strangers", *SIZES[-1])
    found = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(losses, "native_threads", lambda threads=threads: threads)
        x = image.clone().requires_grad_()
        loss = compiled_loss(x, target, library=library)
        found.append((loss.detach(), *torch.autograd.grad(loss, x)))
    assert all(torch.equal(a, b) for each in found[1:] for a, b in zip(found[0], each, strict=True))


def test_it_is_scaled_and_summed_as_any_other(library):
    image, target = pair("smooth")
    x = image.clone().requires_grad_()
    (3 * compiled_loss(x, target, library=library) + x.sum()).backward()
    _, by_image = oracle(image, target)
    torch.testing.assert_close(x.grad.double(), 3 * by_image + 1, rtol=0, atol=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("which", [0, 1])
def test_nan_reaches_value_and_gradient_around_it(library, bad, which):
    images = [z.clone() for z in pair("smooth", 64, 300)]
    images[which][1, 30, 250] = bad
    x = images[0].requires_grad_()
    loss = compiled_loss(x, images[1], library=library)
    loss.backward()
    assert loss.isnan()
    near = x.grad[1, 20:41, 240:261]
    assert near.isnan().all()
    assert x.grad.isnan().sum() == near.numel()


@pytest.mark.parametrize("which", [0, 1])
def test_any_memory_layout(library, which):
    images = [z.clone() for z in pair("smooth")]
    expected = compiled_loss(*images, library=library)
    images[which] = images[which].permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert not images[which].is_contiguous()
    x = images[0].requires_grad_()
    loss = compiled_loss(x, images[1], library=library)
    loss.backward()
    assert loss.detach() == expected
    assert x.grad.double().sub(oracle(*images)[1]).abs().max() < 1e-7


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (lambda x, y: (x.double(), y), "image.*float64"),
        (lambda x, y: (x, y.half()), "target.*float16"),
        (lambda x, y: (x.to("meta"), y), "image.*meta"),
        (lambda x, y: (x[0], y), "image"),
        (lambda x, y: (x, y[:1]), "target"),
        (lambda x, y: (x, y.clone().requires_grad_()), "target: requires_grad"),
    ],
)
def test_what_it_does_not_take_is_refused_by_name(changed, said):
    with pytest.raises(InputError, match=said):
        compiled_loss(*changed(*pair("smooth")))


def test_a_picture_without_pixels_is_refused(library):
    with pytest.raises(EngineError, match="height"):
        compiled_loss(torch.empty(3, 0, 4), torch.empty(3, 0, 4), library=library)


def test_what_the_compiled_code_does_not_take_is_for_torch():
    image, target = pair("smooth")
    for x, y in ((image.double(), target.double()), (image, target.clone().requires_grad_())):
        value, _ = oracle(x, y)
        assert float(photometric_loss(x, y).detach()) == pytest.approx(float(value), abs=1e-6)


def test_ssim_agrees_with_scikit_image_inside():
    """Far from the border the paddings do not differ: a border of equal pixels adds none."""
    x, y = (z.double() for z in pair("smooth"))
    how = {"channel_axis": -1, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    given = (z.permute(1, 2, 0).numpy() for z in (x, y))
    _, theirs = structural_similarity(*given, **how, use_sample_covariance=False, full=True)
    ours, inside = ssim_map(x, y).permute(1, 2, 0).numpy(), slice(10, -10)
    assert ours[inside, inside] == pytest.approx(theirs[inside, inside], abs=1e-9)


def test_without_compiled_code_torch_does_it(monkeypatch):
    image, target = pair("smooth")
    monkeypatch.setenv(binding.ENVIRONMENT, "off")
    assert trained.code_for(image.device) == "torch"
    value, _ = oracle(image, target)
    assert float(photometric_loss(image, target)) == pytest.approx(float(value), abs=1e-6)


def test_fused_ssim_does_it_on_cuda_where_it_is_installed(monkeypatch):
    cuda, package = torch.device("cuda"), ModuleType("fused_ssim")
    package.__spec__ = ModuleSpec("fused_ssim", None)
    package.fused_ssim = lambda x, y: ssim_map(*x, *y).mean()  # of one image each
    monkeypatch.setitem(sys.modules, "fused_ssim", None)
    assert trained.code_for(cuda) == "torch"
    monkeypatch.setitem(sys.modules, "fused_ssim", package)
    assert trained.code_for(cuda) == "fused-ssim"
    monkeypatch.setattr(trained, "code_for", lambda _: "fused-ssim")
    image, target = pair("smooth")
    value, _ = oracle(image, target)
    assert float(photometric_loss(image, target)) == pytest.approx(float(value), abs=1e-6)
