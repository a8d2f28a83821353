"""The widest way is found, whatever ways there are, and never taken for narrower than it is."""

import numpy as np
import pytest
from scipy.stats import norm

from spinndrift.systems.planning.obstacles import Pylon
from spinndrift.systems.planning.passage import Passage, upright_gap, widest_way

SIZE = (0.45, 0.6, 0.25)
HALF = 0.45 / 2  # the hull's narrower side
START, GOAL = np.array([0.0, 0.0, -1.5]), np.array([4.0, 0.0, -1.5])
DIAGONAL = 0.04 * np.sqrt(2)  # of a cell


def ring(count: int, radius: float = 1.3, skip: int = 0, **more) -> list[Pylon]:
    angles = 2 * np.pi * np.arange(skip, count) / count
    xy = GOAL[:2] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [Pylon(float(x), float(y), 0.3, **{"bottom": -5.0, **more}) for x, y in xy]


def gap(count: int, radius: float = 1.3) -> float:
    """Clearance in the middle between two neighbours in a ring."""
    return radius * np.sin(np.pi / count) - 0.15 - HALF


def way(pylons, goal=GOAL, radius=0.5, bed=-5.0, enough=np.inf, start=START) -> float:
    return widest_way(start, goal, radius, pylons, SIZE, bed, enough)


@pytest.mark.parametrize("count", [5, 7, 9, 12, 16])
def test_a_ring_is_as_wide_as_its_gaps(count):
    found = way(ring(count))
    assert gap(count) <= found <= gap(count) + DIAGONAL
    assert way(ring(count), start=GOAL, goal=START) == pytest.approx(found, abs=DIAGONAL)


def test_a_gate_in_the_ring_opens_it():
    wide = 1.3 * np.sin(2 * np.pi / 16) - 0.15 - HALF
    assert wide <= way(ring(16, skip=1)) <= wide + DIAGONAL


def test_ways_over_and_under_count_while_they_are_near():
    closed = way(ring(16))
    over = way(ring(16, top=-1.0))
    assert over > closed + 0.3
    assert over <= 1.0 - SIZE[2] / 2 + DIAGONAL
    assert way(ring(16, top=-0.02)) == pytest.approx(closed, abs=DIAGONAL)  # no room to swim in
    assert way(ring(16, bottom=-2.5)) > closed + 0.3
    assert way(ring(16, bottom=-2.5), bed=-2.5) == pytest.approx(closed)
    assert way(ring(16, bottom=-4.0)) == pytest.approx(closed)  # deeper than anyone would look


def test_a_goal_is_reached_from_outside_if_its_radius_allows():
    assert way(ring(16), radius=0.5) < 0
    assert way(ring(16, radius=0.6), radius=1.5) > 0.2


def test_far_fields_and_open_water():
    far = np.array([150.0, 40.0, -1.5])
    assert way([], goal=far) == np.inf
    assert way([Pylon(2.0, 0.0)], goal=far) > 0.9
    assert way([Pylon(2.0, 0.0)] * 3, goal=START) > 0.9


def test_the_way_out_of_a_tight_start_is_not_judged():
    beside = START + np.array([2.7 - 0.15 - HALF - 0.05, 0.0, 0.0])  # 5 cm from a pylon of the ring
    pylons = ring(4)
    assert way(pylons, start=beside, goal=-GOAL, enough=0.2) >= 0.2 - DIAGONAL
    assert way(pylons, start=beside, goal=-GOAL) <= 0.05 + DIAGONAL


def test_risk_is_that_of_the_widest_way():
    tight = Passage(0.05, 0.08, 0.05)
    assert tight.risk == pytest.approx(norm.sf(0.05 / 0.08))
    assert not tight.safe
    assert Passage(0.08 * norm.isf(0.05) + 1e-9, 0.08, 0.05).safe
    assert Passage(np.inf, 0.08, 0.05).risk == 0
    assert (Passage(-0.01).safe, Passage(0.01).safe) == (False, True)
    assert (Passage(-0.01).risk, Passage(0.01).risk) == (1.0, 0.0)
    assert Passage(0.01, 0.08).safe


def test_the_gap_of_an_upright_hull():
    pylon = Pylon(0.0, 0.0, 0.3, bottom=-4.0, top=-1.0)
    assert upright_gap(np.array([1.0, 0.0, -2.0]), pylon, SIZE) == pytest.approx(0.85 - HALF)
    assert upright_gap(np.array([0.0, 0.0, -0.5]), pylon, SIZE) == pytest.approx(0.5 - 0.125)
    assert upright_gap(np.array([0.0, 0.0, -2.0]), pylon, SIZE) == pytest.approx(-0.15 - HALF)
