"""Command `app`: a page in the browser."""

from pathlib import Path

from jaxbeam.cli.arguments import check_exists, refuse_option
from jaxbeam.cli.options import enable_compile_cache, print_message


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
    from jaxbeam.app.server import serve

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
