"""A print on a ball that is finer than the grid comes back from photographs, without light."""

import io
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from analytic import cameras_around
from asymmetric_scene import lopsided
from PIL import Image
from torch.nn.functional import normalize

import univoxel
from univoxel import Run, api, evaluate
from univoxel.camera import Cameras, image_rays, sizes_of, stacked
from univoxel.cli import main
from univoxel.cli.detail import made_after_training, minutes_left, write
from univoxel.cli.report import report
from univoxel.color import linear_to_srgb
from univoxel.core.records import Surface
from univoxel.data import Photos
from univoxel.data.lens import shrink
from univoxel.detail import texture
from univoxel.detail import views as detail_views
from univoxel.detail.texture import load_detail, make_detail, page_options, save_detail
from univoxel.detail.views import DetailedViews, coherence, likenesses, measure_full_size
from univoxel.errors import DataError
from univoxel.evaluation.measures import render_layers
from univoxel.output.mesh import bake
from univoxel.output.page import PageOptions, model
from univoxel.output.report_pictures import Split, compared
from univoxel.output.surface import surface_of
from univoxel.render.pictures import preview
from univoxel.render.pipeline import shade, shade_hits, surface_of_view
from univoxel.run import photos_of
from univoxel.scene import load_checkpoint, load_scene, save_scene

RADIUS, SIZE, VIEWS = 0.4, 240, 12
DATA = Path(univoxel.__file__).parent / "example_data" / "tiny"
EVEN = torch.tensor([0.4, 0.32, 0.2])  # what the model has for albedo


def printed(points):
    """Waves of 0.07, where the grid has voxels of 0.06: a period is 6 pixels."""
    x, y, z = (90 * points).unbind(-1)
    wave = (x + y).sin() * (y - z).sin()
    return (0.4 + 0.25 * wave)[..., None] * torch.tensor([1.0, 0.8, 0.5])


def photograph(scene, cameras, view, paint=printed):
    """Linear colours [H, W, 3] of the painted ball in the scene's own light, and where it is."""
    rays = image_rays(cameras, view)
    along = -(rays.origin * rays.direction).sum(1)
    nearest = rays.origin + along[:, None] * rays.direction
    inside = RADIUS**2 - nearest.square().sum(1)
    hit = inside > 0
    depth = along - inside.clamp_min(0).sqrt()
    place = (rays.origin + depth[:, None] * rays.direction)[hit]
    at = scene.field.sample(place)
    _, roughness, metallic = scene.material(at.features)
    surface = Surface(
        position=place,
        normal=normalize(place, dim=1),
        features=at.features,
        albedo=paint(place),
        roughness=roughness,
        opacity=torch.ones(len(place)),
        depth=depth[hit],
        metallic=metallic,
    )
    rgb = torch.zeros(len(hit), 3)
    rgb[hit] = shade(scene, surface, -rays.direction[hit])
    return rgb.reshape(SIZE, SIZE, 3), hit.reshape(SIZE, SIZE)


@pytest.fixture(scope="module")
def scene():
    """A ball whose albedo is even: the grid holds none of the print. It shines."""
    made = lopsided(16**3, change=lambda nodes, _: nodes.norm(dim=-1) - RADIUS)
    with torch.no_grad():
        made.field.features[..., :3] = EVEN
        made.field.features[..., 3] = 0.35
    return made


@pytest.fixture(scope="module")
@torch.no_grad()
def photos(scene):
    """In files they are as large as those that training had."""
    cameras = cameras_around(VIEWS + 1, SIZE)
    cameras = replace(cameras, focal=1.8 * cameras.focal)
    pictures, masks = zip(*(photograph(scene, cameras, v) for v in range(VIEWS + 1)), strict=True)
    color = (255 * linear_to_srgb(torch.stack(pictures))).round().to(torch.uint8)
    alpha = 255 * torch.stack(masks).to(torch.uint8)
    readers = tuple(lambda factor, v=v: color[v] for v in range(VIEWS + 1))
    names = [str(v) for v in range(VIEWS + 1)]
    return Photos(Path(), names, color, alpha, cameras, readers=readers)


@pytest.fixture(scope="module")
def detail(scene, photos):
    made = make_detail(scene, photos.of(torch.arange(VIEWS)), 1024)
    assert made is not None
    return made


def test_the_print_comes_back_without_light(scene, detail):
    """The model has none of it; highlights, which the model has, are not painted on."""
    generator = torch.Generator().manual_seed(0)
    way = normalize(torch.randn(4000, 3, generator=generator), dim=1)
    found = detail.near(RADIUS * way, way, EVEN.expand(4000, 3), 0.0)
    true = printed(RADIUS * way)
    one, two = (x[:, 0] - x[:, 0].mean() for x in (found, true))
    assert (one * two).sum() / (one.norm() * two.norm()) > 0.97
    # With the highlights left on it the ball would be brighter by 0.048, measured so
    assert abs(float((found - true).mean())) < 0.01


def test_novel_views_show_it(scene, photos, detail):
    """The last photograph was not looked at; the model's own view of it has no detail at all."""
    views = DetailedViews(scene, detail, photos.of(torch.arange(VIEWS)))
    surface, wo = surface_of_view(scene, photos.cameras, VIEWS)
    coarse = shade_hits(scene, surface, wo).reshape(SIZE, SIZE, 3)
    opacity = surface.opacity.reshape(SIZE, SIZE)
    aided, alone = views.render(photos.cameras, VIEWS, coarse, opacity)
    photo, cover = photos.picture(VIEWS)
    before, *after = likenesses((coarse, alone, aided), photo, cover)
    assert before is not None
    assert coherence([before])[1] < 0.3
    for found in after:
        assert found is not None
        assert coherence([found])[1] > 0.85
        assert found.psnr > before.psnr + 3


def test_full_size_is_that_of_each_file(scene, photos, detail):
    """Files of differing sizes, of which rows and columns are left over when they are shrunk."""
    few, factor = photos.of(torch.arange(4)), 7
    parts = [slice(SIZE - 7 * (view % 2)) for view in range(4)]  # cut off to the right and below
    files = [photos.color[view, part, part] for view, part in enumerate(parts)]
    masks = [photos.alpha[view, part, part, None] for view, part in enumerate(parts)]
    color, alpha = ([shrink(x.float(), factor).byte() for x in xs] for xs in (files, masks))
    sizes = sizes_of([(x.shape[1], x.shape[0]) for x in color])
    lens = few.cameras.focal / factor, few.cameras.centre / factor
    small = replace(
        few,
        color=stacked(color),
        alpha=stacked(alpha)[..., 0],
        cameras=Cameras(few.cameras.camera_to_world, *lens, *sizes),
        downscale=factor,
        readers=tuple(lambda _, file=file: file for file in files),
    )
    found = measure_full_size(scene, DetailedViews(scene, detail, small), small)
    assert found["full_coherence_2"] > 0.85
    assert found["full_psnr"] > 30


def test_what_is_no_object_in_a_photograph_nearby_does_not_count(scene, photos, detail):
    """Where the surface is off, they show what is behind it."""
    white = tuple(lambda factor: torch.full((SIZE, SIZE, 3), 255, dtype=torch.uint8) for _ in "ab")
    near = replace(photos.of(torch.arange(2)), readers=white)
    nothing = replace(near, alpha=torch.zeros_like(near.alpha))
    coarse, opacity = torch.zeros(SIZE, SIZE, 3), torch.ones(SIZE, SIZE)
    changed = []
    for shown in (near, nothing):
        views = DetailedViews(scene, detail, shown)
        aided, alone = views.render(photos.cameras, 0, coarse, opacity)
        changed.append(float((aided - alone).abs().max()))
    assert changed[0] > 0.1
    assert changed[1] < 1e-6  # rounding


def test_exported_textures_hold_it(scene, detail):
    mesh = surface_of(scene)
    size = 512
    even, fine = bake(scene, mesh, size), bake(scene, mesh, size, detail.near)
    assert even.albedo.std((0, 1)).max() < 1e-3
    assert fine.albedo[..., 0].std() > 0.8 * printed(torch.randn(9999, 3))[:, 0].std()
    assert torch.equal(even.relief, fine.relief)


def test_pages_show_it(scene, tiny_copy, detail):
    run = tiny_copy / "run"
    assert page_options(run) == {}
    save_detail(detail, run)
    options = PageOptions(**page_options(run) | {"texture_size": 256, "faces": 2000})
    mesh = trimesh.load(io.BytesIO(model(scene, options, None)), file_type="glb", force="mesh")
    picture = np.asarray(mesh.visual.material.baseColorTexture)[..., 0]
    assert picture.std() > 10  # of 255; the model's albedo is even


def test_the_preview_shows_it(scene, photos, detail, tmp_path, monkeypatch):
    monkeypatch.setattr(texture, "make_detail", lambda *_: detail)
    save_scene(scene, tmp_path, {})
    path, middle = tmp_path / "preview.png", slice(3 * SIZE // 8, 5 * SIZE // 8)

    def spread() -> float:
        albedo = np.asarray(Image.open(path))[middle, 2 * SIZE : 3 * SIZE, 0]
        return float(albedo[:, middle].std())

    preview(scene, photos, path)
    even = spread()
    assert write(scene, photos, tmp_path) == tmp_path / "detail"
    assert spread() > 5 * even + 5  # of 255; the model's albedo is even
    monkeypatch.setattr(texture, "make_detail", lambda *_: None)
    assert write(scene, photos, tmp_path) is None
    assert spread() == even  # nor does it show a texture that is gone


def test_measures_and_reports_show_it(scene, photos, detail):
    even, fine = (
        compared(scene, Split(photos, False), VIEWS, SIZE, near) for near in (None, detail.near)
    )
    assert fine.quality > even.quality + 2  # the rim, which counts too, is as it was
    albedo = render_layers(scene, photos.cameras, VIEWS, albedo_near=detail.near).albedo
    assert albedo[fine.inside][:, 0].std() > 0.8 * printed(torch.randn(9999, 3))[:, 0].std()


def test_other_photographs_do_not_correct_views(scene, photos, detail, monkeypatch, caplog):
    monkeypatch.setattr(detail_views, "load_detail", lambda _: detail)
    monkeypatch.setattr(detail_views, "photos_of", lambda *_: photos)
    assert detail_views.detailed_views(scene, Path(), None).photos is not None
    monkeypatch.setattr(scene, "cfg", replace(scene.cfg, views=("another",)))
    with caplog.at_level("INFO"):
        assert detail_views.detailed_views(scene, Path(), None).photos is None
    assert "has other photographs than the run was trained on" in caplog.text


@pytest.mark.parametrize("fit_light", [False, True])
def test_a_run_with_a_texture_is_measured_by_nearby_photographs(tiny_copy, fit_light, monkeypatch):
    """At both sizes; a light that is fitted to a test view is not that of the photographs."""
    run = tiny_copy / "run"
    plain = evaluate(run, data=DATA, fit_light=fit_light)
    monkeypatch.setattr(texture, "PIXELS_OF_VOXEL", 0.0)
    made = make_detail(load_scene(run), photos_of(run, DATA, "train"), 256)
    assert made is not None
    save_detail(made, run)
    found = evaluate(run, data=DATA, fit_light=fit_light, full_size=True)
    assert found["nvs_psnr"] > plain["nvs_psnr"]
    assert found["full_ssim"] > 0  # of pictures so small there is nothing else


def test_runs_are_measured_rendered_and_reported_with_it(tiny_copy, monkeypatch):
    run, asked = tiny_copy / "run", []

    def half(points, normals, albedo, footprint):
        asked.append(footprint)
        return 0.5 * albedo

    before, mean = evaluate(run, data=DATA), Run(run).render()[..., :3].mean()
    assert before["albedo_psnr_3ch"] is not None
    for module in (texture, api):
        monkeypatch.setattr(module, "albedo_near", lambda run: half)
    fake = SimpleNamespace(
        detail=SimpleNamespace(near=half), render=lambda c, v, rgb, _: (rgb, rgb)
    )
    monkeypatch.setattr(detail_views, "detailed_views", lambda *_: fake)
    assert Run(run).render()[..., :3].mean() < 0.8 * mean
    after = evaluate(run, data=DATA)
    assert after["nvs_psnr"] != before["nvs_psnr"]  # another picture
    # The scale that brings it nearest to the truth is twice as large, but for pixels of the mask
    # where the scene has nothing: they keep their albedo
    assert after["albedo_psnr_3ch"] == pytest.approx(before["albedo_psnr_3ch"], abs=0.01)
    counts = []
    for fit_light in (False, True):
        asked.clear()
        evaluate(run, fit_light=fit_light)
        counts.append(len(asked))
    views = {split: len(photos_of(run, None, split)) for split in ("train", "test")}
    assert counts[1] == counts[0] + views["test"]  # light is fitted with it, too
    asked.clear()
    report(run, size=16, views=0)
    assert len(asked) == 4 + sum(views.values())  # four sides, and what is compared


def test_none_is_made_where_photographs_show_no_more(scene, photos, monkeypatch):
    monkeypatch.setattr(texture, "PIXELS_OF_VOXEL", 1000.0)
    assert make_detail(scene, photos) is None


def test_none_is_made_where_held_out_photographs_are_no_better(scene, photos):
    """The ball as the model has it, under noise that differs from one photograph to the next."""
    generator = torch.Generator().manual_seed(0)

    def even(place):
        return EVEN.expand(len(place), 3)

    def noisy(view):
        picture, _ = photograph(scene, photos.cameras, view, even)
        return picture * (0.5 + torch.rand(picture.shape, generator=generator))

    with torch.no_grad():
        pictures = [noisy(view) for view in range(len(photos))]
    readers = tuple(lambda factor, v=v: pictures[v] for v in range(len(photos)))
    assert make_detail(scene, replace(photos, readers=readers), 256) is None


def test_files_of_another_checkpoint_are_refused(tiny_copy, detail, capsys):
    run = tiny_copy / "run"
    assert load_detail(run) is None
    save_detail(detail, run)
    again = load_detail(run)
    assert again is not None
    for name in ("vertices", "faces", "corners", "uv", "albedo"):
        assert torch.equal(getattr(again, name), getattr(detail, name))
    mesh = tiny_copy / "mesh.glb"
    (run / "detail" / "albedo.png").rename(run / "detail" / "other.png")
    with pytest.raises(DataError, match="damaged"):
        load_detail(run)
    (run / "detail" / "other.png").rename(run / "detail" / "albedo.png")
    scene, state = load_checkpoint(run)
    scene.inv_s *= 1.01
    save_scene(scene, run, state)
    capsys.readouterr()
    assert main(["export", str(run), "--mesh", str(mesh)]) == 2
    assert "another version of scene.safetensors" in capsys.readouterr().err


def test_a_limit_of_time_leaves_room(photos, scene, tmp_path, caplog):
    large = replace(photos, downscale=9)
    assert minutes_left(None, large, "texture", 2) is None
    assert minutes_left(2.0, large, "none", 2) == 2.0
    assert minutes_left(2.0, photos, "texture", 2) == 2.0  # trained on as they are
    left = minutes_left(2.0, large, "texture", 2)
    assert left is not None
    assert 1.5 <= left < 2.0
    caplog.set_level("INFO", "univoxel")
    over = time.monotonic() - 1
    assert made_after_training(scene, photos, tmp_path, "texture", over) is None
    assert "univoxel detail" in caplog.text
    assert not any(tmp_path.iterdir())
