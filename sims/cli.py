"""The console command `spinndrift`."""

import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated

import tyro

from ..models.errors import UserError
from .commands.check import Check
from .commands.demo import Demo
from .commands.diagnose import Diagnose
from .commands.evaluate import Evaluate
from .commands.generate import Generate
from .commands.import_log import Import
from .commands.run import Run
from .commands.study import Study
from .commands.train import Train
from .compile_cache import keep_compiled

Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Diagnose, tyro.conf.subcommand("diagnose")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Study, tyro.conf.subcommand("study")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)

_DESCRIPTION = """Learned stochastic dynamics and control for underwater vehicles.

The usual order: `import` a log (or `generate` one), `train` a model on it, `evaluate` the model on
data it has not seen, `run` a mission with it. `diagnose` names what a simulation gets wrong,
`check` measures how well on cases whose answer is known, `study` compares the methods of training
on simulated data, `demo` goes the whole way from a log that comes along to a dive.
`spinndrift COMMAND --help` explains each."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; exit code 2 and one sentence for bad input, 130 after Ctrl-C."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given == ["--version"]:
        print(version("spinndrift"))  # noqa: T201 - the answer asked for
        return
    command = tyro.cli(Command, args=given, prog="spinndrift", description=_DESCRIPTION)
    import jax

    keep_compiled()
    jax.config.update("jax_enable_x64", True)
    # Small programs then run in line: a call from a diagram costs 10 µs instead of up to 40.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    try:
        command.run()
    except UserError as error:
        _fail(f"spinndrift: {error}", 2)
    except KeyboardInterrupt:
        _fail("spinndrift: interrupted; what is on disk is whole", 130)
    except BrokenPipeError:
        sys.exit(141)


def _fail(message: str, code: int) -> None:
    sys.stderr.write(message.rstrip() + "\n")
    sys.exit(code)
