"""From a simulated diagram's signals to one log on a uniform grid."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System
from pydrake.systems.primitives import LogVectorOutput

from ...systems.closed_loop import Signal
from ...systems.compiled.signal_log import add_log
from ...systems.estimation.error_state import POSITION, ROTATION, VELOCITY
from ...systems.estimation.state import status_names
from ...systems.planning.passage import Passage
from ...systems.planning.plan import PlanLayout
from ..scenarios.maneuvers import Maneuvers
from ..scenarios.scenario import Scenario
from .log import Plans, RunLog

_PLAN_STEP = 0.2  # s between the stored states of a plan
_NOTES = (
    "X_WB and V_WB_B are the simulation's truth, not an estimate.",
    "F_Bo_B is the mean over each step of the wrench commanded of the thrusters; their lag is not "
    "in it. pwm is the command that they had at the sample.",
    "flow_W and F_disturbance_Bo_B are known in simulation only.",
)


_RATED = (
    "X_WB",
    "V_WB_B",
    "covariance",
    "status",
    "health",
    "X_WB_cheat",
    "V_WB_B_cheat",
    "F_disturbance_cheat",
    "flow_cheat",
    "maneuver",
)
_OF_FILTER = ("covariance", "status")


def log_periods(scenario: Scenario) -> dict[str, float]:
    """Logging period of each port of station and controller (s)."""
    ends = isinstance(scenario.controller, Maneuvers)  # then the commands of a step are logged too
    names = {*_RATED, *(("pwm",) if ends else ())}
    names -= set(() if scenario.log.covariance else _OF_FILTER)
    return dict.fromkeys(sorted(names), 1 / scenario.log.rate)


def log_commands(scenario: Scenario) -> Callable[[DiagramBuilder, System, System], None]:
    """Adds logs of the commands that act on the plant to a diagram.

    The plant advances from t under the commands from before the updates at t. The wrench is logged
    at the plant's own events, where Drake publishes this value.
    """

    def extend(builder: DiagramBuilder, station: System, controller: System) -> None:
        F, pwm = controller.GetOutputPort("F_Bo_B"), station.GetOutputPort("pwm")
        LogVectorOutput(F, builder, scenario.station.period).set_name("log_F_acting")
        add_log(builder, pwm, "pwm_acting", 1 / scenario.log.rate, early=True)

    return extend


def plan_source(diagram: Diagram) -> Any:
    """The system with the port `plan` that a closed loop's controller follows; None without one.

    It is the controller or its subsystem `source`, and has the plan's `PlanLayout` as `layout`.
    """
    source: Any = diagram.GetSubsystemByName("controller")
    if isinstance(source, Diagram) and source.HasSubsystemNamed("source"):
        source = source.GetSubsystemByName("source")
    layout: Any = getattr(source, "layout", None)
    if not isinstance(layout, PlanLayout) or not source.HasOutputPort("plan"):
        return None
    return source if source.GetOutputPort("plan").size() == layout.size else None


class PlanTap:
    """Keeps every plan of a controller, with its planner's samples and figures.

    It keeps nothing for a controller without plans (`plan_source`).
    """

    def __init__(self, diagram: Diagram, root: Context, samples: bool = True):
        self.source = source = plan_source(diagram)
        self.kept: list[dict[str, np.ndarray]] = []
        if source is not None:
            self._context = source.GetMyContextFromRoot(root)
            names = ["plan"]
            if hasattr(source, "planner"):
                names += ["samples", "figures"] if samples else ["figures"]
            self._ports: dict[str, Any] = {name: source.GetOutputPort(name) for name in names}

    @property
    def period(self) -> float | None:
        """Period of the planner's calls (s), None without a planner."""
        planner = getattr(self.source, "planner", None)
        return None if planner is None else float(planner.config.period)

    def read(self, t: float) -> None:
        """Keep the present plan if it is new; `t` (s) is its time if it is not valid."""
        if self.source is None:
            return
        plan: np.ndarray = self._ports["plan"].Eval(self._context)
        if self.kept and np.array_equal(plan, self.kept[-1]["plan"], equal_nan=True):
            return
        found = {name: port.Eval(self._context).copy() for name, port in self._ports.items()}
        valid = np.isfinite(plan).all() and plan[1:5] @ plan[1:5] > 0.25
        self.kept.append(found | {"time": np.array(plan[0] if valid else t), "valid": valid})

    def setpoints(self, grid: Float[np.ndarray, " n"]) -> dict[str, np.ndarray]:
        """The plan at every time of the grid, as the tracking controller reads it.

        A plan made at t is available to reads after t.
        """
        if self.source is None:
            return {}
        X, V = np.tile([1.0, 0, 0, 0, 0, 0, 0], (grid.size, 1)), np.zeros((grid.size, 6))
        valid = np.zeros(grid.size)
        if self.kept:
            times = np.array([call["time"] for call in self.kept])
            index = np.searchsorted(times, grid - 1e-9) - 1
            vectors = np.stack([call["plan"] for call in self.kept])[np.maximum(index, 0)]
            wanted = jax.jit(jax.vmap(self.source.layout.at))(
                jnp.asarray(vectors), jnp.asarray(grid)
            )
            there = np.asarray(wanted.valid) & (index >= 0)
            X = np.where(there[:, None], np.asarray(wanted.X_WB), X)
            V = np.where(there[:, None], np.asarray(wanted.V_WB_B), V)
            valid = there.astype(float)
        return {"X_WB_plan": X, "V_WB_B_plan": V, "plan_valid": valid}

    def plans(self, end: float) -> Plans | None:
        """Every valid plan made before `end` (s), decimated in time."""
        calls = [call for call in self.kept if call["valid"] and call["time"] < end + 1e-9]
        if not calls:
            return None
        layout = self.source.layout
        stride = max(1, min(round(_PLAN_STEP / layout.dt), layout.horizon))
        stop = 1 + 13 * (layout.horizon + 1)
        states = np.stack([call["plan"][1:stop].reshape(-1, 13)[::stride, :7] for call in calls])
        extra = {}
        if "samples" in calls[0]:
            unpacked = [self.source.samples.unpack(jnp.asarray(call["samples"])) for call in calls]
            sampled = [np.asarray(s.p_WB, np.float32)[stride - 1 :: stride] for s in unpacked]
            extra["p_WB"] = np.stack(sampled)
            extra["weights"] = np.stack([np.asarray(s.weights) for s in unpacked])
        if "figures" in calls[0]:
            extra["figures"] = np.stack([call["figures"] for call in calls])
            extra["allowed"] = self.source.planner.config.collision_risk
        times = np.array([float(call["time"]) for call in calls])
        return Plans(times, stride * layout.dt, states, **extra)


def collect(
    scenario: Scenario,
    signals: Mapping[str, Signal],
    tap: PlanTap,
    end: float,
    passage: Passage | None = None,
    depth_only: bool = False,
) -> RunLog:
    """One log of all signals from 0 to `end` (s), with the attribute `depth_only` (`RunLog`)."""
    dt = 1 / scenario.log.rate
    n = min(round(end / dt) + 1, len(signals["X_WB_cheat"].time))
    finite = np.all(np.isfinite(signals["X_WB_cheat"].value[:n]), axis=1)
    n = n if finite.all() else max(1, int(np.argmin(finite)))
    grid = dt * np.arange(n)
    fused = scenario.station.sensing.fused
    variables = {
        "X_WB": signals["X_WB_cheat"].value[:n],
        "V_WB_B": signals["V_WB_B_cheat"].value[:n],
        "F_Bo_B": mean_over(signals["F_acting"], grid, dt),
        "pwm": signals["pwm_acting"].value[:n],
        "X_WB_estimate": signals["X_WB"].value[:n],
        "V_WB_B_estimate": signals["V_WB_B"].value[:n],
        "F_disturbance_Bo_B": signals["F_disturbance_cheat"].value[:n],
        "flow_W": signals["flow_cheat"].value[:n],
    }
    if "covariance" in signals:
        variables |= consistency(signals, n, fused)
    for name in ("health", "maneuver"):
        if name in signals:
            variables[name] = signals[name].value[:n]
    return RunLog.create(
        scenario.name,
        dt,
        variables | tap.setpoints(grid),
        tap.plans(float(grid[-1])),
        vehicle=scenario.station.vehicle,
        source=f"simulation of scenario {scenario.name}, seed {scenario.seed}",
        notes=_NOTES,
        least_risk=None if passage is None else passage.risk,
        fused=fused,
        depth_only=depth_only,
    )


def consistency(
    signals: Mapping[str, Signal], n: int, fused: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """What the filter says of its errors, up to row n.

    Standard deviations and covariances of the errors, and of each fused sensor the last NIS and the
    rejections in a row.
    """
    P = signals["covariance"].value[:n]
    P = P.reshape(n, math.isqrt(P.shape[1]), -1)
    blocks = [P[:, part, part].reshape(-1, 9) for part in (POSITION, ROTATION, VELOCITY)]
    status, names = signals["status"].value[:n], status_names(fused)
    told = {
        kind: status[:, [names.index(f"{kind}_{name}") for name in fused]]
        for kind in ("nis", "rejected")
    }
    return told | {
        "error_std": np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0)),
        "error_covariance": np.concatenate(blocks, axis=1),
    }


def mean_over(
    signal: Signal, grid: Float[np.ndarray, " n"], dt: float
) -> Float[np.ndarray, "n size"]:
    """Mean of the finite samples of a faster signal over [t, t + dt) for every t of the grid."""
    index = np.clip(np.floor(signal.time / dt + 1e-6).astype(int), 0, None)
    inside = (index < grid.size) & np.all(np.isfinite(signal.value), axis=1)
    total = np.zeros((grid.size, signal.value.shape[1]))
    count = np.zeros(grid.size)
    np.add.at(total, index[inside], signal.value[inside])
    np.add.at(count, index[inside], 1)
    return total / np.maximum(count, 1)[:, None]
