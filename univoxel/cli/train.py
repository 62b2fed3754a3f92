"""Train a scene on posed photographs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from univoxel.cli import parsing
from univoxel.cli.view import with_page
from univoxel.core import choices
from univoxel.errors import ExistingFile, UserError

if TYPE_CHECKING:
    from univoxel.config import TrainConfig


# Options that go before --config, which says all others
OWN = ("data", "out", "config", "minutes", "downscale", "allow_outside", "seed", "changes")


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of a training; `univoxel.train` has them too."""

    data: Annotated[parsing.File, parsing.written("DATA", positional=True)]
    """folder with the photographs and their cameras"""
    out: Annotated[parsing.File, parsing.written("RUN")]
    """folder to write the run to"""
    preset: choices.PresetOrAuto = "auto"
    """amount of work, from draft to best; auto: what fits in --minutes, else fast"""
    light: Annotated[choices.LightName, parsing.ADVANCED] = "hybrid"
    """lighting model; hybrid keeps shadows out of the albedo; the others are baselines"""
    varying: Annotated[choices.Differing, parsing.ADVANCED] = "auto"
    """what varies between photographs; auto: detect whether exposure or light does"""
    light_frame: Annotated[choices.LightFrameOrAuto, parsing.ADVANCED] = "auto"
    """world: the light is fixed; turntable: it moves with the camera; camera: a flash"""
    metal: Annotated[choices.Metal, parsing.ADVANCED] = "auto"
    """all: the whole object is metal (or patina); some: not all of it is; auto: detect"""
    detail: choices.DetailingOrAuto = "auto"
    """texture: refine the albedo at full size; auto: do so except with draft or baked"""
    masks: choices.MasksFrom = "auto"
    """auto: erode masks that extend past the object's edge; given: use them unchanged"""
    cameras: choices.CamerasFrom = "auto"
    """refined: optimise camera poses; auto: do so if silhouettes are inconsistent"""
    field: Annotated[choices.FieldName, parsing.ADVANCED] = "hash"
    """where features are stored: hash table, every grid node, or bricks at the surface"""
    capacity: Annotated[choices.CapacityOrAuto, parsing.ADVANCED] = "auto"
    """adaptive: shrink the model with little loss of PSNR; auto: if this is supported"""
    budget_mb: Annotated[float | None, parsing.written("MB", "no limit", advanced=True)] = None
    """maximum size of the model file in megabytes; implies --capacity adaptive"""
    config: parsing.ConfigFile = None
    """reuse the config.json of another run instead of --preset, --light and others"""
    minutes: parsing.Minutes = None
    """time limit, including preparation; stages run fewer steps if it is short"""
    downscale: parsing.DownscaleBy = "auto"
    """train at 1/N of the photographs' size; auto: longer side of about 1000 pixels"""
    allow_outside: Annotated[bool, parsing.ADVANCED] = False
    """also read files outside the folder if the data set refers to them"""
    seed: Annotated[int | None, parsing.written("N", "0, or from --config", advanced=True)] = None
    """random seed"""
    changes: parsing.Changes = ()
    """change one configuration field, such as loss.radiance=0.5; repeatable"""

    def configuration(self) -> TrainConfig:
        """What they amount to; a UserError for an option out of range, a file that cannot be read,
        or a choice that the file makes itself."""
        from univoxel.core.validation import changed

        parsing.check_minutes(self.minutes)
        config = self._chosen() if self.config is None else self._loaded(Path(self.config))
        downscale = parsing.check_downscale(self.downscale)
        config = replace(config, downscale=downscale, allow_outside=self.allow_outside)
        return changed(
            config if self.seed is None else replace(config, seed=self.seed), self.changes
        )

    def _chosen(self) -> TrainConfig:
        from univoxel.presets import chosen, with_field, with_metal

        where = Path(self.data), Path(self.out)
        config = chosen(self.preset, self.minutes, *where, self.light, self.varying)
        config = replace(config, masks=self.masks, cameras=self.cameras)
        config = with_metal(with_field(config, self.field), self.metal)
        if self.detail != "auto":
            config = replace(config, detail=self.detail)
        if self.light_frame != "auto":
            config = replace(config, light_frame=self.light_frame)
        fits = self.budget_mb is not None and self.capacity == "auto"
        capacity = "adaptive" if fits else self.capacity
        if capacity == "auto":
            return config
        return replace(config, capacity=capacity, budget_mb=self.budget_mb)

    def _loaded(self, file: Path) -> TrainConfig:
        from univoxel.config import load_config

        for field in fields(TrainOptions):
            if field.name not in OWN and (value := getattr(self, field.name)) != field.default:
                both = f"{field.name}={value} cannot be combined with config: {file} sets it too"
                raise UserError(both, "config", field.name)
        config = replace(load_config(file), data=Path(self.data), out=Path(self.out))
        return config if self.minutes is None else replace(config, minutes=self.minutes)


@dataclass(frozen=True, kw_only=True)
class Train(TrainOptions):
    resume: bool = False
    """resume the run in --out, or start a new run if nothing was saved yet"""
    timelapse: Annotated[
        str | None, parsing.written("FILE.gif|FILE.mp4|DIR/", "none", advanced=True)
    ] = None
    """record a test view during training, as an animation or a folder of frames"""
    view: bool = False
    """watch the training in a browser, where you can also end it early"""
    host: Annotated[str | None, parsing.written("ADDRESS", "127.0.0.1", advanced=True)] = None
    """address on which --view listens"""
    port: Annotated[int | None, parsing.written("N", "8080", advanced=True)] = None
    """port on which --view listens"""
    no_page: Annotated[bool, parsing.ADVANCED] = False
    """do not write RUN/index.html"""

    def view_at(self) -> tuple[str, int] | None:
        """Host and port for watching the training, or None; a UserError without --view."""
        host, port = self.host, self.port
        if self.view:
            return "127.0.0.1" if host is None else host, 8080 if port is None else port
        if host is not None or port is not None:
            option = f"--host {host}" if host is not None else f"--port {port}"
            raise UserError(f"{option} has no effect without --view")
        return None


@parsing.takes(Train)
def command(asked: Train) -> int:
    """Recover shape, materials and light from posed photographs."""
    from univoxel.cli.trainer import train

    watched = {"timelapse": asked.timelapse, "view": asked.view_at()}
    if not asked.resume and (Path(asked.out) / "scene.safetensors").exists():
        raise ExistingFile(
            f"{asked.out} already contains a run: add --resume, or choose another --out"
        )
    run = train(asked.configuration(), resume=asked.resume, **watched)
    print(run if asked.no_page else with_page(run))
    return code_of(run)


def code_of(run: Path) -> int:
    """The exit code of a training: 3 if a stage made no step at all, else 0."""
    from univoxel.run import load_verdict

    verdict = load_verdict(run)
    return 3 if verdict is not None and verdict.empty else 0
