"""What tests/test_ranks.py has each of its ranks do: prints what it got, as JSON."""

import json

import torch

from univoxel import ranks
from univoxel.training.exchange import summed_over_ranks_


def main() -> None:
    with ranks.joined():
        me = ranks.rank()
        torch.manual_seed(me)
        gathered = ranks.shared(lambda i: (torch.tensor([10 * i]), torch.ones(i, 2)), range(7))
        rows = torch.full((5, 2), -1.0)
        for i in ranks.mine(range(5)):
            rows[i] = i
        ranks.spread_(rows)
        total = ranks.total(torch.tensor([float(me), 0.0]) + ranks.once(torch.tensor([0.0, 7.0])))
        value = torch.tensor([float(me)])
        ranks.as_first_([value])
        drawn = torch.rand(()).item()

        table, net, unused = torch.zeros(6, 2), torch.zeros(3), torch.zeros(2)
        index = torch.tensor([[me, 5]])
        values = torch.full((2, 2), me + 1.0)
        table.grad = torch.sparse_coo_tensor(index, values, table.shape, is_coalesced=True)
        if me < 2:
            net.grad = torch.full((3,), me + 1.0)
        terms = {"a": torch.tensor(me + 1.0)} | ({"b": torch.ones(())} if me == 1 else {})
        summed = summed_over_ranks_([table, net, unused], terms)
        assert net.grad is not None
        got = {
            "gathered": [[part.sum().item() for part in parts] for parts in gathered],
            "spread": rows.tolist(),
            "total": total.tolist(),
            "as_first": value.item(),
            "drawn": drawn,
            "rows": table.grad._indices()[0].tolist(),
            "values": table.grad._values().tolist(),
            "dense": net.grad.tolist(),
            "terms": {name: term.item() for name, term in summed.items()},
            "none": unused.grad,
            "now": ranks.now(),
        }
    print(json.dumps(got))


if __name__ == "__main__":
    main()
