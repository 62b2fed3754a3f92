"""NeuS opacity of sections."""

import torch

from univoxel.ops import section_alpha


def test_matches_the_formula_of_the_paper():
    sdf = torch.tensor([0.3, 0.1, -0.05, -0.3, 0.2, 0.1], dtype=torch.float64)
    connected = torch.tensor([True, True, True, False, True, False])
    phi = torch.sigmoid(sdf * 10)
    expected = (1 - phi[1:] / phi[:-1]).clamp(0, 1)
    alpha = section_alpha(sdf, connected, 10.0)
    torch.testing.assert_close(alpha[:3], expected[:3])
    torch.testing.assert_close(alpha[4], expected[4])
    assert alpha[3] == 0
    assert alpha[5] == 0


def test_a_rising_sdf_is_transparent():
    assert section_alpha(torch.tensor([-0.1, 0.2]), torch.tensor([True, False]), 50.0)[0] == 0


def test_weights_do_not_depend_on_the_number_of_sections():
    """1 - prod (1 - alpha) telescopes to 1 - Phi_last / Phi_first: finer steps change nothing."""
    coarse, fine = torch.linspace(0.5, -0.5, 5), torch.linspace(0.5, -0.5, 65)
    through = [
        (1 - section_alpha(f, torch.arange(len(f)) < len(f) - 1, 8.0)).prod()
        for f in (coarse, fine)
    ]
    torch.testing.assert_close(through[0], through[1])


def test_extreme_values_stay_finite_in_value_and_gradient():
    sdf = torch.tensor([1e30, -1e30, -1e30, 0.0, 1e-38, -5.0], requires_grad=True)
    alpha = section_alpha(sdf, torch.tensor([True] * 5 + [False]), 1e4)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    (grad,) = torch.autograd.grad(alpha.sum(), sdf)
    assert grad.isfinite().all()
