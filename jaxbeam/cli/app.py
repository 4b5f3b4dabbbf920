"""Application: the commands, the old words of renamed ones, and the process that runs them."""

import atexit
import contextvars
import errno
import functools
import gc
import inspect
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import NoReturn

from cyclopts import (
    App,
    CycloptsError,
    Group,
    MissingArgumentError,
    Parameter,
    UnusedCliTokensError,
)

from jaxbeam.cli.arguments import UsageError
from jaxbeam.cli.commands.compare import compare
from jaxbeam.cli.commands.describe import describe
from jaxbeam.cli.commands.engineering import assess, check, combine, envelope, influence
from jaxbeam.cli.commands.export import export
from jaxbeam.cli.commands.frequency import frf, modes, state_space
from jaxbeam.cli.commands.identify import compare_models, design_experiment, identify
from jaxbeam.cli.commands.modes_from_log import modes_from_log, monitor
from jaxbeam.cli.commands.published import benchmark, demo, reproduce
from jaxbeam.cli.commands.simulate import simulate
from jaxbeam.cli.commands.stability import stability
from jaxbeam.cli.commands.start import app as app_command, new, schema
from jaxbeam.cli.commands.sweep import native, sweep
from jaxbeam.cli.commands.tune import tune
from jaxbeam.cli.commands.weigh import calibrate, identify_responses, traffic, weigh
from jaxbeam.cli.options import print_message
from jaxbeam.runtime.interrupts import interruptible

COMMANDS = {
    "Simulation": (new, check, describe, modes, frf, simulate, sweep),
    "Engineering": (assess, envelope, combine, influence),
    "Control": (compare, benchmark, stability, state_space, tune, export),
    "Identification": (
        identify,
        modes_from_log,
        monitor,
        identify_responses,
        weigh,
        compare_models,
        design_experiment,
    ),
    "Other": (app_command, demo, reproduce, schema, native),
}

# Words of former versions, which are refused by a sentence that names the present ones.
RENAMED_COMMANDS = {"judge": "compare-models", "sharpen": "design-experiment"}
RENAMED_OPTIONS = {  # by command, in its new word
    "compare-models": {"--unseen": "--held-out"},
    "design-experiment": {"--over": "--vary"},
    "stability": {"--spacing": "--headway"},
    "tune": {
        "--over": "--aggregate",
        "--front": "--pareto",
        "--rank": "--lexicographic",
        "--choose": "--integers",
        "--keep": "--states",
        "--plant": "--fit",
        "--sampled": "--posterior",
        "--stable": "--max-real-part",
        "--reserve": "--extra-delay",
        "--spread": "--parameter-tolerance",
        "--bounds": "--least-peaks",
        "--no-bounds": "--no-least-peaks",
    },
    "weigh": {"--most": "--max-loads"},
}

WRONG_USAGE = 2


def _documented(command: Callable) -> Callable:
    """The command, its docstring without "Raises", each paragraph in a line: terminals wrap it."""
    lines: list[str] = []
    text = re.sub(r"\s*\bRaises [^.]*\.", "", inspect.cleandoc(command.__doc__ or ""))
    for line in text.splitlines():
        indents = [re.match(r" *[^\s-]", one) for one in (line, *lines[-1:])]
        if len(indents) == 2 and all(indents) and len({one.end() for one in indents if one}) == 1:
            lines[-1] += f" {line.strip()}"
        else:
            lines.append(line)
    command.__doc__ = "\n".join(lines)
    return command


app = App(
    name="jaxbeam",
    help="Beams under moving loads: simulation, control and identification from logs.",
    help_format="plaintext",
    result_action="return_value",
    suppress_keyboard_interrupt=False,  # `interruptible` says what is kept
    default_parameter=Parameter(negative=(), show_default=False),
)
for _title, _commands in COMMANDS.items():
    _group = Group.create_ordered(_title)
    for _command in _commands:
        app.command(_documented(_command), group=_group)
for _command in (calibrate, traffic):
    app["weigh"].command(_documented(_command))
app.register_install_completion_command(
    help="Install completion of commands and options for bash, zsh, fish or PowerShell, also in"
    " the file that the shell reads when it starts."
)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command line (that of the process by default) and exit.

    The status is 0, or 1 for an error in what the words name, or 2 for one in the words themselves.

    An error of the user is printed as one sentence on standard error, and so is each warning. After
    Ctrl-C one sentence says what is kept, and the status is 130.
    """
    of_process = arguments is None
    printed_warnings = set()

    def print_warning(message, *_, **__):
        if str(message) not in printed_warnings:
            printed_warnings.add(str(message))
            print_message(f"warning: {message}")

    warnings.showwarning = print_warning
    if of_process:
        arguments = sys.argv[1:]
        _relax_garbage_collection()
    try:
        refuse_former_words(arguments)
        with interruptible(of_process):
            own = contextvars.copy_context()  # in which commands show warnings by themselves
            own.run(app, arguments, exit_on_error=False, print_error=False)
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output, as `head`, has seen enough
        _close_output()
        sys.exit(0)
    except MemoryError as error:
        print_message(f"not enough memory: {error}; take fewer runs, samples or modes")
        sys.exit(1)
    except UnusedCliTokensError as error:
        words, what = " ".join(error.unused_tokens or ()), " ".join(error.command_chain or ())
        print_message(f"{what} takes no further {words!r}; see jaxbeam {what} --help")
        sys.exit(WRONG_USAGE)
    except MissingArgumentError as error:
        print_message(_missing(error))
        sys.exit(WRONG_USAGE)
    except (ValueError, OSError, RuntimeError, ImportError, CycloptsError) as error:
        message = " ".join(str(error).split())
        names_no_file = isinstance(error, OSError) and not error.filename and message[:1] == "["
        if names_no_file and error.errno == errno.ENOSPC:
            _close_output()  # what is printed goes to a file on a full disk
            message = "no space left on device"
        print_message(message)
        sys.exit(WRONG_USAGE if isinstance(error, UsageError | CycloptsError) else 1)
    sys.exit(0)


def _close_output() -> None:
    """Print nothing more, also when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _missing(error: MissingArgumentError) -> str:
    """Sentence that names an argument without a value, and says what it is."""
    argument, chain = error.argument, error.command_chain or ()
    if argument is None:
        return " ".join(str(error).split())
    command = functools.reduce(App.__getitem__, chain, app)
    described = command.assemble_argument_collection(parse_docstring=True)
    helps = (one.parameter.help for one in described if one.name == argument.name)
    meaning = " ".join((next(helps, None) or argument.name).split()).split(". ")[0].rstrip(".")
    what, name = " ".join(chain), max(argument.names, key=len)
    if error.keyword is not None or argument.tokens:
        return f"{error.keyword or name} needs a value: {meaning}"
    return f"{what} needs {name}: {meaning}; see jaxbeam {what} --help"


def refuse_former_words(arguments: Sequence[str]) -> None:
    """Check a command line. Raises UsageError for a command or option that is called otherwise.

    Also for an empty word, as of a variable of the shell without a value: as the name of a file it
    would be that of the folder. Only a title may be empty.
    """
    former, before = RENAMED_COMMANDS, ""
    for word in arguments:
        name, equals, value = word.partition("=")
        of_option = bool(equals) and name.startswith("--")
        if not (value if of_option else word) and (name if of_option else before) != "--title":
            where = f"{name}=" if of_option else f"after {before}" if before else "of the command"
            raise UsageError(f"a word of the command line is empty ({where}); give a name or value")
        before = word
        if name in former:
            raise UsageError(f"{name} is called {former[name]} now")
        if former is RENAMED_COMMANDS:
            former = RENAMED_OPTIONS.get(name, {})


def _relax_garbage_collection() -> None:
    """Raise the thresholds of garbage collection, and skip it when the process ends.

    Imports and tracing make millions of objects that live on; a command takes a fifth less time.
    """
    gc.set_threshold(500_000, 20, 100)  # of new objects, and of younger collections
    atexit.register(gc.freeze)
