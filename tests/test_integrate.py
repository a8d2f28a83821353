"""Algorithm 1: order, Stratonovich limit, group constraint, and its two forms agree."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from spinndrift.models import se3
from spinndrift.models.integrate import (
    LieEulerHeun,
    brownian_increments,
    cast,
    rollout,
    sde_terms,
    step,
)
from spinndrift.models.rigid_body import FossenDynamics, spatial_inertia
from spinndrift.models.spinn import Spinn, SpinnConfig


def vehicle(dtype=float, **changes):
    values = {
        "rigid_inertia": spatial_inertia(11.5, np.array([0, 0, -0.02]), np.diag([0.2, 0.2, 0.3])),
        "added_mass": np.diag([5.5, 12.7, 14.6, 0.12, 0.13, 0.14]),
        "linear_drag": np.diag([4.0, 6.2, 5.2, 0.3, 0.3, 0.3]),
        "quadratic_drag": np.diag([18.2, 21.7, 37.0, 1.5, 1.6, 1.7]),
        "weight": 112.8,
        "buoyancy": 113.8,
        "p_BoBcm_B": np.array([0, 0, -0.02]),
        "p_BoCb_B": np.zeros(3),
        "diffusion": np.array([2.0, 2.0, 2.0, 0.2, 0.2, 0.2]),
    }
    return FossenDynamics(dtype=dtype, **(values | changes))


class StateNoise(FossenDynamics):
    """The same vehicle with a diffusion that grows with speed: b_i (1 + ½ sin(2 ξ_i))."""

    def mass_and_diffusion(self, V_WB_B):
        (b, _) = se3.align(self.diffusion, V_WB_B)
        return self.mass, b * (1 + jnp.sin(2 * V_WB_B) / 2)

    def coefficients(self, V_WB_B):
        return super().coefficients(V_WB_B)._replace(diffusion=self.mass_and_diffusion(V_WB_B)[1])


X0 = se3.from_position_rpy(jnp.zeros(3), jnp.array([0.1, -0.2, 0.3]))
V0 = jnp.array([0.3, 0.1, -0.2, 0.2, 0.3, -0.4])
F = jnp.array([20.0, -5.0, 3.0, 0.5, -0.5, 1.0])


def coarse(dW, factor):
    """Sum Brownian increments over `factor` consecutive steps."""
    return dW.reshape(dW.shape[0] // factor, factor, *dW.shape[1:]).sum(1)


def end_errors(dynamics, dt, dW, factors, samples):
    """Root-mean-square distance of the end state from the finest solution, by coarsening."""
    run = jax.jit(rollout, static_argnames=("dt", "remat"))
    X = jnp.tile(X0[:, None], (1, samples))
    V = jnp.tile(V0[:, None], (1, samples))

    def end(factor):
        increments = coarse(dW, factor)[:, None]
        wrench = jnp.tile(F, (increments.shape[0], 1))
        Xs, Vs = run(dynamics, X, V, wrench, dt * factor, increments, remat=False)
        return Xs[-1], Vs[-1]

    X_fine, V_fine = end(1)
    errors = []
    for factor in factors:
        X_end, V_end = end(factor)
        squared = jnp.sum(se3.local(X_fine, X_end) ** 2, 0) + jnp.sum((V_end - V_fine) ** 2, 0)
        errors.append(float(jnp.sqrt(jnp.mean(squared))))
    return np.array(errors)


def test_deterministic_order_is_one():
    dynamics = vehicle()

    @jax.jit
    def rate(y):
        X, V = se3.normalize(y[:7]), y[7:]
        dq = jnp.concatenate([-(y[1:4] @ V[3:])[None], y[0] * V[3:] + se3.cross(y[1:4], V[3:])]) / 2
        return jnp.concatenate([dq, se3.rotate(X, V[:3]), dynamics.acceleration(X, V, F)])

    start = np.concatenate([X0, V0])
    y = solve_ivp(lambda t, y: np.asarray(rate(y)), (0, 2), start, rtol=1e-11, atol=1e-12).y[:, -1]
    run = jax.jit(rollout, static_argnames=("dt",))
    errors = []
    steps = np.array([40, 80, 160, 320])
    for n in steps:
        X, V = run(dynamics, X0, V0, jnp.tile(F, (int(n), 1)), 2 / int(n))
        distance = np.asarray(se3.local(se3.normalize(jnp.asarray(y[:7])), X[-1]))
        errors.append(np.hypot(np.linalg.norm(distance), np.linalg.norm(V[-1] - y[7:])))
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 0.9 < slope < 1.15
    assert errors[-1] < errors[0] / 7


def test_strong_order_is_at_least_one_half_with_state_dependent_noise():
    dynamics = eqx.tree_at(lambda d: d.diffusion, StateNoise(**parameters()), jnp.ones(6) * 2.0)
    dt, fine = 1 / 4096, 4096
    dW = brownian_increments(jax.random.key(0), (fine, 6, 200), dt)
    factors = [32, 64, 128, 256, 512]
    errors = end_errors(dynamics, dt, dW, factors, 200)
    slope = np.polyfit(np.log(factors), np.log(errors), 1)[0]
    assert slope > 0.5
    assert errors[0] < 0.1


def parameters():
    """Arguments of a light vehicle whose noise matters at every step size."""
    return {
        "rigid_inertia": spatial_inertia(2.0, np.zeros(3), np.eye(3)),
        "added_mass": np.diag([1.0, 2.0, 3.0, 0.5, 0.5, 0.5]),
        "linear_drag": np.eye(6),
        "quadratic_drag": np.eye(6),
        "weight": 20.0,
        "buoyancy": 20.5,
        "p_BoBcm_B": np.zeros(3),
        "p_BoCb_B": np.array([0, 0, 0.05]),
    }


class GeometricNoise(FossenDynamics):
    """b(ξ) = σ |ξ| with M = 1 and nothing else: geometric Brownian motion along surge."""

    def mass_and_diffusion(self, V_WB_B):
        return self.mass, 0.8 * jnp.abs(V_WB_B)

    def coefficients(self, V_WB_B):
        return super().coefficients(V_WB_B)._replace(diffusion=0.8 * jnp.abs(V_WB_B))


def test_the_limit_is_stratonovich_not_ito():
    """dξ = σ ξ ∘ dW has the solution ξ_0 exp(σ W): path by path, and in the mean exp(σ²T/2)."""
    zero = np.zeros((6, 6))
    dynamics = GeometricNoise(
        rigid_inertia=np.eye(6),
        added_mass=zero,
        linear_drag=zero,
        quadratic_drag=zero,
        weight=0.0,
        buoyancy=0.0,
        p_BoBcm_B=np.zeros(3),
        p_BoCb_B=np.zeros(3),
    )
    n, steps = 20000, 100
    dW = brownian_increments(jax.random.key(1), (steps, 1, 6, n), 1 / steps)
    dW = dW.at[:, :, 1:].set(0)
    V = jnp.zeros((6, n)).at[0].set(1.0)
    X = jnp.tile(se3.identity()[:, None], (1, n))
    run = jax.jit(rollout, static_argnames=("dt",))
    surge = run(dynamics, X, V, jnp.zeros((steps, 6)), 1 / steps, dW)[1][-1, 0]
    exact = jnp.exp(0.8 * jnp.sum(dW[:, 0, 0], 0))
    assert float(jnp.sqrt(jnp.mean((surge / exact - 1) ** 2))) < 0.06
    stratonovich, ito = np.exp(0.32), 1.0
    assert float(jnp.mean(surge)) == pytest.approx(stratonovich, rel=0.03)
    assert abs(float(jnp.mean(surge)) - ito) > 0.3


def test_group_constraint_after_many_float32_steps():
    dynamics = vehicle(jnp.float32)
    X, V, wrench = (a.astype(jnp.float32) for a in (X0, V0, F))

    @jax.jit
    def many(key, X, V):
        def body(carry, k):
            dW = brownian_increments(k, (6,), 0.05, jnp.float32)
            return step(dynamics, *carry, wrench, 0.05, dW), None

        return jax.lax.scan(body, (X, V), jax.random.split(key, 100_000))[0]

    X, V = many(jax.random.key(2), X, V)
    R = np.asarray(se3.rotation_matrix(X), float)
    assert np.all(np.isfinite(V))
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-6


def test_diffrax_solver_takes_the_same_steps():
    dynamics = StateNoise(**parameters(), diffusion=np.ones(6))
    n, dt = 64, 0.03125
    path = diffrax.VirtualBrownianTree(
        0.0, n * dt, dt / 8, shape=(6,), key=jax.random.key(3), levy_area=diffrax.BrownianIncrement
    )
    grid = dt * jnp.arange(n + 1.0)
    dW = jnp.asarray(jax.vmap(path.evaluate)(grid[:-1], grid[1:]))
    Xs, Vs = rollout(dynamics, X0, V0, jnp.tile(F, (n, 1)), dt, dW[:, None])
    solution = diffrax.diffeqsolve(
        sde_terms(dynamics, lambda t: F, path),
        LieEulerHeun(),
        0.0,
        n * dt,
        dt,
        (X0, V0),
        saveat=diffrax.SaveAt(ts=grid[1:]),
    )
    assert solution.ys is not None
    X_diffrax, V_diffrax = solution.ys
    np.testing.assert_allclose(X_diffrax, Xs, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(V_diffrax, Vs, rtol=1e-6, atol=1e-6)


def test_substeps_and_single_states_agree_with_the_plain_loop():
    dynamics = StateNoise(**parameters(), diffusion=np.ones(6))
    dW = brownian_increments(jax.random.key(4), (3, 2, 6), 0.025)
    Xs, Vs = rollout(dynamics, X0, V0, jnp.tile(F, (3, 1)), 0.05, dW)
    X, V = X0, V0
    for n in range(3):
        for s in range(2):
            X, V = step(dynamics, X, V, F, 0.025, dW[n, s])
        np.testing.assert_allclose(Xs[n], X, atol=1e-13)
        np.testing.assert_allclose(Vs[n], V, atol=1e-13)


def test_gradient_of_a_rollout_matches_finite_differences():
    dynamics = StateNoise(**parameters(), diffusion=np.ones(6))
    dW = brownian_increments(jax.random.key(5), (10, 1, 6), 0.05)

    @jax.jit
    def loss(dynamics, V):
        Xs, Vs = rollout(dynamics, X0, V, jnp.tile(F, (10, 1)), 0.05, dW)
        return jnp.sum(se3.log(Xs[-1]) ** 2) + jnp.sum(Vs[-1] ** 2)

    slope = jax.grad(loss, argnums=1)(dynamics, V0)
    h = 1e-6
    for i in range(6):
        e = jnp.zeros(6).at[i].set(h)
        central = (loss(dynamics, V0 + e) - loss(dynamics, V0 - e)) / (2 * h)
        assert float(slope[i]) == pytest.approx(float(central), rel=1e-6)


@pytest.mark.slow
def test_gradients_of_a_thousand_long_windows_fit_in_two_gigabytes():
    """4 s at 20 Hz times 1000 samples through the networks, from the compiler's own accounting."""
    model = Spinn.create(SpinnConfig(), vehicle(jnp.float32), jax.random.key(6), jnp.float32)
    f32, samples = jnp.float32, 1000
    shapes = [(7, samples), (6, samples), (80, 6, samples), (80, 1, 6, samples)]

    def loss(model, X, V, wrench, dW):
        Xs, Vs = rollout(model, X, V, wrench, 0.05, dW)
        return jnp.sum(Xs**2) + jnp.sum(Vs**2)

    arguments = [jax.ShapeDtypeStruct(shape, f32) for shape in shapes]
    memory = jax.jit(jax.grad(loss)).lower(model, *arguments).compile().memory_analysis()
    assert memory is not None
    used = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    assert used < 2e9


def test_cast_changes_precision_and_nothing_else():
    single = cast(vehicle(), jnp.float32)
    assert single.mass.dense.dtype == jnp.float32
    A = single.acceleration(*(a.astype(jnp.float32) for a in (X0, V0, F)))
    np.testing.assert_allclose(A, vehicle().acceleration(X0, V0, F), rtol=1e-4)
