"""Command `check`: whether a case is valid and plausible, before it runs."""

from pathlib import Path

import jaxbeam as jb
from jaxbeam.cli.options import CaseOptions, print_warnings


def check(case: Path, /, *, options: CaseOptions = CaseOptions()) -> None:
    """Check a case without running it: errors, and warnings of what looks wrong, as units.

    Parameters
    ----------
    case
        Case file, TOML.
    """
    found = jb.check(options.read(case, judged=""))
    print_warnings(found)
    number = len(found.warnings)
    words = "nothing looks wrong" if not number else f"{number} warning{'s' * (number > 1)}"
    options.report(jb.api.content(found), [f"plausibility: {found}", words])
