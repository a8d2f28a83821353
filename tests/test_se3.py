"""SE(3) against scipy's matrix exponential, in value and derivative, in both precisions."""

from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from spinndrift.models import se3

TOLERANCE = {np.float32: 2e-5, np.float64: 1e-11}
ANGLES = [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 3e-3, 0.05, 0.3, 0.999, 1.001, 2.0, 3.0, np.pi - 1e-6]


def hat(xi):
    v, w = xi[:3], xi[3:]
    top = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    return np.block([[top, np.reshape(v, (3, 1))], [np.zeros((1, 4))]])


@cache
def compiled(name):
    """Compile each function once; hypothesis then only runs it."""
    functions = {
        "exp": lambda xi: se3.as_matrix(se3.exp(xi)),
        "exp_jacobian": jax.jacfwd(lambda xi: se3.as_matrix(se3.exp(xi))),
        "log_of_exp": lambda xi: se3.log(se3.exp(xi)),
        "log_of_exp_jacobian": jax.jacrev(lambda xi: se3.log(se3.exp(xi))),
        "log": se3.log,
        "log_jacobian": jax.jacrev(se3.log),
        "from_matrix": se3.from_matrix,
        "interpolate": se3.interpolate,
        "jaxlie_exp_jacobian": jax.jacfwd(lambda xi: jaxlie.SE3.exp(xi).as_matrix()),
    }
    return jax.jit(functions[name])


def exact_jacobian(xi):
    generators = [hat(e) for e in np.eye(6)]
    columns = [
        scipy.linalg.expm_frechet(hat(xi), g, compute_expm=False, method="blockEnlarge")
        for g in generators
    ]
    return np.stack(columns, axis=-1)


unit = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda a: np.linalg.norm(a) > 0.1)
angle = st.one_of(st.sampled_from(ANGLES), st.floats(0, np.pi - 1e-6))
precision = st.sampled_from([np.float32, np.float64])


@st.composite
def twists(draw):
    axis = np.array(draw(unit))
    v = np.array([draw(st.floats(-3, 3)) for _ in range(3)])
    return np.concatenate([v, draw(angle) * axis / np.linalg.norm(axis)])


@given(twists(), precision)
def test_exp_is_the_matrix_exponential(xi, dtype):
    got = np.asarray(compiled("exp")(xi.astype(dtype)))
    assert got.dtype == dtype
    assert got == pytest.approx(scipy.linalg.expm(hat(xi.astype(dtype))), abs=TOLERANCE[dtype])


@given(twists(), precision)
def test_derivative_of_exp(xi, dtype):
    got = np.asarray(compiled("exp_jacobian")(xi.astype(dtype)))
    assert got == pytest.approx(exact_jacobian(xi.astype(dtype)), abs=TOLERANCE[dtype])


def test_derivative_oracle_catches_the_small_angle_error_of_jaxlie():
    """jaxlie 1.5.0 gives at ω = 0 twice the derivative of the translation: ours must not."""
    xi = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0], np.float32)
    exact = exact_jacobian(xi)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        wrong = np.asarray(compiled("jaxlie_exp_jacobian")(xi))
    assert np.abs(wrong - exact).max() > 0.5
    assert np.asarray(compiled("exp_jacobian")(xi)) == pytest.approx(exact, abs=1e-6)


@given(twists(), precision)
def test_log_inverts_exp_with_its_derivative(xi, dtype):
    x = xi.astype(dtype)
    if np.linalg.norm(x[3:]) >= np.pi - 5e-7:  # rounding crossed the cut locus
        x[3:] *= dtype((np.pi - 1e-6) / np.linalg.norm(x[3:]))
    scale = 1 + np.abs(xi).max()
    assert np.asarray(compiled("log_of_exp")(x)) == pytest.approx(x, abs=TOLERANCE[dtype] * scale)
    jacobian = np.asarray(compiled("log_of_exp_jacobian")(x))
    assert jacobian == pytest.approx(np.eye(6), abs=10 * TOLERANCE[dtype] * scale**2)


@given(twists())
def test_log_is_the_matrix_logarithm(xi):
    if np.linalg.norm(xi[3:]) > 3.0:
        xi[3:] *= 3.0 / np.linalg.norm(xi[3:])  # scipy's logm loses digits at the cut locus
    T = scipy.linalg.expm(hat(xi))
    got = np.asarray(compiled("log")(compiled("from_matrix")(T)))
    with np.errstate(all="ignore"):  # scipy divides by subnormal entries
        exact = np.real(scipy.linalg.logm(T))
    assert hat(got) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_log_and_its_gradient_are_finite_on_the_cut_locus_and_at_the_identity(dtype):
    for q in ([0, 1, 0, 0], [0, 0, 0, -1], [-1, 0, 0, 0], [1, 0, 0, 0], [-1e-20, 0.6, 0.8, 0]):
        X = np.array([*q, 0.5, -1.0, 2.0], dtype)
        assert np.all(np.isfinite(compiled("log")(X)))
        assert np.all(np.isfinite(compiled("log_jacobian")(X)))
        assert np.linalg.norm(compiled("log")(X)[3:]) <= np.pi + 1e-6


def test_opposite_quaternions_are_the_same_pose():
    X = se3.exp(jnp.array([1.0, 2.0, 3.0, 0.3, -0.5, 1.0]))
    flipped = jnp.concatenate([-X[:4], X[4:]])
    np.testing.assert_allclose(se3.log(flipped), se3.log(X), atol=1e-15)


@given(twists(), twists(), twists())
def test_group_axioms(a, b, c):
    A, B, C = (compiled("from_matrix")(scipy.linalg.expm(hat(x))) for x in (a, b, c))
    left = se3.as_matrix(se3.compose(se3.compose(A, B), C))
    np.testing.assert_allclose(left, se3.as_matrix(se3.compose(A, se3.compose(B, C))), atol=1e-12)
    identity = se3.as_matrix(se3.compose(A, se3.inverse(A)))
    np.testing.assert_allclose(identity, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(
        se3.as_matrix(se3.compose(A, B)), se3.as_matrix(A) @ se3.as_matrix(B), atol=1e-12
    )


def sample(shape=(), seed=0):
    xi = np.random.default_rng(seed).normal(size=(6, *shape))
    return se3.exp(jnp.asarray(xi)), jnp.asarray(xi)


def test_adjoint_moves_twists_between_frames():
    X, xi = sample()
    T = np.asarray(se3.as_matrix(X))
    moved = T @ hat(np.asarray(xi)) @ np.linalg.inv(T)
    np.testing.assert_allclose(hat(np.asarray(se3.adjoint(X) @ xi)), moved, atol=1e-13)


def test_ad_is_the_commutator_and_coadjoint_its_transpose():
    a, b = (sample(seed=s)[1] for s in (1, 2))
    bracket = hat(a) @ hat(b) - hat(b) @ hat(a)
    np.testing.assert_allclose(hat(se3.ad(a) @ b), bracket, atol=1e-14)
    np.testing.assert_allclose(se3.ad_apply(a, b), se3.ad(a) @ b, atol=1e-14)
    np.testing.assert_allclose(se3.coad_apply(a, b), se3.ad(a).T @ b, atol=1e-14)


def test_interpolation_follows_the_geodesic():
    A, _ = sample(seed=3)
    B, _ = sample(seed=4)
    np.testing.assert_allclose(
        se3.as_matrix(se3.interpolate(A, B, 0.0)), se3.as_matrix(A), atol=1e-14
    )
    np.testing.assert_allclose(
        se3.as_matrix(se3.interpolate(A, B, 1.0)), se3.as_matrix(B), atol=1e-13
    )
    quarter = se3.interpolate(A, B, 0.25)
    np.testing.assert_allclose(se3.local(A, quarter), se3.local(A, B) / 4, atol=1e-13)


def test_chordal_distance_is_the_frobenius_norm():
    A, _ = sample(seed=5)
    B, _ = sample(seed=6)
    embedded = jnp.sum((se3.chordal(A) - se3.chordal(B)) ** 2)
    frobenius = jnp.sum((se3.as_matrix(A) - se3.as_matrix(B)) ** 2)
    np.testing.assert_allclose(embedded, frobenius, rtol=1e-13)


def test_roll_pitch_yaw_round_trip():
    angles = np.random.default_rng(7).uniform(-1.5, 1.5, (3, 50))
    X = se3.from_position_rpy(jnp.zeros((3, 50)), jnp.asarray(angles))
    np.testing.assert_allclose(se3.rpy(X), angles, atol=1e-13)
    np.testing.assert_allclose(se3.yaw(X), angles[2], atol=1e-13)


@given(twists())
def test_from_matrix_inverts_as_matrix(xi):
    T = scipy.linalg.expm(hat(xi))
    np.testing.assert_allclose(se3.as_matrix(compiled("from_matrix")(T)), T, atol=1e-13)


def test_batches_agree_with_single_states_and_with_jaxlie():
    X, xi = sample((4, 3), seed=8)
    Y, _ = sample((4, 3), seed=9)
    product = se3.compose(X, Y)
    assert product.shape == (7, 4, 3)
    np.testing.assert_allclose(product[:, 2, 1], se3.compose(X[:, 2, 1], Y[:, 2, 1]), atol=1e-14)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = se3.to_jaxlie(X) @ se3.to_jaxlie(Y)
    np.testing.assert_allclose(se3.from_jaxlie(theirs), product, atol=1e-13)
    np.testing.assert_allclose(se3.from_jaxlie(se3.to_jaxlie(X)), X)
    np.testing.assert_allclose(se3.adjoint(X)[:, :, 1, 2], se3.adjoint(X[:, 1, 2]), atol=1e-14)
    assert xi.shape == (6, 4, 3)
