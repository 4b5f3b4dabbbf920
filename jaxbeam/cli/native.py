"""Command `native`: the optional C code, compiled for this machine."""

from jaxbeam.cli.options import PrintOptions


def native(*, remove: bool = False, options: PrintOptions = PrintOptions()) -> None:
    """Compile the C code for this machine, once; sweeps of peaks use it from then on.

    Needs a C compiler.

    Parameters
    ----------
    remove
        Remove the compiled code; sweeps use XLA again.
    """
    from jaxbeam.integrator import native_peaks

    if remove:
        path = native_peaks.LIBRARY.remove()
        line = f"removed {path}: sweeps use XLA"
    else:
        path = native_peaks.LIBRARY.build()
        line = f"compiled {path}: sweeps on this machine use it from now on"
    options.report({"path": str(path), "compiled": not remove}, [line])
