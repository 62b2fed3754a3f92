"""A survey in figures and in words."""

from __future__ import annotations

from torch import Tensor

from univoxel.confidence.survey import Survey

# Views; a material that fewer see is reported as a guess
FEW_VIEWS = 3
# Degrees of spread; views within are reported as one direction
ONE_SIDE = 15.0
# Share of a point's light; where less comes from outside, that is reported
MIN_VISIBILITY = 0.5
# Mean absolute difference of render and photographs, sRGB; where it is more, that is reported:
# surface, material or light is wrong
MAX_DISAGREEMENT = 0.05
# Share of the surface below which nothing is reported about it
MIN_SHARE = 0.01


def numbers(surveyed: Survey) -> dict[str, float]:
    """The survey in figures: means over the surface, shares of it in [0, 1]."""

    def share(where: Tensor) -> float:
        return where.float().mean().item()

    seen = surveyed.views > 0
    return {
        "doubt_albedo": surveyed.albedo.mean().item(),
        "doubt_roughness": surveyed.roughness.mean().item(),
        "unseen": share(~seen),
        "few_views": share(surveyed.views < FEW_VIEWS),
        "one_side": share(seen & (surveyed.spread < ONE_SIDE)),
        "clipped": share(surveyed.clipped > 0.5),
        "black": share(surveyed.black > 0.5),
        "shut": share(surveyed.visibility < MIN_VISIBILITY),
        "disagreeing": share(surveyed.disagreement > MAX_DISAGREEMENT),
        "dull": share(surveyed.information < 1),
    }


def words(figures: dict[str, float], troubles: list[str]) -> str:
    """The figures as a paragraph, without what is not the case.

    Args:
        troubles: what went wrong in training, from its state.
    """
    sentences = [
        f"Doubt of albedo {figures['doubt_albedo']:.2f}, of roughness "
        f"{figures['doubt_roughness']:.2f} in the mean over the surface (0: well determined, 1: a "
        "guess)."
    ]
    shares = {
        "few_views": f"is seen by fewer than {FEW_VIEWS} cameras: its materials are a guess",
        "one_side": f"is seen from about one direction, within {ONE_SIDE:g} degrees of it: "
        "colour and highlight are hard to tell apart there",
        "clipped": "is clipped in most photographs: shorter exposures would help",
        "black": "is black in most photographs: more light would help",
        "shut": f"gets less than {MIN_VISIBILITY:.0%} of its light from outside: what parts of "
        "the object send to each other may be left in its albedo",
        "disagreeing": f"differs from its photographs by more than {MAX_DISAGREEMENT:g} in "
        "sRGB: its surface, material or light is wrong",
        "dull": "shows no highlight that tells its roughness",
    }
    for name, text in shares.items():
        if figures[name] >= MIN_SHARE:
            sentences.append(f"{figures[name]:.0%} of the surface {text}.")
    sentences.append(
        "Albedo and light share a factor that photographs cannot fix: compare albedos with one "
        "another, not with a colour chart."
    )
    if troubles:
        sentences.append(f"Training met trouble {len(troubles)} times, the last in {troubles[-1]}.")
    return " ".join(sentences)
