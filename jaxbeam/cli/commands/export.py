"""Command `export`: gains of a controller, for a real-time system."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.arguments import refuse_option
from jaxbeam.cli.options import CaseOptions

# Those of jaxbeam.files.export.WRITERS (a test compares), known before JAX is imported.
GAIN_FILES = (".csv", ".mat", ".tdms", ".h")


def export(
    case: Path,
    /,
    *,
    output: Annotated[Path, Parameter(("-o", "--output"))],
    points: int = 1001,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Write the gains of a controller, and the filters of its sensors, for a real-time system.

    Parameters
    ----------
    case
        Case file with a controller that is a table of gains, TOML.
    output
        GAINS.csv, .mat, .tdms or .h (C).
    points
        Number of points of the gain table over the crossing; 1001 if left out.
    """
    endings = ", ".join(GAIN_FILES)
    refuse_option(
        output.suffix not in GAIN_FILES, f"gains are written to {endings}, not to {output}"
    )
    options.check_outputs(output)
    parsed_case = options.read(case)

    from jaxbeam.files.export import export_gains, write_gains

    gains = export_gains(parsed_case, points)
    write_gains(gains, output, options.overwrite)
    options.report(
        {"crc32": gains.checksum, "test_command": gains.test_command},
        [f"check value {gains.checksum}"],
        output,
    )
