"""Interface of a named physical effect: parameters that are zero when it is absent, and hooks.

An effect is one possible difference between a simulation and the world. The same object serves the
simulator (`extended.Extended`), the one-step predictor of a diagnosis and the extended model that
the diagnosis returns, so that a name means one equation everywhere.

To add one, subclass `Effect`, state `name`, `family`, `parameters`, `places` and which `Traits` it
has, register it in `library`, and override the hooks of a simulation where it acts::

    command (n) → `actuate` (memory: lag, delay) → `thrust` (static, by thruster) → allocation
    → `together` (wrench of all thrusters) → `wrench` + `inertia` + `flow` (body and water)
    → `diffusion`, `advance` (noise laws) → `measure` (sensors; `unmeasure` is its inverse)

Arrays are component first as in `models.se3`. `values` may have batch axes that broadcast against
the state's (a column per hypothesis): one compiled program runs all. Neutral values change nothing.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..config.errors import UserError
from ..networks import expand
from ..rigid_body import FossenDynamics
from ..thrusters import MOST
from .recent import Recent
from .traits import Traits

Family = Literal["actuation", "body", "environment", "disturbance", "measurement"]


@dataclass(frozen=True)
class Parameter:
    """One number of an effect: zero means absent.

    Attributes:
        name: name in reports.
        unit: SI unit, "1" for a ratio.
        probes: values at which a diagnosis computes the response; several where it is not linear.
        low: least admissible value; an estimate below it rejects the cause.
        high: largest admissible value.
        spread: prior standard deviation; 0 stands for a weak prior.
        usual: nominal value, reported where the value is zero; the value is relative to it.
        refit: prior standard deviation in a fit of all coefficients; 0 stands for `spread`, and if
            that is 0 too, the parameter is not fitted there.
        start: where that fit starts, relative to the believed value.
    """

    name: str
    unit: str
    probes: tuple[float, ...]
    low: float = -math.inf
    high: float = math.inf
    spread: float = 0.0
    usual: float = 0.0
    refit: float = 0.0
    start: float = 0.0


class Plant(NamedTuple):
    """Constants of the vehicle that effects refer to."""

    positions: Float[Array, "3 n"]
    directions: Float[Array, "3 n"]
    mass: Float[Array, "6 6"]
    weight: Float[Array, ""]
    rigid_mass: Float[Array, ""]
    drag: Callable[[Array], Array]
    """The drag wrench at a velocity relative to the water."""
    p_BoCb_B: Float[Array, "3"]
    """The centre of buoyancy."""


class Effect(eqx.Module, Traits):
    """Base of all effects; every hook's default does nothing.

    Attributes:
        values: parameters by place: index = place × number of parameters + parameter.
        name: the cause's name in reports.
        parameters: those of one place.
        places: where it can act (axis, frame); see `ByThruster` for single thrusters.
        order: actuation and measurement effects apply from small to large.
        source: where the admissible range comes from.
    """

    values: Float[Array, "p *batch"]

    name: ClassVar[str] = ""
    family: ClassVar[Family] = "body"
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    places: ClassVar[tuple[str, ...]] = ("all",)
    order: ClassVar[int] = 0
    source: ClassVar[str] = ""

    # --------------------------------------------------------------------------------- making

    @classmethod
    def places_with(cls, thrusters: int) -> tuple[str, ...]:
        """Where it can act on a vehicle with so many thrusters."""
        del thrusters
        return cls.places

    @classmethod
    def neutral(cls, dtype: Any = float, thrusters: int = 0, **options: Any) -> "Effect":
        """The effect that changes nothing, with its places on so many thrusters."""
        size = len(cls.places_with(thrusters)) * len(cls.parameters)
        return cls(jnp.zeros(size, dtype), **options)

    @classmethod
    def index(cls, place: str, parameter: str) -> int:
        """Index in `values` of a parameter at a place.

        Raises:
            UserError: the effect has no such place or parameter.
        """
        names = [p.name for p in cls.parameters]
        places = cls.places_with(MOST)
        if place not in places:
            raise UserError(f"{cls.name}.where is {place!r}: take {_listed(places)}")
        if parameter not in names:
            raise UserError(f"{cls.name} has no {parameter!r}: it has {', '.join(names)}")
        return places.index(place) * len(names) + names.index(parameter)

    @classmethod
    def single(cls, place: str) -> bool:
        """Whether a place is one thruster of an effect that may act on all alike."""
        del place
        return False

    def for_thrusters(self, count: int) -> "Effect":
        """The same effect on a vehicle with so many thrusters.

        Raises:
            UserError: it acts on a thruster that the vehicle doesn't have.
        """
        del count
        return self

    @classmethod
    def of(
        cls, where: str | None = None, dtype: Any = float, options: Any = None, **parameters: float
    ) -> "Effect":
        """The effect with parameters by name at one place: `ThrusterLag.of(time_constant=0.1)`.

        `where` may be left out for an effect with a single place, or with `all` among them;
        `options` are its further fields. A thruster's number stands for itself: `for_thrusters`
        fits the effect to a vehicle.

        Raises:
            UserError: a place or parameter is unknown, or a value is not admissible.
        """
        places = list(cls.places_with(MOST))
        if where is None and len(places) > 1 and "all" not in places:
            raise UserError(f"{cls.name}: say where: {_listed(places)}")
        where = where or places[0]
        number = int(where) if where in places and where.isdecimal() else 0
        values = np.array(cls.neutral(thrusters=number).values)
        for name, value in parameters.items():
            i = cls.index(where, name)
            p = cls.parameters[i % len(cls.parameters)]
            low, high = p.low + p.usual, p.high + p.usual
            if not low <= value <= high:
                raise UserError(
                    f"{cls.name}.{name} is {value:g}: give {low:g} to {high:g} {p.unit}"
                )
            values[i] = value - p.usual
        return cls(jnp.asarray(values, dtype), **(options or {}))

    @classmethod
    def acts(cls, hook: str) -> bool:
        """Whether this kind overrides a hook."""
        return getattr(cls, hook) is not getattr(Effect, hook)

    def assumed(self, place: str) -> dict[str, tuple[float, str]]:
        """Assumed values and units that parameters at a place refer to; they are not estimated."""
        del place
        return {}

    def part(self, i: int, like: Array) -> Array:
        """Value i, expanded to the rank of one component of `like`."""
        return expand(self.values[i], like.ndim - 1)

    def column(self, like: Array) -> Array:
        """All values as components, expanded to the rank of `like`."""
        return expand(self.values, like.ndim)

    # --------------------------------------------------------------------------- actuation

    @property
    def memory_size(self) -> int:
        """Length of the memory that the effect carries from step to step."""
        return 0

    @property
    def memory_duration(self) -> float:
        """Memory duration (s), to about 1 %."""
        return 0.0

    def initial(self, command: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
        """Steady-state memory under a constant `command`."""
        return jnp.zeros((self.memory_size, *command.shape[1:]), command.dtype)

    def actuate(
        self,
        memory: Float[Array, "m *#batch"],
        level: Float[Array, "n *#batch S"],
        dt: Float[Array, "..."],
    ) -> tuple[Float[Array, "m *#batch"], Float[Array, "n *#batch S"]]:
        """Memory after a step of `dt` s, and mean thruster forces (N) over its S substeps.

        `dt` is a scalar, or (1, *batch) where columns have different steps.
        """
        del dt
        return memory, level

    def for_steps_of(self, dt: float) -> "Effect":
        """The same effect with enough memory for steps of `dt` s."""
        del dt
        return self

    def feel(
        self,
        memory: Float[Array, "m *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        dt: Any,
    ) -> tuple[Float[Array, "m *#batch"], Float[Array, "6 *#batch"]]:
        """Memory after a step of `dt` s at a velocity, and the resulting wrench F_Bo_B."""
        del dt
        return memory, jnp.zeros_like(V_WB_B)

    def thrust(
        self,
        force: Float[Array, "n *#batch"],
        V_CB_B: Float[Array, "6 *#batch"],
        voltage: Float[Array, "1 *#batch"],
        plant: Plant,
    ) -> Float[Array, "n *#batch"]:
        """Actual thruster forces (N) from the commanded; `voltage` is relative to the nominal."""
        del V_CB_B, voltage, plant
        return force

    def together(self, F_Bo_B: Float[Array, "6 *#batch"]) -> Float[Array, "6 *#batch"]:
        """Actual wrench of all thrusters (N, N·m), from the allocated one."""
        return F_Bo_B

    # ---------------------------------------------------------------------- body and water

    def inertia(self, plant: Plant) -> Float[Array, "6 6 *batch"]:
        """Addition to the mass matrix (kg, kg·m, kg·m²)."""
        del plant
        return jnp.zeros((6, 6, *self.values.shape[1:]), self.values.dtype)

    def wrench(
        self, X_WB: Float[Array, "7 *#batch"], V_CB_B: Float[Array, "6 *#batch"], plant: Plant
    ) -> Float[Array, "6 *#batch"]:
        """A wrench F_Bo_B (N, N·m) at a pose and a velocity relative to the water."""
        del X_WB, plant
        return jnp.zeros_like(V_CB_B)

    def flow(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "3 *#batch"]:
        """Velocity of the water in W (m/s), steady and uniform around the vehicle."""
        return jnp.zeros_like(X_WB[4:])

    def in_constants(self, base: FossenDynamics, plant: Plant) -> FossenDynamics | None:
        """`base` with this effect in its constants; None if it is more than that."""
        return None

    # ------------------------------------------------------------------------- noise laws

    @property
    def noise_size(self) -> int:
        """Number of unit Gaussians that one step of `advance` takes."""
        return 0

    @property
    def pushes(self) -> int:
        """Length of the random state that `advance` updates and `push` reads."""
        return 0

    def diffusion(
        self, V_WB_B: Float[Array, "6 *#batch"], b: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        """The diffusion (N√s, N·m√s) that replaces b."""
        del V_WB_B
        return b

    def advance(
        self, state: Float[Array, "s *#batch"], w: Float[Array, "w *#batch"], dt: Float[Array, ""]
    ) -> Float[Array, "s *#batch"]:
        """The random state after `dt` s from unit Gaussians w."""
        del w, dt
        return state

    def push(
        self, state: Float[Array, "s *#batch"], X_WB: Float[Array, "7 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        """The wrench F_Bo_B of the random state."""
        del state
        return jnp.zeros((6, *X_WB.shape[1:]), X_WB.dtype)

    def drift_of_water(
        self, state: Float[Array, "s *#batch"], X_WB: Float[Array, "7 *#batch"]
    ) -> Float[Array, "3 *#batch"]:
        """The random part of the water's velocity in W (m/s)."""
        del state
        return jnp.zeros_like(X_WB[4:])

    # ------------------------------------------------------------------------ measurement

    def measure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        """Recorded pose and twist from the true ones; `recent` is the twist's history."""
        del recent
        return X_WB, V_WB_B

    def unmeasure(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        recent: Recent,
    ) -> tuple[Float[Array, "7 *#batch"], Float[Array, "6 *#batch"]]:
        """True pose and twist from the recorded ones: the inverse of `measure`."""
        del recent
        return X_WB, V_WB_B


def _listed(places: Sequence[str]) -> str:
    if len(places) < MOST:
        return f"one of {', '.join(places)}"
    return "all, or the number of a thruster" if "all" in places else "the number of a thruster"


class ByThruster(Effect):
    """Base of effects on single thrusters, and unless `common` is empty on all alike as well.

    The places are `common` and the numbers of the thrusters, as many as there are values for.
    """

    common: ClassVar[tuple[str, ...]] = ("all",)

    @property
    def places(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.places_with(self.thrusters)

    @classmethod
    def places_with(cls, thrusters: int) -> tuple[str, ...]:
        return (*cls.common, *(str(k + 1) for k in range(thrusters)))

    @classmethod
    def single(cls, place: str) -> bool:
        return bool(cls.common) and place not in cls.common

    @property
    def thrusters(self) -> int:
        """Number of thrusters with values of their own."""
        return self.values.shape[0] // len(self.parameters) - len(self.common)

    def for_thrusters(self, count: int) -> "Effect":
        more = (count - self.thrusters) * len(self.parameters)
        if more == 0:
            return self
        if more < 0:
            raise UserError(
                f"{self.name}.where is {self.thrusters}: the vehicle has {count} thrusters; give a "
                f"number from 1 to {count}"
            )
        padding = [(0, more), *((0, 0) for _ in self.values.shape[1:])]
        return dataclasses.replace(self, values=jnp.pad(self.values, padding))

    def each(self, k: int, like: Array) -> Array:
        """Parameter k of every thruster: common plus individual part."""
        own = expand(self.values[k :: len(self.parameters)], like.ndim)
        return own[:1] + own[1:] if self.thrusters else own

    def longest(self, k: int) -> float:
        """The largest parameter k of any thruster."""
        own = np.asarray(self.values, float)[k :: len(self.parameters)]
        return float(own[0] + np.max(own[1:], initial=0.0))


def force_only(f: Float[Array, "3 *batch"]) -> Float[Array, "6 *batch"]:
    """A wrench without moment."""
    return jnp.concatenate([f, jnp.zeros_like(f)])


def axes_only(entries: dict[int, Array], like: Array) -> Array:
    """Six components of which only some are not zero."""
    zero = jnp.zeros_like(like[0])
    return jnp.stack(jnp.broadcast_arrays(*(entries.get(i, zero) for i in range(6))))
