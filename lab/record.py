"""What one training of many is, and what came out of it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from univoxel.config import TrainConfig
from univoxel.core.choices import LightName
from univoxel.core.files import read_json, write_json
from univoxel.core.validation import changed, check_fields
from univoxel.errors import DataError
from univoxel.presets import chosen

RESULT = "result.json"


@dataclass(frozen=True)
class Setting:
    """How to train, whatever the scene."""

    name: str  # of its folder and in tables; unique among the settings of an experiment
    preset: str = "auto"
    light: LightName = "hybrid"
    minutes: float | None = None  # as in presets.chosen
    changes: tuple[str, ...] = ()  # FIELD=VALUE of the configuration

    def config(self, data: Path, out: Path) -> TrainConfig:
        """The whole configuration.

        Raises:
            ValueError: there is no such preset, light or field, or a value is out of range.
        """
        config = chosen(self.preset, self.minutes, data, out, self.light)
        return changed(config, self.changes)


@dataclass(frozen=True)
class Outcome:
    """One training on one scene."""

    scene: str
    setting: str
    identity: dict[str, Any]  # what a later call must agree with to take this for its own; JSON
    # By the keys of evaluation.measures.MEASURES, steps_made (share of the planned ones), and
    # map_*, the fields of evaluation.recovered_map.Comparison
    measures: Mapping[str, float | int | None] = dataclasses.field(default_factory=dict)
    log: list[dict[str, Any]] = dataclasses.field(
        default_factory=list
    )  # seconds, stage, held_out_psnr
    load_average: float | None = None  # of the machine when it began
    error: str | None = None  # why it failed

    def __post_init__(self) -> None:
        check_fields(self, "text", lambda x: isinstance(x, str), "scene", "setting")
        check_fields(self, "text or None", lambda x: isinstance(x, str | None), "error")
        check_fields(self, "a JSON object", lambda x: isinstance(x, dict), "identity")
        check_fields(self, "a JSON object of numbers", _is_measures, "measures")
        check_fields(
            self,
            "a list of JSON objects",
            lambda x: isinstance(x, list) and all(isinstance(line, dict) for line in x),
            "log",
        )

    def save(self, folder: Path) -> None:
        """Write folder/result.json, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        write_json(folder / RESULT, dataclasses.asdict(self))

    def summary(self) -> dict[str, Any]:
        """All but the identity, which result.json keeps."""
        fields = dataclasses.asdict(self)
        del fields["identity"]
        return fields


def _is_measures(values: object) -> bool:
    return isinstance(values, Mapping) and all(
        isinstance(value, int | float | None) for value in values.values()
    )


def load_outcome(folder: Path) -> Outcome | None:
    """What folder/result.json holds; None if there is none.

    Raises:
        ValueError: it is no such file.
    """
    path = folder / RESULT
    if not path.exists():
        return None
    try:
        return Outcome(**read_json(path))
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"{path}: expected the record of a training run: {error}") from None


def identity(config: TrainConfig, samples: int) -> dict[str, Any]:
    """Everything that decides what comes out, as JSON has it; not where it lies."""
    fields = dataclasses.asdict(config) | {"data": str(config.data.resolve())}
    del fields["out"]
    return json.loads(json.dumps({"samples": samples, "config": fields}, default=str))


def result_text(record: dict[str, Any]) -> str:
    """A record of measurements as JSON text, with one entry a line and six digits a number.

    Each key of the record begins a line. Where its value is a list or a dict of records, each of
    these has a line of its own. So files stay short, and a changed record is a changed line. JSON
    has no number that is not finite: such numbers become text.
    """
    entries = [f"{json.dumps(key)}: {_lines(_rounded(value))}" for key, value in record.items()]
    return "{\n" + ",\n".join(entries) + "\n}\n"


def _lines(value: object) -> str:
    """JSON of one entry; several records stand on a line each."""
    if isinstance(value, list) and any(isinstance(item, (dict, list)) for item in value):
        return "[\n" + ",\n".join(_line(item) for item in value) + "\n]"
    if isinstance(value, dict) and any(isinstance(item, (dict, list)) for item in value.values()):
        lines = (f"{json.dumps(key)}: {_line(item)}" for key, item in value.items())
        return "{\n" + ",\n".join(lines) + "\n}"
    return _line(value)


def _line(value: object) -> str:
    return json.dumps(value, allow_nan=False)


def _rounded(value: Any) -> Any:
    """The same with lists for tuples, text for keys, and numbers of six significant digits."""
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(item) for item in value]
    return value
