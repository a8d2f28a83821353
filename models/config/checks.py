"""Checks of configuration dataclasses at construction."""

import dataclasses
import sys
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

import jax.numpy as jnp

from .errors import FieldError, UserError

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Within:
    """The range of an option's numbers, ends included; `low` is excluded if `above`.

    It is part of the field's annotation: `rate: Annotated[float, Within(1, 400)] = 20.0`.
    """

    low: float | int
    high: float | int
    above: bool = False

    def holds(self, value: float | int) -> bool:
        """Whether a number lies within; NaN does not."""
        return (self.low < value if self.above else self.low <= value) and value <= self.high

    def __str__(self) -> str:
        """The range in words, for a remedy."""
        if self.above:
            return f"above {self.low:g}, at most {self.high:.10g}"
        return f"from {self.low:g} to {self.high:.10g}"


SEED = Within(0, 2**32 - 1)
COUNT = Within(1, 1_000_000)
WORKERS = Within(0, 1024)
RATE_OF_ALARMS = Within(0.0, 0.499, above=True)
SECONDS = Within(0.0, 86400.0, above=True)
WATER_DENSITY = Within(900.0, 1100.0)
LARGEST = 1e12
"""Far above any quantity of a vehicle or its water; results computed from it stay finite."""


def require(condition: bool, config: Any, field: str, remedy: str) -> None:
    """Raise `UserError` with kind, field, value and remedy unless `condition` holds."""
    if not condition:
        value = getattr(config, field)
        raise FieldError(type(config).__name__, (field,), f"is {value!r}: {remedy}.")


def require_rate(value: float, named: str) -> None:
    """Raise `UserError` with the option's name unless `value` is a false alarm rate in (0, 0.5)."""
    if not 0 < value < 0.5:
        raise UserError(f"{named} {value:g}: give a rate above 0 and below 0.5")


def check_numbers(config: Any) -> None:
    """Check the numbers of a dataclass: finite, within their annotated ranges, right in count.

    Raises:
        UserError: naming kind, field, value and remedy.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        kind = get_args(field.type)[0] if get_origin(field.type) is Annotated else field.type
        sizes = get_args(kind) if get_origin(kind) is tuple else ()
        limit = range_of(field.type)
        if sizes and Ellipsis not in sizes:
            require(
                isinstance(value, tuple) and len(value) == len(sizes),
                config,
                field.name,
                f"give {len(sizes)} numbers",
            )
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float | int):
                finite = abs(number) <= sys.float_info.max
                require(finite, config, field.name, "give finite numbers")
                small = abs(number) <= LARGEST
                require(small, config, field.name, f"give numbers of at most {LARGEST:g}")
                within = limit is None or limit.holds(number)
                require(within, config, field.name, f"give numbers {limit}")


def require_double(who: str, before: str) -> None:
    """Refuse single precision: `who` needs double, to be enabled before `before`.

    Raises:
        ValueError: if JAX runs in single precision.
    """
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError(
            f"{who} in double precision: call "
            f'jax.config.update("jax_enable_x64", True) before {before}'
        )


def range_of(hint: Any) -> Within | None:
    """The range in an annotation, at any depth."""
    if get_origin(hint) is Annotated:
        found = next((part for part in hint.__metadata__ if isinstance(part, Within)), None)
        return found or range_of(get_args(hint)[0])
    return next((found for part in get_args(hint) if (found := range_of(part))), None)
