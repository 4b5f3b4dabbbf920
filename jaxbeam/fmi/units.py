"""Units for co-simulation by FMI 3.0, written by pythonfmu3 (extra `fmi`).

A unit holds the case file and a script; where it runs, the Python of its host needs jaxbeam.
"""

import os
import shutil
import tempfile
from pathlib import Path

from jaxbeam.case.case import Case
from jaxbeam.files.case_file import save_case
from jaxbeam.fmi.steps import BeamSteps, ControllerSteps
from jaxbeam.runtime.output_file import whole_file

PARTS = {"beam": BeamSteps, "controller": ControllerSteps}

SCRIPT = '''"""Unit for co-simulation of a {part} of jaxbeam."""

from pathlib import Path

from pythonfmu3 import DefaultExperiment, Fmi3Causality, Fmi3Slave, Fmi3Variability, Float64

import jaxbeam as jb
from jaxbeam.fmi import PARTS


class {name}(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        case = jb.load_case(Path(self.resources) / "case.toml")
        self.description = case.title or "{part} of jaxbeam"
        self.steps, self.time = PARTS["{part}"](case), 0.0
        self.default_experiment = DefaultExperiment(
            start_time=0.0, stop_time=float(case.run.duration), step_size={step}
        )
        varies = dict(variability=Fmi3Variability.continuous)
        time = Float64("time", causality=Fmi3Causality.independent, **varies)
        self.register_variable(time)
        commands = [f"command_{{i}}" for i in range(len(case.actuators))]
        readings = [f"sensor_{{i}}" for i in range(len(case.sensors))]
        self.inputs, self.outputs = ({inputs})
        for names, causality in ((self.inputs, "input"), (self.outputs, "output")):
            for name in names:
                setattr(self, name, 0.0)
                start = dict(start=0.0) if causality == "input" else {{}}
                kind = getattr(Fmi3Causality, causality)
                self.register_variable(Float64(name, causality=kind, **varies, **start))

    def do_step(self, current_time, step_size):
        given = [float(getattr(self, name)) for name in self.inputs]
        {step_text}
        for name, value in zip(self.outputs, found):
            setattr(self, name, float(value))
        self.time = current_time + step_size
        return True
'''
STEPS = {
    "beam": "self.steps.step(step_size, given); found = self.steps.readings",
    "controller": "found = self.steps.step(current_time, given)",
}
INPUTS = {"beam": "commands, readings", "controller": "readings, commands"}


def write_fmu(case: Case, path: str | os.PathLike, part: str = "beam", overwrite=False) -> Path:
    """Write the beam or the controller of a case as a unit for co-simulation by FMI 3.0.

    The beam has the inputs command_0, ... (V, A or N, held over a step) and the outputs sensor_0,
    ... (SI units); a controller the other way round. In a loop the master steps the controller
    first, from t with the readings at t, then the beam with its commands, by communication steps
    that divide the period. The name of the file is that of the model.

    Raises ValueError for another part, a name that is none in Python, and cases that `BeamSteps` or
    `ControllerSteps` refuse; FileExistsError for a file that exists, without `overwrite`;
    ImportError, with what to install, without pythonfmu3.
    """
    path = Path(path)
    if part not in PARTS:
        raise ValueError(f"part may be {' or '.join(PARTS)}, not {part!r}")
    if path.suffix != ".fmu" or not (path.stem.isidentifier() and path.stem.isascii()):
        raise ValueError(f"{path.name} cannot be the name of a unit: take letters, digits, _, .fmu")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    try:
        from pythonfmu3 import FmuBuilder
    except ImportError:
        raise ImportError(
            "units for co-simulation are written by pythonfmu3, which is not installed: pip install"
            " pythonfmu3, or pip install 'jaxbeam[fmi]'"
        ) from None
    PARTS[part](case)  # its errors, before anything is written
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        save_case(case, scratch / "case.toml")
        period = 0.0 if case.controller is None else float(case.controller.period or 0.0)
        text = SCRIPT.format(
            part=part,
            name=path.stem,
            step=period or 1 / float(case.run.sample_rate),
            inputs=INPUTS[part],
            step_text=STEPS[part],
        )
        script = scratch / f"{path.stem}_unit.py"
        with open(script, "w", encoding="utf-8") as file:
            file.write(text)
        built = FmuBuilder.build_FMU(script, scratch / "out", [scratch / "case.toml"])
        with whole_file(path, overwrite) as partial:
            shutil.copy(built, partial)
    return path
