"""The command that writes gains for real controllers."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.app import Json, Overwrite, Settings, app
from jaxbeam.cli.arguments import check_outputs, read_case, refuse
from jaxbeam.cli.printing import print_json, print_written


@app.command
def export(
    case: Path,
    /,
    *,
    output: Annotated[Path, Parameter(("-o", "--output"))],
    points: int = 1001,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Write the gains of a case's controller, and its sensors' filters, for a real one.

    Parameters
    ----------
    case
        Case file with a controller that is a table of gains, TOML.
    output
        GAINS.csv, .mat, .tdms or .h (C).
    points
        Points of the table over the crossing; 1001 if left out.
    """
    from jaxbeam.files.export import WRITERS, export_gains, write_gains

    endings = ", ".join(WRITERS)
    refuse(output.suffix not in WRITERS, f"gains are written to {endings}, not to {output}")
    check_outputs(overwrite, output)
    gains = export_gains(read_case(case, set_), points)
    write_gains(gains, output, overwrite)
    if json_:
        print_json({"crc32": gains.checksum, "test_command": gains.test_command})
        return
    print(f"check value {gains.checksum}")
    print_written(output)
