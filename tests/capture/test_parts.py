"""Grouping, choosing pairs, judging, sizes: the parts of a capture that need no program."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from univoxel.capture.model import (
    NO_POINT,
    TRACK,
    Model,
    Placed,
    Points,
    read_model,
    read_models,
    without,
    write_model,
)
from univoxel.capture.photographs import Photograph
from univoxel.capture.pose_validation import still, why_not
from univoxel.capture.prepare import Capture, group, in_words
from univoxel.capture.scene import own_sizes
from univoxel.capture.structure import choose, features_each, similarities
from univoxel.data.lens import Lens


def photo(name="a.jpg", width=40, height=30, camera="", focal=(0.0, 0.0)) -> Photograph:
    return Photograph(Path(name), width, height, camera, focal)


def test_one_lens_at_one_zoom_is_one_camera_held_either_way():
    wide, long = (4.2, 26.0), (9.0, 77.0)
    photographs = [
        photo("a", 40, 30, "Phone", wide),
        photo("b", 30, 40, "Phone", wide),
        photo("c", 40, 30, "Phone", long),
        photo("d", 40, 30, "Other", wide),
        photo("e", 20, 15, "Phone", wide),
        photo("f", 40, 30, "Phone", long),
        photo("g", 40, 30, "Phone", wide),
    ]
    groups = group(photographs)
    assert groups == [[0, 1, 6], [2, 5], [3], [4]]
    said = in_words(photographs, groups)
    assert said.startswith("7 photographs from 4 cameras (2 models, 2 zoom settings, 2 sizes), ")
    assert said.endswith("1 of them in portrait orientation")
    assert in_words(photographs[:1], [[0]]) == "1 photographs from Phone (40x30)"


def _features(seed, count=40):
    found = np.abs(np.random.default_rng(seed).normal(size=(count, 128))).astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_similarities_count_mutual_clear_matches():
    """Against the plain loop over features."""
    a, b = _features(0), _features(1, 30)
    b[:12] = a[5:17]  # twelve things that both show
    for row, step in ((12, 0.05), (13, 0.055)):  # one that the other shows twice: not clear
        b[row] = a[20] + step * _features(9)[row]
        b[row] /= np.linalg.norm(b[row])
    features = [a, b, np.zeros((0, 128), np.float32), _features(2, 25)]
    found = np.stack(list(similarities(features)))
    expected = np.zeros_like(found)
    for i, own in enumerate(features):
        for j, other in enumerate(features):
            if i == j or len(own) < 2 or len(other) < 2:
                continue
            distance = np.linalg.norm(own[:, None] - other, axis=-1)
            for r, row in enumerate(distance):
                best, second = np.sort(row)[:2]
                c = row.argmin()
                expected[i, j] += best < 0.8 * second and distance[:, c].argmin() == r
    np.testing.assert_array_equal(found, expected)
    assert found[0, 1] == 12
    assert found[1, 0] == 13  # seen from there it is clear which is the better one
    assert not found[2].any()


def test_pairs_are_the_best_partners_and_the_next_by_name():
    similar = np.zeros((6, 6), int)
    similar[0, 3], similar[0, 5], similar[0, 2] = 30, 20, 10
    pairs = choose(similar, partners=2)
    assert {(0, 3), (0, 5)} <= set(pairs)
    assert {(i, i + 1) for i in range(5)} <= set(pairs)
    assert all(i < j for i, j in pairs)
    assert len(pairs) == len(set(pairs))
    assert features_each(60) == features_each(150) == 512  # the work of choosing is bounded
    work = [n**2 * features_each(n) ** 2 for n in (150, 400, 1000)]
    assert max(work) <= work[0]
    counted = [(1, 2, 30, 7), (1, 3, 40, 2), (2, 3, 0, 7), (1, 4, 0, 1), (2, 4, 50, 3)]
    assert still(counted) == (1, 3)  # a shift alone counts


def test_reasons_of_photographs_without_a_place():
    features = {1: 0, 2: 900, 3: 900, 4: 900}
    pairs = [(2, 3, 12, 2), (3, 4, 80, 2)]
    assert why_not(None, features, pairs, {}) == "no features that can be matched"
    assert why_not(1, features, pairs, {}) == "no features that can be matched"
    few = "at most 12 matches with any other photograph, but 15 are needed"
    assert why_not(2, features, pairs, {}) == few
    assert why_not(3, features, pairs, {3: 4}).startswith("connected to 4 photographs")
    wrong = "80 matches with another photograph, but these contradict the other matches"
    assert why_not(4, features, pairs, {}) == wrong


def model(seed=0, views=6) -> Model:
    """Cameras around a point, which are held level in a world of any direction."""
    random = np.random.default_rng(seed)
    world = Rotation.random(random_state=seed).as_matrix()
    positions = random.normal(size=(40, 3))
    images = []
    for v in range(views):
        phi = 2 * np.pi * v / views
        place = np.array([5 * np.cos(phi), 5 * np.sin(phi), 2 + 0.3 * (v % 2)])
        forward = -place / np.linalg.norm(place)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(forward, right), forward]) @ world.T
        to_camera = np.concatenate([turn, (-turn @ world @ place)[:, None]], 1)
        seen = np.where(random.random(40) < 0.8, np.arange(40) + 1, NO_POINT)
        local = to_camera[:, :3] @ (world @ positions.T) + to_camera[:, 3:]
        xy = 100 * (local[:2] / local[2]).T + (80, 60)
        images.append(Placed(v + 1, 1, f"0/{v:05d}.jpg", to_camera, xy, seen))
    tracks = [
        np.array([(i.number, p) for i in images if i.point[p] == p + 1], TRACK) for p in range(40)
    ]
    points = Points(
        np.arange(40) + 1,
        positions @ world.T,
        random.integers(0, 256, (40, 3)).astype(np.uint8),
        random.random(40),
        tracks,
    )
    return Model({1: Lens(160, 120, (100.0, 100.0), (80.0, 60.0))}, images, points)


def _projected(found: Model, image: Placed) -> np.ndarray:
    lens = found.cameras[image.camera]
    x, y, z = image.to_camera[:, :3] @ found.points.position.T + image.to_camera[:, 3:]
    return np.stack(lens.seen(x / z, y / z), -1)


def test_a_model_is_read_as_it_was_written(tmp_path):
    one = model()
    write_model(tmp_path / "0", one)
    two = read_model(tmp_path / "0")
    assert [(i.number, i.camera, i.name) for i in two.images] == [
        (i.number, i.camera, i.name) for i in one.images
    ]
    for a, b in zip(one.images, two.images, strict=True):
        np.testing.assert_allclose(b.to_camera, a.to_camera, atol=1e-12)
        np.testing.assert_array_equal(b.xy, a.xy)
        np.testing.assert_array_equal(b.point, a.point)
    np.testing.assert_array_equal(two.points.position, one.points.position)
    np.testing.assert_array_equal(two.points.color, one.points.color)
    for a, b in zip(one.points.tracks, two.points.tracks, strict=True):
        np.testing.assert_array_equal(a, b)
    assert two.cameras == one.cameras
    assert two.error == pytest.approx(one.error)
    write_model(tmp_path / "1", model(views=3))
    assert [len(m.images) for m in read_models(tmp_path)] == [6, 3]  # the largest comes first
    two = without(one, {1, 2, 3})  # images that are left out leave no trace
    assert [i.number for i in two.images] == [4, 5, 6]
    for track in two.points.tracks:
        assert len(track) >= 2
        assert set(track["image"]) <= {4, 5, 6}
    kept = set(two.points.number.tolist())
    for image in two.images:
        assert set(image.point.tolist()) <= kept | {NO_POINT}


def test_pictures_of_their_own_size_see_the_same_points():
    """Landscape is enlarged; portrait is turned back and shrunk: projections fit features."""
    one = model(1)
    photographs = [photo(f"{v}.jpg", *((120, 160) if v % 2 else (160, 120))) for v in range(6)]
    capture = Capture(photographs, [list(range(6))])
    two = own_sizes(one, capture, 80)
    assert {(lens.width, lens.height) for lens in two.cameras.values()} == {(80, 60), (60, 80)}
    for v, image in enumerate(two.images):
        lens = two.cameras[image.camera]
        assert (lens.height > lens.width) == bool(v % 2)
        np.testing.assert_allclose(_projected(two, image), image.xy, atol=1e-9)
        assert image.name == f"{v}.jpg"
