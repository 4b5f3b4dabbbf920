"""C code of the compensation of hysteresis and creep: inverse before the limits, model after them.

As `jaxbeam.simulation.commands` has them: the inverse gives the command for a wanted one; what
acts of the limited command, according to the same operators, is what the law knows of it.
"""

import numpy as np

from jaxbeam.c_code.source import CSource
from jaxbeam.case.case import Case
from jaxbeam.simulation.commands import command_path


class Compensation:
    """Compensations of the actuators of a case, in a program."""

    def __init__(self, case: Case, code: CSource):
        path = command_path(case)
        self.code = code
        self.operators = {
            i: (forward, inverse)
            for i, (forward, inverse) in enumerate(
                zip(path.compensations, path.inverses, strict=True)
            )
            if forward is not None and inverse is not None
        }
        self.names: dict[int, dict[str, str]] = {}

    def write_inverse(self) -> None:
        """Statements from the wanted commands to those that are sent."""
        code = self.code
        for i, (forward, inverse) in self.operators.items():
            plays, lags = len(inverse.hysteresis.thresholds), self._lags(forward)
            names = {}
            for part, operator in (("model", forward), ("inverse", inverse)):
                for number in ("thresholds", "weights"):
                    values = getattr(operator.hysteresis, number)
                    names[f"{part}_{number}"] = code.constant(f"{part}_{number}_{i}", values)
                zeros = np.zeros(plays)
                meaning, restarts = f"plays of actuator {i}", False
                names[part] = code.state(f"{part}_plays_{i}", zeros, meaning, restarts)
                if lags:
                    name, zeros = f"{part}_lags_{i}", np.zeros(lags)
                    meaning = f"creep of actuator {i}"
                    names[f"{part}_lags"] = code.state(name, zeros, meaning, restarts)
            names["tried"] = code.work(f"tried_plays_{i}", plays)
            self.names[i] = names
            command = f"{code.output}[{i}]"
            code.add(f"/* Inverse of hysteresis and creep of actuator {i} */")
            if lags:
                kept, shares, of_command = self._creep(forward, i)
                before = f"creep_after({kept}, {shares}, {lags}, {names['inverse_lags']}"
                code.add(
                    f"{command} = ({command} - {before}, {names['inverse']}[0])) / {of_command};",
                    5 * lags + 2,
                )
            code.add(
                f"copy({names['tried']}, {names['inverse']}, {plays});\n"
                f"{command} = {self._plays('inverse', i, names['tried'], plays, command)};",
                6 * plays,
            )

    def write_model(self, acting: str) -> None:
        """Statements from the limited commands to what acts of them, written to an array."""
        code = self.code
        code.add(f"copy({acting}, {code.output}, {code.actuators});")
        for i, (forward, _) in self.operators.items():
            plays, lags, names = (
                len(forward.hysteresis.thresholds),
                self._lags(forward),
                self.names[i],
            )
            acts, model = f"{acting}[{i}]", names["model"]
            code.add(f"/* What acts of the command of actuator {i} */")
            at_once = self._plays("model", i, model, plays, f"{code.output}[{i}]")
            if not lags:
                code.add(f"{acts} = {at_once};", 6 * plays)
                code.add(f"{self._plays('inverse', i, names['inverse'], plays, acts)};", 6 * plays)
                continue
            kept, shares, of_command = names["kept"], names["shares"], names["of_command"]
            weights, model_lags = names["model_weights"], names["model_lags"]
            code.add(
                f"""
{{
    real before = 0, creep;
    for (j = 0; j < {plays}; j++) before += {weights}[j] * {model}[j];
    creep = creep_after({kept}, {shares}, {lags}, {model_lags}, before);
    {acts} = {of_command} * {at_once} + creep;
    creep = 0;
    for (j = 0; j < {lags}; j++) creep += {shares}[j] * {names["inverse_lags"]}[j];
    before = ({acts} - creep) / {of_command};
    {self._plays("inverse", i, names["inverse"], plays, "before")};
}}""",
                14 * plays + 7 * lags + 4,
            )

    def _creep(self, forward, i: int) -> tuple[str, str, str]:
        """Constants of the creep: shares kept over a period, shares of the lags, of the command."""
        creep, period = forward.creep, forward.period
        of_command, of_lags = creep.shares(period)
        names = self.names[i]
        names["kept"] = self.code.constant(f"creep_kept_{i}", np.exp(-creep.rates * period))
        names["shares"] = self.code.constant(f"creep_shares_{i}", of_lags)
        names["of_command"] = f"(real){float(of_command)!r}"
        return names["kept"], names["shares"], names["of_command"]

    def _plays(self, part: str, i: int, plays: str, count: int, command: str) -> str:
        """Call that lets plays of one of the operators follow a command."""
        names = self.names[i]
        thresholds, weights = names[f"{part}_thresholds"], names[f"{part}_weights"]
        return f"plays_output({thresholds}, {weights}, {count}, {plays}, {command})"

    @staticmethod
    def _lags(forward) -> int:
        return 0 if forward.creep is None else len(forward.creep.rates)
