"""Command `export`: a controller as a program in C, or its gains, for a real-time system."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from jaxbeam.cli.arguments import check_points, refuse_option
from jaxbeam.cli.options import CaseOptions

if TYPE_CHECKING:
    import jaxbeam as jb

PROGRAM_FILES = (".h", ".c", "_samples.h", "_check.c")  # of jaxbeam.export, added to the name
# Those of jaxbeam.export.WRITERS (a test compares), known before JAX is imported.
GAIN_FILES = (".csv", ".mat", ".tdms", ".h")


def export(
    case: Path,
    /,
    *,
    output: Annotated[Path, Parameter(("-o", "--output"))],
    points: int = 1001,
    part: Literal["beam", "controller"] | None = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Write a controller for a real-time system, with its estimator and the filters of its sensors.

    As a program in C99 for a controller of any kind: source, header, samples of a simulated run and
    a loop that checks the commands for them. Or as a table of gains, for those that are one. Or the
    beam, or the controller, as a unit for co-simulation by FMI 3.0.

    Parameters
    ----------
    case
        Case file with a controller that has a period, TOML.
    output
        NAME.c for a program, whose files and functions begin with NAME; GAINS.csv, .mat, .tdms or
        .h (C) for gains; NAME.fmu for a unit of FMI 3.0, which needs the extra "fmi".
    points
        Number of points of the gain table over the crossing; 1001 if left out.
    part
        What a .fmu holds: "beam", if left out, or "controller".
    """
    endings = ", ".join(GAIN_FILES)
    is_program = output.suffix == ".c"
    is_unit = output.suffix == ".fmu"
    refuse_option(
        not (is_program or is_unit) and output.suffix not in GAIN_FILES,
        f"gains are written to {endings}, programs to .c and units to .fmu, not to {output}",
    )
    check_points(points)
    refuse_option(part is not None and not is_unit, "--part is that of a unit, NAME.fmu")
    files = [output.with_name(output.stem + ending) for ending in PROGRAM_FILES]
    options.check_outputs(*(files if is_program else [output]))
    parsed_case = options.read(case)
    if is_program:
        _write_program(parsed_case, output, files, options)
        return
    if is_unit:
        from jaxbeam.export.fmi import write_fmu

        write_fmu(parsed_case, output, part or "beam", options.overwrite)
        options.report({"part": part or "beam"}, [], output)
        return

    from jaxbeam.export import export_gains, write_gains

    gains = export_gains(parsed_case, points)
    write_gains(gains, output, options.overwrite)
    options.report(
        {"crc32": gains.checksum, "test_command": gains.test_command},
        [f"check value {gains.checksum}"],
        output,
    )


def _write_program(case: "jb.Case", output: Path, files: list[Path], options: CaseOptions) -> None:
    """Write the program of a controller in C, and print its cost and how to check it."""
    from jaxbeam.export import export_c, write_c

    program = export_c(case, output.stem)
    write_c(program, output.parent, options.overwrite)
    sources = f"{output} {files[-1]}"
    options.report(
        {
            "files": list(program.files),
            "operations_per_step": program.operations,
            "state_bytes": program.state_bytes,
            "constant_bytes": program.constant_bytes,
            "recorded_samples": program.samples,
        },
        [
            f"at worst {program.operations} operations a step; in double precision"
            f" {program.state_bytes} bytes of state, {program.constant_bytes} of constants",
            f"check: cc -std=c99 {sources} -lm && ./a.out, over {program.samples} samples",
        ],
        *files,
    )
