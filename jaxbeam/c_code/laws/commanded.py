"""C code of a law of some of the actuators; springs and dampers receive no command."""

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.writers import write_law
from jaxbeam.case.controller import LawOfCommanded


@write_law.register
def _(law: LawOfCommanded, code: CSource) -> None:
    all_commands, all_output, count = code.command, code.output, code.actuators
    own, chosen = len(law.active), code.constant("commanded", law.active)
    code.command = code.work("own_acting", own, "acting commands of the actuators that take any")
    code.output = code.work("own_wanted", own, "commands of the law for these")
    code.actuators = own
    code.add(f"for (i = 0; i < {own}; i++) {code.command}[i] = {all_commands}[{chosen}[i]];")
    write_law(law.law, code)
    own_output, code.command, code.output = code.output, all_commands, all_output
    code.actuators = count
    code.add(
        f"for (i = 0; i < {count}; i++) {all_output}[i] = 0;\n"
        f"for (i = 0; i < {own}; i++) {all_output}[{chosen}[i]] = {own_output}[i];"
    )
