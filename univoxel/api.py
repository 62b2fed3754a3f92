"""The library interface: `univoxel.train`, `univoxel.open_run` and the class `Run`."""

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
    """A trained scene in its folder.

    Attributes:
        path: the folder that training wrote.
        scene: field, materials and light, in evaluation mode.
    """

    path: Path
    scene: Scene

    def __init__(self, path: str | Path) -> None:
        """
        Raises:
            MissingFile: the folder has no trained scene.
            DataError: the scene cannot be read.
        """
        self.path = Path(path)
        self.scene = load_scene(self.path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    def _repr_html_(self) -> str | None:
        """The web page of `univoxel view` in a frame, for notebooks; None without a surface."""
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
        """Render the scene in the light of the photographs.

        Args:
            cameras: "test" for the test views of the data set, "orbit" or "orbit N" for N frames
                around the object, a file like transforms_test.json, or cameras.
            resolution: width in pixels; None: that of the data set, or 512 for an orbit.

        Returns:
            [F, H, W, 4] linear RGBA, premultiplied.

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
        """Render the scene under new light: [F, H, W, 4] linear RGBA, premultiplied.

        Args:
            envmap: a file or an environment map; None for suns and point lights only.
            cameras, options: fields of `univoxel.cli.relight.RelightOptions`.

        Raises:
            UserError: a map or the cameras cannot be used, or a number is out of range.
        """
        return relight_images(self.path, envmap, cameras, **options)

    def export(self, path: str | Path, **options: Any) -> Path:
        """Export the surface with materials as .glb, .usdz, .obj or .ply; return the file.

        Args:
            options: fields of `univoxel.cli.export.ExportOptions`, except run and mesh.

        Raises:
            UserError: an argument is out of range, or there is no surface.
            MissingExtra: .usdz needs usd-core.
            OSError: a file cannot be written.
        """
        export(self.path, path, **options)
        return Path(path)

    def page(self, path: str | Path, **options: Any) -> Path:
        """Write a web page with a relightable view of the object; return the file.

        Args:
            options: fields of `univoxel.output.page.PageOptions`.

        Raises:
            UserError: a map cannot be used, or there is no surface.
            OSError: a file cannot be read or written.
        """
        return write_page(self.path, path, **page_options(self.path) | options)

    def report(self, path: str | Path | None = None, **options: Any) -> Path:
        """Write a report on the quality and on what to photograph next; return the file.

        Args:
            path: .html file; None: report.html in the folder of the run.
            options: fields of `univoxel.output.report.ReportOptions`.

        Raises:
            UserError: an option is out of range, or there is no surface.
            OSError: a file cannot be read or written.
        """
        return report(self.path, path, **options)

    def light(self, height: int = MAP_ROWS) -> EnvMap:
        """The recovered environment map with `height` rows.

        Raises:
            UserError: the run has none, because it was trained with local light only.
        """
        return EnvMap(recovered_map(self.scene, self.path, height))

    @torch.no_grad()
    def mesh(self) -> Mesh:
        """The surface as triangles, with materials at the vertices.

        Raises:
            NoSurface: the scene has no surface.
        """
        return extract_mesh(self.scene)

    @property
    def trust(self) -> str:
        """The result and its expected errors in words, from trust.txt; empty if there is none."""
        file = self.path / "trust.txt"
        return file.read_text(encoding="utf-8") if file.is_file() else ""

    @property
    def verdict(self) -> Verdict | None:
        """The verdict and its remedies; None if training has not ended, or is older than 0.3."""
        return load_verdict(self.path)

    @property
    def log(self) -> list[dict[str, Any]]:
        """The training log, with an entry every few seconds: time, losses, validation PSNR."""
        file = self.path / LOG
        if not file.is_file():
            return []
        return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]

    def evaluate(self, **options: Any) -> dict[str, float | int | None]:
        """Metrics on the test views; options: fields of `univoxel.cli.evaluate.EvaluateOptions`,
        except run."""
        return evaluate(self.path, **options)


def open_run(path: str | Path) -> Run:
    """Open the run in a folder.

    Raises:
        MissingFile: the folder has no trained scene.
        DataError: the scene cannot be read.
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
    """Recover shape, materials and light from posed photographs.

    Args:
        data: folder with the photographs and their cameras, or a complete configuration. With a
            configuration, pass no options; the folder of the run is returned instead of a `Run`.
        out: folder to write the run to.
        resume: resume the run in out from its last checkpoint.
        timelapse: .gif, .mp4 or folder to record a view to during training.
        on_progress: called every few seconds. To end the training, raise `univoxel.Cancelled` in
            it: the state is saved, and you can resume.
        view: host and port at which browsers can watch the training, such as ("127.0.0.1", 8080);
            port 0: any free port. A button on the page ends the training early, with a result.
        options: fields of `univoxel.cli.train.TrainOptions`, such as preset, light, varying and
            minutes. They are the options of `univoxel train`; --set is called changes.

    Raises:
        UserError: an argument or the data cannot be used.
        ExistingFile: out already contains a run and resume is False.
        Cancelled: on_progress raised it.
        OSError: a file of the run cannot be written; earlier files are unchanged.
    """
    watched = {"timelapse": timelapse, "on_progress": on_progress, "view": view}
    if isinstance(data, TrainConfig):
        if options:
            raise TypeError(f"train: pass either a configuration or {', '.join(options)}, not both")
        return train_config(data, resume=resume or out is True, **watched)
    if out is None or isinstance(out, bool):
        raise TypeError("train: out is missing: pass the folder to write the run to")
    config = TrainOptions(data=data, out=out, **options).configuration()
    return Run(train_config(config, resume=resume, **watched))
