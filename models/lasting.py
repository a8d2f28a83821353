"""The mean-reverting wrench of a learned model, for users that don't carry it as a latent state."""

import numpy as np

from .disturbances import OrnsteinUhlenbeckWrench
from .dynamics import Dynamics
from .effects.extended import core, with_core
from .spinn import Spinn


def lasting_wrench(model: Dynamics) -> tuple[OrnsteinUhlenbeckWrench, ...]:
    """The model's mean-reverting wrench as a disturbance; none of a model without one."""
    own = core(model)
    if not isinstance(own, Spinn) or own.lasting is None:
        return ()
    std = np.asarray(own.lasting.std(own.scales.diffusion)).tolist()
    time = np.asarray(own.lasting.time_constant).tolist()
    return (OrnsteinUhlenbeckWrench(tuple(std), tuple(time)),)


def whitened(model: Dynamics) -> Dynamics:
    """The model with white noise of equal strength over long times (`Spinn.whitened`)."""
    own = core(model)
    if not isinstance(own, Spinn) or own.lasting is None:
        return model
    return with_core(model, own.whitened())
