"""Choices of capacity, and their entries in the state of a run."""

import json

from plain import plain_stage

from univoxel.training.compression import stage_voxels
from univoxel.training.progress import CapacityChoice, chosen_reach, chosen_voxels

# As runs have it in their checkpoints and logs
ENTRY = {
    "what": "voxels",
    "before": 1_000_000,
    "after": 37_037,
    "cost": 0.0625,
    "why": "held-out rays after rehearsals",
    "said": "voxels 1,000,000 -> 37,037: held-out rays after rehearsals",
}


def test_an_entry_is_read_and_written_as_it_was():
    choice = CapacityChoice.from_json(json.loads(json.dumps(ENTRY)))
    assert choice.kind == "voxels"
    assert choice.sentence == ENTRY["said"]
    assert json.dumps(choice.as_json()) == json.dumps(ENTRY)


def test_choices_are_found_by_their_kind():
    def choice(kind, after):
        return CapacityChoice(kind, 10**6, after, 0.0, "")

    choices = [choice("voxels", 5e4), choice("reach", 2.5), choice("rows", 9), choice("reach", 1.5)]
    assert chosen_voxels(choices) == 50_000
    assert chosen_reach(choices) == 1.5
    assert chosen_voxels(choices[1:]) is None
    assert chosen_reach(choices[2:3]) is None
    stage = plain_stage(voxels=0.06, iterations=1, share=1.0)
    assert stage_voxels(stage, choices) == 50_000
    assert stage_voxels(stage, [choice("voxels", 70_000)]) == 60_000
    assert stage_voxels(stage, []) == 60_000
