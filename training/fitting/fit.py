"""Training: minibatches of windows, Adam, bit-exact checkpoints, recovery of non-finite steps."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...models.config.errors import UserError
from ...models.dynamics import Dynamics
from ...models.files.checkpoint import save_model
from ...models.files.interrupts import interrupt_noted
from ..config import TrainingConfig
from ..data.groups import group_labels, members, step_indices, whole_groups
from ..data.provenance import fingerprint, provenance
from ..data.windows import Windows
from ..losses.base import Batch, Objective
from .guard import Diagnosis, TrainingError, explain_non_finite, few_running_away, not_finite
from .run_folder import RunFolder, TrainState
from .step import (
    Report,
    TrainStep,
    first_moments,
    learning_rate,
    mean_over_devices,
    on_all,
    partition,
    usable_devices,
)

Progress = Callable[[int, int, float], None]
"""Called after every step with steps done, steps in all, and the loss."""

_log = logging.getLogger(__name__)
_VALIDATION_WINDOWS = 96
_REGROWTH = 2.0 ** (1 / 50)
"""Factor by which a rate that was cut grows after every good step, up to the schedule's."""
_FLUSH_EVERY = 20


@dataclass(frozen=True)
class TrainingResult:
    """Result of a run.

    Attributes:
        model: the best model on the validation windows, including the starting one; without
            validation windows the last one.
        last: the model after the last step.
        steps: steps done, including those of earlier parts of a resumed run.
        best_step: number of steps after which `model` was reached.
        metrics: columns of metrics.csv by name (only this process' rows without a folder).
        events: recoveries, each with its step and a description.
        seconds: time spent in training.
        stopped_early: whether `patience` ended it.
        refits: steps before which bandwidths were refitted; losses before and after have different
            scales.
    """

    model: Dynamics
    last: Dynamics
    steps: int
    best_step: int
    metrics: dict[str, np.ndarray]
    events: tuple[dict[str, Any], ...]
    seconds: float
    stopped_early: bool
    refits: tuple[int, ...] = ()


def fit(
    config: TrainingConfig,
    model: Dynamics,
    windows: Windows,
    out_dir: str | Path | None = None,
    *,
    validation: Windows | None = None,
    progress: Progress | None = None,
    resume: bool = False,
    metadata: dict[str, Any] | None = None,
) -> TrainingResult:
    """Train all arrays of `model` that receive a gradient.

    `validation` windows select the best model; evaluate the result on other ones. With `out_dir`
    the run writes checkpoint.npz, metrics.csv, config.yaml, run.json and model.spinn (with
    `metadata`). With `resume` a checkpoint there is continued; the result is bit-identical to that
    of an uninterrupted run. On the first Ctrl-C the current step is completed, a checkpoint is
    written and KeyboardInterrupt is raised.

    Raises:
        UserError: the starting model or all windows are not finite, or the checkpoint doesn't fit.
        TrainingError: more non-finite steps than `max_recoveries`; the last good state is saved.

    Example:
        >>> vehicle = load_vehicle("bluerov2_heavy")
        >>> recording = generate(GenerateConfig(trajectories=1, duration=4.0), vehicle)
        >>> config = TrainingConfig(steps=2, batch=4)
        >>> physics = vehicle.dynamics(dtype=np.float32)
        >>> start = Spinn.create(config.model, physics, jax.random.key(0))
        >>> fit(config, start, make_windows(recording, length_s=1.0)).steps
        2
    """
    return Run(config, model, windows, out_dir, validation, metadata).go(progress, resume)


class Run:
    """State of one run, and its operations between the compiled steps (`fit`, `fit_ensemble`)."""

    def __init__(
        self,
        config: TrainingConfig,
        model: Dynamics,
        windows: Windows,
        out_dir: str | Path | None,
        validation: Windows | None,
        metadata: dict[str, Any] | None,
    ):
        if broken := not_finite(model):
            raise UserError(f"model: parameter {', '.join(broken)} is not finite at the start")
        self.config, self.windows, self.metadata = config, windows, metadata
        self.folder = None if out_dir is None else RunFolder(out_dir)
        params, self.static = partition(model)
        # copies, as the step donates its inputs and the caller keeps its arrays
        self.state = TrainState(
            params=jax.tree.map(jnp.array, params),
            moments=first_moments(config, params),
            objective=config.objective.build(model, windows),
            best=jax.tree.map(jnp.array, params),
        )
        self.snapshot = (self.state.arrays(), self.state.plain())
        self.data = Batch.of(windows)
        self.data_id = fingerprint(windows)
        self.labels = group_labels(windows)
        self.validation = (
            None
            if validation is None
            else Batch.of(
                whole_groups(validation, self.state.objective.group_size(), _VALIDATION_WINDOWS)
            )
        )
        self.rows: list[dict[str, Any]] = []
        self.unwritten: list[dict[str, Any]] = []
        self.bad_in_a_row = 0
        self.began = time.monotonic()
        self.loss = float("nan")

    # the loop

    def begin(self, resume: bool) -> None:
        """Open the folder, and with `resume` load its checkpoint."""
        state = self.state
        if self.folder is not None:
            if resume and self.folder.checkpoint.exists():
                self.folder.load(state, self.config, self.data_id)
            self.folder.begin(self.config, provenance(self.windows))
            self.folder.begin_metrics(state.step)
        if state.step == 0:
            state.best_value = self._score(state.best)
        self.snapshot = (state.arrays(), state.plain())
        self.began = time.monotonic() - state.seconds

    def go(self, progress: Progress | None, resume: bool) -> TrainingResult:
        """Take all remaining steps."""
        self.begin(resume)
        devices = usable_devices(self.state.objective, self.config.batch)
        step = TrainStep(self.config, self.state.params, self.static, devices)
        stopped = False
        with interrupt_noted() as interrupted:
            try:
                while self.state.step < self.config.steps and not stopped:
                    plan = self.plan()
                    stopped = self.take(plan, *step(*plan))
                    if progress is not None:
                        progress(self.state.step, self.config.steps, self.loss)
                    if interrupted.is_set():
                        raise KeyboardInterrupt
            except KeyboardInterrupt:
                self.checkpoint()
                raise
        return self.finish(stopped)

    def finish(self, stopped: bool) -> TrainingResult:
        """Write the last checkpoint and return the result."""
        self.checkpoint()
        return self._result(stopped)

    def plan(self) -> tuple[Any, ...]:
        """Arguments of the compiled step for the current step."""
        state, config = self.state, self.config
        if state.step in self._refits():
            state.objective = state.objective.refit(self._model(state.params), self._usable())
            state.best_value = self._score(state.best)  # the refit changes the scale of the loss
        usable = np.setdiff1d(np.arange(len(self.windows)), state.excluded)
        size = state.objective.group_size()
        indices = step_indices(config.seed, state.step, config.batch, usable, self.labels, size)
        rate = learning_rate(config, state.step) * state.rate_scale
        seed, number = config.seed, state.step
        return state.params, state.moments, state.objective, self.data, indices, seed, number, rate

    def take(self, plan: tuple[Any, ...], params: Any, moments: Any, report: Report) -> bool:
        """Store the result of a step; return whether to stop early."""
        state = self.state
        *_, indices, _, number, rate = plan
        state.params, state.moments = params, moments
        if bool(report.ok):
            self.bad_in_a_row = 0
            state.rate_scale = min(1.0, state.rate_scale * _REGROWTH)
        else:
            self._recover(indices, number)
        state.step = number + 1
        row = {
            "step": number,
            "loss": float(report.loss),
            "gradient_norm": float(report.gradient_norm),
            "rate": rate,
            "ok": int(bool(report.ok)),
            "validation": "",
            "seconds": "",
            **{name: float(value) for name, value in report.parts.items()},
        }
        stopped = self._validate(row)
        state.seconds = time.monotonic() - self.began
        self._note(row)
        if state.step % self.config.checkpoint_every == 0:
            self.checkpoint()
        self.loss = row["loss"]
        return stopped

    def _recover(self, indices: np.ndarray, number: int) -> None:
        """Explain a non-finite step; exclude the faulty windows, or halve the rate and restore.

        Windows are at fault if their data are not finite, or if they alone run away: a model that
        runs away in many of them is at fault itself.
        """
        state = self.state
        self.bad_in_a_row += 1
        key = jax.random.fold_in(jax.random.key(np.uint32(self.config.seed)), np.uint32(number))
        found = explain_non_finite(
            self._model(state.params), state.objective, self.windows, indices, key, self.windows.dt
        )
        broken = bool(not_finite(state.params))
        if faulty := found.data or few_running_away(
            self._model(state.params), self.windows, state.excluded, found
        ):
            new = sorted({*state.excluded, *faulty})
            remedy = "left out from now on"
            if more := len(new) - len(state.excluded) - len(found.windows):
                remedy += f", with {more} more that run away"
            state.excluded = new
        else:
            state.rate_scale *= 0.5
            remedy = f"batch skipped, rate × {state.rate_scale:g}"
            if broken or self.bad_in_a_row > 1:
                kept = state.rate_scale, state.excluded, state.events, state.seconds
                state.fill(*self.snapshot)
                state.rate_scale, state.excluded, state.events, state.seconds = kept
                remedy += f", state of step {self.snapshot[1]['step']} restored"
        text = f"step {number}: {found.text}; {remedy}"
        state.events = [*state.events, {"step": number, "text": text}]
        _log.warning(text)
        self._give_up_if_needed(found, number)

    def _give_up_if_needed(self, found: Diagnosis, number: int) -> None:
        state = self.state
        usable = np.setdiff1d(np.arange(len(self.windows)), state.excluded)
        none_left = not members(self.labels, usable, state.objective.group_size())
        if len(state.events) <= self.config.max_recoveries and not none_left:
            return
        state.step = number
        self.checkpoint()
        kept = (
            "" if self.folder is None else f"; the last good state is in {self.folder.checkpoint}"
        )
        why = (
            "no window, or no whole group of them, has finite data"
            if none_left
            else f"more than {self.config.max_recoveries} bad steps, so training stopped"
        )
        raise TrainingError(f"step {number}: {found.text}; {why}{kept}")

    def _validate(self, row: dict[str, Any]) -> bool:
        """Keep the best parameters; return whether to stop early."""
        state, config = self.state, self.config
        due = state.step % config.validate_every == 0 or state.step == config.steps
        if self.validation is None:
            if state.step == config.steps:
                state.best, state.best_step = jax.tree.map(jnp.array, state.params), state.step
            return False
        if not due:
            return False
        row["validation"] = value = self._score(state.params)
        if value < state.best_value:
            state.best, state.best_value = jax.tree.map(jnp.array, state.params), value
            state.best_step, state.stale = state.step, 0
        else:
            state.stale += 1
        return 0 < config.patience <= state.stale

    def _score(self, params: Any) -> float:
        """Loss on the validation windows; infinite without them, or if it is not finite."""
        if self.validation is None:
            return float("inf")
        objective = self.state.objective
        devices = usable_devices(objective, self.validation.place.size)
        model = self._model(on_all(params, devices))
        value = float(
            _validation_loss(model, objective, self.validation, self.config.seed, devices)
        )
        return value if np.isfinite(value) else float("inf")

    # files

    def _note(self, row: dict[str, Any]) -> None:
        row["seconds"] = round(self.state.seconds, 3)
        if self.folder is None:
            self.rows.append(row)
            return
        self.unwritten.append(row)
        if len(self.unwritten) >= _FLUSH_EVERY:
            self._flush()

    def _flush(self) -> None:
        if self.folder is not None:
            self.folder.append_metrics(self.unwritten)
            self.unwritten = []

    def checkpoint(self) -> None:
        """Write the state between two steps."""
        self._flush()
        self.snapshot = (self.state.arrays(), self.state.plain())
        if self.folder is not None:
            self.folder.save(self.state, self.config, self.data_id)

    # views

    def _model(self, params: Any) -> Dynamics:
        return eqx.combine(params, self.static)

    def _refits(self) -> tuple[int, ...]:
        """Steps before which the objective refits its constants."""
        return tuple(sorted({round(f * self.config.steps) for f in self.config.refit_at}))

    def _usable(self) -> Windows:
        return self.windows.take(np.setdiff1d(np.arange(len(self.windows)), self.state.excluded))

    def _result(self, stopped: bool) -> TrainingResult:
        state = self.state
        if self.validation is None:
            state.best, state.best_step = state.params, state.step
        best, last = (self._model(_on_one_device(p)) for p in (state.best, state.params))
        if self.folder is None:
            names = list(self.rows[0]) if self.rows else []
            metrics = {
                n: np.array([np.nan if r[n] == "" else r[n] for r in self.rows], float)
                for n in names
            }
        else:
            save_model(self.folder.model, best, self.metadata)
            metrics = self.folder.read_metrics()
        return TrainingResult(
            model=best,
            last=last,
            steps=state.step,
            best_step=state.best_step,
            metrics=metrics,
            events=tuple(state.events),
            seconds=state.seconds,
            stopped_early=stopped,
            refits=tuple(r for r in self._refits() if 0 < r < state.step)
            if type(state.objective).refit is not Objective.refit
            else (),
        )


def _on_one_device(params: Any) -> Any:
    """Arrays that are replicated on several devices, on the first device alone."""
    return jax.device_put(params, jax.devices()[0])


@eqx.filter_jit
def _validation_loss(
    model: Dynamics, objective: Objective, batch: Batch, seed: int, devices: int
) -> jax.Array:
    key = jax.random.fold_in(jax.random.key(seed), np.uint32(2**32 - 1))
    whole, rest = eqx.partition((model, objective), eqx.is_array)

    def of_part(batch: Batch, whole: Any, key: jax.Array) -> jax.Array:
        model, objective = eqx.combine(whole, rest)
        return objective.loss(model, batch, key)[0]

    return mean_over_devices(of_part, devices)(batch, whole, key)
