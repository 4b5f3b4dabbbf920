"""Command `schema`: the JSON Schema of case files, for editors."""

import json
from pathlib import Path

from jaxbeam.cli.options import Output, OutputOptions


def schema(*, output: Output = None, options: OutputOptions = OutputOptions()) -> None:
    """Write the JSON Schema of case files, with which editors complete and check TOML.

    Parameters
    ----------
    output
        Write it to this file; case.schema.json in this folder if left out.
    """
    path = output or Path("case.schema.json")
    options.check_outputs(path)
    from jaxbeam.files.json_schema import json_schema

    path.write_text(json.dumps(json_schema(), indent=1) + "\n", encoding="utf-8")
    line = f"written: {path}; begin a case file with the line: #:schema {path}"
    options.report({"path": str(path)}, [line])
