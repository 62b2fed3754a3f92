"""Adam on rows: native against reference, against torch.optim."""

import pytest
import torch

from univoxel.ops import adam_rows_, adam_rows_reference_

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


@pytest.mark.parametrize(("lr", "eps"), [(0.1, 1.0), (0.1, 0.0), (0.0, 1.0)])
def test_first_step_in_closed_form(lr, eps):
    """From zero moments the corrected ones are g and g^2: the step is lr g / (|g| + eps)."""
    param, grad = torch.zeros(3, 1).double(), torch.tensor([[4.0], [-2.0]]).double()
    moments = torch.zeros(2, 3, 1).double()
    rows = torch.tensor([2, 0])
    adam_rows_(
        param, *moments.unbind(), rows, grad, **(NUMBERS | {"lr": lr, "eps": eps, "step": 1})
    )
    assert param[:, 0].tolist() == pytest.approx([lr * 2 / (2 + eps), 0.0, -lr * 4 / (4 + eps)])
