"""The frame that the light is fixed to: the world, the room of a turntable, or the camera; and
whether it differs from photograph to photograph."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from univoxel.camera import looked_at
from univoxel.color import CLIPPED, linear_to_srgb
from univoxel.core import log
from univoxel.core.choices import LightFrameOrAuto
from univoxel.data import Photos
from univoxel.errors import DataError
from univoxel.fields.grid import GridShape
from univoxel.lights.views import Turntable, rotated
from univoxel.preparation.hull import observe_hull
from univoxel.preparation.matches import neighbours
from univoxel.render.observations import Observations
from univoxel.sphere import real_harmonics

# Pixels along the longer side of the pictures whose surroundings are compared
SMALL = 128
# Of those pixels, by which a camera that stands still may wobble, or be turned a little
WOBBLE = 3
# By which surroundings are shifted, to see whether that fits better: less than a camera sees them
# shift that goes some 5 degrees around the object
SHIFT = 10
# Correlation that surroundings which stood still have at least
ALIKE = 0.85
# Correlation of a picture with itself shifted, above which it is too plain to tell
PLAIN = 0.95


@torch.no_grad()
def surroundings_stand_still(photos: Photos) -> bool | None:
    """Whether neighbouring photographs show the same around the object, at the same pixels.

    A camera that goes around an object sees its surroundings shift. None: they cannot tell, since
    they are plain or cut away.
    """
    stand_still = []
    for one, other in neighbours(photos.cameras):
        if photos.cameras.size(one) == photos.cameras.size(other):
            first, second = _shrunk(photos, one), _shrunk(photos, other)
            stand_still.append(_same(first, second))
    known = [same for same in stand_still if same is not None]
    if 2 * len(known) <= len(stand_still):
        return None
    return 2 * sum(known) > len(known)


def _shrunk(photos: Photos, view: int) -> tuple[Tensor, Tensor]:
    """A small picture [h, w], grey sRGB or linear values, and where it shows no object [h, w]."""
    color, alpha = photos.stored(view)
    factor = max(1, round(max(alpha.shape) / SMALL))
    grey = avg_pool2d(color.float().mean(-1)[None], factor)[0]
    shown = max_pool2d((alpha > 0).float()[None], factor)  # of the object, anywhere in a pixel
    return grey, max_pool2d(shown, 3, 1, 1)[0] == 0


def _same(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> bool | None:
    """Whether two pictures agree around the object as they lie, and not better shifted far."""
    here = _correlation(one, other, 0, 0)
    at_rest = [*([] if here is None else [here]), *_shifted(one, other, WOBBLE)]
    itself, far = _shifted(one, one, SHIFT), _shifted(one, other, SHIFT)
    # Plain surroundings look alike wherever they are
    if not (at_rest and itself and far) or max(itself) > PLAIN:
        return None
    return max(at_rest) > max(ALIKE, *far)


def _shifted(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], pixels: int) -> list[float]:
    """Correlations with the other shifted so far, to all sides."""
    sides = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
    found = (_correlation(one, other, pixels * y, pixels * x) for y, x in sides)
    return [correlation for correlation in found if correlation is not None]


def _correlation(
    one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor], down: int, right: int
) -> float | None:
    """Of grey values around the object, the other picture shifted; None: of nothing, or of one
    colour."""
    height, width = one[0].shape
    y, x = slice(max(down, 0), height + min(down, 0)), slice(max(right, 0), width + min(right, 0))
    v, u = (
        slice(max(-down, 0), height + min(-down, 0)),
        slice(max(-right, 0), width + min(-right, 0)),
    )
    both = one[1][y, x] & other[1][v, u]
    if both.float().mean() < 0.1:
        return None
    a, b = one[0][y, x][both], other[0][v, u][both]
    a, b = a - a.mean(), b - b.mean()
    size = float(a.norm() * b.norm())
    return float(a @ b) / size if size > 1e-3 * len(a) else None


# Whether the light stood still around the object, or turned about it with the camera.
#
# Before a camera that stands still an object is turned, and with it, in the object's world, the
# light turns as the camera does. Then a point is bright where its normal faces the light as seen
# from the camera. Under a light that stands still a point keeps its shade, and changes only by what
# it mirrors. Each is a smooth function on the sphere. It is fitted to half of the photographs, and
# the other half says how well it predicts them: the light that does better there is believed.


# Points of the surface whose colours are compared
POINTS = 3000
# sRGB; darker colours are left out: rounding to 8 bits is too large a part of them
DARK = 0.05
# Natural log; the scale of the Cauchy cost of a colour that is not explained
CAUCHY = 0.1
# Rounds of iteratively reweighted least squares
ROUNDS = 6
# Standard errors, over the photographs, by which a turning light has to be ahead of a still one
CERTAIN = 2.0
# Share of the shade of a flash that points show at least if there is one: paint does. Elsewhere
# it was -0.4 to 0, for towards the outline surfaces do not become darker
SHADE = 0.1
# Natural log by which points that face the camera are brighter than others at least, if they do not
# show that shade: metal does. Elsewhere it was -0.1 to 0.2
GLINT = 0.5
# Powers of the cosine to the camera that a highlight of its flash is made of
SHININESS = 16, 64
# Share of the cost under a still light that has to go away. Of 12 rendered scenes whose light did
# not turn it was 1.4 % at most, of three under one that turned 15 to 32 %, of a wooden tankard 5 %
LEAST = 0.03


@dataclass(frozen=True)
class Explained:
    """How well either light predicts photographs that it was not fitted to."""

    # Shares of the robust cost of how points change that go away
    by_still_light: float
    by_turning_light: float
    ahead: float  # standard errors over the photographs by which the turning one is better
    saved: float  # share of the cost under a still light that it takes away


@dataclass(frozen=True)
class LightFrame:
    """What the light stood still in: the world, if it is neither of these."""

    turntable: Turntable | None = None  # on which the photographs were taken
    flash: float | None = None  # world units between the object and a flash at the lens


def light_frame_of(
    photos: Photos,
    hull: Tensor,
    grid: GridShape,
    frame: LightFrameOrAuto,
    gains: Tensor | None = None,
) -> LightFrame:
    """What the light of the photographs stood still in.

    Args:
        photos: their cameras where they are believed to be.
        hull: [X, Y, Z] sdf of the visual hull on the grid, world units.
        frame: what is known.
        gains: [V] log gains of the exposures; None: all are alike.

    Raises:
        DataError: a turntable is asked for, and the cameras do not say where its axis is.
    """
    if frame == "world":
        return LightFrame()
    away = (photos.cameras.camera_to_world[:, :, 3] - looked_at(photos.cameras)).norm(dim=1)
    flash = LightFrame(flash=float(away.median()))
    if frame == "camera":
        return flash
    turntable = Turntable.of(photos.cameras)
    if frame == "turntable":
        if turntable is None:
            raise DataError(
                f"{photos.folder}: light_frame=turntable needs cameras around one upright axis, "
                "but these are placed differently, so the axis of the turntable is unknown",
                "light_frame",
            )
        return LightFrame(turntable)
    observations = observe_hull(photos, hull, grid, POINTS)
    if observations is None:
        return LightFrame()
    flashed = explained_by_flash(observations, gains)
    log.debug("flash: %s", flashed)
    lit = (flashed.shade > SHADE or flashed.glint > GLINT) and flashed.ahead > CERTAIN
    found = None if turntable is None else explained(observations, turntable, gains)
    log.debug("light frame: %s", found)
    turns = found is not None and rotates(found, photos)
    if lit and turns:  # a light that turns has more functions, which explain a flash in part
        assert found is not None
        lit = 2 * flashed.saved > found.saved
    if lit:
        log.info(
            "light: there is a flash on the camera. It explains %.0f %% more of the colour changes "
            "between photographs than a fixed light does; light_frame=world switches this off",
            100 * flashed.saved,
            extra={"arguments": ("light_frame",)},
        )
        return flash
    if not turns:
        return LightFrame()
    assert turntable is not None
    assert found is not None
    log.info(
        "light: it rotates with the camera, as on a turntable%s. This explains %.0f %% of the "
        "colour changes between photographs (fixed light: %.0f %%); light_frame=world disables it",
        f" with {len(turntable.tables)} positions of the object" if turntable.others else "",
        100 * found.by_turning_light,
        100 * max(found.by_still_light, 0.0),  # none, where the other half contradicts it
        extra={"arguments": ("light_frame",)},
    )
    return LightFrame(turntable)


def rotates(found: Explained, photos: Photos) -> bool:
    """Whether the light rotates with the camera."""
    # Surroundings that stood still have said it already, if photographs do not contradict. That
    # they moved says nothing: a cloth or a scale on the turntable does, too
    still_around = surroundings_stand_still(photos)
    if found.ahead < (-CERTAIN if still_around else CERTAIN):
        return False
    return bool(still_around) or found.saved >= LEAST


@dataclass(frozen=True)
class Flashed:
    """How well a flash predicts photographs that it was not fitted to."""

    shade: float  # share of the shade of a flash alone that points show
    glint: float  # natural log by which points that face the camera are brighter than others
    ahead: float  # standard errors over the photographs by which it is better than a still light
    saved: float  # share of the cost under a still light that it takes away


@torch.no_grad()
def explained_by_flash(observations: Observations, gains: Tensor | None = None) -> Flashed:
    """How well a flash predicts how points change from photograph to photograph.

    It lights a point by the cosine to the camera over the squared distance. The surroundings light
    it too, so that it shows only a share of that. What is glossy shows its highlight where it faces
    the camera.

    Args:
        gains: as in `light_frame_of`.
    """
    log_color, point, view, normal, wo = comparable(observations, gains)
    facing = (normal * wo).sum(1, keepdim=True)  # well above 0, as in `observe`
    away = (observations.eye[view] - observations.position[point]).norm(dim=1, keepdim=True)
    still = smooth(2 * facing * normal - wo)
    shade = facing.log() - 2 * (away / away.mean()).log()
    flash = torch.cat([shade, *(facing**power for power in SHININESS), still], 1)
    half = random_half(len(observations.eye), view)
    without, with_flash = (foretold(log_color, basis, point, half) for basis in (still, flash))
    ahead = ahead_by(without - with_flash, view)
    if ahead is None:
        return Flashed(0.0, 0.0, -math.inf, 0.0)
    fitted = _robust(log_color.double(), flash.double(), point)[0].tolist()
    glint = sum(fitted[1 : 1 + len(SHININESS)])
    saved = 1 - float(with_flash.sum() / without.sum())
    return Flashed(fitted[0], glint, ahead, saved)


@torch.no_grad()
def explained(
    observations: Observations, turntable: Turntable, gains: Tensor | None = None
) -> Explained:
    """How well either light predicts how points change from photograph to photograph.

    Of photographs in two random halves, each is predicted by what was fitted to the other.

    Args:
        gains: as in `light_frame_of`.
    """
    log_color, point, view, normal, wo = comparable(observations, gains)
    facing = (normal * wo).sum(1, keepdim=True)
    mirrored = 2 * facing * normal - wo
    turn = turntable.turn(observations.eye)[view]
    # What changes under any light: towards the outline, where edges are blurred or the surface is
    # off, and with the camera's height, as light that is alike all around the axis has it
    up, above, shown = (x @ x.new_tensor(turntable.axis)[:, None] for x in (normal, wo, mirrored))
    any_light = torch.cat(
        [
            *(facing, facing.square(), facing**3, shown, shown.square(), above, above.square()),
            *(facing * up, shown * up, above * up),
        ],
        1,
    )
    turned = smooth(rotated(turn, normal)), smooth(rotated(turn, mirrored))
    lights = {
        "none": any_light,
        "still": torch.cat([any_light, smooth(mirrored)], 1),
        "turning": torch.cat([any_light, *turned], 1),
    }
    half = random_half(len(observations.eye), view)
    costs = {name: foretold(log_color, basis, point, half) for name, basis in lights.items()}
    none, still, turning = (float(cost.sum()) for cost in costs.values())
    ahead = ahead_by(costs["still"] - costs["turning"], view)
    if min(none, still) <= 0 or ahead is None:
        return Explained(0.0, 0.0, -math.inf, 0.0)
    return Explained(1 - still / none, 1 - turning / none, ahead, 1 - turning / still)


# Whether the light itself differs from photograph to photograph.
#
# Then each photograph has a shade of its own over the object: a smooth function of the normal. It
# is fitted to half of the points that a photograph shows, and the other half says how well it
# predicts them, beside a gain alone. What photographs have in common, such as highlights under one
# light, is taken out before.


# Mean Cauchy cost of an observation under a gain for each photograph that has to go away: on the
# tuning half of the bank 0.10 at most under one light, and 0.18 to 0.26 under several
VARIED = 0.14
# Share of that cost. Of polished metal, 0.11 went away: most of what gains leave there is mirrored,
# a light for each photograph can imitate it, and then no metal is found
VARIED_SHARE = 0.12
# Points of either half that a photograph shows at least
COMMON = 40


@torch.no_grad()
def varied_light(photos: Photos, hull: Tensor, grid: GridShape, gains: Tensor | None) -> float:
    """How much more a light for each photograph explains than a gain for each: the mean Cauchy
    cost of an observation that it takes away, 0 where it is not certain or a small share.

    Args:
        photos, hull, grid, gains: as in `light_frame_of`.
    """
    observations = observe_hull(photos, hull, grid, POINTS)
    if observations is None:
        return 0.0
    log_color, point, view, normal, wo = comparable(observations, gains)
    facing = (normal * wo).sum(1, keepdim=True)
    mirrored = smooth(2 * facing * normal - wo)
    common = torch.cat([facing, facing.square(), facing**3, mirrored], 1).double()
    values = log_color.double()
    values = values - common @ _robust(values, common, point)[0]
    rest = _robust(values, common[:, :0], point)[1]
    half = random_half(len(observations.position), point)
    shade, nothing = smooth(normal).double(), torch.zeros(len(rest), 0, dtype=torch.double)
    costs, compared = torch.zeros(2, len(rest), dtype=torch.double), torch.zeros_like(half)
    for seen in (view == v for v in range(len(photos))):
        if min(int((seen & half).sum()), int((seen & ~half).sum())) < COMMON:
            continue
        for part in (seen & half, seen & ~half):
            other, compared = seen & ~part, compared | part
            for cost, basis in zip(costs, (nothing, shade), strict=True):
                fitted, left = _robust(rest[other], basis[other], torch.zeros_like(point[other]))
                level = (rest[other] - basis[other] @ fitted - left).mean()
                cost[part] = _cost(rest[part] - basis[part] @ fitted - level)
    if not compared.any():
        return 0.0
    saved = (costs[0] - costs[1])[compared]
    ahead = ahead_by(saved, view[compared])
    told = [round(float(cost[compared].mean()), 3) for cost in costs]
    log.debug("light: cost %s with gains, %s with a light per photograph; z score %s", *told, ahead)
    enough = saved.sum() > VARIED_SHARE * costs[0].sum()
    return float(saved.mean()) if enough and ahead is not None and ahead > CERTAIN else 0.0


def comparable(
    observations: Observations, gains: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Observations that are neither dark nor clipped: log brightness [N] without gains, point and
    view [N] int64, normal and wo [N, 3]."""
    point = torch.repeat_interleave(observations.offsets.diff())
    encoded = linear_to_srgb(observations.color)
    usable = (encoded.mean(1) > DARK) & (encoded < CLIPPED).all(1)
    point, view, wo = point[usable], observations.view[usable], observations.wo[usable]
    log_color = observations.color[usable].mean(1).log()
    if gains is not None:
        log_color = log_color - gains[view]
    return log_color, point, view, observations.normal[point], wo


def random_half(views: int, view: Tensor) -> Tensor:
    """Which observations, of views [N], belong to one half of the photographs: [N] bool."""
    order = torch.randperm(views, generator=torch.Generator().manual_seed(0))
    return (order % 2).bool()[view]


def ahead_by(gain: Tensor, view: Tensor) -> float | None:
    """Standard errors, over the photographs, by which a gain [N] of observations of views [N] is
    above 0; None: too few photographs show anything."""
    count = torch.bincount(view)
    total = gain.new_zeros(len(count)).index_add_(0, view, gain)
    of_view = total[count > 0] / count[count > 0]
    if len(of_view) < 2:
        return None
    error = float(of_view.std()) / math.sqrt(len(of_view))
    return float(of_view.mean()) / max(error, 1e-12)


def smooth(direction: Tensor) -> Tensor:
    """Smooth functions [N, 8] of directions [N, 3], without the constant one."""
    return real_harmonics(2, direction)[:, 1:]


def foretold(log_color: Tensor, basis: Tensor, point: Tensor, half: Tensor) -> Tensor:
    """Cauchy cost [N] of log colours [N] of points [N], each of which has an albedo of its own,
    after the sum of a basis [N, K] that is best for the other half, of [N] bool."""
    log_color, basis = log_color.double(), basis.double()
    cost = torch.zeros_like(log_color)
    for part in (half, ~half):
        fitted = _robust(log_color[~part], basis[~part], point[~part])[0]
        rest = log_color[part] - basis[part] @ fitted
        cost[part] = _cost(_robust(rest, basis[part][:, :0], point[part])[1])
    return cost


def _cost(rest: Tensor) -> Tensor:
    """Cauchy cost of what is left, natural log."""
    return torch.log1p((rest / CAUCHY).square())


def _robust(values: Tensor, basis: Tensor, point: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients [K] of a basis [N, K] for values [N] but for a constant of each point, and what
    is left [N]."""
    weight = torch.ones_like(values)
    count = int(point.max()) + 1 if len(point) else 0
    fitted, rest = basis.new_zeros(basis.shape[1]), values
    for _ in range(ROUNDS):
        total = weight.new_zeros(count).index_add_(0, point, weight).clamp_min(1e-9)

        def centred(values: Tensor, weight: Tensor = weight, total: Tensor = total) -> Tensor:
            sums = values.new_zeros(count, values.shape[1])
            sums.index_add_(0, point, weight[:, None] * values)
            return values - (sums / total[:, None])[point]

        shades, rest = centred(basis), centred(values[:, None])
        weighted = weight[:, None] * shades
        system = weighted.T @ shades + 1e-6 * torch.eye(basis.shape[1], dtype=basis.dtype)
        fitted = torch.linalg.solve(system, weighted.T @ rest)
        rest = (rest - shades @ fitted)[:, 0]
        weight = 1 / (1 + (rest / CAUCHY).square())
    return fitted.reshape(-1), rest
