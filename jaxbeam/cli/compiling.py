"""The command that compiles what is written in C for this machine."""

from jaxbeam.cli.app import Json, app
from jaxbeam.cli.printing import print_json


@app.command
def native(*, remove: bool = False, json_: Json = False) -> None:
    """Compile what is written in C for this machine: needs a C compiler, once.

    Sweeps of peaks use it from then on.

    Parameters
    ----------
    remove
        Remove what was compiled; sweeps do without again.
    """
    from jaxbeam.integrator import native_peaks as compiled

    path = compiled.library_path()
    if remove:
        compiled.remove()
    else:
        compiled.build()
    if json_:
        print_json({"path": str(path), "compiled": not remove})
    elif remove:
        print(f"removed {path}: sweeps do without")
    else:
        print(f"compiled {path}: sweeps on this machine use it from now on")
