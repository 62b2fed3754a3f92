"""Settings and outcomes in files."""

from pathlib import Path

import pytest

from lab.record import Outcome, Setting, identity, load_outcome


def test_a_setting_is_a_preset_with_changes():
    setting = Setting("a", "draft", "sg", 2.5, ("stages.1.rays=7", "seed=3"))
    config = setting.config(Path("photos"), Path("run"))
    assert (config.data, config.out, config.minutes) == (Path("photos"), Path("run"), 2.5)
    assert (config.stages[1].rays, config.seed, config.scene.light.kind) == (7, 3, "sg")
    assert Setting("b", "draft").config(Path("a"), Path("b")).minutes is None
    assert Setting("c", minutes=1.5).config(Path("a"), Path("b")).stages[1].voxels < 2.0


def test_identity_is_all_but_the_place():
    def of(name="a", samples=4, out="run", data="photos", **options):
        return identity(Setting(name, **options).config(Path(data), Path(out)), samples)

    assert of() == of(name="b", out="elsewhere")
    others = [of(samples=5), of(light="sg"), of(changes=("seed=1",)), of(data="x"), of(minutes=9.0)]
    assert all(other != of() for other in others)


def test_an_outcome_comes_back_from_its_file(tmp_path):
    assert load_outcome(tmp_path) is None
    outcome = Outcome("s", "a", {"samples": 4}, {"nvs_psnr": 31.5, "chamfer": None}, [{"x": 1}])
    outcome.save(tmp_path)
    assert load_outcome(tmp_path) == outcome
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


@pytest.mark.parametrize("text", ["{", "{}", "[]", '{"scene": "s", "colour": 1}'])
def test_another_file_is_no_record(tmp_path, text):
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(ValueError, match=r"result\.json: expected the record of a training"):
        load_outcome(tmp_path)
