"""Recordings: what is refused, that files and parts lose nothing, splits that are honest."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.origin import states_estimated
from spinndrift.models.recordings.outputs import outputs_of, with_outputs
from spinndrift.models.recordings.store import Recording
from spinndrift.models.recordings.summary import summarize

DT = 0.05


def trajectory(scenario="surge", n=40, seed=0, **changes):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    arrays = {
        "X_WB": np.concatenate([q, rng.normal(size=(n, 3))], axis=1),
        "V_WB_B": rng.normal(size=(n, 6)),
        "commands": {"F_Bo_B": rng.normal(size=(n, 6))},
        "sensors": {"voltage": rng.uniform(14, 16, size=n)},
        "start": 10.0 * seed,
    }
    return Trajectory(scenario, **(arrays | changes))


def recording(*lengths, scenario="surge"):
    runs = [trajectory(scenario, n, seed) for seed, n in enumerate(lengths or (40, 25))]
    return Recording.from_trajectories(
        runs, DT, vehicle="test", source="here", notes=["one", "two"]
    )


def equal(a: Trajectory, b: Trajectory):
    assert a.scenario == b.scenario
    assert a.start == pytest.approx(b.start, abs=1e-12)
    assert a.variables().keys() == b.variables().keys()
    for name, values in a.variables().items():
        np.testing.assert_array_equal(values, b.variables()[name])


def test_padding_is_masked_and_taken_off_again():
    runs = [trajectory("a", 30, 1), trajectory("b", 12, 2), trajectory("a", 17, 3)]
    made = Recording.from_trajectories(runs, DT)
    assert made.mask.shape == (2, 2, 30)
    assert made.lengths.tolist() == [[30, 17], [12, 0]]
    assert made.scenarios == ("a", "b")
    assert np.isnan(made.dataset["V_WB_B"].to_numpy()[~made.mask]).all()
    for got, put in zip(made.trajectories(), [runs[0], runs[2], runs[1]], strict=True):
        equal(got, put)
    assert made.duration == pytest.approx((29 + 16 + 11) * DT)


def test_netcdf_round_trip_is_exact(tmp_path):
    made = recording(40, 25)
    path = tmp_path / "deep" / "run.nc"
    made.save(path)
    back = Recording.load(path)
    assert back.notes == ("one", "two")
    assert back.vehicle == "test"
    assert back.dataset["V_WB_B"].attrs["units"] == "m/s, rad/s"
    for a, b in zip(made.trajectories(), back.trajectories(), strict=True):
        equal(a, b)
    assert made.dataset.identical(back.dataset.assign_coords(scenario=made.dataset["scenario"]))
    assert [p.name for p in path.parent.iterdir()] == ["run.nc"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda d: d.drop_vars("F_Bo_B"), "no command"),
        (lambda d: d.drop_vars("X_WB"), "X_WB: missing"),
        (lambda d: d.assign_attrs(dt=0.0), "dt: must be a number of seconds from"),
        (lambda d: d.assign_coords(time=d.time**1.01), "resample uneven data"),
        (lambda d: d.assign_coords(time=d.time + 1.0), "time: must be 0"),
        (lambda d: d.assign(X_WB=d.X_WB * 1.01), "normalise it"),
        (lambda d: d.assign(mask=d.mask & (d.time != 5 * DT)), "without holes"),
        (lambda d: d.assign(mask=d.mask & False), "no sample"),
        (lambda d: d.assign(V_WB_B=d.V_WB_B.where(d.time != 5 * DT)), "index 5"),
        (lambda d: d.assign(F_Bo_B=d.F_Bo_B.where(d.wrench_component != "K")), r"F_Bo_B\[K\]"),
        (lambda d: d.assign(X_WB=d.X_WB.where(d.pose_component != "qw")), r"X_WB\[qw\]"),
        (lambda d: d.assign(mask=d.mask & (d.time < 1.0)), "outside the mask"),
        (lambda d: d.assign(V_WB_B=d.V_WB_B.transpose(..., "time")), "dimensions must be"),
        (lambda d: d.assign(V_WB_B=d.V_WB_B.assign_attrs(units="knots")), "convert first"),
        (lambda d: d.assign(mask=d.mask * 1.0), "must be bool"),
    ],
)
def test_what_is_no_recording_is_refused(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        Recording(change(recording(40, 40).dataset))


def test_a_channel_may_lack_throughout_a_run_only():
    lacking = trajectory(seed=1)
    lacking.X_WB[:, 4:6] = np.nan
    lacking.V_WB_B[:, :2] = np.nan
    made = Recording.from_trajectories([trajectory(seed=0), lacking], DT)
    assert made.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}
    assert "missing in at least one run: x, y of X_WB" in summarize(made)
    assert recording().missing == {}


def test_cut_and_time_split_keep_the_right_samples():
    made = recording(40, 25)
    piece = made.cut(0.5, 1.0)
    first = next(iter(piece.trajectories()))
    whole = next(iter(made.trajectories()))
    np.testing.assert_array_equal(first.V_WB_B, whole.V_WB_B[10:20])
    assert first.start == pytest.approx(0.5)

    learn, test = made.split_by_time(0.25, gap=0.1)
    runs = zip(made.trajectories(), learn.trajectories(), test.trajectories(), strict=True)
    for all_, a, b in runs:
        n = len(all_)
        known = round(0.75 * n)
        np.testing.assert_array_equal(a.X_WB, all_.X_WB[:known])
        np.testing.assert_array_equal(b.X_WB, all_.X_WB[known + 2 :])
        assert b.start - a.start == pytest.approx((known + 2) * DT)
    with pytest.raises(UserError, match="too short"):
        made.split_by_time(0.25, gap=10.0)


def test_split_by_run_shares_nothing_and_loses_nothing():
    runs = [trajectory(s, 20, seed) for seed, s in enumerate("aabbb" * 2)]
    made = Recording.from_trajectories(runs, DT)
    for seed in (None, 3):
        learn, test = made.split_by_run(0.3, seed)
        starts = [{t.start for t in part.trajectories()} for part in (learn, test)]
        assert starts[0] & starts[1] == set()
        assert starts[0] | starts[1] == {t.start for t in runs}
        assert learn.scenarios == test.scenarios == ("a", "b")
    learn, test = made.split_by_run(["b"])
    assert (learn.scenarios, test.scenarios) == (("a",), ("b",))
    learn, test = made.split()
    assert np.count_nonzero(test.lengths) == 3
    long = recording(400)
    assert np.array_equal(long.split()[1].mask, long.split_by_time()[1].mask)
    with pytest.raises(UserError, match="single run"):
        recording(40).split_by_run(0.5)
    with pytest.raises(UserError, match="scenario c: is not here"):
        made.select("c")


def test_force_of_outputs_that_changed_within_a_step_is_the_mean_of_their_forces():
    pwm, std = np.full((40, 8), 1600.0), np.full((40, 8), 50.0)
    made = Recording.from_trajectories(
        [trajectory(commands={"pwm": pwm}, sensors={"pwm_std": std})], DT, vehicle="ardusub_sitl"
    )
    force = np.abs(made.thrust()[0])
    # 51.48 N u|u| with u = (pwm - 1500) / 400, which is as often 0.375 as 0.125
    np.testing.assert_allclose(force, 51.48 * (0.375**2 + 0.125**2) / 2, rtol=1e-6)
    plain = Recording(made.dataset.drop_vars("pwm_std"))
    np.testing.assert_allclose(np.abs(plain.thrust()[0]), 51.48 * 0.25**2, rtol=1e-6)


def test_concatenation_keeps_every_run():
    a, b = recording(40, 25), recording(10, scenario="sway")
    both = Recording.concat([a, b, a])
    assert both.scenarios == ("surge", "sway")
    assert both.lengths.tolist() == [[40, 25, 40, 25], [10, 0, 0, 0]]
    assert both.notes == ("one", "two")
    sparse = Recording(a.dataset.assign_attrs(command_period=0.2))
    for wrong in ("fast", 0.0, 1e4):
        with pytest.raises(
            ValueError, match="rates_low_pass: must be a number of Hz from 1 to 500"
        ):
            Recording(a.dataset.assign_attrs(rates_low_pass=wrong))
    assert a.command_period == a.dt
    assert Recording.concat([a, sparse]).command_period == 0.2
    assert [r.commands_sampled for r in (a, sparse, both)] == [False, True, False]
    own = Recording(a.dataset.assign_attrs(states_estimated=1))
    joined = [Recording.concat(some).dataset for some in ([own, own], [own, a])]
    assert [states_estimated(d) for d in joined] == [True, False]
    other = Recording.from_trajectories(
        [trajectory(commands={"pwm": np.full((40, 8), 1500.0)})], DT, vehicle="test"
    )
    with pytest.raises(UserError, match="no command in common"):
        Recording.concat([a, other])
    slow = Recording.from_trajectories([trajectory()], 0.1)
    with pytest.raises(UserError, match="unequal steps"):
        Recording.concat([a, slow])


@dataclass
class FakeThrusters:
    """Force 0.1 N/µs per volt; thruster i pushes with weight i along x."""

    allocation = np.outer(np.eye(6)[0], np.arange(8.0))
    inverse = np.linalg.pinv(allocation)
    nominal_voltage = 2.0

    def force(self, pwm_us, voltage):
        return 0.1 * (pwm_us - 1500.0) * voltage[None]

    def wrench(self, forces):
        return jnp.einsum("ft,t...->f...", self.allocation, forces)


class FakeVehicle:
    def thrusters(self, dtype):
        return FakeThrusters()


def test_wrench_comes_from_whatever_command_there_is():
    plain = recording(40, 25)
    assert plain.wrench().identical(plain.dataset["F_Bo_B"])

    f = np.random.default_rng(0).normal(size=(30, 8))
    forces = Recording.from_trajectories([trajectory(n=30, commands={"thruster_force": f})], DT)
    expected = f @ FakeThrusters.allocation.T
    np.testing.assert_allclose(forces.wrench(FakeVehicle())[0, 0], expected, atol=1e-12)
    with pytest.raises(UserError, match="names no vehicle"):
        forces.wrench()

    pwm = 1500 + 100 * f
    runs = [
        trajectory(n=30, commands={"pwm": pwm}, sensors={"voltage": np.full(30, 5.0)}),
        trajectory(n=20, commands={"pwm": pwm[:20]}, sensors={}),
    ]
    made = Recording.from_trajectories(runs, DT).wrench(FakeVehicle())
    np.testing.assert_allclose(made[0, 0], 50 * expected, atol=1e-9)
    np.testing.assert_allclose(made[0, 1, :20], 20 * expected[:20], atol=1e-9)
    assert np.isnan(made[0, 1, 20:]).all()
    four = Recording.from_trajectories([trajectory(n=30, commands={"pwm": pwm[:, :4]})], DT)
    with pytest.raises(UserError, match="4 thrusters, the vehicle 8"):
        four.wrench(FakeVehicle())


def test_thrust_comes_from_the_nearest_command():
    f = np.random.default_rng(0).normal(size=(30, 8))
    F = f @ FakeThrusters.allocation.T
    wanted = {
        "thruster_force": (f, f),
        "pwm": (1500 + 100 * f, 50 * f),
        "F_Bo_B": (F, F @ FakeThrusters.inverse.T),
    }
    for name, (command, expected) in wanted.items():
        runs = [
            trajectory(n=n, commands={name: command[:n]}, sensors={"voltage": np.full(n, 5.0)})
            for n in (30, 20)
        ]
        level, voltage = Recording.from_trajectories(runs, DT).thrust(FakeVehicle())
        np.testing.assert_allclose(level[0, 0], expected, atol=1e-9)
        np.testing.assert_allclose(level[0, 1, :20], expected[:20], atol=1e-9)
        assert np.isfinite(level).all()
        np.testing.assert_array_equal(voltage[0, 0], 2.5)
    every = {"pwm": 1500 + f, "thruster_force": f, "F_Bo_B": F}
    both = trajectory(n=30, commands=every, sensors={})
    level, voltage = Recording.from_trajectories([both], DT).thrust(FakeVehicle())
    np.testing.assert_array_equal(level[0, 0], f)
    np.testing.assert_array_equal(voltage, 1.0)


def test_broken_files_are_told_in_one_sentence(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        Recording.load(tmp_path / "none.nc")
    bad = tmp_path / "bad.nc"
    bad.write_bytes(b"not a netcdf file at all")
    with pytest.raises(UserError, match="can't be read as NetCDF"):
        Recording.load(bad)
    recording().dataset.assign_attrs(format="other").to_netcdf(bad, engine="h5netcdf")
    with pytest.raises(UserError, match="no recording"):
        Recording.load(bad)
    recording().save(bad)
    whole = bad.read_bytes()
    bad.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"bad\.nc"):
        Recording.load(bad)


def driven(outputs):
    pwm = {"pwm": np.full((40, 8), 1500.0)}
    made = Recording.from_trajectories([trajectory(commands=pwm)], DT, vehicle="test")
    return Recording(with_outputs(made.dataset, outputs))


def test_outputs_of_the_thrusters_are_kept(tmp_path):
    outputs = (1, 2, 5, 4, 3, 6, 0, 32)
    made = driven(outputs)
    made.save(tmp_path / "run.nc")
    read = Recording.load(tmp_path / "run.nc")
    assert outputs_of(read.dataset) == outputs_of(read.cut(0.5, 1.0).dataset) == outputs
    assert outputs_of(Recording.concat([read, made]).dataset) == outputs
    assert outputs_of(Recording.concat([read, driven(range(1, 9))]).dataset) == ()
    driven(()).save(tmp_path / "old.nc")
    assert outputs_of(Recording.load(tmp_path / "old.nc").dataset) == ()


@pytest.mark.parametrize("outputs", [(1, 2, 3), (1, 2, 3, 4, 5, 6, 7, 33), (-1,) * 8])
def test_outputs_that_can_not_be_are_refused(outputs):
    with pytest.raises(ValueError, match="thruster_outputs: "):
        driven(outputs)


@pytest.mark.parametrize("outputs", ["1 2 3 4 5 6 7 8", np.arange(8.0), np.ones((2, 4), int)])
def test_outputs_of_another_kind_are_refused(outputs):
    dataset = driven(()).dataset.assign_attrs(thruster_outputs=outputs)
    with pytest.raises(ValueError, match="thruster_outputs: must be whole numbers"):
        Recording(dataset)
