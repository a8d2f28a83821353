"""Rivals of the diagnosis: regressions find what was planted, a learned rest acts in forecasts."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from spinndrift.models.effects import Extended
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.diagnosis_benchmark import run as running
from spinndrift.sims.diagnosis_benchmark.cases import Case, Truth
from spinndrift.sims.diagnosis_benchmark.judging import Judgement
from spinndrift.sims.diagnosis_benchmark.rivals import Rival, labels, sparse, terms
from spinndrift.sims.diagnosis_benchmark.tables import tables
from spinndrift.training.diagnosis.data.arrays import Data
from spinndrift.training.diagnosis.validation.blackbox import arguments
from spinndrift.training.diagnosis.validation.forecast import forecast

VEHICLE = load_vehicle("bluerov2_heavy")
DIRECTIONS = np.asarray(VEHICLE.thrusters().directions)


def drawn(runs=6, steps=200, dt=0.05, seed=1):
    """Smooth motion of a level vehicle under random commands; not that of any model."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(steps + 1)[:, None, None]

    def smooth(n):
        waves = [rng.uniform(0.3, 2, (n, runs)) * t + rng.uniform(0, 6, (n, runs)) for _ in "abc"]
        return 0.3 * sum(np.sin(w) for w in waves)

    X = np.zeros((steps + 1, 7, runs))
    X[:, 0] = 1
    X[:, 4:] = smooth(3)
    levels = np.repeat(rng.normal(0, 8, (-(-steps // 10), 8, runs)), 10, axis=0)[:steps]
    return Data(
        X, smooth(6), levels, levels[:1], np.full((1, runs), dt), np.ones((steps, runs)),
        np.full((steps, runs), dt), np.ones((steps, runs)), np.arange(runs), np.arange(runs),
        tuple("abcdef"[:runs]), dt, "thruster_force", False,
    )  # fmt: skip


@pytest.mark.parametrize("form", ["stlsq", "weak"])
def test_sparse_regression_finds_planted_terms(form):
    data = drawn()
    names = labels(8)
    phi = np.asarray(terms(jnp.asarray(DIRECTIONS), *arguments(data)))
    assert len(phi) == len(names) == len(set(names))
    planted = np.zeros((len(phi), 6))
    planted[names.index("|u|u"), 0] = -0.8
    planted[names.index("f3"), 5] = 0.05
    rng = np.random.default_rng(2)
    errors = np.zeros((200, 12, 6))
    lacking = np.einsum("dnr,di->nir", phi, planted) + 0.02 * rng.standard_normal((200, 6, 6))
    errors[:, 6:] = lacking * data.dt
    found = np.asarray(sparse(form, errors, data, DIRECTIONS).weights)
    drag, thrust = names.index("|u|u"), names.index("f3")
    assert found[drag, 0] == pytest.approx(-0.8, rel=0.1)
    # both take a command for linear between records, so a step of it is half of that before
    late = names.index("f3 before")
    assert found[thrust, 5] + found[late, 5] == pytest.approx(0.05, rel=0.1)
    size = np.abs(found) * phi.std(axis=(1, 2))[:, None]
    size[0] = 0
    assert np.argmax(size[:, 0]) == drag
    assert set(np.argsort(size[:, 5])[-2:]) == {thrust, late}
    assert np.count_nonzero(found[1:]) < 60


class Constant(eqx.Module):
    a: Array

    def acceleration(self, X, V, u, before):
        return jnp.broadcast_to(self.a[:, None, None], V.shape)


def test_a_learned_rest_is_an_acceleration():
    """For a short time it adds a t to the twist and a t² / 2 to the place, whatever the model."""
    data = drawn(runs=2, steps=4, dt=0.01)
    model = Extended.create(VEHICLE.dynamics(), (), VEHICLE.thrusters())
    a = jnp.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.4])
    plain, none = (forecast(model, data, 4, Constant(s * a)) for s in (1.0, 0.0))
    twist = (plain[1] - none[1])[-1]
    np.testing.assert_allclose(twist, 0.04 * np.asarray(a)[:, None] + 0 * twist, atol=3e-3)
    place = (plain[0] - none[0])[-1, 4:]
    np.testing.assert_allclose(place, 0.0008 * np.asarray(a)[:3, None] + 0 * place, atol=1e-4)


def test_rivals_stand_beside_judgements(tmp_path, monkeypatch):
    cases = [Case(tmp_path / n, Truth("single", "explained", n)) for n in ("lift", "tether")]
    asked = []

    class Finding:
        class diagnosis:
            @staticmethod
            def save(path):
                path.parent.mkdir(parents=True, exist_ok=True)

    def judge(case, alpha, progress):
        about = (case.name, "single", case.truth.called, 1.0, "usual", "explained", True)
        return Judgement(
            *about,
            [case.name],
            [case.name],
            True,
            True,
            None,
            True,
            1,
            0,
            gain={"all": 0.99},
            seconds=2.0,
        ), Finding()

    def compete(case):
        asked.append(case.name)
        sparse_terms = {"X": ["u", "v"], "N": ["r"]}
        return {"stlsq": Rival({"all": 0.5}, sparse_terms), "features": Rival({"all": 0.4})}

    monkeypatch.setattr(running, "judge", judge)
    monkeypatch.setattr(running, "compete", compete)
    go = {"out": tmp_path / "out", "alpha": 0.01, "progress": lambda f, r="": None}
    alone, _ = running.run_cases(cases[:1], **go)
    assert alone[0]["rivals"] == {}
    rows, _ = running.run_cases(cases, **go, rivals=True)
    assert running.run_cases(cases, **go)[0] == rows
    assert asked == ["lift", "tether"]
    table = next(t for t in tables(rows) if "Rival methods" in t.caption)
    assert table.header[3:] == ("stlsq", "features")
    assert table.rows[0] == ("lift", "lift", "0.99", "0.50 (3)", "0.40")
