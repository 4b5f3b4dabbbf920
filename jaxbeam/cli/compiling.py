"""The command that compiles what is written in C for this machine."""

from jaxbeam.cli.app import Json, app
from jaxbeam.cli.printing import print_json


@app.command
def native(*, remove: bool = False, json_: Json = False) -> None:
    """Compile what is written in C for this machine: needs a C compiler, once.

    Steps of sweeps, which use it from then on, and designs that ask for it (in_time = "native").

    Parameters
    ----------
    remove
        Remove what was compiled; sweeps do without again.
    """
    from jaxbeam.integrator import native_peaks as compiled
    from jaxbeam.numerics import native_designs as designs

    path = compiled.binary()
    if remove:
        compiled.remove()
        designs.LIBRARY.remove()
    else:
        compiled.build()
        designs.LIBRARY.build()
    if json_:
        print_json({"path": str(path), "compiled": not remove})
    elif remove:
        print(f"removed {path}: sweeps do without")
    else:
        print(f"compiled {path}: sweeps on this machine use it from now on")
