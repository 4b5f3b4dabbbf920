"""Former words of commands and options are refused by a sentence that names the present ones."""

import inspect

import pytest

from jaxbeam.cli import main
from jaxbeam.cli.app import RENAMED_COMMANDS, RENAMED_OPTIONS, app, refuse_former_words

OPTIONS = [
    (command, old, new) for command, names in RENAMED_OPTIONS.items() for old, new in names.items()
]


def parameters(command: str) -> set[str]:
    """Options of a command."""
    return {
        name for argument in app[command].assemble_argument_collection() for name in argument.names
    }


@pytest.mark.parametrize(("old", "new"), RENAMED_COMMANDS.items())
def test_former_commands(old, new):
    with pytest.raises(ValueError, match=f"^{old} is called {new} now$"):
        refuse_former_words([old, "case.toml"])
    assert inspect.isfunction(app[new].default_command)


@pytest.mark.parametrize(("command", "old", "new"), OPTIONS)
def test_former_options(command, old, new):
    for given in ([old, "1"], [f"{old}=1=2"]):
        with pytest.raises(ValueError, match=f"^{old} is called {new} now$"):
            refuse_former_words([command, "a.toml", *given])
    assert new in parameters(command)
    assert old not in parameters(command)


def test_present_words_and_those_of_other_commands_pass():
    refuse_former_words(["sweep", "case.toml", "--over", "loads.0.mass=1,2"])
    refuse_former_words([])


def test_a_former_option_ends_the_command(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["design-experiment", "case.toml", "--over", "loads.0.speed=1:2"])
    assert ended.value.code != 0
    assert capsys.readouterr().err == "jaxbeam: --over is called --vary now\n"
