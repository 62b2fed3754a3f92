"""Light that depends on the photograph: a gain, a flash, or light that turns with the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.camera import Cameras, circle_of, looked_at
from univoxel.core.validation import about, setting
from univoxel.errors import ConfigError, UserError
from univoxel.sphere import real_harmonics

DEGREE = 3  # of the harmonics that a view's map may differ by at first: halves, quarters of the sky
RATE = 10.0  # the learning rate of networks moves log gains that much faster: a stop is soon taken


def view_number(names: Sequence[str], view: str, argument: str) -> int:
    """The number of a view that an argument gives by name or number; a UserError if none is."""
    if view in names:
        return names.index(view)
    if view.isdigit() and int(view) < len(names):
        return int(view)
    raise UserError(
        f"{argument}: expected the number of a view (below {len(names)}) or its name (from "
        f"{names[0]} to {names[-1]}), got {view!r}",
        argument,
    )


@dataclass(frozen=True)
class ShownLight:
    """A light of no photograph that was trained on."""

    gain: Tensor  # [3] factor on radiance
    code: Tensor | None  # [Z], where views have codes


class ViewLights(nn.Module):
    """Gains, codes and changes of the map for V views; as many views as there are photographs.

    - A gain per channel: exposure, and the colour of all light. Their geometric mean over the views
      is 1, so that they cannot trade with albedo or light.
    - A code of Z numbers, which networks of light read beside the features. Materials never do.
    - What is added to the logarithm of the scene's map at D directions: sum_r weight_vrc basis_rd.
      The R functions start as spherical harmonics of degree 1 to 3, the weights at 0.
    Weights and codes have mean 0 over the views: the mean light is that of no view in particular.

    Source: Martin-Brualla et al. 2021 (NeRF in the Wild) for a learned code per photograph.
    """

    def __init__(
        self, names: tuple[str, ...], codes: int = 0, directions: Tensor | None = None
    ) -> None:
        """
        Args:
            names: of the V views, in the order of their numbers.
            codes: Z, >= 0; 0: the views differ by gains only.
            directions: [D, 3] unit, of the scene's map, where it may differ from view to view.
        """
        super().__init__()
        self.names = names
        self.chosen: int | None = None  # whose light is shown where no view is named; None: mean
        self.shown: ShownLight | None = None  # in place of the mean
        self.gain_steps: nn.Parameter = nn.Parameter(torch.zeros(len(names), 3))
        self.raw_codes: nn.Parameter | None = None
        if codes:
            self.raw_codes = nn.Parameter(torch.randn(len(names), codes))
        self.sky_weights = self.sky_basis = None
        if directions is not None:
            basis = real_harmonics(DEGREE, directions)[:, 1:].T  # the first is constant: the gain
            self.sky_weights: nn.Parameter | None = nn.Parameter(
                torch.zeros(len(names), len(basis), 3)
            )
            self.sky_basis: nn.Parameter | None = nn.Parameter(basis.contiguous())  # [R, D]

    def __len__(self) -> int:
        return len(self.names)

    def choose(self, view: str | None) -> None:
        """Show the light of a view, by name or number, where none is named; None: the mean light. A
        UserError if there is no such view."""
        self.chosen = None if view is None else view_number(self.names, view, "light_of")

    def add(self, to_gains: Tensor, to_weights: Tensor | None = None) -> Tensor:
        """Add to log gains [V, 3] and weights [V, R, 3], but for what all views have of it.

        Returns:
            That, for the log map that they share to take up: [1, 3], or [D, 3] with weights.
        """
        self.gain_steps.data += to_gains / RATE
        shared = to_gains.mean(0, keepdim=True)
        if to_weights is None or self.sky_weights is None or self.sky_basis is None:
            return shared
        self.sky_weights.data += to_weights
        return shared + torch.einsum("rc,rd->dc", to_weights.mean(0), self.sky_basis.detach())

    @property
    def log_gain(self) -> Tensor:
        """[V, 3], of mean 0 over the views."""
        return RATE * _centred(self.gain_steps)

    def gain(self, view: Tensor | int | None = None) -> Tensor:
        """Factor [N, 3] on radiance in the photographs of views [N]; [3] for one view, or none."""
        view = self.chosen if view is None else view
        if view is None:
            return self.gain_steps.new_ones(3) if self.shown is None else self.shown.gain
        return self.log_gain[view].exp()

    def code(self, view: Tensor | int | None = None) -> Tensor | None:
        """[N, Z] of views [N]; [Z] for one view, or none. None if only gains differ."""
        if self.raw_codes is None:
            return None
        view = self.chosen if view is None else view
        codes = _centred(self.raw_codes)
        if view is None:
            shown = None if self.shown is None else self.shown.code
            return torch.zeros_like(codes[0]) if shown is None else shown
        return codes[view]

    def sky_change(self) -> Tensor | None:
        """What each view adds to the log map: [V, D, 3]; None if all have one map."""
        if self.sky_weights is None or self.sky_basis is None:
            return None
        return torch.einsum("vrc,rd->vdc", _centred(self.sky_weights), self.sky_basis)


NEAREST = 0.1  # of the usual distance from a flash, in which it does not become brighter any more


class Flash(nn.Module):
    """A lamp at the lens of the camera, which moves with it: a flash.

    It is a point, so that what it sends falls with the squared distance, and it lights what the
    camera sees without shadows. It is taken for white, as flashes about are: so it tells the colour
    of paint from that of the room's light.
    """

    def __init__(self, distance: float) -> None:
        """
        Args:
            distance: world units, > 0, for which `log_radiance` holds.
        """
        super().__init__()
        self.distance = distance
        # [1] of white matte paint that faces the camera at that distance
        self.log_radiance: nn.Parameter = nn.Parameter(torch.full((1,), math.log(0.5)))

    def reflected(
        self,
        normal: Tensor,
        wo: Tensor,
        away: Tensor,
        albedo: Tensor,
        roughness: Tensor,
        f0: Tensor,
    ) -> Tensor:
        """Linear radiance [N, 3] that its light makes a surface send back to the camera.

        Args:
            normal, wo: [N, 3] unit; wo to the camera.
            away: [N] world units from the camera.
            albedo, f0: [N, 3] of the diffuse and of the specular part.
            roughness: [N].
        """
        nearest = NEAREST * self.distance  # rays that meet nothing have a depth of 0
        falloff = (self.distance / away.clamp_min(nearest)).square()
        cosine = (normal * wo).sum(-1).clamp_min(0)
        shown = brdf.evaluate(normal, wo, wo, albedo, roughness, f0)
        return math.pi * (falloff * cosine)[:, None] * shown * self.log_radiance.exp()


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(0)


# Light that turns with the camera: the object was turned before a camera that stood still.


Vec3 = tuple[float, float, float]
LEVEL = 0.2  # spread of the cameras' right axes along their axis over that across it, at most
UPRIGHT = 0.97  # cosine between that axis and the one of the circle they stand on, at least
FEWEST = 8  # cameras that tell of a further way in which the object lay
# Sine of the angle by which a level camera may be rolled, where others were not level with it
ROLLED = 0.17
PAIRS = 500  # of cameras, whose axes are tried


@dataclass(frozen=True)
class Table:
    """The axis about which an object was rotated, while camera and light did not move."""

    point: Vec3 = field(metadata=about("a point on the axis", unit="world units"))
    axis: Vec3 = field(metadata=about("unit vector along the axis, pointing up"))
    start: Vec3 = field(metadata=about("unit vector from the axis to the first camera"))
    eyes: tuple[Vec3, ...] = setting(
        (), "positions of the cameras around this axis; empty: all cameras are around it"
    )

    def __post_init__(self) -> None:
        axis, start = torch.tensor(self.axis), torch.tensor(self.start)
        lengths = float((axis.norm() - 1).abs().maximum((start.norm() - 1).abs()))
        if not max(lengths, float((axis @ start).abs())) < 1e-3:
            raise ConfigError(
                f"{type(self).__name__}: axis and start must be perpendicular unit vectors, got "
                f"{self.axis} and {self.start}"
            )

    @staticmethod
    def of(cameras: Cameras) -> Table | None:
        """The axis that cameras stood around; None: they do not say where it is.

        A camera that stands still is held level: what is to the right in the photographs lies
        across the axis. Turned all around, the cameras look at a point of it. Where they stand on
        one circle, it says both more exactly: however it was aimed, the camera stood still.
        """
        right = cameras.camera_to_world[:, :, 0]
        _, spread, directions = torch.linalg.svd(right, full_matrices=True)
        if len(cameras) < 3 or spread[2] > LEVEL * spread[1]:
            return None
        axis, point, circle = directions[2], looked_at(cameras), circle_of(cameras)
        if circle is not None and abs(float(circle.axis @ axis.double())) > UPRIGHT:
            axis, centre = circle.axis.to(axis), circle.centre.to(axis)
            point = centre + ((point - centre) @ axis) * axis
        if axis @ cameras.camera_to_world[:, :, 1].mean(0) < 0:
            axis = -axis
        towards = cameras.camera_to_world[0, :, 3] - point
        start = normalize(towards - (towards @ axis) * axis, dim=0)
        if not start.isfinite().all() or start.norm() < 0.5:  # the first stands on the axis
            return None
        return Table(_vec3(point), _vec3(axis), _vec3(start))

    def frame(self) -> Tensor:
        """[3, 3] rows: the start, beside it, the axis."""
        axis, start = torch.tensor(self.axis), torch.tensor(self.start)
        return torch.stack([start, torch.linalg.cross(axis, start), axis])


@dataclass(frozen=True)
class Turntable(Table):
    """How an object was rotated in front of a camera and a light that did not move.

    In the world, whose axes are fixed to the object, light and camera rotate about this axis. The
    frame of the light coincides with the world when the camera is at `start`. If the object was
    turned over to show its underside, the photographs after that have another axis, in `others`.
    """

    others: tuple[Table, ...] = setting((), "rotation axes for the other positions of the object")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.others and not all(table.eyes for table in (self, *self.others)):
            raise ConfigError(
                "Turntable: if there are several axes, each needs camera positions (eyes)"
            )

    @staticmethod
    def of(cameras: Cameras) -> Turntable | None:
        """The turntable that cameras stood around; None: they do not say where its axes are."""
        only, up = Table.of(cameras), cameras.camera_to_world[:, :, 1]
        if only is not None and (up @ up.new_tensor(only.axis) < 0).sum() < FEWEST:
            return Turntable(only.point, only.axis, only.start)
        tables = []
        for which in positions_of(cameras):
            table = Table.of(cameras.of(which))
            if table is None:
                return None
            eyes = tuple(_vec3(eye) for eye in cameras.camera_to_world[which, :, 3])
            tables.append(replace(table, eyes=eyes))
        if not tables:
            return None
        first, *others = tables
        return Turntable(first.point, first.axis, first.start, first.eyes, tuple(others))

    @property
    def tables(self) -> tuple[Table, ...]:
        """All the ways in which the object lay."""
        return (self, *self.others)

    def laid(self, eye: Tensor) -> Tensor:
        """Which of the tables places [..., 3] are seen over: that of the nearest camera."""
        if not self.others:
            return eye.new_zeros(eye.shape[:-1], dtype=torch.long)
        stood = eye.new_tensor([place for table in self.tables for place in table.eyes])
        counts = torch.tensor([len(table.eyes) for table in self.tables])
        nearest = (eye @ stood.T - 0.5 * stood.square().sum(1)).argmax(-1)
        return torch.arange(len(counts)).repeat_interleave(counts)[nearest]

    def turn(self, eye: Tensor, steps: int | None = None) -> Tensor:
        """Rotations [..., 3, 3] from the world to the light's frame, seen from places [..., 3].

        Args:
            steps: to so many positions of the turntable each is rounded; None: to none.
        """
        frames = torch.stack([table.frame() for table in self.tables]).to(eye)
        laid = self.laid(eye)
        towards = eye - eye.new_tensor([table.point for table in self.tables])[laid]
        start, beside, axis = frames[laid].unbind(-2)
        angle = torch.atan2((beside * towards).sum(-1), (start * towards).sum(-1))
        if steps is not None:
            step = 2 * math.pi / steps
            angle = (angle / step).round() % steps * step
        cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
        turned = [cosine * start + sine * beside, cosine * beside - sine * start, axis]
        return frames[0].T @ torch.stack(turned, -2)


def _vec3(vector: Tensor) -> Vec3:
    x, y, z = vector.tolist()
    return x, y, z


def positions_of(cameras: Cameras) -> list[Tensor]:
    """Indices of the cameras of each position of the object, in order; none: they do not say.

    Cameras are level: all that saw one position have their right axes across what was up then.
    """
    right, up = cameras.camera_to_world[:, :, 0], cameras.camera_to_world[:, :, 1]
    generator = torch.Generator().manual_seed(0)
    left = torch.ones(len(cameras), dtype=torch.bool)
    found: list[Tensor] = []  # axes, upwards
    while left.any():
        tried = left.nonzero()[:, 0]
        pair = tried[torch.randint(len(tried), (PAIRS, 2), generator=generator)]
        axis = torch.linalg.cross(*right[pair].unbind(1))
        axis = normalize(axis[axis.norm(dim=1) > 0.2], dim=1)  # others look the same way
        axis = torch.cat([axis, -axis])
        level = _off(axis, right, up).lt(ROLLED) & left
        if not len(axis) or level.sum(1).max() < FEWEST:
            return []
        best = level.sum(1).argmax()
        found.append(axis[best])
        left = left & ~level[best]
    axes = torch.stack(found)
    for _ in range(3):  # of two that fit, the better
        which = _off(axes, right, up).argmin(0)
        if torch.bincount(which, minlength=len(axes)).min() < FEWEST:
            return []
        fitted = torch.stack([torch.linalg.svd(right[which == k])[2][2] for k in range(len(axes))])
        axes = torch.where((fitted * axes).sum(1, keepdim=True) < 0, -fitted, fitted)
    return [torch.nonzero(torch.eq(which, k))[:, 0] for k in range(len(axes))]


def _off(axis: Tensor, right: Tensor, up: Tensor) -> Tensor:
    """[K, V] sine by which cameras are not level about axes [K, 3]; 2: they stand on their head."""
    return torch.where(axis @ up.T > 0, (axis @ right.T).abs(), 2.0)


def rotated(turn: Tensor, direction: Tensor) -> Tensor:
    """Directions [..., 3] turned by rotations [..., 3, 3], one broadcast to the other."""
    return (turn @ direction[..., None])[..., 0]


def resampling(direction: Tensor, turn: Tensor) -> Tensor:
    """Weights [V, D, D] that bring a map at D directions, in the light's frame, to what it is in
    the world along these directions, for V views.

    Args:
        direction: [D, 3] unit, evenly spread over the sphere.
        turn: [V, 3, 3] from the world to the light's frame, of the views.
    """
    sharpness = len(direction) / 5.0  # as wide as the nodes lie apart, as in `DistantLight`
    turned = direction @ turn.transpose(1, 2)
    weights = torch.softmax(sharpness * (turned @ direction.T), -1)
    # What rounding swallows is nothing: processors take a hundred times as long over the tiniest
    # numbers (denormals), of which half of the weights were, or became when multiplied
    weights = weights.masked_fill(weights < torch.finfo(weights.dtype).eps, 0.0)
    return weights / weights.sum(-1, keepdim=True)
