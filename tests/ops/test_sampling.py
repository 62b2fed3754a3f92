"""What all samplers of fields share: sparse gradients, gradients alone, points that are nowhere."""

import pytest
import torch
from check_op import same_on_threads
from op_cases import CASES, LEAVES, doubled, flat, fresh, function, projection
from torch import Tensor

from univoxel.ops import native, use_backend

POINTS = ["sample_dense", "sample_sparse", "encode_hash"]
SAMPLERS = [*POINTS, "composite_field", "composite_field of bricks"]
BACKENDS = pytest.mark.parametrize("backend", ["native", "reference"])


def leaves_of(case: str) -> list[str]:
    return LEAVES[case.split()[0]].split()


def gradients(case: str, arguments: dict, **options) -> dict[str, Tensor]:
    arguments, leaves = fresh(case, arguments, **options)
    out = [o.nan_to_num() for o in flat(function(case)(**arguments))]
    return dict(zip(leaves_of(case), torch.autograd.grad(projection(out), leaves), strict=True))


def tables(case: str) -> list[str]:
    """Arguments that have a sparse gradient."""
    return [name for name in leaves_of(case) if name in ("sdf", "features", "table")]


@BACKENDS
@pytest.mark.parametrize("case", SAMPLERS)
def test_sparse_gradients_are_the_dense_ones(case, backend):
    given = doubled(CASES[case](20))
    with use_backend(backend):
        dense, sparse = (gradients(case, given, sparse_grad=s) for s in (False, True))
    for name, wanted in dense.items():
        got = sparse[name]
        assert got.is_sparse == (name in tables(case))
        if got.is_sparse:
            assert got.is_coalesced()
            assert got.dense_dim() == (name != "sdf")
            checked = torch.sparse_coo_tensor(
                got.indices(), got.values(), got.shape, check_invariants=True
            )
            assert torch.equal(checked.coalesce().indices(), got.indices()), "double or unsorted"
        torch.testing.assert_close(got.to_dense(), wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.skipif(native.core is None, reason="without the extension")
@pytest.mark.parametrize("case", SAMPLERS)
def test_bits_of_sparse_gradients_do_not_depend_on_the_number_of_threads(case):
    given = CASES[case](3000)
    same_on_threads(
        lambda: [g.to_dense() for g in gradients(case, given, sparse_grad=True).values()]
    )


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("case", SAMPLERS)
def test_a_gradient_alone_is_as_among_others(case, sparse):
    given = doubled(CASES[case](20))
    for name in leaves_of(case):
        alone, among = (fresh(case, given, sparse_grad=sparse)[0] for _ in range(2))
        for other in leaves_of(case):
            alone[other].requires_grad_(other == name)
        outputs, wanted = (flat(function(case)(**a)) for a in (alone, among))
        wanted = [w for w, out in zip(wanted, outputs, strict=True) if out.requires_grad]
        (got,) = torch.autograd.grad(projection(outputs), alone[name])
        (wanted,) = torch.autograd.grad(projection(wanted), among[name])
        assert got.is_sparse == (sparse and name in tables(case))
        torch.testing.assert_close(got.to_dense(), wanted.to_dense())


@BACKENDS
@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("case", POINTS)
def test_points_that_are_nowhere(case, sparse, backend):
    """What is no number stays at its point; what is infinitely far is at the border."""
    given = CASES[case](50)
    given["points"][3, 1], given["points"][7] = torch.nan, torch.nan
    given["points"][9, 0], given["points"][11] = torch.inf, -torch.inf
    lost = torch.zeros(50, dtype=torch.bool)
    lost[[3, 7]] = True
    with use_backend(backend):
        for out in flat(function(case)(**given)):
            assert torch.equal(out.reshape(50, -1).isnan().any(1), lost)
            assert torch.equal(out.reshape(50, -1).isnan().all(1), lost)
        found = gradients(case, given, sparse_grad=sparse)
    assert all(g.to_dense().isfinite().all() for g in found.values())
    assert not found["points"][[3, 7, 11]].any()


@pytest.mark.parametrize("case", SAMPLERS)
def test_sparse_gradients_accumulate(case):
    given = doubled(CASES[case](20))
    once = gradients(case, given)
    arguments, _ = fresh(case, given, sparse_grad=True)
    for _ in range(2):
        projection(flat(function(case)(**arguments))).backward()
    for name in tables(case):
        torch.testing.assert_close(arguments[name].grad.to_dense(), 2 * once[name])
