"""Rates of the true vehicle: Fossen's equations with whatever effects are hidden in it.

    η̇ = J(η) ν,   M_RB ν̇ + C_RB(ν) ν + M_A (ν̇ − ν̇_c) + C_A(ν_r) ν_r + d(ν_r) + g(η) = τ + τ_FK + w

(Fossen 2011, eqs. 3.42, 6.1, 8.6), ν_r = ν − ν_c, C(ν) ν = (ω × A, v × A + ω × B) with (A, B) = M ν
(eq. 3.46), and τ_FK the Froude–Krylov force of accelerated water on the displaced mass.
"""

from collections.abc import Sequence

import numpy as np

from .effect import Effect, Latent, Moment
from .rotations import cross, rate, to_body, to_world, up_in_body
from .vehicle import GRAVITY, Vehicle


class Plant:
    """Vehicle with effects: rates of p, q, ν, thrust and the effects' own states."""

    def __init__(self, vehicle: Vehicle, effects: Sequence[Effect]):
        self.effects = sorted((e for e in effects if not e.neutral()), key=lambda e: e.order)
        for effect in self.effects:
            vehicle = effect.alter(vehicle)
        self.vehicle = vehicle
        self.rigid, self.added = vehicle.rigid_mass(), vehicle.added_mass
        self.inverse = np.linalg.inv(self.rigid + self.added)
        self.allocation = vehicle.allocation()
        none = np.zeros(vehicle.directions.shape[1])
        self.lag = sum((e.lag() for e in self.effects), none)
        self.delay = sum((e.delay() for e in self.effects), none)
        self.shifts = {k: s for e in self.effects for k, s in e.shift().items()}
        self.lagged = bool(np.any(self.lag > 0))
        self.own: dict[int, slice] = {}
        size = 13 + 8 * self.lagged
        for i, effect in enumerate(self.effects):
            self.own[i] = slice(size, size + effect.states)
            size += effect.states
        self.size = size

    def steady_thrust(self, u: np.ndarray, volts: np.ndarray, t: float = 0.0) -> np.ndarray:
        for effect in self.effects:
            u = effect.distort_at(u, volts, t)
        return u

    def follow(self, before: np.ndarray, u: np.ndarray, h: float) -> np.ndarray:
        for effect in self.effects:
            u = effect.follow(before, u, h)
        return u

    def followed(self, held: np.ndarray, h: float) -> np.ndarray:
        """`follow` over commands by inner step (steps, 8, B), from a drive at rest."""
        if all(type(e).follow is Effect.follow for e in self.effects):
            return held
        taken = np.empty_like(held)
        before = np.zeros_like(held[0])
        for i, u in enumerate(held):
            taken[i] = before = self.follow(before, u, h)
        return taken

    def flow(self, p: np.ndarray, t: float, latents: dict[int, Latent]) -> tuple | None:
        total = None
        for i, effect in enumerate(self.effects):
            found = effect.flow(p, t, latents[i])
            if found is not None:
                total = found if total is None else (total[0] + found[0], total[1] + found[1])
        return total

    def rates(
        self, y: np.ndarray, t: float, thrust: np.ndarray, latents: dict[int, Latent]
    ) -> np.ndarray:
        """ẏ under the propellers' thrust (8, B) at no inflow."""
        vehicle = self.vehicle
        p, q, nu = y[:3], y[3:7], y[7:13]
        v, w = nu[:3], nu[3:]
        up = up_in_body(q)
        water = self.flow(p, t, latents)
        nu_r, v_c = nu, np.zeros_like(v)
        if water is not None:
            v_c = to_body(q, water[0])
            nu_r = np.concatenate([v - v_c, w])
        now = Moment(t, p, q, nu, up, nu_r, vehicle, latents)

        wrench = self.allocation @ self._loaded(thrust, nu_r)

        rigid, added = self.rigid @ nu, self.added @ nu_r
        both = rigid + added
        wrench[:3] -= cross(w, both[:3])
        wrench[3:] -= cross(w, both[3:]) + cross(v, rigid[:3])
        wrench[3:] -= vehicle.munk * cross(nu_r[:3], added[:3])
        wrench -= (vehicle.linear[:, None] + vehicle.quadratic[:, None] * np.abs(nu_r)) * nu_r
        wrench[:3] += (vehicle.buoyancy - vehicle.weight) * up
        lever = vehicle.buoyancy * vehicle.r_b - vehicle.weight * vehicle.r_g
        wrench[3:] += cross(lever[:, None], up)
        if water is not None:
            a_c = to_body(q, water[1])
            wrench += self.added[:, :3] @ (a_c - cross(w, v_c))
            krylov = vehicle.buoyancy / GRAVITY * a_c
            wrench[:3] += krylov
            wrench[3:] += cross(vehicle.r_b[:, None], krylov)
        for i, effect in enumerate(self.effects):
            extra = effect.wrench(now, latents[i], y[self.own[i]])
            if extra is not None:
                wrench += extra

        dy = np.empty_like(y)
        dy[:3] = to_world(q, v)
        dy[3:7] = rate(q, w)
        dy[7:13] = self.inverse @ wrench
        if self.lagged:
            dy[13:21] = 0.0
        for i, effect in enumerate(self.effects):
            if effect.states:
                dy[self.own[i]] = effect.derivative(now, dy[7:13], latents[i], y[self.own[i]])
        return dy

    def _loaded(self, thrust: np.ndarray, nu_r: np.ndarray) -> np.ndarray:
        inflow = [e for e in self.effects if type(e).load is not Effect.load]
        if inflow:
            axial = self.allocation.T @ nu_r  # e · (v + ω × r) = (e, r × e) · (v, ω)
            for effect in inflow:
                thrust = effect.load(thrust, axial)
        return thrust

    def step(
        self, y: np.ndarray, t: float, h: float, steady: np.ndarray, latents: dict[int, Latent]
    ) -> np.ndarray:
        """One step of the classical Runge–Kutta method; lags follow `steady` exactly."""
        begin, middle, end, follows = self._lagging(y, h, steady)
        k1 = self.rates(y, t, begin, latents)
        k2 = self.rates(y + 0.5 * h * k1, t + 0.5 * h, middle, latents)
        k3 = self.rates(y + 0.5 * h * k2, t + 0.5 * h, middle, latents)
        k4 = self.rates(y + h * k3, t + h, end, latents)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if self.lagged:
            y[13:21] = follows
        y[3:7] /= np.sqrt(np.sum(y[3:7] ** 2, axis=0))
        return y

    def _lagging(self, y: np.ndarray, h: float, steady: np.ndarray) -> tuple[np.ndarray, ...]:
        """Thrust at begin, middle and end of a step with a standing command, and after it.

        The middle is such that Simpson's rule gives the exact impulse; of a lag much shorter than
        the step only the mean is left.
        """
        if not self.lagged:
            return steady, steady, steady, steady
        lags = self.lag[:, None] > 0
        off = np.where(lags, y[13:21] - steady, 0.0)
        part = h / np.where(lags, self.lag[:, None], 1.0)
        left = np.where(lags, np.exp(-part), 0.0)
        mean = (1 - left) / part
        short = part > 2
        first, last = np.where(short, mean, 1.0), np.where(short, mean, left)
        middle = np.where(short, mean, (6 * mean - 1 - left) / 4)
        factors = (first, middle, last, left)
        return tuple(steady + factor * off for factor in factors)

    def kick(
        self, y: np.ndarray, t: float, b: np.ndarray, dW: np.ndarray, latents: dict[int, Latent]
    ) -> np.ndarray:
        """Give the impulse b(ν) ∘ dW."""
        first = self._intensity(y, t, b, latents)
        out = y.copy()
        out[7:13] += self.inverse @ (first * dW)
        if any(type(e).diffusion is not Effect.diffusion for e in self.effects):
            second = self._intensity(out, t, b, latents)
            out[7:13] = y[7:13] + self.inverse @ (0.5 * (first + second) * dW)
        return out

    def knock(self, y: np.ndarray, h: float, own: Sequence[np.random.Generator]) -> np.ndarray:
        """Give the sudden impulses of an inner step."""
        for effect, rng in zip(self.effects, own, strict=True):
            impulse = effect.impulse(y.shape[1], h, rng)
            if impulse is not None:
                y = y.copy()
                y[7:13] += self.inverse @ impulse
        return y

    def _intensity(
        self, y: np.ndarray, t: float, b: np.ndarray, latents: dict[int, Latent]
    ) -> np.ndarray:
        changing = [e for e in self.effects if type(e).diffusion is not Effect.diffusion]
        if not changing:
            return b
        water = self.flow(y[:3], t, latents)
        nu_r = y[7:13].copy()
        if water is not None:
            nu_r[:3] -= to_body(y[3:7], water[0])
        b = b + np.zeros_like(nu_r)
        for effect in changing:
            b = effect.diffusion(b, nu_r)
        return b


def delayed(held: np.ndarray, i: int, delay: np.ndarray, h: float) -> np.ndarray:
    """Mean of the delayed commands over inner step i."""
    if not delay.any():
        return held[i]
    whole = np.floor(delay / h + 1e-9).astype(int)
    part = delay / h - whole
    rows = np.arange(8)

    def back(k: np.ndarray) -> np.ndarray:
        return np.where((i - k >= 0)[:, None], held[np.maximum(i - k, 0), rows], 0.0)

    return (1 - part)[:, None] * back(whole) + part[:, None] * back(whole + 1)
