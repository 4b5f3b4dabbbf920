"""Command `simulate`: one run of a case."""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import jaxbeam as jb
from jaxbeam.cli.arguments import check_suffix
from jaxbeam.cli.commands.describe import settlement_words
from jaxbeam.cli.options import (
    CaseOptions,
    LabelledPictureOptions,
    Output,
    print_plausibility,
    table,
)
from jaxbeam.runtime.output_file import RESULTS

EXTREMES = "smallest", "smallest_time", "largest", "largest_time"
MAX_WHEELS = 8  # of a load, or bodies, with a row each


def simulate(
    case: Path,
    /,
    *,
    output: Output = None,
    animate: Path | None = None,
    pictures: LabelledPictureOptions = LabelledPictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Simulate a case: peaks at sensors, contact forces, commands; the whole record on request.

    `--plot` draws the record to a PNG beside the output, or named after the case.

    Parameters
    ----------
    case
        Case file, TOML.
    output
        Write all of the record to this file, OUT.nc or OUT.zarr, or what sensors measure, contact
        forces and commands to a table: OUT.csv, .xlsx, .mat or .parquet.
    animate
        Write an animation of the run to this file, OUT.gif, or OUT.mp4 if ffmpeg is installed.
    """
    check_suffix(output, ".nc", "a record", RESULTS)
    if animate:
        from jaxbeam.plot.animation import check_film

        check_film(animate)
    picture = pictures.path(output, case)
    options.check_outputs(output, picture, animate)
    parsed_case = options.read(case, judged="")
    labels = pictures.sensor_labels(parsed_case)
    plausibility = print_plausibility(parsed_case, options)

    from jaxbeam.simulation.simulate import ContactLossWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # the verdict says so
        record = jb.simulate(parsed_case)
    if output:
        record.save(output, options.overwrite)
    if picture:
        from jaxbeam.plot import plot_record

        figure = plot_record(record, ax=pictures.page(), title=pictures.title, labels=labels)
        pictures.save(figure, picture)
    if animate:
        from jaxbeam.plot import animate as write_animation

        look = {"title": pictures.title, "size": pictures.inches()}
        write_animation(record, animate, overwrite=options.overwrite, **look)
    content = jb.api.content(record) | {"plausibility": plausibility}
    lines = _lines(record, content["sensors"])
    for words in settlement_words(parsed_case):
        lines.append(f"{words}; sensors read changes from there")
    controller = parsed_case.controller
    if controller is not None and not controller.open_loop:
        from jaxbeam.analysis.stability import stability_margin

        margin = stability_margin(parsed_case, verdict_only=True)
        content["stability"] = margin.verdict
        lines.append(f"the loop is {margin}")
    options.report(content, lines, output, picture, animate)


def _wheel_lines(record: "jb.Record") -> list[str]:
    """Table of contact forces by wheel; of loads of many wheels those with an extreme."""
    import numpy as np

    from jaxbeam.analysis.ride import wheel_unloading
    from jaxbeam.simulation.views import wheel_labels

    loads, labels = record.loads, wheel_labels(record.loads)
    static, lowest = np.asarray(loads.weight)[:, 0], np.asarray(record.lowest_contact_force)
    largest = np.max(record.contact_force, axis=0, initial=0.0)
    unloading = np.asarray(wheel_unloading(record))
    load_of_wheel, rows = np.array(loads.load_of_wheel), []
    for load in range(len(record.case.loads)):
        wheels = np.flatnonzero(load_of_wheel == load)
        names = {int(i): str(labels[i]) for i in wheels}
        if wheels.size > MAX_WHEELS:
            names = _extreme_wheels(names, unloading=unloading, lowest=-lowest, largest=largest)
        rows += [
            (
                name,
                *(f"{f[i]:.6g}" for f in (static, lowest, largest)),
                _percent(unloading[i], bool(loads.prescribed[i])),
            )
            for i, name in names.items()
        ]
    forces = ("static load (N)", "lowest on the beam (N)", "largest at samples (N)")
    header = ("load", *forces, "unloading in the run")
    return table(header, rows)


def _absorber_lines(record: "jb.Record") -> list[str]:
    """Table of the absorbers: largest stroke and force, and energy dissipated."""
    absorbers = record.case.absorbers
    if not absorbers:
        return []
    columns = record.peak_stroke, record.peak_absorber_force, record.absorber_energy[-1]
    rows = [
        (str(i), f"{absorber.position:.4g}", *(f"{column[i]:.6g}" for column in columns))
        for i, absorber in enumerate(absorbers)
    ]
    names = ("position (m)", "largest stroke (m)", "largest force (N)", "dissipated (J)")
    return table(("absorber", *names), rows)


def _extreme_wheels(labels: dict[int, str], **values) -> dict[int, str]:
    """Labels of the wheels at which one of the values is largest, with the names of these.

    Without names if one wheel has all of them.
    """
    import numpy as np

    wheels, words = np.array(list(labels)), {"unloading": "most unloaded"}
    found: dict[int, list[str]] = {}
    for name, of_wheels in values.items():
        own = np.nan_to_num(of_wheels[wheels], nan=-np.inf, posinf=np.inf, neginf=-np.inf)
        if np.any(np.isfinite(own)):
            wheel = int(wheels[np.argmax(own)])
            found.setdefault(wheel, []).append(words.get(name, f"{name} force"))
    return {
        wheel: f"{labels[wheel]}, {' and '.join(names)} of {wheels.size}"
        if len(found) > 1
        else f"{labels[wheel]} of {wheels.size}"
        for wheel, names in found.items()
    }


def _percent(unloading: float, prescribed: bool) -> str:
    """Unloading of a wheel in per cent, or that it would lift; a prescribed force may pull."""
    if unloading > 1:
        return "pulls, as given" if prescribed else "would lift"
    return "-" if unloading != unloading else f"{max(unloading, 0.0):.1%}"


def _body_lines(record: "jb.Record") -> list[str]:
    """Table of motions and ride measures by body; of many vehicles the largest of each."""
    import numpy as np

    names = record.bodies
    if not names:
        return []
    motion = np.max(np.abs(record.body_displacement), axis=0)
    shaking = np.max(np.abs(record.body_acceleration), axis=0)
    columns = {name: [motion[i], shaking[i]] for i, name in enumerate(names)}
    ride = jb.api.ride_of(record)
    if ride is not None:
        measures = ride.weighted_rms, ride.vibration_dose, ride.sperling_index
        for name, *values in zip(ride.bodies, *measures, strict=True):
            columns[name] += values
    heights = {name: row for name, row in columns.items() if not name.endswith(" pitch")}
    if len(heights) > MAX_WHEELS:
        largest: dict[str, list] = {}
        for name, row in heights.items():
            key = re.sub(r" vehicle \d+", "", name)
            largest[key] = np.maximum(largest.get(key, row), row).tolist()
        heights = {f"{name}, largest of all": row for name, row in largest.items()}
    header = ("body", "displacement (m)", "acceleration (m/s^2)")
    if ride is not None:
        header += ("W_k rms (m/s^2)", "VDV (m/s^1.75)", "Sperling W_z")
    rows = [(name, *(f"{v:.4g}" for v in row)) for name, row in heights.items()]
    rows = [row + ("-",) * (len(header) - len(row)) for row in rows]  # absorbers have no rides
    return table(header, rows)


def _lines(record: "jb.Record", sensors: Sequence[dict]) -> list[str]:
    """Verdict and tables of a record, whose sensors are given as `jb.api.content` has them."""
    rows = [
        (
            record.case.sensors[i].name or str(i),
            f"{sensor['position']:.4g}",
            sensor["quantity"] + (f" ({sensor['unit']})" if sensor["unit"] != "1" else ""),
            *("nan" if sensor[name] is None else f"{sensor[name]:.6g}" for name in EXTREMES),
        )
        for i, sensor in enumerate(sensors)
    ]
    header = ("sensor", "position (m)", "quantity", "smallest", "at (s)", "largest", "at (s)")
    for title, name, digits in (
        ("error of steps", "step_error", ".1e"),
        ("error of truncation", "truncation_error", ".1e"),
        ("dynamic amplification", "dynamic_amplification", ".4g"),
    ):
        values = [sensor[name] for sensor in sensors]
        if any(value is not None for value in values):
            header = (*header, title)
            words = ("-" if value is None else f"{value:{digits}}" for value in values)
            rows = [(*row, word) for row, word in zip(rows, words, strict=True)]
    lines = [
        record.verdict,
        *table(header, rows),
        *_wheel_lines(record),
        *_absorber_lines(record),
        *_body_lines(record),
    ]
    if record.case.controller is not None:
        rows = zip(record.peak_command, record.effort, record.saturated.mean(axis=0), strict=True)
        lines += table(
            ("actuator", "largest command", "effort (command^2 s)", "time at limit"),
            [
                (i, f"{peak:.6g}", f"{effort:.6g}", f"{share:.1%}")
                for i, (peak, effort, share) in enumerate(rows)
            ],
        )
    return lines
