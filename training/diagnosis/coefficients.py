"""All coefficients of a grey-box model fitted to a recording, without a search for causes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended
from ...models.integrate import cast
from ...models.recordings.store import Recording
from ...models.vehicles.vehicle import Vehicle
from .config import DiagnoseConfig
from .pipeline import Diagnoser
from .refitting import with_refitted
from .selection.refit_all import with_coefficients


def fit_coefficients(
    recording: Recording,
    vehicle: Vehicle,
    base: Dynamics | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Extended:
    """`base`, or the vehicle's preset, with all coefficients fitted together (`refit_all`).

    Inertia, drag and restoring force are the base's own constants, the thrust curve and the thrust
    along each axis are effects. Latent velocities are simulated.

    Raises:
        UserError: the recording is too short, or the model is unstable on it.
    """
    from threadpoolctl import threadpool_limits  # the import sets an environment variable

    with jax.enable_x64(True), threadpool_limits(1, user_api="blas"):
        base = None if base is None else cast(base, jnp.float64)
        diagnoser = Diagnoser(recording, vehicle, base, DiagnoseConfig(refit="all"))
        problem = with_coefficients(diagnoser.problem, "all")
        problem, _, first = with_refitted(problem, "all", progress)
        used = problem.library.used(first.theta)
        model = Extended.create(problem.model.base, used, problem.vehicle.thrusters())
        return model.with_constants_in_base()
