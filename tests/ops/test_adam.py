"""Adam on rows: native against reference, against torch.optim, bad arguments."""

import pytest
import torch

from univoxel.ops import adam_rows_, adam_rows_reference_, use_backend
from univoxel.ops.adam import _adam_rows

NUMBERS = {"lr": 0.1, "beta1": 0.9, "beta2": 0.99, "eps": 1e-3, "step": 3}


def table(rows=50, channels=8, touched=20, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    param, m = torch.randn(2, rows, channels, generator=g)
    v = torch.rand(rows, channels, generator=g)
    index = torch.randperm(rows, generator=g)[:touched]
    grad = torch.randn(touched, channels, generator=g)
    return [param.to(dtype, copy=True), m.to(dtype, copy=True), v.to(dtype), index, grad.to(dtype)]


@pytest.mark.parametrize("size", [(50, 8, 20), (50, 1, 50), (9, 5, 0), (9, 0, 3), (0, 4, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_native_equals_reference(size, dtype):
    mine, wanted = table(*size, dtype=dtype), table(*size)
    adam_rows_(*mine, **NUMBERS)
    adam_rows_reference_(*wanted, **NUMBERS)
    # float32: some ten operations, none of which cancels; double: the same in 2^-53.
    tolerance = {"rtol": 0, "atol": 3e-6 if dtype == torch.float32 else 1e-14}
    for a, b in zip(mine[:3], wanted[:3], strict=True):
        torch.testing.assert_close(a.double(), b, **tolerance)


def test_forced_reference_gives_the_same():
    mine, wanted = table(), table()
    adam_rows_(*mine, **NUMBERS)
    with use_backend("reference"):
        adam_rows_(*wanted, **NUMBERS)
    torch.testing.assert_close(mine, wanted)


def test_other_rows_stay_bit_for_bit():
    arguments = table()
    before = [t.clone() for t in arguments[:3]]
    adam_rows_(*arguments, **NUMBERS)
    rest = torch.ones(50, dtype=torch.bool).index_fill(0, arguments[3], False)
    for a, b in zip(arguments[:3], before, strict=True):
        assert torch.equal(a[rest], b[rest])
        assert not torch.equal(a[~rest], b[~rest])


def test_same_bits_on_any_number_of_threads():
    many, one = table(9000, 8, 7000), table(9000, 8, 7000)
    adam_rows_(*many, **NUMBERS)
    threads = torch.get_num_threads()
    torch.set_num_threads(1 if threads > 1 else 2)
    adam_rows_(*one, **NUMBERS)
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(many, one, strict=True))


def test_first_step_in_closed_form():
    """From zero moments the corrected ones are g and g^2: the step is lr g / (|g| + eps)."""
    param, grad = torch.zeros(3, 1).double(), torch.tensor([[4.0], [-2.0]]).double()
    moments = torch.zeros(2, 3, 1).double()
    rows = torch.tensor([2, 0])
    adam_rows_(param, *moments.unbind(), rows, grad, **(NUMBERS | {"eps": 1.0, "step": 1}))
    assert param[:, 0].tolist() == pytest.approx([0.1 * 2 / 3, 0.0, -0.1 * 4 / 5])


def test_opcheck():
    torch.library.opcheck(_adam_rows.defined, (*table(), *NUMBERS.values()))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"param": [1.0]}, TypeError, "param must be a tensor, got list"),
        ({"param": torch.zeros(8, 50).T}, ValueError, "param must be contiguous, got strides"),
        ({"exp_avg": torch.zeros(50, 7)}, ValueError, r"exp_avg must be \[R, C\] .* C=8"),
        ({"exp_avg_sq": torch.zeros(8, 50).T}, ValueError, "exp_avg_sq must be contiguous"),
        ({"rows": torch.arange(20).int()}, ValueError, "rows must be .* int64"),
        ({"rows": torch.arange(31, 51)}, ValueError, r"rows must lie in \[0, R=50\)"),
        ({"rows": torch.arange(-1, 19)}, ValueError, r"rows must lie in \[0, R=50\)"),
        ({"grad": torch.zeros(19, 8)}, ValueError, r"grad must be \[K, C\] .* K=20"),
        ({"lr": -1.0}, ValueError, "lr must be at least 0, got -1.0"),
        ({"beta1": 1.0}, ValueError, r"beta1 must be in \[0, 1\), got 1.0"),
        ({"beta2": -0.1}, ValueError, r"beta2 must be in \[0, 1\), got -0.1"),
        ({"eps": float("nan")}, ValueError, "eps must be at least 0, got nan"),
        ({"step": 0}, ValueError, "step must be at least 1, got 0"),
    ],
)
def test_bad_arguments(change, error, message):
    names = ("param", "exp_avg", "exp_avg_sq", "rows", "grad")
    arguments = dict(zip(names, table(dtype=torch.float32), strict=True)) | NUMBERS
    adam_rows_(**arguments)
    with pytest.raises(error, match=message):
        adam_rows_(**(arguments | change))
