"""Linear (Airy) theory of surface waves in water of finite depth."""

from types import ModuleType
from typing import Any

import jax.numpy as jnp

_NEWTON_STEPS = 5


def wave_number(omega: Any, water_depth: float, gravity: float, xp: ModuleType = jnp) -> Any:
    """Wave number k (rad/m) of the angular frequency ω > 0 (rad/s): ω² = g k tanh(k h).

    A fixed number of Newton steps on y tanh y = y₀, y = k h, y₀ = ω² h / g, from the explicit
    start y₀ / √tanh y₀ (Eckart 1952), within 5 % everywhere; five steps reach machine precision.
    `xp` is the array module, `numpy` for constants of a configuration.
    """
    y0 = omega * omega * (water_depth / gravity)
    y = y0 / xp.sqrt(xp.tanh(y0))
    for _ in range(_NEWTON_STEPS):
        tanh = xp.tanh(y)
        y = y - (y * tanh - y0) / (tanh + y * (1 - tanh * tanh))
    return y / water_depth


def orbital_factors(k: Any, z: Any, water_depth: float, xp: ModuleType = jnp) -> tuple[Any, Any]:
    """Orbital velocity over a ω at height z (m, mean surface 0), horizontal and vertical.

    cosh k(z+h) / sinh kh and sinh k(z+h) / sinh kh (Dean and Dalrymple 1991, eqs. 4.9 and 4.10),
    in exponentials that can't overflow. Above the mean surface the value at z = 0 is used.
    """
    z = xp.clip(z, -water_depth, 0.0)
    up, down = xp.exp(k * z), xp.exp(-k * (z + 2 * water_depth))
    scale = 1 / (-xp.expm1(-2 * water_depth * k))
    return (up + down) * scale, (up - down) * scale
