"""Groups of windows: who belongs together, and which ones a step takes."""

from dataclasses import replace

import numpy as np
import pytest
from diagonal import Diagonal, simulated

from spinndrift.models.config.errors import UserError
from spinndrift.training.data.groups import (
    group_labels,
    group_size,
    members,
    step_indices,
    whole_groups,
)


@pytest.fixture(scope="module")
def windows():
    """Two scenarios with 6 runs each, three starts; one run of the second is short."""
    plain = simulated(Diagonal.of(), 34, steps=3)
    scenario, run, tick = (a.ravel() for a in np.meshgrid(range(2), range(6), range(3)))
    kept = np.random.default_rng(0).permutation(36)
    kept = kept[~((scenario == 1) & (run == 5) & (tick > 0))[kept]]
    start = 0.4 * tick + 1e-9 * np.arange(36)
    return replace(plain, scenario=scenario[kept], run=run[kept], start=start[kept])


def test_labels_are_equal_where_scenario_and_start_are(windows):
    labels = group_labels(windows)
    for i in range(len(windows)):
        alike = (windows.scenario == windows.scenario[i]) & (
            np.abs(windows.start - windows.start[i]) < 0.01
        )
        np.testing.assert_array_equal(labels == labels[i], alike)


def test_the_size_is_what_half_of_the_groups_have_or_less(windows):
    assert group_size(windows, 4) == 4
    assert group_size(windows, 60) == 6
    alone = replace(windows, start=np.arange(len(windows)) * 0.1)
    with pytest.raises(UserError, match="several runs of a scenario"):
        group_size(alone, 4)


def test_a_step_holds_whole_groups_of_different_windows(windows):
    labels, usable = group_labels(windows), np.arange(len(windows))
    for number in range(20):
        drawn = step_indices(1, number, 13, usable, labels, 4).reshape(3, 4)
        for group in drawn:
            assert np.unique(group).size == 4
            assert np.unique(labels[group]).size == 1


def test_all_groups_and_all_their_windows_get_their_turn(windows):
    labels, usable = group_labels(windows), np.arange(len(windows))
    first = [step_indices(1, n, 8, usable, labels, 4) for n in range(3)]
    assert np.unique(labels[np.concatenate(first)]).size == 6
    everything = np.concatenate([step_indices(1, n, 8, usable, labels, 4) for n in range(60)])
    assert set(everything) == set(range(len(windows)))


def test_draws_depend_on_their_arguments_alone(windows):
    labels, usable = group_labels(windows), np.arange(3, len(windows))
    again = [step_indices(2, 7, 8, usable, labels, 4) for _ in range(2)]
    np.testing.assert_array_equal(*again)
    assert not np.array_equal(again[0], step_indices(3, 7, 8, usable, labels, 4))
    assert min(again[0]) >= 3


def test_groups_that_are_too_small_are_left_out(windows):
    labels = group_labels(windows)
    whole = members(labels, np.arange(len(windows)), 6)
    assert len(whole) == 4
    assert step_indices(0, 0, 8, np.arange(1), labels, 4).size == 0


def test_windows_to_validate_on_come_in_groups_of_equal_size(windows):
    kept = whole_groups(windows, 6, 20)
    assert len(kept) == 18
    for group in group_labels(kept).reshape(3, 6):
        assert np.unique(group).size == 1
    assert len(whole_groups(windows, 1, 5)) == 5
