"""Options of every command: numbers that can't be are refused by name before work begins."""

import dataclasses
import math
import shlex
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from helpers import ROOT
from spinndrift.models.config.checks import range_of
from spinndrift.models.config.errors import UserError
from spinndrift.sims import cli
from spinndrift.sims.commands.check import CheckDiagnosis
from spinndrift.sims.commands.check_estimator import CheckEstimator
from spinndrift.sims.commands.demo import Demo
from spinndrift.sims.commands.diagnose import Diagnose
from spinndrift.sims.commands.evaluate import Evaluate
from spinndrift.sims.commands.generate import Generate
from spinndrift.sims.commands.generate import Settings as GenerateSettings
from spinndrift.sims.commands.import_log import Import
from spinndrift.sims.commands.run import Run
from spinndrift.sims.commands.study import Study
from spinndrift.sims.commands.train import Train
from spinndrift.sims.options import check_options, misread

GIVEN = Path("given")
COMMANDS = (
    Import(GIVEN), Generate(), GenerateSettings(), Train(GIVEN), Evaluate(GIVEN, GIVEN),
    Run("given"), Diagnose(GIVEN), CheckDiagnosis(), CheckEstimator(), Study(), Demo(),
)  # fmt: skip
WRONG = {
    float: (math.nan, math.inf, -math.inf, 1e300, -1e300, -1.0),
    int: (-1, 10**400, -(10**400)),
}


def numbers(hint):
    """How many numbers an option takes; 0 for what is none."""
    parts = get_args(hint)
    if hint in (int, float):
        return 1
    if hint is bool or str(hint).startswith("typing.Literal"):
        return 0
    return sum(numbers(part) for part in parts)


OPTIONS = [
    (command, field.name, get_type_hints(type(command), include_extras=True)[field.name])
    for command in COMMANDS
    for field in dataclasses.fields(command)
    if numbers(get_type_hints(type(command))[field.name])
]


def kind(hint):
    """Whether an option takes whole numbers."""
    return hint if hint in (int, float) else next(kind(part) for part in get_args(hint))


def filled(hint, value):
    """A value for an option of that type."""
    count = numbers(hint)
    return kind(hint)(value) if count == 1 else (0.5,) * (count - 1) + (float(value),)


@pytest.mark.parametrize(("command", "name", "hint"), OPTIONS)
def test_numbers_beyond_an_option_are_refused_by_its_name(command, name, hint):
    limit = range_of(hint)
    assert limit is not None, f"{name} states no range (`models.config.checks.Within`)"
    for value in WRONG[kind(hint)]:
        changed = dataclasses.replace(command, **{name: filled(hint, value)})
        option = "--" + name.replace("_", "-")
        with pytest.raises(UserError, match=f"^{option} .*: give a number ") as caught:
            check_options(changed)
        assert len(str(caught.value)) < 100
    for value in (limit.high, limit.high if limit.above else limit.low):
        check_options(dataclasses.replace(command, **{name: filled(hint, value)}))


def test_there_are_options_of_all_commands():
    assert {type(command) for command, _, _ in OPTIONS} == {type(c) for c in COMMANDS} - {Generate}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("generate --seed -1", "--seed -1: give a number from 0 to 4294967295"),
        ("generate --duration nan", "--duration nan: give a number above 0, at most 86400"),
        ("evaluate a.spinn b.nc --length nan", "--length nan: give a number above 0"),
        ("check estimator --seconds inf", "--seconds inf: give a number from 1"),
        ("train a.nc --steps 1.5", "--steps 1.5: give a whole number; see spinndrift train --help"),
        ("diagnose a.nc --diffusion 1", "--diffusion 1: give 6 numbers; see"),
        ("run calm --sed 3", "--sed, 3; did you mean --seed? see spinndrift run --help"),
        ("demo --workers 2", "options: --workers 2; see spinndrift demo --help"),
        ("study --scale big", "invalid choice 'big' for argument '--scale'"),
        ("evaluate a.spinn", "Missing"),
        ("simulate calm", "simulate is no command: give one of import, generate, train"),
    ],
)
def test_what_is_given_wrongly_is_told_in_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments.split())
    told = capsys.readouterr().err
    assert ended.value.code == 2
    assert words in told
    assert len(told.splitlines()) == 1


def test_a_message_of_unknown_form_is_passed_on():
    assert misread(["run"], "all is lost") == "all is lost; see spinndrift run --help"


def test_examples_of_the_help_can_be_given(capsys):
    """Their files are in the checkout, or another example writes them."""
    lines = []
    for command in ("import", "generate", "train", "evaluate", "run", "collect", "diagnose",
                    "check", "study", "demo"):  # fmt: skip
        with pytest.raises(SystemExit):
            cli.main([command, "--help"])
        shown = capsys.readouterr().out.split("examples:\n")[1].splitlines()
        assert len(shown) >= 2
        assert all(line.startswith(f"  spinndrift {command}") for line in shown)
        lines += [shlex.split(line, comments=True)[1:] for line in shown]
    commands = [cli._parsed(line) for line in lines]
    written = {str(out) for command in commands if (out := getattr(command, "out", None))}
    written |= {f"{out}/model.spinn" for out in written}
    for line, command in zip(lines, commands, strict=True):
        check_options(command)
        outputs = {line[i + 1] for i, word in enumerate(line) if word == "--out"}
        for word in line:
            if (
                Path(word).suffix in (".nc", ".spinn", ".xz", ".BIN", ".tlog")
                and word not in outputs
            ):
                assert word in written or (ROOT / word).exists(), f"no {word} for {line}"
