"""What was commanded over the steps of a grid, by the logged outputs.

Outputs of a log are samples of a faster signal, so the command of a step is the mean over it of
their linear interpolation: a zero-order hold of these samples would delay the commands by half a
sampling period (50 ms at the 10 Hz of a DataFlash log). Kept with it are the deviation within the
step, because thrust is not linear in the pulse, and the rise over it, because a turn settles within
a step. Commands that act until the next one (`Signals.held`) are held.
"""

import numpy as np
from jaxtyping import Float

from ...models.recordings.resample import deviation, hold, mean, rise
from ...models.recordings.schema import PWM_RISE, PWM_STD
from .signals import Signals


def over_steps(
    signals: Signals, t: Float[np.ndarray, " N"], dt: float
) -> tuple[Float[np.ndarray, "N n"], dict[str, Float[np.ndarray, "N n"]]]:
    """Mean command of each step from t on, `dt` long, and what else a recording has of the PWM."""
    outputs = signals.outputs
    if signals.held:
        return hold(t, outputs.t, outputs.x, dt).T, {}
    middle = t + dt / 2
    if signals.command != "pwm":
        return mean(middle, outputs.t, outputs.x, dt).T, {}
    return mean(middle, outputs.t, outputs.x, dt).T, {
        PWM_STD: deviation(middle, outputs.t, outputs.x, dt).T,
        PWM_RISE: rise(middle, outputs.t, outputs.x, dt).T,
    }
