"""How a run is judged by evidence."""

import dataclasses
import json

import pytest

from univoxel.run import Evidence, as_json, judge, load_verdict, save_verdict

CLEAN = Evidence(steps={}, psnr=31.0, outline=0.01, hidden=0.05, residual=0.02)


def of(**changes):
    return judge(dataclasses.replace(CLEAN, **changes))


def test_a_good_run_and_what_is_no_number():
    found = judge(CLEAN)
    assert (found.word, found.complete, found.empty) == ("good", True, False)
    assert found.sentence() == "Result: good, validation PSNR 31.0 dB"
    assert of(psnr=float("nan")).word == "retake"
    assert of(residual=float("nan")).word == "retake"


@pytest.mark.parametrize(
    ("name", "usable", "retake", "reason", "remedy"),
    [
        ("psnr", 24.0, 15.0, "validation PSNR 24.0 dB", "take sharp photographs"),
        ("outline", 0.05, 0.2, "5% of the validation pixels", "correct the masks"),
        ("hidden", 0.4, 0.7, "40% of the surface is seen by too few", "more photographs"),
        ("residual", 0.3, 0.9, "30% of the surface differs", "--preset full"),
    ],
)
def test_each_piece_of_evidence_counts(name, usable, retake, reason, remedy):
    found = of(**{name: usable})
    assert found.word == "usable"
    assert reason in found.sentence()
    assert remedy in found.sentence()
    assert of(**{name: retake}).word == "retake"
    assert of(**{name: None}).word == "good"


def test_the_worst_comes_first_and_two_remedies_are_enough():
    found = of(psnr=24.0, residual=0.9, outline=0.05, troubles=2)
    assert found.word == "retake"
    assert "90% of the surface" in found.reasons[0]
    assert len(found.reasons) == 4
    assert len(found.remedies) == 2
    assert of(troubles=1).reasons == ("training failed once and recovered",)


def test_a_run_that_was_cut_or_stopped_is_unfinished():
    found = of(steps={"shape": 0.6, "polish": 0.0}, minutes=2.4, limit=1.0, psnr=24.0)
    assert (found.word, found.complete, found.empty) == ("unfinished", False, True)
    assert found.sentence().startswith(
        "Result: unfinished, the time limit was too short (completed steps: 60% of "
        "shape, 0% of polish); validation PSNR 24.0 dB (26 or more is good). To improve it: train "
    )
    assert not of(steps={"shape": 0.6}).empty
    # Never a limit that was too short
    assert "`--minutes 3`" in of(steps={"shape": 0.9}, minutes=0.5, limit=2.0).remedies[0]
    found = of(steps={"shape": 0.6}, stopped=True, minutes=2.4, limit=1.0)
    assert "training was stopped" in found.sentence()
    assert found.remedies == ("resume the training with `--resume`",)


def test_it_is_kept_with_the_run(tmp_path):
    found = of(steps={"shape": 0.5}, psnr=22.0, limit=1.0, minutes=1.7)
    save_verdict(found, tmp_path)
    assert load_verdict(tmp_path) == found
    values = json.loads((tmp_path / "verdict.json").read_text())
    assert values == json.loads(json.dumps(as_json(found)))
    assert (values["complete"], values["verdict"]) == (False, "unfinished")
    assert load_verdict(tmp_path / "none") is None
    (tmp_path / "verdict.json").write_text("{}")
    assert load_verdict(tmp_path) is None
