"""The console command `spinndrift`."""

import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Protocol, runtime_checkable

from ..models.config.errors import UserError
from ..models.files.atomic import DISK_ERRORS
from ..models.files.interrupts import interrupts_held, interrupts_kept

_DESCRIPTION = """Learned stochastic dynamics and control for underwater vehicles.

The usual order: `import` a log (or `generate` one), `train` a model on it, `evaluate` the model on
data it has not seen, `run` a mission with it. `collect` flies maneuvers for data, `diagnose` names
what a simulation gets wrong, `check` measures diagnoses and the estimator where the answer is
known, `study` compares the methods of training on simulated data, `vehicle` serves a simulated
vehicle to ground stations, `export` writes a run or a recording for Foxglove, `demo` goes the whole
way from a log that comes along to a dive.
`spinndrift COMMAND --help` explains each."""


LIVE_PORT = "7890"
"""Where `--live` serves its page without a port."""


@runtime_checkable
class _Command(Protocol):
    def run(self) -> None: ...


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; exit code 2 and one sentence for bad input, 130 after Ctrl-C."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        with interrupts_kept():
            _run(given)
    except UserError as error:
        _fail(f"spinndrift: {error}", 2)
    except KeyboardInterrupt:
        _fail("spinndrift: interrupted; what is on disk is whole", 130)
    except BrokenPipeError:
        sys.exit(141)
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise
        where = error.filename or "a file"
        _fail(f"spinndrift: {where}: can't be written ({error.strerror}); make room there", 2)


def _run(given: list[str]) -> None:
    if given == ["--version"]:
        from importlib.metadata import version

        print(version("spinndrift"))  # noqa: T201 - the output of `--version`
        return
    with interrupts_held():
        command = _parsed(_with_port(given))
        import jax

        from .compile_cache import keep_compiled
        from .options import check_options

    check_options(command)
    keep_compiled()
    jax.config.update("jax_enable_x64", True)
    # Small programs then run inline: a call from a diagram costs 10 µs instead of up to 40.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    place = getattr(command, "place", nullcontext)  # the others choose a folder in `run`
    with place():
        command.run()


def _with_port(given: list[str]) -> list[str]:
    """The arguments with a port after each `--live` that has none."""
    found = []
    for word, following in zip(given, [*given[1:], ""], strict=True):
        bare = word == "--live" and not following.rpartition(":")[2].isdecimal()
        found.append(f"--live={LIVE_PORT}" if bare else word)
    return found


def _parsed(given: list[str]) -> _Command:
    import contextlib
    import io
    from functools import reduce
    from operator import or_
    from typing import Annotated, Any

    import tyro

    from .commands.check import Check
    from .commands.collect import Collect
    from .commands.demo import Demo
    from .commands.diagnose import Diagnose
    from .commands.evaluate import Evaluate
    from .commands.export import Export
    from .commands.generate import Generate
    from .commands.import_log import Import
    from .commands.run import Run
    from .commands.study import Study
    from .commands.train import Train
    from .commands.vehicle import Vehicle
    from .options import misread

    classes: dict[str, Any] = {
        "import": Import,
        "generate": Generate,
        "train": Train,
        "evaluate": Evaluate,
        "export": Export,
        "run": Run,
        "collect": Collect,
        "diagnose": Diagnose,
        "check": Check,
        "study": Study,
        "vehicle": Vehicle,
        "demo": Demo,
    }
    if given and not given[0].startswith("-") and given[0] not in classes:
        raise UserError(
            f"{given[0]} is no command: give one of {', '.join(classes)}; see spinndrift --help"
        )
    subcommands = [Annotated[cls, tyro.conf.subcommand(name)] for name, cls in classes.items()]
    command: Any = reduce(or_, subcommands)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(command, args=given, prog="spinndrift", description=_DESCRIPTION)
    except SystemExit as end:
        if end.code:
            raise UserError(misread(given, said.getvalue())) from None
        if given[0] in classes:  # its help was shown
            print("examples:", *classes[given[0]].EXAMPLES, sep="\n  ")  # noqa: T201
        raise


def _fail(message: str, code: int) -> None:
    sys.stderr.write(message.rstrip() + "\n")
    sys.exit(code)
