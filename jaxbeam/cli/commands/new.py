"""Commands `new` and `schema`: a commented case to start from, and what editors complete it by."""

import json
from importlib import resources
from pathlib import Path

from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.arguments import refuse_option
from jaxbeam.cli.options import Output, OutputOptions
from jaxbeam.runtime.output_file import whole_file

KINDS = ("footbridge", "road-bridge", "railway-bridge", "laboratory-rig")


def new(kind: str, /, *, output: Output = None, options: OutputOptions = OutputOptions()) -> None:
    """Write a commented case to start from, which runs as it is.

    Parameters
    ----------
    kind
        footbridge, road-bridge, railway-bridge or laboratory-rig.
    output
        Write it to this file; KIND.toml in this folder if left out.
    """
    refuse_option(
        kind not in KINDS,
        f"there is no case of kind {kind!r} to start from: {', '.join(KINDS)}",
    )
    path = output or Path(f"{kind}.toml")
    options.check_outputs(path)
    starter = resources.files("jaxbeam") / "files" / "starters" / f"{kind}.toml"
    with whole_file(path, options.overwrite) as partial:
        partial.write_text(starter.read_text(encoding="utf-8"), encoding="utf-8")
    title = read_toml(path)["title"]
    lines = [f"written: {path}", f"{title}; run it: jaxbeam simulate {path} --plot"]
    options.report({"path": str(path), "title": title}, lines)


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

    with whole_file(path, options.overwrite) as partial:
        partial.write_text(json.dumps(json_schema(), indent=1) + "\n", encoding="utf-8")
    line = f"written: {path}; begin a case file with the line: #:schema {path}"
    options.report({"path": str(path)}, [line])
