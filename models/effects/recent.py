"""History of recent twists, for delayed instruments."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

STEPS = 4
"""Number of stored steps; earlier motion is extrapolated."""


class Recent(eqx.Module):
    """The twist over the last steps relative to the current one: a cubic per step, latest first.

    Within a step V(t - τ) = V(t) - c₁ τ + c₂ τ²/2 + c₃ τ³, where t is the step's end.

    Attributes:
        bends: c₁ (m/s², rad/s²), c₂ (1/s more) and c₃ (1/s² more).
        step: lengths of the steps (s).
        V: the current twist that these steps predict, where recorded ones may differ from it.
        slope: Jacobian of the acceleration at V, ∂a/∂V (1/s; m/s and rad/s).
    """

    bends: Float[Array, "S 3 6 *batch"]
    step: Float[Array, "S 1 *batch"]
    V: Float[Array, "6 *batch"] | None = None
    slope: Float[Array, "6 6 *batch"] | None = None

    @classmethod
    def steady(
        cls,
        A_WB_B: Float[Array, "6 *batch"],
        step: float | Float[Array, "1 *#batch"],
    ) -> "Recent":
        """A constant acceleration (dV/dt by components); steps of `step` s will follow."""
        zero = jnp.zeros_like(A_WB_B)
        bends = jnp.stack([A_WB_B, zero, zero])
        step = jnp.broadcast_to(jnp.asarray(step, zero.dtype), zero[:1].shape)
        return cls(jnp.stack([bends] * STEPS), jnp.stack([step] * STEPS))

    @classmethod
    def over(
        cls,
        V0: Float[Array, "6 *#batch"],
        V1: Float[Array, "6 *#batch"],
        rates: Float[Array, "12 *#batch"],
        step: float | Float[Array, "1 *#batch"],
    ) -> "Recent":
        """One step of `step` s from V0 to V1, at whose end dV/dt and d²V/dt² are `rates`."""
        rate, second = rates[:6], rates[6:]
        third = (V0 - V1 + step * (rate - step / 2 * second)) / step**3
        bends = jnp.stack(jnp.broadcast_arrays(rate, second, third))[None]
        step = jnp.broadcast_to(jnp.asarray(step, bends.dtype), bends[0, 0, :1].shape)
        return cls(bends, step[None])

    def after(self, latest: "Recent") -> "Recent":
        """This history with the steps of `latest` added."""
        n = len(latest.step)
        return Recent(
            jnp.concatenate([latest.bends, self.bends[:-n]]),
            jnp.concatenate([latest.step, self.step[:-n]]),
            latest.V,
            latest.slope,
        )

    def keeping(self, V: Float[Array, "6 *batch"], slope: Float[Array, "6 6 *batch"]) -> "Recent":
        """The same with the predicted current twist and the Jacobian of the acceleration."""
        return Recent(self.bends, self.step, V, slope)

    def now(
        self, seen: Float[Array, "6 *#batch"], late: Float[Array, "#6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        """V(t) from the twist V(t - δ) that is `seen`, with the delay δ = `late` (s).

        It differs from the predicted one by disturbances and noise, which propagate to t with
        exp(∂a/∂V δ): exact within each component, of first order between components.
        """
        change = self.back(late)[0]
        V = seen - change
        if self.V is None or self.slope is None:
            return V
        late = jnp.broadcast_to(late, V.shape)
        own = jnp.stack([self.slope[i, i] for i in range(6)])
        apart = 1 - jnp.eye(6, dtype=own.dtype).reshape(6, 6, *(1,) * (own.ndim - 1))
        grown = jnp.minimum((own[:, None] + own[None]) / 2 * late[:, None], 1.0)
        between = apart * self.slope * late[:, None] * jnp.exp(grown)
        d = V - self.V
        alone = jnp.expm1(jnp.minimum(own * late, 1.0)) * d
        return V + alone + jnp.sum(between * d[None], axis=1)

    def back(
        self, late: Float[Array, "#6 *#batch"]
    ) -> tuple[Float[Array, "6 *#batch"], Float[Array, "6 *#batch"]]:
        """V(t - δ) - V(t), and its integral over the last δ = `late` s; δ < 0 is in the future.

        The future is extrapolated with the current derivatives, the past with the first step's.
        """
        change = way = jnp.zeros_like(self.bends[0, 0])
        last = len(self.step) - 1
        for i, (bends, step) in enumerate(zip(self.bends, self.step, strict=True)):
            t = late if i == 0 else jnp.maximum(late, 0.0)
            t = t if i == last else jnp.minimum(t, step)
            late = late - t
            third = jnp.maximum(t, 0.0) ** 3 * bends[2]
            way = way + t * change - t**2 / 2 * (bends[0] - t / 3 * bends[1]) + t / 4 * third
            change = change - t * (bends[0] - t / 2 * bends[1]) + third
        return change, way
