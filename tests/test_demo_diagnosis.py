"""What the demo's diagnosis sees, keeps, and leaves training to start from."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.effects.drag import LinearDrag
from spinndrift.models.effects.extended import Extended
from spinndrift.models.effects.unknown import Unknown
from spinndrift.models.recordings.store import Recording, Trajectory
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims import demo_diagnosis
from spinndrift.sims.demo_diagnosis import _why_not, diagnosed
from spinndrift.sims.learning import Start
from spinndrift.sims.reports import diagnosis_report
from spinndrift.sims.reports.pages import Page
from spinndrift.training.config import WindowConfig
from spinndrift.training.diagnosis.findings.result import VERSION, DataSummary, Diagnosis

VEHICLE = load_vehicle("bluerov2_heavy")
WINDOWS = WindowConfig(length_s=1.0, stride_s=0.5, gap_s=0.5)


def told(verdict="explained", **changes):
    """A diagnosis with nothing in it but its verdict."""
    data = DataSummary([], 1, 10.0, 0.05, "pwm", [], [], {})
    fields = {
        "version": VERSION, "verdict": verdict, "sentence": f"It is {verdict}.", "causes": [],
        "refitted": [], "ratios": [], "residual": {}, "gain": {}, "left_out": "run", "data": data,
        "tested": 60, "threshold": 7.0, "alpha": 0.01,
    }  # fmt: skip
    return Diagnosis(**(fields | changes))


def finding(diagnosis):
    """It, with a model that has a little more drag."""
    drag = LinearDrag(jnp.asarray([5.0, 0, 0, 0, 0, 0]))
    extended = Extended.create(VEHICLE.dynamics(), (drag,), VEHICLE.thrusters())
    return SimpleNamespace(diagnosis=diagnosis, extended=extended)


def recorded(seconds=20.0, speed=0.1):
    N = round(seconds / 0.05)
    X = np.tile([1.0, 0, 0, 0, 0, 0, -1], (N, 1))
    X[:, 4] = 0.05 * speed * np.arange(N)
    V, F = np.zeros((N, 6)), np.zeros((N, 6))
    V[:, 0] = speed
    run = Trajectory("one", X, V, {"F_Bo_B": F})
    return Recording.from_trajectories([run], 0.05, vehicle="bluerov2_heavy")


@pytest.fixture
def stand_in(monkeypatch):
    """A diagnosis in place of a real one; returns the recordings that it was given."""
    seen = []

    def answer(diagnosis):
        def diagnose(part, vehicle, progress):
            seen.append(part)
            if isinstance(diagnosis, Exception):
                raise diagnosis
            return finding(diagnosis)

        monkeypatch.setattr(demo_diagnosis.pipeline, "diagnose", diagnose)
        monkeypatch.setattr(diagnosis_report, "diagnosis_page", lambda *_: Page("Diagnosis"))
        return seen

    return answer


def run(tmp_path, recording):
    out = tmp_path / "diagnosis"
    source = tmp_path / "dive.nc"
    return diagnosed(recording, VEHICLE, source, WINDOWS, out, lambda fraction, remark: None)


def test_only_the_training_part_is_diagnosed(tmp_path, stand_in):
    seen = stand_in(told())
    run(tmp_path, recorded(20.0))
    (part,) = seen
    # a quarter is held out, 15 % of the rest validates, with gaps
    assert part.duration < 0.75 * 0.85 * 20.0
    assert part.duration > 0.55 * 20.0


def test_it_is_kept_for_the_same_data_and_made_anew_for_others(tmp_path, stand_in):
    seen = stand_in(told(explained={}))
    first = run(tmp_path, recorded())
    again = run(tmp_path, recorded())
    assert (first.kept, again.kept, len(seen)) == (False, True, 1)
    assert again.diagnosis == first.diagnosis
    assert again.start is not None
    assert again.start.name == "extended"
    assert isinstance(again.start.model, Extended)
    assert [e.name for e in again.start.model.effects] == ["linear_drag"]
    other = run(tmp_path, recorded(speed=0.2))
    assert (other.kept, len(seen)) == (False, 2)


@pytest.mark.parametrize(
    ("verdict", "word"),
    [("adequate", "adequate"), ("unexplained", "can name nothing")],
)
def test_without_a_claim_the_preset_is_what_training_starts_from(tmp_path, stand_in, verdict, word):
    stand_in(told(verdict))
    found = run(tmp_path, recorded())
    assert found.start is None
    assert word in found.why
    assert found.diagnosis is not None


def test_refused_data_leave_no_diagnosis_of_others_behind(tmp_path, stand_in):
    stand_in(told())
    run(tmp_path, recorded())
    stand_in(UserError("recording: too little for a diagnosis"))
    found = run(tmp_path, recorded(speed=0.2))
    assert found.diagnosis is None
    assert found.start is None
    assert found.why == "The diagnosis refuses these data: recording: too little for a diagnosis."
    assert not (tmp_path / "diagnosis" / "diagnosis.json").exists()


def without_surge(recording):
    V = recording.dataset["V_WB_B"].copy()
    V[..., 0] = np.nan
    return Recording(recording.dataset.assign(V_WB_B=V))


def test_training_goes_on_from_an_extended_model_without_all_channels(tmp_path, stand_in):
    stand_in(told())
    found = run(tmp_path, without_surge(recorded()))
    assert found.start is not None
    assert found.why == ""


def test_an_extended_model_that_remembers_the_motion_needs_all_channels():
    vehicle = load_vehicle("bluerov2_heavy")
    memory = Unknown.neutral(kind="memory", acts_on="yaw", numbers=(1.0, 0.5, 5.0))
    model = Extended.create(vehicle.dynamics(), (memory,), vehicle.thrusters())
    why = _why_not(told(), without_surge(recorded()), Start(model))
    assert "lacks u" in why
    assert "remembers the motion" in why
