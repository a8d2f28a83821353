"""Checks that configuration dataclasses make of themselves when they are constructed."""

import dataclasses
import math
from typing import Any, get_args, get_origin

import jax

from .errors import UserError

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]


def require(condition: bool, config: Any, field: str, remedy: str) -> None:
    """Raise `UserError` with kind, field, value and remedy unless `condition` holds."""
    if not condition:
        value = getattr(config, field)
        raise UserError(f"{type(config).__name__}.{field} is {value!r}: {remedy}.")


def require_rate(value: float, named: str) -> None:
    """Raise `UserError`, by the name that a user knows, unless it is a rate of false alarms."""
    if not 0 < value < 0.5:
        raise UserError(f"{named} {value:g}: give a rate above 0 and below 0.5")


def check_numbers(config: Any) -> None:
    """Check that every number of a dataclass is finite and every fixed-size tuple has its size.

    Raises:
        UserError: naming kind, field, value and remedy.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        sizes = get_args(field.type) if get_origin(field.type) is tuple else ()
        if sizes and Ellipsis not in sizes:
            require(
                isinstance(value, tuple) and len(value) == len(sizes),
                config,
                field.name,
                f"give {len(sizes)} numbers",
            )
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float | int):
                require(math.isfinite(number), config, field.name, "give finite numbers")


def require_double(who: str, before: str) -> None:
    """Refuse to go on in single precision: `who` needs more, `before` what it must be set.

    Raises:
        ValueError: if JAX runs in single precision.
    """
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            f"{who} in double precision: call "
            f'jax.config.update("jax_enable_x64", True) before {before}'
        )
