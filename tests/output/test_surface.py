"""The surface that meshes are made of: no crumbs, no holes but its own, smooth where it is a
guess."""

import logging

import numpy as np
import pytest
import torch
from analytic import cameras_around
from asymmetric_scene import lopsided
from glb import Glb
from torch.nn.functional import normalize

from univoxel.cli.export import export
from univoxel.core.records import Mesh
from univoxel.fields.field import dense_field
from univoxel.fields.grid import GridShape
from univoxel.output.mesh import bake, with_materials
from univoxel.output.surface import cameras_of, seen_by, smoothed, surface_of
from univoxel.output.topology import open_edges, simplify

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("pygltflib")


def read(mesh):
    return trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False)


def ball(nodes, x, y, z, radius):
    return (nodes - torch.tensor([x, y, z])).norm(dim=-1) - radius


def cameras_above(ring):
    """Those of a ring that look down: nothing of an underside is theirs."""
    return ring.of((ring.camera_to_world[:, 2, 3] > 1.5).nonzero()[:, 0])


def test_crumbs_go_and_a_small_part_stays(caplog):
    """A second part of 3 % of the first one's area stays; a crumb of 0.3 %, and a hollow, go."""

    def change(nodes, sdf):
        first = torch.maximum(ball(nodes, 0, 0, 0, 0.4), -ball(nodes, 0, 0, 0, 0.1))
        second = ball(nodes, 0.5, 0.3, 0.5, 0.03**0.5 * 0.4)
        return first.minimum(second).minimum(ball(nodes, 0.55, -0.4, 0.5, 0.003**0.5 * 0.4))

    caplog.set_level(logging.INFO, logger="univoxel")
    parts = read(surface_of(lopsided(64**3, change))).split()
    assert len(parts) == 2
    areas = sorted(part.area for part in parts)
    assert areas[0] / areas[1] == pytest.approx(0.03, rel=0.1)
    assert "1 small pieces beside the object and 1 hollows inside it" in caplog.text


@pytest.mark.parametrize("cut", [False, True])
def test_a_torus_keeps_its_hole(cut):
    """Whole, and where the box cuts it in half and the ends are closed: a bow without a hole."""

    def change(nodes, sdf):
        x, y, z = (nodes - torch.tensor([-0.5 if cut else 0.075, 0.0, 0.075])).unbind(-1)
        ring = torch.stack([torch.stack([x, y], -1).norm(dim=-1) - 0.3, z], -1)
        return ring.norm(dim=-1) - 0.12

    scene = lopsided(change=change)
    mesh = surface_of(scene)
    assert open_edges(mesh) == 0
    assert read(mesh).euler_number == (2 if cut else 0)
    assert (open_edges(Mesh(*scene.field.isosurface())) > 0) == cut


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_bricks_are_closed_as_the_dense_grid_is(axis, side):
    """On each face of a grid of more planes than are looked at together."""
    grid = GridShape((-0.7,) * 3, 1.4 / 71, (72, 72, 72))
    middle = torch.zeros(3)
    middle[axis] = 0.6 * side
    dense = dense_field(grid, 1, (grid.nodes() - middle).norm(dim=-1) - 0.4)
    wanted = Mesh(*dense.isosurface(closed=True))
    found = Mesh(*dense.in_bricks(grid).isosurface(closed=True))
    assert open_edges(Mesh(*dense.isosurface())) > 0
    assert open_edges(wanted) == open_edges(found) == 0
    assert len(found.faces) == len(wanted.faces)
    # The ball's cap beyond the plane 0.1 from its middle is missing, but for what bulges out
    height = 0.3
    missing = torch.pi * height**2 * (3 * 0.4 - height) / 3
    volume = 4 / 3 * torch.pi * 0.4**3 - missing
    assert read(found).volume == pytest.approx(volume, abs=0.47 * grid.voxel_size)
    assert read(wanted).volume == pytest.approx(read(found).volume, abs=1e-3)


@pytest.fixture(scope="module")
def rough():
    """A ball that is rough all over, with waves some five voxels long: a third of a voxel high
    above, and a whole one below."""

    def change(nodes, sdf):
        waves = (nodes * 60).sin().prod(-1)
        height = torch.where(nodes[..., 2] < -0.1, 0.024, 0.008)
        return ball(nodes, 0.075, 0, 0.075, 0.4) + height * waves

    return lopsided(change=change)


@pytest.fixture(scope="module")
def above():
    return cameras_above(cameras_around(24, 64, 2.5))


def test_without_photographs_nothing_is_smoothed(balls, tmp_path, caplog):
    """And a whole surface is not moved where it is closed."""
    caplog.set_level(logging.INFO, logger="univoxel")
    assert cameras_of(balls, tmp_path) is None
    assert "mesh: not smoothed" in caplog.text
    assert surface_of(balls, None).seen is None
    for a, b in zip(balls.field.isosurface(), balls.field.isosurface(closed=True), strict=True):
        assert torch.equal(a, b)


def test_what_no_camera_sees_is_smooth_and_the_rest_is_as_it_was(rough, above):
    before, after = surface_of(rough), surface_of(rough, above)
    assert len(above) > 3
    assert torch.equal(before.faces, after.faces)
    assert open_edges(after) == 0
    middle = torch.tensor([0.075, 0, 0.075])
    way = normalize(before.vertices - middle, dim=1)
    under, over = way[:, 2] < -0.85, way[:, 2] > 0.3
    assert torch.equal(after.vertices[over], before.vertices[over])
    assert after.seen[over].min() == 1
    assert after.seen[under].max() < 0.05
    between = (after.seen > 0.05) & (after.seen < 0.95)
    assert between.sum() > 50  # the border is soft
    uneven = [(m.vertices - middle).norm(dim=1)[under].std() for m in (before, after)]
    assert uneven[1] < 0.4 * uneven[0]
    moved = (after.vertices - before.vertices).norm(dim=1)
    assert moved.max() <= 1.5 * rough.field.voxel_size * (1 + 1e-5)


def test_single_vertices_count_as_those_around_them():
    mesh = surface_of(lopsided(24**3))
    seen = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    seen[100] = True
    assert smoothed(mesh, seen, 1.0).seen.max() < 0.5
    assert smoothed(mesh, ~seen, 1.0).seen.min() == 1


def test_seen_is_what_a_camera_faces_with_nothing_between():
    """Of two balls above one another the upper one throws a shadow on the lower one."""

    def change(nodes, sdf):
        return ball(nodes, 0.075, 0, 0.45, 0.18).minimum(ball(nodes, 0.075, 0, -0.05, 0.2))

    scene = lopsided(change=change)
    mesh = surface_of(scene)
    ring = cameras_around(60, 64, 2.5)
    top = int(ring.camera_to_world[:, 2, 3].argmax())
    eye = ring.camera_to_world[top, :, 3]
    seen = seen_by(mesh, ring.of(torch.tensor([top])), scene.field.voxel_size)
    up = mesh.vertices[:, 2]
    assert seen[up > 0.6].all()
    assert not seen[(up < 0.33) & (up > 0.2)].any()  # below its own horizon
    lower = mesh.vertices[up < 0.2]
    way = normalize(eye - lower, dim=1)
    past = torch.linalg.cross(torch.tensor([0.075, 0, 0.45]) - lower, way).norm(dim=1)
    facing = ((lower - torch.tensor([0.075, 0, -0.05])) * way).sum(1) / 0.2
    assert 50 < ((past < 0.16) & (facing > 0.3)).sum()
    assert not seen[up < 0.2][past < 0.16].any()
    assert 50 < ((past > 0.2) & (facing > 0.3)).sum()
    assert seen[up < 0.2][(past > 0.2) & (facing > 0.3)].all()


def test_normals_and_relief_are_smooth_there_too(rough, above):
    mesh = simplify(surface_of(rough, above), 2000)
    under = mesh.vertices[:, 2] < -0.25
    assert mesh.seen[under].max() < 0.05
    way = normalize(mesh.vertices - torch.tensor([0.075, 0, 0.075]), dim=1)
    flat = with_materials(rough, Mesh(mesh.vertices, mesh.faces))  # as if nothing were known
    lean = [((m.normals * way).sum(1)[under]).mean() for m in (flat, with_materials(rough, mesh))]
    assert lean[0] < 0.95
    assert lean[1] > 0.99
    textured = [bake(rough, m, 128) for m in (Mesh(mesh.vertices, mesh.faces), mesh)]
    assert textured[1].seen.shape == (len(textured[1].vertices),)
    without, share = ((t.relief[..., 2] > 0.9999).float().mean() for t in textured)
    assert without < 0.05
    assert share > without + 0.5 * (mesh.seen == 0).float().mean()


def test_files_say_what_is_seen(rough, above, tmp_path, monkeypatch):
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: rough)
    monkeypatch.setattr("univoxel.output.surface.cameras_of", lambda scene, run: above)
    for name in ("a.glb", "a.ply"):
        export("run", tmp_path / name, faces=1000, texture_size=64, size=2.0)
    cloud = trimesh.load(tmp_path / "a.ply", process=False)
    values = cloud.metadata["_ply_raw"]["vertex"]["data"]["seen"].ravel()
    check_seen(values, cloud.vertices[:, 2])
    file = Glb(tmp_path / "a.glb")
    assert file.accessor("_SEEN").type == "SCALAR"
    values = file.values("_SEEN")
    assert values.dtype == np.float32
    check_seen(values[:, 0], file.values("POSITION")[:, 1])  # +Y is up in glTF


def check_seen(values, height):
    low, high = height.min(), height.max()
    assert values.min() == 0
    assert values.max() == 1
    assert (values[height > low + 0.6 * (high - low)] == 1).all()
    assert values[height < low + 0.06 * (high - low)].max() < 0.05
