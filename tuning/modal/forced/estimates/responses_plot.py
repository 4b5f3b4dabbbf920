"""Figure of measured frequency responses with their coherence."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxbeam.plot.style import use_style
from jaxbeam.runtime.whole_file import whole_file


@use_style
def plot_responses(responses, path: str | Path | None = None) -> Figure:
    """Magnitude, phase and coherence of `MeasuredResponses` over frequency (Hz).

    A colour stands for each output, with a line for each force. Saved if a path is given.
    """
    figure = Figure(figsize=(9, 7))
    size, phase, coherence = figure.subplots(3, 1, sharex=True, height_ratios=(2, 1, 1))
    frequencies = responses.frequencies
    for i, (name, unit) in enumerate(zip(responses.outputs, responses.units, strict=True)):
        for j, force in enumerate(responses.forces):
            values = responses.values[:, i, j]
            size.semilogy(
                frequencies, np.abs(values), color=f"C{i % 10}", linewidth=0.9,
                linestyle=("-", "--", ":", "-.")[j % 4], label=f"{name} ({unit}) / {force} (N)",
            )  # fmt: skip
            phase.plot(
                frequencies, np.degrees(np.angle(values)), ".", color=f"C{i % 10}", markersize=1.5
            )
        coherence.plot(frequencies, responses.coherence[:, i], color=f"C{i % 10}", linewidth=0.9)
    size.set(ylabel="magnitude")
    if len(responses.outputs) * len(responses.forces) <= 10:
        size.legend(frameon=False, fontsize=8, ncols=2)
    phase.set(ylabel="phase (deg)", ylim=(-190, 190), yticks=(-180, 0, 180))
    coherence.set(ylabel="coherence", ylim=(0, 1.05), xlabel="frequency (Hz)")
    if np.all(np.isnan(responses.coherence)):
        coherence.text(
            0.5, 0.5, "one average: no coherence", transform=coherence.transAxes, ha="center"
        )
    coherence.set_xlim(frequencies[0], frequencies[-1])
    figure.suptitle(
        f"{Path(responses.source).name}: {responses.estimator} of {responses.averages} averages"
    )
    if path is not None:
        with whole_file(path, overwrite=True) as beside:
            figure.savefig(beside)
    return figure
