"""Command `state-space`: the matrices of a case as a linear system."""

from pathlib import Path

import jaxbeam as jb
from jaxbeam.cli.arguments import check_suffix, refuse_option
from jaxbeam.cli.options import CaseOptions, Output

SUFFIXES = (".mat", ".npz", ".json", ".csv")


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
    check_suffix(output, SUFFIXES[0], "a linear system", SUFFIXES[1:])
    refuse_option(period is not None and period <= 0, "--period must be positive, in s")
    options.check_outputs(output)
    parsed_case = options.read(case)

    from jaxbeam.files.matrices import matrices_of, write_state_space

    plant = jb.state_space(parsed_case, coordinates)
    system = plant.unloaded if time is None else plant.at(time)
    system = system if period is None else system.discretize(period)
    if output:
        write_state_space(system, output, options.overwrite)
    options.report(matrices_of(system), _lines(system), output)


def _lines(system) -> list[str]:
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
