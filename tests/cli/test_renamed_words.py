"""Old words of commands and options work, with a warning that names the new one."""

import inspect

import pytest

from jaxbeam.cli.app import RENAMED_COMMANDS, RENAMED_OPTIONS, app, current_words

OPTIONS = [
    (command, old, new) for command, names in RENAMED_OPTIONS.items() for old, new in names.items()
]


def parameters(command: str) -> set[str]:
    """Options of a command."""
    return {
        name for argument in app[command].assemble_argument_collection() for name in argument.names
    }


@pytest.mark.parametrize(("old", "new"), RENAMED_COMMANDS.items())
def test_old_commands(capsys, old, new):
    assert list(current_words([old, "case.toml"])) == [new, "case.toml"]
    assert f"{old} is called {new} now" in capsys.readouterr().err
    assert inspect.isfunction(app[new].default_command)


@pytest.mark.parametrize(("command", "old", "new"), OPTIONS)
def test_old_options(capsys, command, old, new):
    assert list(current_words([command, "a.toml", old, "1"])) == [command, "a.toml", new, "1"]
    assert list(current_words([command, f"{old}=1=2"])) == [command, f"{new}=1=2"]
    assert capsys.readouterr().err.count(f"{old} is called {new} now") == 2
    assert new in parameters(command)
    assert old not in parameters(command)


def test_an_old_option_given_twice_is_one_warning(capsys):
    line = ["tune", "a.toml", "--over", "mean", "--over", "worst"]
    assert list(current_words(line)).count("--aggregate") == 2
    assert capsys.readouterr().err.count("--over is called --aggregate now") == 1


def test_new_words_and_those_of_other_commands_are_left_alone(capsys):
    line = ["sweep", "case.toml", "--over", "loads.0.mass=1,2"]
    assert list(current_words(line)) == line
    assert capsys.readouterr().err == ""


def test_an_old_command_with_an_old_option(folder, capsys):
    from jaxbeam.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["sharpen", "case.toml", "--free", "beam.length", "--over", "loads.0.speed"])
    assert ended.value.code == 1
    first, second, error = capsys.readouterr().err.splitlines()
    assert "sharpen is called design-experiment now" in first
    assert "--over is called --vary now" in second
    assert "--vary takes ADDRESS=VALUE" in error
