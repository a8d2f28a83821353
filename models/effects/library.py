"""All named causes, and the layout of their parameters in one vector."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from ..config.errors import UserError
from .added_mass import AddedMass, AddedMassCoupling
from .attitude import ClockOffset, GyroBias, HeadingError
from .base import Effect, Parameter
from .delay import ActuationDelay
from .drag import CubicDrag, DragAsymmetry, DragCoupling, LinearDrag, QuadraticDrag
from .dvl import DvlDeadZone, DvlLeverArm, DvlMisalignment, DvlScale
from .inflow import InflowThrustLoss
from .lag import ThrusterLag
from .lift import Lift
from .load import CentreOfBuoyancy, CentreOfGravity, NetBuoyancy, Payload
from .noise import (
    DisturbanceColour,
    DisturbanceImpacts,
    DisturbanceLevel,
    DisturbanceStateDependence,
)
from .proximity import Proximity
from .supply import LoadDroop, VoltageExponent, VoltageSag
from .tether import TetherEffect
from .thrust import (
    AxisThrust,
    ThrustAsymmetry,
    ThrustCurve,
    ThrusterDeadZone,
    ThrusterGain,
    ThrustLever,
    ThrustOffset,
    ThrustScale,
    ThrustTable,
)
from .unknown import Unknown
from .water import CurrentSteady, CurrentVarying, Waves

_EVERY: tuple[type[Effect], ...] = (
    ThrusterLag,
    ActuationDelay,
    ThrusterDeadZone,
    ThrustAsymmetry,
    ThrustCurve,
    ThrusterGain,
    ThrustScale,
    VoltageSag,
    LoadDroop,
    InflowThrustLoss,
    NetBuoyancy,
    CentreOfGravity,
    Payload,
    LinearDrag,
    QuadraticDrag,
    DragAsymmetry,
    DragCoupling,
    CubicDrag,
    Lift,
    AddedMass,
    AddedMassCoupling,
    Proximity,
    CurrentSteady,
    CurrentVarying,
    Waves,
    TetherEffect,
    DisturbanceLevel,
    DisturbanceColour,
    DisturbanceImpacts,
    DisturbanceStateDependence,
    DvlLeverArm,
    DvlMisalignment,
    DvlScale,
    DvlDeadZone,
    GyroBias,
    ClockOffset,
    HeadingError,
    ThrustOffset,
    ThrustTable,
    VoltageExponent,
    AxisThrust,
    ThrustLever,
    CentreOfBuoyancy,
)
"""Every effect; a new one is added here."""
KINDS: dict[str, type[Effect]] = {k.name: k for k in _EVERY if not k.refit_only}
"""Every named cause."""
COEFFICIENTS: dict[str, type[Effect]] = {k.name: k for k in _EVERY if k.refit_only}
"""Effects that `--refit` estimates and that are never reported as a cause."""


def register(kind: type[Effect]) -> type[Effect]:
    """Make an effect of one's own known: to scenarios, and as a cause to diagnoses.

    Raises:
        UserError: its name is taken.
    """
    if kind.name in (Unknown.name, *KINDS, *COEFFICIENTS):
        raise UserError(f"effect {kind.name!r} is there already: take another name")
    (COEFFICIENTS if kind.refit_only else KINDS)[kind.name] = kind
    return kind


PART = "#"
"""Ends the name of an effect that acts in a part of the data: `thruster_gain#2`, the second one."""


def whole(name: str) -> str:
    """The name of a cause, wherever in the data it acts."""
    return name.partition(PART)[0]


def kind(name: str) -> type[Effect]:
    """The class of a cause; `unknown` stands for unmodelled structure.

    Raises:
        UserError: there is no such cause.
    """
    name = whole(name)
    if name == Unknown.name:
        return Unknown
    if name in COEFFICIENTS:
        return COEFFICIENTS[name]
    if name not in KINDS:
        raise UserError(f"cause {name!r} is unknown: take one of {', '.join(sorted(KINDS))}")
    return KINDS[name]


class Entry(NamedTuple):
    """One component of the vector of all values."""

    cause: str
    where: str
    parameter: Parameter


class Library:
    """A set of effects whose values form one vector θ; zero means absent."""

    def __init__(self, effects: Iterable[Effect]):
        self.effects = tuple(sorted(effects, key=lambda effect: effect.order))
        self.entries = tuple(_entries(self.effects))
        sizes = [effect.values.shape[0] for effect in self.effects]
        self._starts = list(itertools.accumulate(sizes, initial=0))
        self._leaves, self._structure = jax.tree.flatten(self.effects)
        values = {id(effect.values) for effect in self.effects}
        self._values = [i for i, leaf in enumerate(self._leaves) if id(leaf) in values]
        self._index = {(e.cause, e.where, e.parameter.name): i for i, e in enumerate(self.entries)}

    @property
    def size(self) -> int:
        """Length of θ."""
        return len(self.entries)

    def index(self, cause: str, where: str, parameter: str) -> int:
        """Index of a parameter in θ."""
        return self._index[cause, where, parameter]

    def has(self, cause: str) -> bool:
        """Whether a cause is among the effects."""
        return any(effect.name == cause for effect in self.effects)

    def at(self, cause: str, where: str) -> list[int]:
        """Indices in θ of the parameters of one cause at one place."""
        return [i for i, e in enumerate(self.entries) if e.cause == cause and e.where == where]

    def hypotheses(self, single: bool | None = None) -> list[tuple[str, str]]:
        """Every (cause, where).

        `single` selects (True) or drops (False) single thrusters of causes that may affect all.
        """
        every = list(dict.fromkeys((e.cause, e.where) for e in self.entries))
        if single is None:
            return every
        return [h for h in every if kind(h[0]).single(h[1]) == single]

    def filled(self, theta: Float[Array | np.ndarray, "p *batch"]) -> tuple[Effect, ...]:
        """The effects with values from θ, whose batch axes they take."""
        leaves = self._leaves.copy()
        known = isinstance(theta, np.ndarray)
        given = theta.copy() if known else theta  # JAX's arrays may share its memory
        parts: Any = [given[a:b] for a, b in itertools.pairwise(self._starts)]
        if known:
            parts = jax.device_put(parts)  # `jnp.asarray` compiles a program for every shape
        for at, part in zip(self._values, parts, strict=True):
            leaves[at] = part
        return jax.tree.unflatten(self._structure, leaves)

    def used(self, theta: Float[np.ndarray, " p"]) -> tuple[Effect, ...]:
        """The effects that are not absent in one θ."""
        chosen = self.filled(theta)
        return tuple(effect for effect in chosen if bool(np.any(np.asarray(effect.values) != 0)))


def _entries(effects: tuple[Effect, ...]) -> Iterator[Entry]:
    for effect in effects:
        for where in effect.places:
            for parameter in effect.parameters:
                yield Entry(effect.name, where, parameter)
