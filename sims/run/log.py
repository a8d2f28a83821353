"""The log of a run: a Recording of the true motion, with the estimates and the plans.

Besides the variables of every recording (`docs/recording.md`) a run's log holds, over its time:

- `X_WB_estimate`, `V_WB_B_estimate`: the filter's estimates; `error_std` (15 + n): their standard
  deviations in the order of `systems.estimation.error_state`; `error_covariance` (27): covariances
  of δp, δθ and δv, each 3 × 3 by rows, both as the filter estimates them;
- `nis`, `rejected` (n): normalised innovation squared of the last reading of each fused sensor, and
  the number of consecutive rejections;
- `health` (2 + n), if the filter has such a port: 0 good, 1 degraded, 2 lost, then 1 where it
  trusts the imu and each fused sensor;
- `X_WB_plan`, `V_WB_B_plan`: the plan at that time; `plan_valid`: 1 where there was one;
- `maneuver` (5), of the controller `!Maneuvers`: its port (`systems.controllers.maneuvers`);
- `F_disturbance_Bo_B` (N, N·m), `flow_W` (velocity m/s, acceleration m/s²): disturbances and flow;

and for every plan (dim `plan`): `plan_time` (s), `plan_X_WB`, and with a sampling planner also
`sample_p_WB`, `sample_weight` and `planner_figures`. Attributes: `allowed_risk` of the planner's
chance constraint, `least_risk`, that of the widest path to the goal, `fused`, the names of the n
fused sensors if they are not `FUSED`, and `depth_only` of a simulated vehicle that held its depth
without a position.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...models.recordings.build import Trajectory
from ...models.recordings.store import Recording

FUSED = ("dvl", "depth", "compass")
"""Sensors whose readings the filter fuses by default, in the order of `nis` and `rejected`."""


@dataclass(frozen=True)
class Plans:
    """Every plan of a run, decimated in time for figures and replays.

    Attributes:
        time: when each was made (s).
        dt: between the decimated states (s).
        X_WB: planned poses; the first is the estimate at that time.
        p_WB: positions of sampled paths (m, W), at `dt`, 2 `dt`, … after `time`.
        weights: of the sampled paths.
        figures: the planner's figures of merit (`systems.planning.mppi.FIGURES`).
        allowed: probability of a collision that the planner's chance constraint allows.
    """

    time: Float[np.ndarray, " plans"]
    dt: float
    X_WB: Float[np.ndarray, "plans steps 7"]
    p_WB: Float[np.ndarray, "plans sampled 3 paths"] | None = None
    weights: Float[np.ndarray, "plans paths"] | None = None
    figures: Float[np.ndarray, "plans figures"] | None = None
    allowed: float | None = None

    def at(self, t: float) -> int | None:
        """Index of the plan that was the newest at time t, None before the first."""
        index = int(np.searchsorted(self.time, t + 1e-9, side="right")) - 1
        return None if index < 0 else index


_PLAN_DIMS = {
    "plan_X_WB": ("plan", "plan_step", "pose_component"),
    "sample_p_WB": ("plan", "sample_step", "axis", "sample_path"),
    "sample_weight": ("plan", "sample_path"),
    "planner_figures": ("plan", "planner_figure"),
}


@dataclass(frozen=True)
class RunLog:
    """A recording of a single run with the additional variables of this module."""

    recording: Recording

    @classmethod
    def create(
        cls,
        scenario: str,
        dt: float,
        variables: Mapping[str, np.ndarray],
        plans: Plans | None = None,
        *,
        vehicle: str = "",
        source: str = "",
        notes: tuple[str, ...] = (),
        least_risk: float | None = None,
        fused: tuple[str, ...] = FUSED,
        start: float = 0.0,
        depth_only: bool = False,
    ) -> "RunLog":
        """Build from arrays with time first; `variables` holds at least X_WB, V_WB_B, F_Bo_B.

        `least_risk` is the probability of a collision on the widest path to the goal; `fused` are
        the names of the sensors that the filter fuses; `start` is the time of the first sample on
        the vehicle's clock (s), NaN if unknown. `depth_only` says that the controller held depth
        and attitude without a position, so that the depth alone is judged.
        """
        rest = dict(variables)
        X, V = rest.pop("X_WB"), rest.pop("V_WB_B")
        commands = {name: rest.pop(name) for name in ("F_Bo_B", "pwm") if name in rest}
        recording = Recording.from_trajectories(
            [Trajectory(scenario, X, V, commands, rest, start)],
            dt,
            vehicle=vehicle,
            source=source,
            notes=notes,
        )
        dataset = recording.dataset
        if plans is not None:
            dataset = dataset.assign(_plan_variables(plans))
            dataset.attrs["plan_dt"] = float(plans.dt)
            if plans.allowed is not None:
                dataset.attrs["allowed_risk"] = float(plans.allowed)
        if least_risk is not None:
            dataset.attrs["least_risk"] = float(least_risk)
        if depth_only:
            dataset.attrs["depth_only"] = 1
        if fused != FUSED:
            dataset.attrs["fused"] = ",".join(fused)
        return cls(Recording(dataset))

    def __contains__(self, name: str) -> bool:
        return name in self.recording.dataset

    def __getitem__(self, name: str) -> np.ndarray:
        """A variable over time, time first."""
        return self.recording.dataset[name].to_numpy()[0, 0]

    @property
    def time(self) -> Float[np.ndarray, " n"]:
        """Times of the samples (s)."""
        return self.recording.dataset["time"].to_numpy()

    @property
    def dt(self) -> float:
        """Step (s)."""
        return self.recording.dt

    @property
    def placed(self) -> bool:
        """Whether x and y of the vehicle are known at any time."""
        return bool(np.isfinite(self["X_WB"][:, 4:6]).all(axis=1).any())

    @property
    def depth_only(self) -> bool:
        """Whether the depth alone is judged, as the vehicle did not know its x and y."""
        return bool(self.recording.dataset.attrs.get("depth_only", 0)) or not self.placed

    @property
    def least_risk(self) -> float | None:
        """Probability of a collision on the widest path to the goal, if there is a goal."""
        return self._attribute("least_risk")

    @property
    def fused(self) -> tuple[str, ...]:
        """Names of the sensors that the filter fuses."""
        return tuple(str(self.recording.dataset.attrs.get("fused", ",".join(FUSED))).split(","))

    def _attribute(self, name: str) -> float | None:
        value = self.recording.dataset.attrs.get(name)
        return None if value is None else float(value)

    @property
    def plans(self) -> Plans | None:
        """The plans, if any were made."""
        data = self.recording.dataset
        if "plan_X_WB" not in data:
            return None
        arrays = {n: data[n].to_numpy() if n in data else None for n in _PLAN_DIMS}
        return Plans(
            data["plan_time"].to_numpy(),
            float(data.attrs["plan_dt"]),
            data["plan_X_WB"].to_numpy(),
            arrays["sample_p_WB"],
            arrays["sample_weight"],
            arrays["planner_figures"],
            self._attribute("allowed_risk"),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write as a recording (NetCDF), atomically."""
        self.recording.save(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "RunLog":
        """Read what `save` wrote.

        Raises:
            UserError: the file is missing or not a recording.
        """
        return cls(Recording.load(path))


def without_horizontal(X: np.ndarray, V: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States without what a vehicle without a horizontal aid can't know, and its climb (m/s).

    As in an imported log: w is the part of the climb along the body's axis.
    """
    X, V = X.copy(), V.copy()
    R = Rotation.from_quat(X[:, :4], scalar_first=True)
    climb = R.apply(V[:, :3])[:, 2]
    X[:, 4:6] = np.nan
    V[:, :2] = np.nan
    V[:, 2] = climb * R.as_matrix()[:, 2, 2]
    return X, V, climb


def _plan_variables(plans: Plans) -> dict[str, xr.DataArray]:
    arrays = {
        "plan_X_WB": plans.X_WB,
        "sample_p_WB": plans.p_WB,
        "sample_weight": plans.weights,
        "planner_figures": plans.figures,
    }
    made = {
        name: xr.DataArray(values, dims=_PLAN_DIMS[name])
        for name, values in arrays.items()
        if values is not None
    }
    made["plan_time"] = xr.DataArray(plans.time, dims=("plan",), attrs={"units": "s"})
    return made
