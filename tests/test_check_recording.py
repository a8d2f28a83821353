"""Checks of a recording as commands run them: findings kept, stretches cut, severe ones refused."""

import numpy as np
import pytest
from recordings_changed import as_wrench, changed

from helpers import ROOT
from spinndrift.models.config.errors import UserError
from spinndrift.models.recordings.checks.examine import examine
from spinndrift.models.recordings.checks.finding import (
    WORDS,
    Finding,
    check_accepted,
    enforce,
    findings_of,
    with_findings,
)
from spinndrift.models.recordings.checks.velocity import lag_findings
from spinndrift.models.recordings.resample import rotations
from spinndrift.models.recordings.store import Recording
from spinndrift.models.vehicles.vehicle import load_vehicle
from spinndrift.sims.cli import main
from spinndrift.systems.logs.load import import_log

HEAVY = load_vehicle("bluerov2_heavy")


@pytest.fixture(scope="module")
def dive() -> Recording:
    return import_log(ROOT / "sims/data/sitl_dive.tlog.xz")[0].cut(0.0, 20.0)


SEVERE = [word for word, (severity, _) in WORDS.items() if severity == "severe"]


def words(recording):
    return [finding.word for finding in findings_of(recording.dataset)]


def test_a_good_dive_passes_unchanged(dive):
    seen = examine(dive, HEAVY, "dive.nc")
    assert words(seen) == []
    assert seen.dataset.equals(dive.dataset)


@pytest.mark.parametrize("level", [0.0, 0.21])
def test_a_velocity_that_stands_still_in_the_world_is_left_out(dive, level):
    """From 8 to 14 s of each stretch the horizontal velocity stands still."""
    held = slice(160, 280)

    def lost(V):
        V = V.copy()
        for j in range(V.shape[0]):
            R = rotations(dive.dataset["X_WB"].to_numpy()[j, 0, :, :4].T)
            v = R.apply(V[j, 0, :, :3])
            v[held, :2] = level
            V[j, 0, :, :3] = R.inv().apply(v)
        return V

    seen = examine(changed(dive, "V_WB_B", lost), HEAVY, "dive.nc")
    assert words(seen) == ["velocity-held"] * 2
    first = float(dive.dataset["start_time"][0, 0])
    assert f"{first + 8.0:.1f} to {first + 14.0:.1f} s" in findings_of(seen.dataset)[0].place
    assert seen.duration == pytest.approx(dive.duration - 2 * 121 * 0.05)
    np.testing.assert_array_equal(seen.lengths, [[160, 120], [160, 120]])
    starts = seen.dataset["start_time"].to_numpy()
    np.testing.assert_allclose(starts[:, 1] - starts[:, 0], 14.0)
    assert seen.command_period == dive.command_period


def test_attitudes_and_rates_that_stand_still_are_left_out(dive):
    """From 8 to 14 s: the rates at a value, then attitude and rates, while commands go on."""
    held = slice(160, 280)

    def freeze(rows):
        def change(values):
            values = values.copy()
            values[:, :, held, rows] = values[:, :, 160:161, rows]
            return values

        return change

    rates = changed(dive, "V_WB_B", freeze(slice(3, 6)))
    both = changed(rates, "X_WB", freeze(slice(0, 4)))
    for seen, what in ((rates, "p,q,r"), (both, "attitude")):
        seen = examine(seen, HEAVY, "dive.nc", accept=SEVERE)
        found = [f for f in findings_of(seen.dataset) if f.word == "attitude-held"]
        assert [f.place.rsplit("s, ", 1)[1] for f in found] == [what] * 2
        np.testing.assert_array_equal(seen.lengths[:, 0], [160, 160])


def test_a_vehicle_at_rest_is_no_lost_lock(dive):
    """Nothing moves for 6 s, as at the start of a simulation: all velocities are zero."""
    rest = np.ones((1, 1, dive.mask.shape[2], 1))
    rest[:, :, :120] = 0
    assert "velocity-held" not in words(
        examine(changed(dive, "V_WB_B", lambda V: V * rest), HEAVY, "dive.nc")
    )


def test_marks_of_a_failed_dvl_are_left_out(dive):
    def failed(V):
        V = V.copy()
        V[0, 0, 200:203, :3] = -32.768
        return V

    seen = examine(changed(dive, "V_WB_B", failed), HEAVY, "dive.nc")
    assert words(seen) == ["velocity-impossible"]
    assert np.nanmax(np.abs(seen.dataset["V_WB_B"].to_numpy())) < 5
    np.testing.assert_array_equal(seen.lengths, [[198, 195], [400, 0]])


def test_severe_findings_stop_unless_accepted_by_name(dive, tmp_path, capsys):
    zero = changed(as_wrench(dive, HEAVY), "F_Bo_B", np.zeros_like)
    with pytest.raises(UserError, match=r"still.nc: F_Bo_B: .*--accept no-commands"):
        examine(zero, HEAVY, "still.nc")
    assert words(examine(zero, HEAVY, "still.nc", ["no-commands"])) == ["no-commands"]
    zero.save(tmp_path / "still.nc")
    for command in (
        ["train", "still.nc", "--out", "training"],
        ["diagnose", "still.nc", "--out", "diagnosis"],
        ["import", "still.nc", "--out", "again.nc"],
    ):
        with pytest.raises(SystemExit) as end:
            main([str(tmp_path / a) if "." in a or a in command[-1:] else a for a in command])
        assert end.value.code == 2
        assert "no command ever differs from zero" in capsys.readouterr().err
    assert not (tmp_path / "again.nc").exists()
    given = [str(tmp_path / "still.nc"), "--out", str(tmp_path / "again.nc")]
    main(["import", *given, "--accept", "no-commands"])
    assert words(Recording.load(tmp_path / "again.nc")) == ["no-commands"]
    assert "found no-commands" in capsys.readouterr().err


def test_accepted_words_are_checked():
    check_accepted(["no-commands"])
    for word in ("no-comands", "velocity-held"):
        with pytest.raises(UserError, match="give words of not-a-submarine"):
            check_accepted([word])


def test_findings_survive_files_and_damage_is_reported(dive, tmp_path):
    found = [Finding("no-voltage", "BATTERY_STATUS", "0 V"), Finding("velocity-held", "", "µ")]
    Recording(with_findings(dive.dataset, [*found, *found])).save(tmp_path / "a.nc")
    assert findings_of(Recording.load(tmp_path / "a.nc").dataset) == tuple(found)
    for text in ("[", "[1]", '[{"word": "x", "place": "", "text": ""}]', "{}", "1"):
        broken = dive.dataset.assign_attrs(findings=text)
        if text == "{}":
            assert findings_of(broken) == ()
            continue
        with pytest.raises(UserError, match="import the source anew"):
            findings_of(broken)


def test_all_severe_findings_are_told_at_once():
    found = [Finding("no-commands", "pwm", "a", "b"), Finding("no-answer", "", "c", "d")]
    with pytest.raises(UserError, match=r"f: pwm: a; b, or accept .*no-commands\n  also: c; d"):
        enforce("f", found)
    with pytest.raises(UserError, match=r"^f: c; d"):
        enforce("f", found, ["no-commands"])


def test_the_page_lists_every_word():
    page = (ROOT / "docs/checks.md").read_text(encoding="utf-8")
    for word, (severity, meaning) in WORDS.items():
        assert f"| `{word}` | {severity} | {meaning}" in page


@pytest.mark.parametrize("shift", [4, -6])
def test_velocities_shifted_in_time_are_named_with_the_shift(dive, shift):
    late = changed(dive, "V_WB_B", lambda V: np.concatenate(
        [np.roll(V[..., :3], shift, axis=2), V[..., 3:]], axis=-1
    ))  # fmt: skip
    inside = late.cut(0.5, 19.5)
    (finding,) = lag_findings(inside)
    how = "after" if shift > 0 else "before"
    assert (finding.word, finding.place) == ("velocity-lag", "u,v,w")
    assert f"{abs(shift) * dive.dt:.2g} s {how}" in finding.text
    assert lag_findings(dive) == []
