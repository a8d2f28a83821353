"""The CSV form: nothing lost there and back, frames converted, every common mistake told apart."""

import re
from pathlib import Path

import numpy as np
import pytest
from motion import smooth_motion

from helpers import ROOT, shared_data
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.checks.finding import findings_of
from spinndrift.models.recordings.csv import read_csv, write_csv
from spinndrift.models.recordings.outputs import outputs_of, with_outputs
from spinndrift.models.recordings.store import Recording
from spinndrift.training.data.windows import make_windows

T = np.arange(0.0, 5.0, 0.05)
STATE = "t,x,y,z,qw,qx,qy,qz,u,v,w,p,q,r"
WRENCH = "X,Y,Z,K,M,N"


def run(scenario="a", t=T, command="F_Bo_B", seed=0, **sensors):
    X, V, _ = smooth_motion(t, seed=seed)
    rng = np.random.default_rng(seed)
    low, high, n = {"F_Bo_B": (-9, 9, 6), "thruster_force": (-9, 9, 8), "pwm": (1100, 1900, 8)}[
        command
    ]
    return Trajectory(scenario, X.T, V.T, {command: rng.uniform(low, high, (t.size, n))}, sensors)


def write(folder: Path, columns=None, header=STATE + "," + WRENCH, meta="frames: ENU/FLU\n", **kw):
    """Write one file `run.csv` of smooth motion (or the given columns) and its metadata."""
    folder.mkdir(exist_ok=True)
    if columns is None:
        columns = motion_columns(**kw)
    lines = [header, *(",".join(f"{v:.10g}" for v in row) for row in columns.T)]
    (folder / "run.csv").write_text("\n".join(lines) + "\n")
    (folder / "recording.yaml").write_text(meta)
    return folder


def motion_columns(t=T, commands=6):
    X, V, _ = smooth_motion(t)
    return np.concatenate([t[None], X[4:], X[:4], V, np.ones((commands, t.size))])


@pytest.mark.parametrize("frames", ["ENU/FLU", "NED/FRD"])
@pytest.mark.parametrize("command", ["F_Bo_B", "thruster_force", "pwm"])
def test_round_trip(tmp_path, frames, command):
    volts = np.linspace(16, 14, T.size)
    runs = [
        run("a", T, command, 0, voltage=volts),
        run("b c/d", T[:60], command, 1, voltage=volts[:60]),
        run("a", T[:80], command, 2, voltage=volts[:80]),
    ]
    made = Recording.from_trajectories(runs, 0.05, vehicle="v", source="s", notes=["n"])
    write_csv(made, tmp_path / "out", frames=frames)
    back = read_csv(tmp_path / "out")
    assert back.scenarios == made.scenarios
    assert (back.vehicle, back.notes, back.dt) == ("v", ("n",), made.dt)
    assert np.array_equal(back.mask, made.mask)
    for name in ("V_WB_B", command, "voltage"):
        np.testing.assert_allclose(
            back.dataset[name].to_numpy(), made.dataset[name].to_numpy(), rtol=1e-9, atol=1e-9
        )
    X, Y = (r.dataset["X_WB"].to_numpy()[made.mask] for r in (back, made))
    np.testing.assert_allclose(X[:, 4:], Y[:, 4:], atol=1e-9)
    np.testing.assert_allclose(np.abs((X[:, :4] * Y[:, :4]).sum(axis=1)), 1, atol=1e-12)
    with pytest.raises(UserError, match="not empty"):
        write_csv(made, tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_ned_frd_by_hand(tmp_path):
    """Heading east (yaw 90° from north), 2 m deep, swimming forward, pushed to all sides."""
    t = np.arange(4) * 0.5
    half = np.sqrt(0.5)
    still = np.zeros((6, 4))
    still[0] = 1.0
    columns = np.stack(
        [t, 3 + 0 * t, 5 + t, 2 + 0 * t]
        + [half + 0 * t, 0 * t, 0 * t, half + 0 * t]
        + list(still)
        + [c + 0 * t for c in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)]
    )
    meta = "frames: NED/FRD\nvehicle: bluerov2_heavy\nfiles: {run.csv: east}\n"
    made = read_csv(write(tmp_path, columns, meta=meta))
    X = made.dataset["X_WB"].to_numpy()[0, 0]
    np.testing.assert_allclose(np.abs(X[:, 0]), 1, atol=1e-9)  # facing along W's x axis
    np.testing.assert_allclose(X[:, 4:], np.stack([5 + t, 3 + 0 * t, -2 + 0 * t], 1), atol=1e-9)
    np.testing.assert_allclose(made.dataset["V_WB_B"][0, 0, 0], [1, 0, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(made.dataset["F_Bo_B"][0, 0, 0], [1, -2, -3, 4, -5, -6], atol=1e-9)
    assert made.scenarios == ("east",)


def test_uneven_steps_are_resampled(tmp_path):
    t = np.cumsum(np.random.default_rng(0).uniform(0.03, 0.09, 200))
    columns = motion_columns(t)
    columns[14] = np.floor(t)  # a command that steps each second
    made = read_csv(write(tmp_path, columns), rate=50.0)
    assert made.dt == pytest.approx(0.02)
    new = t[0] + 0.02 * np.arange(made.mask.shape[2])
    X, V, _ = smooth_motion(new)
    got = made.dataset["X_WB"].to_numpy()[0, 0].T
    np.testing.assert_allclose(got[4:], X[4:], atol=0.003)  # ≤ h²/8 · 2.5 m/s²
    np.testing.assert_allclose(made.dataset["V_WB_B"].to_numpy()[0, 0].T, V, atol=0.01)
    held = made.dataset["F_Bo_B"].to_numpy()[0, 0, :, 0]
    last = np.floor(t[np.searchsorted(t, new + 1e-9, side="right") - 1])
    settled = np.searchsorted(t, new + 1e-9) == np.searchsorted(t, new + 0.02 - 1e-9)
    np.testing.assert_allclose(held[settled], last[settled], atol=1e-9)
    assert "Uneven time steps were resampled to" in read_csv(tmp_path).notes[-1]


def test_uneven_samples_can_stay_where_they_are(tmp_path):
    t = np.cumsum(np.random.default_rng(0).uniform(0.03, 0.09, 200))
    columns = motion_columns(t)
    raw = read_csv(write(tmp_path / "raw", columns), resample=False)
    assert raw.uneven
    assert not raw.notes
    np.testing.assert_allclose(raw.elapsed(0, 0), t - t[0], atol=1e-9)
    np.testing.assert_allclose(raw.dataset["V_WB_B"].to_numpy()[0, 0].T, columns[8:14], atol=1e-9)
    write_csv(raw, tmp_path / "again")
    again = read_csv(tmp_path / "again", resample=False)
    np.testing.assert_allclose(again.elapsed(0, 0), raw.elapsed(0, 0), atol=1e-9)
    np.testing.assert_allclose(raw.cut(1.0, 3.0).elapsed(0, 0)[0], 0)
    with pytest.raises(UserError, match="times of their own"):
        make_windows(raw, length_s=1.0)
    backwards = raw.dataset.copy(deep=True)
    backwards["elapsed"][0, 0, 5] = 0.0
    with pytest.raises(ValueError, match="don't rise"):
        Recording(backwards)
    # even files are none the less on a grid, and a short pause cuts
    columns = motion_columns()
    columns[0, 50:] += 0.4
    meta = "frames: ENU/FLU\ncheck: false\n"
    paused = read_csv(write(tmp_path / "paused", columns, meta=meta), resample=False)
    assert not paused.uneven
    assert paused.lengths.tolist() == [[50, 50]]
    # lines in bursts of four are whole
    columns = motion_columns(np.cumsum(np.tile([0.01, 0.01, 0.01, 0.12], 40)))
    bursts = read_csv(write(tmp_path / "bursts", columns, meta=meta), resample=False)
    assert bursts.uneven
    assert bursts.lengths.tolist() == [[160]]


def test_a_long_gap_makes_two_runs(tmp_path):
    columns = motion_columns()
    columns[0, 50:] += 5.0
    made = read_csv(write(tmp_path, columns, meta="frames: ENU/FLU\ncheck: false\n"))
    assert made.lengths.tolist() == [[50, 50]]
    assert "cut at 1 gap of up to 5.0 s" in made.notes[0]


def test_dialects_of_csv_read_the_same(tmp_path):
    plain = write(tmp_path / "plain")
    text = (plain / "run.csv").read_text()
    expected = read_csv(plain).dataset["V_WB_B"].to_numpy()
    variants = {
        "bom": b"\xef\xbb\xbf" + text.encode(),
        "utf16": text.encode("utf-16"),
        "semicolon": text.replace(",", ";").encode(),
        "decimal comma": text.replace(",", ";").replace(".", ",").encode(),
        "tab": text.replace(",", "\t").replace("\n", "\r\n").encode(),
        "comments": ("# by hand\n" + text.replace("\n", "\n\n")).encode(),
        "spaces": text.replace(",", " , ").encode(),
    }
    for name, content in variants.items():
        folder = write(tmp_path / name)
        (folder / "run.csv").write_bytes(content)
        np.testing.assert_array_equal(read_csv(folder).dataset["V_WB_B"].to_numpy(), expected)


def test_lacking_channels_may_be_empty_columns(tmp_path):
    folder = write(tmp_path)
    lines = (folder / "run.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines]
    for row in rows[1:]:
        for column in ("x", "y", "u", "v"):
            row[rows[0].index(column)] = ""
    (folder / "run.csv").write_text("\n".join(",".join(row) for row in rows))
    made = read_csv(folder)
    assert made.missing == {"X_WB": ("x", "y"), "V_WB_B": ("u", "v")}
    write_csv(made, tmp_path / "again")
    assert read_csv(tmp_path / "again").missing == made.missing


def edit(pattern, replacement, count=1):
    return lambda text: re.sub(pattern, replacement, text, count=count, flags=re.M)


def line(number, change):
    def apply(text):
        lines = text.splitlines()
        lines[number - 1] = change(lines[number - 1])
        return "\n".join(lines) + "\n"

    return apply


def cell(number, column, value):
    index = f"{STATE},{WRENCH}".split(",").index(column)

    def change(text):
        parts = text.split(",")
        parts[index] = value
        return ",".join(parts)

    return line(number, change)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: "", r"run\.csv: the file is empty"),
        (lambda text: text.splitlines()[0], "no data line"),
        (lambda text: "\n".join(text.splitlines()[1:]), "no header"),
        (edit("^t,x,y,z", "t,x,y,depth"), "column `z` is missing"),
        (edit("^t,x,y,z", "t,x,x,z"), "`x` appears twice"),
        (edit(",N$", ",n"), "column `N` is missing beside X"),
        (edit(",X,Y,Z,K,M,N$", ",f1,f2,f3,f4,f6,f7"), "column `f5` is missing"),
        (edit(",X,Y,Z,K,M,N$", ",a,b,c,d,e,f"), "no command"),
        (lambda text: "\n".join(row + ",1" for row in text.splitlines()), r"`1` is not known"),
        (edit(",N$", ",N,volt", 1), "fields where 21 belong"),
        (line(40, lambda row: row[:60]), r"run\.csv:40: \d+ fields where 20 belong; mend"),
        (line(101, lambda row: row[:60]), r"run\.csv:101: .* seems cut off there"),
        (cell(7, "u", "fast"), r"run\.csv:7: column `u`: 'fast' is no number"),
        (cell(7, "u", "nan"), r"run\.csv:7: column `u` has no finite number"),
        (cell(7, "K", ""), r"run\.csv:7: column `K`"),
        (cell(7, "M", "inf"), r"run\.csv:7: column `M`"),
        (cell(9, "t", "0.1"), r"run\.csv:9: time 0\.1 s goes back from 0\.3 s"),
        (cell(9, "t", "0.3"), r"run\.csv:9: time 0\.3 s repeats"),
        (cell(9, "t", ""), r"run\.csv:9: column `t`"),
        (cell(9, "qw", "45.0"), r"run\.csv:9: qw,qx,qy,qz have length 45"),
        (lambda text: "\n".join(text.splitlines()[:2]), "single sample"),
    ],
)
def test_mistakes_in_files_are_told_in_one_sentence(tmp_path, change, sentence):
    folder = write(tmp_path)
    path = folder / "run.csv"
    path.write_text(change(path.read_text()))
    with pytest.raises(UserError, match=sentence) as caught:
        read_csv(folder)
    assert "\n" not in str(caught.value)


def degrees(X, V, v_W):
    V[3:] = np.rad2deg(V[3:])
    return X, V


def scalar_last(X, V, v_W):
    X[:4] = X[[1, 2, 3, 0]]
    return X, V


def world(X, V, v_W):
    V[:3] = v_W
    return X, V


@pytest.mark.parametrize(
    ("mix_up", "sentence"),
    [(degrees, "deg/s"), (scalar_last, "x,y,z,w"), (world, "world's axes")],
)
def test_wrong_units_and_frames_are_suspected(tmp_path, mix_up, sentence):
    t = np.arange(0.0, 20.0, 0.05)
    X, V = mix_up(*smooth_motion(t, seed=1))
    columns = np.concatenate([t[None], X[4:], X[:4], V, np.ones((6, t.size))])
    folder = write(tmp_path, columns)
    with pytest.raises(UserError, match=sentence):
        read_csv(folder)
    (folder / "recording.yaml").write_text("frames: ENU/FLU\ncheck: false\n")
    assert read_csv(folder).scenarios == ("run",)


def test_pwm_and_voltage_out_of_range_are_units_mistaken(tmp_path):
    header = STATE + "," + ",".join(f"pwm{i}" for i in range(1, 9))
    columns = motion_columns(commands=8)
    columns[-8:] = 0.3
    with pytest.raises(UserError, match=r"run\.csv:2: column `pwm1` is 0\.3; give 500 to 2500 µs"):
        read_csv(write(tmp_path, columns, header))
    columns[-8:] = 1500
    with pytest.raises(UserError, match="`voltage` is 14800; give 1 to 100 V"):
        read_csv(write(tmp_path, np.vstack([columns, 14800 + 0 * T]), header + ",voltage"))


@pytest.mark.parametrize(
    ("meta", "sentence"),
    [
        ("vehicle: x\n", "frames"),
        ("frames: ENU\n", "ENU/FLU"),
        ("frames: ENU/FLU\nfile: {}\n", "did you mean `files`"),
        ("frames: ENU/FLU\nfiles: {missing.csv: a}\n", "missing.csv: no such file"),
        ("frames: ENU/FLU\nrate: -5\n", "rate must lie"),
    ],
)
def test_mistakes_in_the_metadata(tmp_path, meta, sentence):
    with pytest.raises(UserError, match=sentence):
        read_csv(write(tmp_path, meta=meta))


def test_a_folder_without_metadata_says_what_to_write(tmp_path):
    with pytest.raises(UserError, match="frames: ENU/FLU"):
        read_csv(tmp_path)
    (tmp_path / "recording.yaml").write_text("frames: ENU/FLU\n")
    with pytest.raises(UserError, match=r"no \.csv file"):
        read_csv(tmp_path)


def test_extra_columns_can_be_ignored(tmp_path):
    columns = np.vstack([motion_columns(), 7 + 0 * T])
    header = f"{STATE},{WRENCH},lights"
    with pytest.raises(UserError, match="`lights` is not known"):
        read_csv(write(tmp_path, columns, header))
    meta = "frames: ENU/FLU\nignore: [lights]\n"
    assert read_csv(write(tmp_path, columns, header, meta)).commands == ("F_Bo_B",)
    quoted = header.replace("lights", '"lights, all"')
    meta = "frames: ENU/FLU\nignore: ['lights, all']\n"
    assert read_csv(write(tmp_path, columns, quoted, meta)).commands == ("F_Bo_B",)


def test_a_real_tank_run_with_uneven_steps_passes(tmp_path):
    source = shared_data("data", "kth_bluerov2_heavy", "run_11_57_50_3dof.csv")
    data = np.genfromtxt(source, delimiter=",", names=True)
    roll, pitch, yaw = (data[f"{n}_rad"] / 2 for n in ("roll", "pitch", "yaw"))
    cr, cp, cy, sr, sp, sy = *map(np.cos, (roll, pitch, yaw)), *map(np.sin, (roll, pitch, yaw))
    q = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    names = ["t_s", "x_m", "y_m", "z_m"]
    twist = ["u_mps", "v_mps", "w_mps", "p_radps", "q_radps", "r_radps"]
    commands = [f"cmd_{axis}" for axis in ("surge", "sway", "heave", "roll", "pitch", "yaw")]
    columns = np.stack([*(data[n] for n in names), *q, *(data[n] for n in [*twist, *commands])])
    made = read_csv(write(tmp_path, columns), rate=10.0)
    assert made.duration == pytest.approx(data["t_s"][-1] - data["t_s"][0], abs=0.2)
    assert not [note for note in made.notes if "explains" in note]


def test_the_example_of_the_page_can_be_read(tmp_path):
    page = (ROOT / "docs" / "recording.md").read_text()
    table = re.search(r"(?:^    [t\d][^\n]*\n)+(?=\n)", page[page.index("    t,x,y") :], flags=re.M)
    metadata = re.search(r"```yaml\n(.*?)```", page, flags=re.S)
    assert table is not None
    assert metadata is not None
    for n in (1, 2, 3):
        (tmp_path / f"run_{n}.csv").write_text(table[0].replace("    ", ""))
    (tmp_path / "recording.yaml").write_text(metadata[1])
    made = read_csv(tmp_path)
    assert made.scenarios == ("surge", "yaw")
    assert made.lengths.tolist() == [[2, 2], [2, 0]]
    assert made.commands == ("F_Bo_B",)


@pytest.mark.parametrize(
    ("rows", "said"), [((8,), "u seems to have the wrong sign"), ((13,), "r seems to have")]
)
def test_one_axis_with_the_wrong_sign_is_named(tmp_path, rows, said):
    columns = motion_columns()
    columns[list(rows)] *= -1
    with pytest.raises(UserError, match=said):
        read_csv(write(tmp_path / "one", columns))


@pytest.mark.parametrize(("scale", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds")])
def test_times_in_another_unit_are_named(tmp_path, scale, unit):
    columns = motion_columns()
    columns[0] *= scale
    with pytest.raises(UserError, match=f"t looks like {unit}; give seconds"):
        read_csv(write(tmp_path / "one", columns))


def test_files_beside_are_told_and_the_vehicle_is_found_beside(tmp_path):
    (tmp_path / "one").mkdir()
    preset = (ROOT / "models/vehicles/bluerov2.yaml").read_text(encoding="utf-8")
    (tmp_path / "one/mine.yaml").write_text(preset)
    meta = "frames: ENU/FLU\nvehicle: mine.yaml\nfiles: {run.csv: a}\n"
    folder = write(tmp_path / "one", meta=meta)
    (folder / "run_2.csv").write_text((folder / "run.csv").read_text())
    recording = read_csv(folder)
    assert recording.scenarios == ("a",)
    assert [(f.word, f.place) for f in findings_of(recording.dataset)] == [
        ("unlisted-file", "run_2.csv")
    ]
    assert recording.vehicle == str(folder / "mine.yaml")


def test_outputs_of_the_thrusters_are_kept(tmp_path):
    outputs = (1, 2, 5, 4, 3, 6, 0, 12)
    made = Recording.from_trajectories([run(command="pwm")], 0.05)
    write_csv(Recording(with_outputs(made.dataset, outputs)), tmp_path / "runs")
    assert outputs_of(read_csv(tmp_path / "runs").dataset) == outputs
    write_csv(made, tmp_path / "plain")
    assert outputs_of(read_csv(tmp_path / "plain").dataset) == ()
    yaml = tmp_path / "runs" / "recording.yaml"
    yaml.write_text(yaml.read_text().replace("- 12\n", "").replace(", 12]", "]"))
    with pytest.raises(UserError, match="thruster_outputs: 7 outputs for 8 thrusters"):
        read_csv(tmp_path / "runs")
