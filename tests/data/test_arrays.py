"""Files of NumPy that cannot be read end in one line."""

import io
import zipfile

import numpy as np
import pytest

from univoxel.data.path_sandbox import read_npy, read_npz
from univoxel.errors import DataError


def header(text):
    """A .npy file whose header says so."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def archive(change):
    """A .npz file with bytes of its lists changed."""
    stream = io.BytesIO()
    np.savez(stream, a=np.ones(3))
    data = bytearray(stream.getvalue())
    for magic, offset, value in change:
        data[data.index(magic) + offset] = value
    return bytes(data)


SHAPE = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s,)}\n"


@pytest.mark.parametrize(
    "content",
    [b"", b"text", header("{"), header(SHAPE % (10**30)), header(SHAPE % 7), header("[1]\n")],
)
def test_broken_npy(tmp_path, content):
    path = tmp_path / "a.npy"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.npy: this NumPy array could not be read"):
        read_npy(path)


def test_an_archive_is_no_array(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.ones(3))
    with pytest.raises(DataError, match="expected one NumPy array, got an archive of several"):
        read_npy(tmp_path / "a.npz")
    with pytest.raises(DataError, match="this NumPy array could not be read"):
        read_npy(tmp_path / "none.npy")


LOCAL, CENTRAL = b"PK\x03\x04", b"PK\x01\x02"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"text",
        archive([(LOCAL, 8, 99), (CENTRAL, 10, 99)]),  # packed by no known method
        archive([(LOCAL, 6, 1), (CENTRAL, 8, 1)]),  # encrypted
        archive([(b"NUMPY", 60, 7)]),  # of another checksum
    ],
)
def test_broken_npz(tmp_path, content):
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.npz: this npz file could not be read"):
        read_npz(path)


def test_arrays_of_another_prefix_are_not_looked_at(tmp_path):
    np.savez(tmp_path / "a.npz", mat_0=np.ones(2), other=np.array([{}], object))
    assert list(read_npz(tmp_path / "a.npz", "mat_")) == ["mat_0"]
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        assert len(file.namelist()) == 2
