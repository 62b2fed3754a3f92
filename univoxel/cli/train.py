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
    """What is trained, and how; `univoxel.train` takes them too."""

    data: Annotated[parsing.File, parsing.written("DATA", positional=True)]
    """folder of the photographs and their cameras"""
    out: Annotated[parsing.File, parsing.written("RUN")]
    """folder that the run is written to"""
    preset: choices.PresetOrAuto = "auto"
    """how much work goes in: draft is a look, 1 minute on two cores, fast the usual, 2, full finer,
    5, best the finest, 8; auto is what fits into --minutes, or else fast"""
    light: choices.LightName = "hybrid"
    """sg, local lobes as published; hybrid, then one environment map with traced visibility, which
    cleans shadows from the albedo; others to compare with: sh and mlp, local too, envmap-sg and
    envmap, one map from the beginning, and baked, none: the photographs' colours are taken for
    albedo, as a photogrammetry mesh has them"""
    varying: choices.Differing = "auto"
    """what differs from photograph to photograph: exposure, with the colour balance, or the light
    itself too; auto is exposure where it is seen to differ, else none"""
    light_frame: choices.LightFrameOrAuto = "auto"
    """world, where the light stood still; turntable, where it turned with the camera; camera, where
    a flash at the lens lit the object; auto is what explains the photographs best"""
    metal: choices.Metal = "auto"
    """all, if the whole object is metal, patina included; some, if not; auto decides it"""
    detail: choices.DetailingOrAuto = "auto"
    """texture takes the albedo from the photographs at their own size, once the rest is trained,
    where they show more than the grid holds; none leaves it to the grid; auto is texture, but none
    for draft and for the light baked"""
    masks: choices.MasksFrom = "auto"
    """auto takes masks in that end outside of the object, as the photographs show it"""
    cameras: choices.CamerasFrom = "auto"
    """refined puts the photographs' cameras right, before training and in it; auto does so where
    their silhouettes contradict one another"""
    field: choices.FieldName = "hash"
    """hash takes features from a small table of many resolutions; dense stores them at every node
    of the grid, sparse in bricks around the surface alone, for finer grids than the presets', such
    as --set stages.1.voxels=30"""
    capacity: choices.CapacityOrAuto = "auto"
    """adaptive makes no larger a model than the scene needs, as held-out pixels tell: fewer rows of
    features, fewer levels of mirrored directions, fewer nodes far from the surface. auto is that,
    but fixed for sparse fields and for lights other than hybrid"""
    budget_mb: Annotated[float | None, parsing.written("MB", "no limit")] = None
    """most megabytes of the model's file; implies --capacity adaptive"""
    config: parsing.ConfigFile = None
    """config.json of another run, to train these photographs alike: it says all that --preset,
    --light and such would; --minutes, --seed, --downscale and --set go before it"""
    minutes: parsing.Minutes = None
    """wall-clock limit, above 0, from the first photograph read to the end: what does not fit is
    cut, in all stages alike; without, all steps are made, however long they take"""
    downscale: parsing.DownscaleBy = "auto"
    """train on photographs of 1/N of their width and height; auto is as large as leaves what grids
    can use, 1 below 1500 pixels"""
    allow_outside: bool = False
    """read photographs outside of DATA too, where its files or links name such"""
    seed: Annotated[int | None, parsing.written("N", "0, or that of --config")] = None
    """of all random choices"""
    changes: parsing.Changes = ()
    """for experts: one field of the configuration, such as loss.radiance=0.5 or stages.1.voxels=3;
    config.json in a run's folder holds them all"""

    def configuration(self) -> TrainConfig:
        """What they amount to.

        Raises:
            UserError: an option is out of range; the file of a configuration cannot be read, or a
                choice was made that it makes itself.
        """
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
                both = f"expected config or {field.name}={value}, got both: {file} says it"
                raise UserError(both, "config", field.name)
        config = replace(load_config(file), data=Path(self.data), out=Path(self.out))
        return config if self.minutes is None else replace(config, minutes=self.minutes)


@dataclass(frozen=True, kw_only=True)
class Train(TrainOptions):
    resume: bool = False
    """go on with the run in --out; where nothing was saved yet, it begins"""
    timelapse: Annotated[str | None, parsing.written("FILE.gif|FILE.mp4|DIR/", "none")] = None
    """picture of a test view over training time, or a folder of its frames"""
    view: bool = False
    """look at the training in a browser while it goes, and end it early"""
    host: Annotated[str | None, parsing.written("ADDRESS", "127.0.0.1")] = None
    """address that --view listens on"""
    port: Annotated[int | None, parsing.written("N", "8080")] = None
    """port that --view listens on"""
    no_page: bool = False
    """write no RUN/index.html at the end"""

    def view_at(self) -> tuple[str, int] | None:
        """Host and port that a training is looked at, if at all; a UserError for one alone."""
        host, port = self.host, self.port
        if self.view:
            return "127.0.0.1" if host is None else host, 8080 if port is None else port
        if host is not None or port is not None:
            option = f"--host {host}" if host is not None else f"--port {port}"
            raise UserError(f"expected --view with {option}, got that alone")
        return None


@parsing.takes(Train)
def command(asked: Train) -> int:
    """Recover geometry, materials and light from posed photographs."""
    from univoxel.cli.trainer import train

    watched = {"timelapse": asked.timelapse, "view": asked.view_at()}
    if not asked.resume and (Path(asked.out) / "scene.safetensors").exists():
        raise ExistingFile(
            f"{asked.out} holds a run already: add --resume, or choose another --out"
        )
    run = train(asked.configuration(), resume=asked.resume, **watched)
    print(run if asked.no_page else with_page(run))
    return code_of(run)


def code_of(run: Path) -> int:
    """The exit code of a training: 3 where a stage made no step at all, or else 0."""
    from univoxel.run import load_verdict

    verdict = load_verdict(run)
    return 3 if verdict is not None and verdict.empty else 0
