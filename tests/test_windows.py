"""Windows: normalisation, masks, honest splits, messages."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models import se3
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.training.data.windows import make_windows, split_windows

DT = 0.05


def run(scenario, count, seed, start=0.0):
    """Return a motion far from the origin whose command at index n is n in every component."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(count)
    rpy = 0.3 * np.sin(t[None] * rng.uniform(0.3, 1, (3, 1)) + rng.uniform(0, 6, (3, 1)))
    rpy[2] += 1.0 + t
    p = np.array([[1000.0], [-2000.0], [-5.0]]) + np.cumsum(rng.normal(0, 0.02, (3, count)), axis=1)
    X = np.asarray(se3.from_position_rpy(jnp.asarray(p), jnp.asarray(rpy))).T
    V = rng.normal(0, 0.3, (count, 6))
    F = np.repeat(np.arange(count, dtype=float)[:, None], 6, axis=1)
    return Trajectory(scenario, X, V, {"F_Bo_B": F}, start=start)


def displacement(X, Y):
    return np.asarray(se3.local(jnp.asarray(X), jnp.asarray(Y)))


def recording(*runs):
    return Recording.from_trajectories(list(runs), DT)


def test_a_window_is_a_piece_of_its_run():
    rec = recording(run("a", 101, 0), run("b", 61, 1))  # "b" is padded to 101 samples
    w = make_windows(rec, length_s=2.0, stride_s=0.5, normalise="none", dtype=np.float64)
    assert (w.steps, w.dt, w.length) == (40, DT, 2.0)
    assert len(w) == 7 + 3
    X = rec.dataset["X_WB"].to_numpy()
    V = rec.dataset["V_WB_B"].to_numpy()
    for i in range(len(w)):
        n = round(w.start[i] / DT)
        np.testing.assert_array_equal(w.X[..., i], X[w.scenario[i], 0, n : n + 41])
        np.testing.assert_array_equal(w.V[..., i], V[w.scenario[i], 0, n : n + 41])
        np.testing.assert_array_equal(w.F[:, 0, i], np.arange(n, n + 40))
    assert np.isfinite(w.F).all()
    assert "scenario 'b'" in w.label(7)


def test_a_window_can_be_as_long_as_its_run():
    rec = recording(run("a", 41, 0))
    assert len(make_windows(rec, length_s=2.0)) == 1


def test_heading_keeps_gravity_and_identity_starts_at_the_identity():
    rec = recording(run("a", 101, 3))
    plain, heading, identity = (
        make_windows(rec, length_s=2.0, normalise=n, dtype=np.float64)
        for n in ("none", "heading", "identity")
    )
    start = jnp.asarray(heading.X[0])
    np.testing.assert_allclose(start[4:], 0, atol=1e-12)
    np.testing.assert_allclose(se3.yaw(start), 0, atol=1e-12)
    up = [
        np.asarray(se3.rotation_matrix(jnp.moveaxis(jnp.asarray(w.X), 1, 0))[2])
        for w in (plain, heading)
    ]
    np.testing.assert_allclose(up[0], up[1], atol=1e-12)
    np.testing.assert_allclose(
        identity.X[0], np.eye(7)[:, :1] * np.ones(identity.X.shape[2]), atol=1e-12
    )
    # the motion within the body's own frame is the same in all three
    moved = [displacement(w.X[0], w.X[-1]) for w in (plain, heading, identity)]
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-9)
    np.testing.assert_allclose(moved[2], moved[0], atol=1e-9)


def test_far_positions_keep_their_digits_in_single_precision():
    rec = recording(run("a", 101, 4))
    single = make_windows(rec, length_s=2.0, dtype=np.float32)
    double = make_windows(rec, length_s=2.0, dtype=np.float64)
    assert single.X.dtype == np.float32
    np.testing.assert_allclose(single.X, double.X, atol=2e-7)


@pytest.mark.parametrize("by", ["time", "run"])
def test_no_moment_is_on_both_sides_of_a_split(by):
    rec = recording(*(run("a", 240, s) for s in range(4)), *(run("b", 220, s) for s in (7, 8)))
    learn, test = split_windows(rec, by=by, held_out=0.3, length_s=2.0, stride_s=0.25)
    assert not learn.overlaps(test)
    assert learn.overlaps(learn.take([1]))  # the check itself sees overlaps
    assert set(learn.scenario) == {0, 1} == set(test.scenario)
    if by == "time":
        for s in (0, 1):
            gap = test.start[test.scenario == s].min() - (
                learn.start[learn.scenario == s].max() + learn.length
            )
            assert gap >= 1.0 - 1e-9
    else:
        runs = [{(s, r) for s, r in zip(w.scenario, w.run, strict=True)} for w in (learn, test)]
        assert not runs[0] & runs[1]


def test_held_out_windows_are_disjoint():
    _, test = split_windows(recording(run("a", 600, 0)), length_s=2.0)
    assert (np.diff(np.sort(test.start)) >= 2.0 - 1e-9).all()


def test_subdividing_renormalises_and_loses_nothing():
    w = make_windows(recording(run("a", 101, 5)), length_s=2.0, dtype=np.float64)
    parts = w.subdivide(20)
    assert (parts.steps, len(parts)) == (20, 2 * len(w))
    np.testing.assert_allclose(parts.X[0, 4:], 0, atol=1e-12)
    second = parts.take(range(len(w), 2 * len(w)))
    np.testing.assert_allclose(second.start, w.start + 1.0)
    np.testing.assert_array_equal(second.V, w.V[20:])
    np.testing.assert_allclose(
        displacement(second.X[0], second.X[-1]), displacement(w.X[20], w.X[-1]), atol=1e-9
    )


def test_thinning_keeps_both_ends():
    w = make_windows(recording(run("a", 400, 5)), length_s=2.0, stride_s=0.05)
    few = w.thin(7)
    assert len(few) == 7
    assert (few.start[0], few.start[-1]) == (w.start[0], w.start[-1])
    assert w.thin(10**6) is w


def test_what_is_missing_is_named():
    short = recording(run("a", 21, 0))
    with pytest.raises(UserError, match=r"lasts 1 s.*needs 4 s"):
        make_windows(short)
    with pytest.raises(UserError, match="held-out part"):
        split_windows(recording(run("a", 140, 0)), length_s=4.0, by="time")
    with pytest.raises(UserError, match="at least one step"):
        make_windows(short, length_s=0.01)
    blind = run("a", 101, 0)
    blind = Trajectory("a", blind.X_WB, blind.V_WB_B * np.nan, blind.commands)
    with pytest.raises(UserError, match=r"V_WB_B u/v/w.*complete it"):
        make_windows(recording(blind))


class Pair:
    """A vehicle with two thrusters along x."""

    def thrusters(self, dtype=None):
        return SimpleNamespace(
            allocation=np.eye(6)[:, :2],
            inverse=jnp.eye(6)[:2],
            nominal_voltage=jnp.array(16.0),
            wrench=lambda f: jnp.tensordot(jnp.eye(6)[:, :2], f, 1),
        )


def test_windows_know_what_was_commanded_before():
    """Commands at index n are n; before the beginning of a run the first is held."""
    F = run("a", 101, 5).commands["F_Bo_B"]
    one = replace(run("a", 101, 5), commands={"thruster_force": F[:, :2]})
    given = {"length_s": 1.0, "stride_s": 0.5, "normalise": "none", "dtype": np.float64}
    w = make_windows(recording(one), Pair(), remembered=0.2, **given)
    assert make_windows(recording(one), Pair(), **given).commands is None
    c = w.commands
    assert c is not None
    assert c.before.shape == (4, 2, len(w))
    for i, start in enumerate(w.start):
        n = round(start / DT)
        np.testing.assert_array_equal(c.level[:, 0, i], np.arange(n, n + 20))
        before = np.maximum(np.arange(n - 4, n), 0)
        np.testing.assert_array_equal(c.before[:, 1, i], before)
        np.testing.assert_array_equal(c.V_before[..., i], one.V_WB_B[before])
    np.testing.assert_array_equal(c.voltage, 1.0)
    # shorter windows cut from these know as much as if they had been cut so at once
    parts = w.subdivide(10)
    again = make_windows(recording(one), Pair(), remembered=0.2, **(given | {"length_s": 0.5}))
    order = [int(np.flatnonzero(np.isclose(again.start, s))[0]) for s in parts.start]
    leaves = (jax.tree.leaves(x.commands) for x in (parts, again.take(order)))
    for mine, theirs in zip(*leaves, strict=True):
        np.testing.assert_array_equal(mine, theirs)
