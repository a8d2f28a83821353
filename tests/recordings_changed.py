"""Recordings with one thing changed, for the tests of the checks."""

import numpy as np
import xarray as xr

from spinndrift.models.recordings.store import Recording
from spinndrift.models.se3 import WRENCH
from spinndrift.models.vehicles.vehicle import Vehicle


def changed(recording: Recording, name: str, change) -> Recording:
    """A variable replaced by `change` of its values (scenario, trajectory, time, …)."""
    old = recording.dataset[name]
    values = np.where(recording.mask[..., None], np.nan_to_num(change(old.to_numpy())), np.nan)
    return Recording(recording.dataset.assign({name: (old.dims, values, old.attrs)}))


def as_wrench(recording: Recording, vehicle: Vehicle) -> Recording:
    """The same motion with the wrench as its command."""
    F = recording.wrench(vehicle).to_numpy()
    dims = ("scenario", "trajectory", "time", "wrench_component")
    bare = recording.dataset.drop_vars(recording.commands)
    dataset = bare.assign(F_Bo_B=xr.Variable(dims, F, {"units": "N, N m"}))
    return Recording(dataset.assign_coords(wrench_component=list(WRENCH)))
