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


def test_blur_is_less_sharp_and_the_sharpest_of_each_group_is_taken():
    assert sharpest([1, 3, 2, 9, 8, 7, 4], 3) == [1, 3, 6]
    assert sharpest([], 3) == []
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


def test_sharp_frames_are_kept_all_along(film, tmp_path, monkeypatch):
    assert seconds(film) == pytest.approx(4, abs=0.2)
    count = write_frames(film, tmp_path, every=0.5)
    files = sorted(tmp_path.glob("frame_*.jpg"))
    assert len(files) == count == 8
    corners = [np.asarray(Image.open(path))[4:20, 4:20].mean() for path in files]
    assert min(corners) > 200  # all sharp, though two of three are not
    monkeypatch.setattr(photographs, "KEPT", 5)
    assert write_frames(film, tmp_path / "few") == 5
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "concat:film.mp4"  # a name is no protocol
    path.write_bytes(film.read_bytes())
    assert seconds(path.relative_to(tmp_path)) == pytest.approx(4, abs=0.2)


def ffmpeg(*arguments, **options):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *map(str, arguments)]
    return subprocess.run(command, check=True, **options)


def test_a_turned_video_comes_upright(film, tmp_path):
    turned = tmp_path / "turned.mp4"
    ffmpeg("-display_rotation:v:0", 90, "-i", film, "-c", "copy", turned)
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
    given = ["-loop", "1", "-framerate", "5", "-i", tmp_path / "a.png", "-t", "1", "-vf", scale]
    made = ["-color_range", "pc" if full else "tv", "-crf", "4"]
    made += ["-pix_fmt", "yuvj420p" if full else "yuv420p", tmp_path / "a.mp4"]
    ffmpeg(*given, *tag, *drop, *made)
    assert write_frames(tmp_path / "a.mp4", tmp_path / "100% wool") == 1  # it stands still
    found = np.asarray(Image.open(tmp_path / "100% wool/frame_00000.jpg"))
    middles = found[height // 2, height // 8 :: height // 4].tolist()
    np.testing.assert_allclose(middles, COLORS, atol=6)


# From linear Rec. 709 to other primaries of the same white, as standards print them
TO_2020 = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
TO_P3 = [[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]]


def of_709(code):
    return np.where(code < 0.081, code / 4.5, ((code + 0.099) / 1.099) ** (1 / 0.45))


def in_709(light):
    return np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)


def paper(srgb):
    """Linear BT.2020 of numbers in sRGB, in cd/m2, paper as bright as BT.2408 has it."""
    return (
        203
        * np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        @ np.array(TO_2020).T
    )


def hlg(srgb):
    light = paper(srgb) / 1000
    light *= (light @ [0.2627, 0.678, 0.0593])[:, None] ** (1 / 1.2 - 1)
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(light < 1 / 12, np.sqrt(3 * light), a * np.log((12 * light - b).clip(1e-9)) + c)


def pq(srgb):
    power = (paper(srgb) / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


@pytest.mark.parametrize(
    ("codes", "matrix", "primaries", "curve"),
    [
        (lambda srgb: in_709(of_709(srgb) @ np.array(TO_2020).T), "bt2020", "bt2020", "bt2020-10"),
        (lambda srgb: in_709(of_709(srgb) @ np.array(TO_2020).T), "bt2020", "unknown", "unknown"),
        (lambda srgb: in_709(of_709(srgb) @ np.array(TO_P3).T), "bt709", "smpte432", "bt709"),
        (lambda srgb: srgb, "bt709", "bt709", "unknown"),
        (hlg, "bt2020", "bt2020", "arib-std-b67"),
        (pq, "bt2020", "bt2020", "smpte2084"),
    ],
)
def test_wide_colours_and_hdr_become_those_of_709(
    tmp_path, caplog, codes, matrix, primaries, curve
):
    """And pixels twice as wide as high become square."""
    row = codes(np.repeat(np.array(COLORS) / 255, 20, 0))
    frame = np.round(65535 * row).astype("<u2")[None].repeat(64, 0)
    tags = f"setsar=2,setparams=color_primaries={primaries}:color_trc={curve}"
    given = ["-f", "rawvideo", "-r", "5", "-pix_fmt", "rgb48le", "-s", "80x64", "-i", "-", "-vf"]
    given += [f"scale=out_color_matrix={matrix}:out_range=tv,{tags}", "-c:v", "libx264"]
    made = ["-pix_fmt", "yuv420p10le", "-crf", "2", tmp_path / "a.mp4"]
    ffmpeg(*given, *made, input=5 * frame.tobytes())
    assert write_frames(tmp_path / "a.mp4", tmp_path / "frames") == 1
    found = np.asarray(Image.open(tmp_path / "frames/frame_00000.jpg"))
    assert found.shape == (64, 160, 3)
    np.testing.assert_allclose(found[32, 20::40], COLORS, atol=6 if curve == "smpte2084" else 4)
    assert ("(HDR) were tone mapped" in caplog.text) == (codes in (hlg, pq))


def test_frames_that_are_doubled_are_taken_once(film, tmp_path):
    """As recorders of screens write them; noise of the encoder makes no picture of its own."""
    slow = "select='not(mod(n,10))',setpts=N/TB,fps=20,noise=alls=1:allf=t"
    ffmpeg("-i", film, "-vf", slow, "-crf", "30", tmp_path / "a.mp4")
    assert write_frames(tmp_path / "a.mp4", tmp_path / "frames", every=0.25) <= 4


def test_a_recording_that_does_not_know_its_length(film, tmp_path):
    """As browsers write them, while they come."""
    options = ["-c", "copy", "-f", "matroska", "-live", "1", "-"]
    done = ffmpeg("-i", film, *options, capture_output=True)
    (tmp_path / "a.mkv").write_bytes(done.stdout)
    assert seconds(tmp_path / "a.mkv") == pytest.approx(3.9, abs=0.15)  # begin of the last


def test_what_is_no_video_is_one_line(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video" * 50)
    assert is_video(path)
    assert not is_video(tmp_path)
    for every in (None, 1.0):
        with pytest.raises(DataError, match=r"a.mp4: .*this video"):
            write_frames(path, tmp_path / "frames", every)


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
    monkeypatch.setattr(photographs.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match="a video needs imageio-ffmpeg"):
        tasks_poses.photographs_of(film, folders, None)


@pytest.mark.parametrize(
    "text", ["ffconcat version 1.0\nfile {}\n", "#EXTM3U\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n"]
)
def test_lists_of_other_files_are_no_videos(film, tmp_path, text):
    """ffmpeg goes by what a file holds, and reads the files that lists name."""
    (tmp_path / "secret.mp4").write_bytes(film.read_bytes())
    path = tmp_path / "list.mp4"
    path.write_text(text.format("secret.mp4"))
    for every in (None, 0.5):
        with pytest.raises(DataError, match=r"list\.mp4: this video could not be read"):
            write_frames(path, tmp_path / "frames", every)
