"""Data flows one way: a module imports only what ranks below it."""

import ast

import pytest

from tests.modules import PACKAGES, module_files, parse

# One layer a line, lowest first; the modules of a layer do not import each other. A new module
# goes into the lowest layer above all that it imports. A package named here stands for those of
# its modules that are not named themselves, which may import each other.
LAYERS = """
jaxbeam.analysis.bound.__init__  jaxbeam.analysis.__init__  jaxbeam.sweeps.__init__  jaxbeam.simulation.__init__  jaxbeam.files.__init__  jaxbeam.control.predictive.__init__  jaxbeam.control.optimal.__init__  jaxbeam.integrator.__init__  jaxbeam.model.__init__  jaxbeam.numerics.__init__  jaxbeam.runtime.__init__  jaxbeam.case.__init__  jaxbeam.files.report  jaxbeam.integrator.input_policy  jaxbeam.numerics.eigen  jaxbeam.case.fields  jaxbeam.numerics.discretisation
jaxbeam.runtime.compile_cache  jaxbeam.numerics.batched_linalg
jaxbeam.runtime.compiling
jaxbeam.case.declared_checks  jaxbeam.numerics.piecewise  jaxbeam.numerics.intervals
jaxbeam.numerics.stages  jaxbeam.runtime.native_library
jaxbeam.numerics.coupled_stages
jaxbeam.case.beam  jaxbeam.case.filters  jaxbeam.case.trajectory  jaxbeam.case.actuators  jaxbeam.case.controller
jaxbeam.case.estimator  jaxbeam.case.loads  jaxbeam.numerics.riccati  jaxbeam.integrator.events  jaxbeam.case.sensors
jaxbeam.case.case  jaxbeam.numerics.gain_table  jaxbeam.model.sensor_signals
jaxbeam.numerics.gain_polynomials
jaxbeam.numerics.native_designs
jaxbeam.numerics.finite_horizon
jaxbeam.case.validation
jaxbeam.model.modes
jaxbeam.model.measurement  jaxbeam.model.modal_model
jaxbeam.model.flexibility  jaxbeam.integrator.propagators  jaxbeam.numerics.peak_search  jaxbeam.model.channels  jaxbeam.model.sine_basis
jaxbeam.model.frequency_response  jaxbeam.integrator.time_grid
jaxbeam.model.contact
jaxbeam.integrator.adaptive_reference  jaxbeam.model.state_space  jaxbeam.model.statics  jaxbeam.integrator.step_matrices
jaxbeam.model.sensor_filters
jaxbeam.estimation
jaxbeam.control  jaxbeam.integrator.running_peaks
jaxbeam.integrator.step  jaxbeam.files.case_file
jaxbeam.integrator.integrate
jaxbeam.files.export  jaxbeam.simulation.closed_loop  jaxbeam.integrator.native_peaks  jaxbeam.analysis.frozen_loop  jaxbeam.simulation.record  jaxbeam.rigs
jaxbeam.analysis.linearised_loop  jaxbeam.simulation.integration_plan
jaxbeam.analysis.margins  jaxbeam.sweeps.programs  jaxbeam.analysis.stability  jaxbeam.analysis.computing_time  jaxbeam.analysis.limit_cycles
jaxbeam.analysis.stability_limits  jaxbeam.analysis.crossing_margin
jaxbeam.analysis.bound.input_influence
jaxbeam.analysis.bound.linear_program
jaxbeam.analysis.bound.bound
jaxbeam.sweeps.batches  jaxbeam.sweeps.step_size  jaxbeam.sweeps.store
jaxbeam.simulation.simulate  jaxbeam.analysis.static_correction
jaxbeam.analysis.amplification
jaxbeam.sweeps.blocks
jaxbeam.sweeps.specification
jaxbeam.sweeps.cluster
jaxbeam.sweeps.sweep  jaxbeam.analysis.compare
jaxbeam.analysis.derived_gains  jaxbeam.plot
jaxbeam.__init__
tuning
experiments
jaxbeam.cli.arguments  jaxbeam.cli.printing
jaxbeam.cli
jaxbeam.__main__
"""
RANKS = {name: rank for rank, layer in enumerate(LAYERS.split("\n")) for name in layer.split()}
FILES = module_files()


def place(module: str) -> str | None:
    """The entry of the table under which a module falls."""
    parts = module.split(".")
    names = [".".join(parts[: i + 1]) for i in range(len(parts))]
    return next((name for name in reversed(names) if name in RANKS), None)


def imported(tree: ast.AST) -> set[str]:
    """Our modules that the code in a syntax tree imports, anywhere in it."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            # `from package import name` may mean the module package.name
            found |= {
                inner if is_module(inner := f"{node.module}.{alias.name}") else str(node.module)
                for alias in node.names
            }
    ours = {name for name in found if name.split(".")[0] in PACKAGES}
    return {name if name in FILES else f"{name}.__init__" for name in ours}


def is_module(name: str) -> bool:
    """Tell whether a dotted name is a module or package of ours."""
    return name in FILES or f"{name}.__init__" in FILES


def imported_at_once(tree: ast.Module) -> set[str]:
    """Our modules that are imported as soon as the module itself is, not within a function."""
    eager = [node for node in tree.body if not isinstance(node, ast.FunctionDef)]
    return imported(ast.Module(eager, []))


@pytest.mark.parametrize("module", FILES)
def test_has_a_rank(module):
    assert place(module), f"give {module} a place in LAYERS of tests/test_imports.py"


@pytest.mark.parametrize("module", FILES)
def test_imports_only_downward(module):
    here = place(module)
    for other in imported(parse(FILES[module])):
        there = place(other)
        assert here and there
        below = RANKS[there] < RANKS[here]
        assert below or here == there, f"{module} imports {other}, which does not rank below it"


def test_experiments_are_imported_only_when_a_command_needs_them():
    for module, path in FILES.items():
        if place(module) == "experiments":
            continue
        tree = parse(path)
        wanted = [name for name in imported(tree) if name.startswith("experiments")]
        assert not wanted or place(module) == "jaxbeam.cli", f"{module} imports {wanted}"
        eager = [name for name in imported_at_once(tree) if name.startswith("experiments")]
        assert not eager, f"{module} imports {eager} outside a function"
