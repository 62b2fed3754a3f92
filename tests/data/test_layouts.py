"""One scene in every layout gives the same photographs and the same rays."""

import layouts
import numpy as np
import pytest
import torch
from layouts import FOCAL, HEIGHT, WIDTH, scene, write_colmap, write_nerfstudio
from scipy.spatial.transform import Rotation

from univoxel.camera import image_rays, project
from univoxel.core.records import Mesh
from univoxel.data import load_photos
from univoxel.data.images import write_png
from univoxel.errors import DataError
from univoxel.output.viewpoints import views_of
from univoxel.run import load_world, save_world

LEFT_OUT = "not placed, not enabled or in another component"
# What each is called, and what else is said of it
ABOUT = {
    "nerf": ("NeRF layout", ""),
    "nerfstudio": ("nerfstudio layout", ""),
    "colmap": ("COLMAP model", ""),
    "llff": ("LLFF layout", ""),
    "idr": ("IDR layout (cameras_sphere.npz)", ""),
    "neilf": ("NeILF layout", ""),
    "polycam": ("Polycam raw data", ", world rotated so that +Z is up (was +Y)"),
    "metashape": ("Metashape cameras", f", 1 of 11 cameras left out: {LEFT_OUT}"),
    "realitycapture": ("RealityCapture cameras", ""),
    "tensoir": ("TensoIR layout (rgba_sunset.png)", ""),
}
# Those that are made by structure from motion
TURNED = ("colmap", "nerfstudio", "llff", "idr", "neilf", "metashape", "realitycapture")


def write(layout, folder, written, **options):
    return getattr(layouts, f"write_{layout}")(folder, written, **options)


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("layout", [*ABOUT, "colmap text"])
def test_same_photographs_and_same_rays(tmp_path, layout, split):
    written, options = scene(), {"text": True} if "text" in layout else {}
    layout = layout.split()[0]
    photos = load_photos(write(layout, tmp_path / "data", written, **options), split)
    views = written.split(split)
    assert len(photos) == len(views) == (8 if split == "train" else 2)
    if layout != "tensoir":
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
    kind, remark = ABOUT[layout]
    said = f"{kind}, {len(views)} photographs of 12x8 pixels in {split}{remark}"
    assert photos.about == f"{tmp_path / 'data'}: {said}"


@pytest.mark.parametrize("layout", TURNED)
def test_a_world_in_any_direction_is_turned_upright(tmp_path, layout):
    """Distances between cameras and points stay, and what was up is +Z again."""
    turn = Rotation.from_rotvec([2.0, -0.5, 0.7])
    written = scene()
    photos = load_photos(write(layout, tmp_path, written.turned(turn)))
    assert photos.about.endswith("world rotated so that +Z is up")
    views = written.split("train")
    position = photos.cameras.camera_to_world[:, :, 3]
    wanted = torch.from_numpy(written.poses[views, :3, 3]).float()
    torch.testing.assert_close(position[:, 2], wanted[:, 2], atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.cdist(position, position), torch.cdist(wanted, wanted))
    # The turn comes from all cameras, not from those of the split
    test = load_photos(tmp_path, "test").cameras.camera_to_world[0, :, 3]
    apart = torch.from_numpy(written.poses[1, :3, 3] - written.poses[0, :3, 3]).float()
    torch.testing.assert_close((position[0] - test).norm(), apart.norm())
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
@pytest.mark.parametrize("layout", [*TURNED, "polycam"])
def test_how_the_world_was_moved_is_known(tmp_path, layout, far):
    """A run keeps it, so that cameras in the data's own world fit."""
    written = scene().turned(Rotation.from_rotvec([2.0, -0.5, 0.7]))
    if layout == "polycam":
        written, far = scene(), (0.0, 0.0, 0.0)
    written.poses[:, :3, :3] = Rotation.from_matrix(written.poses[:, :3, :3]).as_matrix()
    written.poses[:, :3, 3] += far
    photos = load_photos(write(layout, tmp_path / "data", written))
    save_world(photos.moved, tmp_path)
    moved = load_world(tmp_path)
    assert moved is not None
    undo = np.linalg.inv(np.concatenate([moved, [[0, 0, 0, 1]]]))
    back = undo[:3, :3] @ photos.cameras.camera_to_world.double().numpy()
    back[:, :, 3] += undo[:3, 3]
    if layout == "polycam":  # whose own world has +Y up
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


@pytest.mark.parametrize("layout", ["llff", "neilf", "metashape"])
def test_sizes_may_be_those_of_larger_originals(tmp_path, layout):
    cameras = load_photos(write(layout, tmp_path, scene(), original=4)).cameras
    assert cameras.focal.unique().tolist() == [FOCAL]
    assert cameras.centre[0].tolist() == [WIDTH / 2, HEIGHT / 2]


def test_worlds_that_stay(tmp_path):
    """One that is nearly upright; one of photographs taken upright and stored lying: their right
    axes are vertical."""
    written = scene().turned(Rotation.from_rotvec([0.4, 0.0, 0.0]))
    photos = load_photos(write_colmap(tmp_path / "nearly", written))
    wanted = torch.from_numpy(written.poses[written.split("train"), :3, 3]).float()
    torch.testing.assert_close(photos.cameras.camera_to_world[:, :, 3], wanted)
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


@pytest.mark.parametrize("layout", ["colmap", "nerfstudio", "llff"])
def test_splits_that_cannot_be_made(tmp_path, layout):
    write(layout, tmp_path / "one", scene(views=1))
    with pytest.raises(DataError, match="one: expected at least two photographs, found 1"):
        load_photos(tmp_path / "one")
    write(layout, tmp_path / "two", scene(views=2))
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
