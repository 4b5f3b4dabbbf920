"""Command `simulate`: one run of a case."""

import warnings
from pathlib import Path

import jaxbeam as jb
from jaxbeam.cli.arguments import check_suffix, figure_path
from jaxbeam.cli.options import CaseOptions, Output, table


def simulate(
    case: Path,
    /,
    *,
    output: Output = None,
    plot: bool = False,
    animate: Path | None = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Simulate a case: peaks at sensors, contact forces, commands; the whole record on request.

    Parameters
    ----------
    case
        Case file, TOML.
    output
        Write the record to this netCDF file, OUT.nc.
    plot
        Draw the record to a PNG beside the output, or named after the case.
    animate
        Write an animation of the run to this file, OUT.gif.
    """
    check_suffix(output, ".nc", "a record")
    check_suffix(animate, ".gif", "an animation")
    picture = figure_path(output, case) if plot else None
    options.check_outputs(output, picture, animate)
    parsed_case = options.read(case)

    from jaxbeam.simulation.simulate import ContactLossWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # the verdict tells it
        record = jb.simulate(parsed_case)
    if output:
        record.to_netcdf(output, options.overwrite)
    if picture:
        from jaxbeam.plot import plot_record

        plot_record(record).savefig(picture)
    if animate:
        from jaxbeam.plot import animate as write_animation

        write_animation(record, animate, overwrite=options.overwrite)
    options.report(_to_dict(record), _lines(record), output, picture, animate)


def _to_dict(record: "jb.Record") -> dict:
    """Numbers of a record by their names in JSON (SI units)."""
    from jaxbeam.case.sensors import sensor_labels

    sensors = record.case.sensors
    peaks = zip(sensors, record.peak_deflection, strict=True)
    content = {
        "sensors": [
            {"name": label, "quantity": s.quantity, "unit": s.unit, "position": s.position}
            | extremes
            for label, s, extremes in zip(
                sensor_labels(sensors), sensors, _extremes_of_sensors(record), strict=True
            )
        ],
        # None at sensors of other quantities.
        "peak_deflection": [peak if s.quantity == "deflection" else None for s, peak in peaks],
        "lowest_contact_force": record.lowest_contact_force,
        "contact_lost_time": record.contact_lost_time,
        "error_estimate": record.error_estimate,
        "steps": record.steps,
    }
    if record.case.controller is not None:
        content |= {
            "peak_command": record.peak_command,
            "effort": record.effort,
            "saturated": record.saturated.mean(axis=0),
        }
    return content | {"verdict": record.verdict}


def _extremes_of_sensors(record: "jb.Record") -> list[dict[str, float]]:
    """Smallest and largest value of each sensor and their times, by name."""
    names, columns = zip(*record.extremes._asdict().items(), strict=True)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def _lines(record: "jb.Record") -> list[str]:
    sensors = record.case.sensors
    rows = [
        (
            sensor.name or str(i),
            f"{sensor.position:.4g}",
            f"{sensor.quantity} ({sensor.unit})" if sensor.unit != "1" else sensor.quantity,
            *(f"{extremes[name]:.6g}" for name in ("smallest", "smallest_time")),
            *(f"{extremes[name]:.6g}" for name in ("largest", "largest_time")),
        )
        for i, (sensor, extremes) in enumerate(
            zip(sensors, _extremes_of_sensors(record), strict=True)
        )
    ]
    lines = [
        record.verdict,
        *table(
            ("sensor", "position (m)", "quantity", "smallest", "at (s)", "largest", "at (s)"), rows
        ),
        *table(
            ("load", "lowest contact force (N)"),
            [(i, f"{force:.6g}") for i, force in enumerate(record.lowest_contact_force)],
        ),
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
    return [*lines, f"{record.steps} steps"]
