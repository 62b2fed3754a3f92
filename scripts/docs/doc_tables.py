"""Tables of pages from benchmarks/results: one function for each kind of result file.

A name is `FILE.json`, or `FILE.json:PART` where a file makes several tables. Most files describe
their own table, as written by hand or by a script of one day:

    title, date, commit   what was measured, when, and the commit that recorded it
    command, note         optional: how, and one sentence about it
    machine               optional: a record of the `processor`, among others
    columns               name, unit and digits of each
    rows                  lists of values, None where nothing was measured
"""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

NVS = ("novel views, dB", "nvs_psnr", 1)
# The frame has a black background that every model gets right, so the mask stands beside it
ALBEDO = (
    ("albedo, whole frame, dB", "albedo_psnr_3ch", 1),
    ("albedo, mask only, dB", "albedo_psnr_fg", 1),
)
ROUGHNESS = ("roughness MSE", "roughness_mse", 4)
RELIT = ("relit, dB", "relit_psnr", 1)
NORMALS = ("normals, degrees", "normal_mae_deg", 1)
SECONDS = ("training, s", "train_seconds", 0)
MEMORY = ("peak memory, MB", "peak_rss_mb", 0)
COLUMNS = 100
SCENES = {"chrome_bottle": "metals", "tea_table": "tea table"}


def block(name: str, results: Path) -> str:
    """The text of a generated block.

    Raises:
        ValueError: the file has another form, or rows of different versions.
        OSError: it cannot be read.
    """
    file, _, part = name.partition(":")
    record = json.loads((results / file).read_text(encoding="utf-8"))
    check_one_version(record)
    if missing := [key for key in ("date", "commit") if not record.get(key)]:
        raise ValueError(f"{file}: has no {' and no '.join(missing)}")
    if beside := BESIDE.get(name):
        record |= {"beside": json.loads((results / beside).read_text(encoding="utf-8"))}
    if kind := KINDS.get(name) or KINDS.get(file):
        made = f"*{version(record)}.*"
        return (
            kind(record, part)
            if part in ("small", "published")
            else f"{made}\n\n{kind(record, part)}"
        )
    if "columns" not in record:
        raise ValueError(f"{file}: no columns, and doc_tables.KINDS has no function for {name}")
    return described(record)


def check_one_version(record: dict[str, Any]) -> None:
    """Refuse a file whose rows are of different commits, versions or machines.

    Raises:
        ValueError: they differ.
    """
    for key, rows in record.items():
        rows = list(rows.values()) if isinstance(rows, dict) else rows
        if not isinstance(rows, list):
            continue
        for field in ("commit", "version", "univoxel"):
            seen = {str(r[field]) for r in rows if isinstance(r, dict) and field in r}
            if len(seen) > 1:
                raise ValueError(f"{key} mix the {field}s {', '.join(sorted(seen))}: split them")


def described(record: dict[str, Any]) -> str:
    """A table whose file says what its columns are; repeated first cells are left blank."""
    columns = record["columns"]
    heads = [f"{c['name']}, {c['unit']}" if c.get("unit") else c["name"] for c in columns]
    rows = []
    for row in record["rows"]:
        if len(row) != len(columns):
            raise ValueError(f"{record['title']}: a row of {len(row)} values: {row}")
        rows.append([number(v, c.get("digits")) for v, c in zip(row, columns, strict=True)])
    numeric = [
        any(isinstance(r[i], (int, float)) for r in record["rows"]) for i in range(len(heads))
    ]
    return "\n\n".join([caption(record), table(heads, grouped(rows), numeric)])


def version(record: dict[str, Any]) -> str:
    """When and at which commit a result was measured, and on which processor if it says so."""
    told = [record["date"], f"commit {record['commit']}"]
    if "machine" in record:
        told.append(record["machine"]["processor"])
    return ", ".join(told)


def caption(record: dict[str, Any]) -> str:
    """What a table shows, when it was measured and how."""
    parts = [f"*{record['title']}* ({version(record)})."]
    if record.get("note"):
        parts.append(record["note"])
    text = textwrap.fill(" ".join(parts), COLUMNS, break_on_hyphens=False)
    return f"{text}\n\n    {record['command']}" if record.get("command") else text


def number(value: object, digits: int | None = None) -> str:
    """A cell: numbers with their digits and thousands apart, a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    text = f"{value}" if digits is None else f"{value:.{digits}f}"
    return f"{float(text):,.0f}" if text.isdigit() and len(text) > 4 else text


def grouped(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """The same with a first cell only where it differs from the one above."""
    found, above = [], None
    for row in rows:
        found.append(["" if row[0] == above and len(row) > 2 else row[0], *row[1:]])
        above = row[0]
    return found


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[bool] = ()) -> str:
    """A Markdown table; columns of numbers are aligned to the right."""
    sides = [*right, *[False] * (len(heads) - len(right))]
    lines = [f"| {' | '.join(heads)} |", f"|{'|'.join('---:' if s else '---' for s in sides)}|"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join(lines)


def measured(
    runs: Iterable[tuple[Sequence[str], dict[str, Any]]],
    keys: Sequence[str],
    columns: Sequence[tuple[str, str, int]],
) -> str:
    """A row for each run, with the named measures; columns without any value are left out."""
    runs = list(runs)
    shown = [c for c in columns if any(m.get(c[1]) is not None for _, m in runs)]
    rows = [[*names, *[number(m.get(k), d) for _, k, d in shown]] for names, m in runs]
    heads = [*keys, *[name for name, _, _ in shown]]
    return table(heads, grouped(rows), [False] * len(keys) + [True] * len(shown))


def _scene(name: str) -> str:
    return SCENES.get(name, name)


# One function for each kind of file that benchmarks and experiments write


def _chart(record: dict[str, Any], part: str) -> str:
    """The presets on three scenes; `small` for the README, beside what `baked` gives; `seeds` with
    how far the seeds lie apart."""
    if part == "small":
        return _beside_baked(record)
    if part == "seeds":
        rows = [((_scene(p["scene"]),), p["ranges"]) for p in record["points"]]
        rows = [row for row in rows if any(row[1].values())]
        return measured(rows, ("scene",), (NVS, *ALBEDO, ROUGHNESS, RELIT, NORMALS))
    columns = (SECONDS, NVS, *ALBEDO, ROUGHNESS, RELIT, NORMALS, MEMORY, ("file, MB", "mb", 1))
    columns = (*columns, ("planned steps made, %", "steps", 0))
    runs = [
        (
            (_scene(p["scene"]), f"`{p['setting']}`"),
            p["measures"]
            | {
                "mb": p["measures"]["model_bytes"] / 1e6,
                "steps": 100 * p["measures"]["steps_made"],
            },
        )
        for p in record["points"]
    ]
    return measured(runs, ("scene", "preset"), columns)


def _beside_baked(record: dict[str, Any]) -> str:
    """`fast` on each scene, and the albedo and relit pictures of a training without light."""
    rows = record["beside"]["rows"]
    baked = {r["scene"]: r["measures"] for r in rows if r["setting"] == "baked"}
    columns = (
        *(SECONDS, NVS, NORMALS, ("albedo, dB", "albedo_psnr_fg", 1)),
        *(("baked albedo, dB", "baked_albedo", 1), RELIT, ("baked relit, dB", "baked_relit", 1)),
    )
    runs = []
    for p in record["points"]:
        if p["setting"] == "fast":
            other = baked[p["scene"]]
            other = {
                "baked_albedo": other["albedo_psnr_fg"],
                "baked_relit": other["relit_psnr"],
            }
            runs.append(((_scene(p["scene"]),), p["measures"] | other))
    return measured(runs, ("scene",), columns)


def _published(record: dict[str, Any], _: str) -> str:
    """What the paper of the method that is followed reports, on its own data."""
    runs = [
        ((p["name"], p["where"]), {"minutes": p["minutes"]} | p["measures"])
        for p in record["published"]
        if p["name"].startswith("UniVoxel")
    ]
    albedo = ("albedo, dB", "albedo_psnr_3ch", 1)
    columns = (("training, minutes", "minutes", 0), NVS, albedo, ROUGHNESS, RELIT, NORMALS)
    return measured(runs, ("method", "data and GPU"), columns)


def _lights(record: dict[str, Any], _: str) -> str:
    """The lighting models by scene, the baseline first; the best of a scene is bold."""
    quality = (NVS, *ALBEDO, RELIT, ("diffuse sphere, dB", "map_ball_psnr", 1), ROUGHNESS, NORMALS)
    lower = {ROUGHNESS, NORMALS}
    columns = (*quality, ("brightest direction, degrees", "map_brightest_degrees", 1), SECONDS)
    rows = []
    for scene in dict.fromkeys(r["scene"] for r in record["rows"]):
        runs = [r for r in record["rows"] if r["scene"] == scene]
        best = {}
        for column in quality:
            values = [v for r in runs if (v := r["measures"].get(column[1])) is not None]
            best[column] = min(values) if column in lower else max(values)
        for run in sorted(runs, key=lambda r: r["setting"] != "baked"):
            cells = []
            for column in columns:
                value = run["measures"].get(column[1])
                text = number(value, column[2])
                cells.append(f"**{text}**" if value == best.get(column, math.nan) else text)
            rows.append([_scene(scene), f"`{run['setting']}`", *cells])
    heads = ["scene", "light", *[name for name, _, _ in columns]]
    return table(heads, grouped(rows), [False] * 2 + [True] * len(columns))


def _demo(record: dict[str, Any], _: str) -> str:
    """What `univoxel eval --json` wrote of the demo."""
    shown = record | {"mb": record["model_bytes"] / 1e6}
    columns = (SECONDS, MEMORY, NVS, *ALBEDO, ROUGHNESS, RELIT, NORMALS, ("file, MB", "mb", 1))
    return measured([(("bundled scene",), shown)], ("scene",), columns)


def _capacity(record: dict[str, Any], part: str) -> str:
    """The preset's sizes against chosen ones; or `fields`: those sizes on every kind of field."""
    columns = (("parameters", "stored_parameters", 0), ("file, MB", "mb", 1), SECONDS, NVS, *ALBEDO)
    columns = (*columns, ROUGHNESS, RELIT, NORMALS)
    runs = []
    for name, m in record["runs"].items():
        scene, _, setting = name.split(" ")
        if setting != "hash" and (setting == "adaptive") == (part == "fields"):
            continue
        runs.append(((_scene(scene), f"`{setting}`"), m | {"mb": m["model_bytes"] / 1e6}))
    scenes = list(dict.fromkeys(names[0] for names, _ in runs))
    runs.sort(key=lambda run: scenes.index(run[0][0]))
    return measured(runs, ("scene", "setting"), columns)


def _ops(record: dict[str, Any], part: str) -> str:
    """Medians of one run, forward and backward; `small` for a few columns."""
    most = max(r["threads"] for r in record["results"])
    alone = {(r["op"], r["size"]): r for r in record["results"] if r["threads"] == 1}
    heads = ["op", "size", f"ms, {most} threads", "over eager torch", "nearest other"]
    heads += [f"1 to {most} threads", "floor, ms"]
    rows = []
    for r in record["results"]:
        if r["threads"] != most:
            continue
        times = {name: t["median_ms"] for name, t in r["contenders"].items()}
        ours, eager = times.pop("univoxel"), times.pop("torch eager", None)
        nearest = min(times, key=lambda name: times[name], default=None)
        before = alone[r["op"], r["size"]]["contenders"]["univoxel"]["median_ms"]
        rows.append(
            [
                *(f"`{r['op']}`", r["size"], f"{ours:.1f}"),
                f"{eager / ours:.1f} x" if eager else "",
                f"{times[nearest] / ours:.1f} x ({nearest})" if nearest else "",
                f"{before / ours:.2f} x",
                f"{r['floor_ms']:.1f} ({r['bound']})" if r["bound"] else "",
            ]
        )
    versions = ", ".join(f"{k} {v}" for k, v in record["versions"].items())
    return f"{versions}; {record['cpu']}.\n\n{table(heads, rows)}"


def _scaling(record: dict[str, Any], part: str) -> str:
    if part == "growth":
        sizes = list(next(iter(record["growth"].values()))["ms"])
        heads = ["op", *[f"{int(s):,}, ms" for s in sizes], "exponent"]
        rows = [
            [f"`{name}`", *[f"{g['ms'][s]:.1f}" for s in sizes], f"{g['exponent']:.2f}"]
            for name, g in record["growth"].items()
        ]
        return table(heads, rows)
    heads = [
        "op",
        "1 thread, ms",
        "2 threads, ms",
        "gain",
        "one of two copies, ms",
        "gain of a core",
    ]
    rows = [
        [
            *(f"`{name}`", f"{t['one']:.1f}", f"{t['two']:.1f}", f"{t['one'] / t['two']:.2f}"),
            *(f"{t['beside']:.1f}", f"{2 * t['alone'] / t['beside']:.2f}"),
        ]
        for name, t in record["threads"].items()
    ]
    return table(heads, rows)


def _train_step(record: dict[str, Any], _: str) -> str:
    native, reference = record["native"], record["reference"]
    heads = ["stage", "references, forward ms", "kernels, forward ms", "kernels, backward ms"]
    rows = []
    for stage, t in native["stages"].items():
        share = 100 * (t["forward_ms"] + t["backward_ms"]) / native["step_ms"]
        before = reference["stages"][stage]["forward_ms"]
        rows.append(
            [
                stage,
                f"{before:.1f}",
                f"{t['forward_ms']:.1f}",
                f"{t['backward_ms']:.1f}",
                f"{share:.0f} %",
            ]
        )
    whole = (reference["step_ms"], native["step_ms"], native["backward_ms"])
    rows.append(["whole step", *[f"{v:.0f}" for v in whole], "100 %"])
    return table([*heads, "share of the step"], rows)


def _profile(record: dict[str, Any], _: str) -> str:
    """Seconds of a whole training by part and stage: a part of the steps, multiplied."""
    stages, part = record["stages"], record["part"]
    names = dict.fromkeys(name for s in stages.values() for name in s["rows"])
    once = ("hull", "carving", "loading", "previews", "checkpoints", "trust", "mesh for rays")

    def seconds(stage: dict[str, Any], name: str) -> float:
        fixed = not stage["steps"] or name.startswith("joint:") or name in once
        return stage["rows"].get(name, 0.0) * (1 if fixed else part)

    sums = {n: sum(seconds(s, n) for s in stages.values()) for n in names}
    whole = sum(sums.values())
    shown = sorted(names, key=lambda n: -sums[n])
    rows = [
        [
            name,
            *[f"{v:.1f}" if (v := seconds(s, name)) >= 0.05 else "" for s in stages.values()],
            *(f"{sums[name]:.1f}", f"{100 * sums[name] / whole:.0f} %"),
        ]
        for name in shown
        if sums[name] >= 0.005 * whole
    ]
    heads = ["part", *[f"{title}, s" for title in stages], "whole, s", "share"]
    return table(heads, rows, [False] + [True] * (len(heads) - 1))


def _field_scaling(record: dict[str, Any], _: str) -> str:
    heads = ["field", "nodes along a side", "stored nodes", "memory, MB", "step, ms"]
    rows = [
        [
            c["kind"],
            str(c["size"]),
            f"{c['nodes']:,}",
            f"{c['memory_mb']:.0f}",
            f"{c['step_ms']:.0f}",
        ]
        for c in record["cases"]
    ]
    return table(heads, grouped(rows), [False] + [True] * 4)


VARYING = {
    "fixed": "unchanged",
    "exposure": "random exposure within 1 stop",
    "metered": "automatic exposure within 1 stop",
    "color": "random gains per channel within 1/2 stop",
    "relit": "rendered again under one light",
    "turned": "rendered again, light turns with the camera",
}


def _varying(record: dict[str, Any], light: str) -> str:
    """The trainings with one of the lights."""
    runs = []
    for kind, meaning in VARYING.items():
        for name, m in record["runs"].items():
            _, _, its_light, photographs, option = name.split(" ")
            if (photographs, its_light) == (kind, light):
                runs.append(((meaning, f"`{option}`"), m))
    columns = (*ALBEDO, RELIT, ROUGHNESS, NVS, ("gain error, stops", "gain_stops", 2))
    return measured(runs, ("photographs", "`--varying`"), columns)


def _priors(record: dict[str, Any], _: str) -> str:
    runs = [((f"{m['loss']['light_smoothness']:g}",), m) for m in record["runs"].values()]
    return measured(runs, ("weight",), (NVS, *ALBEDO, ROUGHNESS, RELIT, NORMALS))


def _stress(record: dict[str, Any], part: str) -> str:
    """Every level of one light, means and deviations; or `lights`: relit PSNR of all lights."""
    points = {(p["axis"], p["light"]): p["value"] for p in record["breaking_points"]}

    def broken(axis: str, light: str) -> str:
        value = points[axis, light]
        return "holds" if value is None else f"{value:.2g}"

    if part == "lights":
        lights = list(dict.fromkeys(r["light"] for r in record["rows"]))
        cells = {
            (r["axis"], r["level"], r["light"]): r["mean"].get("relit_psnr") for r in record["rows"]
        }
        rows = []
        for axis, about in record["axes"].items():
            levels = about["levels"]
            for level in levels:
                shown = [number(cells[axis, level, light], 1) for light in lights]
                bold = f"**{level}**" if level == about["reference"] else level
                rows.append([f"`{axis}`", bold, *shown])
            rows.append([f"`{axis}`", "3 dB lost at", *[broken(axis, light) for light in lights]])
        return table(["axis", "level", *[f"`{x}`, dB" for x in lights]], grouped(rows))
    columns = (RELIT, NVS, *ALBEDO, ROUGHNESS, NORMALS)
    rows = []
    for r in record["rows"]:
        cells = []
        for _, key, digits in columns:
            digits = 3 if key == "roughness_mse" else digits
            mean, spread = r["mean"].get(key), r["spread"].get(key)
            cells.append("-" if mean is None else f"{mean:.{digits}f} ({spread or 0:.{digits}f})")
        about = record["axes"][r["axis"]]
        level = f"**{r['level']}**" if r["level"] == about["reference"] else r["level"]
        last = r["level"] == about["levels"][-1]
        end = broken(r["axis"], r["light"]) if last else ""
        rows.append([f"`{r['axis']}`", level, *cells, end])
    heads = ["axis", "level", *[name for name, _, _ in columns], "3 dB lost at"]
    return table(heads, grouped(rows))


def _stress_counts(record: dict[str, Any], _: str) -> str:
    heads = list(record["counts"])
    return table(heads, [[str(record["counts"][h]) for h in heads]])


def _approximations(record: dict[str, Any], _: str) -> str:
    heads = ["directions", "dtype", "ms", "error, %", "rounding"]
    rows = [
        [
            *(str(r["directions"]), r["dtype"], f"{r['ms']:.1f}", f"{100 * r['error']:.2f}"),
            f"{r['rounding']:.1e}" if r.get("rounding") else "",
        ]
        for r in record["shade_sg"]
    ]
    return table(heads, rows, [True, False, True, True, True])


def _relight(record: dict[str, Any], part: str) -> str:
    """Error by strategy; or `mitsuba`, `pictures` of Cycles, and `rays` of bare Embree."""
    if part == "mitsuba":
        heads = ["material", "samples", "error", "Mitsuba, ms", "univoxel to the same error, ms"]
        names = {"same_brdf": "our BRDF, cosine sampling", "principled": "`principled`"}
        rows = []
        for key, name in names.items():
            for r in record["mitsuba"][key]:
                times = [1000 * r[k] for k in ("seconds", "univoxel_seconds")]
                errors = [str(r["spp"]), f"{r['error']:.3f}"]
                rows.append([name, *errors, *[f"{ms:.1f}" for ms in times]])
        return table(heads, grouped(rows), [False] + [True] * 4)
    if part == "pictures":
        rows = [[r["map"], str(r["bounces"]), f"{r['psnr']:.2f}"] for r in record["pictures"]]
        return table(["map", "bounces", "PSNR, dB"], grouped(rows), [False, True, True])
    if part == "rays":
        r = record["rays"]
        against = (r["ratio_to_bare"], r["ratio_to_bare_packets"])
        heads = ["shadow rays", "rate against `rtcOccluded1`", "against packets of 8"]
        return table(heads, [[f"{r['rays']:,}", *[f"{x:.2f}" for x in against]]], [True] * 3)
    names = {"mis": "map and BRDF (MIS)", "map": "map only", "brdf": "BRDF only"}
    runs: dict[str, dict[int, dict]] = {}
    for r in record["strategies"]:
        runs.setdefault(r["strategy"], {})[r["spp"]] = r
    sizes = [s for s in next(iter(runs.values())) if s in (1, 4, 16, 64, 256, 1024)]
    rows = []
    for what, key, digits in (("error", "error", 3), ("seconds", "seconds", 3)):
        for name, at in runs.items():
            cells = [number(at[s][key], digits) if s in at else "-" for s in sizes]
            rows.append([f"{what}, {names.get(name, name)}", *cells])
    return table(["samples", *map(str, sizes)], rows, [False] + [True] * len(sizes))


def _relight_runs(record: dict[str, Any], part: str) -> str:
    if part == "noise":
        noise = record["sneaker"]["noise"]
        sizes = [n["spp"] for n in next(iter(noise.values()))]
        rows = [
            [f"{name.partition('_')[0]}, {what}", *[number(n[key], d) for n in at]]
            for name, at in noise.items()
            for what, key, d in (("seconds", "seconds", 2), ("error, 1/255", "error_255", 2))
        ]
        return table(["samples", *map(str, sizes)], rows, [False] + [True] * len(sizes))
    rows, bounces = [], []
    for scene in ("sneaker", "tea_table"):
        scores = record[scene]["scores"]
        bounces = list(dict.fromkeys(s["bounces"] for s in scores))
        for exponent in dict.fromkeys(s["exponent"] for s in scores):
            at = {s["bounces"]: s["relit_psnr"] for s in scores if s["exponent"] == exponent}
            power = "" if exponent == 1 else f", roughness to the power of {exponent}"
            rows.append([_scene(scene) + power, *[number(at[b], 2) for b in bounces]])
    return table(["relit, dB, by bounces", *map(str, bounces)], rows)


# Blocks that show a second file: functions find it under "beside" in the record
BESIDE = {"chart.json:small": "lights.json"}

KINDS: dict[str, Callable[[dict[str, Any], str], str]] = {
    "chart.json": _chart,
    "chart.json:small": _chart,
    "chart.json:seeds": _chart,
    "chart.json:published": _published,
    "demo.json": _demo,
    "lights.json": _lights,
    "capacity.json": _capacity,
    "ops.json": _ops,
    "scaling.json": _scaling,
    "train_step.json": _train_step,
    "profile.json": _profile,
    "field_scaling.json": _field_scaling,
    "varying.json": _varying,
    "priors.json": _priors,
    "stress.json": _stress,
    "stress_hybrid.json": _stress,
    "stress_hybrid.json:counts": _stress_counts,
    "stress.json:counts": _stress_counts,
    "approximations.json": _approximations,
    "relight.json": _relight,
    "relight_runs.json": _relight_runs,
}
