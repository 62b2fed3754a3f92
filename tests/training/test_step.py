"""A step's gradients, from the parts of its rays."""

import pytest
import torch
from analytic import write_scene

from univoxel.data import load_photos
from univoxel.fields.features import Levels
from univoxel.fields.field import dense_field, hash_field
from univoxel.grid import fit_grid
from univoxel.lights import SGConfig
from univoxel.optim import parameters_of
from univoxel.preparation.hull import mask_distances, visual_hull
from univoxel.scene import Scene, SceneConfig
from univoxel.training.config import LossConfig
from univoxel.training.loop import build_optimizer, descend_, part_terms
from univoxel.training.pixels import split_pixels
from univoxel.training.step import parts_of, total


@pytest.fixture(scope="module")
def pixels(tmp_path_factory):
    photos = load_photos(write_scene(tmp_path_factory.mktemp("step"), views=4, size=32), "train")
    return split_pixels(photos, mask_distances(photos.coverage()))


@pytest.fixture(params=["dense", "hash"])
def scene(request, pixels):
    torch.manual_seed(0)
    grid = fit_grid(torch.full((3,), -1.0), torch.full((3,), 1.0), 4096)
    distance = mask_distances(pixels.photos.coverage())
    sdf = visual_hull(distance, pixels.photos.cameras, grid)
    if request.param == "dense":
        field = dense_field(grid, 4, sdf)
    else:
        field = hash_field(grid, Levels.of(grid.bounds(), grid.voxel_size, 2, 512), sdf)
    torch.nn.init.normal_(field.features)
    light = SGConfig(lobes=4, hidden=16, directions=32)
    sizes = SceneConfig(channels=4, material_channels=2, hidden=16, light=light)
    return Scene(sizes, field, 2 / grid.voxel_size).train()


def gradients(scene, pixels, parts, threads):
    parameters = parameters_of(build_optimizer(scene, False))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with scene.surface_held():
            terms = descend_(scene, LossConfig(), pixels, parts, True, parameters)
    finally:
        torch.set_num_threads(before)
    return terms, [p.grad for p in parameters if p.grad is not None]


def test_they_are_the_gradients_of_the_whole_loss(scene, pixels):
    parts = parts_of(pixels.trained, 301, 2)
    terms, got = gradients(scene, pixels, parts, 2)
    parameters = [p for p in scene.parameters() if p.grad is not None]
    loss = sum(
        part.share * sum(part_terms(scene, LossConfig(), pixels.photos, part, True).values())
        for part in parts
    )
    wanted = torch.autograd.grad(loss, parameters)
    torch.testing.assert_close(sum(terms.values()), loss.detach())
    by_parameter = {id(p): p.grad for p in parameters}
    assert len(by_parameter) == len(got)
    for parameter, gradient in zip(parameters, wanted, strict=True):
        given = by_parameter[id(parameter)].to_dense()
        # Sums in another order, in float32
        torch.testing.assert_close(given, gradient.to_dense(), rtol=1e-4, atol=1e-7)


def test_bits_do_not_depend_on_threads(scene, pixels):
    parts = parts_of(pixels.trained, 600, 1)
    found = []
    for threads in (1, 2):
        terms, grads = gradients(scene, pixels, parts, threads)
        found.append([*terms.values(), *(g.to_dense() for g in grads)])
    for one, two in zip(*found, strict=True):
        assert torch.equal(one, two)


def test_what_is_frozen_keeps_no_gradient_of_before(scene, pixels):
    parts = parts_of(pixels.trained, 64, 1)
    gradients(scene, pixels, parts, 1)
    assert scene.material.net[0].weight.grad is not None
    parameters = parameters_of(build_optimizer(scene, refit=True))
    with scene.surface_held():
        descend_(scene, LossConfig(), pixels, parts, True, parameters)
    assert scene.material.net[0].weight.grad is None


def test_parts_share_out_the_rays(pixels):
    parts = parts_of(pixels.trained, 301, 2)
    assert sum(len(p.pixels) for p in parts) == 301
    assert sum(p.share for p in parts) == pytest.approx(1)
    assert len({p.seed for p in parts}) == 2
    (alone,) = parts_of(pixels.trained, 1, 2)
    assert alone.share == 1


def test_gradients_that_are_missing_count_as_none():
    one = torch.ones(3)
    assert total([None, None]) is None
    assert total([None, one]) is one
    assert torch.equal(total([one, one, one]), 3 * one)
