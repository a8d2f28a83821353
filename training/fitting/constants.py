"""The constants of a SPINN: the values of M, D, D^f and V where its networks give zero."""

from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp

from ...models.dynamics import Dynamics
from ...models.effects.extended import Extended, core
from ...models.euclidean import EulerPotential
from ...models.networks import Heads, MlpStack
from ...models.potential import BoundedScalar, GravityPotential, PosePotential, Potential
from ...models.spinn import Spinn

Model = TypeVar("Model", bound=Dynamics)


def constants(model: Dynamics) -> list[Any]:
    """The constants of M, D, D^f and V of a SPINN, or of one with effects.

    Raises:
        TypeError: it is another model.
    """
    model = _spinn(model)
    potential = model.learned_potential
    network = _network(potential)
    found = [model.matrix_heads.bias, network.skip, network.bound]
    if model.constant_mass is not None:
        found.append(model.constant_mass)
    if isinstance(potential, (GravityPotential, EulerPotential)):
        found.append(potential.net_buoyancy)
    return found


def _spinn(model: Dynamics) -> Spinn:
    found = core(model)
    if not isinstance(found, Spinn):
        raise TypeError(f"{type(found).__name__} is no SPINN: it has no networks")
    return found


def _network(potential: Potential) -> BoundedScalar | EulerPotential:
    if isinstance(potential, GravityPotential):
        return potential.restoring
    if isinstance(potential, PosePotential):
        return potential.scalar
    assert isinstance(potential, EulerPotential)
    return potential


def without_networks(model: Model) -> Model:
    """The same function with networks of one unit, if all heads' weights are zero."""
    if isinstance(model, Extended):
        return model.with_base(_small(_spinn(model)))
    return _small(_spinn(model))


def _small(model: Spinn) -> Spinn:

    def small(hidden: MlpStack) -> MlpStack:
        count, _, inputs = hidden.weights[0].shape
        weight = jnp.zeros((count, 1, inputs), hidden.weights[0].dtype)
        return MlpStack((weight,), (weight[:, :, 0],), hidden.activation)

    def narrow(heads: Heads | None) -> Heads | None:
        return None if heads is None else Heads(heads.weight[..., :1], heads.bias)

    network = _network(model.learned_potential)
    if any(bool(jnp.any(h.weight != 0)) for h in (model.matrix_heads, network.head)):
        return model
    return eqx.tree_at(
        lambda m: (
            m.hidden,
            m.matrix_heads,
            m.diffusion_head,
            _network(m.learned_potential).hidden,
            _network(m.learned_potential).head,
        ),
        model,
        (
            small(model.hidden),
            narrow(model.matrix_heads),
            narrow(model.diffusion_head),
            small(network.hidden),
            narrow(network.head),
        ),
        is_leaf=lambda x: x is None,
    )
