"""A training loop of your own on univoxel's ops: a ball's shape and colour from its pictures."""

import torch

from univoxel.ops import brick_minimum, composite, march, sample_dense, section_alpha
from univoxel.optim import RowAdam

torch.manual_seed(0)
NODES, ORIGIN, VOXEL = 64, (-1.0, -1.0, -1.0), 2 / 63
RADIUS, INV_S, RAYS = 0.5, 40.0, 2048


def ball_rays(count: int):
    """Rays from all around, what they see of a ball (normals as colours), and whether they hit."""
    origin = 3 * torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    aim = torch.rand(count, 3) * 1.6 - 0.8
    direction = torch.nn.functional.normalize(aim - origin, dim=-1)
    along = (origin * direction).sum(-1)
    inside = along**2 - (origin**2).sum(-1) + RADIUS**2
    point = origin + (-along - inside.clamp_min(0).sqrt())[:, None] * direction
    color = (point / RADIUS * 0.5 + 0.5) * (inside > 0)[:, None]
    return origin, direction, color, (inside > 0).float()


axis = torch.linspace(-1, 1, NODES)
grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
sdf = (grid.norm(dim=-1) - 0.7).requires_grad_()  # a ball too large
color = torch.zeros(NODES, NODES, NODES, 3).requires_grad_()
optimizer = RowAdam([{"params": [sdf], "lr": 5e-3}, {"params": [color], "lr": 0.1}], eps=1e-7)

for step in range(301):
    origin, direction, target, hit = ball_rays(RAYS)
    with torch.no_grad():
        bricks = brick_minimum(sdf)
        samples = march(
            sdf, bricks, origin, direction, torch.rand(RAYS), ORIGIN, VOXEL, step=VOXEL, inv_s=INV_S
        )
        ray = torch.repeat_interleave(samples.offsets.diff())
        points = origin[ray] + samples.t[:, None] * direction[ray]
    distance, _, feature = sample_dense(sdf, color, points, ORIGIN, VOXEL, sparse_grad=True)
    alpha = section_alpha(distance, samples.connected, INV_S)
    value = torch.cat([feature.sigmoid(), torch.ones_like(feature[:, :1])], -1)
    out, _ = composite(alpha, value, samples.offsets)
    loss = (out - torch.cat([target, hit[:, None]], -1)).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 50 == 0:
        volume = (sdf.detach() < 0).float().mean() * 8  # the box holds 2^3
        radius = (volume * 3 / (4 * torch.pi)) ** (1 / 3)
        print(f"step {step:3d}   loss {loss.item():.5f}   radius {radius:.3f}, truth {RADIUS}")
