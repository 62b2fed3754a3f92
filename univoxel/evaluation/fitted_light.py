"""The light of a test photograph, fitted to that photograph: how the field measures where light
differs from photograph to photograph."""

from __future__ import annotations

import torch

from univoxel import losses
from univoxel.color import linear_to_srgb, linear_to_srgb_unclipped
from univoxel.data import Photos
from univoxel.lights.views import ShownLight, ViewLights
from univoxel.optim import RowAdam
from univoxel.render.pipeline import at_rays, shade, surface_of_view
from univoxel.scene import Scene
from univoxel.training.surface_update import geometric

STEPS = 100  # of Adam, as of NeRD (Boss et al. 2021) and Neural-PIL
RAYS = 2048  # of a step
LR = 0.05, 0.005  # at begin and end, of log gains and of codes


def fit_light_(scene: Scene, photos: Photos, view: int) -> None:
    """Show the light in which a view looks most like its photograph; all else stays.

    That is a gain per channel and, where light varies (`SceneConfig.varying`), the code that the
    networks of light read.
    """
    whole, wo = surface_of_view(scene, photos.cameras, view)
    color, alpha = photos.picture(view)
    hit = (whole.opacity > 0.5) & (alpha.flatten() > 0.5)
    if scene.views is None:
        scene.views = ViewLights(("test",))
    if not hit.any():  # nothing says what the light is
        scene.views.shown = None
        return
    surface, wo = at_rays(whole, hit), wo[hit]
    target = linear_to_srgb(color.view(-1, 3)[hit])
    log_gain = torch.zeros(3, requires_grad=True)
    codes = scene.views.raw_codes
    code = None if codes is None else torch.zeros(codes.shape[1], requires_grad=True)
    optimizer = RowAdam([log_gain] if code is None else [log_gain, code])
    generator = torch.Generator().manual_seed(view)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = geometric(LR, step / STEPS)
        rays = torch.randint(len(wo), (min(RAYS, len(wo)),), generator=generator)
        with torch.enable_grad():
            scene.views.shown = ShownLight(log_gain.exp(), code)
            shaded = shade(scene, at_rays(surface, rays), wo[rays])
            loss = losses.photometric(linear_to_srgb_unclipped(shaded), target[rays])
            optimizer.zero_grad()
            loss.backward()
        optimizer.step()
    fitted = None if code is None else code.detach()
    scene.views.shown = ShownLight(log_gain.detach().exp(), fitted)
