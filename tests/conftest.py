"""What all tests run in."""

import getpass
import hashlib
import os
import tempfile
from pathlib import Path

import pytest
import textured_room
import torch
from analytic import write_scene
from asymmetric_scene import lopsided, subject_of
from tiny import plain, tiny, tiny_copy  # noqa: F401

from univoxel.data import load_images
from univoxel.preparation.stereo import depth_maps

# torch.compile has one cache for all processes of a user. It tells neither instruction sets apart,
# whose kernels give wrong values on another, nor what the arguments of our backward ops are.
_USER = getattr(os, "getuid", getpass.getuser)()
_OPS = sorted((Path(__file__).parent.parent / "univoxel" / "ops").glob("*.py"))
_SOURCES = hashlib.sha256(b"".join(path.read_bytes() for path in _OPS)).hexdigest()[:8]
_KIND = f"{torch.__version__}-{torch.backends.cpu.get_cpu_capability()}-{_SOURCES}"
_FOLDER = Path(tempfile.gettempdir()) / f"univoxel-tests-inductor-{_USER}-{_KIND}"
os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(_FOLDER))


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """A small data set of the sphere, which no test changes."""
    return write_scene(tmp_path_factory.mktemp("sphere") / "data", views=8, size=24)


@pytest.fixture(scope="session")
def room():
    """Photographs of an object on a patterned floor, in a room with furniture, and depth maps."""
    photos = textured_room.photos_of(textured_room.orbit(30, 160, 120))
    return photos, depth_maps(photos)


@pytest.fixture(scope="session")
def balls():
    """A scene without any symmetry, which no test changes."""
    return lopsided()


@pytest.fixture(scope="session")
def subject():
    """What the viewer shows of it where it is coarse."""
    return subject_of(lopsided(24**3))


@pytest.fixture
def read(monkeypatch):
    """The names of photographs that were read from their files."""
    names = []
    original = load_images.read_photo

    def noted(path, *rest):
        names.append(path.name)
        return original(path, *rest)

    monkeypatch.setattr(load_images, "read_photo", noted)
    return names
