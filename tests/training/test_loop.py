"""The training loop's losses, and the sharpness that it ends with."""

import copy
import json
import math
import time
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from analytic import write_scene
from op_cases import same_on_threads
from plain import plain_stage, plain_training, small_scene

from univoxel.cli.trainer import train
from univoxel.config import LossConfig
from univoxel.data import load_photos
from univoxel.fields.field import Levels, dense_field, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.lights.base import Regularisation
from univoxel.preparation.hull import mask_distances, visual_hull
from univoxel.render.pipeline import surface_at
from univoxel.scene import Scene
from univoxel.training import loop, progress
from univoxel.training.loop import add_gradient_, batch_at, light_priors, losses_of
from univoxel.training.pixels import TrainingPixels, split_pixels
from univoxel.training.progress import Progress

STAGE = plain_stage(voxels=0.004, iterations=3, share=1.0, rays=600, physical_from=0.0)


def test_every_term_of_a_light_has_its_own_weight():
    names = [f.name for f in fields(Regularisation)]
    weight = LossConfig(**{name: float(2 + i) for i, name in enumerate(names)})
    prior = Regularisation(**{name: torch.tensor(10.0) for name in names})
    assert light_priors(prior, weight) == {name: 10.0 * (2 + i) for i, name in enumerate(names)}
    assert light_priors(Regularisation(white_light=torch.tensor(1.0)), weight).keys() == {
        "white_light"
    }


@pytest.fixture(scope="module")
def pixels(tmp_path_factory):
    photos = load_photos(write_scene(tmp_path_factory.mktemp("loop") / "data", 4, 32), "train")
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
    return Scene(small_scene(), field, 2 / grid.voxel_size).train()


def test_what_is_read_beside_the_surface_adds_its_gradient(scene, pixels):
    features, found = scene.field.features, []
    batch = batch_at(pixels.photos, pixels.trained[:300])
    for beside in (None, features.detach().requires_grad_()):
        features.grad = None
        with scene.surface_held():
            surface, draw = surface_at(scene, batch.rays), torch.Generator().manual_seed(1)
            terms = losses_of(scene, LossConfig(), surface, batch, True, draw, beside)
            sum(terms.values()).backward()
        if beside is not None:
            add_gradient_(features, beside.grad)
        found.append(features.grad.to_dense())
    # Sums in another order, in float32
    torch.testing.assert_close(found[1], found[0], rtol=1e-4, atol=1e-7)


def test_bits_do_not_depend_on_threads(scene, pixels, tmp_path):
    cfg = plain_training(Path("data"), tmp_path, (STAGE,))

    def trained():
        torch.manual_seed(0)
        copied = copy.deepcopy(scene)
        loop.run_stage(copied, cfg, STAGE, pixels, Progress(cfg, time.monotonic(), {}))
        return [p.detach() for p in (copied.field.sdf, *copied.parameters())]

    assert not torch.equal(same_on_threads(trained, (1, 2))[0], scene.field.sdf)


@pytest.mark.parametrize("best", [0.7, 1.0, 1.4])
def test_the_density_ends_as_sharp_as_held_out_pixels_want_it(monkeypatch, best):
    scene, asked = SimpleNamespace(inv_s=10.0), []

    def quality(scene, photos, pixels, physical):
        assert physical
        asked.append(scene.inv_s)
        return -abs(math.log(scene.inv_s / (10.0 * best)))

    monkeypatch.setattr(loop, "held_out_psnr", quality)
    loop.fit_sharpness_(scene, TrainingPixels(None, None, None))
    assert scene.inv_s == pytest.approx(10.0 * best)
    assert min(asked) < 10 < max(asked)


def test_masks_whose_edges_were_moved_do_not_tell_how_sharp_the_density_is(monkeypatch):
    scene = SimpleNamespace(inv_s=10.0)
    monkeypatch.setattr(loop, "held_out_psnr", lambda scene, *_, **__: scene.inv_s)
    loop.fit_sharpness_(scene, TrainingPixels(None, None, None, edges_given=False))
    assert scene.inv_s == 10.0
    loop.fit_sharpness_(scene, TrainingPixels(None, None, None))
    assert scene.inv_s == 20.0


def test_patches_are_compared_in_every_second_step_and_told_in_all(data, tmp_path, monkeypatch):
    compared = []

    def disagreement(scene, brightness, cameras, surface, *_):
        compared.append(len(surface.depth))
        return 0.5 + 0 * surface.depth.sum()

    monkeypatch.setattr(loop.patches, "disagreement", disagreement)
    monkeypatch.setattr(progress, "REPORT_SECONDS", -1.0)
    stage = plain_stage(voxels=0.01, iterations=20, share=1.0, rays=64, patches_from=0.42)
    cfg = plain_training(
        data, tmp_path / "run", (stage,), minutes=2.0, scene=small_scene(sky_nodes=0)
    )
    train(cfg)
    assert len(compared) == 5
    lines = [json.loads(line) for line in (cfg.out / "log.jsonl").read_text().splitlines()]
    told = [line["losses"].get("patches") for line in lines]
    assert told == [None] * 10 + [pytest.approx(0.5 * cfg.loss.patches)] * 10
