"""Commands to start with: `new` and `schema` for case files, `app` for the page in the browser."""

import json
from importlib import resources
from pathlib import Path

from jaxbeam.case.toml_file import read_toml
from jaxbeam.cli.arguments import check_exists, refuse_option
from jaxbeam.cli.options import Output, OutputOptions, enable_compile_cache, print_message
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


def app(case: Path | None = None, /, *, no_browser: bool = False, port: int = 0) -> None:
    """Open a page in the browser: build a case, see it move, sweep it, fit it to logs.

    It serves this machine alone, and shows the case files of the folder of CASE, or of this folder.
    Ctrl-C ends it.

    Parameters
    ----------
    case
        Case file, TOML, to open first.
    no_browser
        Print the address of the page on one line, and do not open it.
    port
        Port of the page; any that is free if left out.
    """
    refuse_option(not 0 <= port < 65536, f"--port must be from 0 to 65535; it is {port}")
    if case is not None:
        check_exists("case file", case)
    _check_packages()
    enable_compile_cache()
    from jaxbeam.cli.page.server import serve

    folder, opened = (Path.cwd(), None) if case is None else (case.parent, case.name)
    if not no_browser:
        print_message("the page is open in the browser; Ctrl-C ends it")
    serve(folder, opened, port, browser=not no_browser)


def _check_packages() -> None:
    try:
        import starlette  # noqa: F401
        import tomlkit  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"the page needs {error.name}, which is not installed: pip install 'jaxbeam[app]'"
        ) from None
