"""RowAdam against torch.optim.Adam and SparseAdam."""

import copy
import subprocess
import sys

import pytest
import torch

from univoxel.ops import sample_dense
from univoxel.optim import RowAdam

BETAS = (0.8, 0.95)


def grid(*shape, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=g, dtype=torch.float64).requires_grad_()


def sparse_grad(shape, sparse_dim, step, share=0.3):
    """A gradient on some of the rows, others at every step."""
    g = torch.Generator().manual_seed(100 + step)
    touched = torch.rand(shape[:sparse_dim], generator=g) < share
    values = torch.randn(int(touched.sum()), *shape[sparse_dim:], generator=g, dtype=torch.float64)
    return torch.sparse_coo_tensor(
        touched.nonzero().T, values, shape, is_coalesced=True, check_invariants=True
    )


@pytest.mark.parametrize(("shape", "sparse_dim"), [((4, 3, 5), 3), ((4, 3, 5, 6), 3), ((9, 2), 1)])
def test_rows_follow_sparse_adam(shape, sparse_dim):
    """SparseAdam adds eps before the bias correction: there eps sqrt(1 - beta2^step) is ours."""
    mine, theirs = grid(*shape), grid(*shape)
    optimizer = RowAdam([mine], lr=0.05, betas=BETAS, eps=1e-2)
    oracle = torch.optim.SparseAdam([theirs], lr=0.05, betas=BETAS, eps=1e-2)
    for step in range(1, 8):
        mine.grad = sparse_grad(shape, sparse_dim, step)
        theirs.grad = mine.grad.clone()
        oracle.param_groups[0]["eps"] = 1e-2 * (1 - BETAS[1] ** step) ** 0.5
        optimizer.step()
        with torch.sparse.check_sparse_tensor_invariants():
            oracle.step()
    torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)


def test_groups_of_dense_parameters_follow_adam():
    mine, theirs = [grid(3, 4), grid(5, seed=1)], [grid(3, 4), grid(5, seed=1)]

    def groups(params):
        return [{"params": params[:1], "lr": 0.2, "eps": 0.1}, {"params": params[1:]}]

    optimizer = RowAdam(groups(mine), lr=0.05, betas=BETAS)
    oracle = torch.optim.Adam(groups(theirs), lr=0.05, betas=BETAS)
    for _ in range(5):
        for params, o in ((mine, optimizer), (theirs, oracle)):
            o.zero_grad()
            loss = o.step(lambda params=params: _backward(params))
            assert loss is not None
    for a, b in zip(mine, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


@pytest.mark.parametrize("which", ["gradient", "parameter", "slice", "both"])
def test_memory_in_another_order_follows_adam(which):
    """torch's fused step would read it as if it lay in order."""

    def parameter():
        values = grid(4, 6).detach()
        return {"gradient": values, "slice": values[:, :3]}.get(which, values.T).requires_grad_()

    mine, theirs = parameter(), parameter()
    optimizer = RowAdam([mine], lr=0.05, betas=BETAS)
    oracle = torch.optim.Adam([theirs], lr=0.05, betas=BETAS, foreach=False)
    for step in range(3):
        gradient = grid(*mine.shape[::-1], seed=step).detach().T
        mine.grad = gradient.contiguous() if which == "parameter" else gradient
        theirs.grad = gradient.clone()
        optimizer.step()
        oracle.step()
    torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)


def _backward(params):
    loss = sum(p.square().sum() for p in params)
    loss.backward()
    return loss


def test_untouched_rows_stay_bit_for_bit():
    sdf, features = grid(12, 12, 12), grid(12, 12, 12, 3)
    optimizer = RowAdam([sdf, features], lr=0.1)
    corner = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)).double() * 3
    for points in (corner + 8, corner):  # moments live elsewhere when the last step comes
        before = [copy.deepcopy((p, optimizer.state[p])) for p in (sdf, features)]
        optimizer.zero_grad()
        outputs = sample_dense(sdf, features, points, (0, 0, 0), 1.0, sparse_grad=True)
        sum(o.square().sum() for o in outputs).backward()
        optimizer.step()
    for p, (old, state) in zip((sdf, features), before, strict=True):
        rest = torch.ones(12, 12, 12, dtype=torch.bool)
        rest[tuple(p.grad.coalesce().indices())] = False
        assert 0 < rest.sum() < 12**3
        assert torch.equal(p[rest], old[rest])
        assert not torch.equal(p[~rest], old[~rest])
        for name in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(optimizer.state[p][name][rest], state[name][rest])


def test_gradients_of_two_backward_passes_add_up():
    mine, wanted = grid(4, 5, 6), grid(4, 5, 6)
    optimizers = [RowAdam([p], lr=0.1, eps=1e-2) for p in (mine, wanted)]
    a, b = sparse_grad(mine.shape, 3, 0), sparse_grad(mine.shape, 3, 1)
    both = torch.cat([a.indices(), b.indices()], 1)
    mine.grad = torch.sparse_coo_tensor(
        both, torch.cat([a.values(), b.values()]), mine.shape, check_invariants=True
    )
    with torch.sparse.check_sparse_tensor_invariants():
        wanted.grad = (a + b).coalesce()
        for optimizer in optimizers:
            optimizer.step()
    torch.testing.assert_close(mine, wanted)


@pytest.mark.parametrize(("channels", "n_points"), [(3, 0), (0, 5)])
def test_empty_gradient(channels, n_points):
    sdf, features = grid(4, 4, 4), grid(4, 4, 4, channels)
    before = sdf.detach().clone()
    points = torch.full((n_points, 3), 1.5, dtype=torch.float64)
    outputs = sample_dense(sdf, features, points, (0, 0, 0), 1.0, sparse_grad=True)
    sum(o.sum() for o in outputs).backward()
    RowAdam([sdf, features], lr=0.1).step()
    assert torch.equal(sdf, before) is (n_points == 0)


def test_layout_may_change_and_state_is_saved():
    """Half the steps, save, load into a fresh optimizer, the other half: as in one go."""
    straight, broken = grid(4, 5, 6), grid(4, 5, 6)

    def steps(param, optimizer, which):
        for step in which:
            param.grad = sparse_grad(param.shape, 3, step)
            if step % 3 == 0:
                param.grad = param.grad.to_dense()
            optimizer.step()

    steps(straight, RowAdam([straight], lr=0.1, eps=1e-3), range(8))
    first = RowAdam([broken], lr=0.1, eps=1e-3)
    steps(broken, first, range(4))
    second = RowAdam([broken])
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    steps(broken, second, range(4, 8))
    assert torch.equal(straight, broken)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lr": -1.0}, "lr must be at least 0, got -1.0"),
        ({"eps": -1.0}, "eps must be at least 0, got -1.0"),
        ({"betas": (0.9, 1.0)}, r"betas must be in \[0, 1\), got \(0.9, 1.0\)"),
    ],
)
def test_bad_numbers(change, message):
    with pytest.raises(ValueError, match=message):
        RowAdam([grid(2)], **change)
    with pytest.raises(ValueError, match=message):
        RowAdam([{"params": [grid(2)], **change}])


def test_strided_table():
    param = grid(4, 5).detach().T.requires_grad_()
    param.grad = sparse_grad(param.shape, 1, 0)
    with pytest.raises(ValueError, match="sparse gradient must be contiguous, got strides"):
        RowAdam([param]).step()


def test_the_compiler_is_not_imported():
    """By torch's own optimizers it is: a second and 70 MB of every training."""
    program = """
import sys, torch
from univoxel.optim import RowAdam
table = torch.nn.Parameter(torch.ones(3))
optimizer = RowAdam([table])
optimizer.zero_grad()
table.square().sum().backward()
optimizer.step()
print(any(name.startswith("torch._dynamo") for name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout.strip() == b"False"
