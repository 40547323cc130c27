"""The colour basis against its definition by Legendre functions."""

import pytest
import torch
from oracle.naive import harmonic

from reference_renderer.sh import sh_basis, sh_colors

F64 = torch.float64


def directions(n=20):
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    return points / points.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("degree", range(4))
def test_basis_is_the_real_harmonics_up_to_the_degree(degree):
    basis = sh_basis(directions(), degree)
    orders = [(d, m) for d in range(degree + 1) for m in range(-d, d + 1)]
    expected = [[harmonic(d, m, v) for d, m in orders] for v in directions().tolist()]
    assert torch.allclose(basis, torch.tensor(expected, dtype=F64), atol=1e-12)


def test_coefficients_above_the_degree_are_not_used():
    sh = torch.randn(20, 16, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    sh.requires_grad_()
    colors = sh_colors(directions(), torch.zeros(3, dtype=F64), sh, 1)
    colors.sum().backward()
    assert sh.grad[:, 4:].abs().max() == 0
    assert torch.equal(colors, sh_colors(directions(), torch.zeros(3, dtype=F64), sh[:, :4], 1))


def test_a_channel_clamped_at_zero_gets_no_gradient():
    sh = torch.tensor([[[-3.0, 1.0, 0.0]]], dtype=F64, requires_grad=True)
    colors = sh_colors(directions(1), torch.zeros(3, dtype=F64), sh, 0)
    colors.sum().backward()
    assert colors[0, 0] == 0
    assert sh.grad[0, 0].tolist() == pytest.approx([0, 0.28209479, 0.28209479])
