"""The command line: parse, call one task, turn a user's mistake into one line.

Tasks are imported by the command that runs them: `univoxel --help` does not wait for torch.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from univoxel import __version__

Run: TypeAlias = Annotated[Positional[Path], arg(metavar="RUN")]


def train(
    data: Annotated[Positional[Path], arg(metavar="DATA")],
    /,
    out: Annotated[Path, arg(metavar="RUN")],
    preset: Literal["draft", "fast", "full"] = "fast",
    minutes: Annotated[
        float | None, arg(metavar="MINUTES", help_behavior_hint="(default: the preset's)")
    ] = None,
    resume: bool = False,
    set: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="FIELD=VALUE", help_behavior_hint="(repeatable)"),
    ] = (),
) -> None:
    """Recover geometry, materials and light from posed photographs.

    Args:
        data: folder of the photographs and their cameras
        out: folder that the run is written to
        preset: how much work goes in: draft is a look, fast the usual, full the best
        minutes: wall-clock limit, above 0; training ends in time with what it has
        resume: go on with the run in --out
        set: for experts: one field of the configuration, such as loss.radiance=0.5
    """
    from univoxel.config import preset as preset_config
    from univoxel.tasks import train as task

    if minutes is not None and not minutes > 0:
        raise ValueError(f"--minutes must be above 0, got {minutes}")
    if not resume and (out / "scene.safetensors").exists():
        raise FileExistsError(f"{out} holds a run already: add --resume, or choose another --out")
    config = preset_config(preset, data=data, out=out)
    limit = [] if minutes is None else [f"minutes={minutes}"]
    task.train(_changed(config, [*limit, *set]), resume=resume)


def evaluate(
    run: Run,
    /,
    data: Annotated[
        Path | None, arg(metavar="DATA", help_behavior_hint="(default: the data trained on)")
    ] = None,
    save: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: none are written)")
    ] = None,
    json: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: only printed)")
    ] = None,
) -> None:
    """Measure a run on the test views and print the table.

    Args:
        run: folder of a trained run
        data: folder of the photographs
        save: folder for the rendered pictures
        json: file for the measures
    """
    from univoxel.tasks import evaluate as task

    task.evaluate(run, data=data, save=save, json=json)


def relight(
    run: Run,
    /,
    envmap: Annotated[Path, arg(metavar="MAP")],
    out: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: RUN/relight/MAP)")
    ] = None,
    cameras: Annotated[str, arg(metavar="test|orbit|FILE")] = "test",
    rotate: Annotated[float, arg(metavar="DEGREES")] = 0.0,
) -> None:
    """Render a run under another environment map.

    Args:
        run: folder of a trained run
        envmap: equirectangular map, twice as wide as high, .exr or .hdr, linear radiance
        out: folder for the pictures
        cameras: the test views, an orbit around the object, or a transforms.json
        rotate: turn the map counter-clockwise about +Z, degrees
    """
    from univoxel.tasks import relight as task

    out = out or run / "relight" / envmap.stem
    task.relight(run, envmap, out, cameras=cameras, rotate=rotate)
    print(out)


def export(
    run: Run,
    /,
    mesh: Annotated[Path, arg(metavar="FILE.glb|obj|ply")],
    faces: Annotated[
        int | None,
        arg(metavar="N", help_behavior_hint="(default: 20000 with textures, all without)"),
    ] = None,
    texture_size: Annotated[int, arg(metavar="TEXELS")] = 1024,
    watertight: bool = False,
) -> None:
    """Write the surface as a mesh with its materials, for any renderer.

    Args:
        run: folder of a trained run
        mesh: the file to write: .glb and .obj hold textures, .ply materials at the vertices
        faces: most triangles, at least 4
        texture_size: width of the square textures, a power of 2
        watertight: close holes, or fail
    """
    from univoxel.tasks import export as task

    task.export(run, mesh, faces=faces, texture_size=texture_size, watertight=watertight)
    print(mesh)


def demo(out: Annotated[Path, arg(metavar="DIR")] = Path("univoxel-demo")) -> None:
    """Train, evaluate and relight the small scene that comes with the package, in minutes.

    Args:
        out: folder for everything it writes; the page to open is DIR/index.html
    """
    from univoxel.tasks import demo as task

    print(task.demo(out))


COMMANDS: dict[str, Callable[..., None]] = {
    "train": train,
    "eval": evaluate,
    "relight": relight,
    "export": export,
    "demo": demo,
}


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for a user's mistake, 130 when interrupted.

    The hidden flag --traceback shows where an error came from.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["--version"]:
        print(f"univoxel {__version__}")
        return 0
    traceback = "--traceback" in arguments
    arguments = [a for a in arguments if a != "--traceback"]
    # Parse alone first: what a command raises must not pass for an error of its arguments.
    call = tyro.extras.subcommand_cli_from_dict(
        {name: _deferred(command) for name, command in COMMANDS.items()},
        prog="univoxel",
        description="From posed photographs to a relightable object, on a plain CPU.",
        args=arguments,
        config=(FlagCreatePairsOff,),
    )
    try:
        call()
    except KeyboardInterrupt:
        print(f"univoxel {arguments[0]}: interrupted{_kept(call)}", file=sys.stderr)
        return 130
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        if traceback:
            raise
        message = " ".join(str(error).split()) or type(error).__name__
        print(f"univoxel {arguments[0]}: {message}", file=sys.stderr)
        return 2
    return 0


def _deferred(command: Callable[..., None]) -> Callable[..., functools.partial[None]]:
    """A function of the same signature that returns the call instead of making it."""

    @functools.wraps(command)
    def prepare(*args, **kwargs):
        return functools.partial(command, *args, **kwargs)

    return prepare


def _kept(call: functools.partial[None]) -> str:
    """What an interrupted command left behind."""
    out = call.keywords.get("out")
    if call.func is not train or not isinstance(out, Path):
        return ""
    if (out / "scene.safetensors").exists():
        return f"; {out} keeps the last saved state: go on with --resume"
    return f"; nothing was saved in {out} yet"


def _changed(config, changes: list[str]):
    """A frozen config with fields replaced: changes are "field.field=value".

    Raises:
        ValueError: no such field, or a value of another type than the field has.
    """
    import ast
    import dataclasses

    def replace(node, path: list[str], change: str, text: str):
        name, *rest = path
        known = [f.name for f in dataclasses.fields(node)] if dataclasses.is_dataclass(node) else []
        if name not in known:
            raise ValueError(
                f"--set {change}: no field {name!r}, there are: {', '.join(known) or 'none'}"
            )
        old = getattr(node, name)
        if rest:
            return dataclasses.replace(node, **{name: replace(old, rest, change, text)})
        try:
            new = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            new = text
        if isinstance(old, float) and isinstance(new, int) and not isinstance(new, bool):
            new = float(new)
        if isinstance(old, Path) and isinstance(new, str):
            new = Path(new)
        if old is not None and type(new) is not type(old):
            raise ValueError(
                f"--set {change}: {name} is a {type(old).__name__} such as {old!r}, got {text!r}"
            )
        return dataclasses.replace(node, **{name: new})

    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise ValueError(f"--set {change}: expected FIELD=VALUE")
        config = replace(config, path.split("."), change, text)
    return config


if __name__ == "__main__":
    sys.exit(main())
