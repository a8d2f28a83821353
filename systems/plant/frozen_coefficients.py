"""A model whose coefficients are evaluated once for several substeps."""

from jaxtyping import Array, Float

from ...models.dynamics import Coefficients, Dynamics, Flow
from ...models.spd import Spd


class FrozenCoefficients(Dynamics):
    """The given dynamics with M, D, D^f and b frozen at their values for one velocity.

    They change slowly with the velocity, while the drag and the potential that they enter are
    stiff: substeps with frozen coefficients are cheap and stable where one step is not. The noise
    of a frozen b has no Stratonovich correction, which is of the order of b ∂b/∂ξ dt.
    """

    dynamics: Dynamics
    held: Coefficients
    rigid_inertia: Float[Array, "6 6"]
    displaced_mass: Float[Array, ""]
    p_BoCb_B: Float[Array, "3"]

    def __init__(self, dynamics: Dynamics, V_WB_B: Float[Array, "6 *batch"]):
        self.dynamics, self.held = dynamics, dynamics.coefficients(V_WB_B)
        self.rigid_inertia = dynamics.rigid_inertia
        self.displaced_mass, self.p_BoCb_B = dynamics.displaced_mass, dynamics.p_BoCb_B

    @property
    def stochastic(self) -> bool:
        return self.dynamics.stochastic

    def coefficients(self, V_WB_B: Float[Array, "6 *#batch"]) -> Coefficients:
        del V_WB_B
        return self.held

    def mass_and_diffusion(
        self, V_WB_B: Float[Array, "6 *#batch"]
    ) -> tuple[Spd, Float[Array, "6 *#batch"]]:
        del V_WB_B
        return self.held.mass, self.held.diffusion

    def potential(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "*#batch"]:
        return self.dynamics.potential(X_WB)

    def potential_wrench(self, X_WB: Float[Array, "7 *#batch"]) -> Float[Array, "6 *#batch"]:
        return self.dynamics.potential_wrench(X_WB)

    def displace(
        self, X_WB: Float[Array, "7 *#batch"], twist_dt: Float[Array, "6 *#batch"]
    ) -> Float[Array, "7 *#batch"]:
        return self.dynamics.displace(X_WB, twist_dt)

    def correlate(
        self, V_WB_B: Float[Array, "6 *#batch"], dW: Float[Array, "6 *#batch"]
    ) -> Float[Array, "6 *#batch"]:
        return self.dynamics.correlate(V_WB_B, dW)

    def drag_wrench(
        self, V_CB_B: Float[Array, "6 *#batch"], coefficients: Coefficients | None = None
    ) -> Float[Array, "6 *#batch"]:
        return self.dynamics.drag_wrench(V_CB_B, coefficients or self.held)

    def balance(
        self,
        X_WB: Float[Array, "7 *#batch"],
        V_WB_B: Float[Array, "6 *#batch"],
        F_Bo_B: Float[Array, "6 *#batch"],
        flow: Flow | None = None,
        coefficients: Coefficients | None = None,
    ) -> tuple[Spd, Float[Array, "6 *#batch"]]:
        return self.dynamics.balance(X_WB, V_WB_B, F_Bo_B, flow, coefficients or self.held)

    def noise_acceleration(
        self,
        V_WB_B: Float[Array, "6 *#batch"],
        dW: Float[Array, "6 *#batch"],
        coefficients: tuple[Spd, Array] | None = None,
    ) -> Float[Array, "6 *#batch"]:
        own = coefficients or (self.held.mass, self.held.diffusion)
        return self.dynamics.noise_acceleration(V_WB_B, dW, own)
