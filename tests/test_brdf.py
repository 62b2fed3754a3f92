"""The BRDF against quadrature and an independent reference in NumPy."""

import math

import numpy as np
import pytest
import torch

from univoxel import brdf

Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def view(cosine):
    return torch.tensor([math.sqrt(1 - cosine**2), 0.0, cosine], dtype=torch.float64)


def half_sphere(n_z, n_phi):
    """Mid-point rule in z^2 and phi: directions [M, 3] and solid angles [M], in double."""
    edges = torch.linspace(0, 1, n_z + 1, dtype=torch.float64) ** 2
    z, step = (edges[1:] + edges[:-1]) / 2, edges.diff()
    phi = (torch.arange(n_phi, dtype=torch.float64) + 0.5) * (2 * math.pi / n_phi)
    z, phi = torch.meshgrid(z, phi, indexing="ij")
    s = (1 - z * z).sqrt()
    w = torch.stack([s * phi.cos(), s * phi.sin(), z], -1).reshape(-1, 3)
    return w, (step * (2 * math.pi / n_phi))[:, None].expand(z.shape).reshape(-1)


def visible_normals_albedo(cosine, roughness, f0, n=96):
    """E by Gauss quadrature over GGX's visible normals (the cap of Dupuy & Benyoub 2023)."""
    a = max(roughness**2, 1e-3)
    x, w = np.polynomial.legendre.leggauss(n)
    u, w = (x + 1) / 2, w / 2
    sine = np.sqrt(1 - cosine**2)
    stretched = np.array([a * sine, 0, cosine])
    stretched /= np.linalg.norm(stretched)
    phi = np.pi * u[:, None]
    z = (1 - u) * (1 + stretched[2]) - stretched[2] + 0 * phi
    s = np.sqrt(np.clip(1 - z * z, 0, 1))
    h = np.stack([s * np.cos(phi), s * np.sin(phi), z], -1) + stretched
    h = h * [a, a, 1]
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    vh = h @ np.array([sine, 0, cosine])
    nl = 2 * vh * h[..., 2] - cosine
    root_v, root_l = (np.sqrt(c * c * (1 - a * a) + a * a) for c in (cosine, nl))
    ratio = np.where(nl > 0, nl * (cosine + root_v) / (nl * root_v + cosine * root_l), 0)  # G2 / G1
    fresnel = f0 + (1 - f0) * (1 - np.clip(vh, 0, 1)) ** 5
    return float((w[:, None] * w * ratio * fresnel).sum())


def numpy_brdf(n, wo, wi, albedo, roughness, f0):
    """f without the (1 - E) of the base: docs/reference/conventions.md, in textbook forms."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    a2 = roughness**4
    nh, nl, nv, vh = n @ h, n @ wi, n @ wo, wo @ h
    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    v = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
    return d * v * (f0 + (1 - f0) * (1 - vh) ** 5)


def random_unit(g, *shape):
    x = torch.nn.functional.normalize(
        torch.randn(*shape, 3, generator=g, dtype=torch.float64), dim=-1
    )
    return x


def test_specular_equals_independent_reference():
    g = torch.Generator().manual_seed(0)
    n, wo, wi = (random_unit(g, 200) for _ in range(3))
    wo = wo * (n * wo).sum(-1, keepdim=True).sign()
    wi = wi * (n * wi).sum(-1, keepdim=True).sign()
    roughness = 0.2 + 0.8 * torch.rand(200, generator=g, dtype=torch.float64)
    got = brdf.specular(n, wo, wi, roughness, 0.04).numpy()
    wanted = [
        numpy_brdf(*(t[i].numpy() for t in (n, wo, wi)), 0, float(roughness[i]), 0.04)
        for i in range(200)
    ]
    # |wi + wo|^2 carries a guard of 1e-7, which weighs most where the two are nearly opposite.
    np.testing.assert_allclose(got, wanted, rtol=1e-4)
    # Reciprocity.
    torch.testing.assert_close(
        brdf.specular(n, wi, wo, roughness), brdf.specular(n, wo, wi, roughness)
    )


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.7, 1.0])
def test_d_is_normalised(roughness):
    edges = torch.linspace(0, 1, 20001, dtype=torch.float64) ** 3  # of sin^2, dense at the peak
    s2, step = (edges[1:] + edges[:-1]) / 2, edges.diff()
    alpha = brdf.ggx_alpha(torch.tensor(roughness, dtype=torch.float64))
    # n.h dh = d(sin^2)/2 dphi
    total = (brdf.ggx_d(1 - s2, s2, alpha) * step).sum() * math.pi
    assert float(total) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("roughness", [0.05, 0.12, 0.35, 0.62, 0.81, 1.0])
@pytest.mark.parametrize("cosine", [0.02, 0.07, 0.23, 0.55, 0.9, 1.0])
def test_specular_albedo_against_quadrature(cosine, roughness):
    for f0 in (0.0, 0.04, 0.5, 1.0):
        wanted = visible_normals_albedo(cosine, roughness, f0)
        arguments = (torch.tensor(v, dtype=torch.float64) for v in (cosine, roughness))
        got = brdf.specular_albedo(*arguments, f0)
        # the stated bound of the fit
        assert abs(float(got) - wanted) < 0.005


def test_white_furnace():
    """A white surface in white light sends 1: the base gives what the layer leaves."""
    wi, weight = half_sphere(400, 200)
    for roughness in (0.45, 0.7, 1.0):  # a highlight that the mid-point rule resolves
        for cosine in (0.2, 0.5, 1.0):
            wo, r = view(cosine), torch.tensor(roughness, dtype=torch.float64)
            f = brdf.evaluate(Z, wo, wi, torch.ones(3).double(), r)
            total = (f * (wi[:, 2] * weight)[:, None]).sum(0)
            # The base gives 1 - E exactly and the layer E: 1 up to the error of the fit of E.
            torch.testing.assert_close(total, torch.ones(3).double(), atol=0.006, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_inputs_are_finite(dtype):
    x, z, none = ([1.0, 0, 0], [0, 0, 1.0], [0.0, 0, 0])
    down = [0, 0, -1.0]
    cases = [(z, z, down), (z, x, x), (none, z, z), (z, down, z), (z, z, z), (z, x, [-1.0, 0, 0])]
    for roughness in (0.0, 0.03, 1.0):
        for case in cases:
            n, wo, wi = (torch.tensor(v, dtype=dtype, requires_grad=True) for v in case)
            albedo = torch.full((3,), 0.5, dtype=dtype, requires_grad=True)
            r = torch.tensor(roughness, dtype=dtype, requires_grad=True)
            f = brdf.evaluate(n, wo, wi, albedo, r)
            grads = torch.autograd.grad(f.sum(), [n, wo, wi, albedo, r])
            assert all(bool(t.isfinite().all()) for t in (f, *grads)), (roughness, case)
            assert bool((f >= 0).all())


def test_f0_per_channel_is_each_channel_alone():
    """Values and gradients, also where the eye is behind the surface and E leaves the fit."""
    g = torch.Generator().manual_seed(2)
    inputs = [random_unit(g, 40), random_unit(g, 40)[:, None], random_unit(g, 6)]
    inputs[0] = inputs[0][:, None]
    inputs += [torch.rand(40, 1, 3, generator=g).double(), torch.rand(40, 1, generator=g).double()]
    leaves = [t.requires_grad_() for t in inputs]
    f0 = torch.rand(40, 1, 3, generator=g).double()
    f0[0], f0[1], f0[2] = 0, 1, torch.tensor([0.0, 0.5, 1.0])
    weight = torch.rand(40, 6, 3, generator=g).double()
    got = brdf.evaluate(*leaves, f0)
    grads = torch.autograd.grad((got * weight).sum(), leaves)
    wanted = torch.empty_like(got)
    summed = [torch.zeros_like(t) for t in leaves]
    for i in range(40):
        for c in range(3):
            mine = [leaf if leaf.shape[0] == 6 else leaf[i] for leaf in leaves]
            f = brdf.evaluate(*mine, float(f0[i, 0, c]))[..., c]
            wanted[i, :, c] = f.detach()
            for to, by in zip(
                summed, torch.autograd.grad((f * weight[i, :, c]).sum(), leaves), strict=True
            ):
                to += by
    torch.testing.assert_close(got.detach(), wanted)
    torch.testing.assert_close(list(grads), summed)


def test_outside_of_the_fitted_range_and_from_behind():
    """Outside the fitted range E stays a share."""
    v = torch.linspace(-1, 1, 101)[:, None]
    r = torch.linspace(0, 1, 101)[None]
    e = brdf.specular_albedo(v, r, 1.0)
    assert bool(((e >= 0) & (e <= 1)).all())
    f = brdf.evaluate(Z, Z, -view(0.3), torch.ones(3).double(), torch.tensor(0.5).double())
    assert f.tolist() == [0, 0, 0]
