"""One scene in every layout gives the same photographs and the same rays."""

import numpy as np
import pytest
import torch
from layouts import (
    FOCAL,
    HEIGHT,
    WIDTH,
    scene,
    write_colmap,
    write_idr,
    write_llff,
    write_metashape,
    write_neilf,
    write_nerf,
    write_nerfstudio,
    write_polycam,
    write_realitycapture,
    write_tensoir,
)
from scipy.spatial.transform import Rotation

from univoxel.camera import image_rays, project
from univoxel.core.records import Mesh
from univoxel.data import load_photos
from univoxel.data.images import write_png
from univoxel.errors import DataError
from univoxel.output.viewpoints import views_of
from univoxel.run import load_world, save_world

WRITERS = {
    "NeRF layout": write_nerf,
    "nerfstudio layout": write_nerfstudio,
    "COLMAP model": write_colmap,
    "COLMAP text": lambda folder, s: write_colmap(folder, s, text=True),
    "LLFF layout": write_llff,
    "IDR layout (cameras_sphere.npz)": write_idr,
    "NeILF layout": write_neilf,
    "Polycam raw data": write_polycam,
    "Metashape cameras": write_metashape,
    "RealityCapture cameras": write_realitycapture,
    "TensoIR layout (rgba_sunset.png)": write_tensoir,
}
REMARKS = {
    "Polycam raw data": ", world rotated so that +Z is up (was +Y)",
    "Metashape cameras": (
        ", 1 of 11 cameras left out: not placed, not enabled or in another component"
    ),
}
# Those that are made by structure from motion
TURNED = (write_colmap, write_nerfstudio, write_llff, write_idr, write_neilf, write_metashape)
TURNED += (write_realitycapture,)


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("layout", WRITERS)
def test_same_photographs_and_same_rays(tmp_path, layout, split):
    written = scene()
    photos = load_photos(WRITERS[layout](tmp_path / "data", written), split)
    views = written.split(split)
    assert len(photos) == len(views) == (8 if split == "train" else 2)
    if "TensoIR" not in layout:
        assert photos.names == [written.names[v] for v in views]
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    local = np.stack([(column - WIDTH / 2) / FOCAL, (HEIGHT / 2 - row) / FOCAL, -1 + 0 * row], -1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    for i, v in enumerate(views):
        assert np.array_equal(photos.color[i].numpy(), written.pictures[v, ..., :3])
        assert np.array_equal(photos.alpha[i].numpy(), written.pictures[v, ..., 3])
        rays = image_rays(photos.cameras, i)
        wanted = (local @ written.poses[v, :3, :3].T).reshape(-1, 3)
        # Cameras are kept in float32
        np.testing.assert_allclose(rays.direction, wanted, atol=1e-6)
        np.testing.assert_allclose(rays.origin[0], written.poses[v, :3, 3], atol=1e-6)
    kind = layout.replace("COLMAP text", "COLMAP model")
    assert photos.about == (
        f"{tmp_path / 'data'}: {kind}, {len(views)} photographs of 12x8 pixels in {split}"
        f"{REMARKS.get(layout, '')}"
    )


@pytest.mark.parametrize("writer", TURNED)
def test_a_world_in_any_direction_is_turned_upright(tmp_path, writer):
    """Distances between cameras and points stay, and what was up is +Z again."""
    turn = Rotation.from_rotvec([2.0, -0.5, 0.7])
    written = scene()
    photos = load_photos(writer(tmp_path, written.turned(turn)))
    assert photos.about.endswith("world rotated so that +Z is up")
    views = written.split("train")
    position = photos.cameras.camera_to_world[:, :, 3]
    wanted = torch.from_numpy(written.poses[views, :3, 3]).float()
    torch.testing.assert_close(position[:, 2], wanted[:, 2], atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.cdist(position, position), torch.cdist(wanted, wanted))
    # A point that all cameras see stays where it was in their pictures
    point = turn.apply([0.1, -0.2, 0.3])
    up = turn.apply([0.0, 0.0, 1.0])
    back, _ = Rotation.align_vectors([[0, 0, 1]], [up])  # the smallest turn
    for i, v in enumerate(views):
        pixel, _ = project(photos.cameras, i, torch.from_numpy(back.apply(point)[None]).float())
        local = np.linalg.inv(written.poses[v]) @ [0.1, -0.2, 0.3, 1]
        wanted = FOCAL * local[:2] / -local[2] * [1, -1] + [WIDTH / 2, HEIGHT / 2]
        np.testing.assert_allclose(pixel[0], wanted, atol=1e-4)


@pytest.mark.parametrize("far", [(0.0, 0.0, 0.0), (391234.5, 5.82e6, 34.0)], ids=["near", "far"])
@pytest.mark.parametrize("writer", [*TURNED, write_polycam])
def test_how_the_world_was_moved_is_known(tmp_path, writer, far):
    """A run keeps it, so that cameras in the data's own world fit."""
    written = scene().turned(Rotation.from_rotvec([2.0, -0.5, 0.7]))
    if writer is write_polycam:
        written, far = scene(), (0.0, 0.0, 0.0)
    written.poses[:, :3, :3] = Rotation.from_matrix(written.poses[:, :3, :3]).as_matrix()
    written.poses[:, :3, 3] += far
    photos = load_photos(writer(tmp_path / "data", written))
    save_world(photos.moved, tmp_path)
    moved = load_world(tmp_path)
    assert moved is not None
    undo = np.linalg.inv(np.concatenate([moved, [[0, 0, 0, 1]]]))
    back = undo[:3, :3] @ photos.cameras.camera_to_world.double().numpy()
    back[:, :, 3] += undo[:3, 3]
    if writer is write_polycam:  # whose own world has +Y up
        back = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ back
    np.testing.assert_allclose(back, written.poses[written.split("train"), :3], atol=2e-6)


@pytest.mark.parametrize("far", [0.0, 5.82e6])
def test_cameras_in_the_data_s_own_world_fit(tmp_path, far):
    """A path is given in it, to a run that was trained in one with +Z up."""
    written = scene().turned(Rotation.from_rotvec([2.0, -0.5, 0.7]))
    written.poses[:, 0, 3] += far
    photos = load_photos(write_nerfstudio(tmp_path / "data", written))
    save_world(photos.moved, tmp_path)
    path, mesh = tmp_path / "data/transforms.json", Mesh(torch.zeros(3, 3), torch.zeros(1, 3).int())
    names, cameras = views_of(tmp_path, path, None, 0.0, mesh)
    chosen = cameras.camera_to_world[[names.index(name) for name in photos.names]]
    torch.testing.assert_close(chosen, photos.cameras.camera_to_world, atol=1e-6, rtol=0)
    save_world(None, tmp_path)  # a world that was not moved
    names, cameras = views_of(tmp_path, path, None, 0.0, mesh)
    wanted = torch.from_numpy(written.poses[[written.names.index(n) for n in names], :3]).float()
    torch.testing.assert_close(cameras.camera_to_world, wanted)


@pytest.mark.parametrize("writer", [write_llff, write_neilf, write_metashape])
def test_sizes_may_be_those_of_larger_originals(tmp_path, writer):
    cameras = load_photos(writer(tmp_path, scene(), original=4)).cameras
    assert cameras.focal.unique().tolist() == [FOCAL]
    assert cameras.centre[0].tolist() == [WIDTH / 2, HEIGHT / 2]


def test_train_and_test_share_the_turn(tmp_path):
    """The turn comes from all cameras, not from those of the split."""
    written = scene()
    tilted = written.turned(Rotation.from_rotvec([1.5, 0.0, 0.0]))
    write_colmap(tmp_path, tilted)
    found = [load_photos(tmp_path, s).cameras.camera_to_world[0, :, 3] for s in ("train", "test")]
    train, test = (torch.from_numpy(tilted.poses[v, :3, 3]).float() for v in (1, 0))
    torch.testing.assert_close((found[0] - found[1]).norm(), (train - test).norm())


def test_a_world_that_is_nearly_upright_stays(tmp_path):
    written = scene().turned(Rotation.from_rotvec([0.4, 0.0, 0.0]))
    photos = load_photos(write_colmap(tmp_path, written))
    wanted = torch.from_numpy(written.poses[written.split("train"), :3, 3]).float()
    torch.testing.assert_close(photos.cameras.camera_to_world[:, :, 3], wanted)


def test_cameras_on_their_side_do_not_say_what_is_up(tmp_path):
    """Photographs taken upright and stored lying: their right axes are vertical."""
    written = scene()
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]
    lying = written.poses @ turn
    photos = load_photos(write_colmap(tmp_path, type(written)(lying, written.pictures)))
    assert photos.about.endswith(
        "world not rotated, because the cameras do not show which way is up"
    )
    wanted = torch.from_numpy(lying[written.split("train"), :3, 3]).float()
    torch.testing.assert_close(photos.cameras.camera_to_world[:, :, 3], wanted)


@pytest.mark.parametrize("writer", [write_colmap, write_nerfstudio, write_llff])
def test_splits_that_cannot_be_made(tmp_path, writer):
    writer(tmp_path / "one", scene(views=1))
    with pytest.raises(DataError, match="one: expected at least two photographs, found 1"):
        load_photos(tmp_path / "one")
    writer(tmp_path / "two", scene(views=2))
    with pytest.raises(DataError, match="two: expected train or test as the split, got val"):
        load_photos(tmp_path / "two", "val")
    assert load_photos(tmp_path / "two", "test").names == ["p_000"]


def test_masks_may_be_alpha_too(tmp_path):
    written = scene()
    write_colmap(tmp_path, written)
    for v, name in enumerate(written.names):
        (tmp_path / "masks" / f"{name}.png.png").unlink()
        if v % 2:  # or a mask under the photograph's name with its ending replaced
            write_png(tmp_path / "masks" / f"{name}.png", written.pictures[v, ..., 3])
        else:
            write_png(tmp_path / "images" / f"{name}.png", written.pictures[v])
    photos = load_photos(tmp_path)
    views = written.split("train")
    assert np.array_equal(photos.alpha.numpy(), written.pictures[views, ..., 3])
