"""What is made harder: each axis with its severities, from the base scene on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lab.stress.damage import Damage
from lab.stress.scenes import Spec
from univoxel.errors import UserError

BASE = Spec(views=80)  # photographs are of its first 40 views unless an axis says otherwise
SECOND = Spec(light="dusk", tests=0)  # the base scene again, in another light
OTHER = Spec()  # scenes of their own
INTACT = Damage()


@dataclass(frozen=True)
class Level:
    """One severity of an axis."""

    value: float
    label: str  # of the value, and in names of folders
    spec: Spec = BASE
    damage: Damage = INTACT
    changes: tuple[str, ...] = ()  # FIELD=VALUE of the training's configuration

    @property
    def random(self) -> bool:
        """Whether its photographs differ from seed to seed."""
        d = self.damage
        return bool(d.pose or d.stops or d.light or d.noise or d.rough)


@dataclass(frozen=True)
class Axis:
    name: str
    title: str  # with the unit of its values
    levels: tuple[Level, ...]  # harder and harder
    reference: int = 0  # the level that the others are held against
    quick: tuple[int, ...] = (0, -1)  # levels of a quick run, with the reference


def _scenes(name: str, title: str, field: str, values: Sequence[float], **fixed) -> Axis:
    """An axis along a field of the scene; the base scene where nothing else differs from it."""
    levels = []
    for value in values:
        spec = replace(OTHER, **{field: value}, **fixed)
        same = replace(spec, views=BASE.views) == BASE
        levels.append(Level(value, f"{value:g}", BASE if same else spec))
    return Axis(name, title, tuple(levels))


def _photos(name: str, title: str, field: str, values: Sequence[float], sign=1, changes=()) -> Axis:
    """An axis along a field of what befalls the photographs; the first is the base scene's."""
    levels = [Level(values[0], f"{values[0]:g}")]
    for value in values[1:]:
        damage = replace(INTACT, **{field: sign * value})
        levels.append(Level(value, f"{value:g}", damage=damage, changes=changes))
    return Axis(name, title, tuple(levels))


_SHARES = 0.0, 0.25, 0.5, 1.0
_TURNTABLES = (
    *(("still-2", 2, False), ("turning-2", 2, True)),
    *(("still-1", 1, False), ("turning-1", 1, True)),
)
_ROUGH = 0.0, 0.5, 1.0, 2.0
AXES = {
    axis.name: axis
    for axis in (
        _scenes("roughness", "roughness", "roughness", (0.6, 0.3, 0.1, 0.03)),
        replace(_scenes("metal", "parts of metal, of 3", "metals", (0, 1, 2, 3)), quick=(0, 2, 3)),
        _scenes("concavity", "depth of an open box", "amount", (0.1, 0.4, 0.7, 1.0), shape="box"),
        _scenes("sun", "share of a small sun in the light", "sun", (0.0, 0.5, 0.8, 0.95)),
        Axis(
            "views",
            "photographs",
            tuple(Level(n, f"{n}", damage=Damage(views=n)) for n in (80, 40, 20, 12, 6)),
            reference=1,
            quick=(1, 3, 4),
        ),
        replace(
            _photos("pose", "error of the cameras, degrees", "pose", (0.0, 0.1, 0.3, 1.0)),
            quick=(0, 2, 3),
        ),
        _photos("exposure", "exposures apart, +- stops", "stops", (0.0, 0.5, 1.0, 2.0)),
        _photos("light", "share of a second light, up to", "light", _SHARES),
        _photos(
            "light-varying",
            "the same, with --varying light",
            "light",
            _SHARES,
            changes=("scene.varying=light",),
        ),
        _photos("masks", "masks too wide, pixels", "dilation", (0.0, 1.0, 3.0)),
        replace(
            _photos("rough-masks", "masks drawn by hand, % of the picture", "rough", _ROUGH),
            quick=(0, 2, 3),
        ),
        _scenes("thin", "diameter of rods", "amount", (0.16, 0.08, 0.04, 0.02), shape="rods"),
        _scenes("fur", "length of hairs", "amount", (0.0, 0.02, 0.05, 0.1), shape="fur"),
        Axis(
            "turntable",
            "cameras in 2 rings or 1; light still, or turning with them",
            tuple(
                Level(value, label, replace(OTHER, rings=rings, turning=turning))
                for value, (label, rings, turning) in enumerate(_TURNTABLES)
            ),
            quick=(0, 1, 3),
        ),
        _photos("noise", "noise, of sRGB in [0, 1]", "noise", (0.0, 0.02, 0.05, 0.1)),
        _scenes("placement", "off the middle, world units", "shift", (0.0, 0.25, 0.5, 0.75)),
        _photos("dark", "stops too dark", "exposure", (0.0, 2.0, 4.0, 6.0), sign=-1),
        _photos("bright", "stops too bright", "exposure", (0.0, 1.0, 2.0, 3.0)),
    )
}


def chosen(only: Sequence[str], quick: bool) -> list[Axis]:
    """The axes of these names, or all; with fewer levels where it shall be quick.

    Raises:
        ValueError: there is no such axis.
    """
    if unknown := [name for name in only if name not in AXES]:
        raise UserError(f"only must be of {', '.join(AXES)}, got {', '.join(unknown)}", "only")
    found = [AXES[name] for name in (only or AXES)]
    return [_shortened(axis) for axis in found] if quick else found


def _shortened(axis: Axis) -> Axis:
    kept = sorted({axis.reference, *(i % len(axis.levels) for i in axis.quick)})
    levels = tuple(axis.levels[i] for i in kept)
    return replace(axis, levels=levels, reference=kept.index(axis.reference))
