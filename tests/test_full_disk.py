"""A disk that fills up while a file is written: one sentence, and what was there before stays."""

from pathlib import Path

import jax
import numpy as np
import pytest
from diagonal import Diagonal

from helpers import full_disk
from spinndrift.models.config.errors import UserError
from spinndrift.models.files.atomic import atomic_files
from spinndrift.models.files.checkpoint import save_model
from spinndrift.models.recordings.store import Recording, Trajectory
from spinndrift.sims.reports.pages import Page
from spinndrift.sims.study.table import write_csv
from spinndrift.training.config import TrainingConfig
from spinndrift.training.fitting.run_folder import RunFolder, TrainState

ROOM = 600  # bytes, less than any of these files has


def recording(at: Path) -> None:
    noise = np.random.default_rng(0).normal(size=(400, 6))
    pose = np.tile([1.0, 0, 0, 0, 0, 0, -1], (400, 1))
    run = Trajectory("noise", pose, noise, {"F_Bo_B": noise})
    Recording.from_trajectories([run], 0.05).save(at)


def checkpoint(at: Path) -> None:
    params = jax.numpy.arange(500.0)
    RunFolder(at.parent).save(TrainState(params, params, params, params), TrainingConfig(), "")


def table(at: Path) -> None:
    write_csv(at, [{"method": "fdm-geodesic", "seed": n} for n in range(200)])


WRITERS = {
    "log.nc": recording,
    "model.spinn": lambda at: save_model(at, Diagonal.of()),
    "checkpoint.npz": checkpoint,
    "table.csv": table,
    "report.html": lambda at: Page("Title", "and what it is about").write(at),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("there", [False, True])
def test_what_can_not_be_written_is_told_and_leaves_nothing(tmp_path, name, there):
    at = tmp_path / name
    if there:
        at.write_text("old")
    words = f"{name}: can't be written .File too large.; make room there or name another place"
    with full_disk(ROOM), pytest.raises(UserError, match=words):
        WRITERS[name](at)
    left = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert left == ({name: b"old"} if there else {})
    WRITERS[name](at)
    assert at.stat().st_size > ROOM


def test_files_that_belong_together_are_written_all_or_none(tmp_path):
    (tmp_path / "a.txt").write_text("old")

    def write(writer) -> None:
        with atomic_files(tmp_path) as partial:
            (partial / "a.txt").write_text("new")
            writer(partial / "b.txt")

    for writer, words in (
        (lambda at: at.write_text("n" * 2 * ROOM), f"^{tmp_path}: can't be written"),
        (table, f"^{tmp_path}/b.txt: can't be written"),
    ):
        with full_disk(ROOM), pytest.raises(UserError, match=words):
            write(writer)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.txt": "old"}


def test_rows_of_metrics_are_appended_whole_or_not_at_all(tmp_path):
    folder = RunFolder(tmp_path)
    rows = [{"step": n, "loss": 0.1234567} for n in range(40)]
    folder.append_metrics(rows[:5])
    before = folder.metrics.read_text()
    with full_disk(200), pytest.raises(UserError, match=r"metrics.csv: can't be written"):
        folder.append_metrics(rows[5:])
    assert folder.metrics.read_text() == before
    folder.append_metrics(rows[5:])
    np.testing.assert_array_equal(folder.read_metrics()["step"], np.arange(40))
