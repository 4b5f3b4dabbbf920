"""Commands of the linear system: natural frequencies, frequency responses, matrices."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.cli.arguments import (
    check_suffix,
    frequency_grid,
    input_output_pair,
    refuse_option,
    stationary_mass,
)
from jaxbeam.cli.options import CaseOptions, Output, PictureOptions, table
from jaxbeam.runtime.output_file import RESULTS, TABLES

MATRIX_SUFFIXES = (".mat", ".npz", ".json", ".csv")


def modes(
    case: Path,
    /,
    *,
    output: Output = None,
    pictures: PictureOptions = PictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compute natural frequencies and damping ratios.

    `--plot` draws the mode shapes to CASE_modes.png in this folder.

    Parameters
    ----------
    case
        Case file, TOML.
    output
        Write the table to this file, OUT.csv, .xlsx, .mat or .parquet, or OUT.nc or .zarr with the
        mode shapes.
    """
    check_suffix(output, TABLES[0], "a table of modes", RESULTS)
    picture = pictures.path(None, case.with_stem(f"{case.stem}_modes"))
    options.check_outputs(output, picture)
    parsed_case = options.read(case, judged="structure")
    found = jb.modes(parsed_case)
    if picture:
        from jaxbeam.plot import plot_modes

        figure = plot_modes(parsed_case, found, ax=pictures.page(), title=pictures.title)
        pictures.save(figure, picture)
    if output:
        jb.save(found, output, options.overwrite)
    rows = zip(found.frequencies, found.damping_ratios, strict=True)
    options.report(
        {"frequencies_hz": found.frequencies, "damping_ratios": found.damping_ratios},
        table(
            ("mode", "frequency (Hz)", "damping ratio"),
            [
                (i, f"{frequency:.6g}", f"{ratio:.4g}")
                for i, (frequency, ratio) in enumerate(rows, 1)
            ],
        ),
        output,
        picture,
    )


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
    pictures: PictureOptions = PictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compute frequency responses without the loads; print resonances and antiresonances.

    `--plot` draws magnitude and phase to a PNG beside the output, or to CASE_frf.png in this
    folder.

    Parameters
    ----------
    case
        Case file, TOML.
    pair
        INPUT:OUTPUT; repeat it for more. All commands to all sensors if left out. Inputs:
        actuators.0, actuators.0.active_force, force@0.3. Outputs: sensors.0, deflection@0.3,
        velocity@0.3, acceleration@0.3, slope@0.3, actuators.0.current, actuators.0.active_force,
        actuators.0.transmitted_force. Positions are in m.
    mass_at
        POSITION=MASS: a mass (kg) that stands on the beam at a position (m); repeat it for more.
    from_
        Lowest frequency (Hz), 1 if left out.
    to
        Highest frequency (Hz), 1000 if left out.
    points
        Number of frequencies, logarithmically spaced; 2000 if left out.
    output
        Write the responses to this file: OUT.nc, .zarr, .csv, .xlsx, .mat or .parquet.
    """
    check_suffix(output, ".nc", "a frequency response", RESULTS)
    picture = pictures.path(output, case.with_stem(f"{case.stem}_frf"))
    options.check_outputs(output, picture)
    frequencies = frequency_grid(from_, to, points)
    pairs = [input_output_pair(text) for text in pair] or None
    masses = [stationary_mass(text) for text in mass_at]
    parsed_case = options.read(case, judged="structure")

    from jaxbeam.model.frequency_responses import frequency_response, resonances_and_antiresonances

    response = frequency_response(parsed_case, frequencies, pairs, masses)
    if output:
        jb.save(response, output, options.overwrite)
    if picture:
        from jaxbeam.plot import plot_frequency_response

        figure = plot_frequency_response(response, ax=pictures.page(), title=pictures.title)
        pictures.save(figure, picture)
    columns = zip(response.pairs, response.magnitude.T, response.phase.T, strict=True)
    lines = []
    for i, channel_pair in enumerate(response.pairs):
        unit = channel_pair.unit
        lines.append(str(channel_pair) if unit == "1" else f"{channel_pair}, in {unit}")
        rows = [
            (word, f"{f:.5g}", f"{size:.5g}")
            for word, f, size in resonances_and_antiresonances(response, i)
        ]
        lines += table(("", "frequency (Hz)", "magnitude"), rows)
    options.report(
        {
            "frequencies_hz": response.frequencies,
            "responses": [
                {
                    "input": channel_pair.input,
                    "output": channel_pair.output,
                    "unit": channel_pair.unit,
                    "magnitude": magnitude,
                    "phase_deg": phase,
                }
                for channel_pair, magnitude, phase in columns
            ],
        },
        lines,
        output,
        picture,
    )


def state_space(
    case: Path,
    /,
    *,
    time: float | None = None,
    coordinates: str = "modal",
    period: float | None = None,
    output: Output = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Compute the matrices A, B, C, D of the beam with its actuators and sensors.

    Inputs are the commands, with loads on the beam also their weights; the controller is left out.

    Parameters
    ----------
    case
        Case file, TOML.
    time
        Time (s) at whose positions the loads are frozen; without loads if left out.
    coordinates
        Coordinates of the states: modal, or sine, the amplitudes of sines of a pinned beam.
    period
        Sampling period (s) of the system in discrete time, for held inputs.
    output
        Write matrices, names and units to this file: OUT.mat, .npz, .json or .csv.
    """
    check_suffix(output, MATRIX_SUFFIXES[0], "a linear system", MATRIX_SUFFIXES[1:])
    refuse_option(period is not None and period <= 0, "--period must be positive, in s")
    options.check_outputs(output)
    parsed_case = options.read(case, judged="structure")

    from jaxbeam.files.tables import matrices_of, write_state_space

    plant = jb.state_space(parsed_case, coordinates)
    system = plant.unloaded if time is None else plant.at(time)
    system = system if period is None else system.discretize(period)
    if output:
        write_state_space(system, output, options.overwrite)
    options.report(matrices_of(system), _system_lines(system), output)


def _system_lines(system) -> list[str]:
    """Sizes and signals, and the matrices with few digits."""
    import numpy as np

    lines = []
    for kind in ("states", "inputs", "outputs"):
        signals = ", ".join(f"{signal.name} ({signal.unit})" for signal in getattr(system, kind))
        lines.append(f"{kind}: {signals or 'none'}")
    for name in "ABCD":
        rows = np.asarray(getattr(system, name))
        if rows.size:
            text = np.array2string(rows, precision=4, max_line_width=100, suppress_small=False)
            lines.append(f"{name} =\n{text}")
    return lines
