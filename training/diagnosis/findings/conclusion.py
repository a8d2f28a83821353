"""From causes, coefficients and a tested claim to the verdict and its words."""

from collections.abc import Sequence
from typing import NamedTuple

from ..validation.claims import Claim
from . import result, sentences


class Conclusion(NamedTuple):
    """What a diagnosis concludes.

    Attributes:
        causes: those that remain.
        left: what speaks against the claim that only noise is left.
    """

    causes: list[result.Cause]
    left: list[str]
    verdict: result.Verdict
    sentence: str


def conclude(
    causes: list[result.Cause],
    left: list[str],
    claim: Claim,
    faults: Sequence[str],
    coefficients: Sequence[result.Refitted],
    ratios: Sequence[result.Ratio],
) -> Conclusion:
    """The conclusion; what commands do not explain is no evidence for a name."""
    left = [*left, *claim.vetoes]
    lost = sentences.commands_lost(ratios)
    if lost:
        causes, left = [], [lost, *left]
    added = sentences.without_added_mass(coefficients)
    off = "" if lost else sentences.coefficients_off(ratios, added)
    text = sentences.sentence(causes, faults, bool(coefficients), left, claim.explained, off)
    return Conclusion(causes, left, sentences.verdict(causes, left, bool(off)), text)
