"""Radiance pictures (.hdr): pixels of a shared exponent, flat or in run lengths; written flat."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from univoxel.errors import DataError
from univoxel.files import replacing

SMALLEST = 2.0**-128  # what is darker has no exponent: black
# x and y of red, green, blue and white: of Rec. 709, which colours here are of, and of Radiance,
# whose writers state it whatever colours they have
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
OF_RADIANCE = (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 0.3333, 0.3333)
NEAR = 2e-3  # by which primaries may differ and are the same
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
LARGEST = 255 * 2.0**119  # the largest number of the format


def read_radiance(path: Path) -> np.ndarray:
    """Linear RGB [H, W, 3] float32: mantissa * 2^(exponent - 136), exactly; 0 where exponent is 0.

    EXPOSURE lines are not applied, as in other readers. Colours of stated PRIMARIES become those of
    Rec. 709.

    Raises:
        DataError: not a Radiance RGBE picture, cut off, or of an orientation or encoding other than
            -Y +X rows, flat or with run lengths per channel.
        OSError: the file cannot be read.

    Source: Ward 1991, "Real pixels" (Graphics Gems II), and the Radiance file format description.
    """
    data = path.read_bytes()
    if not data.startswith(b"#?"):
        raise DataError(f"{path}: expected a Radiance picture (first bytes '#?'), got {data[:8]!r}")
    head, blank, rest = data.partition(b"\n\n")
    line, newline, body = rest.partition(b"\n")
    if not (blank and newline):
        raise DataError(f"{path}: expected a header and pixels, the file ends before")
    if form := re.search(rb"^FORMAT=(.*)$", head, re.MULTILINE):
        if form[1].strip() != b"32-bit_rle_rgbe":
            raise DataError(f"{path}: expected FORMAT=32-bit_rle_rgbe, got {form[1].strip()!r}")
    size = re.fullmatch(rb"\s*-Y\s+(\d{1,9})\s+\+X\s+(\d{1,9})\s*", line)
    if not size or not (int(size[1]) and int(size[2])):
        raise DataError(f"{path}: expected the size as '-Y height +X width', got {line[:40]!r}")
    height, width = int(size[1]), int(size[2])

    # A flat file cannot start with the marker: its largest mantissa would be below 128.
    marker = bytes([2, 2, width >> 8 & 255, width & 255])
    if 8 <= width < 32768 and body.startswith(marker):
        rgbe = _run_lengths(path, np.frombuffer(body, np.uint8), marker, height, width)
    elif len(body) == 4 * height * width:
        rgbe = np.frombuffer(body, np.uint8).reshape(height, width, 4)
    else:
        raise DataError(
            f"{path}: expected {4 * height * width} bytes of {width}x{height} flat pixels or "
            f"run-length encoded rows, got {len(body)} bytes"
        )
    exponent = rgbe[..., 3:].astype(np.int32)
    value = np.ldexp(rgbe[..., :3].astype(np.float32), exponent - 136)
    value = np.where(exponent > 0, value, np.float32(0))
    stated = re.search(rb"^PRIMARIES=\s*((?:[\d.]+\s+){7}[\d.]+)\s*$", head, re.MULTILINE)
    return in_rec709(value, [float(x) for x in stated[1].split()]) if stated else value


def in_rec709(rgb: np.ndarray, stated: Sequence[float]) -> np.ndarray:
    """Linear colours [.., 3] float32 of stated primaries as those of Rec. 709, white as white; what
    only the wider space has becomes 0.

    Args:
        stated: x and y of red, green, blue and white. Numbers that are none change nothing.
    """
    usual = any(np.allclose(stated, known, atol=NEAR) for known in (REC_709, OF_RADIANCE))
    if len(stated) != 8 or usual or min(stated[1::2]) <= 0:
        return rgb
    (theirs, white), (ours, d65) = _to_xyz(stated), _to_xyz(REC_709)
    scale = np.diag((BRADFORD @ d65) / (BRADFORD @ white))
    matrix = np.linalg.inv(ours) @ np.linalg.inv(BRADFORD) @ scale @ BRADFORD @ theirs
    return np.maximum(rgb @ matrix.T, 0).astype(np.float32)


def _to_xyz(primaries: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """From linear RGB of primaries to XYZ [3, 3], and the XYZ of their white [3]."""
    *colors, white = (
        np.array([x / y, 1, (1 - x - y) / y])
        for x, y in zip(primaries[::2], primaries[1::2], strict=True)
    )
    matrix = np.stack(colors, 1)
    return matrix * np.linalg.solve(matrix, white), white


def write_radiance(path: Path, radiance: np.ndarray) -> None:
    """Write linear RGB [H, W, 3], at least 0, as flat pixels, whole or not at all.

    A channel is off by at most 1/256 of the pixel's largest channel, as `read_radiance` reads it.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
    """
    height, width, _ = radiance.shape
    value = np.minimum(radiance.astype(np.float64), LARGEST)
    largest = value.max(2)
    _, exponent = np.frexp(largest)
    # Mantissas of 255.5 and more would round to 256
    exponent += np.rint(np.ldexp(largest, 8 - exponent)) > 255
    mantissa = np.rint(np.ldexp(value, 8 - exponent[..., None]))
    rgbe = np.concatenate([mantissa, exponent[..., None] + 128], 2)
    rgbe[largest < SMALLEST] = 0
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    with replacing(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + rgbe.astype(np.uint8).tobytes())


def _run_lengths(
    path: Path, body: np.ndarray, marker: bytes, height: int, width: int
) -> np.ndarray:
    """Rows that start with the marker and hold each channel as runs (> 128) and literals."""
    shortest = 4 + 8 * -(-width // 127)  # bytes of a row: its marker, 4 channels of runs of 127
    # Memory for as many rows as there may be, whatever the header says
    out = np.empty((min(height, len(body) // shortest + 1), 4, width), np.uint8)
    at = 0
    for row in range(height):
        if body[at : at + 4].tobytes() != marker:
            raise DataError(f"{path}: row {row} of {height} is missing or broken")
        at += 4
        for channel in out[row]:
            x = 0
            while x < width:
                count = int(body[at]) if at < len(body) else 0
                run = count > 128
                count -= 128 if run else 0
                needed = 1 if run else count
                if not count or x + count > width or at + 1 + needed > len(body):
                    raise DataError(f"{path}: row {row} of {height} is cut off or broken")
                channel[x : x + count] = body[at + 1 : at + 1 + needed]
                x += count
                at += 1 + needed
    return out.transpose(0, 2, 1)
