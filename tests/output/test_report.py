"""A report of small runs: what it shows, what it says of what is not there, and its mistakes."""

import base64
import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import LIGHTS, photos_of, scene_of, sphere_scene, write_scene
from asymmetric_scene import lopsided
from browser import browser, installed
from PIL import Image

import univoxel
from univoxel.cli import main
from univoxel.cli.trainer import train
from univoxel.color import linear_to_srgb
from univoxel.core.html import chart
from univoxel.errors import DataError, NoSurface, UserError
from univoxel.evaluation.confidence import azimuths
from univoxel.lights import LocalSG, SGConfig
from univoxel.output import report, report_pictures
from univoxel.output.report import ReportOptions, report_text, what_is_known
from univoxel.presets import preset
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import load_checkpoint
from univoxel.sphere import latlong_directions

SIZE, VIEWS, SECTOR = 24, 24, 90.0  # pixels, photographs, azimuth that none is taken from
# Nothing is found out before training
GIVEN = {"carving_seconds": 0.0, "masks": "given", "cameras": "given"}
GIVEN |= {"exposures": False, "light_frame": "world"}
STAGES = tuple(
    f"stages.{i}.{field}"
    for i in (0, 1)
    for field in ("voxels=0.01", "rays=128", f"iterations={20 + 10 * i}")
)


def off(direction):
    return ((azimuths(direction) - SECTOR + 180) % 360 - 180).abs()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The sphere without photographs from a quarter of the turn."""
    folder = write_scene(tmp_path_factory.mktemp("sphere") / "data", VIEWS, 32)
    path = folder / "transforms_train.json"
    described = json.loads(path.read_text())
    place = torch.tensor([f["transform_matrix"] for f in described["frames"]])[:, :3, 3]
    kept = (off(place) > 45).tolist()
    described["frames"] = [f for f, keep in zip(described["frames"], kept, strict=True) if keep]
    assert len(described["frames"]) < VIEWS - 4
    path.write_text(json.dumps(described))
    return folder


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    """A run with local light alone, and no map."""
    out = tmp_path_factory.mktemp("sphere") / "run"
    changes = [*STAGES, "voxel_pixels=0", *(f"{name}={value}" for name, value in GIVEN.items())]
    return univoxel.train(data, out, light="sg", minutes=2, changes=changes)


@pytest.fixture(scope="module")
def text(run):
    return run.report(run.path / "sent" / "ball.html", size=SIZE, title='<"Ball">').read_text()


def pictures(text):
    found = re.findall(r'<img alt="([^"]*)" src="data:image/jpeg;base64,([^"]*)">', text)
    return [(alt, np.asarray(Image.open(io.BytesIO(base64.b64decode(d))))) for alt, d in found]


def section(text, name):
    return re.search(rf"<section><h2>{name}</h2>(.*?)</section>", text, re.DOTALL)[1]


def test_the_page_is_whole(text):
    """It loads nothing and runs nothing."""
    assert "default-src 'none'" in text
    assert "<script" not in text
    assert not re.search(r'(?:src|href)\s*=\s*"(?!data:)', text)
    assert "url(" not in text
    assert "&lt;&quot;Ball&quot;&gt;</h1>" in text
    assert text.count("<section>") == 7
    assert len(text) < 2e6
    for _, picture in pictures(text):
        assert picture.std() > 1
    errors, light = section(text, "Expected errors"), section(text, "Light")
    assert "Mean expected error of the surface: 0." in errors
    assert [name for name, _ in pictures(errors)] == ["front", "right", "back", "left"]
    assert "no environment map: its light is local (sg)" in light
    assert [name for name, _ in pictures(light)] == ["map", "diffuse sphere", "chrome sphere"]


def test_it_asks_for_the_sector_that_was_not_photographed(run, text):
    advice = what_is_known(run.path, run.scene, ReportOptions()).advice
    assert len(advice.chosen) >= 3
    assert (off(advice.chosen) < 55).all()  # those beside it by a few degrees see into it
    assert (off(advice.chosen[:3]) < 45).all()
    said = section(text, "What to photograph next")
    assert re.search(r"<li>\w+ photographs? from the", said)
    assert said.count('class="number"') == len(advice.chosen)
    assert said.count('class="taken"') == len(advice.taken)
    assert said.count('class="gap"') == int(advice.gap.sum()) > 0
    assert "No photograph from the " in said
    assert f"The front is the side from which {advice.front_name} was taken" in said


def test_photographs_stand_beside_their_render_the_worst_first(run, text):
    found = [p for alt, p in pictures(section(text, "Photographs and renders")) if alt]
    assert len(found) == 3 * 4
    split = report_pictures.Split(photos_of(2, 32), False)
    views, count = report_pictures.worst(run.scene, [split], 2, 16)
    assert count == 2
    assert views[0].error >= views[1].error
    one = report_pictures.compared(run.scene, split, 1, 64)  # not enlarged
    color, alpha = split.photos.picture(1)
    expected = linear_to_srgb(color) * alpha[..., None] + 0.11 * (1 - alpha[..., None])
    torch.testing.assert_close(one.photograph, expected, atol=1e-5, rtol=0)
    assert one.render.shape == (32, 32, 3)
    assert one.inside[16, 16]
    assert not one.inside[0, 0]
    # Against its own render nothing differs
    again = replace(one, photograph=one.render)
    assert again.error == 0
    assert again.difference.max() == 0


def test_the_map_of_lobes_that_are_everywhere_the_same_is_their_sum():
    scene = sphere_scene(0, light=SGConfig(lobes=3, hidden=4))
    assert isinstance(scene.light, LocalSG)
    with torch.no_grad():
        scene.light.base += torch.randn(3, 7, generator=torch.Generator().manual_seed(0))
    mesh = extract_mesh(scene)
    found, _ = report_pictures.found_light(scene, mesh)
    axis, sharpness, amplitude = scene.light.lobes_from_raw(torch.zeros(1, 21))
    w = latlong_directions(report_pictures.LOCAL_ROWS)
    expected = sum(
        amplitude[0, k] * (sharpness[0, k] * (w @ axis[0, k] - 1)).exp()[..., None]
        for k in range(3)
    )
    torch.testing.assert_close(found, expected.detach(), rtol=1e-4, atol=1e-5)


def test_the_map_of_local_light_counts_points_where_they_face_it():
    """Red on the side of +X, blue on the other: so is what comes from there."""

    class TwoSided(torch.nn.Module):
        def incident(self, surface, wi):
            side = (surface.position[:, :1] > 0).float()
            color = side * torch.tensor([1.0, 0, 0]) + (1 - side) * torch.tensor([0, 0, 1.0])
            return color[:, None].expand(-1, wi.shape[1], -1)

    scene = sphere_scene(0)
    scene.light = TwoSided()
    found = report_pictures.local_map(scene, extract_mesh(scene))
    w = latlong_directions(report_pictures.LOCAL_ROWS)[..., 0]
    red = found[..., 0] / found.sum(-1)
    assert red[w > 0.9].min() > 0.8
    assert red[w < -0.9].max() < 0.2
    # A recovered map is shown as it is; baked light is none
    scene = scene_of((0.5, 0.5, 0.5), 0.5, 32)
    found, about = report_pictures.found_light(scene, extract_mesh(scene))
    torch.testing.assert_close(found, scene.environment().latlong(report_pictures.ROWS))
    assert "recovered environment map" in about
    scene = sphere_scene(0, light=LIGHTS[-1])
    assert report_pictures.found_light(scene, extract_mesh(scene)) is None


def test_training_is_told(run, text):
    said = section(text, "Training")
    assert said.count('<svg class="chart"') in (0, 2)  # of seconds: there may be no line of the log
    assert "1: coarse shape<td>20<td>100%" in said
    assert "whole" in said
    assert "The time limit was 120 s." in said
    _, state = load_checkpoint(run.path)
    assert len(state["took"]) == 2
    assert report.prepared(state) + sum(state["took"]) <= state["seconds"] + 1e-6


def test_what_time_cut_is_told(tmp_path):
    cfg = preset("draft", tmp_path / "data", tmp_path)
    state = {"stage": 3, "progress": 0.5, "made": [1.0, 0.4, 0.9], "early": [2]}
    state |= {"took": [10.0, 20.0, 15.0], "stage_took": 5.0, "seconds": 57.0, "troubles": ["a"]}
    names, _, _, seconds, fates = zip(*report.stages(cfg, state), strict=True)
    assert list(fates) == [
        "whole",
        *("shortened by the time limit", "ended early, because it stopped improving", "not ended"),
    ]
    assert seconds == ("10.0 s", "20.0 s", "15.0 s", "")
    assert names[2:] == ("3: materials and light", "4: polish")
    assert report.prepared(state) == pytest.approx(7.0)
    assert report.stage_ends(state) == pytest.approx([17.0, 37.0])
    told = report.remarks(cfg, state)
    assert told[0] == "Training has not ended: it is in stage 4."
    assert "(completed steps: 40% of shape)" in told[1]
    assert "recovered: 1. The last one: a." in told[2]
    assert report.stage_ends({}) == []
    assert report.prepared({}) is None


def test_curves_of_a_log(tmp_path):
    lines = [(0, 1.0, 2.0, 20.0), (0, 2.0, 1.0, None), (1, 3.0, 4.0, 22.0), (1, 4.0, 0.5, 23.0)]
    text = [
        json.dumps({"stage": s, "seconds": t, "losses": {"a": v, "b": v}, "held_out_psnr": q})
        for s, t, v, q in lines
    ]
    trouble = {"stage": 1, "seconds": 3.5, "losses": {}, "held_out_psnr": None, "trouble": "x"}
    text.insert(3, json.dumps(trouble))
    (tmp_path / "log.jsonl").write_text("\n".join(text))
    loss, quality = report.curves(tmp_path)
    assert loss.pieces == [[(1.0, 4.0), (2.0, 2.0)], [(3.0, 8.0), (4.0, 1.0)]]
    assert quality.pieces == [[(1.0, 20.0)], [(3.0, 22.0), (4.0, 23.0)]]
    drawn = chart(loss, [2.5])
    assert drawn.count("<polyline") == 2
    assert drawn.count('class="stage"') == 1
    ys = [float(y) for y in re.findall(r",([\d.]+)[ \"]", re.search(r"<polyline.*", drawn)[0])]
    assert ys[0] < ys[1]  # less loss is drawn lower
    assert len(re.findall(r'class="point"', chart(quality, []))) == 1
    for broken in ("", "{", '{"seconds": 1}', "[1]"):
        (tmp_path / "log.jsonl").write_text(broken)
        assert report.curves(tmp_path) == []


def test_a_run_whose_photographs_are_gone_shows_what_is_left(run, data, tmp_path):
    moved = tmp_path / "run"
    shutil.copytree(run.path, moved)
    config = json.loads((moved / "config.json").read_text())
    (moved / "config.json").write_text(json.dumps(config | {"data": str(tmp_path / "gone")}))
    for kept in moved.glob("photographs_*"):
        kept.unlink()
    (moved / "log.jsonl").unlink(missing_ok=True)
    scene, state = load_checkpoint(moved)
    text = report_text(moved, scene, state, ReportOptions(size=SIZE))
    said = section(text, "What to photograph next")
    assert "The photographs could not be read, so this part is missing: " in said
    assert "gone" in said
    assert re.findall(r"<h2>(.*?)</h2>", text) == [
        *("Result", "What to photograph next", "Materials", "Light", "Training")
    ]
    assert "because this run has no log" in text
    # Where they are now
    whole = report_text(moved, scene, state, ReportOptions(size=SIZE, data=data, views=0))
    assert "<li>" in section(whole, "What to photograph next")
    with pytest.raises(DataError, match="gone"):
        report_text(moved, scene, state, ReportOptions(data=tmp_path / "gone"))
    (moved / "config.json").write_text("{")
    text = report_text(moved, scene, state, ReportOptions(size=SIZE))
    assert "The table of stages is missing" in text


def test_metal_is_a_layer_where_there_is_any(tmp_path):
    scene = lopsided(24**3)

    class Metal(torch.nn.Module):
        def forward(self, features):
            return features[:, :3], features[:, 3], torch.ones(len(features))

    plain = report_text(tmp_path, scene, {}, ReportOptions(size=SIZE))
    assert "No metal was found." in plain
    scene.material = Metal()
    shown = report_text(tmp_path, scene, {}, ReportOptions(size=SIZE))
    assert "Metal: white is metal." in shown
    assert "No metal was found." not in shown


def test_a_training_that_was_cancelled_is_shown_too(data, tmp_path, monkeypatch):
    monkeypatch.setattr("univoxel.training.progress.REPORT_SECONDS", 0.0)

    def cancel(now):
        if now.stage == 2:
            raise univoxel.Cancelled

    cfg = preset("draft", data, tmp_path / "run", "sg")
    small = [replace(s, voxels=0.01, rays=64, iterations=5) for s in cfg.stages]
    with pytest.raises(univoxel.Cancelled):
        train(replace(cfg, stages=tuple(small), voxel_pixels=0.0, **GIVEN), on_progress=cancel)
    text = univoxel.open_run(tmp_path / "run").report(size=SIZE, views=0).read_text()
    said = section(text, "Training")
    assert "Training has not ended: it is in stage 2." in said
    assert said.count('<svg class="chart"') == 2


def test_by_the_command_line(run, capfd, tmp_path):
    assert main(["report", str(run.path), "--views", "1", "--title", "One"]) == 0
    out = capfd.readouterr().out
    assert Path(out.splitlines()[-1]) == run.path / "report.html"
    text = (run.path / "report.html").read_text()
    assert "<h1>One</h1>" in text
    assert len(pictures(section(text, "Photographs and renders"))) == 3
    for arguments, message in (
        ([str(tmp_path)], f"{tmp_path}: not a trained run"),
        ([str(run.path), "--views", "-1"], "--views must be at least 0, got -1"),
        ([str(run.path), "--html", "a.pdf"], "--html: expected a file that ends in .html, got"),
        ([str(run.path), "--data", str(tmp_path / "none")], "none"),
    ):
        assert main(["report", *arguments]) == 2
        error = capfd.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    with pytest.raises(UserError, match="size must be at least 16, got 8"):
        ReportOptions(size=8)
    empty = sphere_scene(0)
    with torch.no_grad():
        empty.field.sdf.fill_(1.0)
    with pytest.raises(NoSurface):
        report_text(tmp_path, empty, {})


@pytest.mark.skipif(installed() is None, reason="needs a browser, such as Debian's chromium")
def test_in_a_browser(text, tmp_path):
    """Nothing overflows on a desk or a phone, nothing is asked for, all pictures are decoded."""
    page = tmp_path / "report.html"
    page.write_text(text)
    with browser() as tab:
        for width, phone in ((1280, False), (390, True)):
            tab.open(page.as_uri(), width, 800, phone)
            assert tab.run("document.documentElement.scrollWidth") <= width
            decoded = "[...document.images].every(i => i.complete && i.naturalWidth > 0)"
            assert tab.run(decoded)
        assert tab.errors == []
        assert [url for url in tab.requests if not url.startswith(("data:", "file:"))] == []
