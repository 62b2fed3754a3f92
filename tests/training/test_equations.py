"""The equations of the map against autograd: transport, Schur complements, smoothness."""

from dataclasses import replace

import pytest
import torch
from observed_points import in_double, photographed, random_problem

from univoxel import brdf
from univoxel.color import linear_to_srgb_unclipped
from univoxel.sphere import fibonacci_sphere
from univoxel.training import equations, newton
from univoxel.training.newton import CAUCHY


@pytest.fixture(params=["dielectric", "metal"])
def transport_and_map(request):
    """Transport in double, a map and albedos that do not explain it, some observations clipped."""
    problem, metal = random_problem(), request.param == "metal"
    map, albedo = 0.7 + 2.5 * torch.rand(12, 3), 0.2 + 0.6 * torch.rand(5, 3)
    problem = photographed(problem, map, *of_metal(metal, albedo, torch.full((5,), 0.3)))
    target = problem.target + 0.03 * torch.randn_like(problem.target)
    target = target.clamp_max(1.0)  # as photographs are
    problem = replace(problem, target=target)
    point, observation = torch.arange(5), torch.arange(20).view(5, 4)
    rough = torch.full((5,), 0.3)
    transport = newton.linear_transport(problem, point, observation, rough, metal)
    map = map * torch.linspace(1.6, 0.9, 12)[:, None]
    return in_double(transport), map.double(), albedo.log().double()


def of_metal(metal: bool, base: torch.Tensor, roughness: torch.Tensor):
    """Diffuse albedo, roughness and F0."""
    diffuse, f0 = brdf.split(base, torch.full((len(base),), float(metal)))
    return diffuse, roughness, f0


@pytest.mark.parametrize("metal", [False, True])
def test_transport_makes_what_the_shading_makes(metal):
    problem = random_problem()
    map, albedo, roughness = torch.rand(12, 3), torch.rand(5, 3), 0.2 + 0.6 * torch.rand(5)
    problem = photographed(problem, map, *of_metal(metal, albedo, roughness))
    point, which = torch.tensor([0, 2, 4]), torch.tensor([[3, 1], [9, 8], [18, 18]])
    transport = newton.linear_transport(problem, point, which, roughness[point], metal)
    radiance = radiance_of(transport, map, albedo[point])
    assert torch.allclose(radiance, problem.observations.color[which], rtol=1e-4, atol=1e-6)
    assert torch.equal(transport.target, problem.target[which])


def radiance_of(transport: equations.LinearTransport, map: torch.Tensor, albedo: torch.Tensor):
    sky = transport.diffuse_factor[..., None] * (transport.diffuse @ map)
    specular = transport.specular @ map + transport.specular_indirect
    return albedo[:, None] * (sky + transport.diffuse_indirect) + specular


def weights(transport: equations.LinearTransport, map: torch.Tensor, log_albedo: torch.Tensor):
    residual = transport.target - linear_to_srgb_unclipped(
        radiance_of(transport, map, log_albedo.exp())
    )
    weight = 1 / (1 + (residual / CAUCHY) ** 2)
    return torch.where((transport.target > equations.CLIPPED) & (residual < 0), 0.0, weight)


def test_equations_are_the_schur_complement_of_the_dense_system(transport_and_map):
    transport, map, log_albedo = transport_and_map
    weight = weights(transport, map, log_albedo)
    assert 0 < int((weight == 0).sum()) < weight.numel() / 2  # clipped observations are among them
    state = transport, map, log_albedo, CAUCHY
    eliminated, right, back = equations.normal_equations(*state)
    cost = 0.0
    for c in range(3):

        def encoded(x, a, c=c):
            light, albedo = map.clone(), log_albedo.exp()
            light[:, c], albedo[:, c] = x.exp(), a.exp()
            return linear_to_srgb_unclipped(radiance_of(transport, light, albedo))[..., c].flatten()

        x, a = map[:, c].log(), log_albedo[:, c]
        j_map, j_albedo = torch.autograd.functional.jacobian(encoded, (x, a))
        w = weight[..., c].flatten()
        residual = transport.target[..., c].flatten() - encoded(x, a)
        cost += (w * residual**2).sum()
        full = torch.cat([j_map, j_albedo], 1)
        hessian, gradient = full.T @ (w[:, None] * full), full.T @ (w * residual)
        own = hessian[12:, 12:] + 1e-6 * torch.eye(5)
        cross, inverse = hessian[:12, 12:], torch.linalg.inv(own)
        exact = {"rtol": 1e-6, "atol": 1e-9}  # double, but for float32 constants of the curve
        assert torch.allclose(eliminated[c], hessian[:12, :12] - cross @ inverse @ cross.T, **exact)
        assert torch.allclose(right[c], gradient[:12] - cross @ inverse @ gradient[12:], **exact)
        assert torch.allclose(back.gradient[c], gradient[12:], **exact)
        assert torch.allclose(back.curvature[c], own.diagonal(), **exact)
        assert torch.allclose(back.cross[c], cross.T, **exact)

        # One step of the eliminated system and what it says of the albedo: the dense solution
        damping = 1e-4 * torch.eye(12)
        dense = hessian.clone()
        dense[12:, 12:], dense[:12, :12] = own, hessian[:12, :12] + damping
        solution = torch.linalg.solve(dense, gradient)
        step = torch.linalg.solve(eliminated[c] + damping, right[c])
        change = (back.gradient[c] - back.cross[c] @ step) / back.curvature[c]
        assert torch.allclose(step, solution[:12], rtol=1e-4, atol=1e-7)
        assert torch.allclose(change, solution[12:], rtol=1e-4, atol=1e-7)
    assert back.cost == pytest.approx(float(cost), rel=1e-9)


def test_roughness_is_eliminated_by_the_schur_complement_too():
    """Of the dense system of three channels, which roughness ties to one another; in double."""
    problem = random_problem()
    true, albedo = 0.7 + 2.5 * torch.rand(12, 3), 0.2 + 0.6 * torch.rand(5, 3)
    problem = photographed(problem, true, albedo, torch.full((5,), 0.5))
    point, observation, by = torch.arange(5), torch.arange(20).view(5, 4), 0.02
    transport, rougher = (
        in_double(newton.linear_transport(problem, point, observation, rough, False))
        for rough in (torch.full((5,), 0.3), torch.full((5,), 0.3 + by))
    )
    map, log_albedo = (true * 1.2).double(), (0.9 * albedo).log().double()
    prior, deviation = 0.3, torch.linspace(-0.1, 0.2, 5).double()

    def encoded(x, a, rough):  # linear in roughness, as the equations take it
        state = x.view(12, 3).exp(), a.view(5, 3).exp()
        now, then = (radiance_of(t, *state) for t in (transport, rougher))
        return linear_to_srgb_unclipped(now + rough[:, None, None] / by * (then - now)).flatten()

    state = map.log().flatten(), log_albedo.flatten(), torch.zeros(5).double()
    jacobian = torch.cat(torch.autograd.functional.jacobian(encoded, state), 1)
    w = weights(transport, map, log_albedo).flatten()
    residual = transport.target.flatten() - encoded(*state)
    hessian, gradient = jacobian.T @ (w[:, None] * jacobian), jacobian.T @ (w * residual)
    hessian[36:51, 36:51] += 1e-6 * torch.eye(15)
    hessian[51:, 51:] += prior * torch.eye(5)
    gradient[51:] -= prior * deviation

    step = equations.RoughnessStep(rougher, by, prior, deviation)
    state = transport, map, log_albedo, CAUCHY
    own, right, back = equations.normal_equations(*state, None, step)
    coupling, from_gradient = equations.roughness_terms(back.roughness)
    system, right = torch.block_diag(*own) - coupling, (right - from_gradient).flatten()
    order = torch.arange(36).view(12, 3).T.flatten()  # channel after channel
    cross, inverse = hessian[:36, 36:], torch.linalg.inv(hessian[36:, 36:])
    exact = {"rtol": 1e-5, "atol": 1e-8}  # double, but for float32 constants of the curve
    complement = (hessian[:36, :36] - cross @ inverse @ cross.T)[order][:, order]
    assert torch.allclose(system, complement, **exact)
    assert torch.allclose(right, (gradient[:36] - cross @ inverse @ gradient[36:])[order], **exact)
    assert (own[0] - system[:12, :12]).abs().max() > 1e-3 * own[0].abs().max()  # it matters

    hessian[:36, :36] += 1e-4 * torch.eye(36)
    solution = torch.linalg.solve(hessian, gradient)
    step = torch.linalg.solve(system + 1e-4 * torch.eye(36), right)
    to_albedo, to_rough = back.back_substituted(step.view(3, 12))
    found = {"rtol": 1e-4, "atol": 1e-7}
    assert torch.allclose(step, solution[:36][order], **found)
    assert torch.allclose(to_albedo.flatten(), solution[36:51], **found)
    assert torch.allclose(to_rough, solution[51:], **found)


def test_laplacian():
    direction = fibonacci_sphere(200)
    matrix = equations.graph_laplacian(direction, 6)
    assert (matrix.sum(1) == 0).all()
    assert torch.equal(matrix, matrix.T)
    assert (matrix.diagonal() >= 6).all()
    near = (direction[0] @ direction.T).topk(7).indices[1:]
    assert (matrix[0, near] == -1).all()
    assert (matrix - torch.diag(matrix.diagonal()) <= 0).all()
    # A smooth function costs little, an uneven one much: x' L x sums squared differences
    smooth, rough = direction[:, 2], torch.arange(200) % 2 * 2.0 - 1
    edges = 0.5 * (matrix.diagonal().sum())
    assert smooth @ matrix @ smooth < 0.1 * edges
    assert rough @ matrix @ rough > edges
