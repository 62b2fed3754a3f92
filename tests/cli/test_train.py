"""The whole street on an analytic sphere, in seconds."""

import dataclasses
import json
from types import SimpleNamespace

import pytest
import torch
from analytic import LIGHTS, RADIUS, photos_of, sphere_scene, write_scene
from layouts import Scene, write_colmap
from plain import interrupt_second_stage, plain_stage, plain_training, small_scene
from scipy import ndimage
from scipy.spatial.transform import Rotation

from univoxel.cli import main
from univoxel.cli import trainer as task
from univoxel.cli.info import info
from univoxel.cli.trainer import train
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.config import TrainConfig, save_config
from univoxel.data import load_photos
from univoxel.data.images import read_image, write_png
from univoxel.preparation import prepare as preparation
from univoxel.presets import with_field
from univoxel.render.pipeline import extract_mesh
from univoxel.run import load_verdict
from univoxel.run import photos_of as photos_of_run
from univoxel.scene import FILE, load_scene
from univoxel.training import clock, descent, loop
from univoxel.training.pixels import split_pixels


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("sphere") / "data")


def config(data, out, **changes) -> TrainConfig:
    stages = (
        plain_stage(voxels=0.01, iterations=60, share=0.5, rays=256),
        plain_stage(voxels=0.03, iterations=80, share=0.5, rays=256, physical_from=0.0),
    )
    cfg = plain_training(data, out, stages, minutes=2.0, scene=small_scene())
    # The pictures are 32 pixels wide
    return dataclasses.replace(cfg, **{"voxel_pixels": 0.0} | changes)


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return train(config(data, tmp_path_factory.mktemp("sphere") / "run"))


def test_a_run_folder_holds_what_is_promised(run):
    """The sphere, and its sides by their albedo."""
    assert {"config.json", FILE, "preview.png"} <= {p.name for p in run.iterdir()}
    assert json.loads((run / "config.json").read_text())["stages"][1]["rays"] == 256
    scene = load_scene(run)
    table = scene.radiance.directions  # every level of the mirrored directions is learned
    assert table.table.view(table.levels, -1).any(1).tolist() == [True] * 5
    mesh = extract_mesh(scene)
    red, blue = mesh.vertices[:, 0] > 0.2, mesh.vertices[:, 0] < -0.2
    assert mesh.albedo[red].mean(0).argmax() == 0
    assert mesh.albedo[blue].mean(0).argmax() == 2
    away = mesh.vertices.norm(dim=1) - RADIUS
    assert away.abs().mean() < 0.03  # a pixel of these photographs is 0.056 wide at the sphere


def test_the_physical_render_learns_the_photographs(run, data):
    photos = load_photos(data, "test")
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(32), torch.arange(32))
    psnr = loop.held_out_psnr(load_scene(run).eval(), photos, pixels, physical=True)
    assert psnr > 20  # black gives 9 dB, the right sphere in one mean colour 16


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_every_light_learns_the_photographs(data, tmp_path, light):
    cfg = config(data, tmp_path / "run")
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, light=light, sky_nodes=0))
    scene = load_scene(train(cfg))
    photos = load_photos(data, "test")
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(32), torch.arange(32))
    psnr = loop.held_out_psnr(scene, photos, pixels, physical=True)
    assert psnr > 18  # black gives 9 dB, the right sphere in one mean colour 16


def test_grids_of_a_training_are_no_finer_than_its_photographs(data, tmp_path, monkeypatch):
    monkeypatch.setattr(task, "run_stage", lambda *_: None)
    scene = load_scene(train(config(data, tmp_path / "run", voxel_pixels=1.2)))
    assert scene.field.voxel_size == pytest.approx(1.2 * 1.8 / 32, rel=0.05)  # cameras differ


@pytest.mark.parametrize(
    ("masks", "wide", "said"),
    [
        ("auto", True, "masks extend 3 pixels past the object's edge: they are eroded\n"),
        ("given", True, "masks extend 3 pixels past the object's edge: masks=auto erodes them\n"),
        ("auto", False, None),
    ],
)
def test_masks_that_are_too_wide_are_taken_in(tmp_path, monkeypatch, caplog, masks, wide, said):
    """What training starts with is as large as the ball, or larger by 3 pixels of 0.028."""
    folder = write_scene(tmp_path / "data", size=64)
    grey = 0.2
    for path in sorted((folder / "train").glob("*.png")):
        rgba = read_image(path).float() / 255
        color = linear_to_srgb(
            srgb_to_linear(rgba[..., :3]) * rgba[..., 3:] + grey * (1 - rgba[..., 3:])
        )
        y, x = torch.meshgrid(torch.arange(-3, 4), torch.arange(-3, 4), indexing="ij")
        disc = (x * x + y * y <= 9).numpy()
        alpha = (
            ndimage.grey_dilation(rgba[..., 3].numpy(), footprint=disc) if wide else rgba[..., 3]
        )
        both = torch.cat([color, torch.as_tensor(alpha)[..., None]], -1)
        write_png(path, (255 * both).round().byte().numpy())
    trusted = []
    monkeypatch.setattr(task, "run_stage", lambda *_: None)
    fit = lambda _, pixels: trusted.append(pixels.edges_given)  # noqa: E731
    monkeypatch.setattr(task, "fit_sharpness_", fit)
    cfg = config(folder, tmp_path / "run", masks=masks)
    caplog.set_level("INFO", "univoxel")
    away = extract_mesh(load_scene(train(cfg))).vertices.norm(dim=1).mean()
    larger = 3 * 0.028 * (wide and masks == "given")
    assert away == pytest.approx(RADIUS + larger, abs=0.02)
    assert said in caplog.text if said else "past the object's edge" not in caplog.text
    assert trusted == [not (wide and masks == "auto")]


@pytest.mark.parametrize(
    ("seconds", "varying", "wanted"),
    [(60.0, "none", 60.0), (60.0, "exposure", 60.0), (60.0, "light", None), (0.0, "none", None)],
)
def test_hollows_are_opened_where_light_is_the_same(
    data, tmp_path, monkeypatch, seconds, varying, wanted
):
    """What training starts with is what carving makes of the hull."""
    given = []

    def larger(hull, grid, photos, gains, seconds):
        given.append(seconds)
        return hull + 0.25

    monkeypatch.setattr(task, "run_stage", lambda *_: None)
    monkeypatch.setattr(preparation, "carve_within_time", larger)
    cfg = config(data, tmp_path / "run", carving_seconds=seconds)
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, varying=varying))
    away = extract_mesh(load_scene(train(cfg))).vertices.norm(dim=1)
    asked = wanted is not None
    assert given == [wanted] * asked
    assert away.mean() == pytest.approx(RADIUS - 0.25 * asked, abs=0.03)  # half a voxel


def test_a_gradient_spreads_over_the_nodes_that_it_touches():
    field = sphere_scene(0, voxel_size=0.1).field
    x, y, z = torch.cartesian_prod(*[torch.arange(2, 7)] * 3).unbind(1)
    rows = torch.stack([x, y, z])
    values = torch.zeros(rows.shape[1])
    middle = (rows == 4).all(0)
    values[middle] = 1.0
    grad = torch.sparse_coo_tensor(rows, values, field.sdf.shape, check_invariants=True)
    field.sdf.grad = grad.coalesce()
    descent.smooth_sdf_gradient_(field, 2)
    spread = field.sdf.grad.to_dense()
    beside = [spread[3, 4, 4], spread[5, 4, 4], spread[4, 3, 4], spread[4, 4, 5]]
    assert spread[4, 4, 4] > beside[0] > spread[2, 4, 4] > 0
    torch.testing.assert_close(torch.stack(beside), beside[0].expand(4))
    torch.testing.assert_close(spread.sum(), torch.tensor(1.0))  # two passes stay in the block


def test_a_model_of_colmap_in_a_world_of_its_own(tmp_path, caplog):
    """The sphere, 40 times as large, far away and upside down, from half of the pixels."""
    caplog.set_level("INFO", "univoxel")
    scale, centre = 40.0, torch.tensor([100.0, -50.0, 30.0])
    photos = photos_of(16, 64)
    poses = torch.eye(4).repeat(16, 1, 1)
    poses[:, :3] = photos.cameras.camera_to_world
    poses[:, :3, 3] = scale * poses[:, :3, 3] + centre
    color = torch.cat([linear_to_srgb(photos.color), photos.alpha[..., None]], -1)
    pictures = (255 * color).round().to(torch.uint8)
    turn = Rotation.from_rotvec([2.0, -0.5, 0.7])
    written = Scene(poses.numpy(), pictures.numpy()).turned(turn)
    focal = float(photos.cameras.focal[0, 0])
    data = write_colmap(tmp_path / "data", written, parameters=(focal, 32.0, 32.0))
    stages = (plain_stage(voxels=0.01, iterations=40, share=1.0, rays=256),)
    out = train(config(data, tmp_path / "run", stages=stages, downscale=2))
    said = "14 photographs of 32x32 pixels in train, downscaled to 1/2, world rotated so"
    assert said in caplog.text
    mesh = extract_mesh(load_scene(out))
    middle = (mesh.vertices.amin(0) + mesh.vertices.amax(0)) / 2
    away = (mesh.vertices - middle).norm(dim=1) / scale - RADIUS
    assert away.abs().mean() < 0.03  # as above
    assert abs(float(middle.norm() - centre.norm())) < 0.03 * scale
    views = photos_of_run(out)
    assert (views.downscale, views.cameras.width) == (2, 32)


@pytest.mark.parametrize("kind", ["sparse", "hash"])
def test_another_field_is_as_good(data, run, tmp_path, kind):
    out = train(with_field(config(data, tmp_path / "run"), kind))
    scene, dense = load_scene(out), load_scene(run)
    assert scene.field.kind == kind
    found = info(out, picture=tmp_path / "info.png")
    assert 0 < found["grid"]["share_with_features"] < 0.9
    assert scene.field.grid == dense.field.grid
    away = extract_mesh(scene).vertices.norm(dim=1) - RADIUS
    assert away.abs().mean() < 0.03
    photos = load_photos(data, "test")
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(32), torch.arange(32))
    psnr, of_dense = (loop.held_out_psnr(s, photos, pixels, physical=True) for s in (scene, dense))
    assert psnr > of_dense - 1.0  # two runs of 140 steps with other random numbers
    with pytest.raises(ValueError, match="was started with another stages"):
        train(config(data, out), resume=True)


def test_a_sparse_run_is_resumed(data, tmp_path, monkeypatch):
    """In the middle of its fine stage, from the checkpoint of a sparse field."""
    cfg = with_field(config(data, tmp_path / "run"), "sparse")
    save, saved = loop.save_scene, []

    def killed(*arguments, **options):
        save(*arguments, **options)
        saved.append(1)
        if len(saved) == 2:
            raise KeyboardInterrupt

    for module in (task, loop):  # the last of a stage, and those within
        monkeypatch.setattr(module, "save_scene", killed)
    monkeypatch.setattr(task.Progress, "checkpoint_due", lambda self: self.clock.step == 70)
    with pytest.raises(KeyboardInterrupt):
        train(cfg)
    first = load_scene(cfg.out)
    assert first.field.kind == "sparse"
    train(cfg, resume=True)
    assert not torch.equal(load_scene(cfg.out).field.sdf[:1000], first.field.sdf[:1000])


def test_resume_goes_on_where_it_stopped(data, tmp_path, monkeypatch):
    cfg = config(data, tmp_path / "run")
    interrupt_second_stage(cfg)
    first, seen = load_scene(cfg.out), []
    monkeypatch.setattr(task, "run_stage", lambda scene, cfg, stage, *rest: seen.append(stage))
    train(cfg, resume=True)
    assert seen == list(cfg.stages[1:])
    assert load_scene(cfg.out).field.grid != first.field.grid  # the second stage's resolution


def test_what_is_pinned_is_so_on_the_grid_of_every_stage_and_after_a_kill(
    data, tmp_path, monkeypatch
):
    class Pinned:
        def __init__(self):
            self.grids = []

        def pin_(self, field):
            self.grids.append(field.grid.size)

    first, second = Pinned(), Pinned()
    monkeypatch.setattr(preparation, "find_pinned", lambda *_: first)
    cfg = config(data, tmp_path / "run", carving_seconds=0.0)
    interrupt_second_stage(cfg)
    coarse, fine = first.grids
    assert coarse < fine
    monkeypatch.setattr(preparation, "find_pinned", lambda *_: second)
    train(cfg, resume=True)
    assert second.grids == [fine]


def test_resume_refuses_another_configuration(run, data):
    cfg = config(data, run)
    with pytest.raises(ValueError, match=r"was started with another downscale: .* downscale, "):
        train(dataclasses.replace(cfg, downscale=2), resume=True)
    with pytest.raises(ValueError, match="was started with another stages: to resume it"):
        train(dataclasses.replace(cfg, stages=cfg.stages[:1]), resume=True)
    for change in ({"masks": "auto"}, {"exposures": True}):
        with pytest.raises(ValueError, match=f"was started with another {next(iter(change))}: "):
            train(dataclasses.replace(cfg, **change), resume=True)
    with pytest.raises(FileExistsError, match="already contains a run: pass resume"):
        train(cfg)
    train(dataclasses.replace(cfg, minutes=5.0), resume=True)  # more time is no other run


def test_so_few_pixels_that_none_is_spared():
    distance = torch.full((1, 30, 30), 99.0)
    distance[0, 3, 4:8] = -1.0
    split = split_pixels(photos_of(1, 30), distance)
    pixels, held = split.trained, split.held_out
    assert len(pixels) == 4
    assert torch.equal(pixels, held)


def test_a_training_says_how_it_came_out(data, tmp_path, caplog):
    caplog.set_level("INFO", "univoxel")
    run = train(config(data, tmp_path / "run"))
    verdict = load_verdict(run)
    assert verdict.complete
    assert verdict.evidence.steps == {}
    assert 0 <= verdict.evidence.outline < 0.2
    assert verdict.evidence.psnr > 10
    assert (run / "trust.txt").read_text().startswith(verdict.sentence() + ". ")
    assert any(message.startswith("Result: ") for message in caplog.messages)
    assert "12 photographs of 0.001 megapixels: training takes about" in caplog.text


def test_a_limit_may_be_enough_for_the_steps_alone(caplog):
    """Then it does not promise more than all of them."""
    caplog.set_level("INFO", "univoxel")
    clock = SimpleNamespace(seconds=0.0, planned=20.0, limit=120.0, preparation=0.0, afterwards=0.0)
    progress = SimpleNamespace(clock=clock, cfg=SimpleNamespace(minutes=2.0), slower=1.0)
    cameras = SimpleNamespace(width=4000, height=3000)
    photos = type("", (), {"cameras": cameras, "downscale": 1, "__len__": lambda self: 60})()
    task.announce(progress, photos)
    assert caplog.messages[-1].endswith("all steps, if preparation takes at most 30 s")
    assert clock.preparation == 30.0
    clock.limit, clock.afterwards = 400.0, 600.0  # enough for the steps; texture and page follow
    task.announce(progress, photos)
    assert caplog.messages[-1].endswith("training takes about 16 min on this machine")


def test_a_stage_without_a_step_is_said_and_ends_with_code_3(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(clock, "LEAST", 0.0)
    monkeypatch.setattr(clock.Clock, "hurried", property(lambda self: False))
    cfg = config(data, tmp_path / "run", minutes=1e-4)
    save_config(dataclasses.replace(cfg, out=tmp_path))
    options = ["--out", str(tmp_path / "run"), "--config", str(tmp_path / "config.json")]
    assert main(["train", str(data), *options]) == 3
    said = capsys.readouterr().out
    assert "the time limit was too short (completed steps: 0% of" in said
    assert (
        "--minutes 0.0001 allows about 0% of the steps; to run all steps, use --minutes 1" in said
    )
    assert extract_mesh(load_scene(tmp_path / "run")).faces.numel() > 0
    verdict = load_verdict(tmp_path / "run")
    assert verdict.empty
    assert verdict.remedies[0] == "train with `--minutes 1`"
