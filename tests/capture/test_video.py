"""Frames of a video: sharp ones, spread over it, upright."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from univoxel.capture import photographs
from univoxel.capture import poses as tasks_poses
from univoxel.capture.photographs import is_video, seconds, sharpest, sharpness, write_frames
from univoxel.capture.prepare import Folders
from univoxel.errors import DataError, MissingExtra


def test_the_sharpest_of_each_group():
    assert sharpest([1, 3, 2, 9, 8, 7, 4], 3) == [1, 3, 6]
    assert sharpest([], 3) == []


def test_blur_is_less_sharp():
    noise = np.random.default_rng(0).integers(0, 256, (60, 80)).astype(np.uint8)
    assert sharpness(noise) > 2 * sharpness(gaussian_filter(noise, 1.0))


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Four seconds of a pattern that drifts; every third picture is sharp, told by its corner."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    noise = gaussian_filter(np.random.default_rng(1).normal(size=(120, 400)), 1.0)
    pattern = (127 + 200 * noise).clip(0, 255)
    writer = imageio_ffmpeg.write_frames(str(path), (160, 120), fps=10, macro_block_size=2)
    writer.send(None)
    for n in range(40):
        frame = pattern[:, 4 * n : 4 * n + 160]
        sharp = n % 3 == 0
        if not sharp:
            frame = gaussian_filter(frame, 3.0)
        frame = np.repeat(frame[..., None], 3, -1).astype(np.uint8)
        frame[:24, :24] = 255 if sharp else 0
        frame[:24, 24:48] = 0, 0, 255  # at the top, left of the middle
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    return path


def test_sharp_frames_are_kept_all_along(film, tmp_path):
    assert seconds(film) == pytest.approx(4, abs=0.2)
    count = write_frames(film, tmp_path, every=0.5)
    files = sorted(tmp_path.glob("frame_*.jpg"))
    assert len(files) == count == 8
    corners = [np.asarray(Image.open(path))[4:20, 4:20].mean() for path in files]
    assert min(corners) > 200  # all sharp, though two of three are not


def test_the_number_of_frames_is_limited(film, tmp_path, monkeypatch):
    monkeypatch.setattr(photographs, "KEPT", 5)
    assert write_frames(film, tmp_path) == 5


def test_a_turned_video_comes_upright(film, tmp_path):
    turned = tmp_path / "turned.mp4"
    program = imageio_ffmpeg.get_ffmpeg_exe()
    command = [program, "-v", "error", "-display_rotation:v:0", "90", "-i", str(film), "-c", "copy"]
    subprocess.run([*command, str(turned)], check=True)
    write_frames(turned, tmp_path / "frames", every=1.0)
    with Image.open(tmp_path / "frames/frame_00000.jpg") as picture:
        assert picture.size == (120, 160)


COLORS = [(200, 40, 40), (40, 160, 60), (50, 70, 200), (190, 170, 60)]


@pytest.mark.parametrize(
    ("matrix", "full", "tagged", "height"),
    [
        ("bt709", False, True, 64),
        ("bt709", True, True, 64),
        ("bt601", False, True, 64),
        ("bt601", False, False, 64),
        ("bt709", False, False, 720),  # as players take it
    ],
)
def test_colours_are_those_of_the_video(tmp_path, matrix, full, tagged, height):
    picture = np.repeat(np.array(COLORS, np.uint8), height // 4, 0)[None].repeat(height, 0)
    Image.fromarray(picture).save(tmp_path / "a.png")
    scale = f"scale=out_color_matrix={matrix}:out_range={'pc' if full else 'tv'}"
    tag = ["-colorspace", "smpte170m" if matrix == "bt601" else matrix] if tagged else []
    drop = [] if tagged else ["-bsf:v", "h264_metadata=matrix_coefficients=2"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-loop", "1", "-framerate", "5"]
    command += ["-i", str(tmp_path / "a.png"), "-t", "1", "-vf", scale, *tag, *drop]
    command += ["-color_range", "pc" if full else "tv", "-crf", "4"]
    command += ["-pix_fmt", "yuvj420p" if full else "yuv420p", str(tmp_path / "a.mp4")]
    subprocess.run(command, check=True)
    assert write_frames(tmp_path / "a.mp4", tmp_path / "100% wool") == 1  # it stands still
    found = np.asarray(Image.open(tmp_path / "100% wool/frame_00000.jpg"))
    middles = found[height // 2, height // 8 :: height // 4].tolist()
    np.testing.assert_allclose(middles, COLORS, atol=6)


def test_hdr_is_told(film, tmp_path, caplog):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(film), "-c", "copy"]
    curve = "h264_metadata=transfer_characteristics=18:matrix_coefficients=9:colour_primaries=9"
    subprocess.run([*command, "-bsf:v", curve, str(tmp_path / "a.mp4")], check=True)
    write_frames(tmp_path / "a.mp4", tmp_path / "frames", every=1.0)
    assert "a.mp4: colours of HLG (HDR) come out flat: record without HDR" in caplog.text


def test_a_recording_that_does_not_know_its_length(film, tmp_path):
    """As browsers write them, while they come."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(film), "-c", "copy"]
    piped = [*command, "-f", "matroska", "-live", "1", "-"]
    done = subprocess.run(piped, check=True, capture_output=True)
    (tmp_path / "a.mkv").write_bytes(done.stdout)
    assert seconds(tmp_path / "a.mkv") == pytest.approx(3.9, abs=0.15)  # begin of the last


def test_what_is_no_video_is_one_line(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video" * 50)
    assert is_video(path)
    assert not is_video(tmp_path)
    with pytest.raises(DataError, match=r"a.mp4: expected a video"):
        write_frames(path, tmp_path / "frames")
    with pytest.raises(DataError, match=r"a.mp4: expected a video"):
        write_frames(path, tmp_path / "frames", every=1.0)


def test_frames_are_chosen_once_and_anew_for_other_wishes(film, tmp_path, monkeypatch):
    calls = []
    write = photographs.write_frames
    monkeypatch.setattr(
        photographs, "write_frames", lambda *args: calls.append(args[2]) or write(*args)
    )
    folders = Folders(tmp_path)
    for every, frames in ((0.5, 8), (0.5, 8), (2.0, 2)):
        files, others, doubles = tasks_poses.photographs_of(film, folders, every)
        assert (len(files), others, doubles) == (frames, [], 0)
    assert calls == [0.5, 2.0]


def test_without_ffmpeg_nothing_is_read(film, tmp_path, monkeypatch):
    monkeypatch.setattr(photographs.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match="a video needs imageio-ffmpeg"):
        tasks_poses.photographs_of(film, Folders(tmp_path), None)


@pytest.mark.parametrize(
    "text", ["ffconcat version 1.0\nfile {}\n", "#EXTM3U\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n"]
)
def test_lists_of_other_files_are_no_videos(film, tmp_path, text):
    """ffmpeg goes by what a file holds, and reads the files that lists name."""
    (tmp_path / "secret.mp4").write_bytes(film.read_bytes())
    path = tmp_path / "list.mp4"
    path.write_text(text.format("secret.mp4"))
    with pytest.raises(DataError, match=r"list\.mp4: expected a video, could not read it"):
        write_frames(path, tmp_path / "frames")
    with pytest.raises(DataError, match=r"list\.mp4: expected a video, could not read it"):
        write_frames(path, tmp_path / "frames", every=0.5)


def test_a_name_is_no_protocol(film, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "concat:film.mp4"
    path.write_bytes(film.read_bytes())
    assert seconds(path.relative_to(tmp_path)) == pytest.approx(4, abs=0.2)
