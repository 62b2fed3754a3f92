"""What is written into a page, without a browser."""

import base64
import hashlib
import html
import json
import logging
import math
import re
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from asymmetric_scene import lopsided
from glb import Glb
from scipy.spatial import ConvexHull

from univoxel.api import Run
from univoxel.cli.view import command as view
from univoxel.cli.view import with_page
from univoxel.core.records import Mesh
from univoxel.data.images import write_exr
from univoxel.envmap import EnvMap, tables
from univoxel.errors import DataError, MissingFile, NoSurface, UserError
from univoxel.ops import VisibilityScene, relight
from univoxel.output import page
from univoxel.output.mesh import TexturedMesh
from univoxel.output.page import transfer, vertex_albedo
from univoxel.sphere import fibonacci_sphere, latlong_directions, real_harmonics

VENDOR = Path(page.__file__).parent / "web" / "vendor"
SMALL = page.PageOptions(title='"Balls" </script> & more', faces=500, texture_size=128)


@pytest.fixture(scope="module")
def scene():
    return lopsided(voxels=24**3)


@pytest.fixture(scope="module")
def text(scene, tmp_path_factory):
    run = tmp_path_factory.mktemp("run")
    (run / "trust.txt").write_text("Nothing <b>is sure.\n")
    lines = (
        {"seconds": 30.0 + i, "held_out_psnr": psnr} for i, psnr in enumerate((20, 31.25, None))
    )
    (run / "log.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    options = {"measures": {"novel views, PSNR, dB": "32.1"}, "notes": "A note."}
    return page.page_text(run, scene, page.PageOptions(**vars(SMALL) | options))


def embedded(text, name):
    return re.search(rf'<script id="{name}" type="[^"]*">(.*?)</script>', text, re.DOTALL)[1]


def test_the_page_is_whole(text):
    """It names nothing to load, and tells what the run tells."""
    assert "default-src 'none'" in text
    assert not re.search(r'(?:src|href)\s*=\s*"(?!data:)', text)
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]
    assert re.findall(r"url\((?!data:)", style) == []
    assert "&quot;Balls&quot; &lt;/script&gt; &amp; more</h1>" in text
    assert "trained in 32 s on the CPU \u00b7 validation 31.2 dB" in text
    assert "Nothing &lt;b&gt;is sure." in text
    assert "<td>novel views, PSNR, dB<td>32.1" in text
    assert "A note." in text
    assert "MIT licence" in text
    assert "Permission is hereby granted, free of charge" in text  # three's
    assert text.count("</script>") == 4
    assert len(text) < 10e6


USUAL = ["studio", "city", "sunset", "overcast"]


def test_lights_of_the_page(text, scene, tmp_path):
    described = json.loads(embedded(text, "scene"))
    names = [light["name"] for light in described["lights"]]
    assert names == ["recovered", *USUAL]
    assert described["view"] == list(page.START)  # there are no photographs
    first = described["lights"][0]
    half = np.frombuffer(base64.b64decode(first["texels"]), "<f2").reshape(first["height"], -1, 3)
    truth = scene.environment().latlong(first["height"]).detach().numpy()
    np.testing.assert_allclose(half, truth, rtol=1e-3, atol=1e-6)
    written = page.as_json(page.Light("sun", torch.full((1, 2, 3), 1e6)))  # too bright for halves
    assert np.isfinite(np.frombuffer(base64.b64decode(written["texels"]), "<f2")).all()
    # Own maps take the place of usual ones; after <!--<script a browser does not see its end
    paths = [tmp_path / "studio.exr", tmp_path / "<!--<script>.exr"]
    for path in paths:
        write_exr(path, {c: torch.ones(4, 8) for c in "RGB"})
    options = page.PageOptions(**vars(SMALL) | {"envmaps": paths})
    held = embedded(page.page_text(tmp_path, scene, options), "scene")
    assert "<" not in held
    names = [light["name"] for light in json.loads(held)["lights"]]
    assert names == ["recovered", "studio", "<!--<script>", *USUAL[1:]]
    without = lopsided(voxels=8**3)
    without.sky = None
    assert [light.name for light in page.lights_of(without, SMALL)] == USUAL


def test_the_model_holds_what_light_reaches_it(text):
    model = Glb(base64.b64decode(embedded(text, "model")))
    assert {kind for kind, _, _ in model.pictures()} == {"image/jpeg"}
    extra = {name for name in vars(model.primitive.attributes) if name.startswith("_")}
    assert extra == {*(f"_DIRECT{i}" for i in range(7)), "_RED", "_GREEN", "_BLUE"}
    stored = model.accessor("_DIRECT0")
    assert (stored.componentType, stored.normalized) == (5122, True)  # SHORT
    numbers = model.values("_DIRECT0") / 32767
    open_sky = numbers[:, 0] / 0.282095
    assert len(numbers) == model.accessor("POSITION").count
    assert open_sky.max() == pytest.approx(1, abs=0.01)  # the far side of the large ball
    assert 0.7 < open_sky.min() < 0.9  # where two balls meet


def mesh_of(vertices, faces, albedo):
    """A mesh as the exporter makes it, of one colour; its texture says no more."""
    corner = vertices[faces]
    across = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = torch.zeros_like(vertices)
    for k in range(3):
        normal.index_add_(0, faces[:, k], across)
    normal = torch.nn.functional.normalize(normal, dim=1)
    count = len(vertices)
    return TexturedMesh(
        vertices,
        faces.int(),
        normal,
        torch.tensor([1.0, 0, 0, 1]).expand(count, 4),
        torch.rand(count, 2, generator=torch.Generator().manual_seed(1)),
        torch.zeros(2, 2, 3),
        torch.tensor(albedo).expand(2, 2, 3),
        torch.ones(2, 2),
    )


def hollowed(points, distance):
    """A bowl in the side of the large ball."""
    return torch.maximum(distance, 0.3 - (points - torch.tensor([-0.3, -0.1, 0])).norm(dim=-1))


def test_transfer_is_the_light_that_a_path_tracer_finds():
    """Under light of degree 1 nothing is cut off: both see the same shadows and colours."""
    scene = lopsided(voxels=24**3, change=hollowed)
    vertices, faces = scene.field.isosurface()
    faces, albedo = faces.long(), (0.9, 0.5, 0.2)
    mesh = mesh_of(vertices, faces, albedo)
    offset = 0.1 * scene.field.voxel_size
    direct, bounced = transfer(mesh, offset)
    direction = latlong_directions(32)
    radiance = 1 + direction @ torch.tensor([[0.5, 0.1, 0], [0.2, 0.5, 0], [-0.3, 0.1, 0.6]])
    numbers = page.harmonics(radiance)
    ours = direct @ numbers + torch.einsum("pck,kc->pc", bounced, numbers[:4])

    some = torch.randperm(len(vertices), generator=torch.Generator().manual_seed(0))[:300]
    traced_mesh = Mesh(
        vertices,
        faces.int(),
        mesh.normals,
        torch.tensor(albedo).expand_as(vertices).contiguous(),
        torch.ones(len(vertices)),
    )
    # What is white and matte shows its irradiance over pi
    white = torch.ones(300, 3)
    truth = relight(
        VisibilityScene(vertices, faces),
        traced_mesh,
        tables(EnvMap(radiance)),
        vertices[some],
        mesh.normals[some],
        mesh.normals[some],
        white,
        torch.ones(300),
        f0=0.0,
        mesh_f0=0.0,
        offset=offset,
        samples=512,
        bounces=2,
    )
    error = ours[some] - truth
    hollow = direct[some, 0] < 0.7 * 0.282095
    assert hollow.sum() > 20
    # 256 rays, 512 samples, and the little gloss of a surface whose F0 is 0; without what the
    # hollow's walls send, it would be off by a sixth
    assert error.abs().mean() < 0.015
    assert error[hollow].abs().mean() < 0.015


def test_a_ball_alone_sees_all_the_sky():
    """Convex: the numbers are those of the clamped cosine, and nothing bounces."""
    points = fibonacci_sphere(400)
    faces = torch.from_numpy(ConvexHull(points.numpy()).simplices.astype(np.int64))
    corner = points[faces]
    outside = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    flip = (outside * corner[:, 0]).sum(1) < 0
    faces[flip] = faces[flip].flip(1)
    mesh = mesh_of(points, faces, (0.5, 0.5, 0.5))
    direct, bounced = transfer(mesh, 1e-3)
    of_degree = [1.0] + 3 * [2 / 3] + 5 * [1 / 4] + 7 * [0.0] + 9 * [-1 / 24]
    expected = real_harmonics(4, mesh.normals) * torch.tensor(of_degree)
    # 256 rays; neighbours' faces rise above the tangent plane of none
    torch.testing.assert_close(direct, expected, atol=0.01, rtol=0)
    assert bounced.abs().max() == 0


def test_vertices_take_the_texel_they_lie_in():
    mesh = mesh_of(torch.eye(3), torch.tensor([[0, 1, 2]]), (0.0, 0.0, 0.0))
    texture = torch.arange(12.0).view(2, 2, 3)
    uv = torch.tensor([[0.1, 0.9], [1.0, 1.0], [0.2, 0.0]])  # v upwards, row 0 on top
    found = vertex_albedo(TexturedMesh(**vars(mesh) | {"albedo": texture, "uv": uv}))
    assert found[:, 0].tolist() == [0.0, 3.0, 6.0]


def test_harmonics_of_a_map():
    """A constant has one number; a map made of harmonics gives them back."""
    constant = page.harmonics(torch.ones(16, 32, 3))
    assert constant[0, 0] == pytest.approx(math.sqrt(4 * math.pi), rel=1e-3)
    assert constant[1:].abs().max() < 0.02  # of the quadrature
    basis = real_harmonics(page.DEGREE, latlong_directions(128))
    found = page.harmonics((0.3 * basis[..., 0] + 0.2 * basis[..., 7])[..., None].expand(-1, -1, 3))
    expected = torch.zeros(25)
    expected[[0, 7]] = torch.tensor([0.3, 0.2])
    torch.testing.assert_close(found[:, 1], expected, atol=2e-3, rtol=0)


def test_made_maps_light_a_white_ball_as_paper():
    """Under exposure 1 the brightest side of a matte white ball is neither grey nor clipped."""
    for light in page.usual_lights():
        assert light.radiance.isfinite().all()
        assert light.radiance.min() >= 0
        if light.name in page.PHOTOGRAPHED:
            continue
        direction = latlong_directions(len(light.radiance)).flatten(0, 1)
        area = page.sphere.texel_solid_angles(*light.radiance.shape[:2]).flatten()
        cosine = (fibonacci_sphere(200) @ direction.T).clamp_min(0)
        ball = cosine @ (area[:, None] * light.radiance.flatten(0, 1)) / math.pi
        assert 0.6 < ball.max() < 1.1, light.name
    direction = latlong_directions(page.ROWS)
    brightest = page.studio().sum(2).flatten().argmax()
    phi = math.degrees(math.atan2(*direction.flatten(0, 1)[brightest, :2].flip(0).tolist()))
    assert phi == pytest.approx(40, abs=20)  # where the studio's key is said to stand


def test_a_large_map_is_averaged(tmp_path):
    radiance = torch.rand(512, 1024, 3, generator=torch.Generator().manual_seed(0))
    write_exr(tmp_path / "hall.exr", dict(zip("RGB", radiance.unbind(2), strict=True)), half=False)
    light = page.light_of_file(tmp_path / "hall.exr")
    assert light.name == "hall"
    expected = radiance.view(256, 2, 512, 2, 3).mean((1, 3))
    torch.testing.assert_close(light.radiance, expected)


def test_mistakes_are_named(tmp_path):
    with pytest.raises(MissingFile, match=r"scene\.safetensors"):
        view(tmp_path)  # before it listens to anybody
    with pytest.raises(UserError, match=r"expected a file that ends in \.html, got .*mug\.png"):
        view(tmp_path, tmp_path / "mug.png")
    with pytest.raises(MissingFile, match=r"scene\.safetensors"):
        view(tmp_path, tmp_path / "mug.html")
    with pytest.raises(UserError, match=r"different names, got .*hall.*hall"):
        page.PageOptions(envmaps=["a/hall.exr", "b/hall.hdr"])
    (tmp_path / "broken.hdr").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"broken\.hdr"):
        page.light_of_file(tmp_path / "broken.hdr")
    assert not (tmp_path / "mug.html").exists()


def test_a_page_is_written_whole(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "load_checkpoint", lambda run: (scene, {"seconds": 61.0}))
    line = {"seconds": 55.0, "held_out_psnr": None}
    (tmp_path / "log.jsonl").write_text(json.dumps(line) + "\n")
    target = tmp_path / "new" / "mug.html"
    assert page.write_page(tmp_path, target, **vars(SMALL)) == target
    assert [path.name for path in target.parent.iterdir()] == ["mug.html"]
    text = target.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>")
    assert "trained in 61 s" in text  # the log ends before the training
    for damaged in ("", "{", '{"seconds": 3}\n', "[1]\n", '{"seconds": "a", "held_out_psnr": 1}\n'):
        (tmp_path / "log.jsonl").write_text(damaged)
        assert page.facts_of(tmp_path) == []


def test_training_names_its_page_and_ends_well_without(tmp_path, monkeypatch, caplog):
    write = Mock(side_effect=[tmp_path / "index.html", NoSurface("there is no surface")])
    monkeypatch.setattr("univoxel.output.page.write_page", write)
    with caplog.at_level(logging.INFO, "univoxel"):
        assert with_page(tmp_path) == with_page(tmp_path) == tmp_path
    named, then, without = caplog.messages
    assert named == f"Page: open {tmp_path / 'index.html'} in a browser"
    assert then.startswith(f"Next: univoxel view {tmp_path}, or univoxel export {tmp_path} ")
    assert without == "the web page was not written: there is no surface"


def test_a_notebook_shows_the_page(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("univoxel.api.load_scene", lambda run: scene)
    monkeypatch.setattr("univoxel.api.SMALL", SMALL)
    shown = Run(tmp_path)._repr_html_()
    inside = re.fullmatch(r'<iframe srcdoc="([^"]*)" style="[^"]*"></iframe>', shown)[1]
    assert html.unescape(inside).startswith("<!doctype html>")
    monkeypatch.setattr("univoxel.api.page_text", Mock(side_effect=NoSurface("none")))
    assert Run(tmp_path)._repr_html_() is None


def test_the_bundle_is_the_one_that_was_checked():
    said = re.search(r"([0-9a-f]{64})  three\.min\.js", (VENDOR / "README.md").read_text("utf-8"))
    bundle = (VENDOR / "three.min.js").read_bytes()
    assert hashlib.sha256(bundle).hexdigest() == said[1]
    assert b"</script" not in bundle  # it stands in one
    assert (VENDOR / "LICENSE").read_text("utf-8").startswith("The MIT License")
