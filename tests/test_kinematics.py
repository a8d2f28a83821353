"""Poses against twists: agreement is near one for true motion, and mix-ups are called by name."""

import re

import numpy as np
import pytest
from motion import smooth_motion

from spinndrift.models.recordings.kinematics import agreement, contradictions, dead_reckoned
from spinndrift.models.recordings.resample import rotations

T = np.arange(0.0, 20.0, 0.05)


def test_true_motion_agrees_and_noise_of_real_sensors_is_no_contradiction():
    X, V, _ = smooth_motion(T)
    for part in agreement(T, X, V):
        assert part.explained > 0.999
        assert part.slope == pytest.approx(1.0, abs=0.01)
    assert contradictions(T, X, V) == ([], [])
    rng = np.random.default_rng(0)
    noisy = V + rng.normal(size=V.shape) * 0.02
    noisy_X = X + np.concatenate([np.zeros((4, T.size)), rng.normal(size=(3, T.size)) * 0.01])
    assert contradictions(T, noisy_X, noisy) == ([], [])


def test_positions_that_are_mostly_noise_are_a_doubt():
    """Half a second at 5 cm of noise tells nothing of units; five seconds do."""
    X, V, _ = smooth_motion(T)
    rng = np.random.default_rng(1)
    X[4:] = X[4:] + rng.normal(size=(3, T.size)) * 0.3
    assert agreement(T, X, V)[0].explained < 0.5
    errors, doubts = contradictions(T, X, V)
    assert not errors
    assert len(doubts) == 1


def test_a_vehicle_at_rest_contradicts_nothing():
    X, V, _ = smooth_motion(T)
    X[:] = X[:, :1]
    assert contradictions(T, X, 0.001 * V) == ([], [])


def scaled(row, factor):
    def change(X, V, v_W):
        V[row] *= factor
        return X, V

    return change


def world_velocity(X, V, v_W):
    V[:3] = v_W
    return X, V


def world_rates(X, V, v_W):
    V[3:] = rotations(X[:4]).apply(V[3:].T).T
    return X, V


def scalar_last(X, V, v_W):
    return np.concatenate([X[[1, 2, 3, 0]], X[4:]]), V


def inverse(X, V, v_W):
    return np.concatenate([X[:1], -X[1:4], X[4:]]), V


def body_frd(X, V, v_W):
    V[[1, 2]] *= -1
    return X, V


def position_ned(X, V, v_W):
    return np.concatenate([X[:4], X[[5]], X[[4]], -X[[6]]]), V


def placed(order, *factors):
    """Positions in another order, or with other factors along x, y, z."""

    def change(X, V, v_W):
        size = np.array(factors or (1, 1, 1))[:, None]
        return np.concatenate([X[:4], size * X[4:][list(order)]]), V

    return change


def exchanged_in_the_world(X, V, v_W):
    V[:3] = rotations(X[:4]).inv().apply(v_W[[1, 0, 2]].T).T
    return X, V


def in_order(*rows):
    return lambda X, V, v_W: (X, V[list(rows)])


def north_east_down(X, V, v_W):
    V[:3] = v_W[[1, 0, 2]] * np.array([[1], [1], [-1]])
    return X, V


@pytest.mark.parametrize(
    ("mix_up", "sentence"),
    [
        (placed((1, 0, 2)), "x and y look exchanged; give x east, y north"),
        (exchanged_in_the_world, "x and y look exchanged"),
        (in_order(1, 0, 2, 3, 4, 5), "u and v look exchanged"),
        (in_order(0, 2, 1, 3, 4, 5), "v and w look exchanged"),
        (in_order(0, 1, 2, 5, 4, 3), "p and r look exchanged"),
        (in_order(3, 4, 5, 0, 1, 2), "u,v,w and p,q,r look exchanged"),
        (
            north_east_down,
            "along the world's axes, and x and y look exchanged, and z has the other",
        ),
        (placed((0, 1, 2), 1 / 0.3048, 1 / 0.3048, 1 / 0.3048), "x,y,z look like feet"),
        (placed((0, 1, 2), 39.37, 39.37, 39.37), "x,y,z look like inches"),
        (placed((0, 1, 2), 1, 1, 1 / 0.3048), "z looks like feet"),
        (placed((0, 1, 2), 1, 1, 100), "z looks like cm"),
        (placed((0, 1, 2), 1, 1000, 1), "y looks like mm"),
        (scaled(slice(0, 3), 1 / 0.3048), "ft/s"),
        (scaled(slice(3, 6), np.pi / 180), "57.3 times too small"),
        (scaled(slice(3, 6), 1000), "mrad/s"),
        (scaled(slice(3, 6), 180 / np.pi), "deg/s"),
        (scaled(slice(0, 3), 1 / 0.514444), "knots"),
        (scaled(slice(0, 3), 3.6), "km/h"),
        (scaled(slice(0, 3), 1000), "mm/s"),
        (world_velocity, "along the world's axes"),
        (world_rates, "about the world's axes"),
        (scalar_last, "x,y,z,w"),
        (inverse, "world-to-body"),
        (body_frd, "forward-right-down"),
        (position_ned, "north-east-down"),
        (scaled(slice(0, 3), -1), "u, v, w have the other sign"),
        (scaled(slice(0, 3), 7.0), "check units, frames"),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_mix_ups_are_named(mix_up, sentence, seed):
    errors, _ = contradictions(T, *mix_up(*smooth_motion(T, seed=seed)))
    assert len(errors) == 1
    assert sentence in errors[0]


@pytest.mark.parametrize("factor", [1 / 0.3048, 100.0, -1.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_unit_or_sign_of_a_height_that_hardly_moves_is_named(factor, seed):
    """The height makes 1 % of the displacement, so that the whole agrees."""
    X, V, v_W = smooth_motion(T, seed=seed)
    v_W[2] *= 0.1
    X[6] *= 0.1
    V[:3] = rotations(X[:4]).inv().apply(v_W.T).T
    assert contradictions(T, X, V) == ([], [])
    errors, _ = contradictions(T, *placed((0, 1, 2), 1, 1, factor)(X, V, v_W))
    said = {100.0: "z looks like cm", -1.0: r"z .* sign"}.get(factor, "z looks like feet")
    assert len(errors) == 1
    assert re.search(said, errors[0])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_quaternion_in_other_axes_is_named(seed):
    X, V, _ = smooth_motion(T, seed=seed)
    errors, _ = contradictions(T, np.concatenate([X[:1], X[[2, 1, 3]], X[4:]]), V)
    assert len(errors) == 1
    assert re.search("(qx and qy|p and q) look exchanged", errors[0])  # alike at small angles


def test_dead_reckoning_is_of_second_order_and_keeps_what_was_measured():
    errors = []
    for step in (0.1, 0.05):
        t = np.arange(0.0, 20.0, step)
        X, V, _ = smooth_motion(t)
        lacking = X.T.copy()
        lacking[:, 4:6] = np.nan
        found = dead_reckoned(t, lacking, V.T)
        np.testing.assert_array_equal(found[:, [0, 1, 2, 3, 6]], X.T[:, [0, 1, 2, 3, 6]])
        np.testing.assert_array_equal(found[0, 4:6], 0.0)
        errors.append(np.abs(found[:, 4:6] - (X[4:6] - X[4:6, :1]).T).max())
    assert errors[1] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
