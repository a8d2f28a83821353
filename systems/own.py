"""User-defined Drake systems in a diagram, named in a configuration by file and class."""

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any, ClassVar

from pydrake.systems.framework import InputPort, OutputPort, System

from ..models.config.errors import UserError
from ..models.sensors import Sensor

Offered = Mapping[str, Callable[[], Any]]
"""Values passed to a constructor that has an argument of that name, each as a function that makes
it; a function that returns None has no value to pass."""


@dataclass(frozen=True)
class OwnSystem:
    """A user-defined system.

    Attributes:
        system: `path/to/file.py:ClassName` or `package.module:ClassName` of a Drake system.
        parameters: keyword arguments of its constructor: numbers, text, lists and mappings.
    """

    system: str
    parameters: dict[str, Any] = field(default_factory=dict)

    base: ClassVar[type] = System
    """What the class must be derived from."""

    @property
    def code(self) -> str:
        """The file (or module) whose code runs, and the class in it."""
        where, _, name = self.system.rpartition(":")
        return f"{Path(where).resolve() if where.endswith('.py') else where}:{name}"

    def make(self, offered: Offered, check: Callable[[Any], None] = lambda made: None) -> Any:
        """Run the code and build the system; `parameters` take precedence over `offered`.

        `check` may raise a sentence on what is wrong with the system.

        Raises:
            UserError: there is no such file, module or class, it fails, or it takes other
                parameters.
        """
        kind = type(self).__name__
        where, _, name = self.system.rpartition(":")
        if not where or not name:
            raise UserError(
                f"{kind}.system is `{self.system}`: write path/to/file.py:ClassName, or "
                "package.module:ClassName"
            )
        with _blamed(f"{kind}.system: {where}"):
            found = getattr(_module(kind, where), name, None)
        if not (inspect.isclass(found) and issubclass(found, self.base)):
            what = "Drake system" if self.base is System else self.base.__name__
            raise UserError(f"{kind}.system: {where} has no {what} called `{name}`")
        signature = inspect.signature(found)
        arguments, nothing = dict(self.parameters), []
        for word in offered.keys() & signature.parameters.keys() - arguments.keys():
            value = offered[word]()
            if value is not None:
                arguments[word] = value
            elif signature.parameters[word].default is inspect.Parameter.empty:
                nothing.append(word)
        if nothing:
            raise UserError(
                f"{kind}.system: {name} takes `{'`, `'.join(sorted(nothing))}`, of which there is "
                "none here; give it in `parameters`, or a goal by success: !ReachGoal "
                "{goal: [x, y, z]}"
            )
        try:
            signature.bind(**arguments)
        except TypeError as error:
            raise UserError(
                f"{kind}.parameters do not fit {name}{signature}: {error}; give what it takes"
            ) from error
        with _blamed(f"{kind}.system: {name}"):
            made = found(**arguments)
            check(made)
            return made


@dataclass(frozen=True)
class OwnFilter(OwnSystem):
    """A user-defined state estimator that replaces the station's.

    It has the outputs `X_WB` and `V_WB_B`, and any of the station's `covariance`, `status` and
    `health`; where it lacks one, the station outputs NaN there, and good health. It is connected to
    the station's sensors by their names (`imu`, `dvl`, …), `pwm` and `initial_noise` as far as they
    are among its inputs. Its constructor receives, if it has arguments of these names, the
    station's `vehicle`, its sensors' configurations by their names, the start `X0_WB` and
    `V0_WB_B`, and the whole configuration `station`.

    Example:
        >>> estimator = OwnFilter("examples/own_filter.py:DeadReckoning")
        >>> estimator.parameters
        {}
    """


@dataclass(frozen=True)
class OwnSensor(OwnSystem):
    """A user-defined sensor: `system` names a class derived from `models.sensors.Sensor`.

    The station's filter fuses it if it `observes` something.
    """

    base: ClassVar[type] = Sensor

    def make(self, offered: Offered) -> Any:
        """As for a system; a list of the parameters becomes a tuple, as sensors have them."""
        given = {k: tuple(v) if isinstance(v, list) else v for k, v in self.parameters.items()}
        return OwnSystem.make(replace(self, parameters=given), offered)


def port_sizes(system: System) -> tuple[dict[str, int], dict[str, int]]:
    """Names and sizes of a system's input ports and of its output ports."""
    inputs: list[InputPort] = [system.get_input_port(i) for i in range(system.num_input_ports())]
    outputs: list[OutputPort] = [
        system.get_output_port(i) for i in range(system.num_output_ports())
    ]
    return {p.get_name(): p.size() for p in inputs}, {p.get_name(): p.size() for p in outputs}


def check_ports(
    who: str,
    system: System,
    needs: tuple[Mapping[str, int], Mapping[str, int]],
    may_have: tuple[Mapping[str, int], Mapping[str, int]] = ({}, {}),
) -> None:
    """Check that a system has its required ports, and optional ones in their right sizes.

    Raises:
        UserError: it lacks a port, or a port has another size.
    """
    for kind, has, wanted, other in zip(
        ("input", "output"), port_sizes(system), needs, may_have, strict=True
    ):
        for name, size in {**other, **wanted}.items():
            if has.get(name, None if name in wanted else size) != size:
                raise UserError(
                    f"{who} {type(system).__name__} needs the {kind} port `{name}` of size {size}; "
                    f"it has {has or 'none'}"
                )


@contextmanager
def _blamed(where: str) -> Iterator[None]:
    """Turn exceptions of user code into a sentence that names the place."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        last = extract_tb(error.__traceback__)[-1]
        raise UserError(
            f"{where} failed with {type(error).__name__}: {error} ({last.filename}, line "
            f"{last.lineno}); correct the code or its parameters"
        ) from error


def _module(kind: str, where: str) -> ModuleType:
    """The module of a dotted name, or of a file, which is run at most once."""
    path = Path(where).resolve()
    if path.suffix != ".py":
        try:
            return importlib.import_module(where)
        except ModuleNotFoundError as error:
            raise UserError(
                f"{kind}.system: there is no module `{where}`; a file's name ends in .py"
            ) from error
    if not path.is_file():
        raise UserError(f"{kind}.system: there is no file {where}; check the path")
    name = f"own_system_{path.stem}_{abs(hash(str(path))):x}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
