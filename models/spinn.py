"""Stochastic physics-informed neural network of a vehicle: networks for M, D, D^f, V and b.

Palmer et al., "Stochastic physics-informed neural networks on Lie groups": the stochastic
Euler–Poincaré equation of `models.dynamics` with M_θ(ξ), D_θ(ξ), D^f_θ(ξ) symmetric positive
definite, b_θ(ξ) diagonal and positive, and V_θ(g) bounded by a learned λ. Beyond the paper, b may
be the diagonal of a full factor b C_θ(ξ).
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .config.checks import Vector6, check_numbers, require
from .distance_aware import DiffusionKind, DistanceAware
from .dynamics import Coefficients, Dynamics
from .growth import Growth
from .mean_reverting import MeanReverting
from .networks import ACTIVATIONS, Activation, Heads, MlpStack, expand
from .potential import BoundedScalar, GravityPotential, PosePotential, Potential, PotentialKind
from .rigid_body import FossenDynamics
from .spd import PACKED, CholeskySpd, ConstantSpd, EigenSpd, Spd, squareplus

SpdKind = Literal["cholesky", "eigenvalues"]

_OPERATORS: dict[str, type[CholeskySpd] | type[EigenSpd]] = {
    "cholesky": CholeskySpd,
    "eigenvalues": EigenSpd,
}


@dataclass(frozen=True)
class SpinnConfig:
    """The architecture: five perceptrons of `depth` hidden layers with `width` units."""

    width: int = 32
    depth: int = 3
    activation: Activation = "tanh"
    spd: SpdKind = "cholesky"
    """Parametrisation of M, D and D^f: Cholesky factors, or positive eigenvalues."""
    potential: PotentialKind = "gravity"
    """`gravity` keeps the symmetry in x, y, yaw (whole dives); `pose` is the paper's."""
    constant_mass: bool = False
    """M does not depend on velocity, as in physics."""
    stochastic: bool = True
    """Without it b = 0 (a geometric PINN)."""
    diffusion: DiffusionKind = "network"
    """b from its own network, or growing with the distance from the data."""
    correlated: bool = False
    """The noise's axes are correlated: b C(ξ) dW, C lower triangular with rows of length one."""
    mean_reverting: bool = False
    """A second, Ornstein–Uhlenbeck disturbance, whose time constants are learned."""
    growing: bool = False
    """The scale of b grows with the twist, as calibration finds it (`Growth`)."""
    coordinates: Literal["group", "euler"] = "group"
    """State on SE(3), or position and Euler angles in R¹² as in baselines (`EuclideanSpinn`).
    """
    start: Literal["reference", "scale"] = "reference"
    """Networks start at the reference's matrices, or at the diagonal matrices of their scales."""
    velocity_scale: Vector6 = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """Scale of the networks' velocity input (m/s, rad/s)."""
    length_scale: float = 1.0
    """Scale of the position input of a `pose` potential (m)."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(1 <= self.width <= 1024, self, "width", "give 1 to 1024 units")
        require(1 <= self.depth <= 32, self, "depth", "give 1 to 32 hidden layers")
        require(self.activation in ACTIVATIONS, self, "activation", f"use one of {ACTIVATIONS}")
        require(self.spd in _OPERATORS, self, "spd", f"use one of {tuple(_OPERATORS)}")
        require(self.potential in ("gravity", "pose"), self, "potential", "use gravity or pose")
        require(self.start in ("reference", "scale"), self, "start", "use reference or scale")
        kinds = get_args(DiffusionKind)
        require(self.diffusion in kinds, self, "diffusion", f"use one of {kinds}")
        plain = not self.correlated or (self.stochastic and self.diffusion == "network")
        require(plain, self, "correlated", "leave it out, or let b be a network of its own")
        require(self.coordinates in ("group", "euler"), self, "coordinates", "use group or euler")
        plain = not self.growing or (self.stochastic and self.diffusion == "network")
        require(plain, self, "growing", "leave it out, or let b be a network of its own")
        plain = not self.mean_reverting or (self.stochastic and self.coordinates == "group")
        require(
            plain, self, "mean_reverting", "leave it out, or use a stochastic model on the group"
        )
        require(min(self.velocity_scale) > 0, self, "velocity_scale", "give positive numbers")
        require(self.length_scale > 0, self, "length_scale", "give a positive length in m")


class Scales(eqx.Module):
    """Magnitudes (not trained) that make the networks' inputs and outputs of order one."""

    velocity: Float[Array, "6"]
    roots: Float[Array, "3 6 6"]
    """S with S Sᵀ the magnitudes of M, D, D^f: Cholesky factors of the reference's."""
    inverse_roots: Float[Array, "3 6 6"]
    diffusion: Float[Array, "6"]
    growth: Growth | None = None
    """How `diffusion` grows with the twist; None: it is constant."""


class Spinn(Dynamics):
    """Learned drift and diffusion; make one with `Spinn.create`.

    The order of the networks is (b, M, D, D^f), without b if not `stochastic` or if b is
    `distance_aware`, and without M if `constant_mass`: the second stage of a Heun step evaluates a
    prefix of them.

    Example:
        >>> physics = load_vehicle("bluerov2_heavy").dynamics()
        >>> model = Spinn.create(TrainingConfig().model, physics, jax.random.key(0))
        >>> model.stochastic
        True
    """

    config: SpinnConfig = eqx.field(static=True)
    rigid_inertia: Float[Array, "6 6"]
    displaced_mass: Float[Array, ""]
    p_BoCb_B: Float[Array, "3"]
    scales: Scales
    hidden: MlpStack
    matrix_heads: Heads
    diffusion_head: Heads | None
    constant_mass: Float[Array, "21"] | None
    learned_potential: Potential
    distance_aware: DistanceAware | None = None
    lasting: MeanReverting | None = None

    @classmethod
    def create(
        cls,
        config: SpinnConfig,
        reference: FossenDynamics,
        key: Array,
        dtype: jnp.dtype | type | None = None,
    ) -> "Spinn":
        """A model that starts at `reference`: its matrices exactly, V to a few percent.

        Diffusion that is zero in the reference starts at 5 % of the drag at `velocity_scale`, and a
        drag of zero at 1 % of the drag that stops the vehicle in a second. That diffusion is the
        prior of a distance-aware one.
        """
        dtype = reference.rigid_inertia.dtype if dtype is None else dtype
        v = np.asarray(config.velocity_scale)
        operators = (reference.mass, reference.linear_drag, reference.quadratic_drag)
        M, D, Df = (np.asarray(operator.matrix(), float) for operator in operators)
        floor = 0.01 * np.diag(M)
        matrices = [M, _floored(D, floor), _floored(Df, floor / v)]
        drag = np.diag(matrices[1]) * v + np.diag(matrices[2]) * v**2
        b = np.asarray(reference.diffusion, float)
        if config.start == "scale":
            matrices = [np.diag(np.diag(a)) for a in matrices]
        roots = np.linalg.cholesky(np.stack(matrices))
        scales = Scales(
            velocity=jnp.asarray(v, dtype),
            roots=jnp.asarray(roots, dtype),
            inverse_roots=jnp.asarray(np.linalg.inv(roots), dtype),
            diffusion=jnp.asarray(np.where(b > 0, b, 0.05 * drag), dtype),
            growth=Growth.none(dtype) if config.growing else None,
        )
        variable = jnp.zeros((2 if config.constant_mass else 3, PACKED), dtype)
        network_key, potential_key = jax.random.split(key)
        network = config.stochastic and config.diffusion == "network"
        aware = config.stochastic and not network
        count = variable.shape[0] + network
        return cls(
            config=config,
            rigid_inertia=reference.rigid_inertia.astype(dtype),
            displaced_mass=reference.displaced_mass.astype(dtype),
            p_BoCb_B=reference.p_BoCb_B.astype(dtype),
            scales=scales,
            hidden=MlpStack.create(
                count, 6, config.width, config.depth, config.activation, network_key, dtype
            ),
            matrix_heads=Heads.constant(variable, config.width),
            diffusion_head=Heads.constant(
                jnp.zeros((1, 6 + 15 * config.correlated), dtype), config.width
            )
            if network
            else None,
            constant_mass=jnp.zeros(PACKED, dtype) if config.constant_mass else None,
            learned_potential=cls.starting_potential(config, reference, potential_key, dtype),
            distance_aware=DistanceAware.create(
                config.diffusion, jax.random.fold_in(key, 1), jnp.dtype(dtype)
            )
            if aware
            else None,
            lasting=MeanReverting.create(dtype) if config.mean_reverting else None,
        )

    @staticmethod
    def starting_potential(
        config: SpinnConfig, reference: FossenDynamics, key: Array, dtype: Any
    ) -> Potential:
        """V that approximates the reference's restoring energy."""
        return _potential(config, reference, key, dtype)

    @property
    def stochastic(self) -> bool:
        return self.config.stochastic

    @property
    def brownian_size(self) -> int:
        return 6 if self.lasting is None else 12

    def lasting_push(
        self, w: Float[Array, "T 6 *batch"], dt: float | Float[Array, ""]
    ) -> Float[Array, "T 6 *batch"]:
        if self.lasting is None:
            return super().lasting_push(w, dt)
        return self.lasting.path(self.scales.diffusion, w, dt)

    def whitened(self) -> "Spinn":
        """The equivalent model with white noise only, for users without a latent state.

        Over times much longer than τ a mean-reverting wrench acts like white noise with
        b = σ √(2τ); its square is added to that of the model's diffusion scale.
        """
        if self.lasting is None:
            return self
        own = self.scales.diffusion
        b = jnp.sqrt(own**2 + self.lasting.white(own) ** 2)
        growth = self.scales.growth
        if growth is not None:
            growth = replace(growth, rate=growth.rate * (own / b)[:, None] ** 2)
        scales = replace(self.scales, diffusion=b, growth=growth)
        config = replace(self.config, mean_reverting=False)
        return replace(self, config=config, scales=scales, lasting=None)

    def trainable(self) -> "Spinn":
        """The same tree with True at the parameters θ and False at inertia and scales."""
        spec = jax.tree.map(eqx.is_inexact_array, self)
        no_scales = jax.tree.map(lambda _: False, spec.scales)
        fixed = (False, False, False, no_scales)
        spec = eqx.tree_at(
            lambda m: (m.rigid_inertia, m.displaced_mass, m.p_BoCb_B, m.scales), spec, fixed
        )
        if isinstance(self.learned_potential, PosePotential):
            spec = eqx.tree_at(lambda m: m.learned_potential.length, spec, False)
        return spec

    def mass_variation(
        self, V_WB_B: Float[Array, "6 *batch"], direction: Float[Array, "6 *batch"]
    ) -> Float[Array, ""]:
        """Mean over the batch of |∂P(ξ)·v|², P the raw outputs for M in units of their scale.

        With directions v drawn from unit Gaussians it is an unbiased estimate of ‖∂P/∂ξ‖² (in
        units of `velocity_scale`), a penalty that keeps M_θ constant (Hutchinson 1990). Zero if
        `constant_mass`.
        """
        if self.constant_mass is not None:
            return jnp.zeros((), V_WB_B.dtype)
        count = int(self.diffusion_head is not None) + 1

        def raw(V: Array) -> Array:
            return self.matrix_heads(self._features(V, count)[count - 1 :], 1)[0]

        scale = self.scales.velocity.reshape((6,) + (1,) * (V_WB_B.ndim - 1))
        _, change = jax.jvp(raw, (V_WB_B,), (direction * jax.lax.stop_gradient(scale),))
        return jnp.mean(jnp.sum(change**2, axis=0))

    def scaled_velocity(self, V_WB_B: Float[Array, "6 *batch"]) -> Float[Array, "6 *batch"]:
        """Input of the networks: ξ in units of `velocity_scale`."""
        return V_WB_B / expand(jax.lax.stop_gradient(self.scales.velocity), V_WB_B.ndim)

    def _features(self, V_WB_B: Array, count: int) -> Array:
        return self.hidden(self.scaled_velocity(V_WB_B), count)

    def _diffusion(self, V_WB_B: Array, features: Array) -> Array:
        scale = self._diffusion_scale(V_WB_B)
        if self.distance_aware is not None:
            factor = self.distance_aware(self.scaled_velocity(V_WB_B))
            return expand(scale, factor.ndim) * factor
        if self.diffusion_head is None:
            return jnp.zeros_like(scale)
        raw = self.diffusion_head(features[:1], 1)[0, :6]
        return expand(scale, raw.ndim) * squareplus(raw)

    def _diffusion_scale(self, V_WB_B: Array) -> Array:
        """The factor of b's network: constant, or growing with the twist."""
        scales = jax.lax.stop_gradient(self.scales)
        if scales.growth is None:
            return scales.diffusion
        return scales.growth(scales.diffusion, V_WB_B)

    def correlate(
        self, V_WB_B: Float[Array, "6 *#batch"], dW: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        if not self.config.correlated:
            return dW
        C = self.noise_correlation_root(V_WB_B)
        dW = jnp.broadcast_to(dW, jnp.broadcast_shapes(dW.shape, V_WB_B.shape))
        return jnp.sum(C * dW[None], axis=1)

    def noise_correlation_root(
        self, V_WB_B: Float[Array, "6 *batch"]
    ) -> Float[Array, "6 6 *batch"]:
        """C(ξ), lower triangular with rows of length one: b C is the factor of a full diffusion.

        Row i holds free numbers left of the diagonal and 1 on it, divided by the row's length: b
        remains the noise's size on each axis, and C Cᵀ is any correlation matrix.

        Raises:
            ValueError: the model's noise is not correlated.
        """
        if self.diffusion_head is None or not self.config.correlated:
            raise ValueError("the model has no correlated noise: set SpinnConfig.correlated")
        raw = self.diffusion_head(self._features(V_WB_B, 1), 1)[0, 6:]
        rows, columns = np.tril_indices(6, -1)
        batch = raw.shape[1:]
        C = jnp.zeros((6, 6, *batch), raw.dtype).at[rows, columns].set(raw)
        C = C + jnp.eye(6, dtype=raw.dtype).reshape(6, 6, *(1 for _ in batch))
        return C / jnp.sqrt(jnp.sum(C * C, axis=1, keepdims=True))

    def _spd(self, raw: Array, index: int) -> Spd:
        scales = jax.lax.stop_gradient(self.scales)
        kind = _OPERATORS[self.config.spd]
        return kind.from_raw(raw, scales.roots[index], scales.inverse_roots[index])

    def coefficients(self, V_WB_B: Float[Array, "6 *batch"]) -> Coefficients:
        features = self._features(V_WB_B, self.hidden.weights[0].shape[0])
        first = int(self.diffusion_head is not None)
        raw = self.matrix_heads(features[first:], features.shape[0] - first)
        return Coefficients(
            self._mass(raw),
            self._spd(raw[-2], 1),
            self._spd(raw[-1], 2),
            self._diffusion(V_WB_B, features),
        )

    def mass_and_diffusion(self, V_WB_B: Float[Array, "6 *batch"]) -> tuple[Spd, Array]:
        first, varies = int(self.diffusion_head is not None), self.constant_mass is None
        features = self._features(V_WB_B, max(first + varies, 1))
        raw = self.matrix_heads(features[first:], 1) if varies else None
        return self._mass(raw), self._diffusion(V_WB_B, features)

    def _mass(self, raw: Array | None) -> Spd:
        if self.constant_mass is None:
            assert raw is not None
            return self._spd(raw[0], 0)
        M = self._spd(self.constant_mass, 0)
        return ConstantSpd(M.matrix(), M.solve(jnp.eye(6, dtype=self.constant_mass.dtype)))

    def potential(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "*batch"]:
        return self.learned_potential.energy(X_WB)

    def potential_wrench(self, X_WB: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
        return self.learned_potential.wrench(X_WB)


def _floored(a: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """The symmetric part of `a`, its eigenvalues relative to diag(`floor`) raised to at least 1."""
    s = np.sqrt(floor)
    w, Q = np.linalg.eigh((a + a.T) / 2 / np.outer(s, s))
    return np.outer(s, s) * ((Q * np.maximum(w, 1.0)) @ Q.T)


def restoring(
    config: SpinnConfig, reference: FossenDynamics
) -> tuple[Float[np.ndarray, "3"], float, float]:
    """Initial bounded potential: slope on R_WBᵀ e_z, heave energy (J), bound λ (J)."""
    buoyancy, weight = float(reference.buoyancy), float(reference.weight)
    lever = buoyancy * np.asarray(reference.p_BoCb_B) - weight * np.asarray(reference.p_BoBcm_B)
    moment = max(float(np.linalg.norm(lever)), 1e-3 * weight * config.length_scale)
    heave = (buoyancy - weight) * config.length_scale
    bound = 4 * (moment + (abs(heave) if config.potential == "pose" else 0.0))
    slope = -1.075 * lever / bound  # 0.2687 (1 - tanh² 0.2687) = 1/4: exact when upright
    if config.start == "scale":
        slope, heave = 0 * slope, 0.0
    return slope, heave, bound


def _potential(config: SpinnConfig, reference: FossenDynamics, key: Array, dtype: Any) -> Potential:
    slope, heave, bound = restoring(config, reference)
    if config.potential == "gravity":
        skip = slope
    else:
        skip = np.concatenate([np.zeros(6), slope, [0.0, 0.0, -heave / bound]])
    scalar = BoundedScalar.create(
        config.width,
        config.depth,
        config.activation,
        jnp.asarray(skip, dtype),
        jnp.asarray(bound, dtype),
        key,
    )
    if config.potential == "gravity":
        buoyancy = float(reference.buoyancy) - float(reference.weight)
        return GravityPotential(scalar, jnp.asarray(buoyancy, dtype))
    return PosePotential(scalar, jnp.asarray(config.length_scale, dtype))
