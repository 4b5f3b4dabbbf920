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
    """Simulate a case: peak deflections, contact forces, commands; the whole record on request.

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
    content = {
        "peak_deflection": record.peak_deflection,
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


def _lines(record: "jb.Record") -> list[str]:
    peaks = zip(record.case.sensors, record.peak_deflection, strict=True)
    lines = [
        record.verdict,
        *table(
            ("sensor", "position (m)", "peak deflection (m)"),
            [(i, f"{s.position:.4g}", f"{peak:.6g}") for i, (s, peak) in enumerate(peaks)],
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
