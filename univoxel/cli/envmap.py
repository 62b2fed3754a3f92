"""The recovered environment map as a file, and its difference from the true one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from univoxel.cli.parsing import File, LightOf, Run, takes, written
from univoxel.core.choices import MAP_ROWS
from univoxel.errors import UserError, demand

if TYPE_CHECKING:
    from univoxel.evaluation.recovered_map import Comparison


@dataclass(frozen=True)
class EnvmapOptions:
    run: Run
    """folder of a trained run"""
    out: Annotated[File, written("FILE.exr|hdr")]
    """environment map to write, in linear radiance; a preview is written beside it"""
    height: Annotated[int, written("ROWS")] = MAP_ROWS
    """number of rows of the map, which has twice as many columns"""
    light_of: LightOf = None
    """write the light of this training view (name or number), see train --varying"""


@takes(EnvmapOptions)
def command(asked: EnvmapOptions) -> None:
    """Write the recovered light as an environment map."""
    found = envmap(**vars(asked))
    print(asked.out)
    if found:
        under = "under this map and the true one: PSNR"
        print(f"diffuse sphere {under} {found.ball_psnr:.1f} dB, after scaling each channel")
        print(f"chrome sphere {under} {found.mirror_psnr:.1f} dB")
        print(
            f"the brightest directions of the maps are {found.brightest_degrees:.1f} degrees apart"
        )


@takes(EnvmapOptions)
def envmap(asked: EnvmapOptions) -> Comparison | None:
    """Write the recovered environment map of a run and a preview; compare it with the true map.

    Photographs cannot separate the scale of light and albedo, per channel: the comparison removes
    this scale, but the file holds the map as recovered. The true map is envmaps/train.hdr or .exr
    in the data set. The preview, a .png of the same name, has a row for the recovered and one for
    the true map, each with a diffuse and a chrome sphere seen from +X, with +Z up.

    Returns:
        None if the data set has no true map.

    Raises:
        DataError: run or true map cannot be read.
        UserError: the run has no map; an argument out of range; light_of is no training view, or
            light does not vary.
        OSError: a file cannot be written.
    """
    import torch

    from univoxel.color import linear_to_srgb
    from univoxel.data.images import write_exr, write_png, write_radiance
    from univoxel.envmap import true_map
    from univoxel.evaluation.recovered_map import compare, exposure_of, recovered_map, scale_to
    from univoxel.render.pictures import map_and_balls
    from univoxel.run import trained_on
    from univoxel.scene import load_scene

    run, out = Path(asked.run), Path(asked.out)
    height = asked.height
    demand(height >= 1, "height", "at least 1", height)
    if out.suffix.lower() not in (".exr", ".hdr"):
        raise UserError(f"out: expected a name that ends in .exr or .hdr, got {out}", "out")
    scene = load_scene(run)
    scene.show_light_of(asked.light_of)
    recovered, true = recovered_map(scene, run, height), true_map(trained_on(run))
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix.lower() == ".hdr":
        write_radiance(out, recovered.numpy())
    else:
        write_exr(out, dict(zip("RGB", recovered.unbind(2), strict=True)), half=False)
    rows, result = [recovered], None
    if true is not None:
        recovered = recovered * scale_to(recovered, true)
        rows, result = [recovered, true], compare(recovered, true)
    exposure = exposure_of(rows[-1])
    picture = [torch.cat(map_and_balls(row * exposure, height), 1) for row in rows]
    write_png(out.with_suffix(".png"), linear_to_srgb(torch.cat(picture)))
    return result
