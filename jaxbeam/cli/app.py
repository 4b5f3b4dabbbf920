"""The application, and the options that several of its commands have in common."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

app = App(
    name="jaxbeam",
    help="Beams under moving loads: simulate, sweep, and identify from measured logs.",
    help_format="plaintext",
    result_action="return_value",
    default_parameter=Parameter(negative=(), show_default=False),
)

Settings = Annotated[
    tuple[str, ...],
    Parameter("--set", help="ADDRESS=VALUE: change an entry of the case."),
]
Json = Annotated[bool, Parameter("--json", help="Print JSON on standard output, for programs.")]
Overwrite = Annotated[bool, Parameter("--overwrite", help="Replace output files that exist.")]

Output = Annotated[Path | None, Parameter(("-o", "--output"))]


def print_message(message: str) -> None:
    """Tell the user something that is no result, on standard error."""
    print(f"jaxbeam: {message}", file=sys.stderr)
