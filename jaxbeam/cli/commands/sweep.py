"""Commands about many runs of a case: `sweep`, and `native`, the optional C code for it."""

import math
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import jaxbeam as jb
from jaxbeam.cli.arguments import (
    check_suffix,
    parse_sweep_values,
    refuse_option,
)
from jaxbeam.cli.options import (
    CaseOptions,
    LabelledPictureOptions,
    Output,
    Over,
    PrintOptions,
    print_plausibility,
    table,
)
from jaxbeam.runtime.output_file import RESULTS
from jaxbeam.runtime.printer import counted

if TYPE_CHECKING:
    import numpy as np
    import xarray


def sweep(
    case: Path,
    /,
    *,
    over: Annotated[Over, Parameter(required=True)],
    output: Output = None,
    paired: bool = False,
    fractile: str | None = None,
    limit: tuple[str, ...] = (),
    run_up: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    precision: str = "double",
    memory: str | None = None,
    pictures: LabelledPictureOptions = LabelledPictureOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Simulate a case for many values of some of its parameters.

    `--plot` draws the peaks to a PNG beside the store, or to CASE_sweep.png in this folder:
    trains over speed with resonance speeds, other parameters as curves or maps.

    Parameters
    ----------
    case
        Case file, TOML.
    output
        Write the results to this zarr store, OUT.zarr, block by block; or at the end, a row for
        each run, to OUT.csv, .xlsx, .mat or .parquet, or all to OUT.nc.
    paired
        Pair the values of all parameters one by one instead of computing all combinations.
    fractile
        ADDRESS=0.5,0.95: print and draw these fractiles of the peaks over the values of a
        parameter, as of `profile.seed`, with intervals, means, dynamic amplification and how many
        values are still needed; a histogram where nothing else has several. The results are
        written whole.
    limit
        QUANTITY=VALUE, as "acceleration=3.5 m/s^2": count the runs above it, and draw it; repeat
        it for more.
    run_up
        Start vehicles so far before the bridge that their initial transient on a rough track has
        decayed: at the fastest of the speeds, 1 % of it is left at the bridge.
    resume
        Continue an interrupted sweep in the same store.
    scheduler
        Compute on the workers of a Dask cluster: address of its scheduler, tcp://HOST:PORT. The
        store must be in a folder that all workers see.
    precision
        double, or single: half the bits, errors of a few parts in a million.
    memory
        Memory of the blocks of runs, as "2 GB"; a quarter of what is free if left out.
    """
    values = parse_sweep_values(over)
    refuse_option(
        resume and not output, "--resume needs the store to continue; name it with -o OUT.zarr"
    )
    refuse_option(
        bool(scheduler) and not output, "--scheduler needs a store for the results: -o OUT.zarr"
    )
    check_suffix(output, ".zarr", "a sweep", RESULTS)
    store = output if output and output.suffix == ".zarr" else None
    for option, is_given in (("--resume", resume), ("--scheduler", bool(scheduler))):
        refuse_option(
            is_given and store is None,
            f"{option} needs a store of blocks: -o OUT.zarr",
        )
    fractiles = _fractile_levels(fractile, values)
    picture = pictures.path(output, case.with_stem(f"{case.stem}_sweep"))
    refuse_option(
        bool(picture) and not bool(not fractiles) <= len(_several(values) - set(fractiles)) < 3,
        "--plot draws peaks over one or two parameters with several values; leave it out",
    )
    if not resume:
        is_store = output is not None and output.suffix == ".zarr"
        options.check_outputs(output, picture, others="--resume or " if is_store else "")
    parsed_case = options.read(case, judged="")
    if run_up:
        parsed_case = _with_run_up(parsed_case, values)
    labels, limits = pictures.sensor_labels(parsed_case), _limits(parsed_case, limit)
    plausibility = _print_plausibility(parsed_case, values, options)

    from jaxbeam.simulation.sweeps.cluster import connect

    with connect(scheduler) if scheduler else nullcontext() as client:
        results = jb.sweep(
            parsed_case,
            values,
            store=store,
            resume=resume,
            overwrite=options.overwrite,
            paired=paired,
            progress=not options.json_,
            precision=precision,
            memory=memory,
            client=client,
        )
    if output and not store:
        jb.save(results, output, options.overwrite)
    if picture:
        from jaxbeam.plot import plot_realisations, plot_sweep

        look = {"ax": pictures.page(), "title": pictures.title, "labels": labels, "limits": limits}
        if fractiles and not _several(values) - set(fractiles):
            ((address, levels),) = fractiles.items()
            figure = plot_realisations(results, address, levels[-1], **look)
        else:
            drawn = _fractiles(results, fractiles) if fractiles else results
            figure = plot_sweep(drawn, **look)
        pictures.save(figure, picture)
    options.report(
        jb.api.content(results) | {"plausibility": plausibility} | _statistics(results, fractiles),
        _lines(parsed_case, results, list(values))
        + _limit_lines(results, limits)
        + (_fractile_lines(parsed_case, results, fractiles, values) if fractiles else []),
        output,
        picture,
    )


def _with_run_up(case: "jb.Case", values: dict) -> "jb.Case":
    """Case whose vehicles start far enough before the bridge for all swept speeds."""
    from jaxbeam.analysis.critical_speeds import with_run_up
    from jaxbeam.case.toml_file import number_in_si

    given = [one for name, own in values.items() if name.endswith(".speed") for one in own]
    return with_run_up(case, speeds=[number_in_si(one, "m/s", "speed") for one in given])


def _several(values: dict) -> set[str]:
    """Addresses with more than one value."""
    return {address for address, given in values.items() if len(given) > 1}


def _limits(case: "jb.Case", given: Sequence[str]) -> dict[str, float]:
    """Limits by quantity, in SI units, of QUANTITY=VALUE."""
    from jaxbeam.case.toml_file import number_in_si

    units, limits = {sensor.quantity: sensor.unit for sensor in case.sensors}, {}
    for text in given:
        quantity, _, value = text.partition("=")
        refuse_option(
            quantity not in units or not value,
            f"--limit takes QUANTITY=VALUE of a quantity that a sensor reads, as"
            f" {next(iter(units), 'acceleration')}=1.5, not {text!r}; sensors read"
            f" {', '.join(units) or 'nothing'}",
        )
        limits[quantity] = number_in_si(value, units[quantity], f"--limit {quantity}")
    return limits


def _limit_lines(results: "xarray.Dataset", limits: dict[str, float]) -> list[str]:
    """Lines with the number of runs above each limit."""
    lines = []
    for quantity, limit in limits.items():
        peaks, unit = results[f"peak_{quantity}"], results[f"peak_{quantity}"].attrs["units"]
        above = int((peaks > limit).any("sensor").sum())
        words = f"{limit:g} {unit}" if unit != "1" else f"{limit:g}"
        lines.append(f"{quantity} is above {words} in {above} of {results['failed'].size} runs")
    return lines


def _fractile_levels(given: str | None, values: dict) -> dict[str, list[float]]:
    """Levels of fractiles by the one address over which they are taken; none if none is given."""
    if given is None:
        return {}
    levels = parse_sweep_values([given])
    ((address, found),) = levels.items()
    refuse_option(
        address not in values,
        f"--fractile {given}: {address} is not swept; it is taken over one of {', '.join(values)}",
    )
    refuse_option(
        not all(isinstance(level, float) and 0 <= level <= 1 for level in found),
        f"--fractile {given}: fractiles are numbers from 0 to 1, such as 0.95",
    )
    return {address: [float(level) for level in found]}


def _fractiles(results: "xarray.Dataset", fractiles: dict[str, list[float]]) -> "xarray.Dataset":
    """Fractiles of the peaks over one address; of runs that fail none."""
    import warnings

    ((address, levels),) = fractiles.items()
    peaks = [name for name in results if str(name).startswith("peak_") and name != "peak_time"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # sensors of other quantities are all NaN
        return results[peaks].quantile(levels, address, keep_attrs=True)


def _statistics(results: "xarray.Dataset", fractiles: dict[str, list[float]]) -> dict:
    """Statistics over one address for each level, as content; empty without any."""
    from jaxbeam.simulation.sweeps.realisations import realisations

    found = []
    for address, levels in fractiles.items():
        for level in levels:
            one = realisations(results, address, level)
            peaks = {str(name): one[name].values for name in one}
            heads = {**one.attrs, "statistic": one.statistic.values}
            found.append(jb.api.plain(heads | peaks))
    return {"statistics": found} if found else {}


def _fractile_lines(
    case: "jb.Case", results: "xarray.Dataset", fractiles: dict[str, list[float]], over
) -> list[str]:
    """Statistics of the peak of each sensor, of the other values with the largest fractile."""
    import numpy as np

    from jaxbeam.simulation.sweeps.realisations import CONFIDENCE, realisations, static_peaks

    ((address, levels),) = fractiles.items()
    static, rows = static_peaks(case, set(over)), []
    for level in levels:
        found = realisations(results, address, level)
        for i, sensor in enumerate(case.sensors):
            of_sensor = found[f"peak_{sensor.quantity}"].isel(sensor=i)
            run = np.unravel_index(
                np.nanargmax(of_sensor.sel(statistic="fractile")), of_sensor.shape[1:]
            )
            values = (part[run] for part in of_sensor.values)
            one = dict(zip(found.statistic.values, values, strict=True))
            unit = f" ({sensor.unit})" if sensor.unit != "1" else ""
            amplified = one["fractile"] / static[i]
            rows.append(
                (
                    sensor.name or i,
                    f"{sensor.quantity}{unit}",
                    f"{100 * level:g} %",
                    f"{one['fractile']:.6g}",
                    f"{one['low']:.4g} to {one['high']:.4g}",
                    f"{one['mean']:.4g}",
                    f"{one['mean_low']:.4g} to {one['mean_high']:.4g}",
                    "" if np.isnan(amplified) else f"{amplified:.4g}",
                    f"{one['needed']:.0f}",
                )
            )
    head = (
        f"over {_head(results[address])}, of the largest other values, with intervals of"
        f" {100 * CONFIDENCE:g} %; amplification is the fractile over the static peak:"
    )
    columns = ("sensor", "quantity", "fractile", "peak", "interval", "mean", "interval")
    return [head, *table((*columns, "amplification", "still needed"), rows)]


def _print_plausibility(case: "jb.Case", values, options: CaseOptions) -> dict:
    """Plausibility of the first run in a line, with warnings of the first and the last one."""
    from jaxbeam.simulation.sweeps.sweep import first_and_last

    ends = first_and_last(case, values)  # of wrong values the sweep says what is wrong
    return print_plausibility(ends[0], options, ends[-1]) if ends else {}


def _lines(case: "jb.Case", results: "xarray.Dataset", addresses: Sequence[str]) -> list[str]:
    """Number of runs, and of each sensor the largest and the smallest peak with its run."""
    rows, failed = [], results["failed"].values
    for i, sensor in enumerate(case.sensors):
        peaks, times = (
            results[f"peak_{sensor.quantity}"].values[..., i],
            results["peak_time"].values[..., i],
        )
        unit = f" ({sensor.unit})" if sensor.unit != "1" else ""
        for words, sign in (("largest", 1.0), ("smallest", -1.0)):
            run = _run_of_largest(sign * peaks)
            row = (sensor.name or i, f"{sensor.quantity}{unit}", words, f"{peaks[run]:.6g}")
            rows.append((*row, f"{times[run]:.6g}", *_swept_values(results, run, addresses)))
    runs = f"{counted(failed.size, 'run')}, {failed.sum()} failed"
    header = ("sensor", "quantity", "peak", "size", "time (s)")
    names = [_head(results[address]) for address in addresses]
    lines = [f"{runs}; peaks are largest absolute values:", *table((*header, *names), rows)]
    contact = _contact_lines(case, results, addresses)
    return [*lines, *_truncation_lines(results), *_absorber_lines(results, addresses), *contact]


def _absorber_lines(results: "xarray.Dataset", addresses: Sequence[str]) -> list[str]:
    """Largest stroke and force of each absorber, with their runs."""
    rows = []
    for i in range(results.sizes.get("absorber", 0)):
        for words, name in (("stroke (m)", "peak_stroke"), ("force (N)", "peak_absorber_force")):
            peaks = results[name].values[..., i]
            run = _run_of_largest(peaks)
            values = _swept_values(results, run, addresses)
            rows.append((str(i), words, f"{peaks[run]:.6g}", *values))
    heads = [_head(results[address]) for address in addresses]
    return table(("absorber", "largest", "size", *heads), rows) if rows else []


def _truncation_lines(results: "xarray.Dataset") -> list[str]:
    """Sentence on the truncation errors of the peaks of each quantity, where estimated."""
    errors = [
        f"{name.removeprefix('peak_')} {peaks.attrs['truncation_error']:.1e}"
        for name, peaks in ((str(name), results[name]) for name in results)
        if "truncation_error" in peaks.attrs
    ]
    return [f"modes left out change the largest peaks by about: {', '.join(errors)}"] * bool(errors)


def _head(values: "xarray.DataArray") -> str:
    """Name of a swept dimension, with its unit."""
    unit = values.attrs.get("units", "1")
    words = values.attrs.get("long_name", str(values.name))
    return words if unit == "1" else f"{words} ({unit})"


def _run_of_largest(values: "np.ndarray") -> tuple[int, ...]:
    """Index of the run of the largest of some values (*run,); that of a failed run is NaN."""
    import numpy as np

    largest = np.argmax(np.where(np.isnan(values), -math.inf, values))
    return tuple(map(int, np.unravel_index(largest, values.shape)))


def _swept_values(
    results: "xarray.Dataset", run: tuple[int, ...], addresses: Sequence[str]
) -> list[str]:
    """Values at addresses of a run, an index along the dimensions of the sweep."""
    place, words = dict(zip(results["failed"].dims, run, strict=True)), []
    for address in addresses:
        along = results[address]
        value = along.values[tuple(place[dim] for dim in along.dims)]
        words.append(value if isinstance(value, str) else f"{value:.6g}")
    return words


def _contact_lines(
    case: "jb.Case", results: "xarray.Dataset", addresses: Sequence[str]
) -> list[str]:
    """Smallest contact force of all runs, where it is, and how many runs lose contact.

    Nothing is said of prescribed forces, which neither mass nor spring can change.
    """
    import numpy as np

    from jaxbeam.model.load_set import load_set

    forces = results.get("lowest_contact_force")
    if forces is None:
        return []
    prescribed = load_set(case).prescribed
    if prescribed.size != forces.shape[-1]:  # words change the number of wheels, not their kind
        prescribed = np.full(forces.shape[-1], prescribed.all())
    moved = forces.values[..., ~prescribed]
    if not moved.size or np.isnan(moved).all():
        return []
    least = np.fmin.reduce(moved, axis=-1)
    pulls = np.isfinite(results["contact_lost_time"].values[..., ~prescribed])
    run, lost = _run_of_largest(-least), int(pulls.any(axis=-1).sum())
    where = []
    for address, value in zip(addresses, _swept_values(results, run, addresses), strict=True):
        words, _, unit = _head(results[address]).partition(" (")
        where.append(f"{words} {value} {unit.rstrip(')')}".rstrip())
    words = f"contact is lost in {lost} runs" if lost else "no run loses contact"
    return [f"smallest contact force {least[run]:.6g} N, at {', '.join(where)}; {words}"]


def native(*, remove: bool = False, options: PrintOptions = PrintOptions()) -> None:
    """Compile the C code of sweeps for this processor now, or say why that fails.

    Wheels of Linux, macOS and Windows have it compiled for most processors; elsewhere the first
    sweep of a thousand runs or more compiles it by itself where there is a C compiler.

    Parameters
    ----------
    remove
        Remove the compiled code; sweeps use XLA until this command compiles it again.
    """
    from jaxbeam.simulation.integrator import native_peaks

    if remove:
        path = native_peaks.LIBRARY.remove()
        line = f"removed {path}: sweeps use XLA"
    else:
        path = native_peaks.LIBRARY.build()
        line = f"compiled {path}: sweeps on this machine use it from now on"
    options.report({"path": str(path), "compiled": not remove}, [line])
