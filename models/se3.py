"""The special Euclidean group SE(3), and the conventions of all modules.

Frames
    World W: x east, y north, z up. Body B: x forward, y left, z up, origin Bo.
Arrays
    Component first: axis 0 holds the components, all trailing axes are batch. One implementation
    serves a single state `(7,)` and a million samples `(7, N)`; with samples last the inner loops
    are contiguous, which on a CPU is several times faster than `vmap` over rows.
Pose `X_WB`
    `(7, *batch)`: quaternion w, x, y, z, then position x, y, z (m): the storage order of
    `jaxlie.SE3` (`to_jaxlie`, `from_jaxlie`). Quaternions are unit; q and -q are the same pose.
Twist `V_WB_B`
    `(6, *batch)`: linear velocity of Bo (m/s), then angular velocity (rad/s), both of B in W and
    expressed in B. A tangent vector of the group has the same order [v, ω].
Wrench `F_Bo_B`
    `(6, *batch)`: force (N), then moment about Bo (N·m), expressed in B.

Every coefficient that is 0/0 at the identity is a function of the squared angle with its Taylor
series below one radian, so values and derivatives of `exp` and `log` are accurate to rounding from
the identity up to the cut locus at π (Solà et al. 2018, "A micro Lie theory", eqs. 172-182).
"""

from fractions import Fraction
from math import comb, factorial

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
"""The six axes, in the order of a twist and of a wrench."""
XYZ = ("x", "y", "z")
POSE = ("qw", "qx", "qy", "qz", *XYZ)
TWIST = ("u", "v", "w", "p", "q", "r")
WRENCH = ("X", "Y", "Z", "K", "M", "N")
CHANNELS = (*XYZ, *AXES[3:], *TWIST)
"""Displacement and rotation in the axes of one of two poses, then twist: m, rad, m/s, rad/s."""

_SERIES_BELOW = 1.0  # squared angle; at one radian the closed forms lose no digit to cancellation


def _bernoulli(n: int) -> Fraction:
    numbers: list[Fraction] = [Fraction(1)]
    for m in range(1, n + 1):
        total = sum((comb(m + 1, k) * numbers[k] for k in range(m)), Fraction(0))
        numbers.append(-total / (m + 1))
    return numbers[n]


_EXP_TERMS = 9
_SIN_HALF = [(-1) ** k / (2.0 ** (2 * k + 1) * factorial(2 * k + 1)) for k in range(_EXP_TERMS)]
_COS_HALF = [(-1) ** k / (2.0 ** (2 * k) * factorial(2 * k)) for k in range(_EXP_TERMS)]
_ONE_MINUS_COS = [(-1) ** k / factorial(2 * k + 2) for k in range(_EXP_TERMS)]
_X_MINUS_SIN = [(-1) ** k / factorial(2 * k + 3) for k in range(_EXP_TERMS)]
_ONE_MINUS_X_COT = [float(abs(_bernoulli(2 * k)) / factorial(2 * k)) for k in range(1, 13)]
_ATAN = [(-1) ** k / (2 * k + 1) for k in range(14)]
_ATAN_SERIES_BELOW = 0.0625


def _polynomial(coefficients: list[float], x: Array) -> Array:
    if x.dtype == jnp.float32 and len(coefficients) == _EXP_TERMS:
        coefficients = coefficients[:5]  # the rest is below 2e-9 for x < 1
    result = jnp.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        result = result * x + c
    return result


# Components are separated by `unstack` and `split`, whose transposes are one operation each; the
# transpose of an index or slice is a padded array per component, and the backward pass adds them.


def _dot(a: Array, b: Array) -> Array:
    a0, a1, a2 = jnp.unstack(a)
    b0, b1, b2 = jnp.unstack(b)
    return a0 * b0 + a1 * b1 + a2 * b2


def cross(a: Float[Array, "3 *#batch"], b: Float[Array, "3 *#batch"]) -> Float[Array, "3 *#batch"]:
    """Cross product a × b, component first."""
    a0, a1, a2 = jnp.unstack(a)
    b0, b1, b2 = jnp.unstack(b)
    return jnp.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def align(*arrays: Array) -> tuple[Array, ...]:
    """Append batch axes of length one until all arrays have the same rank (explicit broadcast)."""
    rank = max(a.ndim for a in arrays)
    return tuple(a.reshape(a.shape + (1,) * (rank - a.ndim)) for a in arrays)


def identity(dtype: jnp.dtype | type = float) -> Float[Array, "7"]:
    """The pose in which B coincides with W."""
    return jnp.zeros(7, dtype).at[0].set(1)


def compose(X_AB: Float[Array, "7 *a"], X_BC: Float[Array, "7 *b"]) -> Float[Array, "7 *c"]:
    """X_AC = X_AB X_BC."""
    X_AB, X_BC = align(X_AB, X_BC)
    q_AB, p_AB = jnp.split(X_AB, [4])
    q_BC, p_BC = jnp.split(X_BC, [4])
    w, x, y, z = jnp.unstack(q_AB)
    s, i, j, k = jnp.unstack(q_BC)
    q = [
        w * s - x * i - y * j - z * k,
        w * i + x * s + y * k - z * j,
        w * j - x * k + y * s + z * i,
        w * k + x * j - y * i + z * s,
    ]
    return jnp.concatenate([jnp.stack(q), _rotate(q_AB, p_BC) + p_AB])


def inverse(X_AB: Float[Array, "7 *batch"]) -> Float[Array, "7 *batch"]:
    """X_BA."""
    w, u, p = jnp.split(X_AB, [1, 4])
    q = jnp.concatenate([w, -u])
    return jnp.concatenate([q, -_rotate(q, p)])


def _rotate(q: Array, v: Array) -> Array:
    w, u = jnp.split(q, [1])
    t = 2 * cross(u, v)
    return v + w * t + cross(u, t)


def rotate(X_AB: Float[Array, "7 *a"], v_B: Float[Array, "3 *b"]) -> Float[Array, "3 *c"]:
    """v_A = R_AB v_B."""
    X_AB, v_B = align(X_AB, v_B)
    return _rotate(jnp.split(X_AB, [4])[0], v_B)


def rotate_inverse(X_AB: Float[Array, "7 *a"], v_A: Float[Array, "3 *b"]) -> Float[Array, "3 *c"]:
    """v_B = R_ABᵀ v_A."""
    X_AB, v_A = align(X_AB, v_A)
    w, u, _ = jnp.split(X_AB, [1, 4])
    return _rotate(jnp.concatenate([w, -u]), v_A)


def act(X_AB: Float[Array, "7 *a"], p_B: Float[Array, "3 *b"]) -> Float[Array, "3 *c"]:
    """Position of a point known in B, expressed in A: p_A = R_AB p_B + p_AB."""
    X_AB, p_B = align(X_AB, p_B)
    q, p = jnp.split(X_AB, [4])
    return _rotate(q, p_B) + p


def rotation_matrix(X_AB: Float[Array, "7 *batch"]) -> Float[Array, "3 3 *batch"]:
    """R_AB of the pose's quaternion."""
    w, x, y, z, *_ = jnp.unstack(X_AB)
    one = jnp.ones_like(w)
    rows = [
        [one - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), one - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), one - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def exp(xi: Float[Array, "6 *batch"]) -> Float[Array, "7 *batch"]:
    """The pose reached by flowing for unit time with the constant twist xi = [v, ω]."""
    v, omega = jnp.split(xi, 2)
    t2 = _dot(omega, omega)
    # Steps of an integrator rotate by far less than a radian: then no sine is evaluated.
    small = jnp.all(t2 < _SERIES_BELOW)
    w, half, b, c = jnp.unstack(jax.lax.cond(small, _exp_series, _exp_coefficients, t2))
    wxv = cross(omega, v)
    p = v + b[None] * wxv + c[None] * cross(omega, wxv)
    return jnp.concatenate([w[None], half[None] * omega, p])


def _exp_series(t2: Array) -> Array:
    """cos(θ/2), sin(θ/2)/θ, (1 - cos θ)/θ² and (θ - sin θ)/θ³ from θ² below one."""
    series = (_COS_HALF, _SIN_HALF, _ONE_MINUS_COS, _X_MINUS_SIN)
    return jnp.stack([_polynomial(coefficients, t2) for coefficients in series])


def _exp_coefficients(t2: Array) -> Array:
    """The same for any θ²."""
    series = t2 < _SERIES_BELOW
    large = jnp.where(series, 1, t2)
    theta = jnp.sqrt(large)
    s, c = jnp.sin(theta / 2), jnp.cos(theta / 2)
    closed = jnp.stack([c, s / theta, 2 * s**2 / large, (theta - 2 * s * c) / (large * theta)])
    return jnp.where(series[None], _exp_series(jnp.where(series, t2, 0)), closed)


def log(X: Float[Array, "7 *batch"]) -> Float[Array, "6 *batch"]:
    """The twist [v, ω], |ω| ≤ π, whose `exp` is X; finite with its gradient at the cut locus."""
    sign = jnp.where(X[:1] < 0, -1, 1).astype(X.dtype)
    w, u, p = jnp.split(X, [1, 4])
    w, u = jnp.squeeze(sign * w, 0), sign * u
    n2 = _dot(u, u)
    series = n2 < _ATAN_SERIES_BELOW * w * w
    w_safe = jnp.where(series, w, 1)
    ratio = jnp.where(series, n2, 0) / (w_safe * w_safe)
    n = jnp.sqrt(jnp.where(series, 1, n2))
    half_over_n = jnp.where(series, _polynomial(_ATAN, ratio) / w_safe, jnp.arctan2(n, w) / n)
    omega = 2 * half_over_n[None] * u
    t2 = _dot(omega, omega)
    near = t2 < _SERIES_BELOW
    t2_far = jnp.where(near, 1, t2)
    d = jnp.where(
        near,
        _polynomial(_ONE_MINUS_X_COT, jnp.where(near, t2, 0)),
        (1 - half_over_n * w) / t2_far,
    )
    wxp = cross(omega, p)
    return jnp.concatenate([p - wxp / 2 + d[None] * cross(omega, wxp), omega])


def local(X_WA: Float[Array, "7 *a"], X_WB: Float[Array, "7 *b"]) -> Float[Array, "6 *c"]:
    """log(X_WA⁻¹ X_WB): the displacement from A to B expressed in A."""
    return log(compose(inverse(X_WA), X_WB))


def retract(X: Float[Array, "7 *a"], xi: Float[Array, "6 *b"]) -> Float[Array, "7 *c"]:
    """X exp(xi), with the quaternion normalised."""
    return normalize(compose(X, exp(xi)))


def interpolate(
    X_WA: Float[Array, "7 *a"], X_WB: Float[Array, "7 *b"], s: float | Float[Array, "*s"]
) -> Float[Array, "7 *c"]:
    """Geodesic (constant body twist) from X_WA at s = 0 to X_WB at s = 1."""
    xi = local(X_WA, X_WB)
    return retract(X_WA, xi * jnp.asarray(s, xi.dtype))


def normalize(X: Float[Array, "7 *batch"]) -> Float[Array, "7 *batch"]:
    """The same pose with a unit quaternion."""
    q, p = jnp.split(X, [4])
    w, x, y, z = jnp.unstack(q)
    scale = 1 / jnp.sqrt(w * w + x * x + y * y + z * z)
    return jnp.concatenate([q * scale[None], p])


def _hat(v: Array) -> Array:
    zero = jnp.zeros_like(v[0])
    return jnp.stack(
        [
            jnp.stack([zero, -v[2], v[1]]),
            jnp.stack([v[2], zero, -v[0]]),
            jnp.stack([-v[1], v[0], zero]),
        ]
    )


def _blocks(a: Array, b: Array, c: Array, d: Array) -> Array:
    return jnp.concatenate([jnp.concatenate([a, b], axis=1), jnp.concatenate([c, d], axis=1)])


def adjoint(X_AB: Float[Array, "7 *batch"]) -> Float[Array, "6 6 *batch"]:
    """Ad_X, which transforms twists: ξ_A = Ad_X ξ_B, [[R, p̂R], [0, R]] for the order [v, ω]."""
    R = rotation_matrix(X_AB)
    p = X_AB[4:]
    pR = jnp.stack([cross(p, R[:, j]) for j in range(3)], axis=1)
    return _blocks(R, pR, jnp.zeros_like(R), R)


def ad(xi: Float[Array, "6 *batch"]) -> Float[Array, "6 6 *batch"]:
    """The matrix of the Lie bracket, ad_ξ η = [ξ, η]: [[ω̂, v̂], [0, ω̂]]."""
    v, omega = _hat(xi[:3]), _hat(xi[3:])
    return _blocks(omega, v, jnp.zeros_like(v), omega)


def ad_apply(
    xi: Float[Array, "6 *#batch"], eta: Float[Array, "6 *#batch"]
) -> Float[Array, "6 *#batch"]:
    """The Lie bracket [ξ, η] = ad_ξ η without forming the matrix."""
    v, omega = jnp.split(xi, 2)
    eta_v, eta_omega = jnp.split(eta, 2)
    linear = cross(omega, eta_v) + cross(v, eta_omega)
    return jnp.concatenate([linear, cross(omega, eta_omega)])


def coad_apply(
    xi: Float[Array, "6 *#batch"], mu: Float[Array, "6 *#batch"]
) -> Float[Array, "6 *#batch"]:
    """ad*_ξ μ = ad_ξᵀ μ: the rate in B of a constant spatial momentum μ = [p, π].

    Linear part p × ω, angular part π × ω + p × v (Marsden and Ratiu 1994, section 14.2).
    """
    v, omega = jnp.split(xi, 2)
    p, pi = jnp.split(mu, 2)
    return jnp.concatenate([cross(p, omega), cross(pi, omega) + cross(p, v)])


def chordal(X: Float[Array, "7 *batch"]) -> Float[Array, "12 *batch"]:
    """The embedding of SE(3) in R¹²: the rows of R, then the position (m)."""
    R = rotation_matrix(X)
    return jnp.concatenate([R[0], R[1], R[2], X[4:]])


def from_position_rpy(
    p_WB: Float[Array, "3 *batch"], rpy_WB: Float[Array, "3 *batch"]
) -> Float[Array, "7 *batch"]:
    """Pose from position (m) and roll, pitch, yaw (rad) about z-y'-x'' in the frames above."""
    cr, cp, cy = (jnp.cos(rpy_WB[i] / 2) for i in range(3))
    sr, sp, sy = (jnp.sin(rpy_WB[i] / 2) for i in range(3))
    q = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    return jnp.concatenate([jnp.stack(q), p_WB])


def rpy(X: Float[Array, "7 *batch"]) -> Float[Array, "3 *batch"]:
    """Roll, pitch, yaw (rad); pitch is clipped at ±π/2, where roll and yaw are not unique."""
    w, x, y, z = X[0], X[1], X[2], X[3]
    return jnp.stack(
        [
            jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1, 1)),
            jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
    )


def yaw(X: Float[Array, "7 *batch"]) -> Float[Array, "*batch"]:
    """Heading (rad), counter-clockwise from W's x axis."""
    return rpy(X)[2]


def as_matrix(X: Float[Array, "7 *batch"]) -> Float[Array, "4 4 *batch"]:
    """Homogeneous matrix [[R, p], [0, 1]]."""
    R = rotation_matrix(X)
    top = jnp.concatenate([R, X[4:][:, None]], axis=1)
    zero = jnp.zeros_like(X[0])
    return jnp.concatenate([top, jnp.stack([zero, zero, zero, zero + 1])[None]])


def from_matrix(T: Float[Array, "4 4 *batch"]) -> Float[Array, "7 *batch"]:
    """Pose of a homogeneous matrix, by its largest quaternion component (Shepperd 1978)."""
    m = T[:3, :3]
    one = jnp.ones_like(m[0, 0])
    squares = jnp.stack(
        [
            one + m[0, 0] + m[1, 1] + m[2, 2],
            one + m[0, 0] - m[1, 1] - m[2, 2],
            one - m[0, 0] + m[1, 1] - m[2, 2],
            one - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    pairs = [
        [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
        [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], squares[2], m[2, 1] + m[1, 2]],
        [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[3]],
    ]
    candidates = jnp.stack([jnp.stack(row) for row in pairs])
    pivot = jnp.argmax(squares, axis=0)
    chosen = jnp.take_along_axis(candidates, pivot[None, None], axis=0)[0]
    return normalize(jnp.concatenate([chosen, T[:3, 3]]))


def to_jaxlie(X: Float[Array, "7 *batch"]) -> jaxlie.SE3:
    """The same poses as `jaxlie.SE3`, whose batch axes come first."""
    return jaxlie.SE3(jnp.moveaxis(X, 0, -1))


def from_jaxlie(X: jaxlie.SE3) -> Float[Array, "7 *batch"]:
    """Poses of a `jaxlie.SE3` in the component-first form of this module."""
    return jnp.moveaxis(X.wxyz_xyz, -1, 0)
