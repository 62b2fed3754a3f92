"""Evaluation of a made-up scene whose every measure is known."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import rich
import torch
from balls import surface_at
from layouts import repainted, rewritten, without
from torch import nn

from univoxel.cli import evaluate as task
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.core.records import Mesh
from univoxel.data import load_photos
from univoxel.data.images import read_exr, read_image, write_png
from univoxel.errors import DataError
from univoxel.evaluation import measures
from univoxel.evaluation.measures import expected_view
from univoxel.render.pictures import TILE, Panel, contact_sheet, heat, shrink

SIZE = 16
SCALE = torch.tensor([2.0, 1.5, 0.5])  # true albedo over the estimate's
LIGHT = {"train": 1.0, "dim": 0.25}  # what all surfaces are multiplied by, by map
TILT = 10.0  # degrees, error of the normals
ROUGHNESS = 0.5  # of the estimate; true is 0.2 more


def inside():
    """[H, W] bool: a square of half the width."""
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[4:12, 4:12] = True
    return mask


def true_albedo(view):
    g = torch.Generator().manual_seed(view)
    stored = (0.2 + 0.5 * torch.rand(SIZE, SIZE, 3, generator=g)) * inside()[..., None]
    return srgb_to_linear((stored * 255).round() / 255)  # photographs of it are then exact


def picture(linear):
    rgba = torch.cat([linear_to_srgb(linear), inside()[..., None].float()], -1)
    return (rgba * 255).round().to(torch.uint8)


@pytest.fixture
def folders(tmp_path):
    """A data set of two test views with all truth, and a run."""
    data, run = tmp_path / "data", tmp_path / "run"
    for path in (data / "test" / "gt", data / "relight" / "dim", data / "envmaps", run):
        path.mkdir(parents=True)
    frames = []
    for view in range(2):
        pose = torch.eye(4)
        pose[2, 3] = 4.0
        frames.append({"file_path": f"./test/r_{view}", "transform_matrix": pose.tolist()})
        write_png(data / "test" / f"r_{view}.png", picture(true_albedo(view)))
        write_png(data / "relight" / "dim" / f"r_{view}.png", picture(0.25 * true_albedo(view)))
        np.savez(
            data / "test" / "gt" / f"r_{view}.npz",
            albedo=true_albedo(view).numpy(),
            roughness=np.full((SIZE, SIZE), ROUGHNESS + 0.2, np.float16),
            normal=np.broadcast_to(np.float16([0, 0, 1]), (SIZE, SIZE, 3)),
            alpha=255 * inside().numpy().astype(np.uint8),
        )
    transforms = {"camera_angle_x": 0.7, "frames": frames}
    (data / "transforms_test.json").write_text(json.dumps(transforms))
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n"
    # 128 * 2^(127 - 136) = 0.25
    (data / "envmaps" / "dim.hdr").write_bytes(header + bytes([128, 128, 128, 127]) * 2)
    corner = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    np.savez(data / "points.npz", points=corner.numpy() / 3 + np.float32([0, 0, 2]))
    (run / "config.json").write_text(json.dumps({"data": str(data)}))
    (run / "scene.safetensors").write_bytes(bytes(123))
    return SimpleNamespace(data=data, run=run)


@pytest.fixture
def relit_calls(monkeypatch):
    """Stand-ins for the renderer. Light is 1 from everywhere, so radiance is the true albedo."""
    scene = nn.Linear(3, 2)
    scene.show_light_of = lambda view: None
    scene.field = nn.Identity()
    scene.field.voxel_size = 0.125
    calls = []

    def surface_of_view(scene, cameras, view, albedo_near=None):
        mask = inside().flatten()
        n, angle = len(mask), math.radians(TILT)
        normal = torch.tensor([math.sin(angle), 0.0, math.cos(angle)]).expand(n, 3)
        albedo = true_albedo(view).reshape(-1, 3) / SCALE
        at = {"opacity": mask.float(), "depth": torch.full((n,), 4.0)}
        surface = surface_at(torch.zeros(n, 3), normal, albedo, ROUGHNESS, **at)
        wo = torch.tensor([0.6, 0.0, 0.8]).expand(n, 3)
        return surface, wo

    def relight_surface(surface, wo, traced, lighting, *, samples, bounces):
        told = {"samples": samples, "bounces": bounces, "offset": traced.offset}
        calls.append(SimpleNamespace(mesh=traced.mesh, **told))
        assert len(surface.opacity) == int(inside().sum())  # nothing outside is shaded
        return surface.albedo * lighting.tables.radiance.mean()

    def extract_mesh(scene):
        corner = torch.tensor([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0]])
        albedo = torch.tensor([[0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [0.25, 0.5, 0.5]])
        return Mesh(corner, torch.tensor([[0, 1, 2]], dtype=torch.int32), albedo=albedo)

    monkeypatch.setattr(measures, "surface_of_view", surface_of_view)
    monkeypatch.setattr(measures, "shade", lambda scene, surface, wo: surface.albedo * SCALE)
    monkeypatch.setattr(measures, "relight_surface", relight_surface)
    monkeypatch.setattr("univoxel.render.pipeline.extract_mesh", extract_mesh)
    state = {"seconds": 8.5, "threads": 2, "peak_rss_mb": 700.0}
    monkeypatch.setattr("univoxel.scene.load_checkpoint", lambda run: (scene, state))
    return calls


def test_measures_of_a_known_scene(folders, relit_calls, capsys):
    result = task.evaluate(folders.run, samples=5, bounces=1)
    assert list(result) == list(measures.MEASURES)
    # Photographs store bytes; the estimate equals them to fp32.
    assert result["nvs_psnr"] == pytest.approx(100)
    assert result["nvs_ssim"] == pytest.approx(1)
    assert result["albedo_psnr_3ch"] > 90
    assert max(result["albedo_psnr_raw"], result["albedo_psnr_1ch"]) < 40
    assert result["relit_psnr"] > 50  # the relit photograph is rounded to bytes
    assert result["relit_psnr_raw"] < 40
    assert result["roughness_mse"] == pytest.approx(0.04, rel=4e-3)  # truth is in halves
    assert result["normal_mae_deg"] == pytest.approx(TILT, rel=1e-4)
    # The mesh is a point, nearly; the truth three points at height 2, two 1/3 to the side.
    near, far = 2.0, math.hypot(2, 1 / 3)
    assert result["chamfer"] == pytest.approx(0.5 * (near + (near + 2 * far) / 3), rel=1e-3)
    assert result["train_seconds"] == 8.5
    assert result["threads"] == 2
    assert result["peak_rss_mb"] == 700
    assert result["parameters"] == 8
    assert result["model_bytes"] == 123
    assert capsys.readouterr().out == ""
    rich.print(task.table(result))
    assert "normal_mae_deg" in capsys.readouterr().out


def test_on_white_in_json_and_of_other_data(folders, relit_calls, tmp_path, monkeypatch):
    """Photograph and render alike: where nothing is, both are white."""
    empty = Mesh(torch.empty(0, 3), torch.empty(0, 3, dtype=torch.int32))
    monkeypatch.setattr("univoxel.render.pipeline.extract_mesh", lambda scene: empty)
    (folders.run / "config.json").unlink()
    options = {"background": "white", "data": folders.data, "json": tmp_path / "measures.json"}
    result = task.evaluate(folders.run, **options)
    assert result["nvs_psnr"] == pytest.approx(100)
    assert result["chamfer"] is None
    unknown = {"complete": None, "verdict": None}  # it was not trained
    assert json.loads((tmp_path / "measures.json").read_text()) == result | unknown
    truth, outside = load_photos(folders.data, "test"), ~inside()
    black, white = (expected_view(truth, {}, 0, behind) for behind in ("black", "white"))
    assert not black.photo[outside].any()
    torch.testing.assert_close(white.photo[outside], torch.ones_like(white.photo[outside]))
    assert torch.equal(black.photo[inside()], white.photo[inside()])
    opaque = picture(true_albedo(0))
    opaque[..., 3] = 255  # black where the render shows what is behind
    write_png(folders.data / "test" / "r_0.png", opaque)
    on_white, on_black = (
        task.evaluate(folders.run, data=folders.data, background=behind)["nvs_psnr"]
        for behind in ("white", "black")
    )
    assert on_white < 60 < on_black


def test_raw_albedo_against_a_formula(folders, relit_calls):
    result = task.evaluate(folders.run)
    errors, inner = [], []
    for view in range(2):
        truth = true_albedo(view)
        raw = linear_to_srgb(truth / SCALE)
        errors.append(-10 * math.log10(float((raw - linear_to_srgb(truth)).square().mean())))
        ratio = SCALE.repeat(int(2 * inside().sum())).median()
        one = linear_to_srgb(truth / SCALE * ratio)
        inner.append(-10 * math.log10(float((one - linear_to_srgb(truth)).square().mean())))
    assert result["albedo_psnr_raw"] == pytest.approx(sum(errors) / 2, rel=1e-4)
    assert result["albedo_psnr_1ch"] == pytest.approx(sum(inner) / 2, rel=1e-4)


def test_foreground_psnr_leaves_the_background_out(folders, relit_calls):
    """A quarter of the picture is inside: the same error there weighs four times as much."""
    truth = load_photos(folders.data, "test")
    layers = measures.render_layers(nn.Identity(), truth.cameras, 0)
    expected = expected_view(truth, {}, 0)
    numbers = dict(measures.score(layers, expected, measures.Scales(torch.ones(3), torch.ones(3))))
    difference = numbers["albedo_psnr_3ch"] - numbers["albedo_psnr_fg"]
    assert difference == pytest.approx(10 * math.log10(4), rel=1e-4)


def test_relighting_gets_its_settings_and_the_scaled_mesh(folders, relit_calls):
    task.evaluate(folders.run, samples=5, bounces=1)
    raw, scaled = relit_calls[:2]
    assert len(relit_calls) == 4  # two views, raw and scaled
    assert (raw.samples, raw.bounces, raw.offset) == (5, 1, 0.125)
    assert raw.mesh.albedo[1].tolist() == [0.75, 0.5, 0.5]
    # 0.75 x 2 is clipped: no surface sends out more than it gets
    assert scaled.mesh.albedo[1].tolist() == pytest.approx([1.0, 0.75, 0.25], rel=1e-4)


def test_saved_layers(folders, relit_calls, tmp_path):
    task.evaluate(folders.run, save=tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["contact_sheet.png", "r_0.exr", "r_1.exr"]
    channels = read_exr(tmp_path / "out" / "r_1.exr")
    colors = [f"{name}.{c}" for name in ("rgb", "albedo", "relit_dim") for c in "RGB"]
    assert sorted(channels) == sorted(
        [*colors, "normal.X", "normal.Y", "normal.Z", "roughness", "alpha", "depth"]
    )
    mask = inside().numpy()
    for name, value in channels.items():
        assert not value[~mask].any(), name
    truth = true_albedo(1).numpy()
    half = {"rtol": 1e-3, "atol": 1e-6}  # 11 bits of a half float
    np.testing.assert_allclose(channels["rgb.R"], truth[..., 0], **half)
    np.testing.assert_allclose(channels["albedo.R"], truth[..., 0] / 2, **half)  # unscaled
    np.testing.assert_allclose(channels["relit_dim.R"], truth[..., 0] / 8, **half)
    np.testing.assert_allclose(channels["depth"][mask], 4.0 * 0.8, **half)
    np.testing.assert_allclose(channels["roughness"][mask], ROUGHNESS, **half)
    np.testing.assert_allclose(channels["normal.Z"][mask], math.cos(math.radians(TILT)), **half)
    sheet = read_image(tmp_path / "out" / "contact_sheet.png")
    assert sheet.shape[1] > 15 * TILE  # five quantities of three columns


def test_without_truth_measures_are_null(folders, relit_calls, tmp_path):
    for path in (folders.data / "test" / "gt").iterdir():
        path.unlink()
    for path in (folders.data / "relight" / "dim").iterdir():
        path.unlink()
    (folders.data / "relight" / "dim").rmdir()
    (folders.data / "points.npz").unlink()
    result = task.evaluate(folders.run, save=tmp_path / "out")
    missing = {key for key, value in result.items() if value is None}
    training = {"train_seconds", "threads", "peak_rss_mb", "parameters", "model_bytes"}
    assert missing == set(measures.MEASURES) - training - {"nvs_psnr", "nvs_ssim"}
    assert not relit_calls
    assert (tmp_path / "out" / "contact_sheet.png").is_file()


def test_expected_errors_are_compared_with_true_ones(folders, relit_calls):
    """Expected errors that grow with the true ones foretell them; others say the opposite."""
    photos = load_photos(folders.data, "test")
    ones = measures.Scales(torch.ones(3), torch.ones(3))
    pairs = []
    for view in range(2):
        layers = measures.render_layers(nn.Identity(), photos.cameras, view)
        expected = expected_view(photos, {}, view)
        error = (linear_to_srgb(layers.albedo) - expected.albedo).abs().mean(-1)
        told = torch.stack([error.sqrt(), 0 * error, 0 * error], -1)
        errors = measures.errors_of(dataclasses.replace(layers, errors=told), expected, ones)
        albedo = errors["albedo"]
        assert len(albedo[0]) == len(errors["normal"][0]) == int(inside().sum())
        pairs.append((albedo, (-albedo[0], albedo[1]), errors["roughness"]))
    found = [measures.rank_correlation(list(p)) for p in zip(*pairs, strict=True)]
    assert found == [pytest.approx(1.0), pytest.approx(-1.0), None]  # the last are all equal
    assert measures.rank_correlation([None]) is None


CONFIG = "run/config.json"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without(CONFIG), r"folder of a run, but config"),
        (rewritten(CONFIG, b"{}"), "config.json: expected data to be a folder"),
        (rewritten(CONFIG, b"{"), "config.json: .* JSON"),
        (rewritten("data/envmaps/dim.hdr", b"#?"), r"dim\.hdr: expected a header"),
        (
            lambda f: np.savez(f / "data/test/gt/r_1.npz", alpha=np.zeros((4, 5), np.uint8)),
            "truth of r_1 with 16x16 pixels as in the test view, got 5x4",
        ),
        (
            repainted("data/relight/dim/r_0.png", np.zeros((4, 5, 4), np.uint8)),
            r"dim/r_0\.png: expected 16x16 pixels as in the test view, got 5x4",
        ),
    ],
)
def test_bad_folders(folders, relit_calls, damage, message):
    damage(folders.run.parent)
    with pytest.raises(DataError, match=message):
        task.evaluate(folders.run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "samples must be at least 1, got 0"),
        ({"bounces": -1}, "bounces must be at least 0, got -1"),
        ({"light_of": "r_0", "fit_light": True}, "expected light_of or fit_light, but not both"),
    ],
)
def test_bad_settings(folders, change, message):
    with pytest.raises(ValueError, match=message):
        task.evaluate(folders.run, **change)


def test_sheet_shows_the_panels_where_it_says():
    red = torch.tensor([1.0, 0.0, 0.0]).expand(TILE, TILE, 3)
    panel = Panel("albedo", red, 0.5 * red, torch.zeros(TILE, TILE), 0.2)
    sheet = contact_sheet([("r_0", [panel]), ("r_1", [panel])])
    margin, cell = 8 + 8 * 3, TILE + 4
    for y in (18 + 80, 18 + 80 + cell):
        assert sheet[y, margin + 80].tolist() == [255, 0, 0]
        assert sheet[y, margin + cell + 80].tolist() == [128, 0, 0]
        assert sheet[y, margin + 2 * cell + 80].tolist() == [0, 0, 0]


def test_parts_of_a_sheet():
    """Heat rises from black and ends at the limit; large panels shrink; rows are of one kind."""
    colors = heat(torch.tensor([[0.0, 0.1, 0.2, 0.3]]), 0.2)
    assert colors[0, 0].tolist() == [0, 0, 0]
    assert np.array_equal(colors[0, 2], colors[0, 3])
    assert 0 < colors[0, 1].sum() < colors[0, 2].sum()
    panel = Panel("albedo", torch.rand(8 * TILE, 4 * TILE, 3), None, None, 0.2)
    assert shrink(panel).estimate.shape == (4 * TILE, 2 * TILE, 3)
    for rows in ([], [("a", [])], [("a", [panel]), ("b", [panel, panel])]):
        with pytest.raises(ValueError, match="rows with the same panels"):
            contact_sheet(rows)


def test_views_of_differing_sizes_stand_on_one_sheet():
    """Each in its shape, one under another."""
    shapes = [(160, 80), (80, 160), (40, 40)]
    rows = []
    for k, (height, width) in enumerate(shapes):
        picture = torch.full((height, width, 3), (100 + k) / 255)
        rows.append((f"r_{k}", [Panel("novel view", picture, picture, None, 1.0)]))
    sheet = contact_sheet(rows)[18:, 8 + 8 * 3 :]  # without words
    for k, (height, width) in enumerate(shapes):
        row, column = (sheet == 100 + k).all(-1).nonzero()
        assert len(row) == 2 * height * width  # estimate and truth
        assert np.ptp(row) + 1 == height
        assert len(np.unique(column)) == 2 * width
