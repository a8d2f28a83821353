"""What a training step costs, beside torchsde's rollouts of the same size in the same run.

`make bench ONLY=training` times every case; `python benchmarks/bench_training.py` prints the table
of docs/numerics.md: medians of interleaved rounds, so that other load on the machine falls on all
alike. torchsde comes with `pip install -e '.[peers]'`; without it the rest is timed.
"""

import functools
import importlib.util
import sys
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.rigid_body import FossenDynamics
from spinndrift.models.spinn import Spinn, SpinnConfig
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.cores import share_cores
from spinndrift.training.compile_options import QUICK_COMPILE
from spinndrift.training.config import TrainingConfig
from spinndrift.training.data.windows import Windows
from spinndrift.training.fitting.step import (
    TrainStep,
    first_moments,
    mean_over_devices,
    partition,
    usable_devices,
)
from spinndrift.training.losses.base import Batch
from spinndrift.training.losses.matching import Fdm, Mse
from spinndrift.training.predict import predict

SCENARIOS, SAMPLES, STEPS, DT = 10, 64, 80, 0.05

share_cores()  # as `spinndrift train` does


@functools.cache
def reference() -> FossenDynamics:
    return load_vehicle("bluerov2_heavy").dynamics(np.full(6, 0.5), jnp.float32)


@functools.cache
def spinn(constant_mass: bool = False) -> Spinn:
    config = SpinnConfig(constant_mass=constant_mass)
    return Spinn.create(config, reference(), jax.random.key(0))


@functools.cache
def windows() -> Windows:
    """One window a scenario: the reference from rest under constant wrenches."""
    rng = np.random.default_rng(0)
    size = np.array([10, 10, 10, 0.5, 0.5, 0.5])[:, None]
    F = np.tile(size * rng.normal(size=(6, SCENARIOS)), (STEPS, 1, 1)).astype(np.float32)
    X_0 = np.zeros((7, SCENARIOS), np.float32)
    X_0[0] = 1
    V_0 = np.zeros((6, SCENARIOS), np.float32)
    start = jnp.asarray(X_0), jnp.asarray(V_0)
    X, V = predict(reference(), *start, jnp.asarray(F), DT, jax.random.key(1), 1)
    index = np.arange(SCENARIOS)
    return Windows(
        X=np.concatenate([X_0[None], np.asarray(X)[:, :, 0]]),
        V=np.concatenate([V_0[None], np.asarray(V)[:, :, 0]]),
        F=F,
        dt=DT,
        scenario=index,
        run=0 * index,
        start=0.0 * index,
        names=tuple(f"scenario {i}" for i in index),
    )


@functools.cache
def cores() -> int:
    """Cores that share the batch, one where JAX_NUM_CPU_DEVICES=1 says so."""
    return usable_devices(Mse().build(reference(), windows()), SCENARIOS)


def rollout_case(model: Spinn) -> Callable[[], Any]:
    """Rollouts of all samples and the gradient of a plain mean square of them."""
    params, static = partition(model)
    batch = Batch.of(windows())

    def of_part(batch: Batch, p: Any, key: Any) -> Any:
        def loss(p: Any) -> Any:
            m, start = eqx.combine(p, static), (batch.X[0], batch.V[0])
            X, V = predict(m, *start, batch.F, DT, key, SAMPLES, place=batch.place)
            return jnp.mean(X**2) + jnp.mean(V**2)

        return jax.value_and_grad(loss)(p)

    run = jax.jit(mean_over_devices(of_part, cores()), compiler_options=QUICK_COMPILE)
    return lambda: run(batch, params, jax.random.key(0))


def step_case(model: Spinn, **settings: Any) -> Callable[[], Any]:
    """A whole training step: rollouts, kernel scores, gradient, Adam."""
    objective = Fdm(samples=SAMPLES, substeps=1, mse_weight=0.0, **settings)
    config = TrainingConfig(objective=objective, batch=SCENARIOS)
    params, static = partition(model)
    step = TrainStep(config, params, static, cores())
    kept = jax.tree.map(jnp.array, params)
    state = [(kept, first_moments(config, kept))]
    built, data = objective.build(model, windows()), Batch.of(windows())

    def run() -> Any:
        p, moments, report = step(*state.pop(), built, data, np.arange(SCENARIOS), 0, 1, 1e-5)
        state.append((p, moments))
        return report.loss

    return run


def torchsde_case() -> Callable[[], Any]:
    """The same model in torchsde: five 3 x 32 MLPs as batched products, Cholesky factors."""
    import torch  # pyright: ignore[reportMissingImports]
    import torchsde  # pyright: ignore[reportMissingImports]

    torch.manual_seed(0)
    count = SCENARIOS * SAMPLES
    mass = torch.tensor(np.diag(reference().mass.matrix()).copy())
    rows, columns = torch.tril_indices(6, 6, -1)

    class TorchSpinn(torch.nn.Module):
        noise_type, sde_type = "general", "stratonovich"

        def __init__(self) -> None:
            super().__init__()
            layers = ((6, 32), (32, 32), (32, 32), (32, 21))
            self.weights = torch.nn.ParameterList(
                [torch.nn.Parameter(0.3 * torch.randn(4, i, o) / i**0.5) for i, o in layers]
            )
            self.biases = torch.nn.ParameterList(
                [torch.nn.Parameter(torch.zeros(4, 1, o)) for _, o in layers]
            )
            self.V = torch.nn.Sequential(
                torch.nn.Linear(3, 32),
                *(m for _ in range(2) for m in (torch.nn.Tanh(), torch.nn.Linear(32, 32))),
                torch.nn.Tanh(),
                torch.nn.Linear(32, 1),
            )
            self.F = torch.tensor(windows().F[0].T).repeat_interleave(SAMPLES, 0)

        def heads(self, V: Any, chosen: slice) -> Any:
            h = V.expand(4, *V.shape)[chosen]
            for n, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
                h = torch.baddbmm(b[chosen], h, w[chosen])
                h = torch.tanh(h) if n < 3 else h
            return h

        def factor(self, raw: Any) -> Any:
            L = torch.zeros(*raw.shape[:-1], 6, 6)
            L[..., rows, columns] = raw[..., 6:]
            return mass.sqrt()[:, None] * (
                L + torch.diag_embed(torch.nn.functional.softplus(raw[..., :6]))
            )

        def f(self, t: Any, y: Any) -> Any:
            q, V = y[:, :4], y[:, 7:]
            v, w = V[:, :3], V[:, 3:]
            L = self.factor(self.heads(V, slice(1, 4)))
            p = (L[0] @ (L[0].mT @ V[..., None]))[..., 0]
            drag = (L[1] @ (L[1].mT @ V[..., None]))[..., 0]
            square = (L[2] @ (L[2].mT @ (V.abs() * V)[..., None]))[..., 0]
            coad = torch.cat(
                [
                    torch.linalg.cross(p[:, :3], w),
                    torch.linalg.cross(p[:, 3:], w) + torch.linalg.cross(p[:, :3], v),
                ],
                1,
            )
            s, u = q[:, :1], q[:, 1:]
            up = torch.stack(
                [
                    2 * (q[:, 1] * q[:, 3] - q[:, 0] * q[:, 2]),
                    2 * (q[:, 2] * q[:, 3] + q[:, 0] * q[:, 1]),
                    1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2),
                ],
                1,
            )
            with torch.enable_grad():
                up = up if up.requires_grad else up.requires_grad_()
                energy = torch.tanh(self.V(up)).sum()
                slope = torch.autograd.grad(energy, up, create_graph=True)[0]
            restoring = torch.cat([0 * v, torch.linalg.cross(up, slope)], 1)
            wrench = coad - drag - square + restoring + self.F
            a = torch.cholesky_solve(wrench[..., None], L[0])[..., 0]
            c = torch.linalg.cross(u, v)
            dp = v + 2 * (s * c + torch.linalg.cross(u, c))
            dq = 0.5 * torch.cat([-(u * w).sum(1, True), s * w + torch.linalg.cross(u, w)], 1)
            return torch.cat([dq, dp, a], 1)

        def g(self, t: Any, y: Any) -> Any:
            raw = self.heads(y[:, 7:], slice(0, 2))
            b = torch.nn.functional.softplus(raw[0][:, :6])
            noise = torch.cholesky_solve(torch.diag_embed(b), self.factor(raw[1]))
            return torch.cat([torch.zeros(count, 7, 6), noise], 1)

    sde = TorchSpinn()
    y_0 = torch.zeros(count, 13)
    y_0[:, 0] = 1
    times = torch.linspace(0, STEPS * DT, STEPS + 1)

    def run() -> Any:
        sde.zero_grad()
        y = torchsde.sdeint(sde, y_0, times, method="euler_heun", dt=DT)
        loss = torch.mean(torch.square(torch.as_tensor(y)))
        loss.backward()
        return loss.detach()

    return run


def cases() -> dict[str, Callable[[], Any]]:
    """What is timed, by name; torchsde only where it is installed."""
    found: dict[str, Callable[[], Any]] = {
        "rollout and gradient": rollout_case(spinn()),
        "rollout and gradient, constant M": rollout_case(spinn(constant_mass=True)),
        "training step, geodesic FDM": step_case(spinn()),
        "training step, chordal FDM": step_case(spinn(), pose_kernel="chordal"),
    }
    if importlib.util.find_spec("torchsde") is not None:
        found["torchsde, Euler-Heun"] = torchsde_case()
    return found


def interleaved(found: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each case over rounds that time all of them in turn."""
    times: dict[str, list[float]] = {name: [] for name in found}
    for call in found.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in found.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            times[name].append(time.perf_counter() - began)
    return {name: float(np.median(t)) for name, t in times.items()}


@pytest.mark.benchmark(group="training step")
def test_ratios(benchmark: Any) -> None:
    """What is promised: 5 x torchsde's speed, and a step of at most 2 x its rollouts."""
    pytest.importorskip("torchsde")
    medians = benchmark.pedantic(interleaved, args=(cases(), 9), rounds=1)
    rollout = medians["rollout and gradient"]
    benchmark.extra_info.update({name: round(1e3 * t, 1) for name, t in medians.items()})
    assert medians["torchsde, Euler-Heun"] > 5 * rollout
    assert medians["training step, geodesic FDM"] < 2 * rollout


def main() -> None:
    """Print the table of docs/numerics.md."""
    found = cases()
    medians = interleaved(found, 15)
    base = medians["rollout and gradient"]
    lines = [f"{SCENARIOS} scenarios x {SAMPLES} samples x {STEPS} steps, {cores()} cores"]
    lines += [f"{n:34s} {1e3 * s:7.0f} ms {s / base:6.2f} rollouts" for n, s in medians.items()]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
