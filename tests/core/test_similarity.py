"""A host's SSIM is answered in compiled code only where both ways agree."""

from types import SimpleNamespace

import pytest
import torch
from torch.nn.functional import conv2d

from fragprune_plugins.adapting import HostRepo, Role, Seam, SeamCall
from fragprune_plugins.engines.cpu import binding
from fragprune_plugins.injection.similarity import on_similarity, seam_of

SEAM = Seam(Role.SIMILARITY, "utils.loss_utils", "ssim", ("img1", "img2"))

needs_native = pytest.mark.skipif(not binding.usable_builds(), reason="no compiled rasterizer here")


def host(width=11, sigma=1.5, padding=5, c1=0.01**2, c2=0.03**2):
    """A host's function, 121 taps, which counts its calls."""

    def ssim(img1, img2, window_size=width, size_average=True):
        ssim.calls += 1
        offsets = torch.arange(window_size) - window_size // 2
        line = torch.exp(-(offsets**2) / (2 * sigma**2))
        window = torch.outer(line, line)[None, None] / line.sum() ** 2

        def blur(z):
            return conv2d(z.reshape(-1, 1, *z.shape[-2:]), window, padding=padding)

        x, y = blur(img1), blur(img2)
        xx, yy, xy = blur(img1**2) - x * x, blur(img2**2) - y * y, blur(img1 * img2) - x * y
        found = (2 * x * y + c1) * (2 * xy + c2) / ((x * x + y * y + c1) * (xx + yy + c2))
        return found.mean() if size_average else found.mean((1, 2, 3))

    ssim.calls = 0
    return ssim


def pair(*batch):
    stream = torch.Generator().manual_seed(0)
    image, target = (torch.rand(*batch, 3, 40, 50, generator=stream) for _ in range(2))
    return image.requires_grad_(), target


def ask(session, function, *args, **kwargs):
    return on_similarity(session, SeamCall(SEAM, function, None, args, kwargs))


@needs_native
@pytest.mark.parametrize("batch", [(), (1,)])
@pytest.mark.parametrize("order", [1, -1])
def test_what_agrees_is_answered_with_the_same_value_and_gradient(batch, order):
    session, function = SimpleNamespace(similar=None), host()
    image, target = pair(*batch)
    first = ask(session, function, *(image, target)[::order])
    again = ask(session, function, *(image, target)[::order])
    assert (session.similar, function.calls) == (True, 2)  # one is the probe
    assert again.item() == pytest.approx(first.item(), abs=1e-5)
    one, other = (torch.autograd.grad(each, image)[0] for each in (first, again))
    torch.testing.assert_close(one, other, rtol=0, atol=1e-4 * float(one.abs().max()))


@pytest.mark.parametrize(
    "other",
    [{"width": 9, "padding": 4}, {"sigma": 1.6}, {"padding": 0}, {"c1": 0.02**2}, {"c2": 0.02**2}],
    ids=str,
)
def test_another_formula_stays_the_hosts(other):
    session, function = SimpleNamespace(similar=None), host(**other)
    ask(session, function, *pair())
    assert session.similar is False
    before = function.calls
    ask(session, function, *pair())
    assert function.calls == before + 1


@pytest.mark.parametrize(
    "rest", [lambda x: 0 * x.sum(), lambda _: torch.zeros((), requires_grad=True)]
)
def test_an_equal_value_with_another_gradient_is_no_agreement(rest):
    def detached(img1, img2):
        return host()(img1, img2).detach() + rest(img1)

    session = SimpleNamespace(similar=None)
    ask(session, detached, *pair())
    assert session.similar is False


@pytest.mark.parametrize(
    "call",
    [
        lambda x, y: ((x, y), {"size_average": False}),
        lambda x, y: ((x.double(), y.double()), {}),
        lambda x, y: ((x, y.clone().requires_grad_()), {}),
        lambda x, y: ((x[:, :20], y[:1, :20]), {}),
        lambda x, y: ((x.expand(2, -1, -1, -1), y.expand(2, -1, -1, -1)), {}),
    ],
)
def test_what_compiled_code_cannot_answer_is_the_hosts(call):
    session = SimpleNamespace(similar=None)
    args, kwargs = call(*pair())

    def function(img1, img2, size_average=True):
        return "the host's"

    assert ask(session, function, *args, **kwargs) == "the host's"
    assert session.similar is None


def test_without_compiled_code_nothing_is_asked_twice(monkeypatch):
    monkeypatch.setenv(binding.ENVIRONMENT, "off")
    session, function = SimpleNamespace(similar=None), host()
    ask(session, function, *pair())
    assert (session.similar, function.calls) == (None, 1)


def test_the_function_is_found_by_its_name_and_parameters(tmp_path):
    repo = HostRepo(tmp_path)
    assert seam_of(repo) is None
    file = tmp_path / "utils" / "loss_utils.py"
    file.parent.mkdir()
    for parameters, expected in (("img1, img2, window_size=11", SEAM), ("image, truth", None)):
        file.write_text(f"def ssim({parameters}): ...\n")
        assert seam_of(HostRepo(tmp_path)) == expected
