"""The package as a library: `univoxel.train`, `univoxel.open_run`, and what a `Run` can do."""

from __future__ import annotations

import html
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import torch
from torch import Tensor

from univoxel.camera import Cameras, stacked
from univoxel.cli.evaluate import evaluate
from univoxel.cli.export import export
from univoxel.cli.relight import relight_images
from univoxel.cli.report import report
from univoxel.cli.train import TrainOptions
from univoxel.cli.trainer import train as train_config
from univoxel.config import TrainConfig
from univoxel.core.choices import ELEVATION, MAP_ROWS
from univoxel.core.records import Mesh
from univoxel.detail.texture import albedo_near, page_options
from univoxel.envmap import EnvMap
from univoxel.errors import UserError
from univoxel.evaluation.recovered_map import recovered_map
from univoxel.output.page import SMALL, page_text, write_page
from univoxel.output.viewpoints import views_of
from univoxel.render.pipeline import extract_mesh, shade_hits, surface_of_view
from univoxel.run import Verdict, load_verdict
from univoxel.scene import Scene, load_scene
from univoxel.training.progress import LOG, TrainingProgress

__all__ = ["Run", "TrainingProgress", "open_run", "train"]


class Run:
    """A trained scene, and the folder that it lies in.

    Attributes:
        path: the folder, as training wrote it.
        scene: field, materials and light, in evaluation mode.
    """

    path: Path
    scene: Scene

    def __init__(self, path: str | Path) -> None:
        """
        Raises:
            MissingFile: no trained scene is there.
            DataError: it cannot be read.
        """
        self.path = Path(path)
        self.scene = load_scene(self.path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    def _repr_html_(self) -> str | None:
        """The page of `univoxel view` in a frame, for notebooks; None if there is no surface."""
        try:
            options = page_options(self.path) | {"texture_size": SMALL.texture_size}
            text = page_text(self.path, self.scene, replace(SMALL, **options))
        except UserError:
            return None
        style = "width: 100%; height: 600px; border: 0"
        return f'<iframe srcdoc="{html.escape(text)}" style="{style}"></iframe>'

    @torch.no_grad()
    def render(
        self, cameras: str | Path | Cameras = "test", resolution: int | None = None
    ) -> Tensor:
        """Pictures in the light of the photographs: [F, H, W, 4] linear RGBA, premultiplied.

        Args:
            cameras: "test" for the test views of the data trained on, "orbit" or "orbit N" for N
                frames around the object, a file in the form of transforms_test.json, or cameras.
            resolution: pixels along the width; None: as the data's, an orbit's 512.

        Raises:
            UserError: the cameras cannot be used.
        """
        _, views = views_of(self.path, cameras, resolution, ELEVATION, self.mesh())
        near, pictures = albedo_near(self.path), []
        for view in range(len(views)):
            surface, wo = surface_of_view(self.scene, views, view, near)
            rgb = shade_hits(self.scene, surface, wo)
            width, height = views.size(view)
            rgba = torch.cat([rgb, surface.opacity[:, None]], 1)
            pictures.append(rgba.reshape(height, width, 4))
        return stacked(pictures)

    def relight(
        self,
        envmap: str | Path | EnvMap | None = None,
        cameras: str | Path | Cameras = "test",
        **options: Any,
    ) -> Tensor:
        """Pictures under new light: [F, H, W, 4] linear RGBA, premultiplied.

        Args:
            envmap: a file, a map, or None for suns and point lights only.
            cameras, options: fields of `univoxel.cli.relight.RelightOptions`.

        Raises:
            UserError: a map or the cameras cannot be used, or a number is out of range.
        """
        return relight_images(self.path, envmap, cameras, **options)

    def export(self, path: str | Path, **options: Any) -> Path:
        """Write the surface with its materials as .glb, .usdz, .obj or .ply; return the file.

        Args:
            options: fields of `univoxel.cli.export.ExportOptions`, but run and mesh.

        Raises:
            UserError: an argument is out of range, or there is no surface.
            MissingExtra: .usdz without usd-core.
            OSError: a file cannot be written.
        """
        export(self.path, path, **options)
        return Path(path)

    def page(self, path: str | Path, **options: Any) -> Path:
        """Write one web page to look at it, to light it and to send it; return the file.

        Args:
            options: fields of `univoxel.output.page.PageOptions`.

        Raises:
            UserError: a map cannot be used, or there is no surface.
            OSError: a file cannot be read or written.
        """
        return write_page(self.path, path, **page_options(self.path) | options)

    def report(self, path: str | Path | None = None, **options: Any) -> Path:
        """Write one web page that says how good it is and what to photograph next; return the file.

        Args:
            path: .html file; report.html in the run's folder when left out.
            options: fields of `univoxel.output.report.ReportOptions`.

        Raises:
            UserError: an option is out of range, or there is no surface.
            OSError: a file cannot be read or written.
        """
        return report(self.path, path, **options)

    def light(self, height: int = MAP_ROWS) -> EnvMap:
        """The environment map that was recovered, `height` rows of it.

        Raises:
            UserError: this run has none: it was trained with local light only.
        """
        return EnvMap(recovered_map(self.scene, self.path, height))

    @torch.no_grad()
    def mesh(self) -> Mesh:
        """The surface as triangles, with materials at the vertices.

        Raises:
            NoSurface: there is none.
        """
        return extract_mesh(self.scene)

    @property
    def trust(self) -> str:
        """What the photographs leave open, in words; empty where the run has no trust.txt."""
        file = self.path / "trust.txt"
        return file.read_text(encoding="utf-8") if file.is_file() else ""

    @property
    def verdict(self) -> Verdict | None:
        """How training came out and what would help; None: it has not ended, or its version told
        nothing."""
        return load_verdict(self.path)

    @property
    def log(self) -> list[dict[str, Any]]:
        """What training reported, every few seconds: time, losses, validation PSNR."""
        file = self.path / LOG
        if not file.is_file():
            return []
        return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]

    def evaluate(self, **options: Any) -> dict[str, float | int | None]:
        """Measures on the test views; options: fields of `univoxel.cli.evaluate.EvaluateOptions`,
        but run."""
        return evaluate(self.path, **options)


def open_run(path: str | Path) -> Run:
    """The run in a folder.

    Raises:
        MissingFile: no trained scene is there.
        DataError: it cannot be read.
    """
    return Run(path)


@overload
def train(
    data: TrainConfig,
    /,
    *,
    resume: bool = False,
    timelapse: str | Path | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    view: tuple[str, int] | None = None,
) -> Path: ...


@overload
def train(
    data: str | Path,
    /,
    out: str | Path,
    *,
    resume: bool = False,
    timelapse: str | Path | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    view: tuple[str, int] | None = None,
    **options: Any,
) -> Run: ...


def train(
    data: str | Path | TrainConfig,
    /,
    out: str | Path | bool | None = None,
    *,
    resume: bool = False,
    timelapse: str | Path | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    view: tuple[str, int] | None = None,
    **options: Any,
) -> Run | Path:
    """Recover geometry, materials and light from posed photographs.

    Args:
        data: folder of the photographs and their cameras; or the whole configuration, which says
            all but resume, timelapse, on_progress and view: then the folder of the run is returned.
        out: folder that the run is written to.
        resume: continue with the run in out from its last checkpoint.
        timelapse: .gif, .mp4 or folder for pictures of a view over training time.
        on_progress: called every few seconds of training. Raise `univoxel.Cancelled` in it to end
            the training: it is saved, and continues with resume.
        view: host and port that browsers may look at the training at, such as ("127.0.0.1", 8080);
            port 0: any free one. A button there ends it early, with a result.
        options: fields of `univoxel.cli.train.TrainOptions`, such as preset, light, varying,
            minutes and changes: what `univoxel train` has options for, with changes for --set.

    Raises:
        UserError: an argument or the data cannot be used.
        ExistingFile: out holds a run already and resume is False.
        Cancelled: on_progress raised it.
        OSError: a file of the run cannot be written; what was there before stays.
    """
    watched = {"timelapse": timelapse, "on_progress": on_progress, "view": view}
    if isinstance(data, TrainConfig):
        if options:
            raise TypeError(f"train: expected a configuration or {', '.join(options)}, got both")
        return train_config(data, resume=resume or out is True, **watched)
    if out is None or isinstance(out, bool):
        raise TypeError("train: out must be the folder of the run, got none")
    config = TrainOptions(data=data, out=out, **options).configuration()
    return Run(train_config(config, resume=resume, **watched))
