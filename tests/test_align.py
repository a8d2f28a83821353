"""A log at the samples, times and in the world frame of another recording of its dive."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import ROOT, shared_data
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.store import Recording
from spinndrift.sims.cli import main
from spinndrift.systems.logs.load import LogOptions, import_log

pytestmark = pytest.mark.whole

LOG = ROOT / "sims/data/sitl_dive.tlog.xz"
DT, YAW, SHIFT = 0.04, 2.1, np.array([5.0, -3.0])


@pytest.fixture(scope="module")
def logged() -> Recording:
    return import_log(LOG, rate=1 / DT)[0]


def moved(recording: Recording, first: int, last: int, clock: float = 0.0) -> Trajectory:
    """A part of the first run as a station had logged it: W elsewhere, and another clock."""
    run = next(iter(recording.trajectories()))
    X, turn = run.X_WB[first:last].copy(), Rotation.from_euler("z", YAW)
    X[:, :4] = (turn * Rotation.from_quat(X[:, :4], scalar_first=True)).as_quat(scalar_first=True)
    X[:, 4:6] = turn.apply(X[:, 4:])[:, :2] + SHIFT
    start = run.start + DT * first + clock
    commands = {"pwm": run.commands["pwm"][first:last]}
    return Trajectory("crossing", X, run.V_WB_B[first:last], commands, {}, start)


def written(trajectory: Trajectory, folder: Path) -> Path:
    Recording.from_trajectories([trajectory], DT, vehicle="bluerov2_heavy").save(folder / "log.nc")
    return folder


def errors(recording: Recording, wanted: Trajectory) -> tuple[float, float]:
    """Largest differences of place (m) and attitude (rad), sample by sample."""
    (run,) = recording.trajectories()
    assert (run.scenario, len(run)) == (wanted.scenario, len(wanted))
    assert run.start == pytest.approx(wanted.start, abs=1e-6)
    a, b = (Rotation.from_quat(X[:, :4], scalar_first=True) for X in (run.X_WB, wanted.X_WB))
    return float(np.abs(run.X_WB - wanted.X_WB)[:, 4:].max()), float(
        (a.inv() * b).magnitude().max()
    )


def test_a_log_gets_the_samples_and_the_world_of_what_flew(logged, tmp_path):
    wanted = moved(logged, 200, 1000)
    recording, report = import_log(LOG, options=LogOptions(align=written(wanted, tmp_path)))
    place, angle = errors(recording, wanted)
    assert place < 1e-6
    assert angle < 1e-6
    assert recording.dt == DT
    assert any("body rates correlate by 0.99" in s for s in report.done)


@pytest.mark.parametrize("clock", [-40.0, 5000.0])
def test_clocks_that_differ_are_found_by_the_motion(logged, tmp_path, clock):
    wanted = moved(logged, 200, 1000, clock)
    recording, report = import_log(LOG, options=LogOptions(align=written(wanted, tmp_path)))
    place, angle = errors(recording, wanted)
    assert place < 0.02  # of a sample between two of the recording's
    assert angle < 0.02
    assert any(f"{-clock:+.0f}" in s for s in report.done)


def test_a_log_that_begins_in_mid_dive_gives_what_it_has(logged, tmp_path):
    run = next(iter(logged.trajectories()))
    early = moved(logged, 0, 1000)
    still = np.repeat(early.X_WB[:1], 500, axis=0)  # 20 s that the log does not have
    longer = Trajectory(
        "crossing",
        np.concatenate([still, early.X_WB]),
        np.concatenate([np.zeros((500, 6)), early.V_WB_B]),
        {"pwm": np.concatenate([np.full((500, 8), 1500.0), early.commands["pwm"]])},
        {},
        run.start - 500 * DT,
    )
    recording, _ = import_log(LOG, options=LogOptions(align=written(longer, tmp_path)))
    (part,) = recording.trajectories()
    assert part.start == pytest.approx(run.start, abs=DT)
    assert len(part) == pytest.approx(1000, abs=1)


def test_a_log_of_another_dive_is_refused(logged, tmp_path):
    wanted = moved(logged, 200, 1000)
    wanted.V_WB_B[:] = wanted.V_WB_B[::-1].copy()
    with pytest.raises(UserError, match=r"tlog\.xz: its motion is not that of the recording"):
        import_log(LOG, options=LogOptions(align=written(wanted, tmp_path)))


def test_without_motion_the_clock_alone_counts_and_that_is_said(logged, tmp_path):
    wanted = moved(logged, 200, 1000)
    wanted.V_WB_B[:] *= 0.001
    recording, report = import_log(LOG, options=LogOptions(align=written(wanted, tmp_path)))
    assert errors(recording, wanted)[0] < 1e-6
    assert any("by the vehicle's clock alone" in s for s in report.done)


def test_runs_that_begin_together_are_refused(logged, tmp_path):
    one = moved(logged, 200, 600)
    both = Recording.from_trajectories([one, one], DT, vehicle="bluerov2_heavy")
    both.save(tmp_path / "both.nc")
    with pytest.raises(UserError, match="does not say when its runs were"):
        import_log(LOG, options=LogOptions(align=tmp_path / "both.nc"))


@pytest.mark.parametrize(
    ("more", "message"),
    [(["--align", "."], "no log.nc"), (["--align", "x.nc", "--rate", "20"], "leave --rate away")],
)
def test_what_does_not_go_together_is_refused(more, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["import", str(LOG), *more])
    assert ended.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_both_logs_of_a_real_dive_agree(tmp_path):
    """Telemetry and the logger's file of one dive, on one clock."""
    folder = shared_data("data", "sitl_log")
    told = import_log(folder / "dive.tlog")[0]
    told.save(tmp_path / "told.nc")
    logged, report = import_log(
        folder / "dive.BIN.xz", options=LogOptions(align=tmp_path / "told.nc")
    )
    pairs = {run.scenario: run for run in told.trajectories()}
    assert any(
        re.search(r"correlate by (0\.99|1\.0).*are -?\d ms late", sentence)
        for sentence in report.done
    )
    for run in logged.trajectories():
        other = pairs[run.scenario]
        first = round((run.start - other.start) / told.dt)
        apart = run.X_WB - other.X_WB[first : first + len(run)]
        assert np.sqrt(np.mean(apart[:, 4:] ** 2)) < 0.03
        assert np.abs(apart[:, :4]).max() < 0.05
