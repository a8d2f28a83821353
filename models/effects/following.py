"""Drives with backlash, a rate limit or few speeds under a held command, one parameter each."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

Follower = Callable[[Array, Array, Any, Any], tuple[Array, Array]]
"""(output before, command, hold time in s, parameter) → (output at the end, mean output)."""


def taken_up(
    before: Float[Array, "*#b"], command: Float[Array, "*#b"], held: Any, play: Any
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Backlash of ± `play` (N): the output moves only where the command pushes it.

    The play operator of hysteresis (Krasnosel'skii and Pokrovskii 1989).
    """
    del held
    after = jnp.clip(before, command - play, command + play)
    return after, after


def ramped(
    before: Float[Array, "*#b"], command: Float[Array, "*#b"], held: Any, rate: Any
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Rate limit `rate` (N/s): a linear ramp to the command, then the command; exact means."""
    way, most = command - before, rate * held
    after = before + jnp.clip(way, -most, most)
    there = jnp.abs(way) < most
    on_the_way = -way * jnp.abs(way) / (2 * most)
    return after, jnp.where(there, command + on_the_way, (before + after) / 2)


def stepped(
    before: Float[Array, "*#b"], command: Float[Array, "*#b"], held: Any, step: Any
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Multiples of `step` (N) alone: the one nearest to the command."""
    del before, held
    after = step * jnp.round(command / step)
    return after, after


FOLLOWERS: dict[str, Follower] = {"play": taken_up, "slew": ramped, "steps": stepped}
