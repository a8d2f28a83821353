"""What a SPINN costs: MPPI's rollouts, a training step's rollouts with gradient, and its variants.

`make bench ONLY=spinn` times every case; `python benchmarks/bench_spinn.py` prints the tables of
docs/numerics.md, with the processor time of all threads beside the elapsed time: on a machine that
others use too, that is the figure to compare.
"""

import functools
import sys
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import integrate, se3, spd, symmetric
from spinndrift.models.rigid_body import FossenDynamics
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle

STEPS, DT = 80, 0.05
VARIANTS: dict[str, dict[str, Any]] = {
    "Cholesky (default)": {},
    "Cholesky, rational tanh": {"activation": "rational_tanh"},
    "Cholesky, constant M": {"constant_mass": True},
    "Cholesky, constant M, rational tanh": {"constant_mass": True, "activation": "rational_tanh"},
    "Cholesky, no noise": {"stochastic": False},
    "eigenvalues (Jacobi)": {"spd": "eigenvalues"},
}


@functools.cache
def reference() -> FossenDynamics:
    return load_vehicle("bluerov2_heavy").dynamics(np.full(6, 0.5), jnp.float32)


def model(**settings: Any) -> Spinn:
    """A SPINN whose parameters have moved off their start, where all heads are zero."""
    start = Spinn.create(SpinnConfig(**settings), reference(), jax.random.key(0))
    learned, rest = eqx.partition(start, start.trainable())
    leaves, tree = jax.tree.flatten(learned)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    moved = [
        p + 0.02 * jax.random.normal(k, p.shape, p.dtype) for p, k in zip(leaves, keys, strict=True)
    ]
    return eqx.combine(jax.tree.unflatten(tree, moved), rest)


def inputs(samples: int) -> tuple[jax.Array, ...]:
    X = jnp.tile(se3.identity(jnp.float32)[:, None], (1, samples))
    V = jnp.zeros((6, samples), jnp.float32)
    F = jax.random.normal(jax.random.key(2), (STEPS, 6, samples), jnp.float32)
    shape = (STEPS, 1, 6, samples)
    return X, V, F, integrate.brownian_increments(jax.random.key(3), shape, DT, jnp.float32)


def rollout_case(dynamics: Spinn, samples: int = 1000) -> tuple[Callable[..., Any], tuple]:
    arrays, static = eqx.partition(dynamics, eqx.is_array)

    def run(arrays: Any, X: Any, V: Any, F: Any, dW: Any) -> Any:
        return integrate.rollout(eqx.combine(arrays, static), X, V, F, DT, dW)

    return run, (arrays, *inputs(samples))


def training_case(dynamics: Spinn, samples: int = 640) -> tuple[Callable[..., Any], tuple]:
    run, arguments = rollout_case(dynamics, samples)

    def loss(*arguments: Any) -> Any:
        Xs, Vs = run(*arguments)
        return jnp.mean(Xs[:, 4:] ** 2) + jnp.mean(Vs**2)

    return jax.value_and_grad(loss), arguments


def plain_case(samples: int = 1000) -> tuple[Callable[..., Any], tuple]:
    """The yardstick: one sample at a time under `vmap`, library Cholesky, `jax.grad` of V."""
    dynamics = model()
    arrays, static = eqx.partition(dynamics, eqx.is_array)

    def mlp(m: Spinn, n: int, xi: Any) -> Any:
        for w, b in zip(m.hidden.weights, m.hidden.biases, strict=True):
            xi = jnp.tanh(w[n] @ xi + b[n])
        return xi

    def factor(m: Spinn, n: int, xi: Any) -> Any:
        raw = m.matrix_heads.weight[n - 1] @ mlp(m, n, xi) + m.matrix_heads.bias[n - 1]
        rows, columns = np.tril_indices(6, -1)
        L = jnp.diag(spd.squareplus(raw[:6])).at[rows, columns].set(raw[6:])
        return m.scales.roots[n - 1] @ L

    def diffusion(m: Spinn, xi: Any) -> Any:
        assert m.diffusion_head is not None
        raw = m.diffusion_head.weight[0] @ mlp(m, 0, xi) + m.diffusion_head.bias[0]
        return m.scales.diffusion * spd.squareplus(raw)

    def step(m: Spinn, X: Any, V: Any, F: Any, dW: Any) -> Any:
        L, D, Df = (factor(m, n, V) for n in (1, 2, 3))
        momentum = L @ (L.T @ V)
        wrench = se3.coad_apply(V, momentum) - D @ (D.T @ V) - Df @ (Df.T @ (jnp.abs(V) * V))
        wrench = wrench + m.potential_wrench(X) + F
        drift = jax.scipy.linalg.cho_solve((L, True), wrench)
        first = jax.scipy.linalg.cho_solve((L, True), diffusion(m, V) * dW)
        L = factor(m, 1, V + first)
        second = jax.scipy.linalg.cho_solve((L, True), diffusion(m, V + first) * dW)
        return se3.retract(X, V * DT), V + DT * drift + (first + second) / 2

    def run(arrays: Any, X: Any, V: Any, F: Any, dW: Any) -> Any:
        m = eqx.combine(arrays, static)
        each = jax.vmap(lambda *state: step(m, *state))

        def advance(carry: Any, now: Any) -> Any:
            carry = each(*carry, now[0].T, now[1][0].T)
            return carry, carry

        return jax.lax.scan(advance, (X.T, V.T), (F, dW))[1]

    return run, (arrays, *inputs(samples))


def matmul_case() -> tuple[Callable[..., Any], tuple]:
    A = jnp.ones((1024, 1024), jnp.float32)
    return lambda A: A @ A, (A,)


CASES: dict[str, Callable[[], tuple[Callable[..., Any], tuple]]] = {
    "1024³ matrix product (2.1 GFLOP)": matmul_case,
    "MPPI, vmap over one sample, library Cholesky": plain_case,
    **{
        f"MPPI, {n}": functools.partial(lambda s: rollout_case(model(**s)), s)
        for n, s in VARIANTS.items()
    },
    **{
        f"training, {n}": functools.partial(lambda s: training_case(model(**s)), VARIANTS[n])
        for n in ("Cholesky (default)", "Cholesky, constant M", "eigenvalues (Jacobi)")
    },
}


@pytest.mark.parametrize("name", CASES)
def test_spinn_cost(name: str, benchmark: Any) -> None:
    function, arguments = CASES[name]()
    compiled = jax.jit(function).lower(*arguments).compile()
    jax.block_until_ready(compiled(*arguments))
    benchmark(lambda: jax.block_until_ready(compiled(*arguments)))


def derivative_error(value: Callable[[Any], Any], gap: float) -> float:
    """Relative error in float32 of the gradient of <W, f(A)> where eigenvalues are `gap` apart."""
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.normal(size=(6, 6)))[0] if gap else np.eye(6)
    w = 0.7 + gap * np.arange(6)
    W = rng.normal(size=(6, 6))
    root = np.sqrt(w * w + 4)
    slope = (1 + (w[:, None] + w) / (root[:, None] + root)) / 2
    exact = Q @ (slope * (Q.T @ (W + W.T) / 2 @ Q)) @ Q.T
    A = jnp.asarray((Q * w) @ Q.T, jnp.float32)
    found = jax.grad(lambda A: jnp.sum(value(A) * jnp.asarray(W, jnp.float32)))(A)
    found = np.asarray(found + found.T) / 2
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


def through_eigh(A: Any) -> Any:
    w, Q = jnp.linalg.eigh(A)
    return (Q * spd.squareplus(w)[None]) @ Q.T


def main() -> None:
    say = sys.stdout.write
    say("| case | elapsed ms | processor ms | compile s |\n|---|---|---|---|\n")
    for name, make in CASES.items():
        function, arguments = make()
        start = time.process_time()
        compiled = jax.jit(function).lower(*arguments).compile()
        compiling = time.process_time() - start
        jax.block_until_ready(compiled(*arguments))
        elapsed, used = [], []
        for _ in range(9):
            wall, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(compiled(*arguments))
            elapsed.append(time.perf_counter() - wall)
            used.append(time.process_time() - cpu)
        wall, cpu = 1e3 * np.median(elapsed), 1e3 * np.median(used)
        say(f"| {name} | {wall:.0f} | {cpu:.0f} | {compiling:.1f} |\n")
        sys.stdout.flush()
    say("\n| gap | autodiff of eigh | Jacobi, Daleckii–Krein |\n|---|---|---|\n")
    for gap in (1.0, 1e-2, 1e-4, 1e-6, 0.0):
        errors = [
            derivative_error(f, gap) for f in (through_eigh, lambda A: symmetric.positive(A)[0])
        ]
        say(f"| {gap:g} | {errors[0]:.1e} | {errors[1]:.1e} |\n")


if __name__ == "__main__":
    main()
