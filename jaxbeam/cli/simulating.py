"""Commands that simulate a case: modes, one run, many runs, frequency responses."""

import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app
from jaxbeam.cli.arguments import (
    check_outputs,
    check_suffix,
    frequency_range,
    pair_of,
    parked_mass,
    picture_path,
    read_case,
    refuse,
    sweep_values,
)
from jaxbeam.cli.printing import print_json, print_table, print_written


@app.command
def modes(
    case: Path,
    /,
    *,
    set_: Settings = (),
    plot: bool = False,
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Print natural frequencies and damping ratios.

    Parameters
    ----------
    case
        Case file, TOML.
    plot
        Draw the mode shapes to CASE_modes.png in this folder.
    """
    import jaxbeam as jb

    picture = picture_path(None, case.with_stem(f"{case.stem}_modes")) if plot else None
    check_outputs(overwrite, picture)
    parsed_case = read_case(case, set_)
    computed_modes = jb.modes(parsed_case)
    if picture:
        from jaxbeam.plot import plot_modes

        plot_modes(parsed_case, computed_modes).savefig(picture)
    if json_:
        print_json(
            {
                "frequencies_hz": computed_modes.frequencies,
                "damping_ratios": computed_modes.damping_ratios,
            }
        )
        return
    rows = zip(computed_modes.frequencies, computed_modes.damping_ratios, strict=True)
    print_table(
        ("mode", "frequency (Hz)", "damping ratio"),
        [(i + 1, f"{f:.6g}", f"{d:.4g}") for i, (f, d) in enumerate(rows)],
    )
    print_written(picture)


@app.command
def simulate(
    case: Path,
    /,
    *,
    output: Output = None,
    set_: Settings = (),
    plot: bool = False,
    animate: Path | None = None,
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Simulate a case: peaks, contact forces, and on request the whole record.

    Parameters
    ----------
    case
        Case file, TOML.
    output
        Write the record to this netCDF file, OUT.nc.
    plot
        Draw the record to a PNG beside the output, or named after the case.
    animate
        Write the run as a moving picture to this file, OUT.gif.
    """
    import jaxbeam as jb
    from jaxbeam.simulation.simulate import ContactLossWarning

    check_suffix(output, ".nc", "a record")
    check_suffix(animate, ".gif", "a moving picture")
    picture = picture_path(output, case) if plot else None
    check_outputs(overwrite, output, picture, animate)
    parsed_case = read_case(case, set_)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # the verdict says it
        record = jb.simulate(parsed_case)
    if output:
        record.to_netcdf(output, overwrite)
    if picture:
        from jaxbeam.plot import plot_record

        plot_record(record).savefig(picture)
    if animate:
        from jaxbeam.plot import animate as write_moving

        write_moving(record, animate, overwrite=overwrite)
    if json_:
        names = ("peak_deflection", "lowest_contact_force", "contact_lost_time")
        summary = {name: getattr(record, name) for name in names}
        summary |= {"error_estimate": record.error_estimate, "steps": record.steps}
        if parsed_case.controller is not None:
            summary |= {
                "peak_command": record.peak_command,
                "effort": record.effort,
                "saturated": record.saturated.mean(axis=0),
            }
        print_json(summary | {"verdict": record.verdict})
        return
    print(record.verdict)
    peaks = zip(parsed_case.sensors, record.peak_deflection, strict=True)
    print_table(
        ("sensor", "position (m)", "peak deflection (m)"),
        [(i, f"{s.position:.4g}", f"{peak:.6g}") for i, (s, peak) in enumerate(peaks)],
    )
    print_table(
        ("load", "lowest contact force (N)"),
        [(i, f"{force:.6g}") for i, force in enumerate(record.lowest_contact_force)],
    )
    if parsed_case.controller is not None:
        rows = zip(record.peak_command, record.effort, record.saturated.mean(axis=0), strict=True)
        print_table(
            ("actuator", "largest command", "effort (command^2 s)", "saturated"),
            [
                (i, f"{peak:.6g}", f"{effort:.6g}", f"{share:.1%}")
                for i, (peak, effort, share) in enumerate(rows)
            ],
        )
    print(f"{record.steps} steps")
    print_written(output, picture, animate)


@app.command
def sweep(
    case: Path,
    /,
    *,
    over: Annotated[tuple[str, ...], Parameter(required=True)],
    output: Output = None,
    paired: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    precision: str = "double",
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Simulate a case for many values of some of its numbers.

    Parameters
    ----------
    case
        Case file, TOML.
    over
        ADDRESS=START:STOP:COUNT or ADDRESS=V1,V2,...: the values of one number; repeat it for
        more numbers.
    output
        Write the results to this zarr store, OUT.zarr, block by block.
    paired
        Take the values of all numbers together, one by one, not in every combination.
    resume
        Continue an interrupted sweep in the same store.
    scheduler
        Have the workers of a Dask cluster do it: the address of its scheduler, tcp://HOST:PORT.
        The store must be where all of them see it.
    precision
        double, or single: runs in half the bits, to a few parts in a million.
    """
    import jaxbeam as jb
    from jaxbeam.sweeps.cluster import connect

    values = sweep_values(over)
    refuse(resume and not output, "--resume needs the store to continue; name it with -o OUT.zarr")
    refuse(bool(scheduler) and not output, "--scheduler needs a store for the results: -o OUT.zarr")
    check_suffix(output, ".zarr", "a sweep")
    check_outputs(overwrite or resume, output)
    parsed_case = read_case(case, set_)
    with connect(scheduler) if scheduler else nullcontext() as client:
        results = jb.sweep(
            parsed_case,
            values,
            store=output,
            resume=resume,
            overwrite=overwrite,
            paired=paired,
            progress=not json_,
            precision=precision,
            client=client,
        )
    peaks = results["peak_deflection"]
    if json_:
        print_json(
            {"values": values, "dimensions": peaks.dims, "peak_deflection": peaks.to_numpy()}
        )
        return
    rows = []
    for i in range(peaks.sizes["sensor"]):
        one = peaks.isel(sensor=i)
        worst = one.isel(one.fillna(-1.0).argmax(...))
        where = [f"{float(worst[address]):.6g}" for address in values]
        rows.append((i, f"{float(worst):.6g}", *where))
    failed = peaks.isnull().any("sensor")
    print(f"{failed.size} runs, {int(failed.sum())} failed; the largest peak at each sensor:")
    print_table(("sensor", "peak deflection (m)", *(f"at {name}" for name in values)), rows)
    print_written(output)


@app.command
def frf(
    case: Path,
    /,
    *,
    pair: tuple[str, ...] = (),
    mass_at: tuple[str, ...] = (),
    from_: Annotated[float, Parameter("--from")] = 1.0,
    to: float = 1000.0,
    points: int = 2000,
    output: Output = None,
    set_: Settings = (),
    plot: bool = False,
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Frequency responses of a case, its loads away: where they peak and where they drop.

    Parameters
    ----------
    case
        Case file, TOML.
    pair
        INPUT:OUTPUT, repeated for more; all commands to all sensors if left out. Inputs:
        actuators.0, actuators.0.active_force, force@0.3. Outputs: sensors.0, deflection@0.3,
        velocity@0.3, acceleration@0.3, slope@0.3, actuators.0.current, actuators.0.active_force,
        actuators.0.transmitted_force. Positions are in m.
    mass_at
        POSITION=MASS: park a mass (kg) on the beam (m); repeat it for more.
    from_
        Lowest frequency in Hz, 1 if left out.
    to
        Highest frequency in Hz, 1000 if left out.
    points
        Number of frequencies, at equal ratios; 2000 if left out.
    output
        Write the responses to this netCDF file, OUT.nc.
    plot
        Draw magnitude and phase to a PNG beside the output, or to CASE_frf.png in this folder.
    """
    from jaxbeam.model.frequency_response import extremes, frequency_response

    check_suffix(output, ".nc", "a frequency response")
    picture = picture_path(output, case.with_stem(f"{case.stem}_frf")) if plot else None
    check_outputs(overwrite, output, picture)
    frequencies = frequency_range(from_, to, points)
    pairs = [pair_of(text) for text in pair] or None
    stationary_masses = [parked_mass(text) for text in mass_at]
    response = frequency_response(read_case(case, set_), frequencies, pairs, stationary_masses)
    if output:
        response.to_netcdf(output, overwrite)
    if picture:
        from jaxbeam.plot import plot_frequency_response

        plot_frequency_response(response).savefig(picture)
    if json_:
        columns = zip(response.pairs, response.magnitude.T, response.phase.T, strict=True)
        responses = [
            {**pair._asdict(), "magnitude": magnitude, "phase_deg": phase}
            for pair, magnitude, phase in columns
        ]
        print_json({"frequencies_hz": response.frequencies, "responses": responses})
        return
    for i, pair in enumerate(response.pairs):
        print(f"{pair}, in {pair.unit}" if pair.unit != "1" else str(pair))
        print_table(
            ("", "frequency (Hz)", "magnitude"),
            [(word, f"{f:.5g}", f"{size:.5g}") for word, f, size in extremes(response, i)],
        )
    print_written(output, picture)
